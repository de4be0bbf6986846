"""Measures how well overlapping strips agree: one measure and one rule for the quality level, used by all reports.

RMSDz is of heights: in each cell a plane goes through each strip's single returns, and the planes' heights at one place
are compared where the ground is smooth and slopes are below 10° (`quicklook_strips`). Any other number about strips is
another measure, is named so, and gives no level.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from swath.calib.flight import Flight
from swath.calib.strips.standards import ASPRS_2014, TO_CONFIRM, USGS, Judged, best_of, judge
from swath.calib.summary import DifferenceMap, PairDifference
from swath.daemon.processing.quicklook.read import Block
from swath.daemon.processing.quicklook.strips import (
    FEWEST_CELLS,
    FEWEST_PLACES,
    STEEPEST_DEG,
    Overlap,
    StripCells,
    compare,
    strip_frame,
)
from swath.georef.arrays import FloatArray, SingleArray
from swath.georef.mapping.frame import Mapping
from swath.georef.progress import Tell, silent

BLOCK_POINTS = 500_000
MORE_CELLS = "add tiles with smooth open ground where strips overlap, or set another --cell"
BORDER_M = 5.0  # around a flight's points in t, so that the map's corners hold them all
LIMITS = {
    "pulses_m2": "{:g} pulses per m²",
    "within_m": "{:g} m within strips",
    "overlap_m": "{:g} m RMSDz",
    "overlap_max_m": "{:g} m for the largest difference, which 99 % of cells must meet",
    "rmse_z_m": "{:g} m RMSEz",
}


@dataclass(frozen=True, eq=False)
class Agreement:
    """The agreement of strips, and the limits that it keeps.

    Attributes:
        cell_m: side of the cells.
        cells, places: number of cells that were compared, and of separate places that they lie in.
        numbers: numbers of all pairs from `Overlap.numbers`; None: nothing was compared.
        repeatability_m: by number of the strip, sigma of its single returns on the smoothest quarter of gentle ground.
        pulses_m2, area_m2: mean density of pulses, all strips together, and the area that they cover.
        judged: results against every limit; empty if there are too few cells for a verdict.
    """

    cell_m: float
    cells: int
    places: int
    numbers: dict[str, Any] | None
    repeatability_m: dict[int, float]
    pulses_m2: float
    area_m2: float
    judged: tuple[Judged, ...]

    @classmethod
    def of(cls, cells: StripCells, overlap: Overlap) -> Agreement:
        """Return the agreement of strips that were compared."""
        numbers, within = overlap.numbers(), overlap.repeatability_m()
        density, area_m2 = cells.pulse_density()
        compared, places = overlap.compared_cells, overlap.places
        judged: tuple[Judged, ...] = ()
        if numbers is not None and compared >= FEWEST_CELLS and places >= FEWEST_PLACES:
            values = list(within.values())
            judged = judge(
                overlap_rms_m=numbers["rms_m"],
                overlap_max_m=numbers["p99_m"],
                within_rms_m=math.sqrt(sum(one**2 for one in values) / len(values)) if values else None,
                pulses_m2=density if math.isfinite(density) else None,
            )
        return cls(cells.frame.cell_m, compared, places, numbers, within, density, area_m2, judged)

    @property
    def measure(self) -> str:
        """The measure in words, for people."""
        return (
            f"RMSDz: heights of planes of single returns in cells of {self.cell_m:g} m, smooth ground below "
            f"{STEEPEST_DEG:g}° of slope"
        )

    @property
    def best(self) -> str | None:
        """The strictest USGS level that is kept; None: no level is kept, or there is no verdict."""
        return best_of(self.judged)

    @property
    def no_verdict(self) -> str:
        """Reason why there is no verdict, and the remedy; empty if there is one."""
        if self.judged:
            return ""
        there = f"{self.cells:,} {'cell' if self.cells == 1 else 'cells'} of {self.cell_m:g} m in "
        there += f"{self.places} {'place' if self.places == 1 else 'places'}"
        return (
            f"no verdict: strips were compared in {there}, but a verdict needs {FEWEST_CELLS} in {FEWEST_PLACES}: "
            f"{MORE_CELLS}"
        )

    @property
    def level_words(self) -> str:
        """The quality level that strips keep, in words."""
        if not self.judged:
            return f"too few cells for a quality level ({self.cells:,} in {self.places} places)"
        return f"strips meet {self.best or 'no quality level'}"

    def broken(self, level: str) -> list[str]:
        """Return in words the limits of a USGS level that are not kept."""
        named = next((one for one in self.judged if one.standard == USGS and one.level == level), None)
        return [] if named is None else _broken(named)

    def verdicts(self) -> list[str]:
        """Return the result by each specification, one line each; or why there is no verdict."""
        if not self.judged:
            return [self.no_verdict]
        best = self.best
        usgs = f"strips meet {best}" if best else "strips meet no quality level"
        levels = [one for one in self.judged if one.standard == USGS]
        above = levels[: next((k for k, one in enumerate(levels) if one.level == best), len(levels))]
        if above:
            usgs += f"; {above[-1].level} fails its limit of {', '.join(_broken(above[-1]))}"
        asprs = next(one for one in self.judged if one.standard == ASPRS_2014)
        fits = (
            f"strips meet the {asprs.level} class" if asprs.all_kept else f"strips do not meet the {asprs.level} class"
        )
        return [f"{USGS}: {usgs}", f"{ASPRS_2014}: {fits}", TO_CONFIRM]

    def record(self) -> dict[str, Any]:
        """Return the agreement as values for scripts, in SI units."""
        asprs = next((one for one in self.judged if one.standard == ASPRS_2014), None)
        kept = asprs is not None and asprs.all_kept
        within = list(self.repeatability_m.values())
        return {
            "measure": self.measure,
            "cell_m": self.cell_m,
            "cells": self.cells,
            "places": self.places,
            "rmsdz_m": None if self.numbers is None else self.numbers["rms_m"],
            "within_m": math.sqrt(sum(one**2 for one in within) / len(within)) if within else None,
            "pulses_m2": self.pulses_m2,
            "levels": [
                {"standard": one.standard, "level": one.level, "limits": one.limits, "kept": one.kept}
                for one in self.judged
            ],
            "best": self.best,
            "asprs_class_m": asprs.limits["rmse_z_m"] if asprs is not None and kept else None,
            "no_verdict": self.no_verdict or None,
            "note": TO_CONFIRM,
        }


def _broken(one: Judged) -> list[str]:
    return [LIMITS[word].format(one.limits[word]) for word, kept in one.kept.items() if kept is False]


# ---------------------------------------------------------------------- a flight


@dataclass(frozen=True, eq=False)
class FlightStrips:
    """A flight's strips, compared where `swath georef` would place them on the map.

    Attributes:
        names: names of the strips.
        cells, overlap, agreement: cells of these strips, their differences, and their agreement.
    """

    names: tuple[str, ...]
    cells: StripCells
    overlap: Overlap
    agreement: Agreement

    @property
    def rms_m(self) -> float:
        """RMSDz of all pairs; nan: nothing was compared."""
        return math.nan if self.agreement.numbers is None else float(self.agreement.numbers["rms_m"])

    def pairs(self) -> dict[tuple[str, str], PairDifference]:
        """Return the differences by pair of strip names, the first strip minus the second."""
        return {(self.names[row["first"]], self.names[row["second"]]): difference_of(row) for row in self.overlap.rows}

    def rms_of(self, names: set[str]) -> float:
        """Return RMSDz of all pairs that include one of some strips; nan: there are none."""
        own = [one for pair, one in self.pairs().items() if set(pair) & names]
        count = sum(one.count for one in own)
        return math.sqrt(sum(one.count * one.rms_m**2 for one in own) / count) if count else math.nan


def difference_of(row: dict[str, Any]) -> PairDifference:
    """Return the differences of a pair from its row in `Overlap.rows`."""
    std_m = math.sqrt(max(row["rms_m"] ** 2 - row["mean_m"] ** 2, 0.0))
    return PairDifference(row["mean_m"], std_m, row["rms_m"], row["max_m"], row["cells"])


def compare_flight(
    flight: Flight,
    mapping: Mapping | None = None,
    *,
    cell_m: float | None = None,
    corners: tuple[FloatArray, FloatArray] | None = None,
    like: StripCells | None = None,
    also: Callable[[Block], None] = lambda block: None,
    tell: Tell = silent,
) -> FlightStrips:
    """Compare a flight's strips where its points are placed.

    Args:
        flight: a flight whose points are in t.
        mapping: the settled mapping of the products; None: cells lie in t.
        cell_m: side of the cells; None: by the strips' density.
        corners: south-western and north-eastern corner (3,) of the cells; None: `corners_of`.
        like: cells to use again, whatever the other arguments are; None: new cells.
        also: called with every block of points.
        tell: called with the progress.
    """
    if like is None:
        low_m, high_m = corners_of(flight, mapping) if corners is None else corners
        reference_m = float(low_m[2] + high_m[2]) / 2
        cells = StripCells(strip_frame(low_m, high_m, cell_m), reference_m, fixed=cell_m is not None)
    else:
        cells = StripCells(like.frame, like.reference_m, fixed=True)
    done, total = 0, sum(map(len, flight.swaths))
    for block in _blocks(flight, mapping):
        tell("height differences", done, total, "returns")
        cells.add(block)
        also(block)
        done += len(block)
    overlap = compare(cells)
    return FlightStrips(tuple(swath.name for swath in flight.swaths), cells, overlap, Agreement.of(cells, overlap))


def corners_of(flight: Flight, mapping: Mapping | None = None) -> tuple[FloatArray, FloatArray]:
    """Return corners (3,) on the map that hold all points of a flight."""
    full = [swath for swath in flight.swaths if len(swath)]
    if not full:
        return np.zeros(3), np.ones(3)
    low = np.min([np.nanmin(swath.points_t, axis=0) for swath in full], axis=0)
    high = np.max([np.nanmax(swath.points_t, axis=0) for swath in full], axis=0)
    if mapping is None:
        return low, high
    ends = np.stack([low - BORDER_M, high + BORDER_M])
    box = np.array([[ends[i, 0], ends[j, 1], ends[k, 2]] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
    placed = mapping.map_from_e(flight.frame.e_from_t(box))
    return placed.min(axis=0), placed.max(axis=0)


def _blocks(flight: Flight, mapping: Mapping | None) -> Iterator[Block]:
    for number, swath in enumerate(flight.swaths):
        for begin in range(0, len(swath), BLOCK_POINTS):
            part = slice(begin, begin + BLOCK_POINTS)
            points, rows = np.asarray(swath.points_t[part]), swath.rows[part]
            good = np.isfinite(points).all(axis=1)
            points, rows = points[good], rows[good]
            if mapping is not None and len(points):
                points = mapping.map_from_e(flight.frame.e_from_t(points))
            east_m, north_m, up_m = (np.ascontiguousarray(column) for column in points.T)
            yield Block(
                x_m=east_m,
                y_m=north_m,
                z_m=up_m,
                intensity=np.ascontiguousarray(rows["intensity"]),
                strip=np.full(len(points), number, np.int32),
                first=np.asarray(rows["return_number"] <= 1),
                single=np.asarray(rows["number_of_returns"] <= 1),
                sigma_m=np.empty((0, 3), np.float32),
                skipped=0,
            )


def before_and_after(
    before: Flight, after: Flight, mapping: Mapping | None = None, tell: Tell = silent
) -> tuple[FlightStrips, FlightStrips]:
    """Compare a flight's strips before and after a change, in the same cells: those chosen for the latter.

    ``tell`` is called with the progress.
    """
    corners = [corners_of(flight, mapping) for flight in (before, after)]
    both = np.min([low for low, _ in corners], axis=0), np.max([high for _, high in corners], axis=0)
    now = compare_flight(after, mapping, corners=both, tell=tell)
    return compare_flight(before, mapping, like=now.cells, tell=tell), now


def difference_map(before: FlightStrips, after: FlightStrips, most: int, *, in_t: bool = False) -> DifferenceMap | None:
    """Return the differences of all pairs on two grids of the same cells, the largest of each cell; None: there are
    none.

    Args:
        before, after: strips in the same cells, from `before_and_after`.
        most: maximum number of cells along a side; more cells are merged.
        in_t: True if the cells are in t, because the flight has no mapping.
    """
    if before.cells.frame != after.cells.frame:
        return None
    grids = [one.overlap.shown_m for one in (before, after)]
    there = np.isfinite(grids[0]) | np.isfinite(grids[1])
    if not there.any():
        return None
    rows, columns = np.flatnonzero(there.any(axis=1)), np.flatnonzero(there.any(axis=0))
    frame = after.cells.frame
    times = max(1, -(-max(int(np.ptp(rows)) + 1, int(np.ptp(columns)) + 1) // most))
    shown = [_largest(grid[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1], times) for grid in grids]
    return DifferenceMap(
        float(frame.west_m + columns[0] * frame.cell_m),
        float(frame.south_m + rows[0] * frame.cell_m),
        times * frame.cell_m,
        shown[0],
        shown[1],
        _words(before),
        _words(after),
        in_t,
    )


def _words(strips: FlightStrips) -> str:
    return f"RMSDz {100.0 * strips.rms_m:.1f} cm" if math.isfinite(strips.rms_m) else "no comparison"


def _largest(grid: SingleArray, times: int) -> FloatArray:
    """Return the value of largest size in each block of ``times`` by ``times`` cells; nan: the block has none."""
    rows, columns = (-(-size // times) * times for size in grid.shape)
    padded = np.full((rows, columns), np.nan)
    padded[: grid.shape[0], : grid.shape[1]] = grid
    split = padded.reshape(rows // times, times, columns // times, times).swapaxes(1, 2)
    blocks = split.reshape(rows // times, columns // times, times * times)
    at = np.nan_to_num(np.abs(blocks), nan=-1.0).argmax(axis=2)
    return np.asarray(np.take_along_axis(blocks, at[:, :, np.newaxis], axis=2)[:, :, 0])
