"""A device's own clock in GPS time: by the PPS edges it latches, by its UTC-hour stamps, or by arrival times alone.

A device that latches the edge in its own counter gives the best time; the host only names the second of the edge. The
label of latched edges is determined at each request, from the host's clock as it then is, so that a late or corrected
label reaches them.
"""

from __future__ import annotations

import math
from array import array
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from swath.georef.arrays import BoolArray, FloatArray, Int64Array, StructArray
from swath.georef.timescales.gps_time import HOUR_NS, SECOND_NS, gps_ns_past_hour
from swath.georef.timescales.pps_clock import PpsClock
from swath.georef.timescales.stamp_scale import Stamps, StampScale, judge

MAX_PAIRING_S = 0.3  # PROTOCOLS, SREP: an edge further from the second than this is refused
MAX_DRIFT = 200e-6
HELD_DRIFT = MAX_DRIFT / 2  # of a clock that the pulse set: its free-running rate is not yet known
SPACING_FLOOR_NS = 2_000.0
MAX_BRIDGED_S = 1_000  # limit of the time without a latched edge over which seconds can be counted by ticks
REFUSED_IN_A_ROW = 4  # spacings refused in a row after which the first edge was the wrong one
STEP_BACK_NS = 50_000_000  # a greater step back of device time is a restart
# a greater jump against the host's time, which no stall of datagrams explains, is a restart or a setting
JUMP_NS = 5 * SECOND_NS
LABEL_KNOTS = 31  # number of latched edges around the requested time whose labels are compared
LABEL_MAJORITY = 0.8
LABEL_MAX_SIGMA_NS = 1e8  # greatest sigma of the host's clock that suffices to name a second
SLOPE_KNOTS = 16
LATCH_NOISE_NS = 100.0  # prior: one tick at 10 MHz
WANDER_NS = 30.0  # prior of a device crystal in flight, ns/s per √s
BIN_NS = 10 * SECOND_NS
ARRIVAL_LATENCY_NS = 2_000_000.0  # prior of the least latency of an uncalibrated datagram or frame
HOUR_STAMP_SIGMA_NS = 20_000.0  # makers state 10 µs to 50 µs for a head locked to PPS
LIVE_KNOTS = 1800
# greatest sigma of a host's clock that gives the hour, and the second if the head vouches for it
COARSE_MAX_SIGMA_NS = 4e8
JUDGED_AFTER_S = 10  # seconds of stamps before their origin is judged; judged again after as many
JUDGED_SECONDS = 120  # greatest number of seconds used for that


@dataclass(frozen=True, slots=True)
class DeviceClockStatus:
    """Status of a device's clock; latched: by its own latch.

    drift_ppm: of the device, positive: fast; None: unknown. segments: restarts + 1.
    """

    latched: bool
    drift_ppm: float | None
    segments: int
    edges_used: int
    refused: dict[str, int]


class _Latch:
    """Latched edges of one segment: device time, the host's time of them, and seconds counted since the first."""

    def __init__(self) -> None:
        self.device = array("q")
        self.host = array("q")
        self.seconds = array("q")
        self.refused_in_a_row = 0

    def add(self, device_ns: int, host_ns: int) -> str | None:
        """Take an edge, or return the reason for refusing it."""
        if self.device:
            spacing = device_ns - self.device[-1]
            seconds = round(spacing / SECOND_NS)
            off = abs(spacing - seconds * SECOND_NS)
            if seconds < 1 or off > max(SPACING_FLOOR_NS, MAX_DRIFT * seconds * SECOND_NS):
                self.refused_in_a_row += 1
                return "spacing"
            self.seconds.append(self.seconds[-1] + seconds)
        else:
            self.seconds.append(0)
        self.refused_in_a_row = 0
        self.device.append(device_ns)
        self.host.append(host_ns)
        return None

    def trim(self) -> None:
        """Forget all but the last LIVE_KNOTS (called when there are twice as many)."""
        for column in (self.device, self.host, self.seconds):
            del column[:-LIVE_KNOTS]

    def slope(self, at: int) -> float:
        """Return GPS ns per device ns from the knots that end at knot `at`, or begin there for 0."""
        low, high = (max(0, at - SLOPE_KNOTS), at) if at else (0, min(SLOPE_KNOTS, len(self.device) - 1))
        ticks = self.device[high] - self.device[low]
        return (self.seconds[high] - self.seconds[low]) * SECOND_NS / ticks if ticks else 1.0

    def noise_ns(self) -> float:
        """Return the latch's sigma from second differences of the last edges (1.48 MAD), at least that of the prior."""
        device = np.array(self.device[-256:], dtype=np.int64)
        seconds = np.array(self.seconds[-256:], dtype=np.int64)
        even = (np.diff(seconds)[:-1] == 1) & (np.diff(seconds)[1:] == 1)
        second = np.diff(device, n=2)[even]
        if second.size < 8:
            return LATCH_NOISE_NS
        return max(1.4826 * float(np.median(np.abs(second))) / math.sqrt(6.0), LATCH_NOISE_NS / math.sqrt(12.0))


