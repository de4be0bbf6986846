"""Reads points that an error model describes: the nearest to a place, or rows of a file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.path import Path as Outline

from swath.daemon.errors import UserError
from swath.daemon.processing.error_model.file import ENDING, RECORD, ModelFile, model_of_text, read_model
from swath.daemon.processing.quicklook.point_files import UNREADABLE, PointReader, Points, Selection, open_points
from swath.georef.arrays import FloatArray, Int64Array
from swath.georef.error_model.model import ErrorModelError
from swath.georef.formats.las import ADJUSTED_GPS_EPOCH_S
from swath.georef.timescales import SECOND_NS

BLOCK = 500_000
FIELDS = Selection.XY_RETURNS_CHANNEL | Selection.Z | Selection.GPS_TIME | Selection.POINT_SOURCE_ID


@dataclass(frozen=True, eq=False)
class Found:
    """Points of a model.

    Attributes:
        path: of their file.
        xyz: (n, 3) as in the file, in its units.
        points_m: (n, 3) in metres, as the model wants them; time_ns: (n,) GPS times; unit: (n,) numbers of units.
        strip: (n,) numbers of strips.
        row: (n,) rows of the file, from 0.
    """

    path: Path
    xyz: FloatArray
    points_m: FloatArray
    time_ns: Int64Array
    unit: Int64Array
    strip: Int64Array
    row: Int64Array


def model_of(path: Path) -> ModelFile:
    """Read the error model of a file of points: the one in it, else the one of its run in the same folder.

    Raises:
        UserError: there is none, or several and none has the file's name; one line.
    """
    if not path.is_file():
        raise UserError(f"{path}: no such file")
    try:
        with open_points(path) as reader:
            for record in reader.evlrs or ():
                if (record.user_id, record.record_id) == RECORD:
                    return model_of_text(record.record_data_bytes().decode("utf-8", "replace"), path)
    except UNREADABLE as error:
        raise UserError(f"{path}: cannot be read as a LAS or LAZ file ({error})") from error
    models = sorted(path.parent.glob(f"*{ENDING}"))
    own = [one for one in models if path.name.startswith(one.name.removesuffix(ENDING))]
    if len(own) != 1 and len(models) != 1:
        raise UserError(
            f"{path}: has no error model in it, nor NAME{ENDING} beside it; swath georef --error-model writes both"
        )
    return read_model(own[0] if len(own) == 1 else models[0])


def nearest(path: Path, file: ModelFile, place: tuple[float, float]) -> Found:
    """Return the point of each strip in a file that is nearest to a place (easting, northing), nearest first.

    Raises:
        UserError: the file cannot be read, or the model does not describe it; one line.
    """
    best: dict[int, tuple[float, int, FloatArray, float, int]] = {}
    at = 0
    with _opened(path) as reader:
        while len(points := _read(path, reader)):
            apart = np.hypot((points.x - place[0]) * file.unit_m[0], (points.y - place[1]) * file.unit_m[1])
            strips = np.asarray(points.point_source_id)
            for strip in np.unique(strips).tolist():
                of = np.flatnonzero(strips == strip)
                k = int(of[np.argmin(apart[of])])
                if strip not in best or apart[k] < best[strip][0]:
                    xyz = np.array([points.x[k], points.y[k], points.z[k]])
                    channel = int(points.scanner_channel[k])
                    best[strip] = (float(apart[k]), at + k, xyz, float(points.gps_time[k]), channel)
            at += len(points)
    chosen = sorted(best.items(), key=lambda item: item[1][0])
    return _found(
        path,
        file,
        np.array([one[2] for _, one in chosen]).reshape(-1, 3),
        np.array([one[3] for _, one in chosen]),
        np.array([strip for strip, _ in chosen], np.int64),
        np.array([one[4] for _, one in chosen], np.int64),
        np.array([one[1] for _, one in chosen], np.int64),
    )


def rows_of(path: Path, file: ModelFile, rows: Int64Array) -> Found:
    """Return rows of a file, in the order asked for.

    Raises:
        UserError: the file cannot be read or has fewer points, or the model does not describe it; one line.
    """
    wanted, back = np.unique(rows, return_inverse=True)
    pieces: list[tuple[FloatArray, FloatArray, Int64Array, Int64Array]] = []
    at = 0
    if len(wanted) and wanted[0] < 0:
        raise UserError(f"{path}: has no row {wanted[0]}; rows count from 0")
    with _opened(path) as reader:
        while len(points := _read(path, reader)):
            here = wanted[(wanted >= at) & (wanted < at + len(points))] - at
            some = points[here]
            xyz = np.stack([np.asarray(some.x), np.asarray(some.y), np.asarray(some.z)], axis=1)
            sources = np.asarray(some.point_source_id).astype(np.int64)
            pieces.append((xyz, np.asarray(some.gps_time), sources, np.asarray(some.scanner_channel).astype(np.int64)))
            at += len(points)
    if len(wanted) and wanted[-1] >= at:
        raise UserError(f"{path}: has no row {wanted[-1]}; its {at:,} points have the rows 0 to {at - 1:,}")
    xyz, seconds, strips, channels = (np.concatenate(column)[back] for column in zip(*pieces, strict=True))
    return _found(path, file, xyz, seconds, strips, channels, rows)


def within(path: Path, file: ModelFile, corners: FloatArray) -> Found:
    """Return the points of a file in a polygon, corners (n, 2) in its CRS.

    Raises:
        UserError: the file cannot be read, or the model does not describe it; one line.
    """
    kept: list[list[Any]] = []
    at = 0
    outline, middle = Outline(corners - corners.mean(axis=0)), corners.mean(axis=0)
    with _opened(path) as reader:
        while len(points := _read(path, reader)):
            places = np.stack([np.asarray(points.x), np.asarray(points.y)], axis=1)
            inside = outline.contains_points(places - middle)
            rows = np.flatnonzero(inside)
            some = points[rows]
            xyz = np.stack([np.asarray(some.x), np.asarray(some.y), np.asarray(some.z)], axis=1)
            integers = [np.asarray(one).astype(np.int64) for one in (some.point_source_id, some.scanner_channel)]
            kept.append([xyz, np.asarray(some.gps_time), *integers, rows + at])
            at += len(points)
    if not kept:
        kept.append([np.zeros((0, 3)), np.zeros(0), *(np.zeros(0, np.int64) for _ in range(3))])
    xyz, seconds, strips, channels, rows = (np.concatenate(column) for column in zip(*kept, strict=True))
    return _found(path, file, xyz, seconds, strips, channels, rows)


def _opened(path: Path) -> PointReader:
    try:
        with open_points(path) as reader:
            header = reader.header
        if int(header.point_format.id) < 6 or header.global_encoding.gps_time_type.value != 1:
            raise UserError(
                f"{path}: was not written by swath georef: its points have no GPS time of the adjusted kind"
            )
        return PointReader(path, FIELDS)
    except UNREADABLE as error:
        raise UserError(f"{path}: cannot be read as a LAS or LAZ file ({error})") from error


def _read(path: Path, reader: PointReader) -> Points:
    try:
        return reader.read(BLOCK)
    except UNREADABLE as error:
        raise UserError(f"{path}: its points cannot be read ({error})") from error


def _found(
    path: Path,
    file: ModelFile,
    xyz: FloatArray,
    gps_time: FloatArray,
    strips: Int64Array,
    channels: Int64Array,
    rows: Int64Array,
) -> Found:
    try:
        units = file.units_of(strips, channels)
    except ErrorModelError as error:
        raise UserError(f"{path}: {error}; give the files of the run that wrote the model") from error
    time_ns = _gps_ns(gps_time)
    for number in np.unique(units).tolist():
        unit, times = file.model.units[number], time_ns[units == number]
        if times.min() < unit.start_ns - SECOND_NS or times.max() > unit.end_ns + SECOND_NS:
            raise UserError(
                f"{path}: has points of strip {unit.strip} at other times than its error model; give the files of the "
                "run that wrote the model"
            )
    return Found(path, xyz, xyz * file.unit_m, time_ns, units, strips, rows)


def _gps_ns(gps_time: FloatArray) -> Int64Array:
    """Return adjusted GPS times in seconds as GPS time in nanoseconds."""
    whole = np.floor(gps_time)
    return (whole.astype(np.int64) + ADJUSTED_GPS_EPOCH_S) * SECOND_NS + np.rint((gps_time - whole) * SECOND_NS).astype(
        np.int64
    )


def of_files(paths: Sequence[Path]) -> ModelFile:
    """Read the one error model of files of points.

    Raises:
        UserError: files have different models; one line.
    """
    first = model_of(paths[0])
    for path in paths[1:]:
        if path.parent.resolve() != paths[0].parent.resolve() and model_of(path).session != first.session:
            raise UserError(
                f"{path}: has another error model than {paths[0]}; errors of different runs have no common model"
            )
    return first
