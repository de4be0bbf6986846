"""Tests ranging: the formula sheet's numbers, and pulses in air against a scanner with known pulses."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from swath.georef.arrays import StructArray
from swath.georef.records import RETURN_DTYPE
from swath.georef.scanner.ranging import PulseRates, RangingError, ZoneResolver
from tests.sim.srep_spoken import Spoken, joined, scanner, speak

pytestmark = pytest.mark.xdist_group("kernels")

C_MPS = 299_792_458.0


# ------------------------------------------------------------------------------------------- the formula sheet's


APPARENT_M = 1e-3


def longer_m(ticks: int, tick_hz: int, group_index: float, about_m: float) -> float:
    """Return by how many metres an echo's range grows if it belongs to the pulse `ticks` of the counter earlier."""
    rows = np.zeros(2, RETURN_DTYPE)
    rows["device_time_ns"] = 10**12, 10**12 + ticks * 10**9 // tick_hz
    rows["pulse_id"], rows["mta_zone"] = (7, 8), 255
    rows["range_m"][1], rows["number_of_returns"][1] = APPARENT_M, 1
    resolver = ZoneResolver(3000.0, about_m, group_index=group_index, tick_hz=tick_hz, slanted=False)
    (found,) = fed(resolver, rows)
    assert (found["pulse_id"], found["mta_zone"]) == (7, 1)
    return float(found["range_m"]) - APPARENT_M


@pytest.mark.slow
@pytest.mark.parametrize(
    ("flight_us", "group_index", "range_m", "within_m"),
    [
        (6.67128190396, 1.0, 1000.0, 1e-8),
        (6.67128190396, 1.000276394225, 1000.0 - 0.276317853, 1e-8),
        (1e-3, 1.0, 0.149896229, 1e-12),
        (0.1, 1.0, 14.9896229, 5e-9),  # the ambiguity of a tone of 10 MHz
        (5.338500646, 1.000276394225, 800.0, 1e-7),  # a range gate opens at this time
        (10.00968871, 1.000276394225, 1500.0, 1e-6),  # and closes at this time
    ],
)
def test_ranges_match_the_formula_sheet(flight_us: float, group_index: float, range_m: float, within_m: float) -> None:
    """Ranges follow from whole nanoseconds and the fraction of the range."""
    ticks = round(1e3 * flight_us)
    wanted_m = range_m * ticks / (1e3 * flight_us)
    assert longer_m(ticks, 10**9, group_index, range_m) == pytest.approx(wanted_m, abs=within_m)


@pytest.mark.parametrize(
    ("prf_hz", "range_m"), [(66_700, 2247.319775), (100_000, 1498.96229), (150_000, 999.3081933), (500_000, 299.792458)]
)
def test_zone_lengths_match_the_formula_sheet(prf_hz: int, range_m: float) -> None:
    assert longer_m(1000, 1000 * prf_hz, 1.0, range_m) == pytest.approx(range_m, abs=5e-7)
    assert longer_m(1000, 1000 * prf_hz, 1.0003, range_m) * 1.0003 == pytest.approx(range_m, abs=5e-7)


