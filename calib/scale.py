"""Measure the sizes of a flight: its height, the width of its swaths and the distance between its points.

The sizes that a calibration searches on the ground follow from these three, so a drone 20 m above a yard and an
aircraft 3,000 m above a town are treated alike: an angle moves points by its product with the height, features wider
than a swath cannot be compared, and features finer than its points cannot be seen.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from swath.calib.flight import Flight, Swath, sensor_t
from swath.georef.arrays import FloatArray, Int64Array

REFERENCE_HEIGHT_M = 800.0  # height at which constants in metres were tuned
_SAMPLE = 20_000  # returns of a swath that are examined
_FEWEST = 100
_POINTS_A_CELL, _ROUNDS = 16.0, 4
_MIDDLE = (5.0, 95.0)  # percentiles across the track between which a swath's width is measured


@dataclass(frozen=True, slots=True)
class Scale:
    """Sizes of a flight, in metres.

    Attributes:
        height_m: of the scanner above what it sees, the middle one of the swaths.
        width_m: across the track, of the narrowest swath.
        spacing_m: √(area a return), of a middling swath.
    """

    height_m: float
    width_m: float
    spacing_m: float

    @property
    def of_reference(self) -> float:
        """Height in units of `REFERENCE_HEIGHT_M`."""
        return self.height_m / REFERENCE_HEIGHT_M


def scale_of(flight: Flight, points_t: Sequence[tuple[Int64Array, FloatArray]] | None = None) -> Scale | None:
    """Measure the sizes of a flight; None if no swath has points.

    Args:
        flight: whose swaths are measured.
        points_t: by swath, rising indexes (n,) of returns and their positions (n, 3) in t, if these differ from those
            of the flight.
    """
    rows = []
    for index, swath in enumerate(flight.swaths):
        at = np.arange(0, len(swath), max(1, len(swath) // _SAMPLE))
        places = np.asarray(swath.points_t[at]) if points_t is None else points_t[index][1]
        at = at if points_t is None else points_t[index][0]
        good = np.isfinite(places).all(axis=1)
        if good.sum() >= _FEWEST:
            away = places[good] - sensor_t(flight, swath, at[good])
            spacing = area_spacing_m(places[good]) * np.sqrt(good.sum() / len(swath))
            rows.append((float(np.median(-away[:, 2])), _width_m(flight, swath, away), spacing))
    if not rows:
        return None
    height, width, spacing_of = np.array(rows).T
    return Scale(float(np.median(height)), float(width.min()), float(np.median(spacing_of)))


def _width_m(flight: Flight, swath: Swath, away_t: FloatArray) -> float:
    """Return a swath's width across the line between its ends."""
    ends = sensor_t(flight, swath, np.array([0, len(swath) - 1]))
    east, north = (ends[1] - ends[0])[:2] / max(float(np.linalg.norm((ends[1] - ends[0])[:2])), 1e-9)
    low, high = np.percentile(away_t[:, 0] * north - away_t[:, 1] * east, _MIDDLE)
    return float(high - low) * 100.0 / (_MIDDLE[1] - _MIDDLE[0])


def area_spacing_m(points: FloatArray) -> float:
    """Return √(area per point) of points (n, ≥ 2), measured with cells that contain some of them on average.

    A few large cells overestimate the area at the edges; many small cells underestimate it between the points.
    """
    spacing_m = float(np.sqrt(max(np.prod(np.ptp(points[:, :2], axis=0)), 1e-6) / len(points)))
    for _ in range(_ROUNDS):
        cell_m = spacing_m * np.sqrt(_POINTS_A_CELL)
        columns, rows = np.floor(points[:, :2].T / cell_m).astype(np.int64)
        occupied = len(np.unique((rows << 32) + columns))
        spacing_m = float(np.sqrt(occupied * cell_m**2 / len(points)))
    return spacing_m


def spacing_m(swath: Swath) -> float:
    """Return √(area per return) of a swath; infinite where it has no points."""
    step = max(1, len(swath) // 200_000)
    points = np.asarray(swath.points_t[::step])
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) < _FEWEST:
        return np.inf
    return area_spacing_m(points) / float(np.sqrt(step))
