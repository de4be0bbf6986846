"""Takes a quick look at files of points: reads them once into cells, and computes the most important numbers."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from swath.daemon.processing.point_times import time_notes
from swath.daemon.processing.quicklook.grids import FIRST, Surface, cell_for, frame_of, inner
from swath.daemon.processing.quicklook.profile import (
    Line,
    Profile,
    axis_of,
    choose_line,
    line_through,
    read_profile,
)
from swath.daemon.processing.quicklook.read import (
    QuickLookError,
    Source,
    StripBook,
    Units,
    check_one_crs,
    density_near,
    find_files,
    open_source,
    read_blocks,
    units_of,
)
from swath.daemon.processing.quicklook.strips import (
    FINEST_CELL_M,
    MOST_STRIPS,
    Overlap,
    StripCells,
    compare,
    strip_frame,
)
from swath.daemon.processing.strip_agreement import Agreement
from swath.georef.arrays import BoolArray, FloatArray, SingleArray
from swath.georef.progress import Tell, silent
from swath.georef.strip_colours import PALETTE, colours_of, contact

READING = "reading points"
RETURNS_A_CELL = 4  # of the pictures: a side of two point spacings
SAMPLED_FILES = 5


@dataclass(frozen=True, slots=True)
class StripFacts:
    """The numbers of a strip; lengths in metres, sigmas (3,) of easting, northing and height as root mean squares."""

    name: str
    points: int
    pulses: int
    area_m2: float
    density: float
    length_m: float
    sigma_m: FloatArray | None
    largest_sigma_m: FloatArray | None


@dataclass(slots=True)
class StripSums:
    """Sums per strip while points are read."""

    sums: FloatArray = field(default_factory=lambda: np.zeros((0, 9)))

    def add(self, strip: NDArray[np.int32], first: BoolArray, sigma_m: SingleArray) -> None:
        """Count points and pulses; sum squares of sigmas, and keep the largest."""
        strips = int(strip.max(initial=-1)) + 1
        if strips > len(self.sums):
            self.sums = np.concatenate([self.sums, np.zeros((strips - len(self.sums), 9))])
        self.sums[:strips, 0] += np.bincount(strip, minlength=strips)
        self.sums[:strips, 1] += np.bincount(strip[first], minlength=strips)
        if not len(sigma_m):
            return
        known = ~np.isnan(sigma_m.sum(axis=1))
        if not known.any():
            return
        if not known.all():
            strip, sigma_m = strip[known], sigma_m[known]
        self.sums[:strips, 2] += np.bincount(strip, minlength=strips)
        for axis in range(3):
            squares = sigma_m[:, axis].astype(float) ** 2
            self.sums[:strips, 3 + axis] += np.bincount(strip, squares, minlength=strips)
        numbers = np.flatnonzero(np.bincount(strip))
        for number in numbers:
            chosen = sigma_m if len(numbers) == 1 else sigma_m[strip == number]
            self.sums[number, 6:] = np.maximum(self.sums[number, 6:], chosen.max(axis=0))


@dataclass(slots=True)
class Look:
    """The results of reading files.

    Attributes:
        sources, units: the files and the units of their coordinates.
        names, origins: by number of the strip: its name; and the sessions of its run with its point source id.
        surface: cells of all strips together.
        cells, overlap, agreement: cells per strip, differences of strips, and their agreement.
        strips: facts by number of the strip.
        profile: None: there are no points for one.
        density: mean pulses per m² of fully covered cells; area_m2: of all covered ones.
        skipped: number of noise and withheld points.
        notes: notes for the reader of the page.
        colours: by number of the strip, in every picture; strips side by side differ.
    """

    sources: list[Source]
    units: Units
    names: list[str]
    surface: Surface
    cells: StripCells
    overlap: Overlap
    agreement: Agreement
    strips: list[StripFacts]
    profile: Profile | None
    density: float
    area_m2: float
    skipped: int
    notes: list[str]
    origins: list[tuple[tuple[str, ...], int]] = field(default_factory=list)
    colours: list[str] = field(init=False)

    def __post_init__(self) -> None:
        chosen = colours_of(contact(self.cells.tiles >= 0))
        more = len(self.names) - len(chosen)  # strips beyond those that are compared
        self.colours = chosen + [PALETTE[number % len(PALETTE)] for number in range(more)]


def look_at(
    paths: Sequence[Path],
    cell_m: float | None = None,
    ends: Sequence[float] | None = None,
    told: Tell = silent,
    strip_cell_m: float | None = None,
) -> Look:
    """Read files and folders into a quick look.

    Args:
        paths: files and folders.
        cell_m: side of the pictures' cells; None: by the density of points.
        ends: x1, y1, x2, y2 of the profile in the files' coordinates; None: chosen automatically.
        told: called with the progress.
        strip_cell_m: side of the cells in which strips are compared; None: by the strips' density, beginning with
            ``cell_m`` if it is given and not too fine.

    Raises:
        QuickLookError: there are no points, or the files do not share one map.
    """
    sources = [open_source(path) for path in find_files(paths)]
    check_one_crs(sources)
    total = sum(source.point_count for source in sources)
    if total == 0:
        raise QuickLookError(f"{', '.join(str(source.path) for source in sources)}: no points")
    units = units_of(sources)
    reading = _read(sources, units, (cell_m, strip_cell_m), told)
    if reading.surface.points == 0:
        damage = next((f"{source.path}: {source.damage}" for source in sources if source.damage), "")
        raise QuickLookError(damage or f"{sources[0].path}: all points are noise or withheld")
    overlap = compare(reading.cells)
    strips = [_facts(reading, number) for number in range(len(reading.book.names))]
    profile = _profile(reading, overlap, strips, ends)
    agreement = Agreement.of(reading.cells, overlap)
    notes = _notes(reading, overlap, cell_m, strip_cell_m)
    return Look(
        sources,
        units,
        reading.book.names,
        reading.surface,
        reading.cells,
        overlap,
        agreement,
        strips,
        profile,
        agreement.pulses_m2,
        agreement.area_m2,
        reading.skipped,
        notes,
        reading.book.origins,
    )


def _corners(sources: Sequence[Source], units: Units) -> tuple[FloatArray, FloatArray]:
    """Return south-western and north-eastern corners (3,) from the headers of files that have points."""
    metres = np.array([units.east_m, units.north_m, units.up_m])
    corners = np.array([[source.low * metres, source.high * metres] for source in sources if source.point_count])
    good = np.isfinite(corners).all(axis=(1, 2)) & (corners[:, 1] >= corners[:, 0]).all(axis=1)
    if not good.any():
        return np.zeros(3), np.ones(3)
    return corners[good, 0].min(axis=0), corners[good, 1].max(axis=0)


def _picture_side_m(sources: Sequence[Source], units: Units, corners: tuple[FloatArray, FloatArray]) -> float:
    """Return the side of the pictures' cells in metres, from a sample of the files' points."""
    full = [source for source in sources if source.point_count]
    sampled = full[:: -(-len(full) // SAMPLED_FILES)]
    size_m = np.maximum((corners[1] - corners[0])[:2], 1.0)
    density = float(np.median([density_near(source, units) for source in sampled]))
    density = density or sum(source.point_count for source in full) / float(size_m.prod())
    return cell_for(density, RETURNS_A_CELL)


class _Reading:
    """Files that are read into cells."""

    def __init__(
        self,
        sources: Sequence[Source],
        units: Units,
        corners: tuple[FloatArray, FloatArray],
        side_m: float,
        strip_side_m: tuple[float | None, bool],
        told: Tell,
    ) -> None:
        self.sources, self.units, self.told = sources, units, told
        self.total = sum(source.point_count for source in sources)
        low_m, high_m = corners
        self.surface = Surface(frame_of(low_m, high_m, side_m))
        finest_m, fixed = strip_side_m
        frame = strip_frame(low_m, high_m, finest_m)
        self.cells = StripCells(frame, float(low_m[2] + high_m[2]) / 2, fixed=fixed)
        self.sums, self.book, self.skipped = StripSums(), StripBook(), 0

    def read(self) -> None:
        """Read all files into the cells and sums."""
        done = 0
        for source in self.sources:
            source.boxes_m.clear()
            source.damage = ""
            for block in read_blocks(source, self.units, self.book):
                self.surface.add(block)
                self.cells.add(block)
                self.sums.add(block.strip, block.first, block.sigma_m)
                self.skipped += block.skipped
                done += len(block) + block.skipped
                self.told(READING, done, self.total, "points")


def _read(sources: Sequence[Source], units: Units, given_m: tuple[float | None, float | None], told: Tell) -> _Reading:
    """Read all files; once more if points lie outside the headers' extent, which then follows from the points.

    ``given_m``: sides of the cells of the pictures and of the strips; None: automatic.
    """
    corners = _corners(sources, units)
    cell_m, strip_cell_m = given_m
    side_m = cell_m or _picture_side_m(sources, units, corners)
    finest_m = cell_m if cell_m is not None and cell_m >= FINEST_CELL_M else None
    strip_side_m = (finest_m, False) if strip_cell_m is None else (strip_cell_m, True)
    reading = _Reading(sources, units, corners, side_m, strip_side_m, told)
    reading.read()
    if reading.surface.outside:
        corners = (reading.surface.low_m, reading.surface.high_m)
        reading = _Reading(sources, units, corners, side_m, strip_side_m, told)
        reading.read()
    return reading


def _facts(reading: _Reading, number: int) -> StripFacts:
    points, pulses, with_sigma = (int(value) for value in reading.sums.sums[number, :3])
    coverage = reading.cells.coverage(number)
    whole = inner(coverage.there)
    cell_m = coverage.frame.cell_m
    sigma_m = largest_m = None
    if with_sigma:
        sigma_m = np.sqrt(reading.sums.sums[number, 3:6] / with_sigma)
        largest_m = reading.sums.sums[number, 6:9]
    places_m = coverage.centres()
    length_m = 0.0
    if len(places_m):
        centre, ahead = axis_of(places_m)
        length_m = float(np.ptp((places_m - centre) @ ahead)) + cell_m
    density = float(coverage.pulses[whole].mean()) / cell_m**2 if whole.any() else math.nan
    area_m2 = float(coverage.there.sum()) * cell_m**2
    return StripFacts(reading.book.names[number], points, pulses, area_m2, density, length_m, sigma_m, largest_m)


def _profile(
    reading: _Reading, overlap: Overlap, strips: Sequence[StripFacts], ends: Sequence[float] | None
) -> Profile | None:
    longest = max(range(len(strips)), key=lambda number: strips[number].length_m)
    cell_m = max(reading.cells.frame.cell_m, reading.surface.frame.cell_m)
    half_width_m = float(np.clip(cell_m / 2, 0.5, 50.0))
    line: Line | None
    if ends is not None:
        line = line_through(ends, reading.units, half_width_m)
        if line.length_m <= 0.0:
            raise QuickLookError("--profile: both ends are the same point; give x1,y1,x2,y2")
    else:
        line = choose_line(reading.cells, overlap, reading.book.names, longest, reading.sources, half_width_m)
    if line is None:
        return None
    profile = read_profile(reading.sources, reading.units, reading.book, line, trim=ends is None)
    if not len(profile.along_m):
        if ends is not None:
            raise QuickLookError(f"--profile: no points within {line.half_width_m:g} m of that line")
        return None
    return profile


def _notes(reading: _Reading, overlap: Overlap, cell_m: float | None, strip_cell_m: float | None) -> list[str]:
    """Return notes on assumptions, points left out, and changed cell sizes."""
    notes = [reading.units.note] if reading.units.note else []
    notes += reading.book.notes
    notes += time_notes([source.times for source in reading.sources])
    notes += [f"{source.path.name}: {source.damage}: partial" for source in reading.sources if source.damage]
    if any(source.crs is not None for source in reading.sources):
        without = [source.path.name for source in reading.sources if source.crs is None]
        notes += [
            f"{', '.join(without)}: {reading.sources[0].trouble or 'no CRS'}, so the CRS of the other files is assumed"
        ] * bool(without)
    if cell_m and reading.surface.frame.cell_m > cell_m:
        notes.append(f"cells of {cell_m:g} m would be too many; they are {reading.surface.frame.cell_m:g} m")
    if strip_cell_m and reading.cells.frame.cell_m > strip_cell_m:
        made_m = reading.cells.frame.cell_m
        notes.append(f"cells of {strip_cell_m:g} m would be too many; strips are compared in cells of {made_m:g} m")
    if reading.skipped:
        notes.append(f"{reading.skipped:,} points left out: noise (classes 7 and 18) or withheld")
    if reading.surface.unknown_sigma:
        notes.append(f"{reading.surface.unknown_sigma:,} points have sigmas that are unknown or exceed their field")
    if len(reading.book.names) > 1 and not overlap.cells:
        notes.append(f"no two strips share a smooth cell of {reading.cells.frame.cell_m:g} m, so they are not compared")
    if len(reading.book.names) > MOST_STRIPS:
        notes.append(f"only the first {MOST_STRIPS:,} of {len(reading.book.names):,} strips were compared")
    return notes


def numbers_of(look: Look) -> dict[str, Any]:
    """Return the page's numbers for scripts."""
    return {
        "files": [
            {
                "file": str(source.path),
                "points": source.point_count,
                "version": source.version,
                "point_format": source.point_format,
                "crs": source.crs.name if source.crs is not None else None,
                "damage": source.damage or None,
            }
            for source in look.sources
        ],
        "points": look.surface.points,
        "skipped": look.skipped,
        "pulses": int(look.surface.sums[:, :, FIRST].sum()),
        "area_m2": look.area_m2,
        "density_per_m2": look.density,
        "cell_m": look.surface.frame.cell_m,
        "strip_cell_m": look.cells.frame.cell_m,
        "low_m": look.surface.low_m.tolist(),
        "high_m": look.surface.high_m.tolist(),
        "strips": [_strip_numbers(strip) for strip in look.strips],
        "pairs": [
            row | {"first": look.names[row["first"]], "second": look.names[row["second"]]} for row in look.overlap.rows
        ],
        "overlap": look.overlap.numbers(),
        "quality": look.agreement.record(),
        "notes": look.notes,
    }


def _strip_numbers(strip: StripFacts) -> dict[str, Any]:
    return {
        "name": strip.name,
        "points": strip.points,
        "pulses": strip.pulses,
        "area_m2": strip.area_m2,
        "length_m": strip.length_m,
        "density_per_m2": None if math.isnan(strip.density) else strip.density,
        "sigma_m": None if strip.sigma_m is None else strip.sigma_m.tolist(),
        "largest_sigma_m": None if strip.largest_sigma_m is None else strip.largest_sigma_m.tolist(),
    }
