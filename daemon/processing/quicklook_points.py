"""Points of LAS, LAZ and COPC files from any place on."""

from __future__ import annotations

import struct
from pathlib import Path
from types import TracebackType
from typing import TypeAlias

import laspy
import lazrs
from laspy.errors import LaspyException

SKIPPED_POINTS = 200_000
Points: TypeAlias = laspy.ScaleAwarePointRecord
Selection: TypeAlias = laspy.DecompressionSelection
UNREADABLE = (LaspyException, lazrs.LazrsError, ValueError, KeyError, IndexError, EOFError, OSError, struct.error)


class PointReader:
    """Reads a file's points forward.

    Where chunks of LAZ vary in size, as in COPC, lazrs finds none but the first: from there on it gives points that are
    none, without a word. In such files what lies before is read and left.
    """

    def __init__(self, path: Path, selection: Selection) -> None:
        """Raises one of UNREADABLE."""
        self._reader = laspy.open(path, decompression_selection=selection)
        self._at = 0
        self._can_seek = not has_varying_chunks(self._reader.header)

    def __enter__(self) -> PointReader:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._reader.close()

    def go_to(self, number: int) -> None:
        """The next point to be read is this one, which has not been read yet."""
        if number != self._at and self._can_seek:
            self._reader.seek(number)
            self._at = number
        while self._at < number:
            if not len(self.read(min(SKIPPED_POINTS, number - self._at))):
                raise EOFError("the file ends too early")

    def read(self, count: int) -> Points:
        """So many points, or as many as there are."""
        points = self._reader.read_points(count)
        self._at += len(points)
        return points


def has_varying_chunks(header: laspy.LasHeader) -> bool:
    """Whether a LAZ file's chunks vary in size."""
    found = header.vlrs.get("LasZipVlr")
    return bool(found) and bool(lazrs.LazVlr(found[0].record_data).uses_variable_size_chunks())


def sample_of(path: Path, size: int) -> Points:
    """Places of some points that follow each other: from the middle, or the first ones where that cannot be found.

    Raises one of UNREADABLE.
    """
    with laspy.open(path) as reader:
        header = reader.header
    with PointReader(path, Selection.XY_RETURNS_CHANNEL) as points:
        if not has_varying_chunks(header):
            points.go_to((header.point_count - min(size, header.point_count)) // 2)
        return points.read(size)
