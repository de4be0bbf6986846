"""Tests how an error model is made, with errors whose offsets, noise and correlations are known."""

from __future__ import annotations

import numpy as np
import pytest

from swath.georef.arrays import FloatArray
from swath.georef.error_model.build import (
    Sample,
    azimuth_of,
    correlations_in_time,
    joint_turned,
    noise_of,
    offsets_of,
    turned_to_map,
    unmodelled_of,
)
from swath.georef.error_model.correlation import Correlation
from swath.georef.error_model.model import GROUP_OF, offset_columns, path_axes
from tests.georef.error_model.builders import SECOND

NOISE = np.array([0.02, 2e-5, 2e-5])
AZIMUTH = np.radians(200.0)
SIGMAS = np.array([0.01, 0.02, 0.03, 1e-4, 2e-4, 3e-4, 0.02])


def seen(count: int = 300) -> tuple[FloatArray, FloatArray]:
    """Return points and body positions of beams to both sides of a path 500 m above rough ground."""
    rng = np.random.default_rng(2)
    angle, at = rng.uniform(-0.5, 0.5, count), rng.uniform(0.0, 3000.0, count)
    position = path_axes(AZIMUTH)[:, 0] * at[:, np.newaxis] + [0.0, 0.0, 600.0]
    far = 500.0 * rng.uniform(0.95, 1.05, count) / np.cos(angle)
    beam = np.stack([far * 0.02 * rng.standard_normal(count), far * np.sin(angle), far * np.cos(angle)], axis=1)
    return position + beam @ path_axes(AZIMUTH).T, position


def sample(calibration_m: FloatArray, noise_m: FloatArray | None = None) -> Sample:
    """Return a sample of `seen`."""
    points, position = seen(len(calibration_m))
    return Sample(points, position, calibration_m, np.zeros((len(points), 1, 3)) if noise_m is None else noise_m)


def test_offsets_that_made_the_errors_are_found() -> None:
    points, position = seen()
    truth = np.random.default_rng(5).standard_normal((4, 7)) * SIGMAS
    effect = np.einsum("nij,qj->nqi", offset_columns(points - position, AZIMUTH), truth)
    found, left = offsets_of(sample(effect), AZIMUTH)
    np.testing.assert_allclose(found, truth, rtol=1e-6, atol=1e-12)
    assert np.abs(left).max() < 1e-10


def test_what_offsets_do_not_describe_is_the_unmodelled_error() -> None:
    """An error that bends the swath, as a scale of the scan angle does, fades across the path and lasts along it."""
    points, position = seen(2000)
    across = (points - position) @ path_axes(AZIMUTH)[:, 1]
    bent = np.zeros((2000, 1, 3))
    bent[:, 0, 2] = 0.02 * np.cos(across / 60.0)
    of = sample(bent)
    offsets, left = offsets_of(of, AZIMUTH)
    covariance, (u, v, w) = unmodelled_of(of, left, AZIMUTH)
    assert covariance[2, 2] == pytest.approx(np.var(bent[:, 0, 2]), rel=0.1)
    assert float(u.at(1000.0)) > 0.99 < float(w.at(30.0))
    assert float(v.at(5.0)) > 0.8
    assert float(v.at(150.0)) < 0.4
    assert np.linalg.norm(offsets[0] * [1, 1, 1, 500, 500, 500, 1]) < 0.02
    none, _ = unmodelled_of(of, np.zeros_like(left), AZIMUTH)
    np.testing.assert_array_equal(none, 0.0)


def test_noise_is_told_along_the_beam_and_at_right_angles_to_it() -> None:
    points, position = seen()
    beam = points - position
    far = np.linalg.norm(beam, axis=1, keepdims=True)
    side = np.cross(beam / far, path_axes(AZIMUTH)[:, 0])
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    noise = np.stack([0.02 * beam / far, 3e-5 * far * side, 1e-5 * far * np.cross(side, beam / far)], axis=1)
    np.testing.assert_allclose(noise_of(sample(np.zeros((300, 1, 3)), noise), AZIMUTH), [0.02, 3e-5, 1e-5], rtol=1e-9)


def test_correlations_of_a_known_process_are_found_in_its_joint_covariance() -> None:
    truth = [
        Correlation(1.0, 0.0, 0.0, 40.0),
        Correlation(1.0, 0.2, 0.5, 25.0),
        Correlation(0.9, 0.0, 0.0, 100.0),
        Correlation(1.0, 0.5, 0.0, 80.0),
    ]
    time_ns = np.arange(0, 300, 5, dtype=np.int64) * SECOND
    lag = (time_ns[:, np.newaxis] - time_ns) / SECOND
    rng = np.random.default_rng(1)
    mixed = np.eye(6) + 0.2 * rng.standard_normal((6, 6))
    values, vectors = np.linalg.eigh(mixed @ mixed.T)
    sigma = np.diag([0.02, 0.02, 0.03, 5e-5, 5e-5, 1e-4])
    scale = np.sqrt(np.diag(mixed @ mixed.T))
    correlation = (vectors * values) @ vectors.T / np.outer(scale, scale)
    values, vectors = np.linalg.eigh(correlation)
    azimuth = np.where(np.arange(len(time_ns)) < 30, AZIMUTH, AZIMUTH + np.pi)  # flown to and fro
    turn = np.array([np.kron(np.diag([0.0, 1.0]), path_axes(one)) + np.diag([1, 1, 1, 0, 0, 0]) for one in azimuth])
    root = turn @ sigma @ (vectors * np.sqrt(values)) @ vectors.T
    joint = np.zeros((len(time_ns), 6, len(time_ns), 6))
    for error, group in enumerate(GROUP_OF):
        joint += np.einsum("jk,ja,kb->jakb", truth[group].at(lag), root[:, :, error], root[:, :, error])
    size = 6 * len(time_ns)
    for one, expected in zip(
        correlations_in_time(time_ns, joint.reshape(size, size), azimuth, NOISE), truth, strict=True
    ):
        np.testing.assert_allclose(one.correlation.at([5.0, 50.0, 200.0]), expected.at([5.0, 50.0, 200.0]), atol=0.02)
        assert one.rms < 0.01


def test_covariances_are_turned_from_north_east_down() -> None:
    rot_m_from_l = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    covariance_l = np.diag([1.0, 4.0, 9.0, 16.0, 25.0, 36.0])
    covariance_l[0, 2] = covariance_l[2, 0] = 0.5
    found = turned_to_map(covariance_l, rot_m_from_l)
    np.testing.assert_array_equal(np.diag(found), [4.0, 1.0, 9.0, 25.0, 16.0, 36.0])
    assert found[1, 2] == -0.5
    joint: FloatArray = np.kron([[1.0, 0.5], [0.5, 2.0]], covariance_l).astype(np.float64)
    np.testing.assert_array_equal(joint_turned(joint, rot_m_from_l), np.kron([[1.0, 0.5], [0.5, 2.0]], found))


def test_the_azimuth_of_a_path_counts_from_northing_clockwise() -> None:
    assert np.degrees(azimuth_of(np.array([[0.0, 0.0, 0.0], [1.0, 1.0, 0.0], [10.0, 0.0, 5.0]]))) == pytest.approx(90.0)
