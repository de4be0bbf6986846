"""Gives GPS times to an IMU's samples: from its own GPS time, its latch of the PPS, its counter, or their arrival."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from swath.georef.arrays import BoolArray, FloatArray, Int64Array, StructArray
from swath.georef.records import DEVICE_CLOCK_DTYPE
from swath.georef.stream.clocks import HostClocks, StreamClocks
from swath.georef.timescales import SECOND_NS, WEEK_NS, DeviceClock
from swath.georef.trajectory.trajectory import gps_span_text

GREATEST_SIGMA_NS = 1e9  # of a usable time: an offset of this size can still be found
PAUSE_S = 0.5  # of arrivals: after it a unit without a counter is assumed to have missed samples
LEAST_HOLE_S = 0.5  # longer stretches without samples are reported one by one; shorter ones are bridged and counted


@dataclass(frozen=True, slots=True)
class Stretch:
    """A stretch of time in which samples do not become a trajectory.

    Attributes:
        begin_ns, end_ns: GPS time; of samples without a time, estimated from their arrival beside others.
        why: the reason, which follows "from … to …, … s:".
    """

    begin_ns: int
    end_ns: int
    why: str

    @property
    def seconds(self) -> float:
        """Length in seconds."""
        return (self.end_ns - self.begin_ns) / SECOND_NS

    @property
    def text(self) -> str:
        """The stretch in words: begin, end, length and reason."""
        return f"{gps_span_text(self.begin_ns, self.end_ns)}, {self.seconds:.1f} s: {self.why}"


@dataclass(frozen=True, slots=True)
class ImuTimes:
    """The samples that have a time, with their times.

    Attributes:
        rows: `IMU_DTYPE` rows of these samples.
        gps_ns: (n,) GPS times of their stamps.
        sigma_ns: (n,) standard deviations of these times.
        placed: (m,) flags of these among all samples.
        by: source of the times: gps (the unit gives GPS time itself), latch (of the PPS), counter, arrival.
        refused: samples without a time, by reason.
        discarded: stretches of such samples that are longer than `LEAST_HOLE_S`.
    """

    rows: StructArray
    gps_ns: Int64Array
    sigma_ns: FloatArray
    placed: BoolArray
    by: str
    refused: Counter[str]
    discarded: tuple[Stretch, ...] = ()

    @property
    def sigma_s(self) -> float:
        """The usual standard deviation of a time (median)."""
        return float(np.median(self.sigma_ns)) / SECOND_NS if len(self.sigma_ns) else 0.0


def imu_times(rows: StructArray, host: HostClocks, clock: str | None, rate_hz: float) -> ImuTimes:
    """Return the samples of a session with GPS times.

    Args:
        rows: samples in order of arrival.
        host: the host's clocks, complete.
        clock: source of the host's time; None: there is none.
        rate_hz: nominal rate, for a unit without times of its own.
    """
    own = rows["gps_week"] >= 0
    if own.any():
        taken = rows[own]
        gps_ns = taken["gps_week"].astype(np.int64) * WEEK_NS + taken["device_time_ns"]
        untimed = stretches(rows["host_time_ns"], own, gps_ns, rate_hz, "samples without a GPS week")
        refused = _reasons(no_gps_week=int((~own).sum()))
        sigma_ns = taken["time_sigma_s"].astype(np.float64) * SECOND_NS
        return ImuTimes(taken, gps_ns, sigma_ns, own, "gps", refused, untimed)
    if clock is None or not len(rows):
        none = np.zeros(len(rows), np.bool_)
        return ImuTimes(rows[:0], np.empty(0, np.int64), np.empty(0), none, "arrival", _reasons(no_clock=len(rows)))
    counted = rows["device_time_ns"] >= 0
    if counted.any():
        taken, device_ns = rows[counted], rows["device_time_ns"][counted]
    else:
        taken, device_ns = rows, counted_arrivals(rows["host_time_ns"], rate_hz)
    gps_ns, sigma_ns, latched = _by_device(taken, device_ns, host, clock)
    good = sigma_ns <= GREATEST_SIGMA_NS
    by = "arrival" if not counted.any() else "latch" if latched else "counter"
    refused = _reasons(no_device_time=len(rows) - len(taken), no_clock=int((~good).sum()))
    placed = counted.copy() if counted.any() else np.ones(len(rows), np.bool_)
    placed[placed] = good
    why = f"the clock of {clock} cannot time these samples to {GREATEST_SIGMA_NS / 1e9:.0f} s"
    untimed = stretches(rows["host_time_ns"], placed, gps_ns[good], rate_hz, why)
    return ImuTimes(taken[good], gps_ns[good], sigma_ns[good], placed, by, refused, untimed)


def stretches(
    host_ns: Int64Array, placed: BoolArray, gps_ns: Int64Array, rate_hz: float, why: str
) -> tuple[Stretch, ...]:
    """Return the stretches of unused samples that are longer than `LEAST_HOLE_S`.

    Args:
        host_ns: (n,) host times of arrival.
        placed: (n,) flags of samples that are used.
        gps_ns: (m,) times of the m samples used.
        rate_hz: nominal rate, from which a stretch's least length follows.
        why: reason given for the stretches.
    """
    if not len(gps_ns):
        return ()
    number = np.cumsum(placed) - 1  # index of the latest sample used
    edges = np.flatnonzero(np.diff(np.concatenate([[True], placed, [True]]).astype(np.int8)))
    used = np.flatnonzero(placed)
    found = []
    for first, after in pairwise(edges.tolist()):
        if placed[first]:
            continue
        before, beyond = int(number[first]), int(number[first]) + 1
        near = used[max(before, 0)] if before >= 0 else used[0]
        shift_ns = int(gps_ns[max(before, 0)]) - int(host_ns[near])
        begin_ns = int(gps_ns[before]) if before >= 0 else int(host_ns[first]) + shift_ns
        end_ns = int(gps_ns[beyond]) if beyond < len(gps_ns) else int(host_ns[after - 1]) + shift_ns
        end_ns = max(end_ns, begin_ns + round((after - first) / rate_hz * SECOND_NS))
        if end_ns - begin_ns > LEAST_HOLE_S * SECOND_NS:
            found.append(Stretch(begin_ns, end_ns, why))
    return tuple(found)


def _by_device(
    rows: StructArray, device_ns: Int64Array, host: HostClocks, clock: str
) -> tuple[Int64Array, FloatArray, bool]:
    """Return GPS ns and sigma ns (n,) by a device's clock, and whether it latches the PPS."""
    said = np.zeros(len(rows), DEVICE_CLOCK_DTYPE)
    said["host_time_ns"], said["device_time_ns"], said["pps_time_ns"] = (
        rows["host_time_ns"],
        device_ns,
        rows["pps_time_ns"],
    )
    said["pps_count"] = said["locked"] = -1
    device = DeviceClock(host.by_source[clock], keep_history=True)
    raw_ns = host.timeline.raw_from_host(rows["host_time_ns"])
    device.add(said, raw_ns)
    gps_ns, sigma_ns = device.gps_from_device(device_ns, raw_ns)
    return gps_ns, sigma_ns, device.status().latched


