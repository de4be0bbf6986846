"""Cuts a section through the points: chooses its line, collects points near it, and compares strips along it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from swath.daemon.processing.quicklook.read import Source, StripBook, Units, read_blocks
from swath.daemon.processing.quicklook.strips import ROUGHEST_M, Overlap, Pair, StripCells
from swath.georef.arrays import BoolArray, FloatArray, SingleArray

MOST_POINTS = 2_000_000  # maximum points kept in the corridor
MOST_BLOCKS = 15  # maximum blocks read again for an automatic line
SHORTEST_M = 50.0
BINS = 80
FEWEST_IN_BIN = 5
BORDER = 0.15  # share of the overlap's width that is shown beyond it


@dataclass(frozen=True, slots=True)
class Line:
    """The line of a section.

    Attributes:
        start_m, end_m: (2,) east and north of its ends.
        half_width_m: half width of the corridor whose points are shown.
        title: description of the line.
    """

    start_m: FloatArray
    end_m: FloatArray
    half_width_m: float
    title: str

    @property
    def length_m(self) -> float:
        """Length from end to end."""
        return float(np.hypot(*(self.end_m - self.start_m)))

    @property
    def ahead(self) -> FloatArray:
        """Unit vector (2,) along the line."""
        return (self.end_m - self.start_m) / self.length_m


@dataclass(frozen=True, slots=True)
class Profile:
    """Points near a line.

    Attributes:
        line: the line.
        along_m, aside_m, height_m: (n,) distance from the line's start, to its left, and height.
        strip: (n,) numbers of the strips.
        single: (n,) True for the only return of its pulse.
        complete: True if no point was left out to save memory.
    """

    line: Line
    along_m: SingleArray
    aside_m: SingleArray
    height_m: FloatArray
    strip: NDArray[np.int32]
    single: BoolArray
    complete: bool


def axis_of(points_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return centre and unit vector (2,) of the longest direction of points (n, 2)."""
    centre = points_m.mean(axis=0)
    if len(points_m) < 2:
        return centre, np.array([1.0, 0.0])
    vectors = np.linalg.eigh(np.cov((points_m - centre).T))[1]
    return centre, np.asarray(vectors[:, 1])


def choose_line(
    cells: StripCells,
    overlap: Overlap,
    names: Sequence[str],
    longest: int,
    sources: Sequence[Source],
    half_width_m: float,
) -> Line | None:
    """Return a line across the overlap of the two strips with most common smooth cells; else along the longest strip.

    Of a long strip only the middle is shown, so that not all points need to be read again.
    """
    if overlap.best is not None:
        return _across(cells, overlap.best, names, half_width_m)
    coverage = cells.coverage(longest)
    points_m = coverage.centres()
    if not len(points_m):
        return None
    centre, ahead = axis_of(points_m)
    ahead = ahead if ahead[np.argmax(np.abs(ahead))] > 0 else -ahead  # from west to east, or south to north
    along_m = (points_m - centre) @ ahead
    half_cell = coverage.frame.cell_m / 2
    start, end = centre + ahead * (along_m.min() - half_cell), centre + ahead * (along_m.max() + half_cell)
    line = Line(start, end, half_width_m, f"along strip {names[longest]}")
    while sum(_touches(box, line) for source in sources for box in source.boxes_m) > MOST_BLOCKS:
        start, end = centre + 0.7 * (line.start_m - centre), centre + 0.7 * (line.end_m - centre)
        line = Line(start, end, half_width_m, f"along the middle of strip {names[longest]}")
        if line.length_m < SHORTEST_M:
            break
    return line


def _across(cells: StripCells, pair: Pair, names: Sequence[str], half_width_m: float) -> Line:
    """Return a line at right angles to the first strip, through the part of the overlap with most cells."""
    points_m = cells.frame.centres(pair.row, pair.column)
    _, along = axis_of(cells.coverage(pair.first).centres())
    across = np.array([along[1], -along[0]])
    across = across if across[np.argmax(np.abs(across))] > 0 else -across
    band = np.rint(points_m @ along / (4 * cells.frame.cell_m)).astype(int)
    values, counts = np.unique(band, return_counts=True)
    rich = values[counts >= 0.8 * counts.max()]
    chosen = rich[np.argmin(np.abs(rich - np.median(band)))]  # of the bands with most cells, the one nearest the middle
    inside = points_m[band == chosen]
    centre, along_m = inside.mean(axis=0), inside @ across
    half = max(float(np.ptp(along_m)) * (0.5 + BORDER), 5 * cells.frame.cell_m)
    centre = centre + across * ((along_m.max() + along_m.min()) / 2 - centre @ across)
    title = f"across the overlap of strips {names[pair.first]} and {names[pair.second]}"
    return Line(centre - across * half, centre + across * half, half_width_m, title)


def line_through(ends: Sequence[float], units: Units, half_width_m: float) -> Line:
    """Return the line between two points in the files' coordinates: x1, y1, x2, y2."""
    corners = np.array(ends).reshape(2, 2) * [units.east_m, units.north_m]
    return Line(corners[0], corners[1], half_width_m, "as asked for")


