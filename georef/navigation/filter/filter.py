"""The navigation filter: it takes samples and observations as they come, or a whole run at once."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from swath.georef.arrays import FloatArray, StructArray
from swath.georef.geodesy.earth import geodetic_from_e, rot_e_from_l
from swath.georef.geodesy.rotations import quaternion_from_rot, rot_l_from_b
from swath.georef.navigation.bridging import Bridges, made_up_variance, new_bridges, primed_bridges
from swath.georef.navigation.filter.error_model import (
    MOVED,
    Layout,
    begin_accumulation,
    drive_of,
    layout_of,
    prior_variance,
)
from swath.georef.navigation.filter.loop import advance, end_step, level_sigmas, write_node
from swath.georef.navigation.filter.measurements import rules_of
from swath.georef.navigation.filter.stores import (
    IN_MEMORY,
    NodeStore,
    PathStore,
    RowQueue,
    Storage,
    columns_of,
    told_of,
)
from swath.georef.navigation.filter.strapdown import LEVER_ARM, STATE_SIZE, SUM_TIME, Samples, samples_of
from swath.georef.navigation.filter.types import (
    CLOCK_SIZE,
    GAPS,
    KINDS,
    NEXT_NODE,
    NEXT_STEP,
    NOW,
    SCALAR,
    Model,
    Nodes,
    Path,
    Running,
)
from swath.georef.navigation.inputs import Fate, Inertial, Kind, Setup, Start
from swath.georef.timescales import SECOND_NS

PIECE = 1 << 17  # samples, and rows of a path, between calls of the storage's `rest`


@dataclass(frozen=True, eq=False)
class FilterRun:
    """The results of a run that the smoother needs.

    Attributes:
        setup, start, layout: the run's inputs.
        path: one row per sample.
        nodes: blocks of the smoother's nodes.
        innovations: INNOVATION_DTYPE.
        counts: events, by name.
        storage: where it is kept.
    """

    setup: Setup
    start: Start
    layout: Layout
    path: Path
    nodes: list[Nodes]
    innovations: StructArray
    counts: Counter[str]
    storage: Storage = IN_MEMORY


class NavigationFilter:
    """An error-state filter that takes samples and observations as they come.

    A sample is processed once samples `hold_s` later are available: observations that arrive by then are used at their
    own times. Later ones are reported as outside.

    Args:
        setup, start: installation and noise, and the start; earlier samples are left out.
        hold_s: the time by which observations may lag behind samples.
        heights: whether a barometer is among the observations.
        smoothed: whether to keep the smoother's input, and all innovations.
        storage: where blocks are kept.
        expected: the number of samples to come, if known.
        bridges: knowledge about made-up samples before the first comes; None: no knowledge.
    """

    def __init__(
        self,
        setup: Setup,
        start: Start,
        *,
        hold_s: float = 0.0,
        heights: bool = False,
        smoothed: bool = True,
        storage: Storage = IN_MEMORY,
        expected: int = 0,
        bridges: Bridges | None = None,
    ) -> None:
        self.setup, self.start = setup, start
        self.layout = layout_of(setup, heights=heights)
        self._model = _model_of(setup, self.layout)
        self._run = _begin(setup, start, self.layout)
        self._path = PathStore(self._run.clock, storage, expected)
        self._nodes = NodeStore(self._run.clock, self.layout, storage, kept=smoothed)
        self._storage, self._queue = storage, RowQueue(kept=smoothed)
        self._hold_ns = round(hold_s * SECOND_NS)
        self._waiting: Samples | None = None
        self._bridges = new_bridges() if bridges is None else bridges
        self._counts: Counter[str] = Counter()
        level_sigmas(self._run.x, self._run.p, self._run.sigma)
        write_node(self._run, self._nodes.room(1, 0), self._run.x, 0)

    @property
    def time_ns(self) -> int:
        """The GPS time of the state."""
        return int(self._run.clock[NOW])

    @property
    def state(self) -> FloatArray:
        """A copy of the state (STATE_SIZE,), by the columns of `strapdown`."""
        return self._run.x.copy()

    @property
    def covariance(self) -> FloatArray:
        """A copy of the errors' covariance (n, n) at the end of the latest step."""
        return self._run.p.copy()

    @property
    def sigmas(self) -> FloatArray:
        """Sigmas (9,) of position and velocity north, east, down, and of roll, pitch, heading, at the latest step."""
        return self._run.sigma.copy()

    @property
    def counts(self) -> Counter[str]:
        """The events so far, by name."""
        counts = Counter(self._counts)
        counts["gaps not bridged"] += int(self._run.clock[GAPS])
        for (kind, fate), count in sorted(self._queue.fates.items()):
            name = Kind(kind).name if kind < KINDS else f"kind {kind}"
            counts[f"{name.lower().replace('_', ' ')} {Fate(fate).name.lower()}"] += count
        return +counts

    def observe(self, rows: StructArray) -> None:
        """Take observations (OBSERVATION_DTYPE), in any order."""
        self._queue.add(rows, self.time_ns)

    def feed(self, inertial: Inertial) -> None:
        """Take samples, in order, and advance the filter as far as `hold_s` allows."""
        samples = samples_of(inertial)
        samples = samples._replace(made_up=made_up_variance(samples, self._bridges))
        self._counts["samples bridged"] += int(np.count_nonzero(samples.bridged))
        if self._waiting is not None:
            samples = Samples._make(np.concatenate(pair) for pair in zip(self._waiting, samples, strict=True))
        if len(samples.time_ns):
            self._go(samples, int(samples.time_ns[-1]) - self._hold_ns)

    def flush(self) -> None:
        """Process all waiting data as no more will come, and set the last node."""
        if self._waiting is not None and len(self._waiting.time_ns):
            self._go(self._waiting, int(self._waiting.time_ns[-1]))
        self._queue.close()
        run = self._run
        if run.sums[SUM_TIME] > 0.0:
            end_step(run, self._model)
            level_sigmas(run.x, run.p, run.sigma)
        write_node(run, self._nodes.room(1, 0), run.x, int(run.clock[SCALAR]))

    def new_path(self) -> Path:
        """Return the rows written since the last call; for live use, with `smoothed` False."""
        return self._path.taken()

    def finish(self) -> FilterRun:
        """Flush the filter and return all results."""
        self.flush()
        return FilterRun(
            self.setup,
            self.start,
            self.layout,
            self._path.whole(),
            self._nodes.blocks(),
            self._queue.innovations(),
            self.counts,
            self._storage,
        )

    def _go(self, samples: Samples, until_ns: int) -> None:
        """Process samples up to a time; later ones wait."""
        count = int(np.searchsorted(samples.time_ns, until_ns, side="right"))
        self._waiting = Samples._make(column[count:] for column in samples)
        if not count:
            return
        due = self._queue.until(int(samples.time_ns[count - 1]))
        rows, told = columns_of(due), told_of(len(due))
        span_ns = int(samples.time_ns[count - 1]) - self.time_ns
        nodes = len(due) + max(span_ns, 0) // self._model.node_ns + 3
        self._counts["samples before the start"] += int(
            np.searchsorted(samples.time_ns[:count], self.time_ns, side="right")
        )
        advance(
            samples,
            0,
            count,
            rows,
            0,
            self._run,
            self._model,
            self._path.room(count),
            self._nodes.room(nodes, 3 * len(due)),
            told,
        )
        self._queue.tell(due, told)


