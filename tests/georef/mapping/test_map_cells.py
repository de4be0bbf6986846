"""Tests expansions over cubes, on maps whose values and derivatives are known in closed form."""

from __future__ import annotations

import numpy as np
import pytest

from swath.georef.arrays import FloatArray
from swath.georef.mapping import cells as map_cells
from swath.georef.mapping.cells import APPROXIMATION_M, EXACT, LEVELS, TOLERANCE_M, MapCells, expand_cells

pytestmark = pytest.mark.xdist_group("kernels")

METRES = np.ones(3)
HERE = np.array([4_260_000.0, 670_000.0, 4_680_000.0])


def quadratic(points: FloatArray) -> FloatArray:
    """Map points by second-order terms only, which an expansion reproduces exactly."""
    x, y, z = ((points - HERE) / 1000.0).T
    return np.stack([1e5 + x - 2 * y + 3 * x * y, 2e5 + x * x - z * z + y * z, z + 0.5 * y * y + x * z], axis=-1)


def cubic(points: FloatArray) -> FloatArray:
    """Map points with a third-order term, which causes 0.6 mm over 1024 m and an eighth of it over 512 m."""
    x = (points[:, 0] - HERE[0]) / 1000.0
    mapped: FloatArray = points + np.stack([0 * x, 0.014 * x**3, 0 * x], axis=-1)
    return mapped


def creased(points: FloatArray) -> FloatArray:
    """Map points so that the slope of the third coordinate changes by 30 µm per metre along an oblique plane."""
    along = (points - HERE) @ np.array([0.6, 0.64, 0.48])
    mapped: FloatArray = points + np.stack([0 * along, 0 * along, 3e-5 * np.maximum(along, 0.0)], axis=-1)
    return mapped


def torn(points: FloatArray) -> FloatArray:
    """Map points so that the third coordinate jumps by 10 cm."""
    mapped: FloatArray = points + np.where(points[:, :1] > HERE[0], 1.0, 0.0) * [0.0, 0.0, 0.1]
    return mapped


def cells(exact: map_cells.Exact) -> MapCells:
    """Make map cells that may stand anywhere."""
    return MapCells(exact, METRES, lambda centres: None)


def cloud(n: int, spread_m: float, seed: int = 3) -> FloatArray:
    """Return n points around the place where all these maps have their features."""
    return HERE + np.random.default_rng(seed).uniform(-spread_m, spread_m, (n, 3))


def test_values_and_derivatives_of_a_quadratic_map_are_exact() -> None:
    """The derivatives are known in closed form; the row includes the factor ½ of the squares."""
    rows, error = expand_cells(quadratic, HERE[None], np.array([512.0]), METRES)
    first = np.array([[1, -2, 0], [0, 0, 0], [0, 0, 1]]) / 1e3
    second = np.array([[0, 3, 0, 0, 0, 0], [1, 0, 0, 0, 1, -1], [0, 0, 1, 0.5, 0, 0]]) / 1e6
    np.testing.assert_allclose(rows[0, map_cells.VALUE], [1e5, 2e5, 0.0], atol=1e-9)
    np.testing.assert_allclose(rows[0, map_cells.FIRST].reshape(3, 3), first, atol=1e-12)
    np.testing.assert_allclose(rows[0, map_cells.SECOND].reshape(3, 6), second, atol=1e-15)
    assert error[0] < 1e-9


def test_the_check_finds_the_neglected_third_order_at_the_corners() -> None:
    """Central differences over ±h turn c x³ into c h² x; the rest, c (x³ − h² x), is largest inside the cube."""
    _, error = expand_cells(cubic, HERE[None], np.array([512.0]), METRES)
    c, h, x = 0.014e-9, 512.0, 0.75 * 512.0
    assert error[0] == pytest.approx(abs(c * (x**3 - h * h * x)), rel=1e-4)
    _, in_feet = expand_cells(cubic, HERE[None], np.array([512.0]), 0.3048 * METRES)
    assert in_feet[0] == pytest.approx(0.3048 * error[0])


def test_a_cube_without_values_has_infinite_error() -> None:
    _, error = expand_cells(lambda points: np.full_like(points, np.inf), HERE[None], np.array([8.0]), METRES)
    assert error[0] == np.inf


@pytest.mark.slow
@pytest.mark.parametrize("exact", [quadratic, cubic, creased, torn])
def test_no_point_is_wrong_by_a_tenth_of_a_millimetre(exact: map_cells.Exact) -> None:
    """The points cover several cubes, including corners of cubes and the neighbourhood of creases."""
    made = cells(exact)
    corners = np.array(np.meshgrid(*[[-1024.0, 0.0, 1024.0 - 1e-6]] * 3)).reshape(3, -1).T
    corners += np.floor(HERE / 1024.0) * 1024.0
    flat = cloud(40_000, 900.0) * [1.0, 1.0, 0.0] + [0.0, 0.0, HERE[2]]
    for points in (corners, flat, cloud(20_000, 30.0)):
        assert np.abs(made.map(points) - exact(points)).max() < APPROXIMATION_M


def test_cubes_are_halved_only_where_needed() -> None:
    smooth, curved, broken = cells(quadratic), cells(cubic), cells(torn)
    points = cloud(2_000, 200.0)
    levels = []
    for made in (smooth, curved, broken):
        made.map(points)
        levels.append(max(key >> 60 for key in made._node_of))
    assert levels == [0, 2, LEVELS]
    exactly = np.asarray(broken._kinds[: len(broken)]) == EXACT
    assert exactly.any()
    assert np.abs(broken._rows[: len(broken), 0][exactly] - HERE[0]).max() <= 16.0


