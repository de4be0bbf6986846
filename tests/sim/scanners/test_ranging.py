"""Tests the ranging receiver: the conventions' equation gives the true range; intensities, noise, widths."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy import stats

from swath.georef.arrays import FloatArray, Int64Array
from swath.sim.atmosphere import Air
from swath.sim.plan.errors import PlanError
from swath.sim.plan.tables import AtmosphereTable, ScannerTable
from swath.sim.scanners.ranging import IntensityScale, Ranging, packed
from swath.sim.shots import Echoes, Measured, Pulses
from swath.sim.truth import RETURN_TRUTH_DTYPE

CLEAR = AtmosphereTable(visibility_km=1e9)
IBRC = {"intensity": [0.0, 500.0, 2000.0], "correction_m": [0.04, -0.01, -0.05]}
SHOTS_M = np.array([[300.0, 420.5, np.nan], [1000.0, np.nan, np.nan], [2400.0, 2401.0, 2403.0]])


def scanner(**keys: Any) -> ScannerTable:
    return ScannerTable.model_validate({"range_min_m": 1.0, "range_max_m": 5000.0} | keys)


def pulses_of(number: Int64Array, channel: Any = 0) -> Pulses:
    n = len(number)
    channels = np.broadcast_to(np.asarray(channel, np.uint16), (n,))
    return Pulses(
        number, 1e-5 * number.astype(np.float64), number, channels, np.zeros((n, 3)), np.zeros((n, 3)), np.zeros(n)
    )


def echoes_of(range_m: FloatArray, reflectance: Any = 0.4, incidence_deg: Any = 0.0) -> Echoes:
    shape = range_m.shape
    there = np.isfinite(range_m)
    share = np.where(there, np.broadcast_to(reflectance, shape), 0.0)
    angle = np.where(there, np.radians(np.broadcast_to(incidence_deg, shape)), 0.0)
    return Echoes(range_m, share, angle, there.astype(np.uint8))


def measure(
    table: ScannerTable, echoes: Echoes, *, air: Air | None = None, noise: bool = False, **keys: Any
) -> Measured:
    ranging = Ranging(table, air or Air(CLEAR, 1064.0), 1, "left", noise, keys.get("intensity"))
    shape = echoes.range_m.shape
    pulses = keys.get("pulses", pulses_of(np.arange(shape[0])))
    return ranging.measure(pulses, echoes, np.full(shape[0], 1500.0), np.full(shape, 400.0))


# ---------------------------------------------------------------------------------------------- CONVENTIONS


@pytest.mark.parametrize("ranges", ["corrected", "vacuum"])
@pytest.mark.parametrize(
    "errors",
    [
        {},
        {"true": {"range_offset_m": 0.35}},
        {"true": {"range_scale_ppm": -60.0}},
        {"ibrc": IBRC},
        {"true": {"range_offset_m": 0.35, "range_scale_ppm": 40.0}, "ibrc": IBRC},
    ],
)
def test_the_conventions_recover_the_true_range(errors: dict[str, Any], ranges: str) -> None:
    table = scanner(**errors)
    air = Air(AtmosphereTable.model_validate({"ranges": ranges, "visibility_km": 1e9}), 1064.0)
    measured = measure(table, echoes_of(SHOTS_M), air=air)
    there = np.isfinite(SHOTS_M)
    said, intensity = measured.range_m[there], measured.intensity[there]
    if ranges == "vacuum":  # corrected before the equation, as CONVENTIONS has it
        index = air.group_refractivity_ppm(np.full(len(said), 1500.0), np.full(len(said), 400.0))
        assert (index > 200.0).all()
        said = said / (1 + 1e-6 * index)
    true = table.true
    rho = (1 + 1e-6 * true.range_scale_ppm) * said + true.range_offset_m
    if table.ibrc is not None:
        rho = rho - np.interp(intensity, table.ibrc.intensity, table.ibrc.correction_m)
    np.testing.assert_allclose(rho, SHOTS_M[there], atol=1e-9)
    assert (measured.range_m[~there] == 0.0).all()


def test_intensity_corrections_hold_at_the_middle_the_ends_and_beyond() -> None:
    """An echo brighter than the table's last entry is corrected like that entry, a darker one like the first."""
    table = scanner(ibrc={"intensity": [400.0, 2000.0], "correction_m": [0.04, -0.04]})
    range_m = np.full((4, 1), 1000.0)
    measured = measure(table, echoes_of(range_m, np.array([[0.05], [0.1], [0.3], [1.0]])))
    assert measured.intensity[:, 0].tolist() == [200.0, 400.0, 1200.0, 4000.0]
    np.testing.assert_allclose(measured.range_m[:, 0] - 1000.0, [0.04, 0.04, 0.0, -0.04], atol=1e-12)


