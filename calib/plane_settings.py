"""What counts as a plane, and how many are wanted."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from swath.calib.flight import Flight
from swath.calib.scale import Scale, scale_of

_CELLS_ACROSS, _CELL_LEAST_M = 50.0, 0.5  # cells that a swath should have across, at least; the smallest there are
_TILES_ACROSS, _TILE_LEAST_M = 4.0, 4.0


class PlaneError(ValueError):
    """Planes that cannot be searched for; one line for the user."""


@dataclass(frozen=True, slots=True)
class PlaneSettings:
    """Of the plane search and of finding the same planes again.

    Attributes:
        cell_m: least size of a cell; cells are larger where a swath has fewer than ``cell_points`` a cell.
        cell_points: that a cell should have on average.
        tile_m: greatest length of a piece of a plane; larger faces are cut, ground is cut along tiles of this size.
        least_points: returns a swath must have on a plane.
        most_points: returns of a swath on a plane that are kept: evenly drawn in the order of their times.
        most_planes: roofs first, the larger the earlier, in turn by the direction they face; then ground.
        ground_planes: pieces of level ground wanted of each third along and each fifth across a swath, for every
            other swath that sees them.
        roof_slope_rad: what is steeper is kept as a roof; the rest is ground, and thinned.
        wall_slope_rad: what is steeper is left out.
        surface_m: roughness of surfaces that count as plane, one sigma.
        rough: greatest rms of a plane's points in units of that expected.
        several: greatest share of points of pulses with several returns in a cell.
        sag_m: a plane's greatest curvature: height of the arc over its length.
        displacement_m: by which strips may lie beside each other at first, horizontally.
        offset_m: by which they may lie above each other, at first and once calibrated.
        tight_m: by which planes of the same place may differ along their normal once the points were placed anew.
        normal_sigma_rad: greatest sigma of a plane's direction in one swath.
        angle_rad: between normals of the same plane in two swaths, besides what their noise explains.
        overlap: least share of the smaller one's cells that two sights of a plane have in common.
    """

    cell_m: float = 1.0
    cell_points: float = 6.0
    tile_m: float = 15.0
    least_points: int = 10
    most_points: int = 2000
    most_planes: int = 1000
    ground_planes: int = 1
    roof_slope_rad: float = float(np.radians(10.0))
    wall_slope_rad: float = float(np.radians(65.0))
    surface_m: float = 0.01
    rough: float = 1.5
    several: float = 0.3
    sag_m: float = 0.01
    displacement_m: float = 1.5
    offset_m: float = 0.3
    tight_m: float = 0.2
    normal_sigma_rad: float = float(np.radians(1.0))
    angle_rad: float = float(np.radians(1.0))
    overlap: float = 0.3

    def scaled(self, scale: Scale) -> PlaneSettings:
        """Return the settings for a flight of these sizes; the fields are meant for 800 m above ground.

        In narrow swaths cells and pieces are smaller, so that there are several side by side. From higher up the same
        small angles lay strips farther apart.
        """
        higher = max(scale.of_reference, 1.0)
        return replace(
            self,
            cell_m=max(min(self.cell_m, scale.width_m / _CELLS_ACROSS), _CELL_LEAST_M),
            tile_m=max(min(self.tile_m, scale.width_m / _TILES_ACROSS), _TILE_LEAST_M),
            displacement_m=self.displacement_m * higher,
            offset_m=self.offset_m * higher,
            tight_m=self.tight_m * higher,
        )


def scaled_to(flight: Flight, settings: PlaneSettings) -> PlaneSettings:
    """Return the settings by the sizes of a flight, as they are where it has no points."""
    scale = scale_of(flight)
    return settings if scale is None else settings.scaled(scale)
