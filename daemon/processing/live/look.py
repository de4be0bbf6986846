"""Keeps the last moments of a flight for the operator: the ground below, a profile across track, and recent points."""

from __future__ import annotations

import json
import math
import struct
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from swath.daemon.processing.live.files import exchange_file
from swath.georef.arrays import FloatArray, Int64Array, SingleArray
from swath.georef.compiled import jit_cached
from swath.georef.points import Points
from swath.georef.timescales.gps_time import SECOND_NS

PROFILE, RECENT = "profile.json", "recent.bin"
KEPT_NS = 3 * SECOND_NS  # of displayed points, for profile and ground
GROUND_NS = SECOND_NS  # that figures of the ground are of
SAMPLES = 256  # points of a block that the ground is found by
NEAREST = 0.1  # share of the samples, nearest to the vertical, that give the height above ground
NADIR_RAD = math.radians(10.0)  # farther from the vertical a range is not one to the nadir
BACK_NS = SECOND_NS  # from the newest point to the line of the profile: inclined beams have seen all of it by then
STALE_NS = 2 * SECOND_NS  # without points: figures of the ground are no longer those of the present place
HALF_WIDTH_M = 1.0  # of the profile
PROFILE_POINTS = 600
BEFORE_M = 200.0  # beyond the last points, as far as earlier strips are shown
RECENT_S, RECENT_POINTS = 60, 50_000
RECENT_HEAD = struct.Struct("<4sHHIIq")  # SWTR, version, bytes of the head and of a row, number of rows, GPS nanosecond
RECENT_DTYPE = np.dtype(
    [
        ("east", "<f4"),  # in the frame ``local``
        ("north", "<f4"),
        ("up", "<f4"),
        ("intensity", "<f4"),
        ("seconds", "<f4"),  # after the head's GPS time
        ("strip", "<u2"),
        ("scanner", "u1"),  # by the alphabetical order of their names
        ("return_number", "u1"),
    ]
)
# Takes places (n, 2) in the frame ``local``; gives heights of earlier strips there, nan: none, and their numbers.
Earlier = Callable[[FloatArray], tuple[FloatArray, Int64Array]]


@dataclass(slots=True)
class _Block:
    """Displayed points of a scanner: one row each, and xyz (n, 4) in the frame ``local`` with the intensity."""

    name: str
    time_ns: Int64Array
    xyz: SingleArray
    range_m: SingleArray
    return_number: NDArray[np.uint8]
    count: int = 0  # of all points, displayed or not
    pulses: int = 0  # of them first returns

    def take(self, which: Any) -> _Block:
        """Return some of the rows."""
        columns = (self.time_ns, self.xyz, self.range_m, self.return_number)
        return _Block(self.name, *(column[which] for column in columns))


