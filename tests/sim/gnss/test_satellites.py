"""Tests the virtual receiver's solutions: geometry by PROJ and SciPy, errors by their covariance."""

from __future__ import annotations

from dataclasses import fields
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from swath.georef.arrays import FloatArray
from swath.georef.records import FixType
from swath.sim.gnss.noise import Noise
from swath.sim.gnss.receiver import Epochs, InsEpochs, Receiver
from swath.sim.plan.errors import PlanError
from swath.sim.plan.tables import GnssTable
from tests.sim.circling import TO_E, Circling, Standing, geodetic, ned_from_e

LEVER_ARM = [0.8, -0.6, -1.9]
# North, east, down; white part, then (correlated part, correlation time)
ERRORS: dict[str, tuple[list[float], list[tuple[list[float], float]]]] = {
    "rtk": ([0.008, 0.008, 0.015], [([0.004, 0.004, 0.008], 10.0), ([0.006, 0.006, 0.012], 60.0)]),
    "ppk": ([0.004, 0.004, 0.008], [([0.006, 0.006, 0.012], 60.0)]),
    "spp": ([0.2, 0.2, 0.2], [([1.2, 1.2, 2.0], 180.0)]),
}
LIMIT = 4.5  # sigmas of an estimate


def receiver(trajectory: Circling | None = None, *, noise: bool = True, **keys: Any) -> Receiver:
    """Return a receiver on the circling body."""
    seed, name = keys.pop("seed", 7), keys.pop("name", "rover")
    table = GnssTable.model_validate({"lever_arm_m": LEVER_ARM} | keys)
    return Receiver(table, trajectory or Circling(), seed=seed, name=name, noise=noise)


def ecef(epochs: Epochs | InsEpochs) -> FloatArray:
    """Return (n, 3) ECEF coordinates from PROJ."""
    return np.stack(TO_E.transform(np.degrees(epochs.lon_rad), np.degrees(epochs.lat_rad), epochs.height_m), axis=-1)


def autocovariance(rows: FloatArray, lag: int) -> FloatArray:
    """Return the autocovariance (m,) of zero-mean rows (n, m)."""
    n = len(rows) - lag
    return np.asarray((rows[:n] * rows[lag:]).sum(axis=0) / n)


def estimate_sigma(model: FloatArray, lag: int, count: int) -> float:
    """Return one sigma of an autocovariance estimated from ``count`` rows of a Gaussian process (Bartlett)."""
    far = np.concatenate([model[:0:-1], model])  # lags −L … L
    middle = len(model) - 1
    moved = np.array([model[abs(k + lag)] * model[abs(k - lag)] for k in range(lag - middle, middle - lag + 1)])
    return float(np.sqrt(((far**2).sum() + moved.sum()) / (count - lag)))


def test_the_noiseless_solution_equals_place_and_velocity_of_the_antenna() -> None:
    aircraft = Circling()
    epochs = receiver(aircraft, noise=False, rate_hz=10, protocol="ubx").epochs(3, 200)
    time_s = np.arange(3, 203) / 10
    np.testing.assert_array_equal(epochs.time_s, time_s)
    assert np.abs(ecef(epochs) - aircraft.point_e(LEVER_ARM, time_s)).max() < 1e-6
    assert np.abs(epochs.velocity_l - aircraft.velocity_of(LEVER_ARM, time_s)).max() < 2e-6
    assert np.ptp(aircraft.velocity_of(LEVER_ARM, time_s) - aircraft.velocity_l(time_s), axis=0).min() > 0.05
    assert not epochs.position_error_l.any()
    assert not epochs.velocity_error_l.any()
    assert set(epochs.fix) == {FixType.RTK_FIXED}
    assert (epochs.position_sigma_l > 0).all()


def test_novatel_velocity_lags_the_position_by_its_stated_latency() -> None:
    aircraft = Circling()
    epochs = receiver(aircraft, noise=False, rate_hz=20, protocol="novatel").epochs(0, 100)
    assert epochs.velocity_age_s[0] == 0.0  # no epoch precedes the start
    assert (epochs.velocity_age_s[1:] == 0.05).all()
    true_l = aircraft.velocity_of(LEVER_ARM, epochs.time_s - epochs.velocity_age_s)
    assert np.abs(epochs.velocity_l - true_l).max() < 2e-6
    assert np.abs(epochs.velocity_l - aircraft.velocity_of(LEVER_ARM, epochs.time_s)).max() > 0.1


