"""Estimate the error of made-up samples from the flight's own unbroken samples.

`Sampler` bridges a gap of n samples by a straight line between the rates beside it. The same is done, as samples come,
over unbroken ones: n of them are left out, and the line's value for their sum is compared with the true sum. The mean
square of the difference, over the last seconds and axis by axis, is the variance that a gap of n samples adds to
velocity and attitude. It includes the motion in between, and once more the noise of the two samples at the ends of the
line. It is computed for n = 1, 2, 4 … 64; in between it follows a power of n, beyond it grows with the square.

Only samples before a gap are used, so that a filter in flight and one that reads the log afterwards give the same
result.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from swath.georef.arrays import FloatArray, Int64Array
from swath.georef.compiled import jit_cached, jit_inline
from swath.georef.navigation.filter.strapdown import Samples

UNKNOWN_RATE_RADPS, UNKNOWN_FORCE_MPS2 = 0.05, 1.0  # error of a made-up sample before any is known
LEVELS = 7
RING = 128  # samples remembered: more than the longest run that is left out, and its neighbours
LASTS_S = 5.0  # e-folding time of the mean squares, so that they follow the present motion, not the whole flight's
ENOUGH = 20.0  # number of left-out runs from which on their mean square is used
PRIMING_S = 60.0  # length of the start of a whole flight that serves to judge gaps in its first seconds
GAP = 1.5  # intervals: a sample that comes later leaves a gap

# Columns of `Bridges.ring`: cumulative sums of angle and velocity, rates and forces, cumulative time
SUM, RATE, TIME, COLUMNS = 0, 6, 12, 13
# Elements of `Bridges.counters`: successive unbroken samples, successive made-up ones, end of the last
WHOLE, RUN, END_NS = 0, 1, 2


class Bridges(NamedTuple):
    """The knowledge about made-up samples; it changes as samples come.

    Attributes:
        ring: (RING, COLUMNS) the latest unbroken samples.
        counters: (3,) elements WHOLE, RUN and END_NS.
        square: (LEVELS, 6) mean squares of the errors of a run's sum, angles (rad²) then velocities (m²/s²).
        seen: (LEVELS,) number of runs behind these.
        spent: (7,) variance that the present run has added, and its length in seconds.
    """

    ring: FloatArray
    counters: Int64Array
    square: FloatArray
    seen: FloatArray
    spent: FloatArray


def new_bridges() -> Bridges:
    """Return an empty memory."""
    return Bridges(
        np.zeros((RING, COLUMNS)), np.zeros(3, np.int64), np.zeros((LEVELS, 6)), np.zeros(LEVELS), np.zeros(7)
    )


def primed_bridges(samples: Samples) -> Bridges:
    """Return a memory of the first minute of a flight whose samples begin with these."""
    bridges = new_bridges()
    if len(samples.time_ns):
        last = int(np.searchsorted(samples.time_ns, samples.time_ns[0] + round(1e9 * PRIMING_S)))
        made_up_variance(Samples._make(column[:last] for column in samples), bridges)
    fresh = new_bridges()
    return fresh._replace(square=bridges.square, seen=bridges.seen)


@jit_inline
def _leave_out(bridges: Bridges, newest: int, span_s: float) -> None:
    """Bridge over runs that end before the newest sample, and record the errors."""
    ring = bridges.ring
    after = ring[newest % RING]
    for level in range(LEVELS):
        run = 1 << level
        if newest < run + 2:
            return
        before, last = ring[(newest - run - 1) % RING], ring[(newest - 1) % RING]
        half_s = 0.5 * (last[TIME] - before[TIME])
        bridges.seen[level] += 1.0
        weight = max(1.0 / bridges.seen[level], span_s / LASTS_S)
        for axis in range(6):
            true = last[SUM + axis] - before[SUM + axis]
            off = true - half_s * (before[RATE + axis] + after[RATE + axis])
            bridges.square[level, axis] += weight * (off * off - bridges.square[level, axis])


@jit_inline
def _variance_of(bridges: Bridges, run: int, axis: int, long_s: float) -> float:
    """Return the variance of the sum of a run of made-up samples."""
    known = 0
    while known < LEVELS and bridges.seen[known] >= ENOUGH:
        known += 1
    if known == 0:
        unknown = UNKNOWN_RATE_RADPS if axis < 3 else UNKNOWN_FORCE_MPS2
        return float((unknown * long_s) ** 2)
    below = min(int(math.log2(run) + 1e-9), known - 1)
    over = run / float(1 << below)
    here = bridges.square[below, axis]
    if below + 1 >= known:
        return float(here * over * over)
    there = bridges.square[below + 1, axis]
    if not (here > 0.0 and there > 0.0):
        return float(max(here, there))
    return float(here * over ** math.log2(there / here))


@jit_cached
def made_up_variance(samples: Samples, bridges: Bridges) -> FloatArray:
    """Return (n, 6) variances that made-up samples add: rad², m²/s² by axis of the body; 0 where a sample is real.

    Args:
        samples: the next n of a stream, in pieces of any size.
        bridges: of the stream, changed.
    """
    count, spent, n = bridges.counters, bridges.spent, len(samples.time_ns)
    out = np.zeros((n, 6))
    for i in range(n):
        span_s = samples.interval_s[i]
        if 1e-9 * (samples.time_ns[i] - count[END_NS]) > GAP * span_s:
            count[WHOLE] = 0
        count[END_NS] = samples.time_ns[i]
        if samples.bridged[i]:
            count[WHOLE] = 0
            count[RUN] += 1
            spent[6] += span_s
            for axis in range(6):
                grown = max(_variance_of(bridges, count[RUN], axis, spent[6]), spent[axis])
                out[i, axis] = grown - spent[axis]
                spent[axis] = grown
            continue
        count[RUN] = 0
        spent[:] = 0.0
        before, now = bridges.ring[count[WHOLE] % RING], bridges.ring[(count[WHOLE] + 1) % RING]
        first = count[WHOLE] == 0
        count[WHOLE] += 1
        for axis in range(6):
            value = samples.angle_b[i, axis] if axis < 3 else samples.velocity_b[i, axis - 3]
            now[SUM + axis] = value if first else before[SUM + axis] + value
            now[RATE + axis] = value / span_s if span_s > 0.0 else 0.0
        now[TIME] = span_s if first else before[TIME] + span_s
        _leave_out(bridges, count[WHOLE], span_s)
    return out
