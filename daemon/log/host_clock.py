"""Computes the host time of a session, CLOCK_MONOTONIC plus a constant, and converts kernel stamps to it.

The rules are those of docs/log-format.md, "Time stamps": a step of the wall clock never moves a log_time.
"""

from __future__ import annotations

import ctypes
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from swath.drivers.transports.base import UnitBlock
from swath.georef.arrays import Int64Array

STEP_NOTICED_NS = 50_000  # a change of REALTIME − MONOTONIC beyond this is a step of the wall clock
LATER_NS = 1_000_000_000  # a stamp later by more comes from a clock that was stepped forward and back meanwhile
NEARER = 10  # a step whose misfit is below a tenth of the other's is the right one
_BRACKET_NS = 20_000  # two MONOTONIC reads this close around one of REALTIME bound its error to half of this
_BRACKET_TRIES = 8


@dataclass(frozen=True, slots=True)
class ClockPair:
    """REALTIME and MONOTONIC at one instant, accurate to half of ``width_ns``."""

    realtime_ns: int
    monotonic_ns: int
    width_ns: int

    @property
    def offset_ns(self) -> int:
        """Difference REALTIME − MONOTONIC in nanoseconds."""
        return self.realtime_ns - self.monotonic_ns


def _bracketed(read: Callable[[], int]) -> tuple[int, int, int]:
    """Return another clock's time, MONOTONIC at that instant, and the distance of the MONOTONIC reads around it, in
    nanoseconds.

    The closest of a few readings is used, so that a preempted reading does not look like a clock step.
    """
    best: tuple[int, int, int] | None = None
    for _ in range(_BRACKET_TRIES):
        before = time.monotonic_ns()
        value = read()
        after = time.monotonic_ns()
        if best is None or after - before < best[2]:
            best = value, (before + after) // 2, after - before
        if best[2] <= _BRACKET_NS:
            break
    assert best is not None
    return best


def read_clock_pair() -> ClockPair:
    """Return REALTIME beside MONOTONIC, from the closest of a few readings."""
    return ClockPair(*_bracketed(time.time_ns))


class HostClock:
    """Host time of one session, fixed when the object is made."""

    def __init__(self, start: ClockPair | None = None) -> None:
        pair = start if start is not None else read_clock_pair()
        self.realtime_ns = pair.realtime_ns
        self.monotonic_ns = pair.monotonic_ns
        self.offset_ns = pair.offset_ns

    def now_ns(self) -> int:
        """Return the host time now."""
        return time.monotonic_ns() + self.offset_ns

    def step_ns(self, pair: ClockPair) -> int:
        """Return by how much the wall clock has been stepped since the session's start."""
        return pair.offset_ns - self.offset_ns


class StampConverter:
    """Converts one channel's kernel stamps (CLOCK_REALTIME) to host time, across steps of the wall clock.

    Attributes:
        ambiguous: number of stamps that neither the old nor the new step could place; their read time was used.
    """

    def __init__(self, clock: HostClock) -> None:
        self._clock = clock
        self._step_ns = 0
        self._previous_read_ns = clock.now_ns()
        self.ambiguous = 0

    def stamp(self, blocks: Sequence[UnitBlock]) -> list[Int64Array]:
        """Return the host times of the units of each block of one reading: the kernel's, or that of the reading."""
        counts = [len(block.units) for block in blocks]
        if all(block.kernel_realtime_ns is None for block in blocks):  # serial ports have no kernel stamps
            read_ns = self._clock.now_ns()
            return [np.array([read_ns] * count, dtype=np.int64) for count in counts]
        pair = read_clock_pair()
        if len(blocks) == 1:
            return [self.convert_at(blocks[0].kernel_realtime_ns, counts[0], pair)]
        joined = np.concatenate(
            [
                np.zeros(count, np.int64) if block.kernel_realtime_ns is None else block.kernel_realtime_ns
                for block, count in zip(blocks, counts, strict=True)
            ]
        )
        return np.split(self.convert_at(joined, sum(counts), pair), np.cumsum(counts)[:-1])

    def convert_at(self, stamps_ns: Int64Array | None, count: int, pair: ClockPair) -> Int64Array:
        """Return the host times of the units of a batch.

        Args:
            stamps_ns: (n,) CLOCK_REALTIME stamps, 0 for a unit without a stamp; None if the transport has no stamps.
            count: n.
            pair: the clocks as they were read after the batch.
        """
        read_ns = pair.monotonic_ns + self._clock.offset_ns
        old_step = self._step_ns
        new_step = self._clock.step_ns(pair)
        if abs(new_step - old_step) <= max(STEP_NOTICED_NS, pair.width_ns):
            new_step = old_step
        previous_read_ns, self._previous_read_ns, self._step_ns = self._previous_read_ns, read_ns, new_step
        if stamps_ns is None:
            return np.array([read_ns] * count, dtype=np.int64)
        host = stamps_ns - new_step
        if new_step != old_step:
            host = self._place(stamps_ns, old_step, new_step, previous_read_ns, read_ns)
        later = (stamps_ns != 0) & (host > read_ns + LATER_NS)
        self.ambiguous += int(later.sum())
        return np.where((stamps_ns == 0) | later, read_ns, host)

    def _place(
        self, stamps_ns: Int64Array, old_step: int, new_step: int, previous_read_ns: int, read_ns: int
    ) -> Int64Array:
        by_old, by_new = stamps_ns - old_step, stamps_ns - new_step
        # The clock reading after the batch and the stamps come from different reads: allow half a noticed step.
        earliest, latest = previous_read_ns - STEP_NOTICED_NS // 2, read_ns + STEP_NOTICED_NS // 2
        old_misses = np.maximum(0, np.maximum(earliest - by_old, by_old - latest))
        new_misses = np.maximum(0, np.maximum(earliest - by_new, by_new - latest))
        # A unit that arrived between the previous batch and the clock reading after it lies before that reading, on a
        # busy machine by milliseconds; the wrong step misses by nearly the whole step.
        decided = (old_misses == 0) != (new_misses == 0)
        decided |= np.minimum(old_misses, new_misses) * NEARER < np.maximum(old_misses, new_misses)
        undecided = ~decided & (stamps_ns != 0)
        self.ambiguous += int(undecided.sum())
        return np.where(undecided, read_ns, np.where(old_misses < new_misses, by_old, by_new))