def test_reported_errors_match_the_actual_ones() -> None:
    aircraft = Circling()
    noisy = receiver(aircraft, grade="spp", protocol="ubx", jump=[{"at_s": 20, "for_s": 5, "offset_l_m": [3, -2, 7]}])
    epochs = noisy.epochs(0, 300)
    true_e = aircraft.point_e(LEVER_ARM, epochs.time_s)
    lat_rad, lon_rad, _ = geodetic(true_e)
    error_l = ned_from_e(lat_rad, lon_rad).apply(ecef(epochs) - true_e)
    assert np.abs(error_l - epochs.position_error_l).max() < 1e-6
    velocity_error_l = epochs.velocity_l - aircraft.velocity_of(LEVER_ARM, epochs.time_s)
    assert np.abs(velocity_error_l - epochs.velocity_error_l).max() < 2e-6
    assert epochs.velocity_error_l.std() > 0.02


@pytest.mark.parametrize("grade", ERRORS)
def test_position_errors_have_the_sigma_and_correlation_of_their_grade(grade: str) -> None:
    count = 150_000
    epochs = receiver(Standing(), grade=grade, rate_hz=1).epochs(0, count)
    white, slow = ERRORS[grade]
    lags = np.arange(4000)
    for axis in range(3):
        model = np.zeros(len(lags))
        model[0] = white[axis] ** 2
        for sigma, tau_s in slow:
            model += sigma[axis] ** 2 * np.exp(-lags / tau_s)
        for lag in (0, 1, 10, 100):
            found = autocovariance(epochs.position_error_l[:, axis : axis + 1], lag)[0]
            assert abs(found - model[lag]) < LIMIT * estimate_sigma(model, lag, count), (axis, lag)
    independent = np.corrcoef(np.diff(epochs.position_error_l, axis=0).T) - np.eye(3)
    assert np.abs(independent).max() < LIMIT * np.sqrt(1.5 / count)


@pytest.mark.parametrize("smooth", [False, True])
def test_noise_is_stationary_from_its_first_row_on(smooth: bool) -> None:
    """One draw has many components; a process that starts from zero would have no variance yet."""
    components, tau_s, step_s = 20_000, 7.0, 0.5
    rows = Noise(3, ("many",), np.full(components, 2.0), tau_s, step_s, smooth=smooth).rows(0, 600)
    for first, lag in ((0, 0), (0, 1), (0, 8), (1, 1), (511, 1), (505, 14)):  # blocks of 512 rows
        age = lag * step_s / tau_s
        want = np.exp(-age)
        if smooth:  # of the cascade of two equal poles φ = exp(−step/τ): (1 + lag (1 − φ²)/(1 + φ²)) φ^lag
            square = np.exp(-2 * step_s / tau_s)
            want *= 1 + lag * (1 - square) / (1 + square)
        found = (rows[first] * rows[first + lag]).mean() / 4.0
        assert abs(found - want) < LIMIT * np.sqrt((1 + want**2) / components), (first, lag)


def test_velocity_errors_are_white() -> None:
    count = 100_000
    errors_l = receiver(Standing(), grade="rtk", rate_hz=20).epochs(0, count).velocity_error_l
    variance = np.array([0.010, 0.010, 0.020]) ** 2
    assert np.abs(autocovariance(errors_l, 0) / variance - 1).max() < LIMIT * np.sqrt(2 / count)
    assert np.abs(autocovariance(errors_l, 1) / variance).max() < LIMIT * np.sqrt(1 / count)


def test_reported_sigmas_are_a_little_optimistic_and_follow_the_satellites() -> None:
    epochs = receiver(Standing(), grade="rtk", rate_hz=1).epochs(0, 20_000)
    white, slow = ERRORS["rtk"]
    true_sigma = np.sqrt(np.array(white) ** 2 + sum(np.array(sigma) ** 2 for sigma, _ in slow))
    nominal = epochs.satellites == 20
    assert 0.15 < nominal.mean() < 0.4  # of a normal distribution of sigma 1.5, rounded: 0.26
    np.testing.assert_allclose(epochs.position_sigma_l[nominal] / true_sigma, 0.8, rtol=1e-12)
    few = epochs.satellites == 17
    np.testing.assert_allclose(epochs.position_sigma_l[few] / true_sigma, 0.8 * np.sqrt(20 / 17), rtol=1e-12)


@pytest.mark.parametrize("length_m", [0.5, 2.0])
def test_the_sigma_of_a_baseline_direction_follows_its_length(length_m: float) -> None:
    count = 100_000
    second = [LEVER_ARM[0], LEVER_ARM[1] + length_m, LEVER_ARM[2]]
    epochs = receiver(Standing(), secondary_lever_arm_m=second, rate_hz=1).epochs(0, count)
    for errors, sigma_deg in ((epochs.heading_error_rad, 0.2), (epochs.pitch_error_rad, 0.4)):
        sigma = np.radians(sigma_deg) / length_m
        lags = np.arange(2000)
        model = sigma**2 * (0.36 * np.exp(-lags / 60.0) + 0.64 * (lags == 0))
        for lag in (0, 1, 30):
            found = autocovariance(errors[:, None], lag)[0]
            assert abs(found - model[lag]) < LIMIT * estimate_sigma(model, lag, count)
    np.testing.assert_allclose(np.degrees(epochs.heading_sigma_rad), 0.8 * 0.2 / length_m)
    np.testing.assert_allclose(np.degrees(epochs.pitch_sigma_rad), 0.8 * 0.4 / length_m)