class LastLook:
    """The last moments of a flight."""

    def __init__(self) -> None:
        self._poses: deque[tuple[int, float, float, float]] = deque(maxlen=100)  # GPS time, east, north, up
        self._blocks: deque[_Block] = deque()
        self._recent: deque[_Block] = deque()
        self._saved = 0
        self._second, self._in_second, self._stride, self._shown, self._until = 0, 0, 1, 0, 0

    def take_pose(self, gps_ns: int, position: FloatArray) -> None:
        """Note where the body is: (3,) in the frame ``local``."""
        if not self._poses or gps_ns > self._poses[-1][0]:
            east, north, up = position.tolist()
            self._poses.append((gps_ns, east, north, up))

    def take(self, name: str, points: Points, keep: Int64Array, cloud: NDArray[Any]) -> None:
        """Take a block's points, of which those with the indexes ``keep`` (one at least) are displayed as ``cloud``."""
        block = _Block(
            name,
            points.time_ns[keep],
            cloud.view(np.float32).reshape(-1, 4),
            points.range_m[keep],
            points.return_number[keep],
            len(points),
            int(np.count_nonzero(points.return_number <= 1)),
        )
        self._blocks.append(block)
        newest_ns = int(block.time_ns[-1])
        while int(self._blocks[0].time_ns[-1]) < newest_ns - KEPT_NS:
            self._blocks.popleft()
        self._keep_recent(block)

    def _keep_recent(self, block: _Block) -> None:
        """Keep so few points that a minute's are few enough; the stride follows from the second before."""
        most = RECENT_POINTS // RECENT_S
        second = int(block.time_ns[0]) // SECOND_NS
        if second > self._second:
            self._stride = max(1, -(-self._in_second // most))
            self._second, self._in_second, self._shown, self._until = second, 0, 0, 0
        chosen = np.arange(self._until, len(block.time_ns), self._stride)
        self._until += len(chosen) * self._stride - len(block.time_ns)
        self._in_second += len(block.time_ns)
        chosen = chosen[: max(0, most - self._shown)]
        if len(chosen):
            self._shown += len(chosen)
            self._recent.append(block.take(chosen))
        while self._recent and int(self._recent[0].time_ns[0]) // SECOND_NS <= second - RECENT_S:
            self._recent.popleft()

    def ground(self) -> dict[str, dict[str, float | None]]:
        """Return by scanner figures of the last second's points, as `_ground_of` gives them; only where points come."""
        found = {}
        for name in sorted({block.name for block in self._blocks}):
            blocks = [block for block in self._blocks if block.name == name]
            newest_ns = int(blocks[-1].time_ns[-1])
            if self._poses and self._poses[-1][0] - newest_ns > STALE_NS:
                continue
            since_ns = newest_ns - GROUND_NS
            found[name] = self._ground_of([block for block in blocks if int(block.time_ns[-1]) > since_ns])
        return found

    def _ground_of(self, blocks: list[_Block]) -> dict[str, float | None]:
        """Return height above ground and range to the nadir, metres; returns per pulse; mean intensity.

        Of the points, those nearest to the vertical give the height, by the median. None: not known.
        """
        points, pulses = (sum(getattr(block, name) for block in blocks) for name in ("count", "pulses"))
        some = [block.take(slice(None, None, max(1, len(block.time_ns) // SAMPLES))) for block in blocks]
        xyz = np.concatenate([block.xyz for block in some]).astype(np.float64)
        found: dict[str, float | None] = {
            "height_above_ground_m": None,
            "nadir_range_m": None,
            "returns_per_pulse": round(points / pulses, 3) if pulses else None,
            "intensity_mean": round(float(xyz[:, 3].mean()), 2),
        }
        if len(self._poses) < 2:
            return found
        time_ns = np.concatenate([block.time_ns for block in some])
        away = self._places(time_ns) - xyz[:, :3]
        angle = np.arctan2(np.hypot(away[:, 0], away[:, 1]), away[:, 2])
        nearest = np.argsort(angle)[: max(1, round(NEAREST * len(angle)))]
        found["height_above_ground_m"] = round(float(np.median(away[nearest, 2])), 2)
        below = nearest[angle[nearest] < NADIR_RAD]
        if len(below):
            range_m = np.concatenate([block.range_m for block in some])[below]
            found["nadir_range_m"] = round(float(np.median(range_m)), 2)
        return found

    def _places(self, time_ns: Int64Array) -> FloatArray:
        """Return where the body was (n, 3), between the poses that were noted."""
        poses = list(self._poses)
        first_ns = poses[0][0]
        at = np.array([pose[0] - first_ns for pose in poses], np.float64)
        since = (time_ns - first_ns).astype(np.float64)
        return np.stack([np.interp(since, at, [pose[axis] for pose in poses]) for axis in (1, 2, 3)], axis=-1)

    def profile(self, edges: Int64Array, earlier: Earlier) -> dict[str, Any] | None:
        """Return heights along a line across track that the aircraft passed a moment ago; None: it does not move.

        Args:
            edges: beginning, end and number (m, 3) of strips.
            earlier: gives the heights of earlier strips.

        Returns:
            The line's place and direction (on the map, clockwise from north), and by strip ``across_m``, to the right
            of the track, and ``up_m`` above the origin: of the last points, and of earlier strips' planes.
        """
        if len(self._poses) < 2 or not self._blocks:
            return None
        at_ns = min(self._poses[-1][0], int(self._blocks[-1].time_ns[-1])) - BACK_NS
        here, before = self._places(np.array([at_ns, at_ns - SECOND_NS]))
        track = here[:2] - before[:2]
        length_m = float(np.hypot(*track))
        if length_m < HALF_WIDTH_M:
            return None
        along = track / length_m
        right = np.array([along[1], -along[0]])
        off, up_m, time_ns = self._near(at_ns, here, along)
        numbers = strips_at(time_ns, edges)
        strips: dict[str, dict[str, list[float]]] = {}
        for number in np.unique(numbers).tolist():
            own = numbers == number
            _put(strips, number, off[own] @ right, up_m[own])
        reach_m = BEFORE_M + float(np.abs(off @ right).max(initial=0.0))
        across = np.arange(-reach_m, reach_m, 2.0 * HALF_WIDTH_M)
        up_m, numbers = earlier(here[:2] + across[:, np.newaxis] * right)
        for number in np.unique(numbers[np.isfinite(up_m)]).tolist():
            own = (numbers == number) & np.isfinite(up_m)
            if str(number) not in strips:
                _put(strips, number, across[own], up_m[own])
        return {
            "gps_ns": at_ns,
            "east_m": round(float(here[0]), 2),
            "north_m": round(float(here[1]), 2),
            "track_deg": round(math.degrees(math.atan2(*track)) % 360.0, 2),
            "width_m": 2.0 * HALF_WIDTH_M,
            "strips": strips,
        }

    def _near(self, at_ns: int, here: FloatArray, along: FloatArray) -> tuple[FloatArray, FloatArray, Int64Array]:
        """Return the points near the line of the profile: east and north of its place (n, 2), up and GPS times."""
        found = [(np.zeros((0, 2)), np.zeros(0), np.zeros(0, np.int64))]
        x, y = along.astype(np.float32).tolist()
        for block in self._blocks:
            if int(block.time_ns[0]) > at_ns + BACK_NS or int(block.time_ns[-1]) < at_ns - BACK_NS:
                continue
            near = np.empty(len(block.time_ns), np.int64)
            near = near[: _find_near(block.xyz, np.float32(x), np.float32(y), np.float32(here[:2] @ along), near)]
            xyz = block.xyz[near].astype(np.float64)
            found.append((xyz[:, :2] - here[:2], xyz[:, 2], block.time_ns[near]))
        off, up_m, time_ns = (np.concatenate(column) for column in zip(*found, strict=True))
        step = max(1, -(-len(off) // PROFILE_POINTS))
        return off[::step], up_m[::step], time_ns[::step]

    def recent(self, edges: Int64Array) -> bytes:
        """Return the last minute's points, few of them, as the file ``recent.bin``: a head and `RECENT_DTYPE`."""
        blocks = list(self._recent)
        first_ns = int(blocks[0].time_ns[0]) if blocks else 0
        names = sorted({block.name for block in blocks})
        rows = np.zeros(sum(len(block.time_ns) for block in blocks), RECENT_DTYPE)
        if blocks:
            xyz = np.concatenate([block.xyz for block in blocks])
            time_ns = np.concatenate([block.time_ns for block in blocks])
            for axis, column in enumerate(("east", "north", "up", "intensity")):
                rows[column] = xyz[:, axis]
            rows["seconds"], rows["strip"] = (time_ns - first_ns) / SECOND_NS, strips_at(time_ns, edges)
            numbers = [names.index(block.name) for block in blocks]
            rows["scanner"] = np.repeat(numbers, [len(block.time_ns) for block in blocks])
            rows["return_number"] = np.concatenate([block.return_number for block in blocks])
        return RECENT_HEAD.pack(b"SWTR", 1, RECENT_HEAD.size, rows.itemsize, len(rows), first_ns) + rows.tobytes()

    def save(self, folder: Path, edges: Int64Array, earlier: Earlier, *, last: bool = False) -> None:
        """Replace the profile and the recent points by turns; both if it is the ``last`` time.

        Raises:
            OSError: a file cannot be written.
        """
        self._saved += 1
        if self._saved % 2 or last:
            profile = self.profile(edges, earlier)
            if profile is not None:
                exchange_file(folder, PROFILE, (json.dumps(profile, separators=(",", ":")) + "\n").encode())
        if not self._saved % 2 or last:
            exchange_file(folder, RECENT, self.recent(edges))


def read_recent(data: bytes) -> tuple[NDArray[Any], int]:
    """Return the rows, `RECENT_DTYPE`, and the GPS nanosecond that their seconds count from, of ``recent.bin``.

    Raises:
        ValueError: the bytes are no such file.
    """
    if len(data) < RECENT_HEAD.size:
        raise ValueError("too short for a file of recent points")
    magic, version, head, row, count, first_ns = RECENT_HEAD.unpack_from(data)
    if (magic, version, row) != (b"SWTR", 1, RECENT_DTYPE.itemsize) or len(data) != head + row * count:
        raise ValueError("no file of recent points of this version")
    return np.frombuffer(data, RECENT_DTYPE, count, head), first_ns


def strips_at(time_ns: Int64Array, edges: Int64Array) -> Int64Array:
    """Return the numbers of the strips at GPS times (n,); 0: none."""
    numbers = np.zeros(len(time_ns), np.int64)
    for start_ns, end_ns, number in edges.tolist():
        numbers[(time_ns >= start_ns) & (time_ns < end_ns)] = number
    return numbers


def _put(strips: dict[str, dict[str, list[float]]], number: int, across_m: FloatArray, up_m: FloatArray) -> None:
    order = np.argsort(across_m)
    strips[str(number)] = {
        "across_m": np.round(across_m[order], 2).tolist(),
        "up_m": np.round(up_m[order], 3).tolist(),
    }


@jit_cached
def _find_near(xyz: Any, x: Any, y: Any, along_m: Any, near: Any) -> int:
    """Fill ``near`` with the indexes of points (n, 4) near a line across the direction (x, y); return their number."""
    count = 0
    for i in range(len(xyz)):
        if abs(xyz[i, 0] * x + xyz[i, 1] * y - along_m) <= HALF_WIDTH_M:
            near[count] = i
            count += 1
    return count