class _Timex(ctypes.Structure):
    """``struct timex`` of adjtimex(2), 64-bit Linux."""

    _fields_ = (
        ("modes", ctypes.c_uint),
        ("offset", ctypes.c_long),
        ("freq", ctypes.c_long),
        ("maxerror", ctypes.c_long),
        ("esterror", ctypes.c_long),
        ("status", ctypes.c_int),
        ("constant", ctypes.c_long),
        ("precision", ctypes.c_long),
        ("tolerance", ctypes.c_long),
        ("time_sec", ctypes.c_long),
        ("time_usec", ctypes.c_long),
        ("tick", ctypes.c_long),
        ("ppsfreq", ctypes.c_long),
        ("jitter", ctypes.c_long),
        ("shift", ctypes.c_int),
        ("stabil", ctypes.c_long),
        ("jitcnt", ctypes.c_long),
        ("calcnt", ctypes.c_long),
        ("errcnt", ctypes.c_long),
        ("stbcnt", ctypes.c_long),
        ("tai", ctypes.c_int),
        ("reserved", ctypes.c_int * 11),
    )


STA_UNSYNC = 0x0040
_FREQ_PPM_SCALE = 65536.0  # adjtimex(2): freq is ppm with a 16-bit fraction
_libc = ctypes.CDLL(None, use_errno=True)


@dataclass(frozen=True, slots=True)
class ClockDiscipline:
    """The state of the wall clock according to adjtimex(2)."""

    frequency_ppm: float
    status: int
    max_error_s: float

    @property
    def disciplined(self) -> bool:
        """True if the kernel reports that a service keeps this clock right to within half a second."""
        return not self.status & STA_UNSYNC and self.max_error_s < 0.5


def read_clock_discipline() -> ClockDiscipline:
    """Return the kernel's own account of how its wall clock is kept."""
    timex = _Timex()
    if _libc.adjtimex(ctypes.byref(timex)) < 0:
        return ClockDiscipline(0.0, STA_UNSYNC, float("inf"))
    return ClockDiscipline(timex.freq / _FREQ_PPM_SCALE, int(timex.status), timex.maxerror * 1e-6)


def _read_raw_ns() -> int:
    return time.clock_gettime_ns(time.CLOCK_MONOTONIC_RAW)


def read_clock_sample(discipline: ClockDiscipline) -> dict[str, int | float]:
    """Return one message of ``/clock``: the three clocks side by side and adjtimex's frequency and status.

    If the wall clock is disciplined, the message also has its maximum error; the clock may then determine which second
    it is, both now and when the log is read.
    """
    pair = read_clock_pair()
    raw, at_ns, _ = _bracketed(_read_raw_ns)
    shift = at_ns - pair.monotonic_ns  # raw was read a little later: move it to the instant of the pair
    sample: dict[str, int | float] = {
        "realtime_ns": pair.realtime_ns,
        "monotonic_ns": pair.monotonic_ns,
        "monotonic_raw_ns": raw - shift,
        "frequency_ppm": discipline.frequency_ppm,
        "status": discipline.status,
    }
    return sample | ({"max_error_s": discipline.max_error_s} if discipline.disciplined else {})