class _Arrivals:
    """The least delayed arrivals, one per bin, for a device without a latch."""

    def __init__(self) -> None:
        self.bins: dict[int, tuple[int, int]] = {}  # bin: (host − device, device ns)

    def add(self, device: Int64Array, host: Int64Array) -> None:
        """Take arrivals: device times and host stamps (n,)."""
        late = host - device
        which = device // BIN_NS
        starts = np.flatnonzero(np.concatenate(([True], np.diff(which) != 0)))
        for start, stop in zip(starts, np.append(starts[1:], len(which)), strict=True):
            best = int(start) + int(np.argmin(late[start:stop]))
            key, found = int(which[start]), (int(late[best]), int(device[best]))
            self.bins[key] = min(self.bins.get(key, found), found)

    def trim(self) -> None:
        """Forget all but the last LIVE_KNOTS bins."""
        for key in list(self.bins)[:-LIVE_KNOTS]:
            del self.bins[key]

    def host_at(self, device_ns: Int64Array) -> tuple[Int64Array, float]:
        """Return host times (n,) of device times, and their sigma in ns."""
        rows = sorted(self.bins.values(), key=lambda row: row[1])
        late = np.array([row[0] for row in rows], dtype=np.int64)
        at = np.array([row[1] for row in rows], dtype=np.int64)
        base, relative = int(late[0]), (late - late[0]).astype(np.float64)
        x, knots = (device_ns - at[0]).astype(np.float64), (at - at[0]).astype(np.float64)
        offsets = np.interp(x, knots, relative)
        if len(rows) > 2:
            recent = slice(-30, None)
            slope = float(np.polyfit(knots[recent] - knots[-1], relative[recent], 1)[0])
            offsets += slope * (np.maximum(x - knots[-1], 0.0) + np.minimum(x, 0.0))
        bends = np.diff(relative, n=2)
        scatter = 1.4826 * float(np.median(np.abs(bends))) / math.sqrt(6.0) if bends.size else 0.0
        return device_ns + base + np.rint(offsets).astype(np.int64), math.hypot(ARRIVAL_LATENCY_NS, scatter)


class _Segment:
    """The device's clock from one power-on, or one change between kept and free, to the next."""

    def __init__(self, first_host_ns: int, *, free: bool, held: _Latch | None = None) -> None:
        """Begin a segment; held: the latch of the one before, whose time goes on if a head has just lost its pulse."""
        self.first_host_ns = first_host_ns
        self.free = free
        self.held = held
        self.latch = _Latch()
        self.arrivals = _Arrivals()
        self.last_device_ns: int | None = None
        self.last_host_ns = first_host_ns
        self.last_count = -1
        self.last_pps_ns = -1


def _runs_free(rows: StructArray) -> BoolArray:
    """Return (n,) whether a head whose clock the PPS sets, and which counts no edges, runs without it.

    Such a head drifts, and is set again; its seconds before and after do not belong to one clock, as a counter's
    latches do.
    """
    free: BoolArray = (rows["locked"] == 0) & (rows["pps_time_ns"] < 0) & (rows["pps_count"] < 0)
    return free


