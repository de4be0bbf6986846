"""Writes all points of a recording as one array, to compare two ways of making them."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import IO

import numpy as np

from swath.daemon.processing.live.products import Room
from swath.georef.points import Points

POINT_DTYPE = np.dtype(
    [
        ("time_ns", "<i8"),
        ("points_map", "<f8", (3,)),
        ("scan_angle_rad", "<f4"),
        ("range_m", "<f4"),
        ("intensity", "<f4"),
        ("channel", "<u2"),
        ("return_number", "u1"),
        ("number_of_returns", "u1"),
        ("mta_zone", "u1"),
        ("scanner", "u1"),
    ]
)


class PointsFile:
    """One ``.npy`` array of `POINT_DTYPE` with all points of all scanners, in the order of their arrival.

    ``scanner`` counts the names in alphabetical order. The length in the file's header is written at the end.

    Attributes:
        count: points in the file; ``left_out``: points that came after its end.
        trouble: why the file ends before the points do, for people; empty: it does not.
    """

    def __init__(self, path: Path, scanners: list[str], room: Room | None = None) -> None:
        """Create the file.

        Args:
            path: path of the file.
            scanners: names of the scanners.
            room: the file ends when the room is used up or a write fails; None: a failed write raises OSError.

        Raises:
            OSError: the file cannot be created.
        """
        self.count = self.left_out = 0
        self.trouble = ""
        self._path, self._room = path, room
        self._number = {name: number for number, name in enumerate(sorted(scanners))}
        self._file: IO[bytes] = path.open("wb")
        self._write_head()

    def _write_head(self) -> None:
        descr = np.lib.format.dtype_to_descr(POINT_DTYPE)
        text = repr({"descr": descr, "fortran_order": False, "shape": (self.count,)})
        self._file.seek(0)
        self._file.write(b"\x93NUMPY\x01\x00" + struct.pack("<H", 502) + text.ljust(501).encode() + b"\n")

    def add(self, name: str, points: Points) -> None:
        """Add points of a scanner."""
        if self.trouble:
            self.left_out += len(points)
            return
        rows = np.zeros(len(points), dtype=POINT_DTYPE)
        for column in POINT_DTYPE.names or ():
            rows[column] = self._number[name] if column == "scanner" else getattr(points, column)
        try:
            self._file.write(rows.tobytes())
        except OSError as error:
            if self._room is None:
                raise
            self.left_out += len(points)
            self._end(error.strerror or str(error))
            return
        self.count += len(rows)

    def look_for_room(self) -> None:
        """Check for free space and end the file if there is too little; call once a second."""
        if self.trouble or self._room is None:
            return
        try:
            if not self._room.look():
                self._end(f"free space is down to {self._room.least_bytes / 1e6:.0f} MB, twice the recorder's reserve")
        except OSError as error:
            self._end(error.strerror or str(error))

    def _end(self, why: str) -> None:
        self.trouble = f"{self._path.name} ends after {self.count:,} points: {why}"

    def close(self) -> None:
        """Write the number of points into the header and close the file.

        Raises:
            OSError: the file cannot be written; if a ``room`` was given, this is only noted as trouble.
        """
        try:
            with self._file:
                self._write_head()
        except OSError as error:
            if self._room is None:
                raise
            self._end(error.strerror or str(error))
