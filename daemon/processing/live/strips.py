"""Cuts strips while the aircraft flies, by the office's rules, and compares the present strip with those before it.

A strip is compared as `swath.daemon.processing.strip_agreement` does it: a plane goes through each strip's single
returns in each cell, and the planes' heights are compared at one place where both are smooth. Of a strip that has been
flown only its planes are kept, and of each cell only the newest strip's.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from swath.daemon.processing.live.grid import CellGrid
from swath.daemon.processing.quicklook.strips import (
    FEWEST_RETURNS,
    HISTOGRAM_HALF,
    HISTOGRAM_STEP_M,
    MOMENTS,
    RETURNS_A_CELL,
    TILE,
    add_moments,
    merged,
    open_density,
    planes_of,
)
from swath.georef.arrays import BoolArray, FloatArray, Int64Array, SingleArray, StructArray
from swath.georef.compiled import jit_cached
from swath.georef.geodesy.earth import geodetic_of
from swath.georef.geodesy.vectors import heading_and_roll, rot_at, vector_at
from swath.georef.points import Points
from swath.georef.strips import Span, StripRules, straight_spans
from swath.georef.timescales.gps_time import SECOND_NS
from swath.georef.trajectory.trajectory import Trajectory

LOOK_NS = SECOND_NS  # between two looks at the trajectory
STEP_NS = SECOND_NS // 10  # between the attitudes that a turn is found by
HOLE_NS = 3 * STEP_NS  # between two of them: a gap of the trajectory
SEEN_NS = 20 * SECOND_NS  # of attitudes that are kept: longer than a strip that is too short, and a turn
NEVER_NS = 1 << 62
LATEST = 4  # strips whose points may still come

SIDE = 64  # cells along a side of a tile of moments
ACTIVE = 192  # tiles of moments held at once: 69 MB
COLD_NS = 6 * SECOND_NS  # without new points: a tile of the present strip is complete
MOST_PLANES = 6144  # tiles of planes held: 25 million cells, 302 MB
COARSEST_M = 16.0
MOST_LEVELS = 6  # of joining: to one cell a tile
FARTHEST = 1 << 24
FREE = 1 << 40  # in place of the column of a tile of moments that is not used
PLANE_DTYPE = np.dtype(
    [
        ("height", "f4"),  # at the centroid, above the origin
        ("east", "f2"),  # gradient
        ("north", "f2"),
        ("x", "i1"),  # of the centroid from the cell's centre, in 1/256 of a cell
        ("y", "i1"),
        ("strip", "u2"),  # 0: no plane
    ]
)


@dataclass(slots=True)
class Strip:
    """A strip, perhaps still being flown.

    Attributes:
        number: from 1.
        start_ns, end_ns: GPS times; half open.
    """

    number: int
    start_ns: int
    end_ns: int

    def plain(self) -> dict[str, int]:
        """Return the strip in plain values."""
        return {"strip": self.number, "start_gps_ns": self.start_ns, "end_gps_ns": self.end_ns}


class StripCutter:
    """Finds strips as the trajectory grows: straight stretches with the laser on, by `swath.georef.strips`.

    The newest two seconds are judged by half the time that the office has about them, so that a point that comes at a
    strip's begin or end may count for the strip a second or two longer or shorter; the strip's times themselves are
    then corrected. A stretch counts as a strip from its beginning; if it turns out
    to be too short, its number is given up again.

    Attributes:
        strips: complete ones.
        open: the present one, which may still turn out to be too short; None: the aircraft turns, or the laser is off.
        dropped: numbers given up since they were last taken.
    """

    def __init__(self, gps_from_host: Callable[[int], int | None], rules: StripRules | None = None) -> None:
        """Begin without a strip; ``gps_from_host`` gives GPS time of a host time, None if it is not known."""
        self.strips: list[Strip] = []
        self.open: Strip | None = None
        self.dropped: list[int] = []
        self._rules = rules or StripRules()
        self._gps_from_host = gps_from_host
        self._times: Int64Array = np.zeros(0, np.int64)  # of the attitudes seen
        self._seen: FloatArray = np.zeros((0, 2))  # heading, roll
        self._looked_ns = self._newest_ns = 0
        self._is_straight = False
        self._laser_to_ns = 0  # host time of the last data of a scanner
        self._laser_gap: tuple[int, int] | None = None
        self._laser_from_ns = 0  # GPS time since when the laser is on

    @property
    def is_settled(self) -> bool:
        """True if there is no present strip, or one that is long enough."""
        shortest_ns = self._rules.min_strip_s * SECOND_NS
        return self.open is None or self._newest_ns - self.open.start_ns >= shortest_ns

    def note_laser(self, first_ns: int, last_ns: int) -> None:
        """Note that a scanner sent data between two host times."""
        if self._laser_to_ns and first_ns - self._laser_to_ns > self._rules.laser_gap_s * SECOND_NS:
            self._laser_gap = self._laser_to_ns, first_ns
        self._laser_to_ns = max(self._laser_to_ns, last_ns)

    def update(self, trajectory: Trajectory, now_ns: int) -> None:
        """Look at the trajectory so far, at a host time of the log."""
        newest_ns = int(trajectory.time_ns[-1])
        if newest_ns < self._looked_ns + LOOK_NS:
            return
        self._looked_ns = newest_ns
        self._see(trajectory)
        self._look_for_laser(now_ns)
        spans = self._straight()
        self._is_straight = bool(spans) and spans[-1][1] > self._newest_ns
        turned_ns = self._newest_ns - (spans[-1][1] if spans else 0)
        if self.open is not None:
            if self._is_straight and spans[-1][0] <= self.open.end_ns + STEP_NS:
                self.open.end_ns = self._newest_ns + 1
                if spans[-1][0] - int(self._times[0]) > self._rules.window_s * SECOND_NS:  # the turn before is seen too
                    self.open.start_ns = self._start_ns(spans[-1])
                return
            if not self._is_straight and turned_ns < self._rules.min_turn_s * SECOND_NS:
                return
            before = [end for start, end in spans if start <= self.open.end_ns + STEP_NS]
            self._close(min(self.open.end_ns, before[-1]) if before else self.open.end_ns)
        if self._is_straight and self._laser_from_ns < NEVER_NS:
            number = self.strips[-1].number + 1 if self.strips else 1
            self.open = Strip(number, self._start_ns(spans[-1]), self._newest_ns + 1)

    def _start_ns(self, span: Span) -> int:
        return max(span[0], self._laser_from_ns, self.strips[-1].end_ns if self.strips else 0)

    def end(self) -> None:
        """End the present strip: the recording has ended."""
        if self.open is not None:
            self._close(self.open.end_ns)

    def edges(self) -> Int64Array:
        """Return beginning, end and number (m, 3) of the latest strips; the present one has no end yet."""
        rows = [(one.start_ns, one.end_ns, one.number) for one in self.strips[-LATEST:]]
        if self.open is not None:
            rows.append((self.open.start_ns, NEVER_NS if self._is_straight else self.open.end_ns, self.open.number))
        return np.array(rows, np.int64).reshape(-1, 3)

    def _see(self, trajectory: Trajectory) -> None:
        """Keep the attitudes of new epochs, about ten a second."""
        time_ns = trajectory.time_ns
        first = int(np.searchsorted(time_ns, self._newest_ns + STEP_NS))
        if first == len(time_ns):
            return
        span_ns = max(1, int(time_ns[-1] - time_ns[first]))
        rows = np.arange(first, len(time_ns), max(1, (len(time_ns) - 1 - first) * STEP_NS // span_ns))
        seen = np.empty((len(rows), 2))
        _fill_attitudes(trajectory.position_e, trajectory.q_e_from_b, rows, seen)
        self._newest_ns = int(time_ns[rows[-1]])
        times = np.concatenate([self._times, time_ns[rows]])
        kept = int(np.searchsorted(times, self._newest_ns - SEEN_NS))
        self._times, self._seen = times[kept:], np.concatenate([self._seen, np.nan_to_num(seen)])[kept:]

    def _straight(self) -> list[Span]:
        """Return straight spans of the last seconds; gaps of the trajectory count as straight, as in the office."""
        times = self._times
        holes = np.flatnonzero(np.diff(times) > HOLE_NS)
        unknown = [(int(times[hole]), int(times[hole + 1])) for hole in holes]
        return straight_spans(times, self._seen[:, 0], self._seen[:, 1], self._rules, unknown)

    def _look_for_laser(self, now_ns: int) -> None:
        gap, self._laser_gap = self._laser_gap, None
        if gap is None and now_ns - self._laser_to_ns > self._rules.laser_gap_s * SECOND_NS:
            gap = self._laser_to_ns, 0
        if gap is None:
            return
        off_ns = self._gps_from_host(gap[0])
        on_ns = self._gps_from_host(gap[1]) if gap[1] else NEVER_NS
        if self.open is not None and off_ns is not None:
            self._close(min(self.open.end_ns, off_ns))
        self._laser_from_ns = 0 if on_ns is None else on_ns

    def _close(self, end_ns: int) -> None:
        strip, self.open = self.open, None
        assert strip is not None
        strip.end_ns = end_ns
        if strip.end_ns - strip.start_ns >= self._rules.min_strip_s * SECOND_NS:
            self.strips.append(strip)
        else:
            self.dropped.append(strip.number)


class Spread:
    """Height differences as a histogram, from which all their figures follow."""

    def __init__(self) -> None:
        self._counts = np.zeros(2 * HISTOGRAM_HALF + 1, np.int64)
        self._squares = self._sum = 0.0

    def add(self, dz_m: FloatArray) -> None:
        """Add differences (n,)."""
        steps = np.clip(np.rint(dz_m / HISTOGRAM_STEP_M), -HISTOGRAM_HALF, HISTOGRAM_HALF).astype(np.int64)
        low = int(steps.min())
        counts = np.bincount(steps - low)
        self._counts[low + HISTOGRAM_HALF : low + HISTOGRAM_HALF + len(counts)] += counts
        self._squares += float((dz_m**2).sum())
        self._sum += float(dz_m.sum())

    def merge(self, other: Spread) -> None:
        """Add the differences of another one."""
        self._counts += other._counts
        self._squares += other._squares
        self._sum += other._sum

    def numbers(self) -> dict[str, float | int]:
        """Return number of cells, median, mean and root mean square (RMSDz); only the number if that is 0."""
        cells = int(self._counts.sum())
        if not cells:
            return {"cells": 0}
        median = int(np.searchsorted(np.cumsum(self._counts), 0.5 * cells)) - HISTOGRAM_HALF
        return {
            "cells": cells,
            "median_m": round(median * HISTOGRAM_STEP_M, 3),
            "mean_m": round(self._sum / cells, 4),
            "rms_m": round(math.sqrt(self._squares / cells), 4),
        }


class StripComparison:
    """Compares the present strip, cell by cell, with the newest one before it.

    Cells are those of the map, or joined ones where the first strip's single returns are too few for planes.

    Attributes:
        side_m: side of the cells; None: not chosen yet.
        pairs: figures of strips that are complete, each against one before it.
        total: differences of all pairs.
    """

    def __init__(self, fine_m: float) -> None:
        """Begin without strips; ``fine_m`` is the side of the smallest cells."""
        self.side_m: float | None = None
        self.pairs: list[dict[str, Any]] = []
        self.total = Spread()
        self._fine_m, self._levels = fine_m, 0
        self._number = 0
        self._against: dict[int, Spread] = {}
        self._moments = np.zeros((ACTIVE, SIDE, SIDE, MOMENTS))
        self._places: Int64Array = np.full((ACTIVE, 2), FREE, np.int64)
        self._newest_ns: Int64Array = np.zeros(ACTIVE, np.int64)
        self._planes: dict[tuple[int, int], StructArray] = {}

    def take(
        self, points: Points, xyz: FloatArray, origin: FloatArray, unit_m: FloatArray, edges: Int64Array, grid: CellGrid
    ) -> None:
        """Add a block's points, as far as they are the present strip's single returns.

        Args:
            points: the points.
            xyz: (n, 3) their coordinates.
            origin, unit_m: (3,) the map's origin in these coordinates; metres in each unit.
            edges: strips as `StripCutter.edges` gives them.
            grid: takes the differences of tiles that must make room.
        """
        if not len(edges):
            return
        begin_ns, end_ns, number = edges[-1].tolist()
        if number != self._number:
            self.finish(grid)
            self._number = number
        done = 0
        while done < len(points):
            done = _sum_moments(
                xyz,
                points.time_ns,
                points.return_number,
                points.number_of_returns,
                done,
                origin,
                unit_m,
                self._fine_m,
                begin_ns,
                end_ns,
                self._moments,
                self._places,
                self._newest_ns,
            )
            if done < len(points):
                self._fold(self._newest_ns <= np.partition(self._newest_ns, ACTIVE // 8)[ACTIVE // 8], grid)

    def drop(self, number: int) -> None:
        """Give up the present strip: it turned out to be none."""
        if number == self._number:
            self._free(self._places[:, 0] != FREE)
            self._number = 0
            self._against.clear()

    def update(self, newest_ns: int, grid: CellGrid) -> None:
        """Compare what is complete at a GPS time."""
        self._fold((self._places[:, 0] != FREE) & (self._newest_ns < newest_ns - COLD_NS), grid)

    def finish(self, grid: CellGrid) -> None:
        """Compare the rest of the present strip, which is complete."""
        self._fold(self._places[:, 0] != FREE, grid)
        self.pairs += self._rows()
        self._against.clear()
        self._number = 0

    def heights(self, places: FloatArray) -> tuple[FloatArray, Int64Array]:
        """Return the heights (n,) above the origin of earlier strips' planes at places (n, 2), nan where there is none,
        and the numbers (n,) of these strips.
        """
        up_m, numbers = np.full(len(places), np.nan), np.zeros(len(places), np.int64)
        cells = places / self._side_m
        across, up = (np.floor(cells[:, axis]).astype(np.int64) for axis in (0, 1))
        side = SIDE >> self._levels
        tiles = (across // side) * (2 * FARTHEST) + up // side
        for tile in np.unique(tiles).tolist():
            own = np.flatnonzero(tiles == tile)
            kept = self._planes.get((int(across[own[0]]) // side, int(up[own[0]]) // side))
            if kept is None:
                continue
            planes = kept[up[own] % side, across[own] % side]
            x, y = (cells[own, axis] - np.floor(cells[own, axis]) - 0.5 for axis in (0, 1))
            east, north = planes["east"].astype(np.float64), planes["north"].astype(np.float64)
            level = planes["height"] + self._side_m * (
                east * (x - planes["x"] / 256.0) + north * (y - planes["y"] / 256.0)
            )
            up_m[own] = np.where(planes["strip"] > 0, level, np.nan)
            numbers[own] = planes["strip"]
        return up_m, numbers

    def present(self) -> dict[str, Any]:
        """Return the figures of the present strip: against all strips before it, and against each."""
        both = Spread()
        for one in self._against.values():
            both.merge(one)
        return {"strip": self._number or None, **both.numbers(), "against": self._rows()}

    @property
    def _side_m(self) -> float:
        return math.ldexp(self._fine_m, self._levels)

    def _rows(self) -> list[dict[str, Any]]:
        return [
            {"first": other, "second": self._number, **spread.numbers()}
            for other, spread in sorted(self._against.items())
        ]

    def _free(self, which: BoolArray) -> None:
        self._moments[which] = 0.0
        self._places[which] = FREE
        self._newest_ns[which] = 0

    def _fold(self, which: BoolArray, grid: CellGrid) -> None:
        """Compare tiles of moments with the planes there, and keep their planes in place of these."""
        if not which.any():
            return
        if self.side_m is None:
            self._choose_cells(which)
        for tile in np.flatnonzero(which).tolist():
            if self._places[tile, 0] != FREE:
                column, row = self._places[tile].tolist()
                dz_m = self._compared((column, row), self._moments[tile])
                if dz_m is not None:
                    grid.set_differences(column * SIDE, row * SIDE, self._fine_m, self._side_m, dz_m)
        self._free(which)

    def _choose_cells(self, which: BoolArray) -> None:
        """Join cells until they hold as many single returns as the office's."""
        moments = self._moments[which].reshape(-1, SIDE // TILE, TILE, SIDE // TILE, TILE, MOMENTS)[..., :2]
        density = open_density(moments.swapaxes(2, 3).reshape(-1, TILE * TILE, 2), self._fine_m)
        wanted_m = math.sqrt(RETURNS_A_CELL / density) if density > 0.0 else 0.0
        side_m = self._fine_m
        while side_m * math.sqrt(2.0) < wanted_m and 2.0 * side_m <= COARSEST_M and self._levels < MOST_LEVELS:
            side_m *= 2.0
            self._levels += 1
        self.side_m = side_m

    def _compared(self, place: tuple[int, int], moments: FloatArray) -> SingleArray | None:
        """Return differences of a tile (rows, columns), nan where there are none; None: there are none at all."""
        for level in range(self._levels):
            moments = merged(moments, self._fine_m * 2**level)
        enough = moments[..., 1] >= FEWEST_RETURNS
        if not enough.any():
            return None
        found = planes_of(moments[enough], self._side_m)
        kept = self._planes.get(place)
        if kept is None:
            while len(self._planes) >= MOST_PLANES:
                self._planes.pop(next(iter(self._planes)))
            kept = self._planes[place] = np.zeros(moments.shape[:2], PLANE_DTYPE)
        before = kept[enough]
        step_m = self._side_m / 256.0
        both = found.smooth & (before["strip"] > 0) & (before["strip"] != self._number)
        dz_m = None
        if both.any():
            x_m, y_m = before["x"] * step_m, before["y"] * step_m
            at_x, at_y = (x_m + found.x_m) / 2, (y_m + found.y_m) / 2
            east, north = before["east"].astype(np.float64), before["north"].astype(np.float64)
            earlier = before["height"] + east * (at_x - x_m) + north * (at_y - y_m)
            differences = np.where(both, earlier - found.height(at_x, at_y), np.nan)
            for other in np.unique(before["strip"][both]).tolist():
                values = differences[both & (before["strip"] == other)]
                self._against.setdefault(other, Spread()).add(values)
                self.total.add(values)
            dz_m = np.full(enough.shape, np.nan, np.float32)
            dz_m[enough] = differences
        new = np.zeros(len(before), PLANE_DTYPE)
        new["height"], new["east"], new["north"] = found.z_m, found.east, found.north
        new["x"], new["y"] = (np.clip(np.rint(one / step_m), -128, 127) for one in (found.x_m, found.y_m))
        new["strip"] = self._number
        kept[enough] = np.where(found.smooth, new, before)
        return dz_m


@jit_cached
def _fill_attitudes(position_e: Any, q_e_from_b: Any, rows: Any, seen: Any) -> None:
    """Fill ``seen`` (n, 2) with heading (0 … 2π) and roll at the epochs ``rows`` (n,) of a trajectory."""
    for i in range(len(rows)):
        lat, lon, _ = geodetic_of(*vector_at(position_e, rows[i]))
        seen[i, 0], seen[i, 1] = heading_and_roll(lat, lon, rot_at(q_e_from_b, rows[i]))


@jit_cached
def _sum_moments(
    xyz: Any,
    time_ns: Any,
    return_number: Any,
    number_of_returns: Any,
    first: int,
    origin: Any,
    unit_m: Any,
    cell_m: float,
    begin_ns: int,
    end_ns: int,
    moments: Any,
    places: Any,
    newest_ns: Any,
) -> int:
    """Add single returns of a span of time from ``first`` on; return how far it came for lack of a tile."""
    column_before, row_before, tile = FREE, FREE, -1
    per_m = 1.0 / cell_m
    for i in range(first, len(xyz)):
        if number_of_returns[i] > 1 or time_ns[i] < begin_ns or time_ns[i] >= end_ns:
            continue
        x_m, y_m = (xyz[i, 0] - origin[0]) * unit_m[0], (xyz[i, 1] - origin[1]) * unit_m[1]
        z = (xyz[i, 2] - origin[2]) * unit_m[2]
        across, up = math.floor(x_m * per_m), math.floor(y_m * per_m)
        if not (abs(x_m) < FARTHEST and abs(y_m) < FARTHEST and abs(z) < FARTHEST):
            continue
        column, row = across >> 6, up >> 6
        if column != column_before or row != row_before:
            tile, free = -1, -1
            for k in range(len(places)):
                if places[k, 0] == column and places[k, 1] == row:
                    tile = k
                    break
                if free < 0 and places[k, 0] == FREE:
                    free = k
            if tile < 0:
                if free < 0:
                    return i
                tile = free
                places[tile, 0], places[tile, 1] = column, row
            column_before, row_before = column, row
        newest_ns[tile] = max(newest_ns[tile], time_ns[i])
        cell = moments[tile, up & 63, across & 63]
        x, y = x_m - (across + 0.5) * cell_m, y_m - (up + 0.5) * cell_m
        if return_number[i] <= 1:
            cell[0] += 1.0
        add_moments(cell, x, y, z)
    return len(xyz)
