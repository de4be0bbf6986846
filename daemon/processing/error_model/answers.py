"""Answers of `swath accuracy`: how sure a point is, the difference of two, and pairs of a table."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from swath.daemon.errors import ExitCode, UserError
from swath.daemon.processing.error_model.file import ModelFile
from swath.daemon.processing.error_model.points import Found, model_of, nearest, of_files, rows_of
from swath.georef.arrays import FloatArray
from swath.georef.error_model.accuracy import ce90, ellipse, le90

REACH_M = 2.0  # within which a point stands for a place
PAIR_COLUMNS = ("file_1", "point_1", "file_2", "point_2")
ANSWER_COLUMNS = (
    *("sigma_easting", "sigma_northing", "sigma_height"),
    *("covariance_easting_northing", "covariance_easting_height", "covariance_northing_height"),
)
MOST_PAIRS = 50_000_000


def figures(covariance: FloatArray) -> dict[str, Any]:
    """Return the figures of a covariance (3, 3) of easting, northing and height, in m."""
    sigma = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    shape = ellipse(covariance[:2, :2])
    return {
        "sigma_m": sigma.tolist(),
        "covariance_m2": covariance.tolist(),
        "ce90_m": ce90(covariance[:2, :2]),
        "le90_m": le90(float(max(covariance[2, 2], 0.0))),
        "ellipse": {"major_m": shape.major_m, "minor_m": shape.minor_m, "azimuth_deg": shape.azimuth_deg},
    }


def at_place(paths: Sequence[Path], place: tuple[float, float]) -> list[dict[str, Any]]:
    """Return the figures of the point of each strip that is nearest to a place, if within `REACH_M`.

    Raises:
        UserError: no point is near enough, or a file cannot be used; one line.
    """
    return [
        {**_point(file, found, k), **figures(file.model.covariance(*_one(found, k))[0])}
        for file, found, k in _near(paths, place)
    ]


def between(paths: Sequence[Path], first: tuple[float, float], second: tuple[float, float]) -> dict[str, Any]:
    """Return the figures of the difference second − first of the points nearest to two places.

    Where one strip has points near both, its points are taken: they share most errors.

    Raises:
        UserError: no point is near enough, or a file cannot be used; one line.
    """
    of_files(paths)
    starts, ends = _near(paths, first), _near(paths, second)
    strips = {int(found.strip[k]) for _, found, k in ends}
    file, found, k = next((one for one in starts if int(one[1].strip[one[2]]) in strips), starts[0])
    strip = int(found.strip[k])
    _, other, j = next((one for one in ends if int(one[1].strip[one[2]]) == strip), ends[0])
    covariance = _difference(file, found, k, other, j)
    apart = other.points_m[j] - found.points_m[k]
    length = float(np.linalg.norm(apart))
    along = apart / length if length > 0.0 else np.array([0.0, 0.0, 1.0])
    return {
        "first": _point(file, found, k),
        "second": _point(file, other, j),
        "difference_m": apart.tolist(),
        "length_m": length,
        "sigma_of_length_m": float(np.sqrt(max(along @ covariance @ along, 0.0))),
        **figures(covariance),
    }


def answer_pairs(table: Path, output: Path) -> int:
    """Write a table of pairs again with sigmas and covariances of their differences; return the number of pairs.

    Raises:
        UserError: the table or a file of points cannot be used; one line.
        OSError: the answers cannot be written.
    """
    rows = _pairs(table)
    files = {name: _beside(table, name) for name in sorted({name for row in rows for name in (row[0], row[2])})}
    if not rows:
        raise UserError(f"{table}: has no pairs; want rows of {', '.join(PAIR_COLUMNS)}")
    model = of_files(list(files.values()))
    points: dict[str, Found] = {}
    for name, path in files.items():
        asked = [number for row in rows for file, number in (row[:2], row[2:]) if file == name]
        wanted = np.unique(np.array(asked, np.int64))
        points[name] = rows_of(path, model, wanted)
    sides = [_side(rows, at, points) for at in (0, 2)]
    covariance = model.model.difference(*sides[0], *sides[1])
    same = [row[:2] == row[2:] for row in rows]
    covariance[same] = 0.0
    with output.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow((*PAIR_COLUMNS, *ANSWER_COLUMNS))
        for row, one in zip(rows, covariance, strict=True):
            sigma = np.sqrt(np.maximum(np.diag(one), 0.0))
            writer.writerow(
                (*row, *(f"{v:.6f}" for v in sigma), *(f"{v:.6e}" for v in (one[0, 1], one[0, 2], one[1, 2])))
            )
    return len(rows)


def point_lines(answers: Sequence[dict[str, Any]]) -> Iterator[str]:
    """Yield the lines of `at_place`."""
    for answer in answers:
        yield f"strip {answer['strip']}, point {answer['row']:,} of {answer['file']}: {_place(answer)}"
        yield f"  {_figures_line(answer)}"


def difference_lines(answer: dict[str, Any]) -> Iterator[str]:
    """Yield the lines of `between`."""
    for which in ("first", "second"):
        yield f"{which}: strip {answer[which]['strip']}, {_place(answer[which])}"
    east, north, up = answer["difference_m"]
    yield f"difference: easting {east:.3f} m, northing {north:.3f} m, height {up:.3f} m"
    yield f"  {_figures_line(answer)}"
    yield f"length: {answer['length_m']:.3f} m ± {answer['sigma_of_length_m']:.3f} m (one sigma)"


def _place(point: dict[str, Any]) -> str:
    east, north, up = point["xyz"]
    return f"{east:.3f}, {north:.3f}, {up:.3f}"


def _figures_line(answer: dict[str, Any]) -> str:
    east, north, up = (100.0 * value for value in answer["sigma_m"])
    shape = answer["ellipse"]
    sigma = f"sigma: easting {east:.2f} cm, northing {north:.2f} cm, height {up:.2f} cm"
    axes = f"{100.0 * shape['major_m']:.2f} by {100.0 * shape['minor_m']:.2f} cm, {round(shape['azimuth_deg']) % 180}°"
    return f"{sigma}; CE90 {100.0 * answer['ce90_m']:.2f} cm, LE90 {100.0 * answer['le90_m']:.2f} cm; ellipse {axes}"


def _near(paths: Sequence[Path], place: tuple[float, float]) -> list[tuple[ModelFile, Found, int]]:
    """Return the nearest point of each strip within reach of a place, nearest first."""
    found: list[tuple[float, ModelFile, Found, int]] = []
    closest = np.inf
    for path in paths:
        file = model_of(path)
        points = nearest(path, file, place)
        apart = np.hypot(*((points.xyz[:, :2] - place) * file.unit_m[:2]).T)
        closest = min([closest, *apart.tolist()])
        found += [(float(apart[k]), file, points, k) for k in np.flatnonzero(apart <= REACH_M).tolist()]
    if not found:
        raise UserError(
            f"no point lies within {REACH_M:g} m of {place[0]:.3f}, {place[1]:.3f}; the nearest is {closest:.1f} m away"
        )
    return [one[1:] for one in sorted(found, key=lambda one: one[0])]


def _point(file: ModelFile, found: Found, k: int) -> dict[str, Any]:
    scanner = file.model.units[int(found.unit[k])].scanner
    return {
        "file": found.path.name,
        "row": int(found.row[k]),
        "strip": int(found.strip[k]),
        "scanner": scanner,
        "xyz": found.xyz[k].tolist(),
    }


def _one(found: Found, k: int) -> tuple[FloatArray, Any, Any]:
    return found.points_m[k : k + 1], found.time_ns[k : k + 1], found.unit[k : k + 1]


def _difference(file: ModelFile, found: Found, k: int, other: Found, j: int) -> FloatArray:
    if (found.path, found.row[k]) == (other.path, other.row[j]):
        return np.zeros((3, 3))
    covariance: FloatArray = file.model.difference(*_one(found, k), *_one(other, j))[0]
    return covariance


def _pairs(table: Path) -> list[tuple[str, int, str, int]]:
    try:
        with table.open(encoding="utf-8-sig", newline="") as file:
            reader = csv.DictReader(file)
            missing = [name for name in PAIR_COLUMNS if name not in (reader.fieldnames or ())]
            if missing:
                raise UserError(
                    f"{table}: has no column {', '.join(missing)}; want {','.join(PAIR_COLUMNS)}", ExitCode.USAGE
                )
            rows = []
            for number, row in enumerate(reader, 2):
                try:
                    rows.append((row["file_1"], int(row["point_1"]), row["file_2"], int(row["point_2"])))
                except (TypeError, ValueError) as error:
                    raise UserError(
                        f"{table}: line {number}: want a file's name and the whole number of its row, twice",
                        ExitCode.USAGE,
                    ) from error
                if len(rows) > MOST_PAIRS:
                    raise UserError(f"{table}: has more than {MOST_PAIRS:,} pairs; split it", ExitCode.USAGE)
    except OSError as error:
        raise UserError(f"{table}: {error.strerror}", ExitCode.USAGE) from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise UserError(f"{table}: is no CSV: {error}", ExitCode.USAGE) from error
    return rows


def _beside(table: Path, name: str) -> Path:
    """Return a file named in a table: as it is said, else beside the table."""
    path = Path(name)
    return path if path.is_absolute() or path.exists() else table.parent / path


def _side(rows: Sequence[tuple[str, int, str, int]], at: int, points: dict[str, Found]) -> tuple[FloatArray, Any, Any]:
    starts, begin = {}, 0
    for name, found in points.items():
        starts[name] = begin
        begin += len(found.row)
    places = np.concatenate([found.points_m for found in points.values()])
    times = np.concatenate([found.time_ns for found in points.values()])
    units = np.concatenate([found.unit for found in points.values()])
    names = np.array([row[at] for row in rows])
    numbers = np.array([row[at + 1] for row in rows], np.int64)
    index = np.empty(len(rows), np.int64)
    for name, found in points.items():
        of = names == name
        index[of] = starts[name] + np.searchsorted(found.row, numbers[of])
    return places[index], times[index], units[index]
