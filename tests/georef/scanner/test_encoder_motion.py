"""Tests encoder motion: rates in closed form, with whole counts, gaps, repeated rows and jumps."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from swath.georef.arrays import FloatArray, Int64Array, StructArray
from swath.georef.records import RETURN_DTYPE
from swath.georef.scanner.encoder_motion import EncoderMotion
from swath.sim.scanners.motions import polygon, sine, triangle, turning

pytestmark = pytest.mark.xdist_group("kernels")

START_NS = 1_400_000_000_000_000_123
BITS_17 = 2 * np.pi / 2**17


def read(
    motion: Any, prf_hz: float, duration_s: float, quantum_rad: float
) -> tuple[StructArray, Int64Array, FloatArray, FloatArray]:
    """Return rows of every pulse, their times (ns), true rates (rad/s) and accelerations (rad/s²)."""
    time_ns = np.rint(np.arange(round(prf_hz * duration_s)) * 1e9 / prf_hz).astype(np.int64)
    swing = motion(1e-9 * time_ns)
    rows = np.zeros(len(time_ns), RETURN_DTYPE)
    rows["encoder_rad"] = np.rint(swing.angle_rad / quantum_rad) * quantum_rad
    rows["pulse_id"] = np.arange(len(rows))
    rows["channel"] = swing.facet
    return rows, START_NS + time_ns, swing.rate_rps, swing.acceleration_rps2


def run(
    rows: StructArray, time_ns: Int64Array, cuts: Any = (), **keys: bool
) -> tuple[StructArray, FloatArray, FloatArray]:
    """Return all rows with their rates, and check that no row is lost or moved."""
    motion = EncoderMotion(**keys)
    parts = zip(np.split(rows, cuts), np.split(time_ns, cuts), strict=True)
    given = [*(motion.feed(*part) for part in parts), motion.flush()]
    out, out_ns, rate, acceleration = (np.concatenate(column) for column in zip(*given, strict=True))
    np.testing.assert_array_equal(out, rows)
    np.testing.assert_array_equal(out_ns, time_ns)
    return out, rate, acceleration


@pytest.mark.slow
@pytest.mark.parametrize("prf_hz", [30_000.0, 150_000.0, 800_000.0])
def test_a_latency_of_a_microsecond_costs_less_than_a_tenth_of_a_count(prf_hz: float) -> None:
    rows, time_ns, rate_rps, acceleration_rps2 = read(sine(np.radians(30.0), 50.0), prf_hz, 0.06, BITS_17)
    _, rate, acceleration = run(rows, time_ns)
    off = np.abs(rate - rate_rps)
    assert 1e-6 * off.max() < 0.1 * BITS_17
    assert np.sqrt(np.mean(off**2)) < 0.2
    assert 2e-9 * np.abs(acceleration - acceleration_rps2).max() < BITS_17  # torsion of the size of FORMULAS 9
    assert np.abs(acceleration_rps2).max() > 5e4


def test_fine_encoder_readings_are_used_unsmoothed() -> None:
    for motion, limit in ((sine(np.radians(30.0), 50.0), 0.05), (triangle(np.radians(30.0), 50.0), 0.5)):
        rows, time_ns, rate_rps, _ = read(motion, 200_000.0, 0.06, 2 * np.pi / 2**24)
        _, rate, _ = run(rows, time_ns)
        inner = slice(100, -100)
        assert np.abs(rate - rate_rps)[inner].max() < limit


def test_pulses_without_returns_and_with_several_give_the_same_motion() -> None:
    rows, time_ns, rate_rps, acceleration_rps2 = read(sine(np.radians(30.0), 50.0), 100_000.0, 0.1, BITS_17)
    rng = np.random.default_rng(8)
    repeats = rng.integers(0, 4, len(rows))
    repeats[3000:3120] = 0  # over a lake there are no returns
    keep = np.repeat(np.arange(len(rows)), repeats)
    _, rate, acceleration = run(rows[keep], time_ns[keep])
    assert 1e-6 * np.abs(rate - rate_rps[keep]).max() < 0.1 * BITS_17
    assert 2e-9 * np.abs(acceleration - acceleration_rps2[keep]).max() < BITS_17
    same = np.flatnonzero(np.diff(keep) == 0)
    np.testing.assert_array_equal(rate[same], rate[same + 1])
    once = np.unique(keep)
    _, alone, _ = run(rows[once], time_ns[once])  # a repeated row has no weight
    np.testing.assert_array_equal(rate, alone[np.searchsorted(once, keep)])


@pytest.mark.parametrize(("facets", "turns_hz"), [(4, 150.0), (40, 30.0)])
def test_rate_of_a_polygon_is_estimated_across_its_facets(facets: int, turns_hz: float) -> None:
    rows, time_ns, rate_rps, _ = read(polygon(turns_hz, facets), 300_000.0, 0.05, BITS_17)
    assert len(np.unique(rows["channel"])) == facets
    _, rate, acceleration = run(rows, time_ns, steady=True, facets=True)
    assert np.abs(rate / rate_rps - 1.0).max() < 0.01
    assert not acceleration.any()
    if facets == 4:  # with four facets its jumps show in the readings too
        _, blind, _ = run(rows, time_ns, steady=True)
        np.testing.assert_array_equal(blind, rate)


@pytest.mark.parametrize("turns_hz", [80.0, -80.0])
def test_a_shaft_turns_on_through_zero(turns_hz: float) -> None:
    rows, time_ns, rate_rps, _ = read(turning(turns_hz), 100_000.0, 0.05, BITS_17)
    _, rate, _ = run(rows, time_ns, steady=True)
    assert np.abs(np.diff(rows["encoder_rad"])).max() > 6.0  # the reading passed zero
    assert np.abs(rate / rate_rps - 1.0).max() < 2e-3


@pytest.mark.parametrize("seed", [1, 2])
def test_results_do_not_depend_on_how_rows_are_cut(seed: int) -> None:
    rng = np.random.default_rng(seed)
    motion, keys = (sine(0.5, 50.0), {}) if seed == 1 else (polygon(100.0, 8), {"steady": True, "facets": True})
    rows, time_ns, _, _ = read(motion, 60_000.0, 0.04, BITS_17)
    keep = np.repeat(np.arange(len(rows)), rng.integers(0, 3, len(rows)))
    keep = keep[(keep < 800) | (keep > 1100)]
    order = np.r_[:600, 700:760, 600:700, 760 : len(keep)]  # one datagram comes late
    rows, time_ns = rows[keep[order]], time_ns[keep[order]]
    _, rate, acceleration = run(rows, time_ns, **keys)
    for cuts in (np.arange(0, len(rows), 7), np.sort(rng.integers(0, len(rows), 30))):
        _, again, bend = run(rows, time_ns, cuts, **keys)
        assert again.tobytes() == rate.tobytes()
        assert bend.tobytes() == acceleration.tobytes()


def test_few_rows_are_delayed_and_stored() -> None:
    rows, time_ns, _, _ = read(sine(0.5, 50.0), 100_000.0, 0.1, BITS_17)
    motion = EncoderMotion()
    for part in np.split(np.arange(len(rows)), 40):
        given = motion.feed(rows[part], time_ns[part])
        assert len(motion._rows) <= 2 * 130 + len(part)
        if part[0] > 1000:
            assert given[1][-1] >= time_ns[part[-1]] - 1_310_000


def test_a_pulse_alone_is_counted() -> None:
    rows, time_ns, _, _ = read(sine(0.5, 50.0), 1000.0, 0.02, BITS_17)  # a millisecond apart: two neighbours
    _, rate, _ = run(rows, time_ns)
    assert np.isfinite(rate).all()
    motion = EncoderMotion()
    given = motion.feed(rows[::4], time_ns[::4]), motion.flush()
    assert motion.lonely == sum(len(part[0]) for part in given) == 5
    assert not any(part[2].any() for part in given)
    assert not len(EncoderMotion().flush()[0])
