"""Order the observations of an adjustment on planes, and run the passes over them.

Returns are processed swath by swath and plane by plane, in runs of one plane between two knots of the trajectory's
states: all rows of a run have the same unknowns. A pass places the returns of some runs at once, with the current
calibrations, and sums them up or inspects them (`swath.calib.equations.kernels`); it keeps only those values of a row
that a report needs.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from copy import copy
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from swath.calib.equations.inputs import beam_table, head_table, new_looks, rays_of, sigmas_of, track_of, writeable
from swath.calib.equations.sums import MODE_GIVE, MODE_LOOK, MODE_SUM, accumulate
from swath.calib.equations.tables import OF_PLANE, STATES, RowDiagnostics, Sigmas, Sums, Task
from swath.calib.equations.tables import Beam as BeamTable
from swath.calib.equations.tables import Groups as GroupTable
from swath.calib.equations.tables import Knots as KnotTable
from swath.calib.equations.tables import Planes as PlaneTable
from swath.calib.equations.trajectory_prior import TrajectoryPrior
from swath.calib.features import Plane
from swath.calib.flight import Flight, Swath
from swath.calib.parameters import BEAM_PARTS, Unknowns
from swath.georef.arrays import FloatArray, Int64Array, SingleArray
from swath.georef.geodesy.earth import geodetic_from_e, rot_e_from_l
from swath.georef.points import contiguous
from swath.georef.scanner.calibration import Calibration
from swath.georef.scanner.sensor_model import SensorModel

BATCH = 16_384  # returns placed at once; their data fit into the second-level cache
SECOND_NS = 1e9
_NO_SIGMAS = Sigmas(np.zeros((0, 3)), np.zeros((0, 3)))
_NO_LOOKS = RowDiagnostics(np.zeros(0), np.zeros(0), np.zeros(0), np.zeros(0), np.zeros((0, 0, 0)), np.zeros((0, 0)))


@dataclass(frozen=True, eq=False)
class State:
    """The current values of all unknowns of an adjustment.

    Attributes:
        values: (p,) of the parameters.
        knots: (k, 6) trajectory errors: shift (m) and small turn (rad), both along the axes of e.
        normal_e, offset: (q, 3), (q,) planes: n · (x − centre) + offset = 0.
        ties_e: (m, 3) tie points relative to their first sighting.
    """

    values: FloatArray
    knots: FloatArray
    normal_e: FloatArray
    offset: FloatArray
    ties_e: FloatArray


@dataclass(frozen=True, eq=False)
class Run:
    """Returns of one swath on one plane between two knots.

    Attributes:
        plane, swath: indexes; plane is −1 for an axis of a tie point.
        at: (n,) returns.
        before, after: knots; −1: none.
        channel: of a spinning head whose beams are estimated; −1: any.
        each: number of real returns that each listed one represents.
    """

    plane: int
    swath: int
    at: Int64Array
    before: int = -1
    after: int = -1
    channel: int = -1
    each: float = 1.0


@dataclass(frozen=True, eq=False)
class Batch:
    """Runs of one swath that are processed at once; ``begin`` is the position of their rows among all rows."""

    swath: int
    runs: tuple[Run, ...]
    begin: int

    @property
    def size(self) -> int:
        """Number of rows."""
        return sum(len(run.at) for run in self.runs)


class Rows:
    """The returns on planes, as rows of the adjustment.

    Attributes:
        flight: with trajectories that the kernels can read.
        unknowns: parameters.
        prior: of the trajectory; None: its sigmas count as independent from return to return.
        planes: of the features.
        batches: in order.
        count: number of rows.
        lists: by plane, positions of its unknowns: all parameters, then six for each knot next to its returns.
    """

    def __init__(
        self, flight: Flight, planes: Sequence[Plane], unknowns: Unknowns, prior: TrajectoryPrior | None
    ) -> None:
        trajectories = tuple(writeable(trajectory) for trajectory in flight.trajectories)
        self.flight = replace(flight, trajectories=trajectories)
        self.unknowns, self.prior, self.planes = unknowns, prior, tuple(planes)
        self._sigmas = tuple(sigmas_of(trajectory) for trajectory in trajectories)
        runs = [list(self._runs(index)) for index in range(len(flight.swaths))]
        self.batches = tuple(_batches(runs))
        self.count = sum(batch.size for batch in self.batches)
        self.lists, self.places = self._lists()
        self._first = np.cumsum([0, *(len(at) for at in self.lists)])

    def thinned(self, step: int) -> Rows:
        """Return the rows of every ``step``-th return of each run, enough for an approximate solution."""
        less = copy(self)
        runs: list[list[Run]] = [[] for _ in self.flight.swaths]
        for batch in self.batches:
            runs[batch.swath] += [replace(run, at=run.at[::step]) for run in batch.runs]
        less.batches = tuple(_batches(runs))
        less.count = sum(batch.size for batch in less.batches)
        return less

    def with_noise(self, shares: FloatArray) -> Rows:
        """Return the same rows with shares (h,) of the heads' configured noise."""
        quieter = copy(self)
        heads = tuple(
            replace(head, noise=head.noise.times(share))
            for head, share in zip(self.flight.heads, shares.tolist(), strict=True)
        )
        quieter.flight = replace(self.flight, heads=heads)
        return quieter

    def weights(self) -> SingleArray:
        """Return the number (n,) of returns that each row represents."""
        runs = [run for batch in self.batches for run in batch.runs]
        lengths = [len(run.at) for run in runs]
        return np.repeat(np.array([run.each for run in runs], np.float32), np.array(lengths, np.int64))

    @property
    def no_sums(self) -> Sums:
        """Empty sums, for passes that do not sum up."""
        nothing = np.zeros(0)
        return Sums(
            np.zeros((0, 0)),
            nothing,
            np.zeros((0, 3)),
            np.zeros(1, np.int64),
            np.zeros((0, 3, 3)),
            np.zeros((0, 3)),
            np.zeros(1),
            np.zeros(1, np.int64),
        )

    @property
    def size(self) -> int:
        """Number of unknowns that do not belong to a single plane: parameters and trajectory states."""
        return len(self.unknowns) + (0 if self.prior is None else 6 * len(self.prior.time_ns))

    def start(self, ties: int = 0) -> State:
        """Return the state before the first step; tie points are at their first sighting."""
        normals = np.array([plane.normal_t for plane in self.planes]).reshape(-1, 3) @ self.flight.frame.rot_t_from_e
        knots = np.zeros((0 if self.prior is None else len(self.prior.time_ns), 6))
        return State(self.unknowns.first, knots, normals, np.zeros(len(self.planes)), np.zeros((ties, 3)))

    def summed(self, state: State, weight: SingleArray, huber: float) -> Sums:
        """Return the normal equations at a state.

        Args:
            state: state at which they are linearised.
            weight: (n,) of the rows.
            huber: rows whose |f| / √(M + c) is larger lose weight; 0: all keep theirs.
        """
        sums = self._new_sums()
        for batch, task in self._tasks(state):
            mine = weight[batch.begin : batch.begin + batch.size].astype(np.float64)
            accumulate(MODE_SUM, task, mine, float(huber), sums, _NO_LOOKS)
        return sums

    def looks(
        self, state: State, cofactors: Any = None, weight: SingleArray | None = None
    ) -> Iterator[tuple[Batch, RowDiagnostics]]:
        """Yield each batch with f and M of its rows, and A Q Aᵀ (see `swath.calib.equations.sums.inspect`).

        Args:
            state: state at which the rows are evaluated.
            cofactors: function that returns Q (g, c, c) of the columns of a batch's runs; None: rows of the design are
                returned instead of A Q Aᵀ.
            weight: (n,) of the rows; None: 1.
        """
        sums = self.no_sums
        widest = max((len(self.unknowns.of_head(head)[0]) for head in range(len(self.flight.heads))), default=0)
        widest += STATES + OF_PLANE + 1
        for batch, task in self._tasks(state):
            nothing = np.zeros((0, 0))
            design = np.zeros((batch.size, widest)) if cofactors is None else nothing
            cofactor = np.zeros((0, 0, 0)) if cofactors is None else cofactors(batch)
            looks = new_looks(batch.size, cofactor, design)
            mode = MODE_GIVE if cofactors is None else MODE_LOOK
            mine = slice(batch.begin, batch.begin + batch.size)
            kept = np.ones(batch.size) if weight is None else weight[mine].astype(np.float64)
            accumulate(mode, task, kept, 0.0, sums, looks)
            yield batch, looks

    def placed(self, state: State) -> Iterator[BeamTable]:
        """Yield the returns with their axes, batch by batch."""
        for _, task in self._tasks(state):
            yield task.beam

    def expansion(self, run: Run, normal_e: FloatArray) -> tuple[Int64Array, FloatArray]:
        """Return the unknowns (m,) of a run's columns without the plane's own, and their share (m, c) in these."""
        at, kinds, arguments = self.unknowns.of_head(self.flight.swaths[run.swath].head)
        if run.channel >= 0:
            mine = ~np.isin(kinds, list(BEAM_PARTS.values())) | (arguments == run.channel)
            at = at[mine]
        if run.before < 0:
            return at, np.eye(len(at))
        columns, first = len(at), len(self.unknowns)
        knots = [first + 6 * knot + axis for knot in (run.before, run.after) for axis in range(6)]
        table = np.zeros((columns + 12, columns + STATES))
        table[:columns, :columns] = np.eye(columns)
        for side in range(2):
            row = columns + 6 * side
            table[row : row + 3, columns + side] = normal_e
            table[row + 3 : row + 6, columns + 2 + 3 * side : columns + 5 + 3 * side] = np.eye(3)
        return np.concatenate([at, np.array(knots, dtype=np.int64)]), table

    def knots_at(self, swath: Swath, time_ns: Int64Array) -> tuple[Int64Array, Int64Array]:
        """Return the knots before and after times (n,) of a swath, among those of its strip; −1 without a prior."""
        if self.prior is None:
            none = np.full(len(time_ns), -1, dtype=np.int64)
            return none, none
        mine = (self.prior.trajectory_index == swath.trajectory_index) & (self.prior.strip == swath.strip)
        if not mine.any():
            mine = self.prior.trajectory_index == swath.trajectory_index
        knots = np.flatnonzero(mine)
        before = np.searchsorted(self.prior.time_ns[knots], time_ns, side="right") - 1
        late, early = before >= len(knots) - 1, before < 0
        before = np.clip(before, 0, len(knots) - 1)
        after = np.where(late | early, before, np.minimum(before + 1, len(knots) - 1))
        return knots[before], knots[after]

    def task(self, state: State, batch: Batch, planes: PlaneTable) -> Task:
        """Return the kernel's input for a batch of runs; the runs' planes may differ from the state's.

        Raises:
            GeometryError: the calibration has parameters that such a scanner does not have.
        """
        calibrations = self.unknowns.calibrations(state.values)
        return self._task(state, batch, planes, self._model(self.flight.swaths[batch.swath].head, calibrations))

    def plane_table(self, state: State) -> PlaneTable:
        """Return the table of the state's planes."""
        first, second = tangents(state.normal_e)
        centres = np.array([plane.centre_t for plane in self.planes]).reshape(-1, 3)
        return PlaneTable(state.normal_e, self.flight.frame.e_from_t(centres), first, second, state.offset)

    def _tasks(self, state: State) -> Iterator[tuple[Batch, Task]]:
        calibrations, planes = self.unknowns.calibrations(state.values), self.plane_table(state)
        models = [self._model(head, calibrations) for head in range(len(self.flight.heads))]
        for batch in self.batches:
            yield batch, self._task(state, batch, planes, models[self.flight.swaths[batch.swath].head])

    def _model(self, head: int, calibrations: dict[str, Calibration]) -> SensorModel:
        return self.flight.heads[head].model(calibrations[self.flight.heads[head].name])

    def _task(self, state: State, batch: Batch, planes: PlaneTable, model: SensorModel) -> Task:
        swath = self.flight.swaths[batch.swath]
        trajectory = self.flight.trajectories[swath.trajectory_index]
        at = np.concatenate([run.at for run in batch.runs])
        rows = swath.rows.take(at)  # many times faster than indexing
        beam = beam_table(rows, rays_of(self.flight, swath, model, rows, at))
        knots = KnotTable(np.zeros(0, np.int64), state.knots, len(self.unknowns), np.zeros(0))
        if self.prior is not None:
            walk = self.prior.walk_rad2 if len(self.prior.walk_rad2) else np.zeros(len(self.prior))
            knots = knots._replace(time_ns=contiguous(self.prior.time_ns), walk=walk)
        sigmas = self._sigmas[swath.trajectory_index] if self.prior is None else _NO_SIGMAS
        middle = trajectory.position_e[int(beam.epoch[len(at) // 2])]
        lat, lon, _ = geodetic_from_e(middle)
        rot_l_from_e = np.ascontiguousarray(rot_e_from_l(lat, lon).T)
        track = track_of(trajectory, model.calibration)
        head = head_table(self.unknowns, self.flight, swath.head, model)
        return Task(beam, self._groups(batch), head, planes, knots, sigmas, track, rot_l_from_e)

    def _groups(self, batch: Batch) -> GroupTable:
        ends = np.cumsum([len(run.at) for run in batch.runs])
        places = [self.places.get((run.plane, knot), 0) for run in batch.runs for knot in (run.before, run.after)]
        table = np.array([(run.plane, run.before, run.after, run.channel) for run in batch.runs], dtype=np.int64)
        columns = np.ascontiguousarray(table.T)
        slots = np.ascontiguousarray(np.array(places, dtype=np.int64).reshape(-1, 2).T)
        begin = np.concatenate([[0], ends[:-1]])
        return GroupTable(begin, ends, columns[0], columns[1], columns[2], slots[0], slots[1], columns[3])

    def _new_sums(self) -> Sums:
        u, q = self.size, len(self.planes)
        return Sums(
            normal=np.zeros((u, u)),
            right=np.zeros(u),
            mixed=np.zeros((int(self._first[-1]), OF_PLANE)),
            first=self._first,
            plane=np.zeros((q, OF_PLANE, OF_PLANE)),
            plane_right=np.zeros((q, OF_PLANE)),
            square=np.zeros(1),
            counts=np.zeros(1, np.int64),
        )

    def _lists(self) -> tuple[list[Int64Array], dict[tuple[int, int], int]]:
        """Return the unknowns of each plane, and the position of each knot's states in them.

        The position counts knots after the parameters.
        """
        knots: list[dict[int, int]] = [{} for _ in self.planes]
        for batch in self.batches:
            for run in batch.runs:
                for knot in (run.before, run.after):
                    if knot >= 0:
                        knots[run.plane].setdefault(knot, len(knots[run.plane]))
        parameters = np.arange(len(self.unknowns), dtype=np.int64)
        states = len(parameters) + np.arange(6)
        lists = [np.concatenate([parameters, *(states + 6 * knot for knot in mine)]) for mine in knots]
        return lists, {(plane, knot): slot for plane, mine in enumerate(knots) for knot, slot in mine.items()}

    def _runs(self, index: int) -> Iterator[Run]:
        swath = self.flight.swaths[index]
        kinds = self.unknowns.of_head(swath.head)[1]
        by_channel = bool(np.isin(kinds, list(BEAM_PARTS.values())).any())
        for plane, feature in enumerate(self.planes):
            for patch in feature.patches:
                if patch.swath != index or not len(patch.at):
                    continue
                before, after = self.knots_at(swath, swath.time_ns[patch.at])
                for rows in _pieces(before, after):
                    knots = int(before[rows.start]), int(after[rows.start])
                    run = Run(plane, index, patch.at[rows], *knots, each=patch.each)
                    yield from _by_channel(swath, run) if by_channel else (run,)


def tangents(normal_e: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return two unit vectors perpendicular to unit vectors (q, 3) and to each other."""
    least = np.eye(3)[np.argmin(np.abs(normal_e), axis=1)]
    first = np.cross(normal_e, least)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return first, np.cross(normal_e, first)


def _pieces(before: Int64Array, after: Int64Array) -> Iterator[slice]:
    """Yield slices with equal knots, none longer than a batch."""
    changes = np.flatnonzero((np.diff(before) != 0) | (np.diff(after) != 0)) + 1
    ends = [0, *changes.tolist(), len(before)]
    for begin, end in pairwise(ends):
        for first in range(begin, end, BATCH):
            yield slice(first, min(first + BATCH, end))


def _by_channel(swath: Swath, run: Run) -> Iterator[Run]:
    channels = swath.rows["channel"][run.at]
    for channel in np.unique(channels).tolist():
        yield replace(run, at=run.at[channels == channel], channel=int(channel))


def _batches(runs: list[list[Run]]) -> Iterator[Batch]:
    begin = 0
    for swath, mine in enumerate(runs):
        taken: list[Run] = []
        size = 0
        for place, run in enumerate(mine):
            taken.append(run)
            size += len(run.at)
            if place + 1 == len(mine) or size + len(mine[place + 1].at) > BATCH:
                yield Batch(swath, tuple(taken), begin)
                begin, taken, size = begin + size, [], 0
