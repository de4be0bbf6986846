"""One train of PPS edges: found among the interrupts, followed through a gate, remembered knot by knot."""

from __future__ import annotations

import math
from array import array
from collections import deque
from collections.abc import Sequence

import numpy as np

from swath.georef.arrays import BoolArray, FloatArray, Int64Array
from swath.georef.timescales.gps_time import SECOND_NS
from swath.georef.timescales.labelling import Labeller
from swath.georef.timescales.line_fit import SHRINK_HORIZON, LineBank, excess_variances

MAX_DRIFT = 200e-6
FIRST_LOCK_EDGES = 5
NOISY_LOCK_EDGES = 10  # for stamps too noisy for 200 ppm between neighbours
NOISY_TOLERANCE_NS = 2_000_000
NOISY_AFTER_EDGES = 24
MAX_CHAIN_GAP_S = 4
GATE_FLOOR_NS = 50_000.0
FIRST_GATE_FLOOR_NS = 1_000_000.0  # while the stamps' noise is only a first guess
FIRST_EDGES = 16
GATE_SIGMAS = 5.0
GATE_MISSED_MAX = 5.0
MAX_REFUSED_IN_A_ROW = 8
LIVE_KNOTS = 900
FIRST_NOISE_FACTOR = 1.5  # five edges determine little: the noise is assumed larger at first
FIRST_NOISE_NS = 2_000.0  # prior of the stamps' noise, worth two edges beside the first lock's residuals


def find_chain(edges: Sequence[int], train: EdgeTrain | None = None, *, noisy: bool) -> list[tuple[int, int]] | None:
    """Return edges of one 1 Hz train that ends with the newest edge: (index from 0, host ns); None if none is found.

    Neighbours lie whole seconds (up to MAX_CHAIN_GAP_S) ± 200 ppm apart. noisy allows NOISY_TOLERANCE_NS more and
    requires more edges. Edges that an existing train has taken are not used: knots of two trains must not overlap.
    """
    wanted = NOISY_LOCK_EDGES if noisy else FIRST_LOCK_EDGES
    chain = [(0, edges[-1])]
    for edge in reversed(edges[:-1]):
        index, host = chain[-1]
        gap = round((host - edge) / SECOND_NS)
        if gap > MAX_CHAIN_GAP_S or (train is not None and edge <= train.last_host_ns):
            break
        tolerance = MAX_DRIFT * gap * SECOND_NS + (NOISY_TOLERANCE_NS if noisy else 0)
        if gap >= 1 and abs(host - edge - gap * SECOND_NS) <= tolerance:
            chain.append((index - gap, edge))
    if len(chain) < wanted:
        return None
    first = chain[-1][0]
    return [(index - first, host) for index, host in reversed(chain)]


