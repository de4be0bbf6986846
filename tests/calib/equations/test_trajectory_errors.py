"""Tests the prior of trajectory errors against dense least squares, navigated flights and explicit processes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from swath.calib.equations.trajectory_prior import (
    Taus,
    TrajectoryPrior,
    apply,
    draw,
    from_smoother,
    gauss_markov,
    knots_of,
    positive,
)
from swath.calib.flight import Flight, FlightError, Head, Swath, Tangent
from swath.georef.arrays import FloatArray, Int64Array
from swath.georef.geodesy.earth import geodetic_from_e, rot_e_from_l
from swath.georef.geodesy.rotations import rot_from_quaternion
from swath.georef.navigation.cross_covariance import ErrorChain, error_chain
from swath.georef.navigation.filter.error_model import E_ATTITUDE, MOVED
from swath.georef.navigation.filter.filter import FilterRun, run_filter
from swath.georef.navigation.filter.smoother import smooth_nodes
from swath.georef.navigation.inputs import GRADES
from swath.georef.records import RETURN_DTYPE
from swath.georef.scanner.beams import LineGeometry
from swath.georef.scanner.calibration import nominal
from swath.georef.trajectory.trajectory import Trajectory
from tests.georef.navigation.flights import Fixes, Truth, drawn_start, fly, noised, setup_for, survey
from tests.georef.navigation.vehicles import ns

pytestmark = pytest.mark.xdist_group("kernels")

SECOND = 10**9
BEGIN = 1_400_000_000 * SECOND
ARM = np.array([0.35, -0.12, -1.1])
MEMS = GRADES["mems"]


# ---------------------------------------------------------------------- from the smoother


def navigated(truth: Truth, seed: int) -> FilterRun:
    inertial, rows = noised(truth, MEMS, Fixes(share=0.4, velocity_mps=0.05), ARM, seed)
    setup = replace(setup_for(MEMS, ARM), estimate_lever_arm=0.1, gnss_correlated_share=0.4)
    return run_filter(inertial, rows, setup, drawn_start(truth, seed))


def dense(packed: FloatArray, n: int) -> FloatArray:
    p = np.zeros((n, n))
    p[np.tril_indices(n)] = packed
    return p + np.tril(p, -1).T


def batch(run: FilterRun) -> FloatArray:
    """Return the estimates (m, n, m, n) of all nodes' errors by least squares in one piece."""
    n, [block] = run.layout.size, run.nodes
    m, ends = len(block.time_ns), [*block.first[1:].tolist(), len(block.h)]
    process, rows = np.zeros((m, n, m, n)), []
    for k in range(m):
        ahead = dense(block.covariance[k], n)
        for i in range(block.first[k], ends[k]):
            ahead += np.outer(block.gain[i], block.gain[i]) / block.weighed[i, 1]
            rows.append(np.zeros((m, n)))
            rows[-1][k] = block.h[i]
        process[k, :, k] = ahead  # without observations the filter's state before the node is the process's
        if not k:
            continue
        phi = np.diag(block.decay[k])
        phi[:MOVED] = 0.0
        phi[:MOVED, : block.top.shape[2]] = block.top[k]
        noise = ahead - phi @ dense(block.covariance[k - 1], n) @ phi.T
        for j in range(k):
            process[k, :, j] = phi @ process[k - 1, :, j]
            process[j, :, k] = process[k, :, j].T
        process[k, :, k] = phi @ process[k - 1, :, k - 1] @ phi.T + noise
    prior, design = process.reshape(m * n, m * n), np.array(rows).reshape(-1, m * n)
    size = np.sqrt(np.diag(prior))
    prior, design = prior / np.outer(size, size), design * size
    seen = design @ prior
    after = prior - seen.T @ np.linalg.solve(seen @ design.T + np.eye(len(design)), seen)
    whole: FloatArray = (after * np.outer(size, size)).reshape(m, n, m, n)
    return whole


