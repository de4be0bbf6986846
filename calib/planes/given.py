"""Find planes at places that the user gives as polygons."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np

from swath.calib.features import Features, Plane
from swath.calib.flight import Flight, Swath, sensor_t
from swath.calib.planes.cells import cell_size, keys_of
from swath.calib.planes.fit import GATE, PlaneError, PlaneSettings, expected_sigma, scaled_to
from swath.calib.planes.returns import plane_of, returns_near, sights_of
from swath.georef.arrays import BoolArray, FloatArray, Int64Array

Rings = Mapping[str, FloatArray] | Sequence[tuple[str, FloatArray]]

_DEFAULT = PlaneSettings()
_TRIALS = 200
_SEED = 1981
_LONGEST_M = 2_000.0  # east or north: no face is larger, and its box's cells would fill the memory
_SHARE_LEAST = 0.7  # least share of a polygon's returns that lie on its plane


def given_planes(flight: Flight, polygons: Rings, settings: PlaneSettings = _DEFAULT) -> Features:
    """Find in each polygon the plane on which most of its returns lie (Fischler and Bolles 1981).

    These planes must pass the same tests as planes that were found; failures are counted.

    Args:
        flight: with points.
        polygons: names and corners (k, 2) east and north in t, not closed.
        settings: of the tests.

    Raises:
        PlaneError: a polygon has fewer than three corners, or is too large for a face, or two have the same name.
    """
    rings = _checked(polygons)
    settings = scaled_to(flight, settings)
    cell_m = cell_size(flight, settings)
    found: dict[str, dict[int, Int64Array]] = {name: {} for name in rings}
    refused: Counter[str] = Counter()
    for index, swath in enumerate(flight.swaths):
        for name, at in _inside(swath, rings, cell_m).items():
            on_it = _consensus(flight, swath, at, settings)
            if len(on_it) < _SHARE_LEAST * len(at):
                refused["mixed: less than 70 % of the returns inside a polygon lie on one plane in a swath"] += 1
            elif len(on_it):
                found[name][index] = on_it
    planes: list[Plane] = []
    for name, by_swath in found.items():
        sights = sights_of(flight, by_swath, settings, refused)
        if len(sights) > 1:
            planes.append(plane_of(name, "user", sights))
    return Features(planes=tuple(planes), refused=+refused)


def _checked(polygons: Rings) -> dict[str, FloatArray]:
    pairs = list(polygons.items()) if isinstance(polygons, Mapping) else list(polygons)
    rings: dict[str, FloatArray] = {}
    for name, ring in pairs:
        corners = np.asarray(ring, dtype=np.float64)
        if corners.ndim != 2 or corners.shape[1:] != (2,) or len(corners) < 3 or not np.isfinite(corners).all():
            raise PlaneError(
                f"polygon {name}: corners have the shape {corners.shape}; (k, 2) numbers are needed, k at least 3"
            )
        east_m, north_m = np.ptp(corners, axis=0).tolist()
        if max(east_m, north_m) > _LONGEST_M:
            size = f"{east_m:,.0f} m by {north_m:,.0f} m"
            raise PlaneError(
                f"polygon {name}: measures {size}; draw it around one face, at most {_LONGEST_M:,.0f} m a side"
            )
        if name in rings:
            raise PlaneError(f"polygon {name}: two polygons have this name; use each name once")
        rings[name] = corners
    return rings


def _inside(swath: Swath, rings: Mapping[str, FloatArray], cell_m: float) -> dict[str, Int64Array]:
    """Return a swath's single returns in each polygon; polygons that share cells are processed one after the other."""
    left = {name: _cells(ring, cell_m) for name, ring in rings.items()}
    inside: dict[str, Int64Array] = {}
    while left:
        now: dict[str, Int64Array] = {}
        taken: set[int] = set()
        for name, cells in left.items():
            if taken.isdisjoint(cells.tolist()):
                now[name] = cells
                taken.update(cells.tolist())
        left = {name: cells for name, cells in left.items() if name not in now}
        labels = np.repeat(np.arange(len(now)), [len(cells) for cells in now.values()])
        anywhere = np.tile([0.0, 0.0, 0.0, 0.0, np.inf], (len(now), 1))
        near = returns_near(swath, np.concatenate(list(now.values())), labels, anywhere, cell_m)
        for label, at in near.items():
            name = list(now)[label]
            kept = at[_in_ring(np.asarray(swath.points_t[at]), rings[name])]
            if len(kept):
                inside[name] = kept
    return inside


def _cells(ring: FloatArray, cell_m: float) -> Int64Array:
    """Return the keys of all cells of a ring's bounding box."""
    low, high = np.floor(ring.min(axis=0) / cell_m), np.floor(ring.max(axis=0) / cell_m)
    axes = [np.arange(int(first), int(last) + 1) for first, last in zip(low, high, strict=True)]
    columns, rows = np.meshgrid(*axes)
    return keys_of(columns.ravel(), rows.ravel())


def _in_ring(points: FloatArray, ring: FloatArray) -> BoolArray:
    """Return whether points lie inside (n,): a ray to the east then meets an odd number of sides."""
    x, y = points[:, 0], points[:, 1]
    odd = np.zeros(len(points), np.bool_)
    for (x0, y0), (x1, y1) in zip(ring, np.roll(ring, -1, axis=0), strict=True):
        if y0 != y1:
            odd ^= ((y0 > y) != (y1 > y)) & (x < x0 + (y - y0) * (x1 - x0) / (y1 - y0))
    return odd


def _consensus(flight: Flight, swath: Swath, at: Int64Array, settings: PlaneSettings) -> Int64Array:
    """Return the largest set of these returns that lie on a plane through three of them."""
    points = np.asarray(swath.points_t[at])
    if len(points) < settings.least_points:
        return at
    draws = np.random.default_rng(_SEED)
    away = points.mean(axis=0) - sensor_t(flight, swath, at[len(at) // 2 : len(at) // 2 + 1])[0]
    best = np.zeros(len(at), np.bool_)
    for three in draws.integers(0, len(points), (_TRIALS, 3)):
        first, second, third = points[three]
        normal = np.cross(second - first, third - first)
        length = float(np.linalg.norm(normal))
        if length < 1e-6:
            continue
        normal /= length
        sigma_m = float(expected_sigma(flight.heads[swath.head].noise, away, normal, settings))
        near = np.abs((points - first) @ normal) <= GATE * sigma_m
        if near.sum() > best.sum():
            best = near
    return at[best]
