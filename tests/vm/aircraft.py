"""Provides the aircraft computer of these proofs: its configuration, and a comparison of sent and logged units."""

from __future__ import annotations

import re
from collections import defaultdict
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from swath.daemon.log.mcap.chunks import json_objects
from swath.daemon.log.reader import open_logs
from swath.sim.companions import companion_files, config_text, default_wires
from swath.sim.fly import VirtualFlight
from swath.sim.plan.plan import parse_plan
from tests.vm import installed
from tests.vm.machine import GUEST, MODULES

LOGS = "/var/lib/swath"
SENSORS = "/usr/local/lib/sensors.py"
_PLAN = """
[flight]
name = "flight"
seed = 8
[[line]]
name = "1"
from_m = [-150, 0]
to_m = [150, 0]
height_m = 520
[gnss.rover]
ins = true
[scanner.left]
prf_hz = 5000
"""
_WIRES = {
    "gnss/rover": "serial:/dev/ttyS1?baud=115200",
    "imu/main": "can:socketcan:vcan0",
    "scanner/left": "udp:127.0.0.1:2368",
    "pps/main": "/dev/pps0",
}
# The log has its own disk; devices that need no udev appear before systemd asks for them.
_FSTAB = "/dev/vda /var/lib/swath ext4 defaults 0 0\n"
_DEVICES = """\
[Unit]
DefaultDependencies=no
Before=sysinit.target
[Service]
Type=oneshot
RemainAfterExit=yes
ExecStart=/bin/sh -c 'modprobe vcan; ip link add vcan0 type vcan; ip link set vcan0 up; insmod %s'
[Install]
WantedBy=sysinit.target
"""

# qemu joins ttyS1 to a second serial port of the same machine, which the driver of PCI ports serves
SENDING_PORT = "/dev/$(basename /sys/bus/pci/drivers/serial/0000*/tty/ttyS*)"


def null_modem(folder: Path) -> list[str]:
    """Return qemu's arguments that connect ttyS1 with `SENDING_PORT`."""
    place = folder / "wire"
    return [
        *("-chardev", f"socket,id=here,path={place},server=on,wait=off", "-chardev", f"socket,id=there,path={place}"),
        *("-device", "isa-serial,chardev=here,index=1", "-device", "pci-serial,chardev=there"),
    ]


def aboard(folder: Path, *, session: str = "", enabled: tuple[str, ...] = ("swathd.service",)) -> Path:
    """Make an overlay with all sensors configured and present, the log on the first disk, the recorder enabled."""
    plan = parse_plan(_PLAN, Path())
    flight = VirtualFlight(plan, None, 1.0)
    text = config_text(plan, default_wires(plan) | _WIRES, LOGS)
    text = text.replace("[session]\n", f"[session]\nreserve_mb = 16\n{session}", 1)
    installed.overlay(folder, text, enabled=enabled)
    for name, data in companion_files(plan, flight.site, flight.scene).items():
        (folder / "etc/swath" / name).write_bytes(data)
    (folder / "etc/fstab").write_text(_FSTAB)
    units = folder / "etc/systemd/system"
    (units / "sensors.service").write_text(_DEVICES % (MODULES / "pps_sim.ko"))
    (units / "sysinit.target.wants").mkdir(parents=True)
    (units / "sysinit.target.wants/sensors.service").symlink_to("/etc/systemd/system/sensors.service")
    place = folder / SENSORS[1:]
    place.parent.mkdir(parents=True)
    place.write_bytes((GUEST / "sensors.py").read_bytes())
    return folder


@dataclass(frozen=True)
class Turn:
    """How much had been sent by a moment of the machine's CLOCK_MONOTONIC."""

    monotonic_ns: int
    udp: int
    serial: int
    can: int


def sent(folder: Path) -> list[Turn]:
    """Return what the sensors noted; the last line may be cut off by the power cut."""
    lines = (folder / "sent").read_text().split("\n")[:-1]
    return [Turn(*(int(word) for word in line.split())) for line in lines]


def numbers(paths: list[Path], udp: str = "/scanner/left/raw") -> dict[str, list[int]]:
    """Return the numbers of the units in logs, in file order, for each kind of sensor; ``udp`` names its topic."""
    found: dict[str, list[int]] = defaultdict(list)
    text = b""
    for session in open_logs(paths):
        for batch in session.batches():
            topic = batch.channel.topic
            for row in batch.units:
                data = row.tobytes()
                if topic == udp:
                    found["udp"].append(int.from_bytes(data[:8], "little"))
                elif topic == "/imu/main/raw":
                    found["can"].append(int.from_bytes(data[-8:], "little"))
                elif topic == "/gnss/rover/raw":
                    text += data
    found["serial"] = [int(number) for number in re.findall(rb"\$P,(\d{10})\r\n", text)]
    return dict(found)


def missing(numbers: list[int]) -> list[tuple[int, int]]:
    """Return where numbers do not go on by one: the last before, and the first after."""
    return [(one, other) for one, other in pairwise(numbers) if other != one + 1]


def event_codes(path: Path) -> list[str]:
    """Return the codes of a log's events, in order, and check that the log is whole."""
    (session,) = open_logs([path])
    found = [
        str(event["code"])
        for batch in session.batches(lambda topic: topic == "/events")
        for _, event in json_objects(batch)
    ]
    assert not session.damage, session.damage
    return found