def test_the_chain_equals_least_squares_in_one_piece() -> None:
    """All pairs of nodes of a short flight, with 27 errors estimated, agree to 1e-8 of their sigmas."""
    run = navigated(fly(survey(line_s=8.0), 24.0, 50.0), 1)
    [block], whole = run.nodes, batch(run)
    chain = error_chain(run, block.time_ns)
    nodes = np.searchsorted(block.time_ns, chain.time_ns)
    lat, lon, _ = geodetic_from_e(block.after[nodes, :3])
    rot_l_from_e = np.swapaxes(rot_e_from_l(lat, lon), 1, 2)
    parts = (slice(0, 3), slice(E_ATTITUDE, E_ATTITUDE + 3))
    wanted = np.zeros((len(nodes), 6, len(nodes), 6))
    for a, rows in enumerate(parts):
        for b, columns in enumerate(parts):
            block_e = whole[nodes][:, rows][:, :, nodes][..., columns]
            turned = np.einsum("iab,ibjc,jdc->iajd", rot_l_from_e, block_e, rot_l_from_e)
            wanted[:, 3 * a : 3 * a + 3, :, 3 * b : 3 * b + 3] = turned
    flat = wanted.reshape(6 * len(nodes), -1)
    sigma = np.sqrt(np.diag(flat))
    np.testing.assert_allclose(chain.covariance() / np.outer(sigma, sigma), flat / np.outer(sigma, sigma), atol=1e-8)
    assert len(chain) > 40
    few = chain.time_ns[[3, 17, 18, 40]]
    at = (6 * np.array([3, 17, 18, 40])[:, np.newaxis] + np.arange(6)).ravel()
    for shorter in (chain.at(few), error_chain(run, few)):
        assert (shorter.time_ns == few).all()
        unit = np.outer(sigma[at], sigma[at])
        np.testing.assert_allclose(shorter.covariance() / unit, flat[np.ix_(at, at)] / unit, atol=1e-8)


@pytest.mark.slow
def test_errors_of_navigated_flights_are_correlated_as_the_chain_states() -> None:
    """80 flights differ in their noise: χ² is computed of 24 joint errors at four moments and of their differences.

    The moments are far apart and close. A joint covariance without the correlations would give a χ² several times too
    small or too large.
    """
    truth = fly(survey(line_s=15.0), 45.0, 50.0)
    joint: list[float] = []
    differences: list[float] = []
    unlinked: list[float] = []
    step = np.concatenate([-np.eye(6), np.eye(6)], axis=1)
    for seed in range(80):
        run = navigated(truth, seed)
        nodes = smooth_nodes(run)
        at_ns = np.array([nodes.time_ns[np.argmin(np.abs(nodes.time_ns - ns(t)))] for t in (12.0, 14.0, 22.0, 34.0)])
        where = np.searchsorted(nodes.time_ns, at_ns)
        error, covariance = off(truth, nodes.time_ns[where], nodes.state[where]), error_chain(run, at_ns).covariance()
        joint.append(float(error @ np.linalg.solve(covariance, error)))
        between, apart = covariance[:12, :12], np.zeros((12, 12))
        apart[:6, :6], apart[6:, 6:] = between[:6, :6], between[6:, 6:]
        for found, supposed in ((differences, between), (unlinked, apart)):
            found.append(float(step @ error[:12] @ np.linalg.solve(step @ supposed @ step.T, step @ error[:12])))
    for found, dimension, right in ((joint, 24, True), (differences, 6, True), (unlinked, 6, False)):
        low, high = chi2.ppf([0.001, 0.999], dimension * len(found)) / len(found)
        assert (low < np.mean(found) < high) == right


def off(truth: Truth, time_ns: Int64Array, state: FloatArray) -> FloatArray:
    """Return (6k,) true − found positions in l, and rotations about north, east, down."""
    at = truth.flight.motion((time_ns - ns(0.0)) / SECOND)
    level = rot_e_from_l(*geodetic_from_e(at.position_e)[:2])
    shift = np.einsum("nji,nj->ni", level, at.position_e - state[:, :3])
    turn = at.rot_e_from_b @ np.swapaxes(rot_from_quaternion(state[:, 6:10]), 1, 2)
    axis = 0.5 * np.stack([turn[:, 2, 1] - turn[:, 1, 2], turn[:, 0, 2] - turn[:, 2, 0], turn[:, 1, 0] - turn[:, 0, 1]])
    return np.concatenate([shift, np.einsum("nji,jn->ni", level, axis)], axis=1).ravel()


