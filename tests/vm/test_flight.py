"""Tests a flight with the virtual aircraft on this computer and the aircraft's computer in the machine.

The scanner's datagrams come over the machine's network card, the receiver's messages over a 16550, the IMU's frames
over SocketCAN, and the pulses at /dev/pps0. qemu has no CAN beyond the host kernel's, so frames cross as a stream and
are sent to vcan0 in the machine. The pulses are those of `guest/pps_sim.c`, adjusted to the phase outside.
"""

from __future__ import annotations

import os
import socket
import struct
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import can
import laspy
import numpy as np
import pytest

from swath.daemon.cli.main import run_app
from swath.daemon.config import load_config
from swath.daemon.processing.live.points import POINT_DTYPE
from swath.daemon.simulate.on_wires import CAN_GROUP, free_ports
from swath.drivers.transports.spec import parse_transport
from swath.sim.companions import companion_files, config_text
from swath.sim.fly import VirtualFlight
from swath.sim.plan.plan import parse_plan
from tests.builders import Recorded, judged, running
from tests.daemon.log_check import read_log
from tests.daemon.rig import HANGS_S, wait_until
from tests.vm import aircraft, machine
from tests.vm.installed import with_udev

pytestmark = pytest.mark.alone

PRF_HZ = 2000  # an emulated machine can follow this rate; the other flights of this kind have 1000
SECONDS, SECONDS_LONG = 60.0, 180.0
BITRATE = 460_800
SO_RCVBUFFORCE = 33  # <asm-generic/socket.h>; the tests here run as root
PLAN = f"""
[flight]
name = "flight"
seed = 12
speed_mps = 50.0
[[line]]
name = "1"
from_m = [-900, 0]
to_m = [900, 0]
height_m = 700
[[line]]
name = "2"
from_m = [900, 150]
to_m = [-900, 150]
height_m = 700
[gnss.rover]
rate_hz = 5
secondary_lever_arm_m = [0.1, 1.15, -1.2]
[imu.main]
rate_hz = 200
rotation_b_imu = [[0, 1, 0], [-1, 0, 0], [0, 0, 1]]
[scanner.left]
prf_hz = {PRF_HZ}
on_lines_only = false
"""
ABOARD = {
    "pps/main": "/dev/pps0",
    "gnss/rover": f"serial:/dev/ttyS1?baud={BITRATE}",
    "imu/main": "can:socketcan:vcan0",
    "scanner/left": "udp:0.0.0.0:2368?buffer_mb=8",
}
NETWORK = (
    "modprobe virtio_net; until [ -e /sys/class/net/eth0 ]; do sleep 0.1; done;"
    " ip addr add 10.0.2.15/24 dev eth0; ip link set eth0 up; ip route add default via 10.0.2.2"
)


class Lines:
    """This end of the wires: the clock that is queried, CAN frames in transit, the pulses' phase.

    Args:
        wires: folder of the flight's ports.
        can_port: UDP port of the flight's CAN bus.
        stream_port: TCP port that leads into the machine.
    """

    def __init__(self, wires: Path, can_port: int, stream_port: int) -> None:
        self._pulses = wires / "pps-main"
        self._phase_ns = -1
        self._stopped = threading.Event()
        self._clock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._clock.bind(("127.0.0.1", 0))
        self._clock.settimeout(0.2)
        self.clock_port = int(self._clock.getsockname()[1])
        self._bus = can.Bus(CAN_GROUP, interface="udp_multicast", port=can_port)
        with socket.socket(fileno=os.dup(self._bus.fileno())) as wire:  # a busy computer reads it late
            wire.setsockopt(socket.SOL_SOCKET, SO_RCVBUFFORCE, 16 << 20)
        self._stream_port = stream_port
        self.frames = 0
        self._threads = [threading.Thread(target=self._tell_time)]

    def connect(self) -> None:
        """Connect when the machine listens; only then does the flight find a reader of its pulses, and begin."""
        stream = socket.create_connection(("127.0.0.1", self._stream_port))
        stream.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._threads += [threading.Thread(target=self._carry, args=(stream,)), threading.Thread(target=self._follow)]
        for thread in self._threads[1:]:
            thread.start()

    def _tell_time(self) -> None:
        while not self._stopped.is_set():
            try:
                _, asker = self._clock.recvfrom(16)
            except TimeoutError:
                continue
            self._clock.sendto(struct.pack("<qq", time.time_ns(), self._phase_ns), asker)

    def _carry(self, stream: socket.socket) -> None:
        while not self._stopped.is_set():
            frame = self._bus.recv(0.2)
            if frame is not None:
                number = frame.arbitration_id | (1 << 31 if frame.is_extended_id else 0)
                stream.sendall(struct.pack("<IB3x8s", number, frame.dlc, bytes(frame.data)))
                self.frames += 1
        stream.close()

    def _follow(self) -> None:
        fd = os.open(self._pulses, os.O_RDONLY | os.O_NONBLOCK)
        while not self._stopped.wait(0.05):
            try:
                lines = os.read(fd, 4096).split(b"\n")
            except BlockingIOError:
                continue
            if lines[0]:
                self._phase_ns = int(lines[0].split()[0]) % 1_000_000_000
        os.close(fd)

    def __enter__(self) -> Lines:
        self._threads[0].start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stopped.set()
        for thread in self._threads:
            thread.join()
        self._bus.shutdown()
        self._clock.close()