@pytest.mark.parametrize(
    ("offset_b", "turn_deg"),
    [([0, 1.2, 0], 90.0), ([2.0, 0, 0], 0.0), ([0, -1.2, 0], 270.0), ([-0.7, 0, 0], 180.0)],
)
def test_heading_is_that_of_the_baseline_from_the_primary_to_the_secondary_antenna(
    offset_b: list[float], turn_deg: float
) -> None:
    aircraft = Circling(level=True)
    second = [a + b for a, b in zip(LEVER_ARM, offset_b, strict=True)]
    epochs = receiver(aircraft, noise=False, secondary_lever_arm_m=second).epochs(0, 400)
    want = aircraft.attitude(epochs.time_s)[2] + np.radians(turn_deg)
    assert np.abs((epochs.heading_rad - want + np.pi) % (2 * np.pi) - np.pi).max() < 1e-6
    assert np.abs(epochs.pitch_rad).max() < 1e-6
    assert (epochs.heading_rad >= 0).all()
    assert (epochs.heading_rad < 2 * np.pi).all()


def test_baseline_to_the_right_points_down_by_the_roll() -> None:
    aircraft = Circling()
    second = [LEVER_ARM[0], LEVER_ARM[1] + 1.5, LEVER_ARM[2]]
    epochs = receiver(aircraft, noise=False, secondary_lever_arm_m=second).epochs(0, 400)
    roll, pitch, _ = aircraft.attitude(epochs.time_s)
    # third component of Ry(p) Rx(r) e_y is sin r cos p, down
    assert np.abs(epochs.pitch_rad + np.arcsin(np.sin(roll) * np.cos(pitch))).max() < 1e-6


def test_without_a_second_antenna_there_is_no_direction() -> None:
    epochs = receiver().epochs(0, 3)
    assert np.isnan(epochs.heading_rad).all()
    assert np.isnan(epochs.heading_sigma_rad).all()


@pytest.mark.parametrize(("grade", "float_s", "usual"), [("rtk", 10, 4), ("ppk", 3, 4), ("spp", 0, 1)])
def test_an_outage_is_followed_by_float_and_then_the_usual_fix(grade: str, float_s: int, usual: int) -> None:
    epochs = receiver(grade=grade, rate_hz=2, outage=[{"at_s": 10, "for_s": 4.0}]).epochs(0, 100)
    want = np.full(100, usual)
    want[20:28] = 0
    want[28 : 28 + 2 * float_s] = FixType.RTK_FLOAT
    np.testing.assert_array_equal(epochs.fix, want)
    assert not epochs.satellites[20:28].any()
    assert epochs.satellites[28:].all()


def test_float_solutions_are_worse_and_report_it() -> None:
    outages = [{"at_s": 30.0 * k, "for_s": 1.0} for k in range(3000)]
    epochs = receiver(Standing(), rate_hz=1, outage=outages).epochs(0, 90_000)
    floating = epochs.fix == FixType.RTK_FLOAT
    assert floating.sum() == 30_000
    spread = epochs.position_error_l[floating].std(axis=0)
    # windows of 10 s of τ = 20 s every 30 s: at the very least one independent value a window of two
    assert np.abs(spread / np.hypot([0.25, 0.25, 0.40], 0.02) - 1).max() < LIMIT * np.sqrt(1 / (2 * 1500))
    assert (epochs.position_sigma_l[floating].min(axis=0) > 0.15).all()
    assert (epochs.position_sigma_l[~floating].max(axis=0) < 0.03).all()


def test_a_jump_moves_the_solution_and_not_its_sigma() -> None:
    jump = {"at_s": 12.0, "for_s": 3.0, "offset_l_m": [0.4, -0.3, 0.9]}
    calm, jumped = receiver(rate_hz=5), receiver(rate_hz=5, jump=[jump])
    before, after = calm.epochs(0, 100), jumped.epochs(0, 100)
    moved_l = after.position_error_l - before.position_error_l
    window = (before.time_s >= 12.0) & (before.time_s < 15.0)
    np.testing.assert_allclose(moved_l[window], np.tile([0.4, -0.3, 0.9], (15, 1)), atol=1e-12)
    assert not moved_l[~window].any()
    np.testing.assert_array_equal(before.position_sigma_l, after.position_sigma_l)
    np.testing.assert_array_equal(before.fix, after.fix)