def test_the_prior_of_a_smoothed_run_has_its_strips_and_is_positive() -> None:
    """Knots are at the run's nodes, each in its strip; a run that ends before the last strip is refused."""
    truth = fly(survey(line_s=15.0), 45.0, 50.0)
    run = navigated(truth, 7)
    chain = error_chain(run, smooth_nodes(run).time_ns)
    path = level_path(50, begin=int(ns(0.0)))
    flight = made([(0, 1, 5.2, 9.7), (0, 2, 18.1, 26.9)], [path], begin=int(ns(0.0)))
    prior = from_smoother(flight, [chain])
    assert np.isin(prior.time_ns, chain.time_ns).all()
    assert (np.abs(np.diff(prior.time_ns[prior.strip == 1])) <= 1.6 * SECOND).all()
    t = (prior.time_ns - ns(0.0)) / SECOND
    assert t[prior.strip == 1].min() < 5.2
    assert 9.7 < t[prior.strip == 1].max() < 12.0
    assert 16.0 < t[prior.strip == 2].min() < 18.1
    assert 26.9 < t.max() < 29.0
    assert np.linalg.eigvalsh(prior.covariance).min() > -1e-12 * np.linalg.eigvalsh(prior.covariance).max()
    np.testing.assert_allclose(prior.covariance, chain.at(prior.time_ns).covariance(), atol=1e-15)
    walk_is_that_of_the_nodes_between(prior, chain)
    with pytest.raises(FlightError, match=r"does not cover GPS week .*; use the run that covers all strips"):
        from_smoother(made([(0, 1, 5, 9), (0, 2, 46, 49)], [path], begin=int(ns(0.0))), [chain.at(chain.time_ns[:-12])])
    with pytest.raises(FlightError, match="0 runs for 1 trajectories; every trajectory needs its run"):
        from_smoother(flight, [])


def walk_is_that_of_the_nodes_between(prior: TrajectoryPrior, chain: ErrorChain) -> None:
    """Check that a turn half-way, minus the mean at both knots, has a bridge's variance: a quarter of the walk's."""
    seen = []
    for knot in np.flatnonzero((np.diff(prior.strip) == 0) & (np.diff(prior.time_ns) > 0.8 * SECOND)):
        ends = prior.time_ns[knot : knot + 2]
        inside = chain.time_ns[(chain.time_ns > ends[0]) & (chain.time_ns < ends[1])]
        middle = inside[np.argmin(np.abs(inside - ends.mean()))]
        share = (middle - ends[0]) / (ends[1] - ends[0])
        of = chain.at(np.array([ends[0], middle, ends[1]])).covariance().reshape(3, 6, 3, 6)
        weights = np.array([share - 1.0, 1.0, -share])
        variance = np.mean([weights @ of[:, axis, :, axis] @ weights for axis in (3, 4, 5)])
        seen.append(variance / (share * (1.0 - share) * prior.walk_rad2[knot]))
    assert len(seen) > 5
    assert 0.8 < np.median(seen) < 1.2


# ---------------------------------------------------------------------- from sigmas


def level_path(seconds: float, begin: int = BEGIN, heading_deg: float = 30.0, sigma: float = 1.0) -> Trajectory:
    """Return an eastward trajectory with attitude and growing sigmas."""
    t = np.arange(0.0, seconds, 0.1)
    grown = sigma * (1.0 + 0.01 * t)[:, np.newaxis]
    return Trajectory.from_geodetic(
        begin + np.rint(t * SECOND).astype(np.int64),
        np.full(len(t), np.radians(47.0)),
        np.radians(9.0) + 1e-5 * t,
        np.full(len(t), 900.0),
        np.zeros((len(t), 3)),
        np.full(len(t), 0.05),
        np.full(len(t), -0.08),
        np.full(len(t), np.radians(heading_deg)),
        position_sigma_l=grown * [0.02, 0.03, 0.05],
        attitude_sigma_rad=grown * np.radians([0.003, 0.004, 0.008]),
        name="ins",
    )


def made(strips: Sequence[tuple[int, int, float, float]], paths: list[Trajectory], begin: int = BEGIN) -> Flight:
    """Return a flight with strips (trajectory, number, begin, end), s, of two returns each."""
    head = Head("left", nominal("left", [0, 0, 0], np.eye(3)), LineGeometry())
    swaths = tuple(
        Swath(
            f"{strip:02d}",
            0,
            strip,
            flown,
            np.zeros(2, RETURN_DTYPE),
            begin + np.rint(np.array([first, last]) * SECOND).astype(np.int64),
            np.zeros((2, 3)),
        )
        for flown, strip, first, last in strips
    )
    return Flight(Tangent.at(paths[0].position_e[0]), (head,), tuple(paths), swaths)