def aboard(folder: Path, clock_port: int) -> Path:
    """Return the overlay of the aircraft's computer."""
    plan = parse_plan(PLAN, Path())
    flight = VirtualFlight(plan, None, 1.0)
    overlay = aircraft.aboard(folder)
    text = config_text(plan, ABOARD, aircraft.LOGS)
    (overlay / "etc/swath/swath.toml").write_text(text.replace("[session]\n", "[session]\nreserve_mb = 16\n", 1))
    for name, data in companion_files(plan, flight.site, flight.scene).items():
        (overlay / "etc/swath" / name).write_bytes(data)
    place = overlay / "usr/local/lib/lines.py"
    place.write_bytes((machine.GUEST / "lines.py").read_bytes())
    return overlay


@dataclass(frozen=True)
class Ends:
    """Where the flight's own ends of its wires are."""

    serial: str
    udp_port: int
    can_port: int

    @classmethod
    def of(cls, wires: Path) -> Ends:
        """Read the ends from the configuration beside them."""
        config = load_config(wires / "swath.toml")
        receiver, imu, scanner = (
            parse_transport(one.transport) for one in (config.gnss["rover"], config.imu["main"], config.scanner["left"])
        )
        udp_port = int(scanner.address.rpartition(":")[2])
        return cls(os.path.realpath(receiver.address), udp_port, int(imu.options["port"]))


@contextmanager
def flown(folder: Path, seconds: float) -> Iterator[tuple[machine.Machine, Lines]]:
    """Return the completed flight while the machine still runs."""
    plan, wires, disk = folder / "plan.toml", folder / "wires", machine.make_disk(folder / "disk", 512)
    plan.write_text(PLAN)
    fly = ("sim", "fly", plan, "--wire", "-o", wires, "--seconds", f"{seconds:g}", "--wait", f"{HANGS_S:g}")
    (stream_port,) = free_ports(1)
    with running(*fly) as flying:
        wait_until((wires / "pps-main").exists, "the last of the wires")
        ends = Ends.of(wires)
        with Lines(wires, ends.can_port, stream_port) as lines:
            user = f"user,id=net,hostfwd=udp:127.0.0.1:{ends.udp_port}-:2368"
            qemu = [
                *machine.disk(disk),
                *("-chardev", f"serial,id=gnss,path={ends.serial}", "-device", "isa-serial,chardev=gnss,index=1"),
                *("-netdev", f"{user},hostfwd=tcp:127.0.0.1:{stream_port}-:5005"),
                *("-device", "virtio-net-pci,netdev=net"),
            ]
            overlay = aboard(folder / "overlay", lines.clock_port)
            with machine.start(
                machine.SERVE,
                shared=folder / "vm",
                systemd=True,
                overlay=overlay,
                layers=with_udev(),
                qemu=qemu,
                kernel=["net.ifnames=0"],
                memory_mb=1536,
                timeout_s=1200,
            ) as computer:
                computer.told(NETWORK)
                command = f"lines.py vcan0 5005 10.0.2.2:{lines.clock_port}"
                computer.told(f"systemd-run -q --unit=lines chrt -f 20 /usr/bin/python3 /usr/local/lib/{command}")
                computer.until("systemctl is-active swathd && ss -ltn | grep -q :5005", 400)
                lines.connect()
                _, trouble = flying.communicate(timeout=HANGS_S)
                assert flying.returncode == 0, trouble
                # printed with a failure: it shows where each thread of a stalled recorder stood
                sys.stdout.write(computer.told("journalctl -b -o short-monotonic -u swathd --no-pager", 200))
                computer.told("sleep 3; systemctl stop swathd; sync", 200)
                yield computer, lines
    machine.replay_journal(disk)
    machine.copy_from_disk(disk, "/", folder / "logs")


