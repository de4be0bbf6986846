"""Tests the filter: the reference flights, any cuts, bad input, hours of input, and the fates of observations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from swath.georef.arrays import StructArray
from swath.georef.geodesy.earth import e_from_geodetic, rot_e_from_l
from swath.georef.geodesy.gravity import EARTH_RATE_RADPS, gravity_e
from swath.georef.geodesy.rotations import attitude_of
from swath.georef.navigation.filter.error_model import layout_of
from swath.georef.navigation.filter.filter import NavigationFilter, run_filter, start_covariance, start_state
from swath.georef.navigation.filter.gate import PATIENCE
from swath.georef.navigation.filter.smoother import difference, forward
from swath.georef.navigation.filter.stores import LATEST_ROWS
from swath.georef.navigation.filter.strapdown import SLOW, SLOW_VELOCITY
from swath.georef.navigation.inputs import GRADES, Fate, ImuNoise, Inertial, Kind, Start
from swath.georef.records import FixType
from tests.georef.navigation.flights import Fixes, drawn_start, errors, fly, noised, setup_for, survey
from tests.georef.navigation.scores import (
    FILTER,
    LINES_S,
    OUTAGES_M,
    flight_errors,
    of_maxima,
    outages,
    rms,
    start_of,
    without,
)
from tests.georef.navigation.vehicles import BEGIN_NS, ns, observed, reference, uav

pytestmark = pytest.mark.xdist_group("kernels")

ARM = np.array([0.35, -0.12, -1.1])
GOOD = Fixes(velocity_mps=0.03)


@pytest.mark.parametrize("name", ["tactical", "mems"])
def test_the_reference_flight_is_filtered_as_accurately_as_published(name: str) -> None:
    """With positions only, each figure is within a tenth of the filter in the data set's README.

    In the outages it is within 15 %.
    """
    flown, start = reference(name), start_of("reference_flight", name)
    rows = flown.only(Kind.POSITION)
    run = run_filter(flown.inertial, rows, flown.setup, start)
    _, off = flight_errors(name, forward(run), LINES_S)
    assert (rms(off) <= 1.10 * np.array(FILTER[name])).all(), rms(off)
    inside = run.innovations[run.innovations["fate"] == Fate.TAKEN]
    assert 0.9 < np.mean(inside["normalised"] ** 2) < 1.1
    spans = outages(name)
    lost = forward(run_filter(flown.inertial, without(rows, spans), flown.setup, start))
    t, off = flight_errors(name, lost, (spans.min(), spans.max() + 1.0))
    assert of_maxima(t, np.linalg.norm(off[:, :3], axis=1), spans) < 1.15 * OUTAGES_M[name][0]


def test_knowledge_of_a_correlated_error_decays_with_the_error() -> None:
    """In half a minute without observations the estimated errors of positions and velocities decay exponentially."""
    truth, noise = fly(survey(), 60.0, 50.0), GRADES["mems"]
    inertial, rows = noised(truth, noise, Fixes(share=0.5, tau_s=20.0, velocity_mps=0.03), ARM, 3)
    setup = replace(setup_for(noise, ARM), gnss_correlated_share=0.5, gnss_correlation_s=20.0)
    setup = replace(setup, gnss_velocity_share=0.5, gnss_velocity_correlation_s=8.0)
    run = run_filter(inertial, rows[rows["time_ns"] < ns(30.0)], setup, drawn_start(truth, 3))
    time_ns, after = (np.concatenate([getattr(one, name) for one in run.nodes]) for name in ("time_ns", "after"))
    begin, end = after[np.searchsorted(time_ns, ns(30.0))], after[-1]
    for first, tau_s in ((SLOW, 20.0), (SLOW_VELOCITY, 8.0)):
        there = begin[first : first + 3]
        assert np.abs(there).min() > 0.0
        np.testing.assert_allclose(end[first : first + 3], np.exp(-30.0 / tau_s) * there, rtol=1e-3)


def test_results_do_not_depend_on_how_the_input_is_cut() -> None:
    """Results are equal bit for bit, fed sample by sample, with observations held back, or all at once."""
    truth = fly(survey(), 40.0, 100.0)
    inertial, rows = noised(truth, GRADES["tactical"], GOOD, ARM, 1)
    setup, start = setup_for(GRADES["tactical"], ARM), drawn_start(truth, 1, at_s=0.5)
    whole = run_filter(inertial, rows, setup, start)
    assert whole.counts["position taken"] == 39
    for piece, late_s in ((1, 0.25), (137, 0.4), (777, 2.0)):
        cut = NavigationFilter(setup, start, hold_s=late_s)
        for first in range(0, len(inertial), piece):
            part = inertial.between(first, first + piece)
            come = rows["time_ns"] + 200_000_000  # a receiver's delay
            before = inertial.time_ns[first - 1] if first else 0
            cut.observe(rows[(come > before) & (come <= part.time_ns[-1])])
            cut.feed(part)
        cut.observe(rows[rows["time_ns"] + 200_000_000 > inertial.time_ns[-1]])
        run = cut.finish()
        for mine, theirs in zip(run.path, whole.path, strict=True):
            np.testing.assert_array_equal(mine, theirs)
        assert run.innovations.tobytes() == whole.innovations.tobytes()
        assert run.counts == whole.counts
        for column in range(6):
            mine, theirs = (np.concatenate([block[column] for block in one.nodes]) for one in (run, whole))
            np.testing.assert_array_equal(mine, theirs)


def test_the_first_covariance_equals_the_sigmas_of_the_start() -> None:
    """Near a pole, with nose up, bank and heading west, each angle and each direction changes the state differently."""
    setup = setup_for(GRADES["tactical"], ARM)
    place, angles = e_from_geodetic(1.4, -2.0, 3000.0), np.array([0.4, 0.7, 4.5])
    sigma = np.array([1.0, 2.0, 3.0, 0.1, 0.2, 0.3, 0.01, 0.02, 0.03])
    start = Start(0, place, np.array([10.0, 20.0, 1.0]), angles, sigma[:3], sigma[3:6], sigma[6:])
    level, changes = rot_e_from_l(1.4, -2.0), np.zeros((9, 9))
    for i in range(3):
        changes[:3, i] = level[:, i]
        faster = replace(start, velocity_l=start.velocity_l + np.eye(3)[i])
        turned = replace(start, attitude_rad=angles + 1e-6 * np.eye(3)[i])
        for j, other, step in ((3 + i, faster, 1.0), (6 + i, turned, 1e-6)):
            difference(start_state(setup, other), start_state(setup, start), changes[:, j])
            changes[:, j] /= step
    expected = (changes * sigma**2) @ changes.T
    found = start_covariance(setup, start, layout_of(setup))
    np.testing.assert_allclose(found[:9, :9], expected, rtol=0, atol=1e-5 * np.abs(np.diag(expected)).max())
    np.testing.assert_allclose(found[6:9, 6:9], expected[6:, 6:], rtol=0, atol=1e-9)
    noise = GRADES["tactical"]
    rest = np.repeat([noise.gyro_bias, noise.accel_bias, noise.gyro_scale, noise.accel_scale], 3)
    rest = np.append(rest, np.full(6, noise.misalignment))
    np.testing.assert_allclose(np.diag(found)[9:], rest**2)


def test_late_observations_are_counted() -> None:
    truth = fly(survey(), 20.0, 100.0)
    inertial, rows = noised(truth, GRADES["tactical"], GOOD, ARM, 2)
    live = NavigationFilter(setup_for(GRADES["tactical"], ARM), drawn_start(truth, 2), smoothed=False)
    live.feed(inertial.between(0, 1000))
    live.observe(rows)
    live.feed(inertial.between(1000, 2000))
    early = int(np.count_nonzero(rows["time_ns"] < BEGIN_NS + 10 * 10**9))
    assert sum(live.counts[f"{kind} outside"] for kind in ("position", "velocity")) == early
    assert len(live.new_path().time_ns) == 2000
    assert len(live.new_path().time_ns) == 0
    assert live.time_ns == inertial.time_ns[-1]


def bad_rows(rows: StructArray) -> StructArray:
    """Return one observation of each kind of fault."""
    bad = rows[:7].copy()
    bad["value"][0, 1] = np.nan
    bad["sigma"][1] = np.nan
    bad["sigma"][2] = 0.0
    bad["fix_type"][3] = FixType.NONE
    bad["antenna"][4] = 7
    bad["kind"][5] = 200
    bad["correlation"][6] = 5.0
    return bad


def test_every_observation_has_a_fate() -> None:
    """Unusable observations are reported, jumps refused, larger errors inflated; the state is unaffected."""
    truth = fly(survey(), 60.0, 100.0)
    inertial, rows = noised(truth, GRADES["tactical"], Fixes(), ARM, 3)
    rows["value"][30] += [3.0, -4.0, 1.0]
    rows["value"][40] += np.array([0.12, -0.1, 0.04])
    rows = np.concatenate(
        [
            rows,
            bad_rows(rows),
            observed(Kind.POSITION, np.array([-5.0, 100.0]), rows["value"][:2], np.ones(3), FixType.SINGLE),
        ]
    )
    run = run_filter(inertial, rows, setup_for(GRADES["tactical"], ARM), drawn_start(truth, 3))
    told = run.innovations
    assert len(told) == len(rows)
    assert run.counts["position unusable"] + run.counts["kind 200 unusable"] == 6
    assert run.counts["position outside"] == 2
    assert told["fate"][told["time_ns"] == rows["time_ns"][30]] == Fate.REJECTED
    inflated = told[told["time_ns"] == rows["time_ns"][40]]
    assert inflated["fate"] == Fate.INFLATED
    assert inflated["inflation"] > 1.0
    end = forward(run)
    off = errors(truth, truth.edges[1:], end.position_e, end.velocity_e, end.q_e_from_b)
    assert np.abs(off[-1000:, :3]).max() < 0.05
    assert np.isfinite(told["chi2"][told["fate"] < Fate.UNUSABLE]).all()


def test_a_permanent_position_jump_is_accepted_after_half_a_minute() -> None:
    """A base station set wrong by 20 m is refused for half a minute, which is as long as a wrong fix may last."""
    truth = fly(survey(), 90.0, 100.0)
    inertial, rows = noised(truth, GRADES["tactical"], Fixes(), ARM, 4)
    rows["value"][30:] += [10.0, 10.0, 14.0]
    setup = setup_for(GRADES["tactical"], ARM)
    run = run_filter(inertial, rows, setup, drawn_start(truth, 4))
    fates = run.innovations["fate"]
    refused = round(PATIENCE * setup.reacquire_s)
    assert (fates[30 : 30 + refused] == Fate.REJECTED).all()
    assert Fate.REACQUIRED in fates[30 + refused : 36 + refused]
    assert (fates[-10:] <= Fate.REACQUIRED).all()
    end = forward(run)
    off = end.position_e[-1] - truth.flight.motion(truth.edges[-1:]).position_e[0]
    np.testing.assert_allclose(off, [10.0, 10.0, 14.0], atol=0.3)


def test_a_receiver_with_too_small_sigmas_is_not_refused_for_long() -> None:
    """The sigmas are a third of the errors; the result must still be as accurate as the errors allow."""
    truth = fly(survey(), 120.0, 100.0)
    inertial, rows = noised(truth, GRADES["tactical"], Fixes(sigma_m=(0.06, 0.06, 0.12)), ARM, 5)
    rows["sigma"] /= 3.0
    run = run_filter(inertial, rows, setup_for(GRADES["tactical"], ARM), drawn_start(truth, 5))
    assert run.counts["position rejected"] <= 2
    assert np.median(run.innovations["inflation"][30:]) > 2.0
    end = forward(run)
    off = errors(truth, truth.edges[1:], end.position_e, end.velocity_e, end.q_e_from_b)
    assert (rms(off[3000:, :3]) < [0.05, 0.05, 0.08]).all()


def test_missing_samples_are_counted_and_bridged_by_the_next() -> None:
    """20 ms of lost samples are counted and marked, and no fix is refused because of them."""
    truth = fly(survey(), 30.0, 100.0)
    inertial, rows = noised(truth, GRADES["tactical"], Fixes(), ARM, 6)
    kept = np.r_[0:1500, 1502:3000]
    torn = Inertial(
        inertial.time_ns[kept],
        inertial.interval_s[kept],
        inertial.angle_b[kept],
        inertial.velocity_b[kept],
        inertial.bridged[kept],
    )
    run = run_filter(torn, rows, setup_for(GRADES["tactical"], ARM), drawn_start(truth, 6))
    assert run.counts["gaps not bridged"] == 1
    assert np.count_nonzero(run.path.bridged) == 1
    assert np.isin(run.innovations["fate"], [Fate.TAKEN, Fate.INFLATED]).all()


def test_the_covariance_stays_positive_after_hours_of_perfect_fixes() -> None:
    """The unit stands still for three hours; perfect samples and fixes of 0.1 mm strain the arithmetic most."""
    noise, seconds = ImuNoise(1e-9, 1e-9, 1e-10, 1e-9, 3600.0, 1e-8, 1e-8), 10_800
    lat, lon = np.radians(47.0), np.radians(8.0)
    place, level = e_from_geodetic(lat, lon, 400.0), rot_e_from_l(lat, lon)
    t = np.arange(1.0, 2 * seconds + 1) / 2.0
    angle, push = np.array([0.0, 0.0, EARTH_RATE_RADPS]) @ level, -gravity_e(place) @ level
    half = np.full((len(t), 1), 0.5)
    inertial = Inertial(ns(t), half[:, 0], half * angle, half * push, np.zeros(len(t), np.bool_))
    fixes = place + level @ ARM + 1e-4 * np.random.default_rng(7).standard_normal((seconds - 1, 3))
    rows = observed(Kind.POSITION, np.arange(1.0, seconds), fixes, np.full(3, 1e-4), FixType.RTK_FIXED)
    setup = replace(setup_for(noise, ARM), position_floor_m=1e-4)
    off = np.array([0.05, -0.05, 0.3])
    start = Start(int(ns(0.0)), place + 5.0, np.zeros(3), off, np.full(3, 10.0), np.ones(3), np.array([0.1, 0.1, 1.0]))
    machine = NavigationFilter(setup, start)
    machine.observe(rows)
    machine.feed(inertial)
    p = machine.covariance
    np.testing.assert_array_equal(p, p.T)
    assert (np.diag(p) > 0.0).all()
    scale = np.sqrt(np.diag(p))
    assert np.linalg.eigvalsh(p / np.outer(scale, scale)).min() > -1e-9


def test_a_real_flight_with_metre_level_gps_is_processed() -> None:
    """Jumps of the UAV's GPS are refused, all other fixes are taken, and the attitude is near the on-board one."""
    flown = uav()
    assert flown.truth is not None
    begin = 120.0
    rot = flown.truth(np.array([begin]))[0][0]
    first = flown.only(Kind.POSITION)
    fix = first[first["time_ns"] >= ns(begin)][0]
    speeds = flown.only(Kind.VELOCITY)
    speed = speeds[speeds["time_ns"] >= ns(begin)][0]
    start = Start(
        int(fix["time_ns"]), fix["value"], speed["value"], np.array(attitude_of(rot)),
        np.full(3, 5.0), np.full(3, 1.0), np.radians([5.0, 5.0, 20.0]),
    )  # fmt: skip
    run = run_filter(flown.inertial, flown.rows, flown.setup, start)
    told = run.innovations[run.innovations["fate"] != Fate.OUTSIDE]
    assert len(told) > 900
    assert np.count_nonzero(told["fate"] == Fate.REJECTED) < 0.05 * len(told)
    assert np.isfinite(run.path.states).all()
    position = told[(told["kind"] == Kind.POSITION) & (told["fate"] <= Fate.INFLATED)]
    assert np.sqrt(np.mean(position["value"][:, :2] ** 2)) < 3.0


@pytest.mark.slow
def test_a_live_filter_keeps_only_the_latest_innovations() -> None:
    """A live filter counts all innovations, as one that keeps them all does, but its memory is bounded."""
    truth = fly(survey(), 60.0, 100.0)
    inertial, rows = noised(truth, GRADES["tactical"], Fixes(rate_hz=100.0), ARM, 2)
    setup, start = setup_for(GRADES["tactical"], ARM), drawn_start(truth, 2)
    live = NavigationFilter(setup, start, smoothed=False)
    most = 0
    for first in range(0, len(inertial), 2):
        due = (rows["time_ns"] >= inertial.time_ns[first] - 10_000_000) & (
            rows["time_ns"] < inertial.time_ns[first] + 10_000_000
        )
        live.observe(rows[due])
        live.feed(inertial.between(first, first + 2))
        live.new_path()
        most = max(most, sum(map(len, live._queue._told)))
    live.flush()
    assert LATEST_ROWS < most < 4 * LATEST_ROWS < len(rows)
    assert live.counts == run_filter(inertial, rows, setup, start).counts
