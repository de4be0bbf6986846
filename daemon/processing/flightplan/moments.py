"""Facts of a flight, ten times a second: place of the aircraft, returns of the scanners, quality of time and position.

Poses come as soon as they are known; returns come later, because they wait for time and trajectory. `Moments` puts them
together and gives each moment once, when its returns are complete.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from swath.georef.arrays import StructArray
from swath.georef.timescales.gps_time import SECOND_NS

STEP_NS = 100_000_000
STEP_S = STEP_NS / SECOND_NS
SETTLE_NS = 3 * SECOND_NS  # returns wait for time and trajectory; after this time nearly all have come
MOMENT_DTYPE = np.dtype(
    [
        ("gps_ns", "i8"),
        ("lat_rad", "f8"),
        ("lon_rad", "f8"),
        ("height_m", "f8"),  # ellipsoidal
        ("speed_mps", "f8"),  # over the ground
        ("track_rad", "f8"),  # direction of flight over the ground, clockwise from north
        ("roll_rad", "f8"),  # positive: right side down
        ("fix", "i1"),  # quality of the best receiver's position: -1 unknown, 0 none, 1 any, 2 float, 3 fixed
        ("time", "i1"),  # 0: locked; 1: by messages, or holding over; 2: none
        ("lost", "i4"),  # units and packets of scanners lost since the moment before
        ("run", "i4"),  # number of the pass, by `LineWatch`; -1: on no line
        ("along_m", "f8"),  # on that line
        ("across_m", "f8"),  # positive to the right of the line's direction
        ("planned_m", "f8"),  # ellipsoidal height of the plan; nan: none
        ("planned_above_m", "f8"),  # height above ground of the plan; nan: none
        ("is_fixed_enough", "i1"),  # 1 yes, 0 no, -1 unknown
        ("returns", "i4"),  # first returns of all scanners
        ("pulses", "i4"),  # emitted by the scanners that tell it, and first returns of the others; -1: unknown
        ("silent", "i1"),  # scanners without a return that are not known to have emitted
        ("empty", "i1"),  # scanners that emitted and got no return
        ("untimed", "i1"),  # scanners whose returns have no time
        ("left_m", "f8"),  # edges of the swath across track, negative to the left; nan: unknown
        ("right_m", "f8"),
        ("above_m", "f8"),  # height above the ground; nan: unknown
    ]
)

_RAW = np.dtype((np.void, MOMENT_DTYPE.itemsize))  # NumPy copies rows as such without going through their columns
_OF_RETURNS = ("returns", "pulses", "silent", "empty", "untimed", "left_m", "right_m", "above_m")


def empty_moments(count: int) -> StructArray:
    """Return rows of `MOMENT_DTYPE` with nothing known."""
    rows = np.zeros(count, MOMENT_DTYPE)
    for name in ("run", "fix", "is_fixed_enough", "pulses"):
        rows[name] = -1
    for name in ("planned_m", "planned_above_m", "left_m", "right_m", "above_m"):
        rows[name] = math.nan
    return rows


def join_moments(blocks: Sequence[StructArray]) -> StructArray:
    """Return blocks of `MOMENT_DTYPE` as one array."""
    if len(blocks) == 1:
        return blocks[0]
    return np.concatenate([empty_moments(0).view(_RAW), *(block.view(_RAW) for block in blocks)]).view(MOMENT_DTYPE)


@dataclass(slots=True)
class Returns:
    """A scanner's returns within a moment.

    Attributes:
        first: first returns.
        left_m, right_m, above_m: as of a moment.
        empty: pulses known to have no return.
        seen: returns that came about then, placed by the log's time; those without a time give no point.
    """

    first: int = 0
    left_m: float = math.nan
    right_m: float = math.nan
    above_m: float = math.nan
    empty: int = 0
    seen: int = 0


class Moments:
    """Puts poses and returns together.

    Args:
        scanners: names of the scanners, each of which should return something at any time.
    """

    def __init__(self, scanners: Sequence[str]) -> None:
        self._scanners = list(scanners)
        self._poses: deque[StructArray] = deque()
        self._returns: dict[int, dict[str, Returns]] = {}
        self._newest_ns = -(1 << 62)
        self._tells: set[str] = set()  # scanners that tell pulses without a return

    def add_poses(self, rows: StructArray) -> None:
        """Take poses (n,) of `MOMENT_DTYPE` in the order of time, later than those before."""
        if len(rows):
            self._poses.append(rows)
            self._newest_ns = int(rows["gps_ns"][-1])

    def returns_at(self, gps_ns: int, scanner: str) -> Returns:
        """Return the record of a scanner's returns at a time, to add to it."""
        return self._returns.setdefault(gps_ns // STEP_NS, {}).setdefault(scanner, Returns())

    def add_seen(self, gps_ns: Sequence[int], scanner: str, returns: int, empty: int) -> None:
        """Take numbers of returns, and of pulses known to have none, that came while these moments passed."""
        if empty:
            self._tells.add(scanner)
        count = len(gps_ns)
        for place, at_ns in enumerate(gps_ns):
            record = self.returns_at(at_ns, scanner)
            record.seen += (returns + place) // count
            record.empty += (empty + place) // count

    def settled(self, *, last: bool = False) -> StructArray:
        """Return the moments (n,) whose returns are complete; ``last``: all that are left."""
        until_ns = self._newest_ns + (1 if last else -SETTLE_NS)
        found = []
        while self._poses and int(self._poses[0]["gps_ns"][0]) < until_ns:
            block = self._poses.popleft()
            count = int(np.searchsorted(block["gps_ns"], until_ns))
            found.append(block[:count])
            if count < len(block):
                self._poses.appendleft(block[count:])
        if not found:
            return empty_moments(0)
        rows = join_moments(found).copy()
        keys = (rows["gps_ns"] // STEP_NS).tolist()
        for name, values in self._facts(keys).items():
            rows[name] = values
        before = keys[-1] - 20  # pulses without a return are placed to a second or two
        for key in [key for key in self._returns if key < before]:
            del self._returns[key]
        return rows

    def _facts(self, keys: list[int]) -> dict[str, list[Any]]:
        """Return the columns of `MOMENT_DTYPE` that tell of the scanners, for moments by their number."""
        found: dict[str, list[Any]] = {name: [] for name in _OF_RETURNS}
        for key in keys:
            for name, value in zip(_OF_RETURNS, self._fact(key), strict=True):
                found[name].append(value)
        return found

    def _fact(self, key: int) -> tuple[float, ...]:
        """Return the values of one moment, in the order of `_OF_RETURNS`."""
        found = self._returns.get(key, {})
        returns = pulses = silent = empty = untimed = 0
        left_m = right_m = above_m = math.nan
        for scanner in self._scanners:
            one = found.get(scanner) or Returns()
            returns += one.first
            pulses += one.first + one.empty
            if not math.isnan(one.left_m):
                left_m = one.left_m if math.isnan(left_m) else min(left_m, one.left_m)
            if not math.isnan(one.right_m):
                right_m = one.right_m if math.isnan(right_m) else max(right_m, one.right_m)
            if math.isnan(above_m):
                above_m = one.above_m
            if one.first == 0:
                emits = scanner in self._tells and self._is_near(key, scanner, "empty")
                is_seen = not emits and self._is_near(key, scanner, "seen")
                empty, untimed, silent = empty + emits, untimed + is_seen, silent + (not emits and not is_seen)
        if not self._scanners or not self._tells.issuperset(self._scanners):
            pulses = -1
        return returns, pulses, silent, empty, untimed, left_m, right_m, above_m

    def _is_near(self, key: int, scanner: str, name: str) -> bool:
        """Return whether something came within half a second: it is placed by the log's time, which is inexact."""
        for near in range(key - 5, key + 6):
            one = self._returns.get(near, {}).get(scanner)
            if one is not None and getattr(one, name) > 0:
                return True
        return False
