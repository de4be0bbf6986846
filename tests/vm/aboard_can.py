"""Runs in the machine: an IMU on CAN, a sender by raw AF_CAN sockets, faults of interface and controller."""

from __future__ import annotations

import errno
import os
import shutil
import signal
import socket
import struct
import time
from array import array
from pathlib import Path
from typing import Any

from tests.vm.aboard import SHARED, TREE, WORK, Recorder, keep, main, recording, say, session, sh, wait_until

FRAME = struct.Struct("<IB3x8s")
FD_FRAME = struct.Struct("<IBBxx64s")
CAN_RAW_FD_FRAMES = 5
SOL_CAN_RAW = 101
ERROR, BUS_OFF, RESTARTED, CONTROLLER = 0x2000_0000, 0x40, 0x100, 0x04
IMU = """
[imu.{name}]
transport = "can:socketcan:{channel}{options}"
protocol = "dbc"
dbc = "{dbc}"
rate_hz = {rate_hz}
tick_hz = 1_000_000

[imu.{name}.signals]
specific_force = ["ACC.acc_x", "ACC.acc_y", "ACC.acc_z"]
angular_rate = ["GYR.gyr_x", "GYR.gyr_y", "GYR.gyr_z"]
sample_ticks = "SAMPLE.ticks"
temperature = "SAMPLE.temperature"
status = "SAMPLE.status"
packet_counter = "SAMPLE.packet_counter"
"""


DBC = "fixtures/config/imu.dbc"
OF_THE_UNIT: dict[str, Any] = {
    "dbc": str(TREE / DBC),
    "rate_hz": 1000.0,
    "tick_hz": 1_000_000.0,
    "signals": {
        "specific_force": ["ACC.acc_x", "ACC.acc_y", "ACC.acc_z"],
        "angular_rate": ["GYR.gyr_x", "GYR.gyr_y", "GYR.gyr_z"],
        "sample_ticks": "SAMPLE.ticks",
        "packet_counter": "SAMPLE.packet_counter",
    },
}


def imu(name: str, channel: str, rate_hz: int, options: str = "") -> str:
    """Return an [imu.<name>] table for an interface."""
    WORK.mkdir(parents=True, exist_ok=True)
    dbc = shutil.copy(TREE / DBC, WORK)  # the project's folder may be open to root only
    return IMU.format(name=name, channel=channel, rate_hz=rate_hz, dbc=dbc, options=options)


class Bus:
    """The sending end of a CAN interface."""

    def __init__(self, channel: str, *, fd: bool = False) -> None:
        os.sched_setaffinity(0, {0})  # vcan keeps the order of one processor's frames only
        self._socket = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
        self._socket.setsockopt(SOL_CAN_RAW, CAN_RAW_FD_FRAMES, int(fd))
        self._socket.bind((channel,))

    def send(self, identifier: int, data: bytes) -> bytes:
        """Send one classic frame, and return it when the driver has accepted it."""
        frame = FRAME.pack(identifier, len(data), data)
        self.send_frame(frame)
        return frame

    def send_frame(self, frame: bytes) -> None:
        """Send a frame of 16 or 72 bytes, and wait while a controller's queue is full."""
        while not self.try_frame(frame):
            time.sleep(0.001)

    def try_frame(self, frame: bytes) -> bool:
        """Send a frame; return False if no queue accepts it."""
        try:
            self._socket.send(frame)
        except OSError as error:
            if error.errno != errno.ENOBUFS:
                raise
            return False
        return True


def sample_frames(number: int, period_us: int) -> list[bytes]:
    """Return sample ``number`` of the unit of fixtures/config/imu.dbc, whose axes repeat the number."""
    low, high = number & 0x7FFF, number >> 15
    contents = [
        (257, struct.pack("<hhh", low, high, 1962)),
        (258, struct.pack("<hhh", high, low, -low)),
        (256, struct.pack("<IhBB", number * period_us & 0xFFFFFFFF, 3800, 0x5A, number & 0xFF)),
    ]
    return [FRAME.pack(identifier, len(data), data) for identifier, data in contents]


