"""Clocks of the virtual aircraft: device oscillators, the pulse per second, and named random generators.

Time in `sim` is ``time_s``: seconds since the plan's start, true GPS time, float64 (1e-13 s at 1000 s). The plan starts
on a whole second, so true edges stand at whole ``time_s``.
"""

from __future__ import annotations

import zlib

import numpy as np

from swath.georef.arrays import FloatArray, Int64Array
from swath.georef.timescales import unix_ns_from_gps
from swath.georef.timescales.gps_time import SECOND_NS
from swath.sim.plan.plan import Plan
from swath.sim.plan.tables import OscillatorTable, PpsTable

UPTIME_AT_START_NS = 600 * 1_000_000_000  # reading of CLOCK_MONOTONIC at the plan's start


WANDER_PERIOD_S = 600.0


def generator(seed: int, *names: str | int) -> np.random.Generator:
    """Return the random generator of one purpose; draws for other purposes do not change it."""
    return np.random.default_rng([seed, zlib.crc32("/".join(map(str, names)).encode())])


class Oscillator:
    """A counter driven by its own oscillator, which has an offset, a drift and a slow wave of frequency."""

    def __init__(self, tick_hz: int, table: OscillatorTable) -> None:
        self.tick_hz = tick_hz
        self._table = table

    def phase(self, time_s: FloatArray) -> FloatArray:
        """Return (n,) the counter as a real number, at true times (n,)."""
        table = self._table
        gained = table.offset_ppm * time_s + table.drift_ppm_per_h * time_s**2 / 7200.0
        turn = 2 * np.pi / WANDER_PERIOD_S
        gained += table.wander_ppm * (1.0 - np.cos(turn * time_s)) / turn
        phase: FloatArray = self.tick_hz * (time_s + 1e-6 * gained)
        return phase

    def ticks(self, time_s: FloatArray) -> Int64Array:
        """Return (n,) the counter's reading in whole ticks, `OscillatorTable.ticks_at_start` at the plan's start."""
        return np.floor(self.phase(time_s)).astype(np.int64) + self._table.ticks_at_start

    def time_of(self, ticks: FloatArray) -> FloatArray:
        """Return (n,) true times at which the counter reaches ``ticks`` counted from the plan's start."""
        time_s = np.asarray(ticks, np.float64) / self.tick_hz
        for _ in range(4):  # the map differs from the identity by parts per million: each step gains five digits
            time_s = time_s + (ticks - self.phase(time_s)) / self.tick_hz
        return time_s


class PulsePerSecond:
    """The pulse of a receiver: edges at whole seconds, each with its own jitter.

    All devices wired to it see the same edges.

    Args:
        table: of the plan.
        seed, name: names that the jitter's random numbers depend on.
        noise: False leaves the jitter out.
    """

    def __init__(self, table: PpsTable, seed: int, name: str, *, noise: bool) -> None:
        self._sigma_s = 1e-9 * table.jitter_ns if noise else 0.0
        self._seed, self._name = seed, name
        self._jitter_s: FloatArray = np.zeros(0)

    def edges(self, seconds: Int64Array) -> FloatArray:
        """Return (n,) true times of the edges of these seconds; second 0 is the plan's start."""
        seconds = np.asarray(seconds, np.int64)
        if len(seconds) and seconds.max() >= len(self._jitter_s):
            draws = generator(self._seed, "pps", self._name).standard_normal(2 * int(seconds.max()) + 64)
            self._jitter_s = self._sigma_s * draws
        return seconds + self._jitter_s[seconds]

    def latest(self, time_s: FloatArray) -> Int64Array:
        """Return (n,) the second of the newest edge at or before each time; −1 before the first."""
        nearest = np.maximum(np.rint(time_s).astype(np.int64), 0)
        return np.where(self.edges(nearest) <= time_s, nearest, nearest - 1)


class HostClock:
    """Host time as LOG_FORMAT defines it: it reads as UTC at the session's start and is never stepped afterwards.

    Attributes:
        wall_steps: (time_s, step_s) of the wall clock, in order of time.
    """

    def __init__(self, plan: Plan) -> None:
        self._rate = 1.0 + 1e-6 * plan.tables.host.clock_ppm
        utc_ns = unix_ns_from_gps(plan.start_gps_ns, plan.leap_seconds)
        self.start_ns = utc_ns + round(plan.tables.host.utc_offset_s * SECOND_NS)
        faults = [fault for fault in plan.tables.fault if fault.kind == "clock_step"]
        self.wall_steps = sorted((fault.at_s, fault.step_s) for fault in faults)

    def host_ns(self, time_s: float) -> int:
        """Return the host time (log_time) at a true time."""
        return self.start_ns + round(time_s * self._rate * SECOND_NS)

    def monotonic_ns(self, time_s: float) -> int:
        """Return the reading of CLOCK_MONOTONIC at a true time."""
        return self.host_ns(time_s) - self.start_ns + UPTIME_AT_START_NS

    def realtime_ns(self, time_s: float) -> int:
        """Return the reading of CLOCK_REALTIME at a true time, including the steps so far."""
        return self.host_ns(time_s) + sum(
            round(step_s * SECOND_NS) for at_s, step_s in self.wall_steps if at_s <= time_s
        )
