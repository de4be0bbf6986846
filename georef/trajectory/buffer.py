"""A trajectory that grows with the solutions of a device's own INS."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from swath.georef.arrays import BoolArray, FloatArray, Int64Array, StructArray
from swath.georef.geodesy.quaternions import rotations_between
from swath.georef.records import INS_DTYPE
from swath.georef.trajectory.trajectory import DEFAULT_MAX_GAP_NS, Trajectory

SIGMA_HOLDS_NS = 2_500_000_000  # INSPVAX gives sigmas once a second beside INSPVAS, which has none
FIRST_CAPACITY = 4096
NEVER = np.iinfo(np.int64).min
NEEDED = ("lat_rad", "lon_rad", "height_m", "roll_rad", "pitch_rad", "heading_rad")
SIGMAS = ("position_sigma_l", "attitude_sigma_rad")
COLUMNS = ("time_ns", "position_e", "q_e_from_b", "velocity_e", *SIGMAS)

# protocol -> test of `INS_DTYPE` status words for a solution; rows of other protocols are all accepted
SOLUTION_STATUS: dict[str, Callable[[NDArray[np.uint32]], BoolArray]] = {
    # OEM7, inertial solution status: HIGH_VARIANCE, GOOD, FREE, ALIGNMENT_COMPLETE
    "novatel": lambda status: np.isin(status, (2, 3, 6, 7)),
    # mosaic and AsteRx, INSNavGeod: the upper half is the block's Error
    "sbf": lambda status: status >> np.uint32(16) == 0,
}


class TrajectoryBuffer:
    """Takes rows of `INS_DTYPE` and returns trajectories; memory holds only epochs that are not forgotten.

    A repeated epoch is taken once; if only the second one has sigmas, these are used. Until the next ones, and at most
    2.5 s, sigmas hold for epochs without them.

    Args:
        protocol: of the device, ``novatel`` or ``sbf``: it decides which status words are solutions.
        max_gap_ns: of the trajectory.
        name: of the trajectory.

    Attributes:
        counts: rows by fate: taken, sigmas (only these were taken), no_solution (by status), not_finite, out_of_order,
            repeated.
    """

    def __init__(self, protocol: str = "", *, max_gap_ns: int = DEFAULT_MAX_GAP_NS, name: str = "INS") -> None:
        self.counts: Counter[str] = Counter()
        self._is_solution = SOLUTION_STATUS.get(protocol)
        self._max_gap_ns, self._name = max_gap_ns, name
        empty = _trajectory_of(np.empty(0, INS_DTYPE), np.empty((0, 3)), np.empty((0, 3)))
        self._columns = {column: getattr(empty, column) for column in COLUMNS}
        self._rotvec_b = np.empty((0, 3))  # of the interval that begins with the epoch
        self._begin = self._end = 0
        self._sigma = {column: (0, np.full(3, np.nan)) for column in SIGMAS}  # the last ones given, and their time
        self._newest_ns: int | None = None

    @property
    def covered_until_ns(self) -> int | None:
        """The GPS time of the newest epoch; None before the first."""
        return self._newest_ns

    def append(self, rows: StructArray) -> None:
        """Take rows of `INS_DTYPE`, in the order in which they came."""
        rows = self._usable(rows)
        time_ns = rows["gps_ns"]
        sigmas = {column: rows[column].astype(np.float64) for column in SIGMAS}
        newest = np.maximum.accumulate(np.r_[NEVER if self._newest_ns is None else self._newest_ns, time_ns])
        repeated, late = time_ns == newest[:-1], time_ns < newest[:-1]
        gives = np.zeros(len(rows), np.bool_)
        for at in map(int, np.flatnonzero(repeated)):
            first = int(np.searchsorted(newest, time_ns[at])) - 1  # −1: already in the buffer
            for column in SIGMAS:
                gives[at] |= self._taken(column, sigmas[column], first, at)
        new = ~repeated & ~late
        self.counts["taken"] += int(new.sum())
        self.counts["sigmas"] += int(gives.sum())
        self.counts["repeated"] += int((repeated & ~gives).sum())
        self.counts["out_of_order"] += int(late.sum())
        if new.any():
            held = [self._held(column, time_ns[new], sigmas[column][new]) for column in SIGMAS]
            self._write(_trajectory_of(rows[new], *held))

    def snapshot(self) -> Trajectory:
        """Return all epochs not forgotten; they share the buffer's memory, but do not change when it grows."""
        columns: dict[str, Any] = {name: values[self._begin : self._end] for name, values in self._columns.items()}
        whole = Trajectory(**columns, max_gap_ns=self._max_gap_ns, name=self._name)
        if len(whole):  # the trajectory would otherwise compute it for all epochs at every tick
            vars(whole)["rotvec_b"] = self._rotvec_b[self._begin : self._end - 1]
        return whole

    def forget_before(self, gps_ns: int) -> None:
        """Drop epochs before gps_ns, as no poses there are needed any more."""
        time_ns = self._columns["time_ns"][self._begin : self._end]
        self._begin += max(0, int(np.searchsorted(time_ns, gps_ns, side="right")) - 1)

    def _usable(self, rows: StructArray) -> StructArray:
        solution = np.ones(len(rows), np.bool_) if self._is_solution is None else self._is_solution(rows["status"])
        finite = np.logical_and.reduce([np.isfinite(rows[column]) for column in NEEDED])
        self.counts["no_solution"] += int((~solution).sum())
        self.counts["not_finite"] += int((solution & ~finite).sum())
        usable: StructArray = rows[solution & finite]
        return usable

    def _taken(self, column: str, said: FloatArray, first: int, again: int) -> bool:
        """Return whether the row `again` gave its sigma to the epoch it repeats, which had none of its own."""
        if not np.isfinite(said[again]).all():
            return False
        if first >= 0:
            wanted = not np.isfinite(said[first]).all()
            if wanted:
                said[first] = said[again]
            return wanted
        wanted = self._sigma[column][0] != self._newest_ns
        if wanted:
            self._sigma[column] = (int(self._newest_ns or 0), said[again].copy())
            self._columns[column] = self._columns[column].copy()  # earlier snapshots must not change
            self._columns[column][self._end - 1] = said[again]
        return wanted

    def _held(self, column: str, time_ns: Int64Array, said: FloatArray) -> FloatArray:
        """Return sigmas (n, 3); an epoch without them gets those of the last epoch that had some."""
        held_ns, held = self._sigma[column]
        times, values = np.r_[held_ns, time_ns], np.vstack([held, said])
        speaks = np.isfinite(values).all(axis=1)
        speaks[0] = True
        latest = np.maximum.accumulate(np.where(speaks, np.arange(len(times)), 0))
        self._sigma[column] = (int(times[latest[-1]]), values[latest[-1]].copy())
        age_ns = times - times[latest]
        filled: FloatArray = np.where((age_ns <= SIGMA_HOLDS_NS)[:, np.newaxis], values[latest], np.nan)
        return filled[1:]

    def _write(self, new: Trajectory) -> None:
        """Append epochs, in new arrays when these are full: snapshots keep the old ones."""
        end = self._end + len(new)
        if end > len(self._columns["time_ns"]):
            kept = self._end - self._begin
            capacity = max(FIRST_CAPACITY, 2 * (kept + len(new)))
            for column, old in self._columns.items():
                grown = np.empty((capacity, *old.shape[1:]), dtype=old.dtype)
                grown[:kept] = old[self._begin : self._end]
                self._columns[column] = grown
            turns = np.empty((capacity, 3))
            turns[:kept] = self._rotvec_b[self._begin : self._end]
            self._rotvec_b = turns
            self._begin, self._end, end = 0, kept, kept + len(new)
        for column, values in self._columns.items():
            values[self._end : end] = getattr(new, column)
        attitudes = self._columns["q_e_from_b"]
        if self._end > self._begin and attitudes[self._end] @ attitudes[self._end - 1] < 0:
            attitudes[self._end : end] *= -1.0
        first = max(self._begin, self._end - 1)
        self._rotvec_b[first : end - 1] = rotations_between(attitudes[first:end])
        self._end = end
        self._newest_ns = int(new.time_ns[-1])


def _trajectory_of(rows: StructArray, position_sigma_l: FloatArray, attitude_sigma_rad: FloatArray) -> Trajectory:
    lat, lon, height, roll, pitch, heading = (rows[column] for column in NEEDED)
    return Trajectory.from_geodetic(
        rows["gps_ns"],
        *(lat, lon, height),
        rows["velocity_l"],
        *(roll, pitch, heading),
        position_sigma_l=position_sigma_l,
        attitude_sigma_rad=attitude_sigma_rad,
    )