def read_profile(sources: Sequence[Source], units: Units, book: StripBook, line: Line, *, trim: bool) -> Profile:
    """Return the points of a corridor, reading only blocks that touch it; ``trim`` cuts empty ends off the line."""
    none = (np.empty(0, np.float32), np.empty(0, np.float32), np.empty(0), np.empty(0, np.int32), np.empty(0, bool))
    parts: list[tuple[NDArray[Any], ...]] = [none]
    found = 0
    for source in sources:
        wanted = [number for number, box in enumerate(source.boxes_m) if _touches(box, line)]
        if not wanted or found >= MOST_POINTS:
            continue
        damage = source.damage
        for block in read_blocks(source, units, book, wanted):
            east_m, north_m = block.x_m - line.start_m[0], block.y_m - line.start_m[1]
            along_m = east_m * line.ahead[0] + north_m * line.ahead[1]
            aside_m = north_m * line.ahead[0] - east_m * line.ahead[1]
            near = (np.abs(aside_m) <= line.half_width_m) & (along_m >= 0.0) & (along_m <= line.length_m)
            places = along_m[near].astype(np.float32), aside_m[near].astype(np.float32)
            parts.append((*places, block.z_m[near], block.strip[near], block.single[near]))
            found += int(near.sum())
            if found >= MOST_POINTS:
                break
        source.damage = damage
    along, aside, height, strip, single = (np.concatenate(column) for column in zip(*parts, strict=True))
    profile = Profile(line, along, aside, height, strip, single, found < MOST_POINTS)
    return _trimmed(profile) if trim else profile


def _trimmed(profile: Profile) -> Profile:
    """Return the profile with its line cut to the first and last points."""
    if len(profile.along_m) < 2 or np.ptp(profile.along_m) <= 0.0:
        return profile
    line = profile.line
    low, high = float(profile.along_m.min()), float(profile.along_m.max())
    ends = line.start_m + line.ahead * low, line.start_m + line.ahead * high
    return replace(
        profile, line=replace(line, start_m=ends[0], end_m=ends[1]), along_m=profile.along_m - np.float32(low)
    )


def _touches(box: FloatArray, line: Line) -> bool:
    """Return False only if a box (west, south, east, north) holds no points of the corridor."""
    corners = np.array([[x, y] for x in (box[0], box[2]) for y in (box[1], box[3])])
    if not np.isfinite(corners).all():
        return False
    offsets = corners - line.start_m
    along_m = offsets @ line.ahead
    aside_m = offsets @ np.array([-line.ahead[1], line.ahead[0]])
    beside = aside_m.min() > line.half_width_m or aside_m.max() < -line.half_width_m
    return not (beside or along_m.min() > line.length_m or along_m.max() < 0.0)


@dataclass(frozen=True, slots=True)
class Steps:
    """Heights of strips along a line, relative to the mean of all strips.

    Attributes:
        along_m: (n,) centres of the bins.
        offset_m: strip → (n,); nan if the surface is rough or no other strip is there.
    """

    along_m: FloatArray
    offset_m: dict[int, FloatArray]


def steps_of(profile: Profile) -> Steps:
    """Return strips against their mean, bin by bin, after removing a slope common to all strips of a bin."""
    line, keep = profile.line, profile.single
    bins = int(np.clip(line.length_m / max(2 * line.half_width_m, 0.5), 1, BINS))
    size_m = line.length_m / bins
    middles = np.asarray((np.arange(bins) + 0.5) * size_m, np.float64)
    strips, which = np.unique(profile.strip[keep], return_inverse=True)
    along, height = profile.along_m[keep].astype(float), profile.height_m[keep]
    of_bin = np.minimum((along / size_m).astype(int), bins - 1)
    reference = float(np.median(height)) if len(height) else 0.0
    x, y, z = along - middles[of_bin], profile.aside_m[keep].astype(float), height - reference
    group, shape = which * bins + of_bin, (len(strips), bins)

    def summed(values: FloatArray) -> FloatArray:
        return np.asarray(np.bincount(group, values, minlength=math.prod(shape)), np.float64).reshape(shape)

    n, sx, sy, sz = (summed(values) for values in (np.ones_like(z), x, y, z))
    there, count = n >= FEWEST_IN_BIN, np.maximum(n, 1.0)

    def about_means(a: FloatArray, b: FloatArray) -> FloatArray:
        return np.where(there, summed(a * b) - summed(a) * summed(b) / count, 0.0)

    xx, xy, yy, xz, yz, zz = (about_means(*two) for two in ((x, x), (x, y), (y, y), (x, z), (y, z), (z, z)))
    along_slope, aside_slope = _slopes(*(part.sum(axis=0) for part in (xx, xy, yy, xz, yz)))
    left = zz - 2 * (along_slope * xz + aside_slope * yz)
    left += along_slope**2 * xx + 2 * along_slope * aside_slope * xy + aside_slope**2 * yy
    usable = there & (left / np.maximum(count - 3.0, 1.0) <= ROUGHEST_M**2)
    usable &= usable.sum(axis=0) > 1
    level = np.where(usable, (sz - along_slope * sx - aside_slope * sy) / count, np.nan)
    mean = np.nansum(level, axis=0) / np.maximum(usable.sum(axis=0), 1)
    return Steps(middles, {int(strip): level[row] - mean for row, strip in enumerate(strips) if usable[row].any()})


def _slopes(
    xx: FloatArray, xy: FloatArray, yy: FloatArray, xz: FloatArray, yz: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return least squares slopes along and aside; zero if the points do not spread."""
    determinant = xx * yy - xy * xy
    spread = determinant > 1e-6 * (xx + yy) ** 2
    safe = np.where(spread, determinant, 1.0)
    return np.where(spread, (xz * yy - yz * xy) / safe, 0.0), np.where(spread, (yz * xx - xz * xy) / safe, 0.0)
