"""Tests the error model: its partials against differences, its covariances against the formulas written out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from swath.georef.arrays import FloatArray
from swath.georef.error_model.accuracy import ce90, le90
from swath.georef.error_model.correlation import Correlation
from swath.georef.error_model.model import (
    GROUP_OF,
    ErrorModel,
    ErrorModelError,
    Unit,
    normalised_time,
    offset_columns,
    path_axes,
    post_roots,
)
from tests.georef.error_model.builders import SECOND, SLOW, unit

pytestmark = pytest.mark.xdist_group("kernels")


def turn(axis: int, angle: float) -> FloatArray:
    """Return the matrix of a turn about axis 0, 1 or 2, written out."""
    cos, sin = np.cos(angle), np.sin(angle)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    matrix = np.eye(3)
    matrix[i, i] = matrix[j, j] = cos
    matrix[i, j], matrix[j, i] = -sin, sin
    return matrix


def moved(beam_m: FloatArray, azimuth: float, offsets: FloatArray) -> FloatArray:
    """Return where a beam ends with offsets, by the projective model of FORMULAS 10.2."""
    axes = path_axes(azimuth)
    r = axes.T @ beam_m
    turned = turn(0, offsets[3]) @ turn(1, offsets[4]) @ turn(2, offsets[5]) @ r
    found: FloatArray = axes @ (offsets[:3] + turned * (1.0 + offsets[6] / np.linalg.norm(r)))
    return found


def test_the_worked_number_of_the_formula_sheet() -> None:
    """Line of sight 20° right, 1000 m below, heading 75° (FORMULAS 10.5)."""
    azimuth = np.radians(75.0)
    beam = path_axes(azimuth) @ [0.0, 1000.0 * np.tan(np.radians(20.0)), 1000.0]
    columns = offset_columns(beam[np.newaxis], azimuth)[0]
    sigmas = np.array([0.03, 0.03, 0.05, *np.radians([0.003, 0.003, 0.007]), 0.02])
    covariance = columns * sigmas**2 @ columns.T
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), [0.074092, 0.061787, 0.056713], atol=5.1e-7)
    assert ce90(covariance[:2, :2]) == pytest.approx(0.14665232057313413, rel=1e-9)
    assert le90(covariance[2, 2]) == pytest.approx(0.09328502336591436, rel=1e-7)
    half_a_second = 2.0 * covariance * (1.0 - float(Correlation(1.0, 0.0, 0.0, 20.0).at(0.5)))
    np.testing.assert_allclose(np.sqrt(np.diag(half_a_second)), [0.016464, 0.013730, 0.012603], atol=5.1e-7)


def test_partials_equal_differences() -> None:
    rng = np.random.default_rng(3)
    for azimuth, beam in zip(rng.uniform(0.0, 6.0, 5), rng.uniform(-1.0, 0.0, (5, 3)) * [500, 500, 1500], strict=True):
        differences = [(moved(beam, azimuth, step) - moved(beam, azimuth, -step)) / 2e-6 for step in np.eye(7) * 1e-6]
        np.testing.assert_allclose(offset_columns(beam[np.newaxis], azimuth)[0], np.transpose(differences), atol=1e-5)


def test_normalised_times_are_minus_one_to_one() -> None:
    assert normalised_time(130 * SECOND, 100 * SECOND, 200 * SECOND) == pytest.approx(-0.4, abs=1e-15)
    np.testing.assert_array_equal(normalised_time([100, 200], 100, 200), [-1.0, 1.0])


def written_out(one: Unit, other: Unit, place: FloatArray, place_2: FloatArray, at: int, at_2: int) -> FloatArray:
    """Return the cross-covariance of two points at posts ``at`` and ``at_2``, term by term."""

    def parts(unit: Unit, place: FloatArray, at: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        beam = place - unit.position_m[at]
        skew = np.array([[0, -beam[2], beam[1]], [beam[2], 0, -beam[0]], [-beam[1], beam[0], 0]])
        moving = (
            np.hstack([np.eye(3), -skew]) @ post_roots(unit.covariance[at : at + 1], np.array([unit.azimuth_rad]))[0]
        )
        lasting = offset_columns(beam[np.newaxis], unit.azimuth_rad)[0] @ unit.calibration.T
        values, vectors = np.linalg.eigh(unit.unmodelled)
        return moving, lasting, path_axes(unit.azimuth_rad) @ (vectors * np.sqrt(values)) @ vectors.T

    (a, b, c), (a2, b2, c2) = parts(one, place, at), parts(other, place_2, at_2)
    lag_s = (other.post_ns[at_2] - one.post_ns[at]) / SECOND
    in_time = np.array([SLOW[group].at(lag_s) for group in GROUP_OF])
    found: FloatArray = a * in_time @ a2.T
    if one.scanner == other.scanner:
        found = found + b @ b2.T
    if one is other:
        apart = path_axes(one.azimuth_rad).T @ (place_2 - place)
        shares = [each.at(lag) for each, lag in zip(one.unmodelled_correlation, apart, strict=True)]
        found = found + np.prod(shares) * c @ c2.T
    return found


@pytest.mark.slow
@pytest.mark.parametrize("second", [(2, 255.0, "left"), (2, 255.0, "right"), (1, 75.0, "left")])
def test_cross_covariances_are_the_sum_of_the_shared_errors(second: tuple[int, float, str]) -> None:
    first = unit()
    strip, azimuth_deg, scanner = second
    other = first if strip == 1 else unit(strip, azimuth_deg, start_s=260, scanner=scanner)
    units = [first] if other is first else [first, other]
    place, place_2 = np.array([[100.0, 400.0, 20.0]]), np.array([[-150.0, 380.0, 35.0]])
    found = ErrorModel(units, SLOW).cross_covariance(
        place, first.post_ns[[4]], 0, place_2, other.post_ns[[7]], len(units) - 1
    )
    np.testing.assert_allclose(found[0], written_out(first, other, place[0], place_2[0], 4, 7), rtol=1e-12, atol=1e-16)


@pytest.mark.slow
def test_a_point_has_the_noise_besides() -> None:
    one = unit()
    model, place = ErrorModel([one], SLOW), np.array([[100.0, 400.0, 20.0]])
    found = model.covariance(place, one.post_ns[[4]], 0)[0]
    shared = written_out(one, one, place[0], place[0], 4, 4)
    beam = place[0] - one.position_m[4]
    far = float(np.linalg.norm(beam))
    along = beam / far
    side = np.cross(along, path_axes(one.azimuth_rad)[:, 0])
    side /= np.linalg.norm(side)
    noise = sum(
        sigma**2 * np.outer(axis, axis)
        for sigma, axis in ((0.02, along), (2e-5 * far, side), (1e-5 * far, np.cross(side, along)))
    )
    np.testing.assert_allclose(found, shared + noise, rtol=1e-12, atol=1e-16)


def test_all_points_together_have_a_covariance() -> None:
    """The joint covariance of points of three strips is positive definite: no combination has a negative variance."""
    units = [unit(1, 75.0), unit(2, 255.0, start_s=260), unit(3, 165.0, start_s=400, scanner="right")]
    model, rng = ErrorModel(units, SLOW), np.random.default_rng(6)
    number = rng.integers(0, 3, 40)
    times = np.array([units[n].start_ns for n in number]) + rng.integers(0, 100 * SECOND, 40)
    places = rng.uniform(-2000.0, 2000.0, (40, 3)) * [1.0, 1.0, 0.02]
    i, j = (part.ravel() for part in np.indices((40, 40)))
    joint = model.cross_covariance(places[i], times[i], number[i], places[j], times[j], number[j])
    matrix = joint.reshape(40, 40, 3, 3).transpose(0, 2, 1, 3).reshape(120, 120)
    np.testing.assert_allclose(matrix, matrix.T, atol=1e-15)
    assert np.linalg.eigvalsh(matrix).min() > -1e-12 * np.linalg.eigvalsh(matrix).max()


def test_near_points_differ_by_their_noise_only() -> None:
    one = unit()
    model, place = ErrorModel([one], SLOW), np.array([[100.0, 400.0, 20.0]])
    when = one.post_ns[[4]]
    difference = model.difference(place, when, 0, place + 1e-4, when + 1000, 0)[0]
    bare = ErrorModel([replace(one, noise=np.zeros(3))], SLOW)
    noise = model.covariance(place, when, 0)[0] - bare.covariance(place, when, 0)[0]
    np.testing.assert_allclose(difference, 2.0 * noise, rtol=1e-3, atol=1e-8)


def test_wrong_questions_are_refused_in_one_line() -> None:
    model = ErrorModel([unit(4), unit(9)], SLOW)
    assert model.unit_of(9) == 1
    with pytest.raises(ErrorModelError, match="has no strip 5; it has 4, 9"):
        model.unit_of(5)
    with pytest.raises(ErrorModelError, match="units 2 to 2 were asked for; the error model has 0 to 1"):
        model.covariance(np.zeros((1, 3)), np.zeros(1, np.int64), 2)
    with pytest.raises(ErrorModelError, match="needs a unit and 4 correlations"):
        ErrorModel([], SLOW)
    with pytest.raises(ErrorModelError, match="strip 4 has no posts"):
        ErrorModel([replace(unit(4), post_ns=np.zeros(0, np.int64))], SLOW)
