"""Tests the smoother: the formulas of Rauch, Tung and Striebel, reference flights, smoothness between nodes."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from swath.georef.arrays import FloatArray
from swath.georef.geodesy.quaternions import conjugate, product, rotation_vector
from swath.georef.navigation.filter.error_model import MOVED
from swath.georef.navigation.filter.filter import FilterRun, run_filter, start_state
from swath.georef.navigation.filter.smoother import difference, forward, smooth, smooth_nodes, solution_of
from swath.georef.navigation.inputs import GRADES, Kind, Solution, Start
from tests.georef.navigation.flights import Fixes, drawn_start, errors, fly, noised, setup_for, survey
from tests.georef.navigation.scores import (
    LINES_S,
    OUTAGES_M,
    SMOOTHER,
    flight_errors,
    of_maxima,
    outages,
    rms,
    start_of,
    without,
)
from tests.georef.navigation.vehicles import reference

pytestmark = pytest.mark.xdist_group("kernels")

ARM = np.array([0.35, -0.12, -1.1])


@pytest.mark.slow
@pytest.mark.parametrize("name", ["tactical", "mems"])
def test_the_reference_flight_is_smoothed_as_accurately_as_published(name: str) -> None:
    """With positions only, each figure is within a tenth of the smoother in the data set's README, in outages too."""
    flown, start = reference(name), start_of("reference_flight", name)
    rows = flown.only(Kind.POSITION)
    solution = smooth(run_filter(flown.inertial, rows, flown.setup, start))
    _, off = flight_errors(name, solution, LINES_S)
    assert (rms(off) <= 1.10 * np.array(SMOOTHER[name])).all(), rms(off)
    inside = (solution.time_ns >= start.time_ns + 580 * 10**9) & (solution.time_ns <= start.time_ns + 1530 * 10**9)
    predicted = rms(solution.position_sigma_l[inside])
    assert (np.abs(rms(off)[:3] / predicted - 1.0) < 0.2).all()
    spans = outages(name)
    lost = smooth(run_filter(flown.inertial, without(rows, spans), flown.setup, start))
    t, off = flight_errors(name, lost, (spans.min(), spans.max() + 1.0))
    assert of_maxima(t, np.linalg.norm(off[:, :3], axis=1), spans) < 1.10 * OUTAGES_M[name][1]


def flown(seed: int, start: Start | None = None, **setup_keys: Any) -> FilterRun:
    truth = fly(survey(), 60.0, 50.0)
    inertial, rows = noised(truth, GRADES["mems"], Fixes(velocity_mps=0.05), ARM, seed)
    rows = rows[(rows["time_ns"] % 10**10 < 3 * 10**9) | (rows["kind"] == Kind.POSITION)]
    rows = rows[
        (rows["time_ns"] < rows["time_ns"][0] + 20 * 10**9) | (rows["time_ns"] > rows["time_ns"][0] + 35 * 10**9)
    ]
    setup = replace(setup_for(GRADES["mems"], ARM), **setup_keys)
    return run_filter(inertial, rows, setup, start or drawn_start(truth, seed))


def dense(packed: FloatArray, n: int) -> FloatArray:
    p = np.zeros((n, n))
    p[np.tril_indices(n)] = packed
    return p + np.tril(p, -1).T


def rauch_tung_striebel(run: FilterRun) -> tuple[FloatArray, FloatArray]:
    """Return smoothed errors (m, n) and variances (m, n) from the filter's run, by C = P Φᵀ P⁻¹ with inverses."""
    n, [block] = run.layout.size, run.nodes
    m = len(block.time_ns)
    error, p = np.zeros(n), dense(block.covariance[m - 1], n)
    out, variance = np.empty((m, n)), np.empty((m, n))
    end = len(block.h)
    for k in range(m - 1, -1, -1):
        out[k], variance[k] = error, np.diag(p)
        if k == 0:
            break
        ahead, correction = dense(block.covariance[k], n), np.zeros(n)
        for i in range(block.first[k], end):
            gain, (of_nu, inverse) = block.gain[i], block.weighed[i]
            ahead += np.outer(gain, gain) / inverse
            correction += gain * of_nu / inverse
        end = block.first[k]
        phi = np.diag(block.decay[k])
        phi[:MOVED, : run.layout.core] = block.top[k]
        behind = dense(block.covariance[k - 1], n)
        scale = np.sqrt(np.diag(ahead))
        gains = behind @ phi.T @ (np.linalg.inv(ahead / np.outer(scale, scale)) / np.outer(scale, scale))
        error = gains @ (error + correction)
        p = behind + gains @ (p - ahead) @ gains.T
    return out, variance