def test_a_correction_that_is_subtracted_belongs_to_a_range_that_is_too_long() -> None:
    """In ρ = … − ibrc(I) bright echoes, which trigger early, are too short and have negative entries.

    Dark ones trigger late and have positive entries.
    """
    table = scanner(ibrc={"intensity": [0.0, 4000.0], "correction_m": [0.10, -0.10]})
    bright, dark = measure(table, echoes_of(np.full((2, 1), 1000.0), np.array([[1.0], [0.01]]))).range_m[:, 0]
    assert bright == pytest.approx(999.9, abs=1e-9)
    assert dark == pytest.approx(1000.098, abs=1e-9)


def test_each_beam_of_a_spinning_head_has_its_own_correction() -> None:
    beam = [{"channel": 3, "range_m": 0.05}, {"channel": 5, "range_m": -0.02}]
    table = scanner(kind="vlp16", beam=beam, reference_range_m=50.0, true={"range_offset_m": 0.1})
    pulses = pulses_of(np.arange(4), [3, 4, 5, 15])
    measured = measure(table, echoes_of(np.full((4, 1), 60.0)), pulses=pulses)
    np.testing.assert_allclose(measured.range_m[:, 0] + 0.1, [59.95, 60.0, 60.02, 60.0], atol=1e-12)
    assert measured.intensity.tolist() == [[28.0]] * 4  # 100 · 0.4 · (50/60)²


# ---------------------------------------------------------------------------------------------- what is seen


def test_intensity_follows_reflectance_distance_and_air() -> None:
    """Twice the distance gives a quarter. By Beer and Lambert, ln 2 of extinction there and back leaves half."""
    range_m = np.array([[1000.0], [2000.0], [500.0], [10.0]])
    measured = measure(scanner(), echoes_of(range_m, np.array([[1.0], [1.0], [0.25], [1.0]])))
    assert measured.intensity[:, 0].tolist() == [4000.0, 1000.0, 4000.0, 65_535.0]
    sight_km = 12.0
    per_m = 3.912 / (1e3 * sight_km) * (550 / 1064) ** 1.3  # Koschmieder, Kruse
    hazy = measure(scanner(), echoes_of(range_m, 1.0), air=Air(AtmosphereTable(visibility_km=sight_km), 1064.0))
    assert hazy.intensity[0, 0] == round(4000 * np.exp(-2 * per_m * 1000))
    assert hazy.intensity[0, 0] < 0.8 * 4000


def test_a_receiver_may_use_another_intensity_scale() -> None:
    measured = measure(
        scanner(), echoes_of(np.full((2, 1), 1000.0), np.array([[0.5], [5.0]])), intensity=IntensityScale(200.0, 255.0)
    )
    assert measured.intensity[:, 0].tolist() == [100.0, 255.0]


def test_echoes_out_of_limits_give_no_return_and_slots_keep_their_places() -> None:
    table = scanner(range_min_m=100.0, range_max_m=2000.0)
    range_m = np.array([[99.0, 500.0, 1999.0], [100.5, 1000.0, 1500.0], [300.0, 400.0, 2001.0]])
    reflectance = np.array([[0.4, 0.4, 0.4], [0.4, 0.004, 0.4], [1e-9, 0.4, 0.4]])
    measured = measure(table, echoes_of(range_m, reflectance))
    seen = np.array([[False, True, True], [True, False, True], [False, True, False]])
    np.testing.assert_array_equal(measured.range_m, np.where(seen, range_m, 0.0))
    np.testing.assert_array_equal(measured.intensity > 0, seen)
    np.testing.assert_array_equal(measured.pulse_width_ns > 0, seen)


