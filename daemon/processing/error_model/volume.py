"""The volume between points and a level base within a polygon, and how sure it is by the error model.

The ground is averaged in cells. A cell's volume errs by its height's error, and by its place's error times its slope: a
shift of an even slope adds what a shift of a symmetric heap does not. Errors that cells share add up; the noise of
single returns averages out.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.path import Path as Outline

from swath.daemon.errors import ExitCode, UserError
from swath.daemon.processing.error_model.file import ModelFile
from swath.daemon.processing.error_model.points import Found, of_files, within
from swath.georef.arrays import FloatArray, Int64Array

MOST_CELLS = 1500  # a pair of cells and strips each costs an evaluation of the model
POINTS_A_CELL = 12.0  # of few cells none is empty by chance
LEAST_POINTS = 30
FINE = 16  # parts of a cell in each direction, to find how much of it lies in the polygon


@dataclass(frozen=True, eq=False)
class _Cells:
    """Cells of a polygon: pieces are points of one unit in one cell.

    Attributes:
        side_m: of a cell. cell: (p,) number of each piece's cell.
        share: (p,) share of the piece in its cell's mean; count: (p,) of points.
        middle_m, time_ns, unit: (p, 3), (p,), (p,) a point in the midst of the piece.
        height_m: (c,) mean height of the cells; slope: (c, 2) to east and north; area_m2: (c,) within the polygon.
    """

    side_m: float
    cell: Int64Array
    share: FloatArray
    count: Int64Array
    middle_m: FloatArray
    time_ns: Int64Array
    unit: Int64Array
    height_m: FloatArray
    slope: FloatArray
    area_m2: FloatArray


def read_polygon(path: Path) -> FloatArray:
    """Read corners (n, 2) in the points' CRS: a GeoJSON polygon without holes, or a CSV of easting and northing.

    Raises:
        UserError: the file has no polygon; one line.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        why = error.strerror if isinstance(error, OSError) else "is no text"
        raise UserError(f"{path}: {why}; want a polygon", ExitCode.USAGE) from error
    try:
        corners = _geojson(json.loads(text)) if text.lstrip().startswith("{") else _table(text)
    except (ValueError, KeyError, TypeError, IndexError, AttributeError) as error:
        raise UserError(
            f"{path}: is no polygon ({error}); want a GeoJSON polygon or lines of easting,northing", ExitCode.USAGE
        ) from error
    if len(corners) > 1 and (corners[0] == corners[-1]).all():
        corners = corners[:-1]
    if len(corners) < 3 or not np.isfinite(corners).all() or area_of(corners) <= 0.0 or _crosses_itself(corners):
        raise UserError(
            f"{path}: its corners make no simple polygon; give three or more in their order", ExitCode.USAGE
        )
    return corners


def area_of(corners: FloatArray) -> float:
    """Return the area within corners (n, 2), by Gauss."""
    x, y = (corners - corners.mean(axis=0)).T
    return float(0.5 * abs(x @ np.roll(y, -1) - y @ np.roll(x, -1)))


def _crosses_itself(corners: FloatArray) -> bool:
    """Return whether two edges of corners (n, 2) cross that have no corner in common."""
    start, end = corners, np.roll(corners, -1, axis=0)

    def side(a: FloatArray, b: FloatArray, c: FloatArray) -> FloatArray:
        across: FloatArray = np.sign(
            (b[..., 0] - a[..., 0]) * (c[..., 1] - a[..., 1]) - (b[..., 1] - a[..., 1]) * (c[..., 0] - a[..., 0])
        )
        return across

    a, b, c, d = start[:, np.newaxis], end[:, np.newaxis], start[np.newaxis], end[np.newaxis]
    crossed = (side(a, b, c) * side(a, b, d) < 0.0) & (side(c, d, a) * side(c, d, b) < 0.0)
    return bool(crossed.any())


def volume(paths: Sequence[Path], corners: FloatArray, base_m: float) -> dict[str, Any]:
    """Return the volume above a base within a polygon, in m³, with its sigma; below the base it counts negative.

    Args:
        paths: files of one run.
        corners: (n, 2) of the polygon, in the points' CRS and units.
        base_m: height of the base, in the points' unit of heights.

    Raises:
        UserError: there are too few points, or they have no model; one line.
    """
    model = of_files(paths)
    found = [within(path, model, corners) for path in paths]
    count = sum(len(one.row) for one in found)
    if count < LEAST_POINTS:
        raise UserError(f"{count} points lie in the polygon; a volume needs {LEAST_POINTS}")
    outline_m = corners * model.unit_m[:2]
    cells = _cells(found, outline_m)
    above = cells.height_m - base_m * float(model.unit_m[2])
    shared, noise = _variances(model, cells)
    covered = float(cells.area_m2.sum())
    return {
        "volume_m3": float(cells.area_m2 @ above),
        "sigma_m3": float(np.sqrt(shared + noise)),
        "sigma_of_noise_m3": float(np.sqrt(noise)),
        "mean_height_m": float(cells.area_m2 @ above) / covered,
        "sigma_of_mean_height_m": float(np.sqrt(shared + noise)) / covered,
        "area_m2": area_of(outline_m),
        "covered_m2": covered,
        "points": count,
        "cell_m": cells.side_m,
        "strips": sorted({int(strip) for one in found for strip in np.unique(one.strip)}),
    }