def test_a_covariance_made_negative_by_rounding_has_an_inverse() -> None:
    """Correlations of 1 are changed by 4 %, as for a heading known to degrees before it was known to thousandths."""
    built = made([(0, 1, 5.0, 15.0)], [level_path(50, begin=int(ns(0.0)))], begin=int(ns(0.0)))
    sound = gauss_markov(built, Taus(heading_s=1e5), 1.0)
    joint = sound.covariance.reshape(len(sound), 6, len(sound), 6).copy()
    noise = 1.0 + 0.04 * np.random.default_rng(1).standard_normal((len(sound), len(sound)))
    at = np.arange(len(sound))
    noise[at, at] = 1.0
    joint[:, 5, :, 5] *= 0.5 * (noise + noise.T)
    broken = joint.reshape(sound.covariance.shape)
    assert np.linalg.eigvalsh(broken).min() < 0.0
    prior = replace(sound, covariance=positive(broken))
    assert np.isfinite(prior.information).all()
    np.testing.assert_allclose(prior.sigmas(), sound.sigmas(), rtol=0.05)
    lines = np.ones(len(sound)) / len(sound)
    mean = np.einsum("i,iajb,j->ab", lines, prior.covariance.reshape(joint.shape), lines)
    wanted = np.einsum("i,iajb,j->ab", lines, sound.covariance.reshape(joint.shape), lines)
    np.testing.assert_allclose(np.diag(mean), np.diag(wanted), rtol=0.05)


def test_sigmas_become_gauss_markov_processes() -> None:
    """Entries are compared with the definition, for roll and pitch through the axes of rotation."""
    path = level_path(200)
    flight = made([(0, 1, 10, 30), (0, 2, 100, 110)], [path])
    prior = gauss_markov(flight, Taus(60.0, 100.0, 200.0), 5.0)
    assert prior.strip.tolist() == [1] * 6 + [2] * 4
    t = (prior.time_ns - BEGIN) / SECOND
    np.testing.assert_allclose(t[[0, 5, 6, 9]], [9.5, 30.5, 99.5, 110.5])
    assert np.diff(t)[[0, 4, 6]].max() <= 5.0
    a, b = 1, 7
    block = prior.covariance[6 * a : 6 * a + 6, 6 * b : 6 * b + 6]
    grown = (1.0 + 0.01 * t[a]) * (1.0 + 0.01 * t[b])
    faded = np.exp(-(t[b] - t[a]) / 60.0)
    np.testing.assert_allclose(block[:3, :3], np.diag([4e-4, 9e-4, 25e-4]) * grown * faded, atol=1e-12)
    np.testing.assert_allclose(block[:3, 3:], 0.0)
    h, p = np.radians(30.0), -0.08
    nose = np.array([np.cos(p) * np.cos(h), np.cos(p) * np.sin(h), -np.sin(p)])
    right, down = np.array([-np.sin(h), np.cos(h), 0.0]), np.array([0.0, 0.0, 1.0])
    wanted = sum(
        np.radians(sigma) ** 2 * np.exp(-(t[b] - t[a]) / tau) * np.outer(axis, axis)
        for axis, sigma, tau in ((nose, 0.003, 100.0), (right, 0.004, 100.0), (down, 0.008, 200.0))
    )
    np.testing.assert_allclose(block[3:, 3:], wanted * grown, rtol=1e-9)
    assert np.linalg.eigvalsh(prior.covariance).min() > 0.0
    assert "position 60 s" in prior.notes[0]


def test_trajectories_of_two_sessions_are_independent() -> None:
    """Strips of the two sessions with the same number are different strips."""
    second = level_path(60, BEGIN + 100 * SECOND)
    flight = made([(0, 1, 5, 20), (1, 1, 105, 120)], [level_path(60), second])
    prior = gauss_markov(flight)
    cut = 6 * int((prior.trajectory_index == 0).sum())
    assert 0 < cut < len(prior.covariance)
    assert not prior.covariance[:cut, cut:].any()
    assert prior.covariance[:cut, :cut].all(axis=None) == np.False_
    assert (np.diff(prior.time_ns[prior.trajectory_index == 1]) > 0).all()


@pytest.mark.slow
def test_knots_are_widened_and_reported_if_there_would_be_too_many() -> None:
    """The knots that are left are spread evenly over all strips; strips that meet keep separate knots."""
    flight = made([(0, 1, 10, 60), (0, 2, 60.4, 90), (0, 3, 120, 180)], [level_path(200)])
    knots = knots_of(flight, 1.0, most=40)
    assert knots.widened
    assert len(knots) <= 40
    assert 3.0 < knots.apart_s < 4.5
    assert (np.diff(knots.time_ns) > 0).all()
    t = (knots.time_ns - BEGIN) / SECOND
    assert t[knots.strip == 1].max() <= 60.2
    assert t[knots.strip == 2].min() >= 60.2
    narrow = knots_of(flight, 5.0)
    assert not narrow.widened
    assert len(gauss_markov(flight, knot_s=0.2).notes) == 2