def test_packed_slots_keep_their_truth() -> None:
    range_m = np.array([[0.0, 500.0, 700.0], [100.0, 0.0, 150.0], [9.0, 8.0, 0.0], [1.0, 2.0, 3.0], [0.0, 0.0, 0.0]])
    measured = Measured(range_m, range_m * 2, range_m * 3)
    truth = np.zeros(range_m.shape, RETURN_TRUTH_DTYPE)
    truth["range_m"], truth["return_number"] = range_m, [1, 2, 3]
    tight, rows = packed(measured, truth)
    expected = [[500.0, 700.0, 0.0], [100.0, 150.0, 0.0], [8.0, 9.0, 0.0], [1.0, 2.0, 3.0], [0.0, 0.0, 0.0]]
    assert tight.range_m.tolist() == expected
    np.testing.assert_array_equal(tight.intensity, 2 * tight.range_m)
    np.testing.assert_array_equal(tight.pulse_width_ns, 3 * tight.range_m)
    np.testing.assert_array_equal(rows["range_m"], tight.range_m)
    assert rows["return_number"].tolist() == [[1, 2, 3]] * 5
    assert measured.range_m[0, 0] == 0.0  # the input is not changed


def test_a_footprint_on_a_slope_lengthens_the_echo() -> None:
    """At 1000 m, 0.5 mrad and 45° the footprint is 0.5 m deep, which adds 2 · 0.5 m / c = 3.336 ns."""
    table = scanner(pulse_ns=4.0, divergence_mrad=0.5)
    measured = measure(table, echoes_of(np.full((2, 1), 1000.0), 1.0, np.array([[0.0], [45.0]])))
    np.testing.assert_allclose(measured.pulse_width_ns[:, 0], [4.0, 4.0 + 3.3356409520], atol=1e-9)
    steep = measure(table, echoes_of(np.full((1, 1), 1000.0), 1.0, 90.0))
    assert np.isfinite(steep.pulse_width_ns).all()


# ---------------------------------------------------------------------------------------------- noise


def noise_of(reflectance: float, incidence_deg: float, n: int, **keys: Any) -> FloatArray:
    noise = {"sigma_m": 0.02, "footprint": 0.3}
    table = scanner(range_noise=noise, divergence_mrad=0.4, **keys)
    echoes = echoes_of(np.full((n, 2), 1000.0), reflectance, incidence_deg)
    return measure(table, echoes, noise=True).range_m - 1000.0


@pytest.mark.parametrize(
    ("reflectance", "incidence_deg", "sigma_m"),
    [
        (0.1, 0.0, 0.02),
        (0.4, 0.0, 0.01),
        (0.025, 0.0, 0.04),
        (0.4, 60.0, np.hypot(0.01, 0.3 * 0.4 * np.tan(np.pi / 3))),
    ],
)
def test_range_noise_is_normal_and_depends_on_intensity_and_incidence(
    reflectance: float, incidence_deg: float, sigma_m: float
) -> None:
    n = 50_000
    drawn = noise_of(reflectance, incidence_deg, n)
    for column in drawn.T:
        assert abs(column.mean()) < 4 * sigma_m / np.sqrt(n)
        assert abs(column.std() / sigma_m - 1) < 4 / np.sqrt(2 * n)
        assert stats.kstest(column / sigma_m, "norm").pvalue > 1e-3


def test_noise_of_successive_returns_is_uncorrelated() -> None:
    n = 50_000
    drawn = noise_of(0.1, 0.0, n)
    assert abs(np.corrcoef(drawn[:, 0], drawn[:, 1])[0, 1]) < 4 / np.sqrt(n)
    for lag in (1, 2, 16, 256):
        assert abs(np.corrcoef(drawn[lag:, 0], drawn[:-lag, 0])[0, 1]) < 4 / np.sqrt(n - lag)
    assert len(np.unique(drawn)) == drawn.size