def test_a_result_depends_on_its_point_alone() -> None:
    """Results are equal bit for bit for a point alone, shuffled, in pieces, and before and after other points."""
    points = cloud(5_000, 1500.0)
    whole = cells(creased).map(points)
    shuffled = np.random.default_rng(1).permutation(len(points))
    made = cells(creased)
    assert (made.map(points[shuffled]) == whole[shuffled]).all()
    assert all((made.map(points[i : i + 1]) == whole[i]).all() for i in range(0, 5_000, 97))
    assert (np.concatenate([cells(creased).map(part) for part in np.array_split(points, 7)]) == whole).all()


def test_each_face_belongs_to_one_cube() -> None:
    """A point less than a rounding below a face belongs to the lower cube, whichever point was asked for first."""
    below, above = np.array([-1e-300, 5.0, 5.0]), np.array([0.0, 5.0, 5.0])
    made = cells(cubic)
    nodes = [made._locate(np.array(points)).tolist() for points in ([above, below], [below, above], [below])]
    assert nodes[0][0] != nodes[0][1]
    assert nodes == [nodes[0], nodes[0][::-1], nodes[0][1:]]


def test_memory_is_bounded_and_recomputed_cubes_give_the_same_results(monkeypatch: pytest.MonkeyPatch) -> None:
    """Cubes that were discarded and computed again give the same results."""
    monkeypatch.setattr(map_cells, "CELLS_KEPT", 50)
    points = HERE + np.arange(3_000)[:, None] * [700.0, 30.0, 10.0]
    made = cells(cubic)
    rounds = [np.concatenate([made.map(points[i : i + 20]) for i in range(0, 3_000, 20)]) for _ in range(2)]
    assert (rounds[0] == rounds[1]).all()
    assert (rounds[0] == cells(cubic).map(points)).all()
    assert len(made) < 50 + 20 * 2 * (LEVELS + 1)


def test_a_cube_is_made_once() -> None:
    """A thousand points of one cube cost only the cube's 91 exact values."""
    asked = []

    def counted(points: FloatArray) -> FloatArray:
        asked.append(len(points))
        return quadratic(points)

    made = cells(counted)
    for _ in range(3):
        made.map(np.floor(HERE / 1024.0) * 1024.0 + np.linspace(1.0, 1000.0, 1000)[:, None])
    assert asked == [91]


def test_points_outside_any_cube_are_computed_by_the_exact_map() -> None:
    """Such points are NaN, or farther away than any cube reaches."""
    points = np.array([[np.nan, 0.0, 0.0], [2e7, 0.0, 0.0], HERE])
    made = cells(quadratic)
    np.testing.assert_array_equal(made.map(points)[:2], quadratic(points)[:2])
    covariance = np.tile([1.0, 0, 0, 1.0, 0, 1.0], (3, 1))
    assert np.isnan(made.map_with_sigmas(points, covariance)[1]).all(axis=1).tolist() == [True, True, False]


@pytest.mark.slow
def test_sigmas_follow_the_law_of_propagation() -> None:
    """The expected values are J Σ Jᵀ written with matrices, in units of half a metre."""
    random = np.random.default_rng(5)
    root = random.normal(size=(50, 3, 3)) * 0.02
    full = root @ root.transpose(0, 2, 1)
    packed = full[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    points = np.floor(HERE / 1024.0) * 1024.0 + random.uniform(0.0, 1024.0, (50, 3))
    made = MapCells(quadratic, 0.5 * METRES, lambda centres: None)
    jacobian = made._rows[made._locate(points)[0], map_cells.FIRST].reshape(3, 3)
    expected = 0.5 * np.sqrt(np.einsum("ij,njk,ik->ni", jacobian, full, jacobian))
    np.testing.assert_allclose(made.map_with_sigmas(points, packed)[1], expected, rtol=1e-6)
    origins = points + random.normal(size=(50, 3)) * 300.0
    _, sigmas, beams, covariances = made.map_with_beams(points, packed, origins, whole=True)
    assert sigmas is not None
    assert beams is not None
    assert covariances is not None
    np.testing.assert_allclose(sigmas, expected, rtol=1e-6)
    whole = 0.25 * np.einsum("ij,njk,lk->nil", jacobian, full, jacobian)[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    np.testing.assert_allclose(covariances, whole, rtol=1e-5, atol=1e-9)
    along = (points - origins) / np.linalg.norm(points - origins, axis=1, keepdims=True)
    np.testing.assert_allclose(beams, 0.5 * along @ jacobian.T, rtol=1e-6, atol=1e-7)


def test_the_admission_callback_is_called_once_for_each_root_cube() -> None:
    seen: list[list[float]] = []
    made = MapCells(creased, METRES, lambda centres: seen.extend(centres.tolist()))
    made.map(cloud(500, 100.0))
    made.map(cloud(500, 100.0, seed=9))
    assert len(seen) == len({tuple(centre) for centre in seen}) > 0
    assert all((np.array(centre) % 1024.0 == 512.0).all() for centre in seen)
    assert TOLERANCE_M < APPROXIMATION_M