def test_epochs_do_not_depend_on_how_they_are_requested() -> None:
    outages = [{"at_s": 20, "for_s": 5}]
    keys: dict[str, Any] = {"rate_hz": 20, "outage": outages, "secondary_lever_arm_m": [0.8, 0.6, -1.9], "ins": True}
    whole, pieces, backwards = receiver(**keys), receiver(**keys), receiver(**keys)
    cuts = [0, 1, 3, 511, 512, 513, 700, 1023, 1500]
    for method in ("epochs", "ins_epochs"):
        at_once = getattr(whole, method)(0, 1500)
        spans = list(pairwise(cuts))
        forward = [getattr(pieces, method)(a, b - a) for a, b in spans]
        reverse = [getattr(backwards, method)(a, b - a) for a, b in reversed(spans)][::-1]
        for field in fields(at_once):
            want = getattr(at_once, field.name)
            for parts in (forward, reverse):
                found = np.concatenate([getattr(part, field.name) for part in parts])
                if field.name in ("index", "fix", "satellites") or "error" in field.name:
                    np.testing.assert_array_equal(found, want)
                else:
                    np.testing.assert_allclose(found, want, rtol=0, atol=1e-9)


def test_seeds_and_names_have_independent_errors() -> None:
    first = receiver(seed=1).epochs(0, 50).position_error_l
    np.testing.assert_array_equal(first, receiver(seed=1).epochs(0, 50).position_error_l)
    assert (first != receiver(seed=2).epochs(0, 50).position_error_l).all()
    assert (first != receiver(seed=1, name="base").epochs(0, 50).position_error_l).all()


def test_ins_gives_the_bodys_origin_and_attitude() -> None:
    aircraft = Circling()
    ins = receiver(aircraft, noise=False, ins=True).ins_epochs(50, 500)
    time_s = np.arange(50, 550) / 100
    assert np.abs(ecef(ins) - aircraft.position_e(time_s)).max() < 1e-6
    assert np.abs(ins.velocity_l - aircraft.velocity_l(time_s)).max() < 2e-6
    assert np.abs(ins.attitude_rad - np.stack(aircraft.attitude(time_s), -1)).max() < 1e-12


def test_ins_errors_are_smooth_and_as_large_as_stated() -> None:
    count = 500_000  # 5000 s
    ins = receiver(Standing(), ins=True).ins_epochs(0, count)
    step_s = 0.01
    parts = (
        (ins.position_error_l, ins.position_sigma_l, [0.012, 0.012, 0.020], 60.0),
        (ins.velocity_error_l, ins.velocity_sigma_l, [0.005, 0.005, 0.005], 30.0),
        (np.degrees(ins.attitude_error_rad), np.degrees(ins.attitude_sigma_rad), [0.005, 0.005, 0.010], 120.0),
    )
    for errors, reported, sigma, tau_s in parts:
        np.testing.assert_allclose(reported, np.tile(sigma, (count, 1)))
        # ∫ρ² dt of ρ = (1 + t/τ) exp(−t/τ) over both sides is 5τ/2
        independent = count * step_s / (2.5 * tau_s)
        ratio = (errors**2).mean(axis=0) / np.square(sigma)
        assert np.abs(ratio - 1).max() < LIMIT * np.sqrt(2 / independent)
        # the rate's sigma is σ/τ, and that of a process of first order: independent for each τ/2
        rates = np.diff(errors, axis=0) / step_s
        ratio = (rates**2).mean(axis=0) / (np.array(sigma) / tau_s) ** 2
        assert np.abs(ratio - 1).max() < LIMIT * np.sqrt(2 / (count * step_s / tau_s))


def test_ins_drifts_without_satellites_and_comes_back() -> None:
    keys: dict[str, Any] = {"ins": True, "rate_hz": 1}
    calm = receiver(Standing(), **keys).ins_epochs(0, 10_000)
    coasting = receiver(Standing(), **keys, outage=[{"at_s": 20.0, "for_s": 40.0}]).ins_epochs(0, 10_000)
    ratio = coasting.position_error_l / calm.position_error_l
    np.testing.assert_allclose(ratio[:2001], 1.0)
    np.testing.assert_allclose(ratio[4000], 2.0)  # 20 s
    np.testing.assert_allclose(ratio[6000], 5.0)  # 40 s
    assert (ratio[9500:] < 1.001).all()
    np.testing.assert_allclose(coasting.position_sigma_l[6000], 5 * calm.position_sigma_l[6000])
    assert coasting.since_update_s[4000] == 20.0
    assert coasting.since_update_s[6000] == 0.0
    assert np.abs(np.diff(coasting.position_error_l, axis=0)).max() < 0.005  # no step


def test_a_second_antenna_at_the_place_of_the_first_is_refused() -> None:
    with pytest.raises(PlanError, match=r"^gnss\.rover\.secondary_lever_arm_m: equals lever_arm_m; give"):
        receiver(secondary_lever_arm_m=LEVER_ARM)
