"""The inputs and outputs of the filter's compiled loop, as tuples that numba accesses by name."""

from __future__ import annotations

from typing import NamedTuple

from swath.georef.arrays import BoolArray, ByteArray, FloatArray, Int64Array, SingleArray
from swath.georef.navigation.filter.error_model import Drive, Layout
from swath.georef.navigation.filter.measurements import Rules
from swath.georef.navigation.inputs import Kind

KINDS = len(Kind)

# Columns of `Running.clock`
NOW, NEXT_STEP, NEXT_NODE, STARTED, GAPS, OUT, NODE, SCALAR = range(8)
CLOCK_SIZE = 8
# Rows of `Running.refused`: refusals in a row, time of the first, time when one was last taken, time until which the
# state settles; time of the last one if it was within the gate, time of a leap
COUNT, SINCE_NS, TAKEN_NS, SETTLED_NS, SOUND_NS, LEAPT_NS = 0, 1, 2, 3, 4, 5
# Rows of `Running.lately`: mean χ² per component, its number, mean product of neighbours, the last normalised (3)
MEAN, SEEN, ALIKE, WHITE = 0, 1, 2, 3
# Columns of `Told.figures`
NU, SIGMA, NORMALISED, CHI2, LOG_DET, INFLATION = 0, 3, 6, 9, 10, 11
TOLD_SIZE = 12


class Rows(NamedTuple):
    """Observations: (m,) times, (m, 4) kind, fix type, satellites, antenna, (m, 9) value, sigma, correlation."""

    time_ns: Int64Array
    what: ByteArray
    figures: FloatArray


class Running(NamedTuple):
    """The filter's knowledge, all of it changed as it runs.

    Attributes:
        clock: (CLOCK_SIZE,) times in ns and counters.
        x, p: (STATE_SIZE,) the state; (n, n) covariance of its errors.
        sums, before: (Layout.sums_size,) of the step; (7,) the sample before.
        total, total_decay: Φ since the last node.
        sigma: (9,) of position and velocity north, east, down, of roll, pitch, heading.
        bridge: (6, 3) covariances in e of attitude and velocity that made-up samples add to this step.
        refused, lately: (4, kinds), (6, kinds), by the rows above.
        top, work, decay: (9, core), (9, n), (n,) room for a step.
        rows, small, gain, error: (3, n), (8, 3), (n,), (n,) room for an observation.
    """

    clock: Int64Array
    x: FloatArray
    p: FloatArray
    sums: FloatArray
    before: FloatArray
    total: FloatArray
    total_decay: FloatArray
    sigma: FloatArray
    bridge: FloatArray
    refused: Int64Array
    lately: FloatArray
    top: FloatArray
    work: FloatArray
    decay: FloatArray
    rows: FloatArray
    small: FloatArray
    gain: FloatArray
    error: FloatArray


class Model(NamedTuple):
    """The filter's fixed parameters."""

    layout: Layout
    drive: Drive
    rules: Rules
    step_ns: int
    node_ns: int
    reacquire_after: int
    reacquire_ns: int


class Path(NamedTuple):
    """Output per sample: (c,) times, (c, 10) states, (c, 9) sigmas, (c,) bridged."""

    time_ns: Int64Array
    states: FloatArray
    sigma: SingleArray
    bridged: BoolArray


class Nodes(NamedTuple):
    """Output per node, and per component taken.

    Attributes:
        time_ns: (c,).
        before, after: (c, 10), (c, STATE_SIZE) the state without and with the node's observations.
        covariance: (c, n (n + 1) / 2) after them, packed by rows of the lower triangle.
        top, decay: (c, 9, core), (c, n) Φ from the node before.
        first: (c,) index of its first component; the last node's end with the counter.
        h, gain, weighed: (k, n), (k, n), (k, 2) innovation and 1, over the component's variance.
    """

    time_ns: Int64Array
    before: FloatArray
    after: FloatArray
    covariance: FloatArray
    top: FloatArray
    decay: FloatArray
    first: Int64Array
    h: FloatArray
    gain: FloatArray
    weighed: FloatArray


class Told(NamedTuple):
    """Output per observation: (m,) fate, number of components, (m, TOLD_SIZE) figures."""

    fate: ByteArray
    dimension: ByteArray
    figures: FloatArray
