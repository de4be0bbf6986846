"""Tests redundancy, statistical tests and groups against a dense solution and printed values."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from swath.calib.adjust import adjust
from swath.calib.equations.normals import extras
from swath.calib.equations.robust import HUBER, least_detectable, least_shift, w_critical
from swath.calib.equations.rows import Rows, State
from swath.calib.equations.solve import Block, Settings, solved
from swath.calib.equations.trajectory_prior import Taus, gauss_markov
from swath.calib.features import Features
from swath.calib.parameters import ParameterOptions, unknowns
from swath.georef.arrays import FloatArray, Int64Array
from tests.calib.builders import controlled, design, in_planes
from tests.calib.printed import printed
from tests.calib.roofs import LINES, made

pytestmark = pytest.mark.xdist_group("kernels")
PLAIN = Settings(huber=0.0, family=0.0)


def test_limits_match_the_printed_values() -> None:
    assert least_shift() == pytest.approx(4.13215, abs=1e-5)
    assert w_critical(10) == pytest.approx(3.2905, abs=1e-4)
    assert w_critical(10_000_000) == pytest.approx(stats.norm.isf(0.05 / 2e7))
    np.testing.assert_allclose(least_detectable(np.array([4.0]), np.array([0.25])), 4.13215 * 4.0, rtol=1e-5)


def test_huber_weight_matches_the_printed_value() -> None:
    """After four rounds of six steps, with weights of the last solution, a blunder of 0.6 m gets 0.185."""
    flight, features = printed().with_blunder().flight()
    block = Block.of(flight, features, unknowns(flight, ParameterOptions()), None, None)
    done = solved(block, Settings(huber=HUBER, family=0.0, rounds=0, tolerance=1e-3), block.start())
    (residuals,) = done.quality.residuals
    size = residuals.misclosure_m.astype(float) / residuals.sigma_m
    alone = np.zeros(len(size), np.float32)
    alone[int(np.abs(residuals.normalised).argmax())] = 1.0
    square = block.rows.summed(done.solution.state, alone, HUBER).square[0]
    assert square / (alone @ size**2) == pytest.approx(0.18467852582257605, abs=2e-3)
    every = block.rows.summed(done.solution.state, np.ones(len(size), np.float32), HUBER).square[0]
    assert every == pytest.approx(float(np.where(np.abs(size) > HUBER, HUBER * np.abs(size), size**2).sum()), rel=1e-5)


def test_redundancy_matches_the_dense_solution() -> None:
    built = made(lines=LINES[:4], points=5)
    prior = gauss_markov(built.flight, Taus(), 5.0)
    features = controlled(built)
    block = Block.of(built.flight, features, unknowns(built.flight, ParameterOptions()), prior, None)
    done = solved(block, replace(PLAIN, tolerance=1e-5), block.start())
    rows, state = done.solution.rows, done.solution.state
    columns, misclosure, variance, _ = design(rows, state)
    u, q = rows.size, len(rows.planes)
    whole = np.zeros((rows.count, u + 3 * q))
    whole[:, :u] = columns
    for row, (place, which) in enumerate(zip(*in_planes(rows, state), strict=True)):
        whole[row, u + 3 * which : u + 3 * which + 3] = *place, 1.0
    whole /= np.sqrt(variance)[:, np.newaxis]
    more = np.zeros((10, u + 3 * q))
    for row, extra in enumerate(extras(rows, state)):
        more[row, u + 3 * extra.plane : u + 3 * extra.plane + 3] = extra.design
    every = np.vstack([whole, more])
    normal = every.T @ every
    normal[4:u, 4:u] += done.solution.trajectory.normal
    scale = 1 / np.sqrt(np.diag(normal))
    cofactor = np.linalg.inv(normal * np.outer(scale, scale)) * np.outer(scale, scale)
    expected = 1.0 - np.einsum("ij,jk,ik->i", every, cofactor, every)
    on_planes, on_control = done.quality.residuals
    np.testing.assert_allclose(on_planes.redundancy, expected[:-10], atol=2e-6)
    np.testing.assert_allclose(on_control.redundancy, expected[-10:], atol=1e-6)
    w = -misclosure / np.sqrt(variance * expected[:-10])
    np.testing.assert_allclose(on_planes.normalised, w, atol=1e-4)
    assert done.quality.redundancy == pytest.approx(rows.count + 10 - 4 - 3 * q, abs=1e-3)
    groups = {fit.group: fit for fit in done.quality.groups}
    assert groups["trajectory"].redundancy == pytest.approx(6 * len(prior.time_ns) - np.trace(
        done.solution.trajectory.normal @ cofactor[4:u, 4:u]
    ), abs=1e-6)  # fmt: skip
    assert groups["planes"].variance_factor * groups["planes"].redundancy == pytest.approx(
        float((misclosure**2 / variance).sum()), rel=1e-5
    )


def sharing(rows: Rows, state: State) -> tuple[Int64Array, FloatArray, FloatArray]:
    """Return (n,) of each row its run, the variance M and the variance c that its run has in common, m²."""
    run_of, variance, common, count = [], [], [], 0
    for batch, looks in rows.looks(state):
        begin = 0
        for run in batch.runs:
            mine = slice(begin, begin + len(run.at))
            first = len(rows.expansion(run, state.normal_e[run.plane])[0]) - 12
            states = looks.design[mine, first : first + 8]
            lever = states[:, 2:5] + states[:, 5:8]
            assert rows.prior is not None
            walk = rows.prior.walk_rad2[run.before]
            common.append(states[:, 0] * states[:, 1] * walk * (lever**2).sum(axis=1))
            run_of.append(np.full(len(run.at), count))
            begin, count = mine.stop, count + 1
        variance.append(looks.variance)
    return np.concatenate(run_of), np.concatenate(variance), np.concatenate(common)


def test_redundancy_of_correlated_rows_matches_the_dense_solution() -> None:
    """The expected covariance of residuals is (I − H) V (I − H)ᵀ, with V of noise and of the runs' common errors."""
    built = made(lines=LINES[:4], points=25)
    prior = gauss_markov(built.flight, Taus(), 5.0)
    prior = replace(prior, walk_rad2=np.full(len(prior), (6e-5) ** 2))
    block = Block.of(built.flight, built.features, unknowns(built.flight, ParameterOptions()), prior, None)
    done = solved(block, PLAIN, block.start())
    rows, state, u = done.solution.rows, done.solution.state, done.solution.rows.size
    run_of, variance, common = sharing(rows, state)
    assert 0.2 < np.median(common / variance) < 1.0
    every = np.zeros((rows.count, u + 3 * len(rows.planes)))
    every[:, :u] = design(rows, state)[0]
    for row, (place, which) in enumerate(zip(*in_planes(rows, state), strict=True)):
        every[row, u + 3 * which : u + 3 * which + 3] = *place, 1.0
    together = np.bincount(run_of)[run_of]
    weighted = every / (variance + together * common)[:, np.newaxis]
    normal = every.T @ weighted
    normal[4:u, 4:u] += done.solution.trajectory.normal
    scale = 1 / np.sqrt(np.diag(normal))
    cofactor = np.linalg.inv(normal * np.outer(scale, scale)) * np.outer(scale, scale)
    root = np.sqrt(common)
    spread = np.diag(variance) + np.outer(root, root) * (run_of[:, np.newaxis] == run_of)
    inner = weighted.T @ spread @ weighted
    inner[4:u, 4:u] += done.solution.trajectory.normal
    taken = np.einsum("ij,ji->i", every @ cofactor, weighted.T @ spread)
    moved = np.einsum("ij,jk,ik->i", every, cofactor @ inner @ cofactor, every)
    expected = np.diag(spread) - 2.0 * taken + moved
    (residuals,) = done.quality.residuals
    np.testing.assert_allclose(residuals.sigma_m, np.sqrt(variance + common), rtol=1e-5)
    assert residuals.redundancy.sum() == pytest.approx((expected / np.diag(spread)).sum(), rel=0.01)
    of_w = expected / (np.diag(spread) * residuals.redundancy)  # the variance of w
    assert 0.97 < of_w.mean() < 1.03
    assert 0.85 < np.quantile(of_w, 0.01)
    assert np.quantile(of_w, 0.99) < 1.15