def volume_lines(answer: dict[str, Any]) -> Iterator[str]:
    """Yield the lines of `volume`."""
    yield f"volume: {answer['volume_m3']:,.1f} m³ ± {answer['sigma_m3']:,.1f} m³ (one sigma)"
    yield (
        f"mean height above the base: {answer['mean_height_m']:.3f} m ± "
        f"{100.0 * answer['sigma_of_mean_height_m']:.2f} cm; of the noise of single returns "
        f"{100.0 * answer['sigma_of_noise_m3'] / answer['covered_m2']:.2f} cm"
    )
    strips = ", ".join(map(str, answer["strips"]))
    yield f"{answer['points']:,} points of strips {strips} in cells of {answer['cell_m']:.2f} m"
    missing = answer["area_m2"] - answer["covered_m2"]
    if missing > 0.01 * answer["area_m2"]:
        yield (
            f"{missing:,.1f} of {answer['area_m2']:,.1f} m² have no points, and are not in the volume; fill them from "
            "another survey, or take a smaller polygon"
        )


def _cells(found: Sequence[Found], outline_m: FloatArray) -> _Cells:
    points, times = np.concatenate([one.points_m for one in found]), np.concatenate([one.time_ns for one in found])
    units = np.concatenate([one.unit for one in found])
    side = float(np.sqrt(area_of(outline_m) / min(MOST_CELLS, max(1.0, len(points) / POINTS_A_CELL))))
    (west, south), (east, north) = outline_m.min(axis=0), outline_m.max(axis=0)
    columns, rows = int((east - west) // side) + 1, int((north - south) // side) + 1
    column, row = ((points[:, axis] - start) // side for axis, start in ((0, west), (1, south)))
    place = (np.clip(row, 0, rows - 1) * columns + np.clip(column, 0, columns - 1)).astype(np.int64)
    there, cell_of = np.unique(place, return_inverse=True)
    in_cell = np.bincount(cell_of)
    height = np.bincount(cell_of, points[:, 2]) / in_cell
    pieces, piece_of = np.unique(cell_of * (units.max() + 1) + units, return_inverse=True)
    count = np.bincount(piece_of)
    order = np.argsort(piece_of, kind="stable")
    middle = order[np.cumsum(count) - count + count // 2]
    cell = pieces // (units.max() + 1)
    grid = np.full(rows * columns, np.nan)
    grid[there] = height
    fine = (np.arange(FINE) + 0.5) * side / FINE
    corner = np.stack([west + side * (there % columns), south + side * (there // columns)], axis=1)
    parts = corner[:, np.newaxis, np.newaxis] + np.stack(np.meshgrid(fine, fine), axis=-1)
    inside = Outline(outline_m).contains_points(parts.reshape(-1, 2)).reshape(len(there), -1)
    return _Cells(
        side,
        cell,
        count / in_cell[cell],
        count,
        points[middle],
        times[middle],
        units[middle],
        height,
        _slopes(grid.reshape(rows, columns), side).reshape(-1, 2)[there],
        inside.mean(axis=1) * side**2,
    )


def _slopes(grid: FloatArray, side_m: float) -> FloatArray:
    """Return slopes (r, c, 2) to east and north of a grid from neighbours; beside a hole from the cell itself."""
    slopes = np.zeros((*grid.shape, 2))
    for axis, into in ((1, 0), (0, 1)):
        padded = np.pad(grid, [(1, 1) if one == axis else (0, 0) for one in (0, 1)], constant_values=np.nan)
        before = np.take(padded, range(grid.shape[axis]), axis=axis)
        after = np.take(padded, range(2, grid.shape[axis] + 2), axis=axis)
        low, high = np.where(np.isnan(before), grid, before), np.where(np.isnan(after), grid, after)
        steps = 2.0 - np.isnan(before) - np.isnan(after)
        slopes[:, :, into] = np.where(steps > 0.0, (high - low) / (np.maximum(steps, 1.0) * side_m), 0.0)
    return slopes


def _variances(model: ModelFile, cells: _Cells) -> tuple[float, float]:
    """Return the variance of the volume by the errors that points share, and by the noise of single returns, m⁶."""
    effect = np.concatenate([-cells.slope, np.ones((len(cells.slope), 1))], axis=1)[cells.cell]
    effect = effect * (cells.area_m2[cells.cell] * cells.share)[:, np.newaxis]
    shared, number = 0.0, len(cells.cell)
    alone = model.model.covariance(cells.middle_m, cells.time_ns, cells.unit)
    noise = 0.0
    for i in range(number):
        own = np.full(number, i)
        crossed = model.model.cross_covariance(
            cells.middle_m[own], cells.time_ns[own], cells.unit[own], cells.middle_m, cells.time_ns, cells.unit
        )
        shared += float(np.einsum("a,pab,pb->", effect[i], crossed, effect))
        noise += float(effect[i] @ (alone[i] - crossed[i]) @ effect[i]) / int(cells.count[i])
    return max(shared, 0.0), max(noise, 0.0)


def _geojson(content: Any) -> FloatArray:
    if content.get("type") == "FeatureCollection":
        content = content["features"][0]
    if content.get("type") == "Feature":
        content = content["geometry"]
    if content.get("type") != "Polygon":
        raise ValueError(f"its type is {content.get('type')}")
    return np.array(content["coordinates"][0], np.float64)[:, :2]


def _table(text: str) -> FloatArray:
    rows = [row for row in csv.reader(text.splitlines()) if row]
    if rows and not _is_number(rows[0][0]):
        rows = rows[1:]
    return np.array([[float(row[0]), float(row[1])] for row in rows], np.float64).reshape(-1, 2)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
