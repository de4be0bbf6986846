"""SREP/1 datagrams of a line scanner (PROTOCOLS), and its table in the configuration."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from swath.drivers.scanner.srep.layout import (
    FLAG_LASER_ON,
    FLAG_PPS_LOCKED,
    FLAG_RANGE_GATE,
    HEADER_DTYPE,
    ZONE_UNKNOWN,
    datagram_bytes,
    encode_datagrams,
    pulse_dtype,
)
from swath.georef.arrays import BoolArray, FloatArray, Int64Array, StructArray, UInt64Array
from swath.sim.clocks import Oscillator, PulsePerSecond, generator
from swath.sim.plan.errors import PlanError
from swath.sim.plan.tables import HostTable, ScannerTable
from swath.sim.scanners.calibration_files import mirror_factor
from swath.sim.scanners.line_heads import config_geometry
from swath.sim.scanners.ranging import LIGHT_MPS
from swath.sim.scanners.srep_records import ApparentRanges, RecordMaker, Records, WholeRanges, no_records
from swath.sim.shots import Measured, Pulses, WireUnit
from swath.sim.truth import RETURN_TRUTH_DTYPE

PROCESSING_S = 250e-6  # from a datagram's last pulse to the wire; longer than light needs to 30 km and back
HOLD_S = 0.1  # a datagram is sent unfilled after this long without a pulse
HEARTBEATS_HZ = 10
UNLOCKED_AFTER_S = 1.5  # time without an edge
LARGEST_UDP_BYTES = 65_507
_EPOCH_BITS = 31  # datagrams end where the counter passes a multiple of 2³¹: ticks in one fit u32
_U32 = 2**32 - 1


class PpsLatch:
    """The counter as latched at the edges of a pulse per second.

    Args:
        pps: pulse wired to the device; None: no pulse is wired.
        oscillator: oscillator that drives the counter.
        ticks_at_start: the counter at the plan's start.
        lost: windows in which no edge arrives.
    """

    def __init__(
        self,
        pps: PulsePerSecond | None,
        oscillator: Oscillator,
        ticks_at_start: int,
        lost: Sequence[tuple[float, float]],
    ) -> None:
        self._pps, self._oscillator, self._ticks_at_start, self._lost = pps, oscillator, ticks_at_start, lost
        self._reached_s = -1.0
        self._edge_s: FloatArray = np.zeros(0)
        self._ticks: UInt64Array = np.zeros(0, np.uint64)

    def seen(self, time_s: FloatArray) -> tuple[Int64Array, UInt64Array, BoolArray]:
        """Return (n,) the edges latched so far, the counter at the latest one, and True if the device follows them."""
        self._reach(float(time_s.max(initial=0.0)))
        count = np.searchsorted(self._edge_s, time_s, side="right")
        latched = count > 0
        at = np.maximum(count - 1, 0)
        if not len(self._edge_s):
            return count, np.zeros(len(time_s), np.uint64), latched
        locked = latched & (time_s - self._edge_s[at] < UNLOCKED_AFTER_S)
        return count, np.where(latched, self._ticks[at], np.uint64(0)), locked

    def _reach(self, time_s: float) -> None:
        if self._pps is None or time_s < self._reached_s:
            return
        seconds = 2 * int(time_s) + 64
        self._reached_s = seconds - 1.0
        edge_s = self._pps.edges(np.arange(seconds))
        ticks = np.floor(self._oscillator.phase(edge_s)).astype(np.int64)
        there = ticks >= -min(self._ticks_at_start, 2**62)  # an edge before power-on does not count
        for from_s, to_s in self._lost:
            there &= (edge_s < from_s) | (edge_s >= to_s)
        self._edge_s = edge_s[there]
        self._ticks = ticks[there].astype(np.uint64) + np.uint64(self._ticks_at_start)


class SrepWire:
    """Encodes the measurements of a line scanner.

    Args:
        table: of the plan.
        name: of the scanner; units have the source ``scanner/<name>``.
        pps: pulse that it latches; None: no pulse is wired to it.
        host: of the plan, for the jitter of arrivals.
        seed: of that jitter.
        noise: False leaves the jitter out.
        lost_pps: windows (from_s, to_s) in which the device gets no edge: the count stays, the lock goes.
        scanner_id, first_sequence: for the header.

    Raises:
        PlanError: UDP cannot carry the datagrams, or there are more pulses in air than a byte counts.
    """

    def __init__(
        self,
        table: ScannerTable,
        name: str,
        pps: PulsePerSecond | None,
        host: HostTable,
        seed: int,
        *,
        noise: bool,
        lost_pps: Sequence[tuple[float, float]] = (),
        scanner_id: int = 1,
        first_sequence: int = 0,
    ) -> None:
        _check(table, f"scanner.{name}")
        self._table, self._source = table, f"scanner/{name}"
        self._scanner_id, self._sequence = scanner_id, first_sequence
        self._oscillator = Oscillator(table.tick_hz, table.oscillator)
        self._ticks_at_start = np.uint64(table.oscillator.ticks_at_start)
        self._latch = PpsLatch(pps, self._oscillator, table.oscillator.ticks_at_start, lost_pps)
        self._jitter_s = 1e-6 * host.udp_jitter_us if noise else 0.0
        self._random = generator(seed, "udp", self._source)
        self._records: RecordMaker = WholeRanges(table) if table.zone == "resolved" else ApparentRanges(table)
        self._zone = 0 if table.zone == "resolved" else ZONE_UNKNOWN
        self._waiting = no_records(table.return_slots)
        self._owed: StructArray = np.zeros(0, RETURN_TRUTH_DTYPE)
        self._arrived_s = -np.inf
        self._newest_ticks = 0

    @property
    def lost_echoes(self) -> int:
        """Number of echoes that found no slot in their record (apparent ranges)."""
        return self._records.lost_echoes

    def units(self, pulses: Pulses, measured: Measured, truth: StructArray) -> tuple[list[WireUnit], StructArray]:
        """Return the datagrams that are complete, and the truth of their returns in the order in which they are parsed.

        Truth of datagrams that `idle` sent comes first. Pulses that do not fill a datagram wait.
        """
        units, rows = self._send(self._records.take(pulses, measured, truth), ended=False)
        return units, self._with_owed(rows)

    def idle(self, start_s: float, stop_s: float) -> list[WireUnit]:
        """Return the datagrams sent while the laser is off: those that waited, then heartbeats.

        Heartbeats (N = 0) are sent at whole tenths of a second.
        """
        units, rows = self._send(self._records.rest(), ended=True)
        self._owed = self._with_owed(rows)
        time_s = np.arange(np.floor(HEARTBEATS_HZ * start_s), np.ceil(HEARTBEATS_HZ * stop_s) + 1) / HEARTBEATS_HZ
        time_s = time_s[(time_s >= start_s) & (time_s < stop_s)]
        stamp_s = time_s - 1e-6 * self._table.true.time_offset_us  # stamped like a pulse, so that stamps never go back
        ticks = np.maximum(np.floor(self._oscillator.phase(stamp_s)).astype(np.int64), self._newest_ticks)
        header = self._headers(ticks, time_s + PROCESSING_S, np.full(len(ticks), self._zone), laser=0)
        body = np.zeros((len(ticks), 0), pulse_dtype(self._table.return_slots))
        return units + self._arriving(time_s + PROCESSING_S, encode_datagrams(header, body))

    def close(self) -> tuple[list[WireUnit], StructArray]:
        """Return the datagrams that still wait."""
        units, rows = self._send(self._records.rest(), ended=True)
        return units, self._with_owed(rows)

    def _with_owed(self, rows: StructArray) -> StructArray:
        owed, self._owed = self._owed, self._owed[:0]
        return np.concatenate([owed, rows]) if len(owed) else rows

    def _send(self, records: Records, *, ended: bool) -> tuple[list[WireUnit], StructArray]:
        """Return datagrams of waiting and further records; with ``ended`` also one that is not full."""
        waiting = self._waiting.followed_by(records)
        edges = _datagram_edges(waiting, self._table.pulses_per_datagram)
        if not ended and len(edges) > 1 and edges[-1] - edges[-2] < self._table.pulses_per_datagram:
            edges = edges[:-1]
        sent, self._waiting = waiting.split(int(edges[-1]))
        if not len(sent):
            return [], sent.truth
        self._newest_ticks, self._zone = int(sent.ticks[-1]), int(sent.zone[-1])
        first_ticks = sent.ticks[edges[:-1]]
        sent.body["ticks"] = sent.ticks - np.repeat(first_ticks, np.diff(edges))
        time_s = sent.time_s[edges[1:] - 1] + PROCESSING_S
        header = self._headers(first_ticks, time_s, sent.zone[edges[:-1]], FLAG_LASER_ON)
        return self._arriving(time_s, _encoded(header, sent.body, edges)), sent.truth

    def _headers(self, first_ticks: Int64Array, time_s: FloatArray, zone: Int64Array, laser: int) -> StructArray:
        """Return (m,) headers of datagrams sent at these times."""
        table = self._table
        count, latched_ticks, locked = self._latch.seen(time_s)
        header = np.zeros(len(first_ticks), HEADER_DTYPE)
        header["flags"] = laser | FLAG_RANGE_GATE | np.where(locked, FLAG_PPS_LOCKED, 0)
        header["sequence"] = (self._sequence + np.arange(len(header))) & _U32
        self._sequence += len(header)
        header["scanner_id"] = self._scanner_id
        header["mta_zone"] = zone
        header["pps_count"], header["pps_ticks"] = count, latched_ticks
        header["first_ticks"] = first_ticks.astype(np.uint64) + self._ticks_at_start
        header["tick_hz"], header["encoder_counts"] = table.tick_hz, table.encoder_counts
        header["prf_mhz"] = min(round(1000.0 * table.prf_hz), _U32)
        return header

    def _arriving(self, time_s: FloatArray, datagrams: list[bytes]) -> list[WireUnit]:
        """Return the units of datagrams sent at these times (m,); a unit never arrives before its predecessor."""
        if self._jitter_s > 0.0:
            time_s = time_s + self._random.exponential(self._jitter_s, len(time_s))
        arrive_s = np.maximum.accumulate(np.concatenate([[self._arrived_s], time_s]))
        self._arrived_s = float(arrive_s[-1])
        return [WireUnit(at_s, self._source, data) for at_s, data in zip(arrive_s[1:].tolist(), datagrams, strict=True)]


def config_table(table: ScannerTable, name: str, transport: str) -> dict[str, Any]:
    """Return ``[scanner.<name>]`` of the configuration that records the scanner; raises `PlanError`."""
    matrix = np.array(table.installation)
    if not np.allclose(matrix @ matrix.T, np.eye(3), atol=1e-6) or np.linalg.det(matrix) < 0.0:
        text = "is no rotation: want rows of length 1, perpendicular, determinant +1"
        raise PlanError(f"scanner.{name}.installation", text)
    config: dict[str, Any] = {
        "transport": transport,
        "protocol": "srep",
        "model": table.model,
        "serial": table.serial,
        "mirror_factor": mirror_factor(table),
        "installation": table.installation,
        "lever_arm_m": [getattr(table.nominal, f"lever_arm_{axis}_m") for axis in "xyz"],
        "range_min_m": table.range_min_m,
        "range_max_m": table.range_max_m,
        "divergence_mrad": table.divergence_mrad,
        "geometry": config_geometry(table),
    }
    return config if table.pps is None else config | {"pps": table.pps}


def _check(table: ScannerTable, key: str) -> None:
    pulse_bytes = datagram_bytes(1, table.return_slots) - datagram_bytes(0, table.return_slots)
    most = (LARGEST_UDP_BYTES - datagram_bytes(0, table.return_slots)) // pulse_bytes
    if table.pulses_per_datagram > most:
        text = f"got {table.pulses_per_datagram}, want at most {most}: UDP carries {LARGEST_UDP_BYTES} bytes"
        raise PlanError(f"{key}.pulses_per_datagram", text)
    farthest_m = ZONE_UNKNOWN * LIGHT_MPS / (2.0 * table.prf_hz)
    if table.zone == "resolved" and table.range_max_m >= farthest_m:
        text = f"got {table.range_max_m:g}, want less than {farthest_m:.0f}: at most {ZONE_UNKNOWN} pulses in air"
        raise PlanError(f"{key}.range_max_m", text)


def _datagram_edges(records: Records, pulses: int) -> Int64Array:
    """Return (m + 1,) the records at which datagrams begin, and the end of the last one.

    A datagram ends when it is full, when zone or epoch changes, or before a long pause.
    """
    if not len(records):
        return np.zeros(1, np.int64)
    new = records.zone[1:] != records.zone[:-1]
    new |= records.ticks[1:] >> _EPOCH_BITS != records.ticks[:-1] >> _EPOCH_BITS
    new |= np.diff(records.time_s) > HOLD_S
    runs = pairwise([0, *(np.flatnonzero(new) + 1).tolist(), len(records)])
    return np.concatenate([*(np.arange(start, stop, pulses) for start, stop in runs), [len(records)]])


def _encoded(header: StructArray, body: StructArray, edges: Int64Array) -> list[bytes]:
    """Return the datagrams between edges (m + 1,).

    Datagrams of equal length are encoded at once, because alternating zones make many short ones.
    """
    sizes = np.diff(edges)
    datagrams = [b""] * len(sizes)
    for size in np.unique(sizes).tolist():
        which = np.flatnonzero(sizes == size)
        part = body[edges[which][:, np.newaxis] + np.arange(size)]
        for place, data in zip(which.tolist(), encode_datagrams(header[which], part), strict=True):
            datagrams[place] = data
    return datagrams