def test_variance_factor_of_correlated_rows_is_one() -> None:
    """Each run of returns gets a common error as large as the prior states."""
    built, factors, rejected = made(lines=LINES[:4], points=25), [], 0
    prior = gauss_markov(built.flight, Taus(), 5.0)
    prior = replace(prior, walk_rad2=np.full(len(prior), (8e-5) ** 2))
    seen = Rows(built.flight, built.features.planes, unknowns(built.flight, ParameterOptions()), prior)
    run_of, variance, common = sharing(seen, seen.start())
    assert np.median(common / variance) > 0.3
    along = np.concatenate([looks.along for _, looks in seen.looks(seen.start())])
    for seed in range(4):
        error_m = np.sqrt(common) * np.random.default_rng(seed).standard_normal(run_of[-1] + 1)[run_of] / along
        swaths = list(built.flight.swaths)
        for batch in seen.batches:
            at, ranges = np.concatenate([run.at for run in batch.runs]), swaths[batch.swath].rows.copy()
            ranges["range_m"][at] += error_m[batch.begin : batch.begin + batch.size]
            swaths[batch.swath] = replace(swaths[batch.swath], rows=ranges)
        found = adjust(replace(built.flight, swaths=tuple(swaths)), built.features, ParameterOptions(), prior)
        planes = next(fit for fit in found.groups if fit.group == "planes")
        factors.append(planes.variance_factor)
        rejected += planes.rejected
    assert np.mean(factors) == pytest.approx(1.0, abs=0.05)
    assert rejected <= 3


