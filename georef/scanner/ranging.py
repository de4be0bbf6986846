"""Resolve ranges of pulses in air by their time of flight (FORMULAS 3.1, 3.3; PROTOCOLS, SREP's byte 15).

A scanner that fires before the last echo is back measures from its last emission: the apparent range. The emission of
an echo is k − 1 pulses earlier (k is the zone, in the records z = k − 1), and the true range is longer by half the
distance that light travels in between.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections import Counter
from itertools import pairwise

import numpy as np

from swath.georef.arrays import BoolArray, FloatArray, Int64Array, StructArray
from swath.georef.records import RETURN_DTYPE
from swath.georef.scanner.kernels.zones import (
    AMBIGUOUS,
    BRIDGED,
    COMPLETE,
    GAP,
    LAST_ORDINAL,
    LEAST,
    LIGHT_MPS,
    MEDIAN_OF,
    NO_RETURN,
    OLD_LEAST,
    ORDINAL,
    SEGMENT,
    STATE_SIZE,
    TICKS,
    resolve_zones,
)

ZONE_UNKNOWN = 255
CONTEXT_FLAG = 128  # of a row's flags: the row serves only as a neighbour of others
MOST_TICK_HZ = 1_000_000_000  # device times are whole nanoseconds


class RangingError(ValueError):
    """Raised for an impossible description of a scanner's ranging."""


class PulseRates:
    """Pulse and tick rates from a scanner's headers, each valid from a pulse on.

    They are kept by ``pulse_id``, so that late rows still find theirs. A parser calls `note`; `ZoneResolver` and
    `swath.georef.georeference.Georeferencer` ask.
    """

    def __init__(self) -> None:
        self._first: list[int] = []
        self._told: list[tuple[float, int]] = []

    def note(self, pulse_id: int, prf_hz: float, tick_hz: int) -> None:
        """Note the rates from a pulse on: pulse rate in Hz, 0 if not given; nominal ticks a second of the counter."""
        at = bisect_right(self._first, pulse_id)
        self._first.insert(at, pulse_id)
        self._told.insert(at, (prf_hz, tick_hz))

    def runs(self, pulse_id: Int64Array) -> list[tuple[int, int, float | None, int | None]]:
        """Return runs of the same rates among pulses (n,): bounds, prf_hz and tick_hz; None if not given."""
        if not len(pulse_id):
            return []
        at = np.searchsorted(np.array(self._first, np.int64), np.asarray(pulse_id, np.int64), side="right") - 1
        edges = [0, *(np.flatnonzero(np.diff(at)) + 1).tolist(), len(at)]
        runs = []
        for start, stop in pairwise(edges):
            prf_hz, tick_hz = self._told[at[start]] if at[start] >= 0 else (0.0, None)
            runs.append((start, stop, prf_hz or None, tick_hz))
        return runs


