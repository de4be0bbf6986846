"""Pulse records of SREP: assigns echoes to records, with whole ranges or with apparent ones."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from swath.drivers.scanner.srep.layout import PULSE_WIDTH_UNIT_NS, RANGE_UNIT_M, ZONE_UNKNOWN, pulse_dtype
from swath.georef.arrays import FloatArray, Int64Array, StructArray
from swath.sim.plan.tables import ScannerTable
from swath.sim.scanners.line_heads import emission_ticks
from swath.sim.scanners.ranging import LIGHT_MPS, packed
from swath.sim.shots import Measured, Pulses
from swath.sim.truth import RETURN_TRUTH_DTYPE

_U16, _U32 = 2**16 - 1, 2**32 - 1


@dataclass(frozen=True, slots=True)
class Records:
    """n records as they go on the wire, in order.

    Attributes:
        ticks: (n,) of the emission, from the plan's start.
        time_s: (n,) true time of the emission.
        zone: (n,) byte 15 of the datagram to which the record belongs.
        body: (n,) `pulse_dtype`, ``ticks`` still to be counted from the datagram's first.
        truth: (k,) of the returns in them, by record, then by slot.
    """

    ticks: Int64Array
    time_s: FloatArray
    zone: Int64Array
    body: StructArray
    truth: StructArray

    def __len__(self) -> int:
        """Return the number of records."""
        return len(self.ticks)

    def split(self, at: int) -> tuple[Records, Records]:
        """Return the first ``at`` records, and the others."""
        returns = np.count_nonzero(self.body["slot"]["range"][:at])
        return (
            Records(self.ticks[:at], self.time_s[:at], self.zone[:at], self.body[:at], self.truth[:returns]),
            Records(self.ticks[at:], self.time_s[at:], self.zone[at:], self.body[at:], self.truth[returns:]),
        )

    def followed_by(self, other: Records) -> Records:
        """Return these records followed by others."""
        if not len(self):
            return other
        return Records(
            np.concatenate([self.ticks, other.ticks]),
            np.concatenate([self.time_s, other.time_s]),
            np.concatenate([self.zone, other.zone]),
            np.concatenate([self.body, other.body]),
            np.concatenate([self.truth, other.truth]),
        )


def no_records(return_slots: int) -> Records:
    """Return an empty set of records."""
    none = np.zeros(0, np.int64)
    return Records(none, np.zeros(0), none, np.zeros(0, pulse_dtype(return_slots)), np.zeros(0, RETURN_TRUTH_DTYPE))


class RecordMaker(Protocol):
    """Puts measurements into records."""

    lost_echoes: int

    def take(self, pulses: Pulses, measured: Measured, truth: StructArray) -> Records:
        """Return the records that are complete with these pulses."""

    def rest(self) -> Records:
        """Return the records of pulses after which there is a long pause."""


class WholeRanges:
    """Makes records with whole ranges, each in the record of its own pulse; a pulse's zone is that of its first return.

    Zone z holds ranges from z to z + 1 times c / (2 prf) (FORMULAS 3.3, z = k − 1, c of vacuum); a pulse without a
    return belongs to the zone of the one before.
    """

    def __init__(self, table: ScannerTable) -> None:
        self.lost_echoes = 0
        self._table = table
        self._zone = 0
        self._zone_m = LIGHT_MPS / (2.0 * table.prf_hz)

    def take(self, pulses: Pulses, measured: Measured, truth: StructArray) -> Records:
        """Return a record for every pulse."""
        measured, truth = packed(measured, truth)
        body = np.zeros(len(pulses), pulse_dtype(measured.range_m.shape[1]))
        body["encoder"] = pulses.encoder
        _fill(body["slot"], measured.range_m, measured.intensity, measured.pulse_width_ns)
        ticks, zones = emission_ticks(self._table, pulses.number), self._zones(measured.range_m[:, 0])
        rows = truth.reshape(-1).take(np.flatnonzero(body["slot"]["range"]))
        return Records(ticks, pulses.time_s, zones, body, rows)

    def rest(self) -> Records:
        """Return an empty set; no records wait."""
        return no_records(self._table.return_slots)

    def _zones(self, first_m: FloatArray) -> Int64Array:
        zones = np.concatenate([[self._zone], np.floor(first_m / self._zone_m).astype(np.int64)])
        known = np.arange(len(zones))
        known[1:][first_m <= 0.0] = 0
        zones = zones[np.maximum.accumulate(known)]
        self._zone = int(zones[-1])
        return zones[1:]


class ApparentRanges:
    """Makes records with ranges from the last emission before the echo, each in that emission's record.

    Ticks are the device's own: it converts them into metres with its counter's nominal rate and c of vacuum. A record
    is complete when the next pulse has left. If a record has more echoes than slots, the latest are lost. So are those
    that arrive at an emission itself, whose range would be 0; ``lost_echoes`` counts both.
    """

    def __init__(self, table: ScannerTable) -> None:
        self.lost_echoes = 0
        self._table = table
        self._metres_per_tick = LIGHT_MPS / (2.0 * table.tick_hz)
        self._emissions = _Emissions(np.zeros(0, np.int64), np.zeros(0), np.zeros(0, np.int64))
        self._flying = _Flying(np.zeros(0, np.int64), np.zeros((3, 0)), np.zeros(0, RETURN_TRUTH_DTYPE))

    def take(self, pulses: Pulses, measured: Measured, truth: StructArray) -> Records:
        """Return the records of all pulses but the last, for which echoes may still arrive."""
        ticks = emission_ticks(self._table, pulses.number)
        index = np.flatnonzero(measured.range_m > 0.0)
        columns = (measured.range_m, measured.intensity, measured.pulse_width_ns)
        apparent = np.stack([values.reshape(-1).take(index) for values in columns])
        come = _Flying(ticks.take(index // measured.range_m.shape[1]), apparent, truth.reshape(-1).take(index))
        self._emissions = self._emissions.followed_by(_Emissions(ticks, pulses.time_s, pulses.encoder))
        self._flying = self._flying.followed_by(come)
        return self._complete(len(self._emissions.ticks) - 1)

    def rest(self) -> Records:
        """Return the last record."""
        return self._complete(len(self._emissions.ticks))

    def _complete(self, n: int) -> Records:
        """Return the first n records; echoes of later records wait."""
        if n <= 0:
            return no_records(self._table.return_slots)
        emissions, flying = self._emissions, self._flying
        flight = np.floor(flying.said[0] / self._metres_per_tick).astype(np.int64)
        record = np.searchsorted(emissions.ticks, flying.from_ticks + flight, side="right") - 1
        apparent_m = flying.said[0] - (emissions.ticks[record] - flying.from_ticks) * self._metres_per_tick
        self._emissions, self._flying = emissions.after(n), flying.chosen(np.flatnonzero(record >= n))
        echo, slot = self._slots(record, apparent_m, n)
        cells = np.zeros((3, n, self._table.return_slots))
        cells[:, record[echo], slot] = apparent_m[echo], *flying.said[1:, echo]
        body = np.zeros(n, pulse_dtype(self._table.return_slots))
        body["encoder"] = emissions.encoder[:n]
        _fill(body["slot"], *cells)
        zones = np.full(n, ZONE_UNKNOWN)
        return Records(emissions.ticks[:n], emissions.time_s[:n], zones, body, flying.truth.take(echo))

    def _slots(self, record: Int64Array, apparent_m: FloatArray, n: int) -> tuple[Int64Array, Int64Array]:
        """Return the echoes that find a slot in the first n records, and their slots, in order of arrival."""
        come = np.flatnonzero(record < n)
        seen = come[np.rint(apparent_m[come] / RANGE_UNIT_M) > 0.0]
        echo = seen[np.lexsort((apparent_m[seen], record[seen]))]
        slot = np.arange(len(echo)) - np.searchsorted(record[echo], record[echo])
        fits = slot < self._table.return_slots
        self.lost_echoes += len(come) - int(np.count_nonzero(fits))
        return echo[fits], slot[fits]


@dataclass(frozen=True, slots=True)
class _Emissions:
    ticks: Int64Array
    time_s: FloatArray
    encoder: Int64Array

    def after(self, n: int) -> _Emissions:
        return _Emissions(self.ticks[n:], self.time_s[n:], self.encoder[n:])

    def followed_by(self, other: _Emissions) -> _Emissions:
        return _Emissions(
            np.concatenate([self.ticks, other.ticks]),
            np.concatenate([self.time_s, other.time_s]),
            np.concatenate([self.encoder, other.encoder]),
        )


@dataclass(frozen=True, slots=True)
class _Flying:
    """Echoes on their way: ticks of their emission, (range, intensity, width) as rows of ``said``, truth."""

    from_ticks: Int64Array
    said: FloatArray
    truth: StructArray

    def chosen(self, which: NDArray[np.intp]) -> _Flying:
        return _Flying(self.from_ticks[which], self.said[:, which], self.truth[which])

    def followed_by(self, other: _Flying) -> _Flying:
        return _Flying(
            np.concatenate([self.from_ticks, other.from_ticks]),
            np.concatenate([self.said, other.said], axis=1),
            np.concatenate([self.truth, other.truth]),
        )


def _fill(slot: StructArray, range_m: FloatArray, intensity: FloatArray, pulse_width_ns: FloatArray) -> None:
    """Write numbers into slots, all (n, R), rounded to the wire's units and limited to its range."""
    slot["range"] = np.minimum(np.rint(range_m / RANGE_UNIT_M), _U32)
    slot["intensity"] = np.minimum(np.rint(intensity), _U16)
    slot["pulse_width"] = np.minimum(np.rint(pulse_width_ns / PULSE_WIDTH_UNIT_NS), _U16)
