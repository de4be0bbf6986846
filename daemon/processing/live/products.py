"""Writes what the operator sees during the flight: thinned points, the aircraft's position, and the coverage.

Counts and grids use every point; only live.mcap is thinned. Nothing here affects the points themselves.
"""

from __future__ import annotations

import json
import math
import os
import struct
import zlib
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from swath.daemon.config.tables import LiveConfig
from swath.daemon.processing.live.frame import LocalFrame, Maps
from swath.daemon.processing.live.grid import CountGrid
from swath.daemon.processing.live.mcap import NAME, LiveMcap, LivePose
from swath.georef.arrays import ByteArray, Int64Array
from swath.georef.compiled import jit_cached
from swath.georef.geodesy.earth import geodetic_from_e
from swath.georef.points import Points
from swath.georef.timescales.gps_time import SECOND_NS, unix_from_gps
from swath.georef.trajectory.trajectory import Trajectory

POSE_NS = 100_000_000  # between two poses
ROOM_AGAIN = 1.05  # free space, relative to where writing stopped, at which it begins again
IMAGE_CELLS = 2048
COVERAGE, PICTURE = "coverage.json", "coverage.png"
FIRST_STRIDE = 16  # of the thinning, until the points of one second have been counted
# Points per square metre, and the colour from there on; empty cells are transparent.
_COLOURS = ((0.0, 0x5A0F1E), (1.0, 0xB0282E), (2.0, 0xE8743B), (4.0, 0xF4C95D), (8.0, 0x86B66B), (16.0, 0x2F8C74),
            (32.0, 0x1F5F8B))  # fmt: skip


class Thinning:
    """Selects points for display: at most so many per second of GPS time, spread over it.

    The stride follows from the number of points in the second before; it depends on points and their order, not on
    blocks.
    """

    def __init__(self, points_per_s: int) -> None:
        self._limit = points_per_s
        self._state = np.array([np.iinfo(np.int64).min, 0, 0, FIRST_STRIDE, 0], dtype=np.int64)

    def keep(self, time_ns: Int64Array) -> Int64Array:
        """Return the indexes (k,) of the points to keep; points come in the order of their arrival."""
        kept_ones = np.empty(len(time_ns), dtype=np.int64)
        return kept_ones[: _thin(time_ns, self._limit, self._state, kept_ones)]


