"""Tests markings: shifts of images between swaths over known displacements, covariances and refusals."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.special import erf

from swath.calib.flight import Flight
from swath.calib.ties.markings import Image, MarkingSettings, Shift, find_markings, shifted
from swath.georef.arrays import FloatArray, StructArray
from tests.calib.analytic_scene import Line, Scanner, fly, truth_of

pytestmark = pytest.mark.xdist_group("kernels")

LINES = (Line(-60, 0, 90, 120, 300, 47.3), Line(60, 10, 271, 120, 300, 51.9))
DENSE = Scanner(prf_hz=60_000.0, scan_hz=97.0, half_angle_deg=10.0)
FOOTPRINT_M = 0.1  # of a beam, one sigma
SETTINGS = MarkingSettings()


def roads(x: FloatArray, y: FloatArray) -> FloatArray:
    """Return the intensity of streets every 25 m with dashes in their middle, on uneven grass, none along the axes."""
    grass = 0.35 + 0.06 * np.sin(0.9 * x + 0.4 * y) + 0.05 * np.sin(0.3 * x - 1.1 * y)
    a, b = 0.92 * x + 0.39 * y, -0.39 * x + 0.92 * y
    u, v = (a + 3.0) % 25.0 - 12.5, (b - 4.0) % 25.0 - 12.5
    street = np.maximum(_within(u, 3.0), _within(v, 3.0))
    dash = np.maximum(
        _within(u, 0.4) * _within(b % 7.3 - 3.65, 1.5),
        _within(v, 0.4) * _within(a % 6.7 - 3.35, 1.5),
    )
    shade: FloatArray = 100.0 * (grass + street * (0.12 + dash * 0.48 - grass))
    return shade


def _within(away: FloatArray, half: float) -> FloatArray:
    """Return 1 inside and 0 outside, blurred by a footprint."""
    inside: FloatArray = 0.5 * (erf((away + half) / FOOTPRINT_M) - erf((away - half) / FOOTPRINT_M))
    return inside


def flat(x: FloatArray, y: FloatArray) -> FloatArray:
    return 0.02 * x


@cache
def flown(**true: float) -> Flight:
    flight = fly(LINES, flat, true=true, scanner=DENSE, intensity=roads, lowest_m=-4.0, highest_m=4.0, seed=5)
    rng = np.random.default_rng(9)
    swaths = []
    for swath in flight.swaths:
        rows = swath.rows.copy()
        rows["intensity"] += rng.normal(0.0, 3.0, len(rows))
        swaths.append(replace(swath, rows=rows))
    return replace(flight, swaths=tuple(swaths))


def misses(flight: Flight, **true: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return (k, 3) errors of tie points, m, in t, (k, 3, 3) covariances, and (k, 3) the wrong calibration's effect.

    An error is the difference of two sightings minus that effect.
    """
    truth = truth_of(flight, **true)
    found = find_markings(flight).ties
    off, covariance, made = [], [], []
    for tie in found:
        first, second = tie.sightings
        wrong = []
        for sighting in (first, second):
            swath, at = flight.swaths[sighting.swath], np.array([sighting.at])
            wrong.append(swath.points_t[sighting.at] - flight.place(swath, truth, at)[0])
        made.append(wrong[1] - wrong[0])
        off.append(second.point_t - first.point_t - made[-1])
        covariance.append(first.covariance_t + second.covariance_t)
    return np.array(off), np.array(covariance), np.array(made)


@pytest.mark.slow
def test_shifts_match_a_wrong_boresight_and_their_sigmas() -> None:
    true = {"omega_rad": 0.0013, "phi_rad": -0.0017}
    off, covariance, made = misses(flown(**true), **true)
    assert len(off) > 30
    assert np.linalg.norm(made[:, :2], axis=1).min() > 0.8
    squared = np.einsum("ki,kij,kj->k", off, np.linalg.inv(covariance), off)
    assert 0.5 < squared.mean() / 3.0 < 2.0
    assert np.linalg.norm(off[:, :2], axis=1).max() < 0.1