def send_samples(buses: list[Bus], rate_hz: int, count: int, first: int = 0, to: str = "") -> array[int]:
    """Send samples in real time; return times (CLOCK_MONOTONIC, ns) before and after each frame of the first bus.

    A controller at the other end (``to``) holds five frames, whose interrupts an emulated processor sometimes serves
    late, so the next sample waits until the controller has them all.
    """
    frames = [sample_frames(number, 1_000_000 // rate_hz) for number in range(first, first + count)]
    times = array("q")
    begin_ns = time.monotonic_ns()
    there = received(to) if to else 0
    for number, sample in enumerate(frames):
        due_ns = begin_ns + number * 1_000_000_000 // rate_hz
        left_ns = due_ns - time.monotonic_ns()
        if left_ns > 0:
            time.sleep(left_ns * 1e-9)
        while to and received(to) < there + len(sample) * number:
            time.sleep(0.001)
        for frame in sample:
            times.append(time.monotonic_ns())
            buses[0].send_frame(frame)
            times.append(time.monotonic_ns())
            for bus in buses[1:]:
                bus.send_frame(frame)
    return times


def received(channel: str) -> int:
    """Return the number of frames that an interface has received."""
    return int(Path(f"/sys/class/net/{channel}/statistics/rx_packets").read_text())


def listening(recorder: Recorder, times: int = 1) -> None:
    """Wait until the recorder has opened interfaces so many times."""
    recorder.wait_said("device_opened", times)


def make_vcan(mtu: int = 16) -> None:
    """Make vcan0 and set it up."""
    sh(f"modprobe -a vcan can_raw; ip link add vcan0 type vcan; ip link set vcan0 mtu {mtu} up")


def rate(seconds: str) -> None:
    """Record 1 kHz with three frames a sample, in real time."""
    make_vcan()
    with recording(session() + imu("main", "vcan0", 1000)) as recorder:
        listening(recorder)
        say("sending")
        times = send_samples([Bus("vcan0")], 1000, 1000 * int(seconds))
        say(f"sent in {(times[-1] - times[0]) * 1e-9:.2f} s")
    (SHARED / "sent").write_bytes(times.tobytes())


def listen(count: str) -> None:
    """Listen to the unit by `swath.aio` at 1 kHz, in records, and send to it."""
    import asyncio

    import numpy as np

    import swath.aio
    from swath.georef.records import ImuSamples

    make_vcan()
    samples, numbers, host_ns = int(count), [], []

    async def hear() -> swath.aio.Status:
        async with swath.aio.open("can:socketcan:vcan0", protocol="dbc", **OF_THE_UNIT) as unit:
            # the bus binds its thread to a processor
            sending = asyncio.create_task(asyncio.to_thread(lambda: send_samples([Bus("vcan0")], 1000, samples)))
            async for record in unit.records():
                if isinstance(record, ImuSamples):
                    axes = np.rint(record.rows["specific_force_b"][:, :2] / 0.005).astype(int)
                    numbers.extend((axes[:, 0] + axes[:, 1] * 32768).tolist())
                    host_ns.extend(record.rows["host_time_ns"].tolist())
                if len(numbers) == samples:
                    break
            times = await sending
            offset_ns = time.time_ns() - time.monotonic_ns()
            late_ns = np.array(host_ns) - offset_ns - np.array(times[4::6])  # of each sample's last frame
            keep("late", {"median_ns": int(np.median(late_ns)), "most_ns": int(late_ns.max())})
            await unit.send(FRAME.pack(0x7, 2, b"hi"))
            return unit.status

    status = asyncio.run(asyncio.wait_for(hear(), 100.0 + samples / 100.0))
    counts = {"units": status.units, "lost_kernel": status.lost_kernel, "dropped": status.dropped}
    keep("heard", {**counts, "damaged": status.damaged, "in_order": numbers == list(range(samples))})


def overrun(count: str) -> None:
    """Stop the recorder while more frames come than its buffer holds, then let it continue."""
    make_vcan()
    with recording(session() + imu("main", "vcan0", 1000, "?buffer_mb=1")) as recorder:
        listening(recorder)
        bus = Bus("vcan0")
        recorder.process.send_signal(signal.SIGSTOP)
        time.sleep(0.2)
        for number in range(int(count)):
            bus.send(0x700, struct.pack("<Q", number))
        recorder.process.send_signal(signal.SIGCONT)
        time.sleep(1.5)
        for number in range(100):
            bus.send(0x701, struct.pack("<Q", number))
        time.sleep(1.5)


def trouble() -> None:
    """Send FD frames, and error frames, bus-off and restart as a controller reports them.

    Then the interface goes down and comes up.
    """
    make_vcan(mtu=72)
    with recording(session() + imu("main", "vcan0", 1000)) as recorder:
        listening(recorder)
        bus = Bus("vcan0", fd=True)
        frames = [FD_FRAME.pack(0x123, length, 0x05, os.urandom(length)) for length in (1, 8, 12, 16, 32, 48, 64)]
        frames += [
            FRAME.pack(ERROR | CONTROLLER, 8, bytes([0, 0x10, 0, 0, 0, 0, 130, 0])),
            FRAME.pack(ERROR | BUS_OFF, 8, bytes(8)),
            FRAME.pack(ERROR | RESTARTED, 8, bytes(8)),
            FRAME.pack(0x8000_0000 | 0x1ABCDEF0, 8, b"extended"),
        ]
        for frame in frames:
            bus.send_frame(frame)
        time.sleep(1.5)
        sh("ip link set vcan0 down")
        recorder.wait_said("vcan0 is down")
        time.sleep(1.0)
        sh("ip link set vcan0 up")
        listening(recorder, 2)
        bus = Bus("vcan0")
        for number in range(100):
            frames.append(bus.send(0x300, struct.pack("<Q", number)))
        time.sleep(0.5)
        sh("ip link delete vcan0")
        recorder.wait_said("network interface vcan0 does not exist")
        make_vcan(mtu=72)
        listening(recorder, 3)
        bus = Bus("vcan0")
        for number in range(100):
            frames.append(bus.send(0x301, struct.pack("<Q", number)))
        time.sleep(1.5)
    keep("sent", {"frames": [frame.hex() for frame in frames]})


def set_state(state: str) -> None:
    """Set what the error counters of `guest/can_sim.c` mean from now on."""
    numbers = {"ERROR-ACTIVE": 0, "ERROR-WARNING": 1, "ERROR-PASSIVE": 2, "BUS-OFF": 3}
    Path("/sys/module/can_sim/parameters/state").write_text(str(numbers[state]))
    wait_state(state)


def wait_state(state: str) -> None:
    """Wait until the kernel reports this state of the controller."""
    wait_until(lambda: f" state {state} " in sh("ip -details link show can0"), state)


def send_numbers(bus: Bus, identifier: int) -> list[bytes]:
    """Send a hundred numbered frames."""
    return [bus.send(identifier, struct.pack("<Q", number)) for number in range(100)]


def bus_off(module: str) -> None:
    """Take a controller off the bus, so that it returns after its restart-ms; without one, after a command."""
    sh(f"modprobe -a can_dev can_raw; insmod {module}; ip link set can0 up type can bitrate 500000 restart-ms 2000")
    with recording(session() + imu("main", "can0", 1000, "?bitrate=500000")) as recorder:
        listening(recorder)
        bus = Bus("can0")
        frames = send_numbers(bus, 0x300)
        set_state("ERROR-PASSIVE")
        frames += send_numbers(bus, 0x301)
        set_state("BUS-OFF")
        bus.try_frame(FRAME.pack(0x7FF, 8, b"bus-off!"))
        recorder.wait_said("can_bus_off")
        wait_state("ERROR-ACTIVE")
        frames += send_numbers(bus, 0x302)
        time.sleep(0.5)
        sh("ip link set can0 down")
        recorder.wait_said("can0 is down")
        sh("ip link set can0 up type can restart-ms 0")
        listening(recorder, 2)
        bus = Bus("can0")
        frames += send_numbers(bus, 0x303)
        set_state("BUS-OFF")
        time.sleep(3.0)
        wait_state("BUS-OFF")
        sh("ip link set can0 type can restart")
        wait_state("ERROR-ACTIVE")
        frames += send_numbers(bus, 0x304)
        time.sleep(1.5)
    keep("sent", {"frames": [frame.hex() for frame in frames]})


def controllers(seconds: str) -> None:
    """Connect two emulated controllers at 200 Hz on one bus; each sends what the other receives."""
    sh("modprobe -a kvaser_pci can_raw")
    wait_until(lambda: "can1" in os.listdir("/sys/class/net"), "two controllers")
    for number in range(2):
        sh(f"ip link set can{number} up type can bitrate 1000000 restart-ms 100")
    config = imu("left", "can0", 200, "?bitrate=1000000") + imu("right", "can1", 200, "?bitrate=1000000")
    with recording(session() + config) as recorder:
        listening(recorder, 2)
        count = 200 * int(seconds)
        send_samples([Bus("can0")], 200, count, to="can1")
        send_samples([Bus("can1")], 200, count, first=count, to="can0")
        time.sleep(0.5)
        sh("ip link set can0 down")
        recorder.wait_said("can0 is down")
        sh("ip link set can0 up")
        listening(recorder, 3)
        send_samples([Bus("can1")], 200, 200, first=2 * count, to="can0")
        time.sleep(0.5)


if __name__ == "__main__":
    main(
        {
            "rate": rate,
            "listen": listen,
            "overrun": overrun,
            "trouble": trouble,
            "bus_off": bus_off,
            "controllers": controllers,
        }
    )
