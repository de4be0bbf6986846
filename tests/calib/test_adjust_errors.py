"""Tests an adjustment's sigmas against its true errors, over many runs with correlated trajectory errors."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from swath.calib.adjust import adjust
from swath.calib.equations.normals import TrajectoryWeight
from swath.calib.equations.rows import Rows
from swath.calib.equations.solve import Settings
from swath.calib.equations.trajectory_prior import Taus, gauss_markov
from swath.calib.parameters import ParameterOptions, unknowns
from tests.calib.builders import shifted
from tests.calib.roofs import LINES, made, trajectory

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("kernels")]

RUNS = 100


def test_errors_over_many_runs_are_as_large_as_their_sigmas() -> None:
    """Trajectory errors are drawn from their prior; NEES and intervals of every parameter are checked."""
    lines = LINES[:6]
    flown = trajectory(lines)
    base = made(lines=lines, points=4, seed=5)
    prior = gauss_markov(base.flight, Taus(), 4.0)
    weight = TrajectoryWeight(Rows(base.flight, (), unknowns(base.flight, ParameterOptions()), prior))
    root, g = np.linalg.cholesky(prior.covariance), np.random.default_rng(2024)
    offs, inside = [], 0
    for run in range(RUNS):
        errors = weight.to_e((root @ g.normal(size=len(root)))[:, np.newaxis]).reshape(-1, 6)
        true = shifted(flown, prior, errors)
        built = made(lines=lines, points=4, seed=100 + run, true=true)
        found = adjust(built.flight, built.features, ParameterOptions(), prior, Settings(huber=0.0, family=0.0))
        off = (found.values - built.truth.parameters[:4]) / found.sigmas
        offs.append(off)
        inside += int((np.abs(off) < 1.96).sum())
        assert found.converged
    nees = (np.array(offs) ** 2).mean(axis=0)
    low, high = stats.chi2.ppf([0.0005, 0.9995], RUNS) / RUNS
    assert ((nees > low) & (nees < high)).all(), nees
    assert stats.binomtest(inside, 4 * RUNS, 0.95).pvalue > 1e-3