class ZoneResolver:
    """Finds the emission of every return of a scanner that gives apparent ranges.

    The expected range is a terrain model's, if the caller gives it, or that of the returns before: the median of the
    last 60 that were accepted, reduced to scan angle 0; at the beginning it is the height above ground. Of the
    emissions before the echo the one with the nearest range is taken; every one counts from its own time, so that a
    changing or jittered pulse rate does no harm. Dropped and counted:

    - ``mta_gap``: the expected emission is unknown: the sequence is broken before it, or it had no return of its own
      and its neighbours do not determine its time. Rows without a return (``number_of_returns`` 0) are emissions too,
      and are not returned: a parser that gives every pulse leaves no gaps but those of the network.
    - ``mta_ambiguous``: the nearest range is so far from the expected one that the next zone is hardly farther; or
      nothing is expected yet; or the echo came in the blind time of a later pulse.

    Returns of a pulse, which may be in several records, are put together and renumbered. The output does not depend on
    the division of rows into batches. Rows with a known zone pass unchanged and break the sequence.

    Args:
        range_max_m: of the scanner; limit of the search back, and of the wait for a pulse's returns.
        height_above_ground_m: expected at first; None: returns are ambiguous until a terrain model gives a range.
        group_index: the scanner's own between ticks and metres; SREP counts with the speed of light in vacuum.
        tick_hz: of the counter behind ``device_time_ns``, whose floor these nanoseconds are: half a nanosecond would be
            7 cm. Up to 10⁹.
        edge_share: of a zone, beside either edge, where no return is accepted.
        blind_m: apparent ranges below belong to flash and near field of the pulse just fired.
        slanted: the encoder gives the beam's angle from the vertical (line scanners); False: a cone, with equal ranges.
        every_pulse: rows exist for every pulse, also for those without a return: if a datagram follows another, its
            first pulse follows that one's last, however long after.
        rates: give the tick rate instead, from a pulse on. Returns counted in more than 10⁹ ticks a second are gaps:
            their device times do not determine the ticks.

    Attributes:
        counts: returns dropped, by reason; without rows that serve only as neighbours (flag `CONTEXT_FLAG`).

    Raises:
        RangingError: an impossible number.
    """

    def __init__(
        self,
        range_max_m: float,
        height_above_ground_m: float | None = None,
        *,
        group_index: float = 1.0,
        tick_hz: int = 1_000_000_000,
        edge_share: float = 0.1,
        blind_m: float = 0.0,
        slanted: bool = True,
        every_pulse: bool = False,
        rates: PulseRates | None = None,
    ) -> None:
        if not 1 <= tick_hz <= MOST_TICK_HZ:
            raise RangingError(f"tick_hz: got {tick_hz}, want 1 to 1 000 000 000: device times are whole nanoseconds")
        if not 0.0 <= edge_share < 0.5:
            raise RangingError(f"edge_share: got {edge_share:g}, want a share of a zone beside its edge, 0 to 0.5")
        if not 0.0 < range_max_m < math.inf:
            raise RangingError(f"range_max_m: got {range_max_m:g}, want the scanner's longest range in metres")
        self.counts: Counter[str] = Counter()
        self.rates = rates
        self._every_pulse = every_pulse
        self._range_max_m, self._group_index = range_max_m, group_index
        self._count_by(tick_hz)
        self._limits = (math.nan if height_above_ground_m is None else height_above_ground_m, edge_share, blind_m)
        self._slanted = slanted
        self._median = (np.zeros(MEDIAN_OF), np.zeros(MEDIAN_OF), np.zeros(3, np.int64))
        self._restart()

    @property
    def waiting(self) -> int:
        """The number of returns held back."""
        return len(self._held)

    def feed(self, rows: StructArray, predicted_m: FloatArray | None = None) -> StructArray:
        """Take rows, and return those that are complete now, in the order of emission.

        Args:
            rows: (n,) `RETURN_DTYPE`, in the order of their records.
            predicted_m: (n,) predicted range of each row's beam, nan if unknown.
        """
        if self.rates is None:
            return self._fed(rows, predicted_m)
        given = [rows[:0]]
        for start, stop, _, tick_hz in self.rates.runs(rows["pulse_id"]):
            if tick_hz is not None and tick_hz != self._tick_hz:
                given.append(self.flush())
                self._count_by(tick_hz)
            given.append(self._fed(rows[start:stop], None if predicted_m is None else predicted_m[start:stop]))
        some = [piece for piece in given if len(piece)]
        return some[0] if len(some) == 1 else np.concatenate(given)

    def _count_by(self, tick_hz: int) -> None:
        self._tick_hz = tick_hz
        metres_per_tick = LIGHT_MPS / (2.0 * self._group_index * tick_hz)
        self._flight_ticks = math.ceil(self._range_max_m / metres_per_tick)
        self._scale = (metres_per_tick, self._flight_ticks)

    def _fed(self, rows: StructArray, predicted_m: FloatArray | None) -> StructArray:
        """Take rows of one tick rate, and return those that are complete now."""
        unknown = rows["mta_zone"] == ZONE_UNKNOWN
        if not unknown.any():
            return self._passed(rows)
        predicted = np.empty(0) if predicted_m is None else np.ascontiguousarray(predicted_m, dtype=np.float64)
        given = []
        edges = np.flatnonzero(unknown[1:] != unknown[:-1]) + 1
        for start, stop in zip([0, *edges.tolist()], [*edges.tolist(), len(rows)], strict=True):
            if unknown[start]:
                given.append(self._resolved(rows[start:stop], predicted[start:stop]))
            else:
                given.append(self._passed(rows[start:stop]))
        return np.concatenate(given)

    def flush(self) -> StructArray:
        """Return the rows held back, when no more will come; later rows begin a new sequence."""
        held = self._released(np.ones(len(self._held), np.bool_))
        self._restart()
        return held

    def _restart(self) -> None:
        self._state = np.zeros(STATE_SIZE, np.int64)
        self._state[LAST_ORDINAL] = -1  # no pulse yet
        self._state[COMPLETE] = self._every_pulse
        self._state[[LEAST, OLD_LEAST]] = np.iinfo(np.int64).max
        self._pulses, self._angles = np.zeros((0, 4), np.int64), np.zeros(0)
        self._held: StructArray = np.zeros(0, RETURN_DTYPE)
        self._held_key = np.zeros((0, 2), np.int64)  # ordinal, ticks of emission

    def _passed(self, rows: StructArray) -> StructArray:
        """Return rows with complete ranges, after any rows held back."""
        if not len(rows) or not len(self._pulses):
            return rows
        held = self.flush()
        return np.concatenate([held, rows]) if len(held) else rows

    def _resolved(self, rows: StructArray, predicted_m: FloatArray) -> StructArray:
        """Take rows with apparent ranges, and return those that are complete now, with true ranges."""
        if self._tick_hz > MOST_TICK_HZ:
            self._count(np.where(rows["number_of_returns"] > 0, GAP, NO_RETURN), rows)
            return rows[:0]
        n, known = len(rows), len(self._pulses)
        pulses, angles = np.empty((known + BRIDGED * n, 4), np.int64), np.empty(known + BRIDGED * n)
        pulses[:known], angles[:known] = self._pulses, self._angles
        found, whole_m, angle_rad = np.zeros((n, 5), np.int64), np.empty(n), np.empty(n)
        rows = np.ascontiguousarray(rows)
        arguments = (self._state, self._median, self._tick_hz, self._scale, self._limits, self._slanted)
        known = resolve_zones(rows, predicted_m, pulses, angles, known, *arguments, found, whole_m, angle_rad)
        now = int(pulses[known - 1, TICKS])
        keep = int(np.searchsorted(pulses[:known, ORDINAL], self._oldest(pulses[:known])))
        self._pulses, self._angles = pulses[keep:known].copy(), angles[keep:known].copy()
        self._count(found[:, 0], rows)
        which = np.flatnonzero(found[:, 0] >= 0)
        self._hold(rows.take(which), found.take(which, axis=0), whole_m.take(which), angle_rad.take(which))
        old_train = self._held_key[:, 0] < int(pulses[known - 1, ORDINAL]) - SEGMENT // 2
        return self._released(old_train | (self._held_key[:, 1] < now - self._flight_ticks))

    def _oldest(self, pulses: Int64Array) -> int:
        """Return the ordinal of the oldest emission from which an echo may still come."""
        ordinal, ticks = pulses[:, ORDINAL], pulses[:, TICKS]
        recent = (ordinal > ordinal[-1] - SEGMENT // 2) & (ticks >= ticks[-1] - self._flight_ticks)
        return int(ordinal[int(np.argmax(recent))])

    def _count(self, zones: Int64Array, rows: StructArray) -> None:
        own = rows["flags"] & CONTEXT_FLAG == 0
        for reason, code in (("mta_gap", GAP), ("mta_ambiguous", AMBIGUOUS)):
            dropped = int(np.count_nonzero(own & (zones == code)))
            if dropped:
                self.counts[reason] += dropped

    def _hold(self, rows: StructArray, found: Int64Array, whole_m: FloatArray, angle_rad: FloatArray) -> None:
        """Add rows, with the values of their emissions, to those that wait."""
        zone, ordinal, ticks, pulse_id, channel = found.T
        rows["range_m"], rows["encoder_rad"] = whole_m, angle_rad
        rows["device_time_ns"] = _times(ticks, self._tick_hz)
        rows["pulse_id"], rows["channel"] = pulse_id, channel
        rows["mta_zone"] = np.minimum(zone, ZONE_UNKNOWN - 1)
        self._held = np.concatenate([self._held, rows])
        self._held_key = np.concatenate([self._held_key, np.stack([ordinal, ticks], axis=1)])

    def _released(self, which: BoolArray) -> StructArray:
        """Remove complete rows from those held and return them, by emission, then by range, renumbered."""
        index, rest = np.flatnonzero(which), np.flatnonzero(~which)
        if not len(index):
            return self._held[:0]
        ordinal, range_m = self._held_key[index, 0], self._held["range_m"].take(index)
        step = np.diff(ordinal)
        if not ((step > 0) | ((step == 0) & (np.diff(range_m) >= 0.0))).all():
            order = np.lexsort((range_m, ordinal))
            index, ordinal = index[order], ordinal[order]
        rows = self._held.take(index)
        self._held, self._held_key = self._held.take(rest), self._held_key.take(rest, axis=0)
        first = np.flatnonzero(np.concatenate([[True], ordinal[1:] != ordinal[:-1]]))
        count = np.diff(np.append(first, len(rows)))
        rows["return_number"] = np.arange(len(rows)) - np.repeat(first, count) + 1
        rows["number_of_returns"] = np.repeat(count, count)
        return rows


def _times(ticks: Int64Array, tick_hz: int) -> Int64Array:
    """Return device times (n,) in nanoseconds from a counter."""
    seconds = ticks // tick_hz
    time_ns: Int64Array = seconds * 1_000_000_000 + (ticks - seconds * tick_hz) * 1_000_000_000 // tick_hz
    return time_ns