def test_noise_does_not_depend_on_how_pulses_are_batched() -> None:
    echoes = echoes_of(np.full((1000, 3), 800.0), 0.2)
    table = scanner()

    def said(start: int, stop: int, seed: int = 1, name: str = "left") -> FloatArray:
        ranging = Ranging(table, Air(CLEAR, 1064.0), seed, name, True)
        part = echoes_of(echoes.range_m[start:stop], 0.2)
        pulses = pulses_of(7_000_000_000 + np.arange(start, stop))
        return ranging.measure(pulses, part, np.full(stop - start, 1000.0), np.full((stop - start, 3), 200.0)).range_m

    whole = said(0, 1000)
    np.testing.assert_array_equal(np.concatenate([said(0, 1), said(1, 640), said(640, 1000)]), whole)
    for other in (said(0, 1000, seed=2), said(0, 1000, name="right")):
        assert abs(np.corrcoef(whole.ravel() - 800, other.ravel() - 800)[0, 1]) < 4 / np.sqrt(3000)


def test_without_noise_ranges_are_exact() -> None:
    measured = measure(scanner(range_noise={"sigma_m": 5.0}), echoes_of(SHOTS_M))
    there = np.isfinite(SHOTS_M)
    np.testing.assert_array_equal(measured.range_m[there], SHOTS_M[there])


# ---------------------------------------------------------------------------------------------- what cannot be


@pytest.mark.parametrize(
    ("keys", "error"),
    [
        ({"range_min_m": 50.0, "range_max_m": 50.0}, r"range_min_m: got 50, want less than range_max_m = 50"),
        (
            {"ibrc": {"intensity": [0.0, 1.0, 2.0], "correction_m": [0.0, 1.0]}},
            r"ibrc\.correction_m: has 2 values, want 3: one for each of ibrc\.intensity",
        ),
        (
            {"ibrc": {"intensity": [0.0, 5.0, 5.0], "correction_m": [0.0, 1.0, 2.0]}},
            r"ibrc\.intensity: 5 follows 5, want increasing values",
        ),
        ({"true": {"range_scale_ppm": -1e6}}, r"true\.range_scale_ppm: got -1e\+06, want -100000 to 100000"),
    ],
)
def test_impossible_values_are_refused_by_their_key(keys: dict[str, Any], error: str) -> None:
    with pytest.raises(PlanError, match=r"^scanner\.left\." + error):
        Ranging(scanner(**keys), Air(CLEAR, 1064.0), 1, "left", False)


# ---------------------------------------------------------------------------------------------- places in the footprint


def test_a_place_in_the_footprint_is_anywhere_on_its_disc() -> None:
    """An evenly lit disc of 0.4 mrad has a standard deviation of a quarter of that along any axis."""
    n = 50_000
    direction = np.array([[0.3, -0.5, -0.81], [0.95, 0.1, -0.3]])
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    table = scanner(range_noise={"drawn": True}, divergence_mrad=0.4)
    ranging = Ranging(table, Air(CLEAR, 1064.0), 1, "left", True)
    for axis in direction:
        found = ranging.aside(pulses_of(np.arange(n)), np.tile(axis, (n, 1)))
        assert found is not None
        np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1.0, atol=1e-12)
        apart = found - axis
        assert np.linalg.norm(apart, axis=1).max() <= 2.0001e-4
        across = np.cross(axis, [0.0, 0.0, 1.0])
        across /= np.linalg.norm(across)
        for aside in (across, np.cross(axis, across)):
            assert abs((apart @ aside).std() / 1e-4 - 1.0) < 4 / np.sqrt(2 * n)
            assert abs((apart @ aside).mean()) < 4e-4 / np.sqrt(n)
    assert Ranging(scanner(), Air(CLEAR, 1064.0), 1, "left", True).aside(pulses_of(np.arange(3)), direction) is None
    assert Ranging(table, Air(CLEAR, 1064.0), 1, "left", False).aside(pulses_of(np.arange(3)), direction) is None


def test_the_range_of_a_drawn_place_replaces_the_noise_of_a_slope() -> None:
    table = scanner(range_noise={"drawn": True, "sigma_m": 0.0, "footprint": 5.0}, divergence_mrad=0.4)
    ranging = Ranging(table, Air(CLEAR, 1064.0), 1, "left", True)
    echoes = echoes_of(np.full((4, 1), 1000.0), 0.4, 60.0)
    drawn_m = np.array([[0.0], [0.3], [-0.7], [2.0]])
    measured = ranging.measure(pulses_of(np.arange(4)), echoes, np.full(4, 1500.0), np.full((4, 1), 400.0), drawn_m)
    np.testing.assert_allclose(measured.range_m, 1000.0 + drawn_m, atol=1e-9)
