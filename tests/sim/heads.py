"""Provides spinning heads without an aircraft: plans, random echoes with their truth, and decoding."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from swath.drivers.parser import PacketParser
from swath.georef.arrays import FloatArray, StructArray
from swath.georef.records import DeviceClockSamples, Record, ScannerReturns
from swath.sim.clocks import PulsePerSecond
from swath.sim.plan.plan import Plan, parse_plan
from swath.sim.shots import Measured, Pulses, WireUnit
from swath.sim.truth import RETURN_TRUTH_DTYPE

TEXT = """
[flight]
name = "heads"
seed = 7
start = 2026-06-15T09:59:58Z

[[line]]
name = "1"
from_m = [0, 0]
to_m = [0, 1000]
height_m = 600
"""
SLOTS = 3


def plan_of(kind: str, *, noise: bool = False, **keys: Any) -> Plan:
    """Return a plan with the scanner ``left`` of this kind."""
    scanner = {"kind": kind, "scan_hz": 10.0} | keys
    return parse_plan(TEXT, Path()).changed({"flight": {"noise": noise}, "scanner": {"left": scanner}})


def pulse(plan: Plan) -> PulsePerSecond:
    """Return the PPS of a plan."""
    return PulsePerSecond(plan.tables.pps["main"], plan.tables.flight.seed, "main", noise=plan.tables.flight.noise)


class Still:
    """An aircraft that stays over one place but has a velocity to the north-east."""

    def geodetic(self, time_s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        return np.full(len(time_s), 0.829), np.full(len(time_s), 0.155), np.full(len(time_s), 600.0)

    def velocity_l(self, time_s: FloatArray) -> FloatArray:
        return np.tile([40.0, 30.0, 0.0], (len(time_s), 1))


class Shots(NamedTuple):
    """Pulses, their measurements, and truth rows whose values differ from slot to slot."""

    pulses: Pulses
    measured: Measured
    truth: StructArray


def measured_of(pulses: Pulses, farthest_m: float = 120.0) -> Shots:
    """Return up to three returns for each pulse, determined by its number alone.

    The slots are in any order; some are empty, and some are almost alike.
    """
    count = len(pulses)
    rng = np.random.default_rng(5)
    table = rng.random((4096, 3 * SLOTS))[pulses.number % 4096]
    range_m = 2.0 + (farthest_m - 2.0) * table[:, :SLOTS]
    alike = pulses.number % 7 == 0
    range_m[alike, 1] = range_m[alike, 0] + 0.0004
    range_m[table[:, SLOTS : 2 * SLOTS] < 0.4] = 0.0
    light = np.floor(12.0 * table[:, 2 * SLOTS :]) * 20.0  # so coarse that many values are equal
    rows = np.zeros((count, SLOTS), RETURN_TRUTH_DTYPE)
    rows["range_m"], rows["pulse"] = range_m, pulses.number[:, np.newaxis]
    rows["channel"] = pulses.channel[:, np.newaxis]
    rows["return_number"] = 99
    rows["gps_ns"] = np.rint(1e9 * pulses.time_s)[:, np.newaxis]
    rows["incidence_rad"] = light
    return Shots(pulses, Measured(range_m, light, np.zeros((count, SLOTS))), rows)


def feed(parser: PacketParser, units: Iterable[WireUnit]) -> list[Record]:
    """Return the records of a parser fed as by a recorder whose clock is true time."""
    records: list[Record] = []
    for unit in units:
        rows = np.frombuffer(unit.data, np.uint8).reshape(1, -1)
        records += parser.parse_units(np.array([round(1e9 * unit.time_s)], np.int64), rows)
    return records


def rows_of(records: Sequence[Record], kind: type[ScannerReturns | DeviceClockSamples]) -> StructArray:
    """Return the rows of all records of a type."""
    return np.concatenate([record.rows for record in records if isinstance(record, kind)])


def joined(pieces: Sequence[Pulses]) -> dict[str, NDArray[Any]]:
    """Return the columns of consecutive batches of pulses as one."""
    return {name: np.concatenate([getattr(piece, name) for piece in pieces]) for name in Pulses.__slots__}