def test_variance_components_show_which_group_is_worse() -> None:
    """The control points scatter by 5 cm but state 1 cm."""
    built = made()
    prior = gauss_markov(built.flight, Taus(), 4.0)
    features, g = controlled(built), np.random.default_rng(3)
    planes = list(features.planes)
    for index in range(0, 25, 5):
        points = tuple(
            replace(point, position_t=point.position_t + np.array([0.0, 0.0, 0.05 * g.normal()]))
            for point in planes[index].control
        )
        planes[index] = replace(planes[index], control=points)
    found = adjust(built.flight, Features(tuple(planes)), ParameterOptions(), prior, PLAIN)
    groups = {fit.group: fit for fit in found.groups}
    assert groups["control"].variance_factor > 5.0
    assert 0.9 < groups["planes"].variance_factor < 1.1


def test_unusable_returns_are_not_counted() -> None:
    built = made(lines=LINES[:4])
    prior = gauss_markov(built.flight, Taus(), 4.0)
    head = replace(built.flight.heads[0], range_gate=(0.0, 850.0))
    lost = sum(int((swath.rows["range_m"] + 0.18 > 850.0).sum()) for swath in built.flight.swaths)
    found = adjust(replace(built.flight, heads=(head,)), built.features, ParameterOptions(), prior)
    (residuals,) = found.residuals
    assert lost > 10
    assert abs(int((residuals.weight == 0.0).sum()) - lost) <= 1
    assert np.isfinite(found.values).all()
    assert 0.85 < found.variance_factor < 1.15


def test_errors_of_the_minimal_detectable_size_are_found_as_often_as_stated() -> None:
    """Errors of that size are found with a probability of 0.8 at |w| > 3.29, with one error in each range in turn."""
    built = made(lines=LINES[:4])
    prior = gauss_markov(built.flight, Taus(), 4.0)
    found = adjust(built.flight, built.features, ParameterOptions(), prior, PLAIN)
    (residuals,) = found.residuals
    shift = least_detectable(residuals.sigma_m.astype(float) ** 2, residuals.redundancy.astype(float))
    w = residuals.normalised + shift * np.sqrt(residuals.redundancy) / residuals.sigma_m
    share = float((np.abs(w) > 3.2905).mean())
    assert share == pytest.approx(0.8, abs=0.04)
    assert 0.05 < found.least_detectable["range_m"] < 0.2