def counted_arrivals(host_ns: Int64Array, rate_hz: float) -> Int64Array:
    """Return a counter (n,), ns, for samples without one: one interval each, and the host's time over pauses.

    Units arrive late and in bunches; the samples themselves are evenly spaced. The interval is the mean of those
    between the pauses, so that crystal and nominal rate may differ.
    """
    steps = np.diff(host_ns)
    paused = steps > PAUSE_S * SECOND_NS
    flowing_ns, flowing = int(steps[~paused].sum()), int((~paused).sum())
    interval_ns = flowing_ns / flowing if flowing > rate_hz else SECOND_NS / rate_hz
    counter = np.concatenate([[0.0], np.cumsum(np.where(paused, steps, interval_ns))])
    device_ns: Int64Array = np.rint(counter).astype(np.int64)
    return device_ns


class GrowingCounter:
    """Passes the samples' counters with the host's time to the clock.

    Samples without a counter get one: one nominal interval each, and the host's time over pauses.
    """

    def __init__(self, rate_hz: float) -> None:
        self._interval_ns = SECOND_NS / rate_hz
        self._count_ns = 0.0
        self._host_ns: int | None = None

    def told(self, rows: StructArray, clocks: StreamClocks, source: str) -> StructArray:
        """Return rows with a device time; rows that have GPS time themselves need no clock."""
        if (rows["gps_week"] >= 0).any() or source not in clocks.host.plan.devices:
            return rows
        bare = np.flatnonzero(rows["device_time_ns"] < 0).tolist()
        if bare:
            rows = rows.copy()
        for place in bare:
            host_ns = int(rows["host_time_ns"][place])
            step = 0 if self._host_ns is None else host_ns - self._host_ns
            self._count_ns += step if step > PAUSE_S * SECOND_NS else self._interval_ns
            self._host_ns = host_ns
            rows["device_time_ns"][place] = round(self._count_ns)
        said = np.zeros(len(rows), DEVICE_CLOCK_DTYPE)
        for name in ("host_time_ns", "device_time_ns", "pps_time_ns"):
            said[name] = rows[name]
        said["pps_count"] = said["locked"] = -1
        clocks.add_samples(source, said)
        return rows


def _reasons(**counts: int) -> Counter[str]:
    return +Counter(counts)