@pytest.mark.slow
def test_heights_lie_on_the_plane_of_each_swath() -> None:
    """A wrong roll tilts the two swaths against each other, so each sighting lies on its own swath."""
    true = {"omega_rad": 0.0013, "phi_rad": -0.0017}
    flight = flown(**true)
    for tie in find_markings(flight).ties:
        for sighting in tie.sightings:
            swath = flight.swaths[sighting.swath]
            away = np.linalg.norm(swath.points_t - sighting.point_t, axis=1)
            assert away[sighting.at] < 0.5
            about = np.flatnonzero(away < 3.0)
            assert sighting.point_t[2] == pytest.approx(swath.points_t[about, 2].mean(), abs=0.015)


def pattern(side: int, seed: int, lines_only: bool = False) -> FloatArray:
    rng = np.random.default_rng(seed)
    coarse = rng.normal(0.0, 1.0, (1 if lines_only else side // 4 + 3, side // 4 + 3))
    rows = np.zeros(side) if lines_only else np.arange(side) / 4.0
    return np.array([[_bilinear(coarse, row, column / 4.0) for column in range(side)] for row in rows])


def _bilinear(coarse: FloatArray, row: float, column: float) -> float:
    i, j = int(row), int(column)
    u, v = row - i, column - j
    down = min(i + 1, len(coarse) - 1)
    upper = (1 - v) * coarse[i, j] + v * coarse[i, j + 1]
    return float((1 - u) * upper + u * ((1 - v) * coarse[down, j] + v * coarse[down, j + 1]))


SIDE = 2 * round((SETTINGS.square_m / 2 + SETTINGS.search_m) / SETTINGS.cell_m) + 1


def test_shifts_of_images_to_east_and_north_are_measured() -> None:
    large = pattern(SIDE + 20, 1)
    first, second = large[10:-10, 10:-10], large[7:-13, 14:-6]  # moves the image 3 cells north and 4 west
    shift = shifted(Image(first, 0.4, True), Image(second, 0.4, True), SETTINGS)
    assert isinstance(shift, Shift)
    np.testing.assert_allclose(shift.shift_m, [-4 * SETTINGS.cell_m, 3 * SETTINGS.cell_m], atol=0.005)
    assert shift.correlation == pytest.approx(1.0, abs=1e-9)


@pytest.mark.parametrize(
    ("first", "second", "why"),
    [
        (pattern(SIDE, 1), pattern(SIDE, 2), "the strips have too little in common"),
        (pattern(SIDE, 1, lines_only=True), pattern(SIDE, 1, lines_only=True), "no single peak"),
        (np.ones((SIDE, SIDE)), pattern(SIDE, 1), "the ground has no pattern"),
        (
            np.tile(pattern(8, 1), (20, 20))[:SIDE, :SIDE],
            np.tile(pattern(8, 1), (20, 20))[:SIDE, :SIDE],
            "equally well",
        ),
    ],
)
def test_ambiguous_images_are_refused(first: FloatArray, second: FloatArray, why: str) -> None:
    rng = np.random.default_rng(4)
    noisy = second + rng.normal(0.0, 0.02, second.shape)
    said = shifted(Image(first, 0.4, True), Image(noisy, 0.4, True), SETTINGS)
    assert isinstance(said, str)
    assert why in said or (why == "no single peak" and said in ("several places match equally well", "no single peak"))


def test_images_with_holes_are_refused() -> None:
    image = Image(pattern(SIDE, 1), 0.4, True)
    assert shifted(image, replace(image, whole=False), SETTINGS) == "the ground has holes"


def test_images_without_a_tie_are_counted() -> None:
    flight = flown(omega_rad=0.0013, phi_rad=-0.0017)
    even = replace(flight, swaths=tuple(replace(one, rows=_even(one.rows)) for one in flight.swaths))
    found = find_markings(even)
    assert not found.ties
    assert found.refused["marking: too little contrast"] > 10
    rough = replace(flight, swaths=tuple(replace(one, points_t=_rough(one.points_t)) for one in flight.swaths))
    found = find_markings(rough)
    assert not found.ties
    assert found.refused["marking: the ground is not flat"] > 10
    assert not find_markings(replace(flight, swaths=())).ties


def _even(rows: StructArray) -> StructArray:
    rows = rows.copy()
    rows["intensity"] = 50.0
    return rows


def _rough(points: FloatArray) -> FloatArray:
    return points + np.random.default_rng(1).normal(0.0, 0.2, len(points))[:, np.newaxis] * [0.0, 0.0, 1.0]