def run_filter(
    inertial: Inertial,
    observations: StructArray,
    setup: Setup,
    start: Start,
    *,
    storage: Storage = IN_MEMORY,
    passed: Callable[[int], None] = lambda samples: None,
) -> FilterRun:
    """Filter a whole flight, in pieces, between which the storage may free memory; pass on the samples done."""
    heights = bool((observations["kind"] == Kind.HEIGHT).any())
    bridges = primed_bridges(samples_of(inertial.between(0, PIECE)))
    navigation = NavigationFilter(
        setup, start, heights=heights, storage=storage, expected=len(inertial), bridges=bridges
    )
    navigation.observe(observations)
    for first in range(0, len(inertial), PIECE):
        navigation.feed(inertial.between(first, first + PIECE))
        storage.rest()
        passed(min(first + PIECE, len(inertial)))
    return navigation.finish()


def _model_of(setup: Setup, layout: Layout) -> Model:
    return Model(
        layout,
        drive_of(setup, layout),
        rules_of(setup),
        round(setup.step_s * SECOND_NS),
        round(setup.node_s * SECOND_NS),
        setup.reacquire_after,
        round(setup.reacquire_s * SECOND_NS),
    )


def _begin(setup: Setup, start: Start, layout: Layout) -> Running:
    """Return the filter's working state at the start."""
    n = layout.size
    clock = np.zeros(CLOCK_SIZE, np.int64)
    clock[NOW] = start.time_ns
    step_ns, node_ns = round(setup.step_s * SECOND_NS), round(setup.node_s * SECOND_NS)
    clock[NEXT_STEP] = (start.time_ns // step_ns + 1) * step_ns
    clock[NEXT_NODE] = (start.time_ns // node_ns + 1) * node_ns
    none, settled_ns = np.zeros(KINDS, np.int64), start.time_ns + round(setup.reacquire_s * SECOND_NS)
    total, total_decay = np.empty((MOVED, layout.core)), np.empty(n)
    begin_accumulation(total, total_decay)
    return Running(
        clock=clock,
        x=start_state(setup, start),
        p=start_covariance(setup, start, layout),
        sums=np.zeros(layout.sums_size),
        before=np.zeros(7),
        total=total,
        total_decay=total_decay,
        sigma=np.zeros(9),
        bridge=np.zeros((6, 3)),
        refused=np.stack([none, none, none + start.time_ns, none + settled_ns, none, none]),
        lately=np.zeros((6, KINDS)),
        top=np.zeros((MOVED, layout.core)),
        work=np.zeros((MOVED, n)),
        decay=np.ones(n),
        rows=np.zeros((3, n)),
        small=np.zeros((8, 3)),
        gain=np.zeros(n),
        error=np.zeros(n),
    )


def start_state(setup: Setup, start: Start) -> FloatArray:
    """Return the state (STATE_SIZE,) at the start."""
    lat, lon, _ = geodetic_from_e(start.position_e)
    of_level = rot_e_from_l(lat, lon)
    roll, pitch, heading = np.asarray(start.attitude_rad, dtype=np.float64)
    x = np.zeros(STATE_SIZE)
    x[:3] = start.position_e
    x[3:6] = of_level @ np.asarray(start.velocity_l, dtype=np.float64)
    x[6:10] = quaternion_from_rot(of_level @ rot_l_from_b(roll, pitch, heading))
    x[LEVER_ARM : LEVER_ARM + 3] = np.asarray(setup.lever_arms_b, dtype=np.float64).reshape(-1, 3)[0]
    return x


def start_covariance(setup: Setup, start: Start, layout: Layout) -> FloatArray:
    """Return the errors' covariance (n, n) at the start."""
    lat, lon, _ = geodetic_from_e(start.position_e)
    of_level = rot_e_from_l(lat, lon)
    _, pitch, heading = np.asarray(start.attitude_rad, dtype=np.float64)
    cos, sin = np.cos(heading), np.sin(heading)
    # ψ in l of changes of roll, pitch and heading: about the nose, about the level right, about down
    about = np.array([[np.cos(pitch) * cos, -sin, 0.0], [np.cos(pitch) * sin, cos, 0.0], [-np.sin(pitch), 0.0, 1.0]])
    p = np.diag(prior_variance(setup, layout))
    for first, turn, sigma in (
        (0, of_level, start.position_sigma_l),
        (3, of_level, start.velocity_sigma_l),
        (6, of_level @ about, start.attitude_sigma_rad),
    ):
        p[first : first + 3, first : first + 3] = (turn * np.asarray(sigma, dtype=np.float64) ** 2) @ turn.T
    return p
