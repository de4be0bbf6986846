"""Tests whole flights: a start in the air, the real car's clock and outages, and noise found from the flight."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from swath.georef.arrays import FloatArray
from swath.georef.geodesy.quaternions import conjugate, product, rotation_vector
from swath.georef.geodesy.rotations import attitude_of
from swath.georef.navigation.filter.filter import run_filter
from swath.georef.navigation.filter.smoother import smooth
from swath.georef.navigation.inputs import GRADES, Inertial, Kind, Start
from swath.georef.navigation.solve import solve
from swath.georef.records import FixType
from tests.georef.navigation.flights import Fixes, drawn_start, errors, fly, noised, setup_for, survey
from tests.georef.navigation.scores import flight_errors, of_maxima, off_fixes, rms, start_of, without
from tests.georef.navigation.vehicles import FIXTURES, NAVIGATION, car, ns, reference

pytestmark = pytest.mark.xdist_group("kernels")

ARM = np.array([0.35, -0.12, -1.1])


@pytest.mark.slow
def test_a_flight_that_begins_in_the_air_is_as_accurate_at_its_start() -> None:
    """It begins on a line with a heading that is wrong by 8° and has a sigma of 10°; the first minute is as good."""
    flown = reference("tactical").cut(100_640.0, 101_550.0)
    assert flown.truth is not None
    rot, velocity, place = (value[0] for value in flown.truth(np.array([100_640.5])))
    start = Start(
        int(ns(100_640.5)), place + np.array([1.0, -2.0, 1.0]), velocity + np.array([0.1, 0.2, -0.1]),
        np.array(attitude_of(rot)) + np.radians([0.8, -0.7, 8.0]),
        np.full(3, 3.0), np.full(3, 0.3), np.radians([1.0, 1.0, 10.0]),
    )  # fmt: skip
    solved = solve(flown.inertial, flown.only(Kind.POSITION), flown.setup, start)
    assert solved.report.passes > 1
    assert solved.report.start_change_rad[-1] < 1e-2 * solved.report.start_change_rad[0]
    first = flight_errors("tactical", solved.smoothed, (100_641.0, 100_701.0))[1]
    last = flight_errors("tactical", solved.smoothed, (101_480.0, 101_540.0))[1]
    assert (rms(first[:, :3]) < 1.5 * np.maximum(rms(last[:, :3]), [0.004, 0.004, 0.006])).all()
    assert (rms(first[:, 3:]) < 1.5 * np.maximum(rms(last[:, 3:]), [0.003, 0.003, 0.008])).all()


def test_a_further_pass_claims_no_more_knowledge_than_the_first() -> None:
    """A MEMS unit's start is known nearly as well as the flight determines it, and must not be counted twice.

    A pass that begins from the smoothed attitude lies within a tenth of a sigma of the first.
    """
    truth, noise = fly(survey(), 240.0, 50.0), GRADES["mems"]
    inertial, rows = noised(truth, noise, Fixes(rate_hz=5.0, velocity_mps=0.03), ARM, 2000)
    start, setup = drawn_start(truth, 2000), setup_for(noise, ARM)
    solved = solve(inertial, rows, setup, start, noise_from_flight=False)
    assert solved.report.passes == 2
    once = smooth(run_filter(inertial, rows, setup, start))
    apart = rotation_vector(product(solved.smoothed.q_e_from_b, conjugate(once.q_e_from_b)))
    assert np.sqrt(np.mean(apart**2)) < 0.1 * np.sqrt(np.mean(once.attitude_sigma_rad**2, axis=0)).min()


def ticking(inertial: Inertial) -> Inertial:
    """Return the car's samples at the times of the unit's own counter; on that clock GNSS is 0.125 s early.

    The times in imu.txt are stretched by 292 ppm, 0.16 s over the drive, which turns a constant offset into one that
    grows.
    """
    rows = np.loadtxt(FIXTURES / "rtklib/imu_1934.csv.gz", delimiter=",", usecols=6)
    ticks = rows.astype(np.int64)[1 : 1 + len(inertial)]
    time_ns = inertial.time_ns[0] + 125_000_000 + (ticks - ticks[0]) * 1_000_000
    interval_s = np.diff(time_ns, prepend=time_ns[0] - 10_000_000) / 1e9
    return replace(inertial, time_ns=time_ns, interval_s=interval_s)


@pytest.mark.slow
def test_the_logging_delay_of_the_car_is_found() -> None:
    """Its makers configure 0.125 s; only positions are used, because the velocities are means over 0.25 s."""
    drive, start = car(), start_of("gnss_imu_drive", "meta")
    setup = replace(drive.setup, estimate_time_offset_s=0.3)
    solved = solve(ticking(drive.inertial), drive.only(Kind.POSITION), setup, start)
    assert solved.report.time_offset_s == pytest.approx(0.125, abs=0.010)
    assert not solved.report.weak
    np.testing.assert_array_equal(
        np.sort(solved.smoothed.innovations["time_ns"]), np.sort(drive.only(Kind.POSITION)["time_ns"])
    )


@pytest.mark.slow
def test_the_trajectory_of_a_late_imu_is_given_at_gnss_times() -> None:
    """Stamps are 8 ms late, which is half a metre of flight; the poses refer to GNSS time and have honest sigmas.

    The filter is better than a fix, the smoother better than half of one. Ratios of squares to predicted ones scatter
    by 0.3 from flight to flight and axis to axis, and by 1 for angles, which last: the mean of 24 is 1 ± 0.2, and 1 ±
    0.6 for angles, at three sigmas.
    """
    late_ns, truth, noise = 8_000_000, fly(survey(), 200.0, 50.0), GRADES["tactical"]
    setup, fix_m = replace(setup_for(noise, ARM), estimate_time_offset_s=0.02), np.array(Fixes().sigma_m)
    squared: list[FloatArray] = []
    for seed in range(8):
        inertial, rows = noised(truth, noise, Fixes(velocity_mps=0.03, rate_hz=5.0), ARM, seed)
        start = drawn_start(truth, seed)
        late = replace(inertial, time_ns=inertial.time_ns + late_ns)
        solved = solve(late, rows, setup, replace(start, time_ns=start.time_ns + late_ns))
        (sigma_s, *_) = solved.smoothed.time_offset_sigma_s
        assert sigma_s < 1e-4
        assert solved.report.time_offset_s == pytest.approx(1e-9 * late_ns, abs=4.0 * sigma_s)
        for solution, most_m in ((solved.forward, fix_m), (solved.smoothed, fix_m / 2)):
            settled = solution.time_ns >= ns(60.0)
            t = (solution.time_ns[settled] - ns(0.0)) / 1e9
            state = (solution.position_e, solution.velocity_e, solution.q_e_from_b)
            off = errors(truth, t, *(column[settled] for column in state))
            assert (rms(off[:, :3]) < most_m).all()
        sigma = np.column_stack([solved.smoothed.position_sigma_l, solved.smoothed.attitude_sigma_rad])[settled]
        squared.append((off[:, [0, 1, 2, 6, 7, 8]] / sigma) ** 2)
    assert np.concatenate(squared)[:, :3].mean() == pytest.approx(1.0, abs=0.2)
    assert np.concatenate(squared)[:, 3:].mean() == pytest.approx(1.0, abs=0.6)


@pytest.mark.slow
@pytest.mark.parametrize(("raw", "filtered_m", "smoothed_m"), [(False, 11.5, 0.53), (True, 11.5, 0.53)])
def test_the_outages_of_the_car_are_bridged_as_accurately_as_published(
    raw: bool, filtered_m: float, smoothed_m: float
) -> None:
    """The figures are the RMS of the largest horizontal errors in thirteen outages of 15 s.

    The published times are stretched, which makes positions err twenty times as much as their sigmas say; this is no
    noise. With the unit's own clock errors are a third smaller.
    """
    drive, start = car(), start_of("gnss_imu_drive", "meta")
    fixes, spans = (np.loadtxt(NAVIGATION / f"gnss_imu_drive/{name}.txt.xz") for name in ("gnss", "outages"))
    rows = without(drive.only(Kind.POSITION), spans)
    inertial, setup = drive.inertial, drive.setup
    if raw:
        inertial, setup = ticking(inertial), replace(setup, estimate_time_offset_s=0.3)
    solved = solve(inertial, rows, setup, start)
    for solution, allowed in ((solved.forward, filtered_m), (solved.smoothed, smoothed_m)):
        t, off = off_fixes(solution, fixes)
        assert of_maxima(t, np.linalg.norm(off[:, :2], axis=1), spans) < 1.10 * allowed
    assert solved.smoothed.counts["position rejected"] == 0


FLIGHT_S = 600.0


@pytest.mark.slow
@pytest.mark.parametrize(("scale", "share"), [(1.0, 0.0), (2.5, 0.0), (1.0, 0.8)])
def test_noise_different_from_the_stated_sigmas_is_found(scale: float, share: float) -> None:
    """Fixes are as good as stated, worse by 2.5, or have errors that last a minute; the noise is found and used."""
    truth = fly(survey(), FLIGHT_S, 50.0)
    inertial, rows = noised(truth, GRADES["tactical"], Fixes(share=share, rate_hz=5.0), ARM, 11)
    rows["sigma"] /= scale
    setup = replace(setup_for(GRADES["tactical"], ARM), position_floor_m=1e-3)
    solved = solve(inertial, rows, setup, drawn_start(truth, 11))
    found = solved.report.setup
    fixed = found.gnss_sigma_scale.get(int(FixType.RTK_FIXED), 1.0)
    assert fixed == pytest.approx(scale, rel=0.1) if share == 0.0 else found.gnss_correlated_share > 0.5
    assert (found.gnss_correlated_share > 0.0) == (share > 0.0)


@pytest.mark.slow
@pytest.mark.parametrize("fault", ["frozen", "wrong fix"])
def test_seconds_of_blunders_do_not_hide_the_noise_of_the_flight(fault: str) -> None:
    """A receiver repeats itself for 5 s, or has a wrong fix for 20 s; lasting errors are still found.

    Sigmas long before and after are honest; the mean of squares over predicted ones scatters by 0.4.
    """
    truth = fly(survey(), FLIGHT_S, 50.0)
    inertial, rows = noised(truth, GRADES["tactical"], Fixes(share=0.8, rate_hz=5.0), ARM, 11)
    bad = (rows["time_ns"] >= ns(300.0)) & (rows["time_ns"] < ns(305.0 if fault == "frozen" else 320.0))
    rows["value"][bad] = rows["value"][bad][0] if fault == "frozen" else rows["value"][bad] + [0.9, 0.8, 1.0]
    solved = solve(inertial, rows, setup_for(GRADES["tactical"], ARM), drawn_start(truth, 11))
    assert solved.report.setup.gnss_correlated_share > 0.5
    found = solved.smoothed
    far = (found.time_ns < ns(280.0)) | (found.time_ns > ns(350.0))
    t = truth.edges[np.searchsorted(ns(truth.edges), found.time_ns[far])]
    off = errors(truth, t, found.position_e[far], found.velocity_e[far], found.q_e_from_b[far])[:, :3]
    assert np.mean((off / found.position_sigma_l[far]) ** 2) < 1.0 + 3 * 0.4


@pytest.mark.slow
@pytest.mark.parametrize("velocity_mps", [0.02, 0.0], ids=["velocities", "positions alone"])
def test_a_wrong_fix_does_not_move_the_trajectory(velocity_mps: float) -> None:
    """A fix that jumps by 1.6 m between epochs is refused for all of its 20 s, and errors stay within their sigmas."""
    truth = fly(survey(), FLIGHT_S, 50.0)
    inertial, rows = noised(truth, GRADES["tactical"], Fixes(rate_hz=5.0, velocity_mps=velocity_mps), ARM, 11)
    bad = (rows["kind"] == Kind.POSITION) & (rows["time_ns"] >= ns(300.0)) & (rows["time_ns"] < ns(320.0))
    rows["value"][bad] += [0.9, 0.8, 1.0]
    solved = solve(inertial, rows, setup_for(GRADES["tactical"], ARM), drawn_start(truth, 11))
    assert solved.forward.counts["position rejected"] == bad.sum()
    assert "position reacquired" not in solved.forward.counts
    found = solved.smoothed
    near = (found.time_ns > ns(295.0)) & (found.time_ns < ns(345.0))
    t = truth.edges[np.searchsorted(ns(truth.edges), found.time_ns[near])]
    off = errors(truth, t, found.position_e[near], found.velocity_e[near], found.q_e_from_b[near])
    assert np.abs(off[:, :3] / found.position_sigma_l[near]).max() < 5.0
    assert np.abs(off[:, 3:6] / found.velocity_sigma_l[near]).max() < 5.0


def test_a_parameter_that_the_flight_cannot_determine_is_reported() -> None:
    """In straight and level flight a lever arm cannot be separated from the start."""
    truth = fly(survey(line_s=1000.0), 60.0, 50.0)
    inertial, rows = noised(truth, GRADES["tactical"], Fixes(), ARM, 12)
    setup = replace(setup_for(GRADES["tactical"], ARM), estimate_lever_arm=0.05)
    assert "lever arm x" in solve(inertial, rows, setup, drawn_start(truth, 12)).report.weak
