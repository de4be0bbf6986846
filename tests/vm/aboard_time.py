"""Runs in the machine: a GNSS receiver that names the seconds of a PPS, and faults of edges and wall clock."""

from __future__ import annotations

import ctypes
import os
import subprocess
import threading
import time
import tty
from collections.abc import Callable
from pathlib import Path

from tests.vm.aboard import SHARED, keep, lend, main, recording, say, session, sh, wait_until

PARAMETERS = Path("/sys/module/pps_sim/parameters")
DELAY_S = 0.15  # of a message after its edge
NANO = 1_000_000_000
DEVICES = """
[pps.main]
source = "{pps}"

[gnss.rover]
transport = "serial:{port}?baud=115200"
protocol = "nmea"
pps = "main"
leap_seconds = 18
"""
STA_PLL, STA_INS = 0x0001, 0x0010
ADJ_STATUS, ADJ_FREQUENCY, ADJ_TICK = 0x0010, 0x0002, 0x4000


def sentence(body: str) -> bytes:
    """Return an NMEA 0183 sentence with its checksum."""
    check = 0
    for character in body.encode():
        check ^= character
    return f"${body}*{check:02X}\r\n".encode()


def second_told(utc_s: int) -> bytes:
    """Return RMC and ZDA of a second of UTC, seconds since 1970."""
    at = time.gmtime(utc_s)
    clock, date = time.strftime("%H%M%S.00", at), time.strftime("%d%m%y", at)
    rmc = f"GPRMC,{clock},A,4728.9200,N,00854.3000,E,0.0,0.0,{date},,,A"
    return sentence(rmc) + sentence(time.strftime("GPZDA,%H%M%S.00,%d,%m,%Y,00,00", at))


class Receiver:
    """A serial port that reports each second shortly after it has begun.

    Args:
        clock_ns: the receiver's own time, UTC.
    """

    def __init__(self, clock_ns: Callable[[], int]) -> None:
        self._main, secondary = os.openpty()
        tty.setraw(secondary)
        os.set_blocking(self._main, False)
        self.port = os.ttyname(secondary)
        lend(self.port)
        self._clock_ns = clock_ns
        self._last_s = clock_ns() // NANO
        threading.Thread(target=self._run, daemon=True).start()

    def _run(self) -> None:
        while True:
            now_ns = self._clock_ns() - round(DELAY_S * NANO)
            if now_ns // NANO > self._last_s:
                self._last_s = now_ns // NANO
                try:
                    os.write(self._main, second_told(self._last_s))
                except BlockingIOError:
                    pass
            time.sleep(0.01)


class _Timex(ctypes.Structure):
    """The struct timex of <linux/timex.h>."""

    _fields_ = [
        ("modes", ctypes.c_uint),
        *[(name, ctypes.c_long) for name in ("offset", "freq", "maxerror", "esterror")],
        ("status", ctypes.c_int),
        *[(name, ctypes.c_long) for name in ("constant", "precision", "tolerance", "sec", "usec", "tick")],
        ("rest", ctypes.c_long * 24),
    ]


def raw_ns() -> int:
    """Return CLOCK_MONOTONIC_RAW, ns."""
    return time.clock_gettime_ns(time.CLOCK_MONOTONIC_RAW)


def adjtimex(modes: int, **fields: int) -> None:
    """Call adjtimex(2), and fail if it fails."""
    timex = _Timex(modes=modes, **fields)
    found = ctypes.CDLL(None, use_errno=True).adjtimex(ctypes.byref(timex))
    assert found >= 0, os.strerror(ctypes.get_errno())


def set_pps(**parameters: int) -> None:
    """Steer the simulated edges."""
    for name, value in parameters.items():
        (PARAMETERS / name).write_text(str(value))