class DeviceClock:
    """Maps a device's time to GPS time; fed by `DEVICE_CLOCK_DTYPE` rows beside the host's `PpsClock`."""

    def __init__(
        self,
        clock: PpsClock,
        *,
        past_utc_hour: bool = False,
        keep_history: bool = False,
        wanted: StampScale | None = None,
        stamps: Stamps | None = None,
    ) -> None:
        """Prepare a clock of a device beside the host's.

        past_utc_hour: device time counts from the UTC hour while `locked` is 1 (Velodyne), else from power-on. wanted:
        the configured origin of its stamps; AUTO: found while they come, if the device reports no lock; None: as the
        device itself reports. stamps: their origin, if it is known beforehand.
        """
        self._clock = clock
        self._past_utc_hour = past_utc_hour
        self._wanted = wanted
        self.stamps = stamps
        self._judges = stamps is None and wanted not in (None, StampScale.FREE)
        self._quickest: dict[int, tuple[int, int]] = {}  # second of the host: host − device, host ns
        self._judged_at = 0
        self._keep_history = keep_history
        self._segments: list[_Segment] = []
        self._lock_host = array("q")
        self._lock_state = array("b")
        self._edges_used = 0
        self.refused: dict[str, int] = {}

    def add(self, rows: StructArray, host_ns: Int64Array | None = None) -> None:
        """Take rows in order of arrival. host_ns (n,): host times on the clock's scale; None: the rows' own."""
        if not len(rows):
            return
        host = np.asarray(rows["host_time_ns"] if host_ns is None else host_ns, dtype=np.int64)
        device = np.asarray(rows["device_time_ns"], dtype=np.int64)
        count = np.asarray(rows["pps_count"], dtype=np.int64)
        if self._judges:
            self._note_stamps(rows, device, host)
        self._note_locks(np.asarray(rows["locked"]), host)
        free = _runs_free(rows)
        begins = (np.diff(device) < -STEP_BACK_NS) | ((np.diff(count) < 0) & (count[1:] >= 0)) | np.diff(free)
        begins |= np.abs(np.diff(device) - np.diff(host)) > JUMP_NS
        starts = [0, *(int(place) + 1 for place in np.flatnonzero(begins))]
        for start, stop in zip(starts, [*starts[1:], len(rows)], strict=True):
            segment = self._segment_for(int(device[start]), int(count[start]), int(host[start]), free=bool(free[start]))
            pps = np.asarray(rows["pps_time_ns"][start:stop], dtype=np.int64)
            broken = self._add_latched(segment, pps, count[start:stop], device[start:stop], host[start:stop])
            bounds = [start, *(start + place for place in broken), stop]
            for part, (first, last) in zip(self._segments[-len(bounds) + 1 :], pairwise(bounds), strict=True):
                if last > first:
                    part.arrivals.add(device[first:last], host[first:last])
            segment = self._segments[-1]
            segment.last_device_ns, segment.last_host_ns = int(device[stop - 1]), int(host[stop - 1])
            segment.last_count = int(count[stop - 1])
        self._trim()

    def _note_stamps(self, rows: StructArray, device: Int64Array, host: Int64Array) -> None:
        """Keep the least delayed stamp of each second, and judge the stamps' origin at intervals."""
        says = (rows["locked"] >= 0) | (rows["pps_time_ns"] >= 0)
        if self._wanted is StampScale.AUTO and says.any():  # the device reports its lock itself
            if not self._past_utc_hour:
                self._judges, self.stamps = False, None
                return
            device, host = device[~says], host[~says]
            if not len(device):
                return
        second, late = host // SECOND_NS, host - device
        order = np.lexsort((late, second))
        first = np.append(0, np.flatnonzero(np.diff(second[order])) + 1)
        for place in order[first].tolist():
            key, found = int(second[place]), (int(late[place]), int(host[place]))
            self._quickest[key] = min(self._quickest.get(key, found), found)
        for key in sorted(self._quickest)[:-JUDGED_SECONDS]:
            del self._quickest[key]
        newest = max(self._quickest)
        if len(self._quickest) >= JUDGED_AFTER_S and newest - self._judged_at >= JUDGED_AFTER_S:
            self._judged_at = newest
            self.stamps = self._judge()

    def _judge(self) -> Stamps | None:
        rows = np.array(list(self._quickest.values()), dtype=np.int64)
        gps, sigma = self._clock.gps_from_host(rows[:, 1])
        leap = self._clock.leap_seconds_at(int(gps[-1]))
        device = rows[:, 1] - rows[:, 0]
        good = np.where(sigma <= COARSE_MAX_SIGMA_NS, sigma, math.inf)
        wanted = self._wanted or StampScale.AUTO
        return judge(device, gps, good, leap, past_hour=self._past_utc_hour, wanted=wanted)

    def _note_locks(self, locked: NDArray[np.int8], host: Int64Array) -> None:
        previous = self._lock_state[-1] if self._lock_state else None
        changes = np.flatnonzero(np.diff(locked)) + 1
        for place in ([] if int(locked[0]) == previous else [0]) + changes.tolist():
            self._lock_host.append(int(host[place]))
            self._lock_state.append(int(locked[place]))

    def _segment_for(self, device_ns: int, count: int, host_ns: int, *, free: bool) -> _Segment:
        """Return the present segment, or a new one after a step back, a jump or a change of lock.

        A step back is one of the count or of device time, a jump one of device time against host time.
        """
        held = None
        if self._segments:
            last = self._segments[-1]
            passed_ns = 0 if last.last_device_ns is None else device_ns - last.last_device_ns
            jumped = last.last_device_ns is not None and abs(passed_ns - (host_ns - last.last_host_ns)) > JUMP_NS
            goes_on = passed_ns >= -STEP_BACK_NS and not jumped and not 0 <= count < last.last_count
            if goes_on and free == last.free:
                return last
            held = last.latch if goes_on and free else None
        self._segments.append(_Segment(host_ns, free=free, held=held))
        return self._segments[-1]

    def _add_latched(
        self, segment: _Segment, pps: Int64Array, count: Int64Array, device: Int64Array, host: Int64Array
    ) -> list[int]:
        """Take each new latch once: the host saw its edge (device time − latch) before the row's stamp.

        Returns:
            The rows at which the chain broke, so that another segment began.
        """
        broken: list[int] = []
        usable = np.flatnonzero((pps >= 0) & (count != 0))
        if not usable.size:
            return broken
        values = pps[usable]
        fresh = usable[np.concatenate(([values[0] != segment.last_pps_ns], np.diff(values) != 0))]
        segment.last_pps_ns = int(values[-1])
        for place in fresh.tolist():
            latch = segment.latch
            edge, at = int(pps[place]), int(host[place]) - int(device[place] - pps[place])
            if latch.device and edge - latch.device[-1] > MAX_BRIDGED_S * SECOND_NS:
                segment = self._follow_up(segment, int(host[place]))
                broken.append(place)
            reason = segment.latch.add(edge, at)
            if reason is None:
                self._edges_used += 1
                continue
            self.refused[reason] = self.refused.get(reason, 0) + 1
            if segment.latch.refused_in_a_row >= REFUSED_IN_A_ROW:
                segment = self._follow_up(segment, int(host[place]))
                segment.latch.add(edge, at)
                broken.append(place)
        return broken

    def _follow_up(self, segment: _Segment, host_ns: int) -> _Segment:
        """Return a new segment after a break in the chain of latched edges."""
        following = _Segment(host_ns, free=segment.free)
        following.last_pps_ns = segment.last_pps_ns
        self._segments.append(following)
        return following

    def _trim(self) -> None:
        if self._keep_history:
            return
        latch, arrivals = self._segments[-1].latch, self._segments[-1].arrivals
        if len(latch.device) > 2 * LIVE_KNOTS:
            latch.trim()
        if len(arrivals.bins) > 2 * LIVE_KNOTS:
            arrivals.trim()
        del self._segments[:-8], self._lock_host[:-64], self._lock_state[:-64]

    def gps_from_device(
        self, device_time_ns: Int64Array, host_ns: Int64Array | None = None
    ) -> tuple[Int64Array, FloatArray]:
        """Return GPS ns (n,) and sigma ns (n,) of device times (n,).

        host_ns (n,), their arrival times, select among restarts; without it the time since the last restart is used.
        The sigma is inf where the time is unknown.
        """
        device = np.atleast_1d(np.asarray(device_time_ns, dtype=np.int64))
        gps, sigma = np.zeros_like(device), np.full(device.shape, math.inf)
        if not self._segments or not device.size:
            return gps, sigma
        host = None if host_ns is None else np.atleast_1d(np.asarray(host_ns, dtype=np.int64))
        starts = np.array([segment.first_host_ns for segment in self._segments], dtype=np.int64)
        which = np.full(device.shape, len(starts) - 1)
        if host is not None:
            which = np.clip(np.searchsorted(starts, host, side="right") - 1, 0, None)
        for number in np.unique(which).tolist():
            inside = which == number
            gps[inside], sigma[inside] = self._in_segment(self._segments[number], device[inside])
        scale = StampScale.FREE if self.stamps is None else self.stamps.scale
        if self._past_utc_hour and host is not None and self._wanted is not StampScale.FREE:
            self._place_past_hour(device, host, gps, sigma)
        elif scale in (StampScale.TAI, StampScale.UTC) and host is not None:
            self._place_absolute(device, host, gps, sigma)
        return gps, sigma

    def _in_segment(self, segment: _Segment, device: Int64Array) -> tuple[Int64Array, FloatArray]:
        latched = self._by_latch(segment.latch, device)
        if latched is not None:
            return latched
        gps, sigma = self._by_arrivals(segment, device)
        held = None if segment.held is None else self._by_latch(segment.held, device)
        if segment.held is None or held is None:
            return gps, sigma
        held_sigma = np.hypot(held[1], HELD_DRIFT * (device - segment.held.device[-1]))
        better = held_sigma < sigma  # for about 20 s; within 10 s it is good enough for returns
        return np.where(better, held[0], gps), np.where(better, held_sigma, sigma)

    def _by_arrivals(self, segment: _Segment, device: Int64Array) -> tuple[Int64Array, FloatArray]:
        if not segment.arrivals.bins:
            return np.zeros_like(device), np.full(device.shape, math.inf)
        host, scatter = segment.arrivals.host_at(device)
        gps, sigma = self._clock.gps_from_host(host)
        return gps, np.hypot(sigma, scatter)

    def _by_latch(self, latch: _Latch, device: Int64Array) -> tuple[Int64Array, FloatArray] | None:
        """Return GPS ns and sigma, linear between latched edges, by the last rate beyond; None without a known second.

        A single edge is not used: it may be a register that reads 0 before the first pulse, or a glitch at power-on.
        """
        knots = np.array(latch.device, dtype=np.int64)
        if len(knots) < 2:
            return None
        label = self._label(latch, int(np.searchsorted(knots, np.median(device))))
        if label is None:
            return None
        gps = (np.array(latch.seconds, dtype=np.int64) + label) * SECOND_NS
        left = np.clip(np.searchsorted(knots, device, side="right") - 1, 0, len(knots) - 2)
        right = left + 1
        rate = (gps[right] - gps[left]) / (knots[right] - knots[left]).astype(np.float64)
        before, after = device < knots[0], device > knots[-1]
        anchor = np.where(after, len(knots) - 1, left)
        rate = np.where(after, latch.slope(len(knots) - 1), np.where(before, latch.slope(0), rate))
        since = (device - knots[anchor]).astype(np.float64)
        near = np.minimum(np.abs(device - knots[left]), np.abs(device - knots[right])).astype(np.float64) / SECOND_NS
        noise = latch.noise_ns()
        variance = noise**2 * (1.0 + 12.0 / SLOPE_KNOTS**3 * near**2) + WANDER_NS**2 * near**3
        return gps[anchor] + np.rint(rate * since).astype(np.int64), np.sqrt(variance)

    def _label(self, latch: _Latch, around: int) -> int | None:
        """Return the GPS second of the first latched edge, by the majority of the host-labelled edges around a knot."""
        low = max(0, min(around - LABEL_KNOTS // 2, len(latch.host) - LABEL_KNOTS))
        host = np.array(latch.host[low : low + LABEL_KNOTS], dtype=np.int64)
        gps, sigma = self._clock.gps_from_host(host)
        second = (gps + SECOND_NS // 2) // SECOND_NS
        near = (np.abs(gps - second * SECOND_NS) <= MAX_PAIRING_S * SECOND_NS) & (sigma <= LABEL_MAX_SIGMA_NS)
        if not np.any(near):
            return None
        offsets = second[near] - np.array(latch.seconds[low : low + LABEL_KNOTS], dtype=np.int64)[near]
        values, counts = np.unique(offsets, return_counts=True)
        best = int(np.argmax(counts))
        return int(values[best]) if counts[best] >= LABEL_MAJORITY * len(offsets) else None

    def _place_past_hour(self, device: Int64Array, host: Int64Array, gps: Int64Array, sigma: FloatArray) -> None:
        """Overwrite times, in place, by a locked head's more accurate stamps past the UTC hour."""
        near, near_sigma = self._clock.gps_from_host(host)
        leap = self._clock.leap_seconds_at(int(near[-1]))
        place = np.searchsorted(np.array(self._lock_host, dtype=np.int64), host, side="right") - 1
        state = np.array(self._lock_state)[np.clip(place, 0, None)]
        locked = (place >= 0) & (state == 1)
        sigma_ns = HOUR_STAMP_SIGMA_NS
        if self.stamps is not None and self.stamps.scale is StampScale.HOUR:
            locked |= np.ones_like(locked) if self._wanted is StampScale.HOUR else state < 0
            sigma_ns = self.stamps.sigma_ns
        placed, believed = gps_ns_past_hour(device % HOUR_NS, near, leap, slack_ns=self._slack_ns(near_sigma))
        good = locked & believed & (near_sigma <= COARSE_MAX_SIGMA_NS)
        refused = int(np.count_nonzero(locked & ~believed))
        if refused:
            self.refused["past_hour"] = self.refused.get("past_hour", 0) + refused
        gps[good], sigma[good] = placed[good], sigma_ns

    @staticmethod
    def _slack_ns(near_sigma: FloatArray) -> Int64Array:
        """Return the added tolerance (n,) between a stamp and its arrival; 0 if the host knows the second."""
        coarse = (near_sigma > LABEL_MAX_SIGMA_NS) & (near_sigma <= COARSE_MAX_SIGMA_NS)
        return np.where(coarse, 3.0 * near_sigma, 0.0).astype(np.int64)

    def _place_absolute(self, device: Int64Array, host: Int64Array, gps: Int64Array, sigma: FloatArray) -> None:
        """Overwrite times, in place, by stamps that count from 1970, if these agree with their arrival."""
        assert self.stamps is not None
        near, near_sigma = self._clock.gps_from_host(host)
        placed = device + self.stamps.offset_ns
        late, slack = near - placed, self._slack_ns(near_sigma)
        believed = (late <= SECOND_NS + slack) & (late >= -SECOND_NS // 2 - slack)
        good = believed & (near_sigma <= COARSE_MAX_SIGMA_NS)
        refused = int(np.count_nonzero(~believed))
        if refused:
            self.refused["stamp_jump"] = self.refused.get("stamp_jump", 0) + refused
        gps[good], sigma[good] = placed[good], self.stamps.sigma_ns

    def status(self) -> DeviceClockStatus:
        """Return the clock's counts and drift."""
        latch = self._segments[-1].latch if self._segments else _Latch()
        latched = len(latch.device) > 1
        drift = (1.0 / latch.slope(len(latch.device) - 1) - 1.0) * 1e6 if latched else None
        return DeviceClockStatus(latched, drift, len(self._segments), self._edges_used, dict(self.refused))
