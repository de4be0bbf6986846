"""Checks the configured devices as far as the system knows them, without opening them; `swath check` opens them."""

from __future__ import annotations

import os
import re
import socket
import stat
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from swath.daemon.doctor.finding import Finding, Tree, Verdict, read_text

SERVICE_USER = "swath"
EDGE_S = 3.0  # an older edge means that no pulses arrive
TEST_PPS = ("ktimer",)  # Documentation/driver-api/pps.rst: a kernel timer, for tests
SERIAL_LATENCY_MS = 1
CAN_QUEUE_FRAMES = 100
_IFF_UP = 0x1
_UNIT = "/usr/lib/systemd/system/swathd.service"


@dataclass(frozen=True, slots=True)
class User:
    """A user who opens devices, with the ids that decide about permissions."""

    name: str
    uid: int
    gids: frozenset[int]

    def may(self, status: os.stat_result, bits: int) -> bool:
        """Return True if the mode of a file grants this user the access ``bits`` (of 7)."""
        if self.uid == 0:
            return True
        if status.st_uid == self.uid:
            granted = status.st_mode >> 6
        elif status.st_gid in self.gids:
            granted = status.st_mode >> 3
        else:
            granted = status.st_mode
        return granted & bits == bits


def recording_user(tree: Tree) -> User:
    """Return the service's user if it exists, else the user of this process."""
    for line in (tree.read("/etc/passwd") or "").splitlines():
        fields = line.split(":")
        if fields[0] == SERVICE_USER and len(fields) > 3:
            groups = {int(fields[3])}
            for group in (tree.read("/etc/group") or "").splitlines():
                parts = group.split(":")
                if len(parts) > 3 and SERVICE_USER in parts[3].split(","):
                    groups.add(int(parts[2]))
            return User(SERVICE_USER, int(fields[2]), frozenset(groups))
    return User(f"user {os.geteuid()}", os.geteuid(), frozenset({os.getegid(), *os.getgroups()}))


def group_name(tree: Tree, gid: int) -> str:
    """Return the name of a group, or its number as text if it has no name."""
    for line in (tree.read("/etc/group") or "").splitlines():
        fields = line.split(":")
        if len(fields) > 2 and fields[2] == str(gid):
            return fields[0]
    return str(gid)


def device_file(tree: Tree, path: str, user: User) -> Iterator[Finding]:
    """Check that a device exists, and that its user may read and write it."""
    check = "devices"
    try:
        status = tree.at(path).stat()
    except OSError:
        yield Finding(check, Verdict.WRONG, f"{path} does not exist", f"ls -l {Path(path).parent} /dev/serial/by-id")
        return
    if user.may(status, 6):
        yield Finding(check, Verdict.OK, f"{user.name} may read and write {path}")
        return
    group, mode = group_name(tree, status.st_gid), stat.filemode(status.st_mode)
    text = f"{user.name} may not read and write {path} ({mode}, group {group})"
    mend = f"sudo chgrp dialout {path} && sudo chmod g+rw {path}  # permanently: a udev rule as in 90-swath.rules"
    if status.st_mode & 0o060 == 0o060 and status.st_gid != 0:
        mend = f"sudo usermod -aG {group} {user.name}  # then restart the service, or log in again"
    yield Finding(check, Verdict.WRONG, text, mend)


def device_policy(tree: Tree, path: str) -> Iterator[Finding]:
    """Check that the systemd unit lets the service open this class of devices (DeviceAllow)."""
    files = [tree.at(_UNIT), *sorted(tree.at("/etc/systemd/system/swathd.service.d").glob("*.conf"))]
    allowed = [
        value for file in files for value in re.findall(r"^DeviceAllow=(\S+)", read_text(file) or "", re.MULTILINE)
    ]
    if not allowed or path in allowed:
        return
    kind = re.sub(r"\d+$", "", tree.at(path).resolve().name)
    if f"char-{kind}" not in allowed:
        text = f"swathd.service may not open devices of the class char-{kind} ({path})"
        mend = f"sudo systemctl edit swathd  # [Service] DeviceAllow=char-{kind} rw"
        yield Finding("devices", Verdict.WRONG, text, mend)


def serial_port(tree: Tree, path: str) -> Iterator[Finding]:
    """Check a serial port for the kernel's console and for an adapter that holds bytes back."""
    name = tree.at(path).resolve().name
    if name in (tree.read("/sys/class/tty/console/active") or "").split():
        text = f"{path} is the kernel's console: kernel messages mix with the data of the device"
        mend = f"remove console={name} from the kernel's command line; sudo systemctl disable --now serial-getty@{name}"
        yield Finding("serial ports", Verdict.WRONG, text, mend)
    latency = tree.number(f"/sys/bus/usb-serial/devices/{name}/latency_timer")
    if latency is not None and latency > SERIAL_LATENCY_MS:
        text = f"the adapter of {path} delays bytes by {latency} ms, and so the times of messages"
        mend = f"echo 1 | sudo tee /sys/bus/usb-serial/devices/{name}/latency_timer  # permanently: 90-swath.rules"
        yield Finding("serial ports", Verdict.NOTE, text, mend)


def port_grabbers(tree: Tree) -> Iterator[Finding]:
    """Check for running programs that open any serial port they find."""
    for name, unit in (("ModemManager", "ModemManager"), ("brltty", "brltty"), ("gpsd", "gpsd.socket gpsd")):
        if name in tree.processes():
            text = f"{name} is running: it opens serial ports and writes to receivers, even during a flight"
            yield Finding("serial ports", Verdict.WRONG, text, f"sudo systemctl disable --now {unit}")


