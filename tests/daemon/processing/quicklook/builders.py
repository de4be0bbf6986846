"""Strips of points that several tests of the quick look read."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from pyproj import CRS

from swath.daemon.processing.quicklook.run import Look, look_at
from tests.daemon.builders import EAST_M, NORTH_M, Array, lattice, plane, write_laz


def two_strips(folder: Path, dz_m: float, surface: Callable[[Array, Array], Array] = plane) -> Look:
    """Write and read strips of 100 m by 300 m that overlap by 40 m; the second is higher and sampled differently."""
    for number, (south_m, lift_m, shift_m) in enumerate([(0.0, 0.0, 0.0), (60.0, dz_m, 0.17)], start=1):
        x, y = lattice(EAST_M + shift_m, NORTH_M + south_m, 300.0, 100.0, 0.5)
        write_laz(folder / f"s{number}.laz", x, y, surface(x, y) + lift_m, number, crs=CRS.from_epsg(25832))
    return look_at([folder])
