"""Paints the operator's map while the aircraft flies, and writes its changed tiles once a second of the log's time."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from swath.daemon.png import png
from swath.daemon.processing.live.files import replace_file
from swath.daemon.processing.live.frame import LocalFrame
from swath.daemon.processing.live.grid import CellGrid
from swath.daemon.processing.live.strips import StripComparison, StripCutter
from swath.daemon.processing.live.tiles import FILE_BYTES, INDEX, TILES, Head, Place, TileFolder
from swath.georef.arrays import ByteArray
from swath.georef.points import Points
from swath.georef.timescales.gps_time import SECOND_NS
from swath.georef.trajectory.trajectory import Trajectory

HERE, METRES = np.zeros(3), np.ones(3)  # origin and units of points that are in the frame ``local`` already
IMAGE_CELLS = 2048
COVERAGE, PICTURE = "coverage.json", "coverage.png"
# Points per square metre, and the colour from there on; empty cells are transparent.
COLOURS = ((0.0, 0x5A0F1E), (1.0, 0xB0282E), (2.0, 0xE8743B), (4.0, 0xF4C95D), (8.0, 0x86B66B), (16.0, 0x2F8C74),
            (32.0, 0x1F5F8B))  # fmt: skip


class LiveMap:
    """The map of one recording.

    Attributes:
        grid: its cells.
        cutter: finds its strips.
        comparison: compares the present strip with those before it.
        trouble: why tiles are missing in the folder, for people; empty: none are.
    """

    def __init__(
        self, folder: Path, cell_m: float, quota_bytes: int, gps_from_host: Callable[[int], int | None]
    ) -> None:
        """Begin an empty map.

        Args:
            folder: its tiles go to a folder below this one.
            cell_m: side of a cell.
            quota_bytes: size that all tiles may have.
            gps_from_host: gives GPS time of a host time; None: not known.
        """
        self.grid = CellGrid(cell_m)
        self.cutter = StripCutter(gps_from_host)
        self.comparison = StripComparison(cell_m)
        self.trouble = ""
        self._folder, self._quota_bytes = folder, quota_bytes
        self._tiles: TileFolder | None = None
        self._coarsened = 0
        self._saved_ns = self._compared_ns = 0

    @property
    def sequence(self) -> int:
        """The newest step of the tiles' index; 0: nothing has been written."""
        return 0 if self._tiles is None else self._tiles.sequence

    @property
    def file_bytes(self) -> int:
        """Size of the tiles written."""
        return 0 if self._tiles is None else self._tiles.size

    def take(self, points: Points, frame: LocalFrame) -> None:
        """Add points to the cells, and to the comparison of strips."""
        edges = self.cutter.edges()
        xyz, origin, unit_m = points.points_map, frame.origin, frame.unit_m
        if frame.is_level:
            xyz, origin, unit_m = frame.of_points(xyz), HERE, METRES
        self.grid.add(points, origin, unit_m, edges, xyz)
        self.comparison.take(points, xyz, origin, unit_m, edges, self.grid)

    def update(self, trajectory: Trajectory, log_time_ns: int) -> None:
        """Find strips in the trajectory so far, and compare the present one as far as it is complete."""
        self.cutter.update(trajectory, log_time_ns)
        while self.cutter.dropped:
            number = self.cutter.dropped.pop()
            self.grid.forget_strip(number)
            self.comparison.drop(number)
        if log_time_ns >= self._compared_ns + SECOND_NS and self.cutter.is_settled:
            self._compared_ns = log_time_ns
            self.comparison.update(int(trajectory.time_ns[-1]), self.grid)

    def end(self) -> None:
        """End the present strip, and compare the rest of it."""
        self.cutter.end()
        self.comparison.finish(self.grid)

    def strips(self) -> list[dict[str, int]]:
        """Return the strips so far in plain values; the last may be the present one."""
        present = [] if self.cutter.open is None or not self.cutter.is_settled else [self.cutter.open]
        return [strip.plain() for strip in [*self.cutter.strips, *present]]

    def is_due(self, log_time_ns: int) -> bool:
        """Return whether tiles have changed, and a second of log time has passed since they were written."""
        return log_time_ns >= self._saved_ns + SECOND_NS and self.grid.has_changed

    def save(self, log_time_ns: int, about: dict[str, Any]) -> None:
        """Write the tiles that have changed, and the index; ``about`` says what the coordinates refer to."""
        self._saved_ns = log_time_ns
        if self._tiles is None:
            self._tiles = TileFolder(self._folder)
        if self.grid.coarsened > self._coarsened:
            self._coarsened = self.grid.coarsened
            self._tiles.renew()
        self.trouble = ""
        try:
            self._tiles.write(
                self._within_quota(self._tiles), {"cell_m": self.grid.cell_m, "strips": self.strips(), **about}
            )
        except OSError as error:
            self.trouble = f"{TILES}/{INDEX}: {error.strerror or error}: the map's tiles are not written"

    def _within_quota(self, folder: TileFolder) -> Iterator[tuple[Place, Callable[[Head], bytearray]]]:
        """Yield the changed tiles, without new ones if there is no room for them."""
        for place, make in self.grid.take_changed():
            if folder.has(place) or folder.size + FILE_BYTES <= self._quota_bytes:
                yield place, make
            else:
                self.trouble = f"{TILES}: live_quota_mb is used up: parts of the map are not written"

    def save_coverage(self, about: dict[str, Any]) -> None:
        """Replace the coverage's picture and numbers, each at once; ``about`` is put beside the numbers.

        Raises:
            OSError: a file cannot be written.
        """
        counts, west_m, north_m, cell_m = self.grid.image(IMAGE_CELLS)
        numbers = self.grid.numbers() | about
        numbers["strips"] = self.strips()
        numbers["overlap"] = {
            "cell_m": self.comparison.side_m,
            **self.comparison.total.numbers(),
            "pairs": self.comparison.pairs,
        }
        numbers["picture"] = {
            "name": PICTURE,
            "west_m": west_m,
            "north_m": north_m,
            "cell_m": cell_m,
            "rows": counts.shape[0],
            "columns": counts.shape[1],
            "colours_from_points_per_m2": {f"#{colour:06x}": density for density, colour in COLOURS},
        }
        replace_file(self._folder / PICTURE, picture(counts, cell_m))
        replace_file(self._folder / COVERAGE, (json.dumps(numbers, indent=2) + "\n").encode())


def picture(counts: NDArray[Any], cell_m: float) -> bytes:
    """Return a PNG of cells (rows, columns), one pixel each, coloured by density;
    empty ones are clear.
    """
    index: ByteArray = np.zeros(counts.shape, dtype=np.uint8)
    for density, _ in COLOURS:
        index += counts >= max(1, math.ceil(density * cell_m**2))
    return png(index, [0, *(colour for _, colour in COLOURS)])