@jit_cached
def _thin(time_ns: Any, limit: int, state: Any, keep: Any) -> int:
    """Fill ``keep`` with the indexes of points to keep and return their number.

    state: first nanosecond after the second, points in it, those of them kept, stride, points until the next is kept.
    """
    count = 0
    end, points, shown, stride, until = state[0], state[1], state[2], state[3], state[4]
    for i in range(len(time_ns)):
        if time_ns[i] >= end:
            if points > 0:
                stride = max(1, -(-points // limit))
            end, points, shown, until = (time_ns[i] // SECOND_NS + 1) * SECOND_NS, 0, 0, 0
        if until == 0:
            until = stride
            if shown < limit:
                keep[count] = i
                count += 1
                shown += 1
        until -= 1
        points += 1
    state[0], state[1], state[2], state[3], state[4] = end, points, shown, stride, until
    return count


@dataclass(slots=True)
class Room:
    """Checks free space on the disk: writing stops below twice the recorder's reserve, and begins again above it."""

    folder: Path
    least_bytes: int
    free_bytes: int = 0
    is_enough: bool = True

    def look(self) -> bool:
        """Measure the free space and return True if it suffices."""
        disk = os.statvfs(self.folder)
        self.free_bytes = disk.f_bavail * disk.f_frsize
        wanted = self.least_bytes * (1.0 if self.is_enough else ROOM_AGAIN)
        self.is_enough = self.free_bytes > wanted
        return self.is_enough


class LiveProducts:
    """Takes points as they come, and writes the operator's files.

    Attributes:
        points: number of points by scanner; ``shown``: written to live.mcap; ``unwritten``: thinned but not written.
        trouble: why no files are written, for people; empty: they are.
    """

    def __init__(self, folder: Path, live: LiveConfig, mapping: Maps | None, reserve_bytes: int, about: str) -> None:
        """Prepare the folder; ``about`` describes the mapping frame for people.

        Raises:
            OSError: the folder cannot be written to.
        """
        folder.mkdir(parents=True, exist_ok=True)
        self.points: Counter[str] = Counter()
        self.shown = self.unwritten = 0
        self.trouble = ""
        self.room = Room(folder, 2 * reserve_bytes)
        self.frame: LocalFrame | None = None
        self.grid = CountGrid(live.cell_m)
        self._folder, self._live, self._mapping, self._about = folder, live, mapping, about
        self._thinning = Thinning(live.points_per_s)
        self._mcap: LiveMcap | None = None
        self._pose_ns = 0

    def begin(self, trajectory: Trajectory | None) -> None:
        """Lay the local frame at the first known position; later calls change nothing.

        The trajectory sets it, not the points: these must not wait for PROJ, which is slow at its first use.
        """
        if self.frame is None and trajectory is not None and len(trajectory):
            self.frame = LocalFrame(trajectory.position_e[-1], self._mapping)

    def take(self, name: str, points: Points, trajectory: Trajectory | None, log_time_ns: int) -> None:
        """Take points of a scanner, in order, with the trajectory known by then."""
        self.points[name] += len(points)
        self.begin(trajectory)
        if self.frame is None:
            return
        if self.frame.is_level:
            self.grid.add(self.frame.of_points(points.points_map))
        else:
            east, north, _ = self.frame.origin.tolist()
            self.grid.add(points.points_map, east, north, float(self.frame.unit_m[0]))
        keep = self._thinning.keep(points.time_ns)
        count = len(keep)
        if count:
            cloud = self.frame.cloud_of(points, keep)
            time_ns = unix_from_gps(int(points.time_ns[keep[0]]))
            written = self._write(lambda mcap: mcap.add_cloud(f"/points/{name}", cloud, time_ns, log_time_ns))
            self.shown += count * written
            self.unwritten += count * (not written)

    def take_pose(self, trajectory: Trajectory | None, log_time_ns: int) -> None:
        """Write the newest pose, at most ten times a second of log time; the first one lays the frame."""
        if trajectory is None or log_time_ns < self._pose_ns + POSE_NS:
            return
        self.begin(trajectory)
        if self.frame is None:
            return
        self._pose_ns = log_time_ns
        position_e = trajectory.position_e[-1]
        position, q_local_from_b = self.frame.pose_of(position_e, trajectory.q_e_from_b[-1])
        lat, lon, height = geodetic_from_e(position_e)
        pose = LivePose(
            unix_from_gps(int(trajectory.time_ns[-1])),
            math.degrees(lat),
            math.degrees(lon),
            float(height),
            position,
            q_local_from_b,
            trajectory.position_sigma_l[-1],
        )
        self._write(lambda mcap: mcap.add_pose(pose, log_time_ns))

    def look_for_room(self) -> None:
        """Check for free space and stop or resume writing; call once a second."""
        try:
            is_enough = self.room.look()
        except OSError as error:
            self.trouble = f"{self._folder}: {error.strerror or error}: nothing is written any more"
            return
        if is_enough:
            if self.trouble.startswith("free space"):
                self.trouble = ""
            return
        least_mb = self.room.least_bytes / 1e6
        self.trouble = f"free space is down to {least_mb:.0f} MB, twice the recorder's reserve; writing is suspended"

    def _write(self, add: Any) -> bool:
        """Write to live.mcap, if there is a frame and room for it; return True if written."""
        if self.trouble or self.frame is None:
            return False
        try:
            if self._mcap is None:
                quota_bytes = int(self._live.live_quota_mb * 1e6)
                metadata = {key: json.dumps(value) for key, value in self.origin().items()}
                self._mcap = LiveMcap(self._folder, quota_bytes, metadata)
            written = bool(add(self._mcap))
        except OSError as error:
            self.trouble = f"{NAME}: {error.strerror or error}: nothing is written any more"
            return False
        if self._mcap.is_full:
            self.trouble = (
                f"{NAME} has reached live_quota_mb = {self._live.live_quota_mb:g}; no more data is added to it"
            )
        return written

    def origin(self) -> dict[str, Any]:
        """Return what the coordinates of the products refer to."""
        entry: dict[str, Any] = {"crs": self._about, "axes": "east, north, up, metres"}
        if self.frame is not None:
            entry["origin"] = [round(value, 4) for value in self.frame.origin.tolist()]
            entry["origin_unit_m"] = self.frame.unit_m.tolist()
        return entry

    def save_coverage(self, latest: dict[str, Any]) -> None:
        """Replace the coverage grid's numbers and picture, each at once; do nothing if there is no room."""
        if self.trouble.startswith("free space") or not self.grid.points:
            return
        counts, west_m, north_m, cell_m = self.grid.image(IMAGE_CELLS)
        numbers = self.grid.numbers() | self.origin() | latest
        numbers["picture"] = {
            "name": PICTURE,
            "west_m": west_m,
            "north_m": north_m,
            "cell_m": cell_m,
            "rows": counts.shape[0],
            "columns": counts.shape[1],
            "colours_from_points_per_m2": {f"#{colour:06x}": density for density, colour in _COLOURS},
        }
        try:
            replace_file(self._folder / PICTURE, picture(counts, cell_m))
            replace_file(self._folder / COVERAGE, (json.dumps(numbers, indent=2) + "\n").encode())
        except OSError as error:
            self.trouble = f"{COVERAGE}: {error.strerror or error}: nothing is written any more"

    def close(self) -> None:
        """Finish and close live.mcap."""
        mcap, self._mcap = self._mcap, None
        if mcap is not None:
            try:
                mcap.close()
            except OSError as error:
                self.trouble = f"{NAME}: {error.strerror or error}: the file has no index"


def replace_file(path: Path, data: bytes) -> None:
    """Replace a file's content at once: a reader sees the old or the new one, never a part."""
    new = path.with_name(path.name + ".new")
    new.write_bytes(data)
    new.replace(path)


def picture(counts: NDArray[Any], cell_m: float) -> bytes:
    """Return a PNG (ISO/IEC 15948) of cells (rows, columns), one pixel each, coloured by density;
    empty ones are clear.
    """
    index: ByteArray = np.zeros(counts.shape, dtype=np.uint8)
    for density, _ in _COLOURS:
        index += counts >= max(1, math.ceil(density * cell_m**2))
    rows, columns = index.shape
    lines = np.zeros((rows, columns + 1), dtype=np.uint8)  # each line begins with the number of its filter: 0
    lines[:, 1:] = index
    palette = b"".join(colour.to_bytes(3, "big") for colour in (0, *(colour for _, colour in _COLOURS)))
    head = struct.pack(">IIBBBBB", columns, rows, 8, 3, 0, 0, 0)
    pieces = {b"IHDR": head, b"PLTE": palette, b"tRNS": b"\0", b"IDAT": zlib.compress(lines.tobytes(), 1), b"IEND": b""}
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        for kind, data in pieces.items()
    )