def pps_device(tree: Tree, path: str, edge: str, now_s: float | None = None) -> Iterator[Finding]:
    """Check that edges arrive at a PPS device.

    Args:
        edge: assert or clear.
        now_s: CLOCK_REALTIME; None reads it.
    """
    check = "PPS"
    folder = tree.at("/sys/class/pps") / tree.at(path).resolve().name
    if not folder.exists():
        mend = (
            "sudo systemctl start swath-pps@ttyS0  # use your port; permanently: a udev rule as in 90-swath.rules; "
            "or: sudo modprobe pps-gpio, with the overlay of the board"
        )
        yield Finding(check, Verdict.WRONG, f"{path}: the kernel has no such PPS source", mend)
        return
    if read_text(folder / "name") in TEST_PPS:
        text = f"{path} is the kernel's test source, not the pulse of a receiver"
        yield Finding(check, Verdict.WRONG, text, "sudo modprobe -r pps-ktimer")
    last = re.match(r"(\d+\.\d+)#(\d+)", read_text(folder / edge) or "")
    age_s = None if last is None else (time.time() if now_s is None else now_s) - float(last.group(1))
    if last is None or last.group(2) == "0":
        text = f"{path} has never seen an edge ({edge}); check the wiring, the receiver's settings and pps.….edge"
        yield Finding(check, Verdict.WRONG, text, f"sudo ppstest {path}")
    elif age_s is not None and abs(age_s) > EDGE_S:
        text = f"the last edge at {path} came {age_s:.0f} s ago"
        yield Finding(check, Verdict.WRONG, text, f"sudo ppstest {path}")
    else:
        yield Finding(check, Verdict.OK, f"{path} sees edges")


def can_interface(
    tree: Tree, name: str, wanted_bitrate: int | None, bitrate_of: Callable[[str], int | None]
) -> Iterator[Finding]:
    """Check that a CAN interface exists, is up, runs at the right bit rate and has lost no frames.

    Args:
        wanted_bitrate: of the configuration; None if it gives no rate.
        bitrate_of: reads the rate from the kernel (`interface_bitrate`).
    """
    check, folder = "CAN", tree.at(f"/sys/class/net/{name}")
    set_up = f"sudo ip link set {name} up type can bitrate {wanted_bitrate or 1_000_000} restart-ms 100"
    if not folder.exists():
        mend = "ip -details link show type can; dmesg | grep -i can"
        yield Finding(check, Verdict.WRONG, f"interface {name} does not exist", mend)
        return
    if not int(read_text(folder / "flags") or "0", 16) & _IFF_UP:
        yield Finding(check, Verdict.WRONG, f"{name} is down", set_up)
    actual = bitrate_of(name)
    if wanted_bitrate is not None and actual is not None and actual != wanted_bitrate:
        text = f"{name} runs at {actual} bit/s, but {wanted_bitrate} is configured: no frame can be received"
        yield Finding(check, Verdict.WRONG, text, f"sudo ip link set {name} down && {set_up}")
    lost = {
        key: tree.number(f"/sys/class/net/{name}/statistics/{key}") or 0 for key in ("rx_dropped", "rx_over_errors")
    }
    if any(lost.values()):
        counts = ", ".join(f"{key} {count}" for key, count in lost.items() if count)
        yield Finding(
            check, Verdict.NOTE, f"{name} has lost frames since it came up: {counts}", f"ip -s link show {name}"
        )
    queue = tree.number(f"/sys/class/net/{name}/tx_queue_len")
    if queue is not None and queue < CAN_QUEUE_FRAMES:
        text = f"the send queue of {name} holds {queue} frames: enough to record, too few for swath replay"
        yield Finding(check, Verdict.NOTE, text, f"sudo ip link set {name} txqueuelen 1000")
    if actual is not None and actual == wanted_bitrate:
        yield Finding(check, Verdict.OK, f"{name} runs at {actual} bit/s")


def network_host(host: str, port: int) -> Iterator[Finding]:
    """Check that the name of a TCP server is known and that a route leads to it; nothing is sent to it."""
    try:
        family, kind, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
        with socket.socket(family, kind) as probe:
            probe.connect(address)  # of a datagram socket: only asks the kernel for the route
    except socket.gaierror:
        yield Finding("network", Verdict.WRONG, f"the host name {host} is unknown", f"getent hosts {host}")
    except OSError as error:
        text = f"no route leads to {host}: {error.strerror or error}"
        yield Finding("network", Verdict.WRONG, text, "ip route; ip -brief address")
    else:
        yield Finding("network", Verdict.OK, f"a route leads to {host}")


def network_interface(tree: Tree, name: str) -> Iterator[Finding]:
    """Check that the network interface of a scanner has a link."""
    folder = tree.at(f"/sys/class/net/{name}")
    if not folder.exists():
        yield Finding("network", Verdict.WRONG, f"interface {name} does not exist", "ip link")
    elif read_text(folder / "operstate") == "down":
        text = f"{name} is down, or has no link"
        yield Finding("network", Verdict.WRONG, text, f"sudo ip link set {name} up; ethtool {name} | grep Link")
    else:
        yield Finding("network", Verdict.OK, f"{name} has a link")