def _chain_noise_ns(chain: Sequence[tuple[int, int]], edges: Sequence[int]) -> float:
    """Return a first guess of the stamps' noise: residuals of a line through the chain, with the prior.

    The chain was chosen for its even spacing; the other edges near the line (1.48 MAD) show the noise of the stamps.
    """
    seconds = np.array([index for index, _ in chain], dtype=np.float64)
    phase = np.array([host - chain[0][1] - index * SECOND_NS for index, host in chain], dtype=np.float64)
    away, middle = seconds - seconds.mean(), phase.mean()
    # written out, because LAPACK is not used otherwise while recording
    slope = float(away @ phase) / float(away @ away)
    residual = phase - middle - slope * away
    chosen = math.sqrt((float(residual @ residual) + 2 * FIRST_NOISE_NS**2) / len(chain))
    since = np.array(edges, dtype=np.int64) - chain[0][1]
    whole = np.rint(since / SECOND_NS)
    off = np.abs(since - whole * SECOND_NS - middle - slope * (whole - seconds.mean()))
    near = np.sort(off[off < NOISY_TOLERANCE_NS])
    if not len(near):  # a chain of stray edges may have no edges near its line
        return FIRST_NOISE_FACTOR * chosen
    # written out: NumPy's median loads numpy.ma from the disk at its first call, in flight, with edges waiting
    median = 0.5 * float(near[(len(near) - 1) // 2] + near[len(near) // 2])
    return FIRST_NOISE_FACTOR * max(chosen, 1.4826 * median)


class EdgeTrain:
    """A locked 1 Hz train with its line, its label and its history."""

    def __init__(self, chain: Sequence[tuple[int, int]], edges: Sequence[int], *, keep_history: bool) -> None:
        """Begin a train with the (index, host ns) of its first edges from `find_chain`; edges: all recent ones."""
        self.anchor_ns = chain[0][1]
        self.labeller = Labeller(keep_votes=keep_history)
        self.refused_in_a_row = 0
        self.used = 0
        self.last_host_ns = chain[0][1]
        self.doubtful = False
        self._keep_history = keep_history
        self._whole = array("q")  # host ns of the knot's whole nanoseconds, index, doubt
        self._index = array("q")
        self._doubt = array("b")
        self._numbers = array("d")  # KNOT_NUMBERS per knot
        self.bank = LineBank(0, 0.0, _chain_noise_ns(chain, edges))
        self._remember()
        for index, host in chain[1:]:
            self._take(index, host)

    def index_at(self, host_ns: int) -> float:
        """Return the edge number (with fraction) at a host time."""
        knot = self.bank.knot
        since = host_ns - self.anchor_ns - knot.index * SECOND_NS - knot.phase_ns
        return knot.index + since / (SECOND_NS + knot.drift_ns_s)

    def gps_ns_at(self, host_ns: int) -> int:
        """Return GPS ns at a host time by the last knot's line; the train must have its label."""
        knot = self.bank.knot
        since = host_ns - self.anchor_ns - knot.index * SECOND_NS - knot.phase_ns
        whole = ((self.labeller.label or 0) + knot.index) * SECOND_NS
        return whole + round(since * SECOND_NS / (SECOND_NS + knot.drift_ns_s))

    def sigma_at(self, host_ns: int) -> float:
        """Return the sigma (ns) of the line at a host time."""
        return math.sqrt(self.bank.knot.variance_at(self.index_at(host_ns)))

    def offer(self, host_ns: int) -> str | None:
        """Take an edge, or return the reason for refusing it."""
        knot = self.bank.knot
        index = round(self.index_at(host_ns))
        if index <= knot.index:
            return "duplicate" if index == knot.index else "backwards"
        phase = float(host_ns - self.anchor_ns - index * SECOND_NS)
        sigma = math.sqrt(knot.variance_at(index) + self.bank.noise_ns**2)
        floor = FIRST_GATE_FLOOR_NS if self.used < FIRST_EDGES else GATE_FLOOR_NS
        gate = max(floor, GATE_SIGMAS * sigma) * min(float(index - knot.index), GATE_MISSED_MAX)
        if abs(phase - knot.phase_at(index)) > gate:
            self.refused_in_a_row += 1
            return "off_prediction"
        self.refused_in_a_row = 0
        return None if self._take(index, host_ns) else "outlier"

    def _take(self, index: int, host_ns: int) -> bool:
        if not self.bank.update(index, float(host_ns - self.anchor_ns - index * SECOND_NS)):
            return False
        self.used += 1
        self.last_host_ns = host_ns
        self._remember()
        return True

    def amend_last(self, correction_ns: float) -> None:
        """Correct the last edge taken, for a quantisation error reported after its edge."""
        self.bank.amend_last(correction_ns)
        del self._whole[-1], self._index[-1], self._doubt[-1], self._numbers[-KNOT_NUMBERS:]
        self._remember()

    def doubt_all(self) -> None:
        """Mark every knot as doubtful, from the first on."""
        self.doubtful = True
        self._doubt = array("b", bytes([True]) * len(self._doubt))

    def believe(self) -> None:
        """Remove every doubt: the seconds of all knots are known."""
        self.doubtful = False
        self._doubt = array("b", bytes(len(self._doubt)))

    def _remember(self) -> None:
        knot = self.bank.knot
        whole = math.floor(knot.phase_ns)
        self._whole.append(self.anchor_ns + knot.index * SECOND_NS + whole)
        self._index.append(knot.index)
        self._doubt.append(self.doubtful)
        numbers = (knot.phase_ns - whole, knot.drift_ns_s, knot.var_phase, knot.var_cross, knot.var_drift, knot.wander)
        self._numbers.extend(numbers)
        self._numbers.extend(knot.excess)
        self._numbers.append(knot.shrink)
        if not self._keep_history and len(self._whole) > 2 * LIVE_KNOTS:
            del self._whole[:LIVE_KNOTS], self._index[:LIVE_KNOTS], self._doubt[:LIVE_KNOTS]
            del self._numbers[: LIVE_KNOTS * KNOT_NUMBERS]

    @property
    def first_knot_ns(self) -> int:
        """The host time of the first knot remembered."""
        return self._whole[0]

    @property
    def last_knot_ns(self) -> int:
        """The host time of the last knot."""
        return self._whole[-1]

    def knots_between(self, from_ns: int, to_ns: int) -> KnotTable:
        """Return the knots that span host times from … to (one more on both sides)."""
        whole = np.array(self._whole, dtype=np.int64)
        low = max(0, int(np.searchsorted(whole, from_ns, side="right")) - 1)
        high = min(len(whole), int(np.searchsorted(whole, to_ns, side="right")) + 1)
        low = min(low, len(whole) - 1)
        numbers = np.array(self._numbers[low * KNOT_NUMBERS : high * KNOT_NUMBERS], dtype=np.float64)
        return KnotTable(
            whole[low:high],
            np.array(self._index[low:high], dtype=np.int64),
            np.array(self._doubt[low:high], dtype=np.bool_),
            numbers.reshape(-1, KNOT_NUMBERS),
        )


KNOT_NUMBERS = 10  # fraction of a ns, drift, three (co)variances, wander, three excess variances, shrink


def forget_later(edges: deque[int], train: EdgeTrain | None, host_ns: int) -> bool:
    """Return whether an edge before the latest one continues a train; if so, drop the edges after it.

    Those edges did not belong to the train: an edge with a stamp in the future must not stop a clock.
    """
    if train is None or host_ns <= train.last_host_ns or (edges and host_ns == edges[-1]):
        return False
    while edges and edges[-1] >= host_ns:
        edges.pop()
    return True


class KnotTable:
    """Knots as arrays; evaluates the line of knot k at host times."""

    def __init__(self, host_ns: Int64Array, index: Int64Array, doubt: BoolArray, numbers: FloatArray) -> None:
        self.host_ns = host_ns
        self.index = index
        self.doubt = doubt
        self.numbers = numbers

    def seconds_from(self, k: Int64Array, host_ns: Int64Array) -> FloatArray:
        """Return GPS seconds from knot k to the host times, by that knot's drift."""
        fraction, drift = self.numbers[k, 0], self.numbers[k, 1]
        since = (host_ns - self.host_ns[k]).astype(np.float64) - fraction
        return np.asarray(since / (SECOND_NS + drift), dtype=np.float64)

    def variance(self, k: Int64Array, seconds: FloatArray) -> FloatArray:
        """Return the variance (ns²) of the line of knot k, seconds away from it (sign as in `seconds_from`)."""
        xx, xy, yy, wander = self.numbers[k, 2], self.numbers[k, 3], self.numbers[k, 4], self.numbers[k, 5]
        away = np.abs(seconds)
        plain = xx + 2.0 * np.maximum(seconds * xy, 0.0) + away * away * (yy + wander * away / 3.0)
        plain *= 1.0 + (self.numbers[k, 9] - 1.0) * np.minimum(away / SHRINK_HORIZON, 1.0)
        return np.asarray(plain + excess_variances(self.numbers[k, 6:9], away), dtype=np.float64)
