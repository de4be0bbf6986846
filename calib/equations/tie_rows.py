"""Tie points as observations: places where swaths show the same point (NGA Eq. 55 to 60; FORMULAS 7.1).

A sighting is F = x + (moved − placed) − X = 0, three rows in e: x is its measured position in the points as placed;
``moved`` and ``placed`` are the positions of the nearest return with the current calibration and with that of the
measurement; X is the tie point. The columns are those of three planes through the point, perpendicular to e's axes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass

import numpy as np

from swath.calib.equations.inputs import new_looks
from swath.calib.equations.rows import Batch, Rows, Run, State
from swath.calib.equations.sums import MODE_GIVE, accumulate
from swath.calib.equations.tables import Planes as PlaneTable
from swath.calib.features import ControlPoint, Sighting, TiePoint
from swath.georef.arrays import FloatArray, Int64Array
from swath.georef.scanner.calibration import Calibration

AT_ONCE = 4096  # sightings per kernel call


@dataclass(frozen=True, eq=False)
class Seen:
    """A sighting evaluated at a state.

    Attributes:
        tie, sighting: indexes.
        unknowns: (m,) of parameters and states.
        design: (3, m) ∂F/∂unknowns; ∂F/∂X = −I.
        misclosure_e: (3,) F.
        covariance_e: (3, 3) of the measurement.
    """

    tie: int
    sighting: int
    unknowns: Int64Array
    design: FloatArray
    misclosure_e: FloatArray
    covariance_e: FloatArray


class Ties:
    """The tie points of an adjustment.

    Attributes:
        ties: of the features.
        first_e: (m, 3) position of each point's first sighting, the origin of a state's tie points.
    """

    def __init__(self, rows: Rows, ties: Sequence[TiePoint], placed_with: Mapping[str, Calibration] | None) -> None:
        """Take tie points.

        Args:
            rows: of the adjustment, for its flight and unknowns.
            ties: points.
            placed_with: calibrations that placed the points when they were measured; None: the flight's points are
                still the same.
        """
        self.rows, self.ties = rows, tuple(ties)
        frame = rows.flight.frame
        self.first_e = frame.e_from_t(np.array([tie.sightings[0].point_t for tie in self.ties]).reshape(-1, 3))
        self._runs = [
            (index, place, self._run(sighting.swath, sighting.at))
            for index, tie in enumerate(self.ties)
            for place, sighting in enumerate(tie.sightings)
        ]
        self._from_placed_e = [self._offset_e(index, place, placed_with) for index, place, _ in self._runs]

    @property
    def order(self) -> list[tuple[int, Sighting]]:
        """Tie points' indexes and their sightings, in the order that all results use."""
        return [(tie, self.ties[tie].sightings[place]) for tie, place, _ in self._runs]

    def of(self, rows: Rows) -> Ties:
        """Return the same points with other unknowns."""
        other = copy(self)
        other.rows = rows
        return other

    def seen(self, state: State) -> list[Seen | None]:
        """Return all sightings at a state, in their order; None where a return cannot be placed any more."""
        found: list[Seen | None] = [None] * len(self._runs)
        for swath in sorted({run.swath for _, _, run in self._runs}):
            mine = [index for index, (_, _, run) in enumerate(self._runs) if run.swath == swath]
            for begin in range(0, len(mine), AT_ONCE):
                self._look(state, mine[begin : begin + AT_ONCE], found)
        return found

    def control(self, tie: int) -> tuple[FloatArray, FloatArray] | None:
        """Return the surveyed position of a tie point in e, relative to its first sighting, and its covariance (3, 3).

        None if the point is not surveyed.
        """
        point = self.ties[tie].control
        if point is None:
            return None
        frame = self.rows.flight.frame
        rot = frame.rot_t_from_e
        return frame.e_from_t(point.position_t) - self.first_e[tie], rot.T @ covariance_t(point) @ rot

    def _run(self, swath: int, at: int) -> Run:
        taken = self.rows.flight.swaths[swath]
        before, after = self.rows.knots_at(taken, taken.time_ns[at : at + 1])
        return Run(-1, swath, np.array([at], dtype=np.int64), int(before[0]), int(after[0]))

    def _offset_e(self, tie: int, place: int, placed_with: Mapping[str, Calibration] | None) -> FloatArray:
        """Return the vector from the placed return to the measured point, in e."""
        flight, sighting = self.rows.flight, self.ties[tie].sightings[place]
        swath = flight.swaths[sighting.swath]
        if placed_with is None:
            placed_t = swath.points_t[sighting.at]
        else:
            calibration = placed_with[flight.heads[swath.head].name]
            placed_t = flight.place(swath, calibration, np.array([sighting.at]))[0]
        offset: FloatArray = (sighting.point_t - placed_t) @ flight.frame.rot_t_from_e
        return offset

    def _look(self, state: State, which: list[int], found: list[Seen | None]) -> None:
        """Evaluate sightings of one swath, each as three planes."""
        rows, axes = self.rows, np.eye(3)
        normals, centres, runs = np.tile(axes, (len(which), 1)), np.zeros((3 * len(which), 3)), []
        planes = PlaneTable(normals, centres, normals, normals, np.zeros(3 * len(which)))
        for place, index in enumerate(which):
            tie, _, run = self._runs[index]
            centre = self.first_e[tie] - self._from_placed_e[index] + state.ties_e[tie]
            centres[3 * place : 3 * place + 3] = centre
            runs += [Run(3 * place + axis, run.swath, run.at, run.before, run.after) for axis in range(3)]
        task = rows.task(state, Batch(runs[0].swath, tuple(runs), 0), planes)
        looks = new_looks(len(runs), np.zeros((0, 0, 0)), np.zeros((len(runs), len(task.head.kind) + 12)))
        accumulate(MODE_GIVE, task, np.ones(len(runs)), 0.0, rows.no_sums, looks)
        for place, index in enumerate(which):
            three = slice(3 * place, 3 * place + 3)
            if np.isfinite(looks.misclosure[three]).all():
                arm_b = task.beam.arm_b[:, 3 * place]
                found[index] = self._seen(index, looks.design[three], looks.misclosure[three], arm_b)

    def _seen(self, index: int, columns: FloatArray, misclosure_e: FloatArray, arm_b: FloatArray) -> Seen:
        tie, place, run = self._runs[index]
        rot = self.rows.flight.frame.rot_t_from_e
        covariance = rot.T @ self.ties[tie].sightings[place].covariance_t @ rot
        if self.rows.prior is None:
            covariance = covariance + self._flown(run, arm_b)
        expansions = [self.rows.expansion(run, axis) for axis in np.eye(3)]
        design = [expanded @ own[: expanded.shape[1]] for (_, expanded), own in zip(expansions, columns, strict=True)]
        return Seen(tie, place, expansions[0][0], np.array(design), misclosure_e, covariance)

    def _flown(self, run: Run, arm_b: FloatArray) -> FloatArray:
        """Return the covariance (3, 3) due to a trajectory whose errors are not estimated; equal in all directions."""
        swath = self.rows.flight.swaths[run.swath]
        trajectory = self.rows.flight.trajectories[swath.trajectory_index]
        epoch = min(int(np.searchsorted(trajectory.time_ns, swath.time_ns[run.at[0]])), len(trajectory) - 1)
        shift = np.nan_to_num(trajectory.position_sigma_l[epoch]).max()
        turn = np.nan_to_num(trajectory.attitude_sigma_rad[epoch]).max()
        return np.eye(3) * float(shift**2 + turn**2 * (arm_b @ arm_b))


def covariance_t(point: ControlPoint) -> FloatArray:
    """Return the covariance (3, 3) of a surveyed point."""
    return np.diag(np.broadcast_to(np.square(point.sigma_m), 3).astype(np.float64))
