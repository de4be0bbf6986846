"""Reads points of LAS, LAZ and COPC files from any position on."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import BinaryIO, TypeAlias

import laspy
import lazrs
from laspy.errors import LaspyException

SKIPPED_POINTS = 200_000
Points: TypeAlias = laspy.ScaleAwarePointRecord
Selection: TypeAlias = laspy.DecompressionSelection
UNREADABLE = (
    *(LaspyException, lazrs.LazrsError, ValueError, KeyError, IndexError, EOFError, OSError, struct.error),
    *(TypeError, AttributeError, OverflowError, MemoryError),  # raised by laspy for records of a wrong kind
)
_HEADER_BYTES, _VLR_BYTES, _EVLR_BYTES = 375, 54, 60  # LAS 1.4-R15
_SIZES = struct.Struct("<HII")  # size of the header, offset of the points, number of records between
_EXTENDED = struct.Struct("<QI")  # where extended records begin, and their number
_SIZES_AT, _MINOR_AT, _EXTENDED_AT = 94, 25, 235
_POINT, _POINT_AT = struct.Struct("<BH"), 104  # format with the bit of LAZ, bytes per point
_COMPRESSED, _MOST_POINT_BYTES = 0x80, 2048
_VLR = struct.Struct("<2x16sHH32x")  # user, number and length of a record before the points
_LASZIP = (b"laszip encoded", 22204)
_CHUNK_POINTS, _CHUNK_POINTS_AT, _VARYING = struct.Struct("<I"), 12, 0xFFFF_FFFF  # in that record
_MOST_CHUNK_BYTES = 1 << 30  # of points as read; lazrs allocates a whole chunk. LASzip's own have 50,000 points


def open_points(path: Path, selection: Selection | None = None) -> laspy.LasReader:
    """Return a reader of a file, after checking that the file has room for the records that its header counts.

    Without the check laspy would read on for hours. Raises one of UNREADABLE.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(_HEADER_BYTES)
        _refuse_records(head, size)
        _refuse_chunks(file, head, size)
    with _panics_told():
        return laspy.open(path) if selection is None else laspy.open(path, decompression_selection=selection)


def _refuse_records(head: bytes, size: int) -> None:
    if len(head) >= _SIZES_AT + _SIZES.size:
        header_bytes, points_at, count = _SIZES.unpack_from(head, _SIZES_AT)
        if points_at > size or header_bytes + count * _VLR_BYTES > points_at:
            raise ValueError(f"{count} records before the points at byte {points_at} of {size}")
    if len(head) == _HEADER_BYTES and head[_MINOR_AT] >= 4:
        begin, count = _EXTENDED.unpack_from(head, _EXTENDED_AT)
        if count and begin + count * _EVLR_BYTES > size:
            raise ValueError(f"{count} records from byte {begin} of {size} on")


def _refuse_chunks(file: BinaryIO, head: bytes, size: int) -> None:
    """Refuse impossible sizes of points or chunks, or more chunks than bytes: lazrs would end the process."""
    if len(head) < _POINT_AT + _POINT.size:
        return
    kind, point_bytes = _POINT.unpack_from(head, _POINT_AT)
    if point_bytes > _MOST_POINT_BYTES:
        raise ValueError(f"points of {point_bytes} bytes")
    if not kind & _COMPRESSED:
        return
    (chunk_points,) = _CHUNK_POINTS.unpack(_laszip_record(file, head)[_CHUNK_POINTS_AT:][:4].ljust(4, b"\0"))
    if chunk_points != _VARYING and chunk_points * point_bytes > _MOST_CHUNK_BYTES:
        raise ValueError(f"chunks of {chunk_points} points")
    points_at = _SIZES.unpack_from(head, _SIZES_AT)[1]
    if points_at > size - 8:
        return
    file.seek(points_at)
    (table_at,) = struct.unpack("<q", file.read(8))
    if table_at == -1:  # written to a pipe: the offset is at the end
        file.seek(size - 8)
        (table_at,) = struct.unpack("<q", file.read(8))
    if not 0 <= table_at <= size - 8:
        return  # a truncated file, whose first points can be read
    file.seek(table_at)
    _, count = struct.unpack("<II", file.read(8))
    if count > size:
        raise ValueError(f"{count} chunks in {size} bytes")


def _laszip_record(file: BinaryIO, head: bytes) -> bytes:
    """Return the record on the compression of the points; empty if there is none."""
    at, _, count = _SIZES.unpack_from(head, _SIZES_AT)
    for _ in range(count):
        file.seek(at)
        user, number, length = _VLR.unpack(file.read(_VLR_BYTES).ljust(_VLR_BYTES, b"\0"))
        if (user.rstrip(b"\0"), number) == _LASZIP:
            return file.read(length)
        at += _VLR_BYTES + length
    return b""


@contextmanager
def _panics_told() -> Iterator[None]:
    """Turn a panic of lazrs, which is not an Exception, into a ValueError."""
    try:
        yield
    except BaseException as error:
        if type(error).__name__ == "PanicException":  # of pyo3, which does not export the class
            raise ValueError(f"lazrs: {error}") from error
        raise


class PointReader:
    """Reads a file's points forward.

    If chunks of LAZ vary in size, as in COPC, lazrs finds only the first: seeking beyond it silently gives wrong
    points. In such files the points before are read and discarded.
    """

    def __init__(self, path: Path, selection: Selection) -> None:
        """Open a file; raises one of UNREADABLE."""
        self._reader = open_points(path, selection)
        self._at = 0
        self._can_seek = not has_varying_chunks(self._reader.header)

    def __enter__(self) -> PointReader:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._reader.close()

    def go_to(self, number: int) -> None:
        """Go forward to a point that has not been read yet."""
        if number != self._at and self._can_seek:
            with _panics_told():
                self._reader.seek(number)
            self._at = number
        while self._at < number:
            if not len(self.read(min(SKIPPED_POINTS, number - self._at))):
                raise EOFError("the file ends too early")

    def read(self, count: int) -> Points:
        """Read the next ``count`` points, or as many as are left."""
        with _panics_told():
            points = self._reader.read_points(count)
        self._at += len(points)
        return points


def has_varying_chunks(header: laspy.LasHeader) -> bool:
    """Return True if a LAZ file's chunks vary in size."""
    found = header.vlrs.get("LasZipVlr")
    with _panics_told():
        return bool(found) and bool(lazrs.LazVlr(found[0].record_data).uses_variable_size_chunks())


def sample_of(path: Path, size: int) -> Points:
    """Return some consecutive points: from the middle, or the first ones if the middle cannot be found.

    Raises one of UNREADABLE.
    """
    with open_points(path) as reader:
        header = reader.header
    with PointReader(path, Selection.XY_RETURNS_CHANNEL) as points:
        if not has_varying_chunks(header):
            points.go_to((header.point_count - min(size, header.point_count)) // 2)
        return points.read(size)