def test_the_zone_of_a_range_matches_the_formula_sheet() -> None:
    ticks = 10**11 + 1000 * np.arange(20)  # 150 kHz by a counter of 150 MHz
    rows = np.zeros(20, RETURN_DTYPE)
    rows["device_time_ns"] = [int(tick) * 10**9 // 150_000_000 for tick in ticks]
    rows["pulse_id"], rows["number_of_returns"], rows["mta_zone"] = np.arange(20), 1, 255
    rows["range_m"] = 780.9418067
    found = fed(ZoneResolver(3000.0, 1780.0, tick_hz=150_000_000, slanted=False), rows)
    assert set(found["mta_zone"].tolist()) == {1}  # k = 2
    np.testing.assert_allclose(found["range_m"], 1780.25, rtol=0, atol=5e-8)


@pytest.mark.parametrize(("range_m", "zone"), [(0.01, 0), (299.79, 0), (299.80, 1), (1000.0, 3)])
def test_zones_at_500_khz_match_the_formula_sheet(range_m: float, zone: int) -> None:
    rows, true = train(lambda pulse, angle: [range_m], 50)
    found = fed(ZoneResolver(2000.0, range_m, slanted=False), rows)
    assert_true(found, true)
    assert set(found["mta_zone"][:-3].tolist()) == {zone}  # echoes of the last pulses stand in the last record


# -------------------------------------------------------------------------------------------------- a made train


def train(
    range_of: Any,
    n: int,
    period_ns: Any = 2000,
    *,
    per_datagram: int = 100,
    every_pulse: bool = False,
    half_angle_rad: float = 0.5,
) -> tuple[StructArray, StructArray]:
    """Return records of a scanner that gives apparent ranges, and the same returns as they truly are, by emission.

    ``range_of(pulse, angle)`` gives the list of a pulse's ranges, m; ``period_ns`` is one period or (n,) of them.
    """
    steps = np.broadcast_to(np.asarray(period_ns, np.int64), (n,))
    times = 10**12 + np.concatenate([[0], np.cumsum(steps[1:])])
    angle = half_angle_rad * np.sin(2 * np.pi * 50.0 * 1e-9 * (times - times[0]) + 0.3)
    ids = (np.arange(n) // per_datagram + 7 << 16) + np.arange(n) % per_datagram
    true, said = [], []
    for pulse in range(n):
        ranges = sorted(range_of(pulse, angle[pulse]))
        for number, range_m in enumerate(ranges, 1):
            echo_ns = times[pulse] + 2e9 * range_m / C_MPS
            record = int(np.searchsorted(times, echo_ns, side="right")) - 1
            apparent = range_m - (times[record] - times[pulse]) * 1e-9 * C_MPS / 2
            zone, rows = record - pulse, (number, len(ranges))
            true.append((0, times[pulse], range_m, angle[pulse], ids[pulse], pulse, 0, 0, *rows, zone, 0))
            said.append((record, (0, times[record], apparent, angle[record], ids[record], pulse, 0, 0, 1, 1, 255, 0)))
    if every_pulse:
        said += [(i, (0, times[i], 0.0, angle[i], ids[i], 0, 0, 0, 0, 0, 255, 0)) for i in range(n)]
    said = [row for row in said if row[0] < n - 1 or row[1][2] < 1e9]
    said.sort(key=lambda row: (row[0], row[1][2]))
    return np.array([row for _, row in said], RETURN_DTYPE), np.array(true, RETURN_DTYPE)


FIRST = {"mta_gap": 3}  # echoes in records of the first three pulses have unknown emissions


def flat(height_m: float = 1000.0) -> Any:
    return lambda pulse, angle: [height_m / math.cos(angle)]


def fed(resolver: ZoneResolver, rows: StructArray, cuts: Any = ()) -> StructArray:
    parts = [resolver.feed(part) for part in np.split(rows, cuts)]
    return np.concatenate([*parts, resolver.flush()])


def assert_true(found: StructArray, true: StructArray) -> None:
    """Assert that each row has the true emission, encoder, zone and number; its intensity identifies the pulse."""
    key = {(int(row["pulse_id"]), int(row["return_number"])): row for row in true}
    wanted = np.array([key[int(row["pulse_id"]), int(row["return_number"])] for row in found], RETURN_DTYPE)
    for name in ("device_time_ns", "pulse_id", "intensity", "mta_zone", "return_number", "number_of_returns"):
        np.testing.assert_array_equal(found[name], wanted[name], err_msg=name)
    np.testing.assert_allclose(found["range_m"], wanted["range_m"], rtol=0, atol=1e-6)
    np.testing.assert_allclose(found["encoder_rad"], wanted["encoder_rad"], rtol=0, atol=1e-6)


def test_continuity_assigns_every_pulse_its_zone() -> None:
    rows, true = train(flat(), 2500)
    resolver = ZoneResolver(2000.0, 960.0)
    found = fed(resolver, rows)
    assert_true(found, true)
    assert set(found["mta_zone"][:-3].tolist()) == {3}  # echoes of the last pulses stand in the last record
    assert resolver.counts == FIRST
    assert len(found) == len(rows) - 3
    assert (np.diff(found["pulse_id"].astype(np.int64)) > 0).all()


def test_the_zone_changes_with_the_scan_angle_and_the_ground() -> None:
    def hills(pulse: int, angle: float) -> list[float]:
        return [(900.0 + 350.0 * math.sin(pulse / 400.0)) / math.cos(angle)]

    rows, true = train(hills, 2500, half_angle_rad=0.7)
    resolver = ZoneResolver(2500.0, 900.0)
    found = fed(resolver, rows)
    assert_true(found, true)
    assert len(np.unique(found["mta_zone"])) > 3
    assert sum(resolver.counts.values()) < 12  # an echo that coincides with an emission may be missing


def test_returns_of_one_pulse_get_the_same_zone() -> None:
    def forest(pulse: int, angle: float) -> list[float]:
        ground = 890.0 + 0.004 * pulse  # around the edge of the third zone, 899.4 m
        return [ground - above for above in (0.0, 2.5, 14.0)[: 1 + pulse % 3]]

    rows, true = train(forest, 3000)
    found = fed(ZoneResolver(2000.0, 880.0, slanted=False), rows)
    assert_true(found, true)
    both = np.flatnonzero(np.diff(found["mta_zone"].astype(int)) * (np.diff(found["pulse_id"].astype(int)) == 0))
    assert len(both) > 300  # pulses whose echoes stand in two records
    assert len(found) == len(rows) - 3


def test_jitter_is_handled_by_each_emission_time() -> None:
    steps = np.random.default_rng(3).integers(1900, 2100, 2500)
    rows, true = train(flat(1234.5), 2500, steps, every_pulse=True)
    resolver = ZoneResolver(2500.0, 1200.0)
    found = fed(resolver, rows)
    assert_true(found, true)
    assert len(found) == len(true)
    assert not resolver.counts


def test_missing_pulses_are_inferred_only_from_neighbours_that_determine_them() -> None:
    def sparse(pulse: int, angle: float) -> list[float]:
        return [] if pulse % 23 in (5, 6) else [1000.0 / math.cos(angle)]

    even, true = train(sparse, 2500)
    resolver = ZoneResolver(2000.0, 1000.0)
    found = fed(resolver, even)
    assert_true(found, true)
    assert len(found) == len(even) - 3
    assert resolver.counts == FIRST
    steps = np.random.default_rng(3).integers(1900, 2100, 2500)
    jittered, true = train(sparse, 2500, steps)
    resolver = ZoneResolver(2000.0, 1000.0)
    found = fed(resolver, jittered)
    assert_true(found, true)
    assert resolver.counts["mta_gap"] == len(jittered) - len(found)
    assert 0.05 < resolver.counts["mta_gap"] / len(jittered) < 0.1
    whole, true = train(sparse, 2500, steps, every_pulse=True)
    resolver = ZoneResolver(2000.0, 1000.0)
    assert_true(fed(resolver, whole), true)
    assert not resolver.counts


def test_an_ambiguous_pulse_between_uneven_tick_steps_is_counted_as_a_gap() -> None:
    def sparse(pulse: int, angle: float) -> list[float]:
        return [] if pulse % 23 == 5 else [1000.0]

    ticks = np.floor(np.arange(2501) * 100 / 9).astype(int)  # 900 kHz at 10 MHz: 11, 11, 11, …, 12
    rows, true = train(sparse, 2500, 100 * np.diff(ticks), half_angle_rad=0.1)
    resolver = ZoneResolver(2000.0, 1000.0, tick_hz=10_000_000, slanted=False)
    assert_true(fed(resolver, rows), true)
    assert 6 < resolver.counts["mta_gap"] < 60  # if two steps are 23 ticks, the pulse between is unknown


def test_a_lost_datagram_costs_only_earlier_pulses() -> None:
    rows, true = train(flat(), 3000)
    datagram = rows["pulse_id"] >> 16
    resolver = ZoneResolver(2000.0, 1000.0)
    found = fed(resolver, rows[datagram != 20])
    assert_true(found, true)
    assert resolver.counts == {"mta_gap": 6}  # zone 3 concerns three records after it too
    assert len(found) == len(rows) - np.count_nonzero(datagram == 20) - 6


def test_a_late_datagram_only_breaks_the_pulse_train() -> None:
    rows, true = train(flat(), 3000)
    datagram = (rows["pulse_id"] >> 16).astype(int)
    order = np.argsort(np.where(datagram == 20, 21.5, datagram), kind="stable")
    resolver = ZoneResolver(2000.0, 1000.0)
    found = fed(resolver, rows[order])
    assert_true(found, true)
    assert resolver.counts == {"mta_gap": 12}


@pytest.mark.parametrize("seed", [1, 2])
def test_results_do_not_depend_on_how_rows_are_cut(seed: int) -> None:
    rng = np.random.default_rng(seed)

    def forest(pulse: int, angle: float) -> list[float]:
        return [880.0 + 0.03 * pulse - above for above in (0.0, 2.5, 14.0)[: pulse * 7 % 4]]

    rows, _ = train(forest, 900, rng.integers(1990, 2010, 900) if seed == 2 else 2000)
    rows["mta_zone"][600:700] = 3  # a stretch with a known zone
    whole = fed(ZoneResolver(2000.0, 870.0, slanted=False), rows)
    known = whole[np.isin(whole["pulse_id"], rows["pulse_id"][600:700])]
    assert len(known) >= 100
    for cuts in (np.arange(1, len(rows)), np.sort(rng.integers(0, len(rows), 40))):
        again = fed(ZoneResolver(2000.0, 870.0, slanted=False), rows, cuts)
        np.testing.assert_array_equal(again, whole)


def test_unambiguous_ranges_pass_unchanged() -> None:
    _, true = train(flat(), 500)
    resolver = ZoneResolver(2000.0)
    assert resolver.feed(true) is true
    assert not len(resolver.flush())


def test_terrain_has_precedence_over_continuity() -> None:
    def cliff(pulse: int, angle: float) -> list[float]:
        return [(1000.0 if pulse // 500 % 2 else 870.0) / math.cos(angle)]

    rows, true = train(cliff, 3000)
    height_m = np.where(rows["intensity"] // 500 % 2, 990.0, 880.0)
    resolver = ZoneResolver(2000.0)
    found = np.concatenate([resolver.feed(rows, height_m / np.cos(rows["encoder_rad"])), resolver.flush()])
    assert_true(found, true)
    assert len(found) == len(rows) - resolver.counts["mta_gap"] - resolver.counts["mta_ambiguous"]
    assert sum(resolver.counts.values()) < 20
    alone = ZoneResolver(2000.0, 870.0)
    assert len(fed(alone, rows)) < 0.6 * len(rows)  # 130 m are 0.43 of a zone, so many are ambiguous and counted
    assert alone.counts["mta_ambiguous"] > 0.4 * len(rows)


def test_ranges_between_zones_are_dropped() -> None:
    zone_m = 299.792458  # 500 kHz
    rows, true = train(lambda pulse, angle: [1000.0], 500, every_pulse=True)
    for off, accepted in ((0.38, True), (-0.38, True), (0.42, False), (-0.42, False)):
        resolver = ZoneResolver(2500.0, 1000.0 + off * zone_m, slanted=False)
        found = fed(resolver, rows)
        assert len(found) == (len(true) if accepted else 0)
        assert resolver.counts["mta_ambiguous"] == (0 if accepted else len(true))
    nothing = ZoneResolver(2500.0)
    assert not len(fed(nothing, rows))
    assert nothing.counts == {"mta_ambiguous": len(true)}


def test_echoes_in_the_flash_of_a_later_pulse_are_resolved() -> None:
    zone_m = 299.792458  # 500 kHz
    rows, true = train(lambda pulse, angle: [3 * zone_m + (2.0 if pulse % 10 == 5 else 20.0)], 1000)
    resolver = ZoneResolver(2500.0, 3 * zone_m, slanted=False, blind_m=5.0)
    found = fed(resolver, rows)
    assert_true(found, true)
    assert resolver.counts["mta_ambiguous"] == 100
    assert (found["range_m"] > 3 * zone_m + 5.0).all()


def test_fractional_nanosecond_ticks_are_supported() -> None:
    # 70 MHz: a tick is 14.29 ns; the floor of nanoseconds would cost up to 15 cm
    ticks = 10**11 + 150 * np.arange(2000)
    rows = np.zeros(2000, RETURN_DTYPE)
    rows["device_time_ns"] = [int(tick) * 10**9 // 70_000_000 for tick in ticks]
    rows["pulse_id"], rows["number_of_returns"], rows["mta_zone"] = np.arange(2000), 1, 255
    zone_m = 150 * C_MPS / (2 * 70e6)
    rows["range_m"] = 1000.0 - 3 * zone_m
    found = fed(ZoneResolver(2000.0, 1000.0, tick_hz=70_000_000, slanted=False), rows)
    assert len(found) == 1997
    np.testing.assert_allclose(found["range_m"], 1000.0, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(found["device_time_ns"], rows["device_time_ns"][:1997])
    floored = fed(ZoneResolver(2000.0, 1000.0, slanted=False), rows)
    assert np.abs(floored["range_m"] - 1000.0).max() > 0.05


def test_a_laser_pause_leaves_no_gap_if_every_pulse_is_recorded() -> None:
    steps = np.full(1000, 2000)
    steps[500] = 2000 * 3 + 900  # 3.45 periods, between two datagrams
    rows, true = train(flat(1234.5), 1000, steps, every_pulse=True)
    resolver = ZoneResolver(2500.0, 1200.0, every_pulse=True)
    found = fed(resolver, rows)
    assert_true(found, true)
    assert len(found) == len(true)
    assert not resolver.counts
    unsure = ZoneResolver(2500.0, 1200.0)
    assert_true(fed(unsure, rows), true)
    assert set(unsure.counts) == {"mta_gap"}  # the time does not reveal how many pulses were lost


def test_context_rows_are_not_counted() -> None:
    rows, _ = train(flat(), 300)
    resolver = ZoneResolver(2000.0, 1000.0)
    rows["flags"][:2] = 128
    found = resolver.feed(rows)
    assert resolver.counts == {"mta_gap": FIRST["mta_gap"] - 2}
    assert resolver.waiting == len(rows) - 3 - len(found) > 0
    assert len(resolver.flush()) == len(rows) - 3 - len(found)
    assert resolver.waiting == 0


@pytest.mark.parametrize("cuts", [(), (1, 399, 400, 401, 700)])
def test_the_tick_rate_follows_the_header(cuts: tuple[int, ...]) -> None:
    """A device of 70 MHz is followed by another of 150 MHz, whose counter starts again."""
    rows, zones_m = np.zeros(800, RETURN_DTYPE), []
    for part, hz in ((slice(0, 400), 70_000_000), (slice(400, 800), 150_000_000)):
        ticks = 10**11 + hz // 500_000 * np.arange(400)
        rows["device_time_ns"][part] = [int(tick) * 10**9 // hz for tick in ticks]
        zones_m.append(hz // 500_000 * C_MPS / (2 * hz))
        rows["range_m"][part] = 1000.0 - 3 * zones_m[-1]
    rows["pulse_id"], rows["number_of_returns"], rows["mta_zone"] = np.arange(800) + 9, 1, 255
    rates = PulseRates()
    rates.note(0, 500e3, 70_000_000)
    rates.note(409, 500e3, 150_000_000)
    resolver = ZoneResolver(2000.0, 1000.0, slanted=False, rates=rates)
    found = fed(resolver, rows, cuts)
    assert resolver.counts == {"mta_gap": 6}  # three at each of two beginnings
    np.testing.assert_allclose(found["range_m"], 1000.0, rtol=0, atol=1e-9)
    wanted = np.concatenate([rows["device_time_ns"][:397], rows["device_time_ns"][400:797]])
    np.testing.assert_array_equal(found["device_time_ns"], wanted)


def test_ticks_finer_than_device_times_give_gaps() -> None:
    rows, _ = train(flat(), 300, every_pulse=True)
    rates = PulseRates()
    rates.note(0, 0.0, 2_000_000_000)
    resolver = ZoneResolver(2000.0, 1000.0, rates=rates)
    assert not len(fed(resolver, rows))
    assert resolver.counts == {"mta_gap": np.count_nonzero(rows["number_of_returns"])}


# ---------------------------------------------------------------------------------------- the virtual aircraft's


@pytest.mark.parametrize("prf_hz", [250_000.0, 800_000.0])
def test_apparent_ranges_of_a_recording_are_assigned_to_their_pulse(prf_hz: float) -> None:
    table = scanner(zone="apparent", prf_hz=prf_hz, return_slots=3)
    zone_m = C_MPS / (2 * prf_hz)
    spoken: Spoken = speak(table, (2.0, 2.0 + 3000 / prf_hz), ranges_m=(1000.0, 1000.0 + 0.5 * zone_m))
    rows, _ = spoken.parsed()
    resolver = ZoneResolver(2000.0, 1000.0 + 0.25 * zone_m, slanted=False, tick_hz=table.tick_hz)
    found = fed(resolver, rows)
    pulses = joined(spoken.pulses)
    number = np.searchsorted(pulses["number"], spoken.truth["pulse"])
    truth = spoken.truth[np.lexsort((spoken.truth["range_m"], number))]
    ticks = np.array([round(k * table.tick_hz / prf_hz) for k in truth["pulse"].tolist()])
    times = ticks * (10**9 // table.tick_hz)
    wanted = {(int(t), round(1e3 * float(r))) for t, r in zip(times, truth["range_m"], strict=True)}
    got = [(int(t), round(1e3 * float(r))) for t, r in zip(found["device_time_ns"], found["range_m"], strict=True)]
    near = sum(1 for t, r in got if {(t, r), (t, r - 1), (t, r + 1)} & wanted)
    assert near == len(found)
    assert len(found) + sum(resolver.counts.values()) == len(rows)
    if prf_hz == 250_000.0:  # a period of 40 whole ticks, so every pulse is known
        assert len(found) > 0.99 * len(rows)


@pytest.mark.parametrize(
    ("keys", "says"),
    [
        ({"tick_hz": 2_000_000_000}, "tick_hz: got 2000000000"),
        ({"edge_share": 0.5}, "edge_share: got 0.5"),
        ({"range_max_m": math.inf}, "range_max_m: got inf"),
    ],
)
def test_impossible_range_limits_are_refused(keys: dict[str, Any], says: str) -> None:
    with pytest.raises(RangingError, match=says):
        ZoneResolver(**({"range_max_m": 2000.0} | keys))
