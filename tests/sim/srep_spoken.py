"""Provides a line scanner that sends SREP, for tests: returns made from pulse numbers, without a scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from swath.drivers.parser import DeviceSettings
from swath.drivers.scanner.srep.layout import HEADER_DTYPE
from swath.drivers.scanner.srep.parser import SrepParser
from swath.georef.arrays import Int64Array, StructArray
from swath.georef.records import Chunk, DeviceClockSamples, ScannerReturns
from swath.sim.clocks import PulsePerSecond
from swath.sim.plan.tables import HostTable, PpsTable, ScannerTable
from swath.sim.scanners.line_heads import LineHead
from swath.sim.scanners.srep_wire import SrepWire, config_table
from swath.sim.shots import Measured, Pulses, WireUnit
from swath.sim.truth import RETURN_TRUTH_DTYPE

C_MPS = 299_792_458.0
OSCILLATOR = {"offset_ppm": 5.0, "drift_ppm_per_h": 10.0}
TRANSPORT = "udp:127.0.0.1:2368"


def scanner(**keys: Any) -> ScannerTable:
    defaults = {"prf_hz": 100_000.0, "oscillator": OSCILLATOR, "pulses_per_datagram": 100}
    return ScannerTable.model_validate(defaults | keys)


def pulse_per_second(jitter_ns: float = 20.0) -> PulsePerSecond:
    return PulsePerSecond(PpsTable(jitter_ns=jitter_ns), 5, "main", noise=True)


def measured_count(number: Int64Array, slots: int) -> Int64Array:
    """Return how many returns a pulse of this number has."""
    return number * 48_271 % 2_147_483_647 % (slots + 1)


def measured_of(pulses: Pulses, slots: int, near_m: float, far_m: float) -> tuple[Measured, StructArray]:
    """Return up to ``slots`` returns for each pulse, determined by its number; the truth has the device's range."""
    hashed = (pulses.number[:, np.newaxis] * 2_654_435_761 + np.arange(slots) * 40_503) % 65_536
    spread = np.sort(hashed / 65_536, axis=1)
    there = np.arange(slots) < measured_count(pulses.number, slots)[:, np.newaxis]
    range_m = np.where(there, near_m + (far_m - near_m) * spread, 0.0)
    truth = np.zeros(range_m.shape, RETURN_TRUTH_DTYPE)
    truth["range_m"], truth["pulse"] = range_m, pulses.number[:, np.newaxis]
    truth["channel"], truth["return_number"] = pulses.channel[:, np.newaxis], np.arange(1, slots + 1)
    return Measured(range_m, np.where(there, hashed % 4000, 0.0), np.where(there, 3.0 + spread, 0.0)), truth


@dataclass
class Spoken:
    """Everything that a scanner sent."""

    table: ScannerTable
    wire: SrepWire
    units: list[WireUnit] = field(default_factory=list)
    truth: StructArray = field(default_factory=lambda: np.zeros(0, RETURN_TRUTH_DTYPE))
    pulses: list[Pulses] = field(default_factory=list)

    def add(self, said: tuple[list[WireUnit], StructArray]) -> None:
        self.units += said[0]
        self.truth = np.concatenate([self.truth, said[1]])

    def headers(self) -> StructArray:
        return np.concatenate([np.frombuffer(unit.data[:48], HEADER_DTYPE) for unit in self.units])

    def parsed(self) -> tuple[StructArray, StructArray]:
        """Return returns and clock samples read by this project's parser, and check that it counts no error."""
        config = config_table(self.table, "left", TRANSPORT)
        parser = SrepParser(DeviceSettings("scanner/left", config))
        records = [
            record
            for unit in self.units
            for record in parser.feed(Chunk(unit.source, round(1e9 * unit.time_s), unit.data))
        ]
        assert not parser.counters.errors
        assert parser.counters.bad_messages == parser.counters.bad_checksums == parser.counters.bytes_skipped == 0
        returns = [record.rows for record in records if isinstance(record, ScannerReturns)]
        clocks = [record.rows for record in records if isinstance(record, DeviceClockSamples)]
        return np.concatenate(returns), np.concatenate(clocks)


def speak(
    table: ScannerTable,
    cuts: Sequence[float] = (10.0, 10.013, 10.03),
    *,
    ranges_m: tuple[float, float] = (900.0, 1100.0),
    noise: bool = False,
    pps: PulsePerSecond | None = None,
    idle: Sequence[tuple[float, float]] = (),
    **keys: Any,
) -> Spoken:
    """Return what a scanner sends from the first cut to the last, s.

    It is silent in ``idle`` windows, whose limits must be cuts too.
    """
    wire = SrepWire(table, "left", pps or pulse_per_second(), HostTable(), 1, noise=noise, **keys)
    spoken, head = Spoken(table, wire), LineHead(table, "left")
    for start, stop in pairwise(cuts):
        if any(start >= from_s and stop <= to_s for from_s, to_s in idle):
            spoken.units += wire.idle(start, stop)
            continue
        pulses = head.pulses(start, stop)
        spoken.pulses.append(pulses)
        spoken.add(wire.units(pulses, *measured_of(pulses, table.return_slots, *ranges_m)))
    spoken.add(wire.close())
    return spoken


def joined(pulses: list[Pulses]) -> dict[str, NDArray[Any]]:
    return {
        name: np.concatenate([getattr(part, name) for part in pulses])
        for name in ("number", "time_s", "encoder", "channel")
    }