def test_the_adjoint_smoother_equals_rauch_tung_striebel() -> None:
    """All optional states are estimated across an outage of 15 s; the reference uses the formulas with inverses."""
    run = flown(1, estimate_lever_arm=0.1, estimate_time_offset_s=0.01, gnss_correlated_share=0.4)
    errors_there, variance = rauch_tung_striebel(run)
    nodes = smooth_nodes(run)
    size = np.sqrt(variance)
    np.testing.assert_allclose(nodes.leave / size[:, :9], errors_there[:, :9] / size[:, :9], rtol=0, atol=1e-4)
    np.testing.assert_allclose(nodes.sensor_sigma, size[:, 9:], rtol=1e-4)
    block = run.nodes[0]
    learnt = nodes.state[:, 10:22] - block.after[:, 10:22]
    np.testing.assert_allclose(learnt / size[:, 9:21], errors_there[:, 9:21] / size[:, 9:21], rtol=0, atol=1e-4)


def test_a_start_off_its_mean_equals_one_begun_there() -> None:
    """The run begins 50 µrad off the mean that is known, and the smoother is given that mean.

    States agree to a hundredth of a sigma, sigmas to a thousandth.
    """
    keys: dict[str, Any] = {"estimate_time_offset_s": 0.01, "gnss_correlated_share": 0.4}
    there, off = flown(1, **keys), np.array([5e-5, -3e-5, 4e-5])
    begun = replace(there.start, attitude_rad=there.start.attitude_rad + off)
    run = flown(1, begun, **keys)
    mean = np.zeros(run.layout.size)
    difference(start_state(run.setup, there.start), start_state(run.setup, begun), mean[:MOVED])
    expected, blind, found = smooth_nodes(there), smooth_nodes(run), smooth_nodes(run, mean)
    turned = [rotation_vector(product(q.state[:, 6:10], conjugate(expected.state[:, 6:10]))) for q in (blind, found)]
    least = expected.sigma[:, 6:].min()
    assert np.abs(turned[0]).max() > 0.05 * least
    assert np.abs(turned[1]).max() < 5e-3 * least
    assert (np.abs(found.state - expected.state)[:, :6] < 1e-2 * expected.sigma[:, :6].min(axis=0)).all()
    np.testing.assert_allclose(found.sigma, expected.sigma, rtol=1e-3)
    np.testing.assert_allclose(found.separation[:, 6:], expected.separation[:, 6:], rtol=0, atol=1e-2 * least)


def test_a_sensor_without_errors_is_harmless() -> None:
    """The covariance of perfectly known scale factors is singular, so a smoother with inverses would fail."""
    truth = fly(survey(), 40.0, 50.0)
    noise = replace(GRADES["tactical"], gyro_scale=0.0, accel_scale=0.0)
    inertial, rows = noised(truth, noise, Fixes(), ARM, 2)
    solution = smooth(run_filter(inertial, rows, setup_for(noise, ARM), drawn_start(truth, 2)))
    assert (solution.gyro_scale == 0.0).all()
    assert (solution.accel_scale_sigma == 0.0).all()
    off = errors(truth, truth.edges[1:], solution.position_e, solution.velocity_e, solution.q_e_from_b)
    assert (rms(off[:, :3]) < 0.02).all()


def test_the_path_between_nodes_is_smooth() -> None:
    """The filter jumps at a node; a smoothed position must move by its velocity in each sample."""
    run = flown(3)

    def steps(solution: Solution) -> float:
        mean = (solution.velocity_e[1:] + solution.velocity_e[:-1]) / 2.0
        return float(np.abs(np.diff(solution.position_e, axis=0) - 0.02 * mean).max())

    assert steps(forward(run)) > 5e-3
    assert steps(smooth(run)) < 2e-4


def test_parts_of_a_run_equal_the_whole() -> None:
    """A long flight is written piece by piece, so a piece must not depend on where it is cut."""
    run = flown(4)
    nodes = smooth_nodes(run)
    whole = solution_of(run, nodes)
    pieces = [solution_of(run, nodes, first, first + 999) for first in range(0, len(whole), 999)]
    for column in ("time_ns", "position_e", "velocity_e", "q_e_from_b", "position_sigma_l", "attitude_sigma_rad"):
        np.testing.assert_array_equal(
            np.concatenate([getattr(piece, column) for piece in pieces]), getattr(whole, column)
        )


def test_forward_and_smoothed_solutions_differ_as_their_sigmas_predict() -> None:
    """The squared separation over its variance, P forward − P smoothed, is near 1 over the whole flight."""
    ratios = []
    for seed in range(8):
        solution = smooth(flown(seed))
        inside = solution.separation_sigma[1:-1, :6] > 1e-6
        ratios.append((solution.separation[1:-1, :6][inside] / solution.separation_sigma[1:-1, :6][inside]) ** 2)
    assert 0.7 < np.concatenate(ratios).mean() < 1.35