@pytest.mark.parametrize("column", ["position_sigma_l", "attitude_sigma_rad"])
def test_a_trajectory_without_sigmas_is_refused(column: str) -> None:
    path = level_path(60)
    silent = getattr(path, column).copy()
    silent[200:] = np.nan
    told = replace(path, **{column: silent})
    what = column.split("_", maxsplit=1)[0]
    assert len(gauss_markov(made([(0, 1, 5, 15)], [told]))) == 4
    with pytest.raises(FlightError, match=rf"trajectory ins has no {what} sigma at GPS week .*: put an smrmsg"):
        gauss_markov(made([(0, 1, 5, 30)], [told]))


def test_impossible_trajectory_priors_are_refused() -> None:
    with pytest.raises(FlightError, match="no strip with returns; at least one is needed"):
        knots_of(made([], [level_path(10)]), 5.0)
    with pytest.raises(FlightError, match="the knots are 0 s apart; the interval must"):
        knots_of(made([(0, 1, 1, 5)], [level_path(10)]), 0.0)


# ---------------------------------------------------------------------- drawn and applied


@pytest.mark.slow
def test_drawn_errors_have_the_covariance() -> None:
    """20 000 draws, with one component known exactly and two identical ones, agree within the sampling error."""
    flight = made([(0, 1, 10, 15)], [level_path(60)])
    prior = gauss_markov(flight)
    factor = prior.covariance.copy()
    factor[4] = factor[:, 4] = 0.0
    factor[7] = factor[1]
    factor[:, 7] = factor[:, 1]
    factor[7, 7] = factor[1, 1]
    prior = replace(prior, covariance=factor)
    rng = np.random.default_rng(5)
    drawn = np.array([draw(prior, rng).ravel() for _ in range(20_000)])
    assert not drawn[:, 4].any()
    sigma = np.sqrt(np.diag(factor))
    sigma[4] = 1.0
    np.testing.assert_allclose(drawn[:, 1], drawn[:, 7], atol=1e-6 * sigma[1])
    found = np.cov(drawn.T, bias=True) / np.outer(sigma, sigma)
    np.testing.assert_allclose(found, factor / np.outer(sigma, sigma), atol=0.04)  # 4 √2 / √20000


def test_applied_errors_move_and_rotate_the_body() -> None:
    """Errors are linear between knots and constant beyond them, on one trajectory; turns about down change heading."""
    path = level_path(60)
    time_ns = BEGIN + np.array([10, 20, 40], np.int64) * SECOND
    prior = TrajectoryPrior(np.array([0, 0, 0]), time_ns, np.array([1, 1, 2]), np.eye(18))
    errors = np.zeros((3, 6))
    errors[:, 2], errors[:, 5] = [0.0, 1.0, 0.0], [1e-4, 3e-4, 1e-4]
    moved = apply(path, 0, prior, errors)
    assert apply(path, 1, prior, errors) is path
    at = np.searchsorted(path.time_ns, BEGIN + np.array([0, 15, 30, 55], np.int64) * SECOND)
    np.testing.assert_allclose(path.geodetic()[2][at] - moved.geodetic()[2][at], [0.0, 0.5, 0.5, 0.0], atol=1e-6)
    turned = moved.attitude()[2][at] - path.attitude()[2][at]
    np.testing.assert_allclose(turned, [1e-4, 2e-4, 2e-4, 1e-4], atol=1e-9)
    errors[:, 5], errors[:, 3] = 0.0, 2e-4
    rolled = apply(level_path(60, heading_deg=0.0), 0, prior, errors)
    np.testing.assert_allclose(rolled.attitude()[0] - path.attitude()[0], 2e-4 / np.cos(0.08), rtol=1e-3)
    back = apply(moved, 0, prior, -np.concatenate([errors[:, :3], [[0, 0, 1e-4], [0, 0, 3e-4], [0, 0, 1e-4]]], axis=1))
    np.testing.assert_allclose(back.position_e, path.position_e, atol=1e-8)
    np.testing.assert_allclose(back.q_e_from_b, path.q_e_from_b, atol=1e-15)
