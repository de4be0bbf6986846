"""Tests SREP with apparent ranges: a reader written from the page finds every echo's own pulse."""

from __future__ import annotations

import struct

import numpy as np
import pytest

from swath.sim.plan.tables import HostTable
from swath.sim.scanners.line_heads import LineHead
from swath.sim.scanners.srep_wire import SrepWire
from swath.sim.shots import Measured, WireUnit
from swath.sim.truth import RETURN_TRUTH_DTYPE
from tests.sim.srep_spoken import C_MPS, Spoken, joined, measured_count, scanner, speak


def records_of(units: list[WireUnit]) -> list[tuple[int, int, list[int]]]:
    """Return (ticks, encoder, ranges in 0.1 mm) of every record of all datagrams, read as the page defines them."""
    records = []
    for unit in units:
        n, slots, zone = struct.unpack_from("<H", unit.data, 6)[0], unit.data[14], unit.data[15]
        first = struct.unpack_from("<Q", unit.data, 32)[0]
        assert zone == 255
        for pulse in range(n):
            at = 48 + pulse * (8 + 8 * slots)
            ticks, encoder = struct.unpack_from("<Ii", unit.data, at)
            ranges = [struct.unpack_from("<I", unit.data, at + 8 + 8 * slot)[0] for slot in range(slots)]
            records.append((first + ticks, encoder, ranges))
    return records


def resolved(units: list[WireUnit], tick_hz: int, about_m: tuple[float, float]) -> list[tuple[int, int, float]]:
    """Return (ticks, encoder, whole range in m) of every return, with the emission's ticks and encoder.

    The reader knows about where the ground is.
    """
    found = []
    records = records_of(units)
    for place, (ticks, _, ranges) in enumerate(records):
        for apparent in ranges:
            whole = [
                (*records[place - z][:2], 1e-4 * apparent + (ticks - records[place - z][0]) * C_MPS / (2 * tick_hz))
                for z in range(min(place, 40) + 1)
            ]
            fitting = [one for one in whole if apparent and about_m[0] <= one[2] <= about_m[1]]
            assert len(fitting) == bool(apparent)
            found += fitting
    return found


@pytest.mark.parametrize("prf_hz", [50_000.0, 333_333.3, 900_000.0])
def test_apparent_ranges_are_assigned_to_their_pulse(prf_hz: float) -> None:
    table = scanner(zone="apparent", prf_hz=prf_hz, return_slots=3)
    about_m = (1000.0, 1000.0 + 0.9 * C_MPS / (2 * prf_hz))  # less than a zone, so that a reader can tell
    n = 3000
    spoken = speak(table, (2.0, 2.0 + n / prf_hz), ranges_m=about_m)
    found = resolved(spoken.units, table.tick_hz, about_m)
    assert len(found) == len(spoken.truth)
    pulses = joined(spoken.pulses)
    at = np.searchsorted(pulses["number"], spoken.truth["pulse"])
    ticks = [round(k * table.tick_hz / prf_hz) for k in spoken.truth["pulse"].tolist()]
    assert [one[0] for one in found] == ticks
    assert [one[1] for one in found] == pulses["encoder"][at].tolist()
    np.testing.assert_allclose([one[2] for one in found], spoken.truth["range_m"], atol=0.5e-4 + 1e-6)
    rows, _ = spoken.parsed()  # the parser leaves ranges ambiguous and keeps the order
    assert len(rows) == len(spoken.truth)
    assert (rows["mta_zone"] == 255).all()
    said = [1e-4 * apparent for _, _, ranges in records_of(spoken.units) for apparent in ranges if apparent]
    np.testing.assert_allclose(rows["range_m"], said, atol=1e-9)
    measured = measured_count(pulses["number"], 3).sum()
    assert len(spoken.truth) + spoken.wire.lost_echoes == measured
    assert spoken.wire.lost_echoes < 0.2 * measured


def test_of_more_echoes_than_slots_the_latest_are_lost_and_counted() -> None:
    table = scanner(zone="apparent", prf_hz=1_000_000.0, return_slots=1, oscillator={})
    pulses = LineHead(table, "left").pulses(0.0, 6e-6 - 1e-9)
    unambiguous_m = C_MPS / 2e6
    range_m = np.zeros((6, 1))
    range_m[0] = 2.7 * unambiguous_m  # all three echoes are in the record of pulse 2
    range_m[1] = 1.2 * unambiguous_m
    range_m[2] = 0.5 * unambiguous_m
    range_m[3] = 2.0 * unambiguous_m + 2e-5  # with the emission of pulse 5: no range
    spoken = Spoken(table, SrepWire(table, "left", None, HostTable(), 1, noise=False))
    truth = np.zeros((6, 1), RETURN_TRUTH_DTYPE)
    truth["pulse"] = np.arange(6)[:, np.newaxis]
    spoken.add(spoken.wire.units(pulses, Measured(range_m, range_m, range_m), truth))
    spoken.add(spoken.wire.close())
    assert spoken.truth["pulse"].tolist() == [1]
    assert spoken.wire.lost_echoes == 3
    ranges = [ranges[0] for _, _, ranges in records_of(spoken.units)]
    assert ranges == [0, 0, round(0.2 * unambiguous_m * 1e4), 0, 0, 0]


def test_echoes_of_the_last_pulses_are_in_the_last_record() -> None:
    table = scanner(zone="apparent", prf_hz=500_000.0, oscillator={})
    pulses = LineHead(table, "left").pulses(0.0, 4e-6)
    range_m = np.zeros((2, 3))
    range_m[:, 0] = 1000.0, 1100.0
    spoken = Spoken(table, SrepWire(table, "left", None, HostTable(), 1, noise=False))
    spoken.add(spoken.wire.units(pulses, Measured(range_m, range_m, range_m), np.zeros((2, 3), RETURN_TRUTH_DTYPE)))
    assert not spoken.units
    spoken.units += spoken.wire.idle(1.0, 1.25)  # with heartbeats, of the same zone
    spoken.add(spoken.wire.close())
    assert len(spoken.units) == 4
    apparent = round((1000.0 - C_MPS / 1e6) * 1e4)
    assert [ranges for _, _, ranges in records_of(spoken.units)] == [[0, 0, 0], [apparent, 11_000_000, 0]]
    assert len(spoken.truth) == 2
