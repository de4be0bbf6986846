"""Compute dθ/dt and d²θ/dt² of encoder readings, for encoder latency and torsion (CONVENTIONS, the beam; FORMULAS 9).

Readings are whole counts, exist for returns only, and repeat if a pulse has several. Therefore each piece of 50 µs gets
a polynomial by least squares over a window around it: 0.35 ms, or as much more as 24 pulses over 0.26 ms need, 2.45 ms
at most. For a ±30° sine at 50 Hz the rate is then good to 0.5 rad/s with an encoder of 17 bits and 100 000 pulses a
second, that is 5e-7 rad for a microsecond of latency, a hundredth of a count.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from swath.georef.arrays import FloatArray, Int64Array, StructArray
from swath.georef.records import RETURN_DTYPE
from swath.georef.return_rows import concatenate, plain, words
from swath.georef.scanner.kernels.motion import PLACE, REACH, TRAIN, cut, rates

Moving = tuple[StructArray, Int64Array, FloatArray, FloatArray]


class TellsMotion(Protocol):
    """A source of the encoder's motion at its readings."""

    def motion(self, rows: StructArray, time_ns: Int64Array) -> tuple[FloatArray, FloatArray]:
        """Return rate and acceleration (n,) of the readings, rad/s, rad/s²."""


class NoMotion:
    """Stands for a head that gives a direction by two angles: it has no encoder whose motion could be a parameter."""

    def feed(self, rows: StructArray, time_ns: Int64Array) -> Moving:
        """Return the rows with rates and accelerations of 0."""
        return rows, time_ns, np.zeros(len(rows)), np.zeros(len(rows))

    def flush(self) -> Moving:
        """Return no rows."""
        return np.zeros(0, RETURN_DTYPE), np.zeros(0, np.int64), np.zeros(0), np.zeros(0)


class EncoderMotion:
    """Computes rate and acceleration for the rows of one scanner, as they come.

    It holds back the last 1.2 ms. The output does not depend on the division of rows into batches.

    Args:
        steady: whether the shaft turns evenly (polygon, monogon, nutating mirror, prisms, spinning head): the rate is
            then that of a straight line, the acceleration 0. False: an oscillating mirror.
        facets: whether the rows' channel is a polygon's facet: at its edges, as at every step of more than a radian,
            the reading jumps, and no window crosses a jump.

    Attributes:
        lonely: pulses too far from others to determine their rate, which is then 0.
    """

    def __init__(self, *, steady: bool = False, facets: bool = False) -> None:
        self.lonely = 0
        self._steady, self._facets = steady, facets
        self._rows: StructArray = np.zeros(0, RETURN_DTYPE)
        self._time_ns: Int64Array = np.zeros(0, np.int64)
        self._given = 0  # number of held rows that are kept only as neighbours of later ones

    def feed(self, rows: StructArray, time_ns: Int64Array) -> Moving:
        """Take rows, and return those whose neighbourhood is complete now.

        Args:
            rows: (n,) `RETURN_DTYPE`, in the order of emission.
            time_ns: (n,) their GPS times.

        Returns:
            rows, time_ns: (m,) in the same order; rate: rad/s; acceleration: rad/s².
        """
        self._rows = concatenate([self._rows, rows], rows)
        self._time_ns = concatenate([self._time_ns, time_ns], time_ns)
        return self._give(everything=False)

    def flush(self) -> Moving:
        """Return the rows held back, when no more will come."""
        given = self._give(everything=True)
        self._rows, self._time_ns, self._given = self._rows[:0], self._time_ns[:0], 0
        return given

    def _give(self, *, everything: bool) -> Moving:
        n = len(self._rows)
        if not n:
            return self._rows, self._time_ns, np.zeros(0), np.zeros(0)
        pulses, pulse_ns, angle = np.empty(n, np.int64), np.empty(n, np.int64), np.empty(n)
        pieces = np.empty((n, 3), np.int64)
        count, parts = cut(plain(self._rows), self._time_ns, self._facets, pulses, pulse_ns, angle, pieces)
        pulses, pulse_ns, angle, pieces = pulses[:count], pulse_ns[:count], angle[:count], pieces[:parts]
        starts = np.append(pulses[pieces[:, 0]], n)  # first row of each piece
        first = int(np.searchsorted(starts, self._given, side="right")) - 1
        done = parts if everything else self._complete(pieces)
        if done <= first:
            return self._rows[:0], self._time_ns[:0], np.zeros(0), np.zeros(0)
        rate, acceleration = np.empty(n), np.empty(n)
        self.lonely += rates(pulses, pulse_ns, angle, pieces, self._steady, first, done, rate, acceleration)
        out = slice(self._given, int(starts[done]))
        given = self._rows[out], self._time_ns[out], rate[out], acceleration[out]
        if not everything:
            self._forget(pieces, starts, done)
        return given

    @staticmethod
    def _complete(pieces: Int64Array) -> int:
        """Return the number of pieces with complete neighbourhoods: their train went on far enough, or ended."""
        last = pieces[-1]
        open_pieces = (pieces[:, TRAIN] == last[TRAIN]) & (last[PLACE] - pieces[:, PLACE] <= REACH)
        return int(np.argmax(open_pieces))

    def _forget(self, pieces: Int64Array, starts: Int64Array, done: int) -> None:
        """Drop rows that later pieces do not need; these need their train, as far back as a window reaches."""
        next_piece = pieces[done]
        needed = (pieces[:, TRAIN] == next_piece[TRAIN]) & (next_piece[PLACE] - pieces[:, PLACE] <= REACH)
        keep = int(starts[int(np.argmax(needed))])
        self._rows = words(self._rows[keep:]).copy().view(self._rows.dtype).reshape(-1)
        self._time_ns = self._time_ns[keep:].copy()
        self._given = int(starts[done]) - keep
