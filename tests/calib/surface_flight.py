"""Makes a flight of given surfaces, with points where a test needs them and without a sensor."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from swath.calib.flight import Flight, Swath, Tangent
from swath.georef.arrays import ByteArray, FloatArray
from swath.georef.geodesy.earth import e_from_geodetic
from swath.georef.records import RETURN_DTYPE

Height = Callable[[FloatArray, FloatArray], FloatArray]

LAT_RAD, LON_RAD = np.radians(47.4), np.radians(8.9)
FRAME = Tangent.at(np.asarray(e_from_geodetic(LAT_RAD, LON_RAD, 500.0)))


def grid(half_m: float, step_m: float) -> tuple[FloatArray, FloatArray]:
    """Return east and north, m, of places in a grid around the middle."""
    along = np.arange(-half_m, half_m, step_m)
    east, north = np.meshgrid(along, along)
    return east.ravel(), north.ravel()


def swath_of(points_t: FloatArray, strip: int = 1, returns: ByteArray | None = None) -> Swath:
    """Return a swath of single returns at places (n, 3), m, in t."""
    rows = np.zeros(len(points_t), RETURN_DTYPE)
    rows["return_number"] = 1
    rows["number_of_returns"] = 1 if returns is None else returns
    time_ns = np.arange(len(points_t), dtype=np.int64) * 1000
    return Swath(f"{strip:02d}", 0, strip, 0, rows, time_ns, points_t)


def surface_flight(
    heights: Sequence[Height], *, half_m: float = 60.0, step_m: float = 0.5, noise_m: float = 0.01, seed: int = 5
) -> Flight:
    """Return a flight with one swath for each function of height over east and north (metres in t)."""
    draws = np.random.default_rng(seed)
    swaths = []
    for strip, height in enumerate(heights, start=1):
        east, north = grid(half_m, step_m)
        east, north = east + draws.uniform(-0.2, 0.2, east.size), north + draws.uniform(-0.2, 0.2, north.size)
        up = height(east, north) + draws.normal(0.0, noise_m, east.size)
        swaths.append(swath_of(np.stack([east, north, up], axis=1), strip))
    return Flight(FRAME, (), (), tuple(swaths))