@pytest.mark.parametrize(
    "seconds", [SECONDS, pytest.param(SECONDS_LONG, marks=pytest.mark.long)], ids=["minute", "three minutes"]
)
def test_a_flight_is_recorded_from_the_wires_and_georeferenced(
    tmp_path: Path, seconds: float, record_property: Callable[[str, object], None]
) -> None:
    with flown(tmp_path, seconds) as (computer, _):
        assert computer.told("systemctl show -P NRestarts swathd") == "0"
    logs, again = tmp_path / "logs", tmp_path / "again"
    assert run_app(["sim", "fly", str(tmp_path / "plan.toml"), "-o", str(again), "--seconds", f"{seconds:g}"]) == 0
    assert_complete(logs, again)
    out = tmp_path / "points"
    # a nominal calibration has sigmas of metres, which would hide errors of time, navigation and decoding
    known = ["--calibration", f"left={again / 'left.true.toml'}", "--trajectory-datum", "same"]
    assert run_app(["georef", str(logs), "-o", str(out), "--strips", "whole", *known]) in (0, 1)
    las = laspy.read(next(out.glob("*.laz")))
    truth = np.load(again / "truth.npz")
    record_property("pulses_per_s", PRF_HZ)
    record_property("points", len(las))
    # returns before the first or after the last sample of the IMU have no pose
    assert len(las) > 0.99 * len(truth["left.gps_ns"])
    assert len(las) > PRF_HZ * seconds / 3  # the turn of the three-minute flight is beyond the ground
    time_ns = np.rint(np.asarray(las.gps_time) * 1e9).astype(np.int64) + 10**18
    sigma = np.stack([np.asarray(las[f"sigma_{name}"]) for name in ("easting", "northing", "height")], axis=1)
    recorded = Recorded(logs, np.empty(0, POINT_DTYPE), truth)
    missed = recorded.missed(time_ns, np.asarray(las.return_number), np.asarray(las.xyz))
    for axis, axis_missed, axis_sigma in zip(("east", "north", "height"), missed.T, sigma.T, strict=True):
        record_property(f"rms_{axis}_m", float(np.sqrt((axis_missed**2).mean())))
        record_property(f"sigma_{axis}_m", float(np.sqrt((axis_sigma**2).mean())))
    judged(missed, sigma)


def assert_complete(logs: Path, again: Path) -> None:
    """Assert that the recording equals the log that the same flight writes, to the byte."""
    (log,) = logs.glob("*.mcap")
    (same,) = again.glob("*.mcap")
    recorded, flown_ = read_log(log), read_log(same)
    for source in ("imu/main", "scanner/left"):
        mine, its = ([data for _, data in content.units[source]] for content in (recorded, flown_))
        assert len(mine) == len(its), source
        assert mine == its, source
    assert recorded.data("gnss/rover") == flown_.data("gnss/rover")
    for source in ("imu/main", "scanner/left", "gnss/rover", "pps/main"):
        status = recorded.messages[f"/status/{source}"][-1][1]
        assert [status[key] for key in ("lost_kernel", "lost_queue", "lost_write")] == [0, 0, 0], (source, status)
    assert recorded.messages["/status/pps/main"][-1][1]["time_state"] == "LOCKED"