def edges(module: str) -> None:
    """Make edges that are missing, stray, late, uneven, wrong for long, or gone; the device vanishes and returns."""
    sh(f"insmod {module}")
    lend("/dev/pps0")
    receiver = Receiver(time.time_ns)
    with recording(session() + DEVICES.format(pps="/dev/pps0", port=receiver.port)) as recorder:
        recorder.wait_said("second_known")
        time.sleep(3.0)
        set_pps(drop=2)
        time.sleep(4.0)
        for _ in range(3):
            time.sleep(1.3)
            set_pps(extra=1)
        set_pps(jitter_ns=20_000)
        time.sleep(3.0)
        set_pps(jitter_ns=0, offset_ns=100_000_000)
        time.sleep(3.0)
        set_pps(offset_ns=0)
        time.sleep(3.0)
        lost = time.monotonic_ns()
        set_pps(on=0)
        time.sleep(9.0)
        set_pps(on=1)
        back = time.monotonic_ns()
        time.sleep(6.0)
        gone = time.monotonic_ns()
        sh("rmmod pps_sim")
        recorder.wait_said("/dev/pps0: ")
        time.sleep(9.0)
        sh(f"insmod {module}")
        lend("/dev/pps0")
        returned = time.monotonic_ns()
        time.sleep(14.0)  # the recorder looks for it every 5 s at most
        end = time.monotonic_ns()
    offset_ns = time.time_ns() - time.monotonic_ns()  # this clock is never stepped, and pulses are on its whole seconds
    times = {"lost": lost, "back": back, "gone": gone, "returned": returned, "end": end}
    keep("told", {"utc_minus_monotonic_ns": offset_ns, **times})


def ahead_of_outside_ns() -> int:
    """Return this machine's wall clock minus that of the computer outside, ns.

    The computer outside stamps the files of its file system that the machine writes.
    """
    place, found = SHARED / "stamped", []
    for number in range(50):
        before_ns = time.time_ns()
        place.write_text(str(number))
        stamp_ns = place.stat().st_mtime_ns
        after_ns = time.time_ns()
        found.append((after_ns - before_ns, (before_ns + after_ns) // 2 - stamp_ns))
    return min(found)[1]


def serial(kind: str, seconds: str) -> None:
    """Record from a receiver outside the machine, at /dev/ttyS1: NMEA, and its pulse on DCD."""
    line = None
    if kind == "ldisc":
        sh("modprobe pps_ldisc")
        line = subprocess.Popen(["ldattach", "-d", "PPS", "/dev/ttyS1"])
        wait_until(lambda: os.path.exists("/dev/pps0"), "/dev/pps0")
        lend("/dev/pps0")
    lend("/dev/ttyS1")
    pps = "/dev/pps0" if kind == "ldisc" else "serial-dcd:/dev/ttyS1"
    try:
        with recording(session() + DEVICES.format(pps=pps, port="/dev/ttyS1")):
            say("recording")
            time.sleep(float(seconds))
            keep("told", {"ahead_ns": ahead_of_outside_ns()})
    finally:
        if line is not None:
            line.terminate()


def wall_clock(module: str) -> None:
    """Step the wall clock by an hour and back, slew it, and let the kernel insert a leap second."""
    sh(f"insmod {module} raw=1")
    lend("/dev/pps0")
    # the receiver's UTC follows a clock that is never stepped or slewed, and so do its pulses
    base_ns = round((time.time_ns() - raw_ns()) / NANO) * NANO
    steps = []

    def step(by_s: int) -> None:
        before = time.monotonic_ns()
        time.clock_settime_ns(time.CLOCK_REALTIME, time.clock_gettime_ns(time.CLOCK_REALTIME) + by_s * NANO)
        steps.append([by_s, before, time.monotonic_ns()])

    receiver = Receiver(lambda: base_ns + raw_ns())
    with recording(session() + DEVICES.format(pps="/dev/pps0", port=receiver.port)) as recorder:
        recorder.wait_said("second_known")
        time.sleep(5.0)
        for by_s in (3600, -3600, -3600, 3600):
            step(by_s)
            time.sleep(3.0)
        adjtimex(ADJ_STATUS | ADJ_FREQUENCY, status=STA_PLL, freq=400 << 16)
        time.sleep(5.0)
        adjtimex(ADJ_FREQUENCY, freq=-400 << 16)
        time.sleep(5.0)
        adjtimex(ADJ_FREQUENCY, freq=0)
        midnight_s = (time.time_ns() // NANO // 86400 + 1) * 86400
        step(midnight_s - 5 - time.time_ns() // NANO)  # the kernel's leap second comes before UTC's midnight
        adjtimex(ADJ_STATUS, status=STA_PLL | STA_INS)
        time.sleep(12.0)
    inserted = "inserting leap second" in sh("dmesg")
    keep("told", {"base_ns": base_ns, "steps": steps, "inserted": inserted})


if __name__ == "__main__":
    main({"edges": edges, "serial": serial, "wall_clock": wall_clock})
