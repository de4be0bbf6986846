"""How fast an encoder turns: local polynomials by least squares, piece by piece of the time."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from georef.compiled import kept, kernel

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

PIECE_NS = 50_000  # pieces begin at whole multiples of it, whatever the batches
TIERS = (3, 6, 12, 24)  # pieces to either side of a window: 0.175 to 1.225 ms
REACH = TIERS[-1]
JUMP_RAD = 1.0
ENOUGH, FOR_QUARTIC, FOR_SQUARE = 24, 10, 6  # pulses in a window
SPAN_NS = 260_000  # between its first and last, for anything but a line
ORDER = 5

# Columns of `pieces`: first pulse, train, place in time
FIRST, TRAIN, PLACE = range(3)


@kept
def cut(
    rows: Any,
    time_ns: IntArray,
    facets: bool,
    pulses: IntArray,
    pulse_ns: IntArray,
    angle: FloatArray,
    pieces: IntArray,
) -> tuple[int, int]:
    """Rows to pulses, and pulses to pieces of time; a piece, and a window, never crosses a jump.

    Args:
        rows: (n,) `RETURN_DTYPE` in the order of emission; time_ns: (n,) their GPS times; n > 0.
        facets: the channel is a polygon's facet.
        pulses, pulse_ns, angle: (n,) get the first row of each pulse, its time (ns) and reading.
        pieces: (n, 3) gets the pieces.

    Returns:
        Numbers of pulses and of pieces.
    """
    n, m = 0, 0
    before = rows[0]
    begins_ns, ends_ns = 0, 0
    for i in range(len(rows)):
        row, now_ns = rows[i], time_ns[i]
        broken = n == 0
        if n:
            if now_ns == pulse_ns[n - 1] and row.pulse_id == before.pulse_id:
                continue
            facet = facets and row.channel != before.channel
            broken = facet or abs(row.encoder_rad - angle[n - 1]) > JUMP_RAD or now_ns < pulse_ns[n - 1]
        if broken or now_ns < begins_ns or now_ns >= ends_ns:
            place = now_ns // PIECE_NS
            begins_ns, ends_ns = place * PIECE_NS, (place + 1) * PIECE_NS
            pieces[m, FIRST], pieces[m, PLACE] = n, place
            pieces[m, TRAIN] = 0 if m == 0 else pieces[m - 1, TRAIN] + (1 if broken else 0)
            m += 1
        pulses[n], pulse_ns[n], angle[n] = i, now_ns, row.encoder_rad
        before = row
        n += 1
    return n, m


@kernel
def window_of(pieces: IntArray, m: int, n: int, piece: int, reach: int) -> tuple[int, int]:
    """Pulses from, to of the pieces at most ``reach`` away in time, of the same train."""
    first, last = piece, piece
    train, place = pieces[piece, TRAIN], pieces[piece, PLACE]
    while first > 0 and pieces[first - 1, TRAIN] == train and place - pieces[first - 1, PLACE] <= reach:
        first -= 1
    while last + 1 < m and pieces[last + 1, TRAIN] == train and pieces[last + 1, PLACE] - place <= reach:
        last += 1
    return pieces[first, FIRST], pieces[last + 1, FIRST] if last + 1 < m else n


@kernel
def solve(normal: FloatArray, right: FloatArray, size: int) -> bool:
    """Cholesky in place; the solution in ``right``. False: the points do not tell."""
    for j in range(size):
        diagonal = normal[j, j]
        for k in range(j):
            diagonal -= normal[j, k] * normal[j, k]
        if not diagonal > 1e-12 * normal[0, 0]:
            return False
        root = math.sqrt(diagonal)
        normal[j, j] = root
        for i in range(j + 1, size):
            value = normal[i, j]
            for k in range(j):
                value -= normal[i, k] * normal[j, k]
            normal[i, j] = value / root
    for i in range(size):
        for k in range(i):
            right[i] -= normal[i, k] * right[k]
        right[i] /= normal[i, i]
    for i in range(size - 1, -1, -1):
        for k in range(i + 1, size):
            right[i] -= normal[k, i] * right[k]
        right[i] /= normal[i, i]
    return True


@kernel
def add_up(
    pulse_ns: IntArray, angle: FloatArray, first: int, last: int, middle_ns: int, unit_ns: float, work: FloatArray
) -> None:
    """Sums of x^k into row 1 of ``work`` and of x^k y into row 0; written out, which makes it three times as fast."""
    origin, share = angle[first], 1.0 / unit_ns
    s1 = s2 = s3 = s4 = s5 = s6 = s7 = s8 = r0 = r1 = r2 = r3 = r4 = 0.0
    for i in range(first, last):
        x, y = (pulse_ns[i] - middle_ns) * share, angle[i] - origin
        x2 = x * x
        x3, x4 = x2 * x, x2 * x2
        s1, s2, s3, s4 = s1 + x, s2 + x2, s3 + x3, s4 + x4
        s5, s6, s7, s8 = s5 + x4 * x, s6 + x4 * x2, s7 + x4 * x3, s8 + x4 * x4
        r0, r1, r2, r3, r4 = r0 + y, r1 + x * y, r2 + x2 * y, r3 + x3 * y, r4 + x4 * y
    work[0, 0], work[0, 1], work[0, 2], work[0, 3], work[0, 4] = r0, r1, r2, r3, r4
    work[1, 0], work[1, 1], work[1, 2], work[1, 3], work[1, 4] = float(last - first), s1, s2, s3, s4
    work[1, 5], work[1, 6], work[1, 7], work[1, 8] = s5, s6, s7, s8


@kernel
def fit(
    pulse_ns: IntArray,
    angle: FloatArray,
    window: tuple[int, int],
    middle_ns: int,
    unit_ns: float,
    work: FloatArray,
    size: int,
) -> bool:
    """Coefficients of the polynomial through a window's pulses, in (t − middle) / unit, into row 0 of ``work``."""
    add_up(pulse_ns, angle, window[0], window[1], middle_ns, unit_ns, work)
    for j in range(size):
        for k in range(size):
            work[2 + j, k] = work[1, j + k]
    return solve(work[2:], work[0], size)


@kernel
def choose(pulse_ns: IntArray, pieces: IntArray, piece: int, steady: bool) -> tuple[int, int, int, int]:
    """Window of a piece, as from pulse, to pulse, how many pieces to either side; number of coefficients, 0: none."""
    first, last, reach, wide = 0, 0, 0, False
    for reach in TIERS:
        first, last = window_of(pieces, len(pieces), len(pulse_ns), piece, reach)
        wide = pulse_ns[last - 1] - pulse_ns[first] >= SPAN_NS
        if wide and last - first >= ENOUGH:
            break
    count = last - first
    if count < 2:
        return first, last, reach, 0
    if steady or not wide or count < FOR_SQUARE:
        return first, last, reach, 2
    return first, last, reach, ORDER if count >= FOR_QUARTIC else 3


@kept
def rates(
    pulses: IntArray,
    pulse_ns: IntArray,
    angle: FloatArray,
    pieces: IntArray,
    steady: bool,
    first_piece: int,
    last_piece: int,
    rate: FloatArray,
    acceleration: FloatArray,
) -> int:
    """dθ/dt and d²θ/dt² of the rows of some pieces.

    Args:
        pulses, pulse_ns, angle: (n,) of `cut`; pieces: (m, 3).
        steady: a turning shaft: a line, and no acceleration; else a polynomial of degree 4, less where pulses are few.
        first_piece, last_piece: of those wanted.
        rate, acceleration: of all rows, get rad/s and rad/s²; 0 where nothing tells.

    Returns:
        How many pulses nothing tells about.
    """
    n, m = len(pulses), len(pieces)
    work = np.zeros((2 + ORDER, 2 * ORDER))
    lonely = 0
    for piece in range(first_piece, last_piece):
        middle_ns = pieces[piece, PLACE] * PIECE_NS + PIECE_NS // 2
        first, last, reach, size = choose(pulse_ns, pieces, piece, steady)
        unit_ns = reach * float(PIECE_NS)
        told = size > 0 and fit(pulse_ns, angle, (first, last), middle_ns, unit_ns, work, size)
        work[0, size:] = 0.0
        c1, c2, c3, c4 = work[0, 1], 2.0 * work[0, 2], 3.0 * work[0, 3], 4.0 * work[0, 4]
        end = pieces[piece + 1, FIRST] if piece + 1 < m else n
        for i in range(pieces[piece, FIRST], end):
            slope, bend = 0.0, 0.0
            if told:
                x = (pulse_ns[i] - middle_ns) / unit_ns
                slope = (c1 + x * (c2 + x * (c3 + x * c4))) * (1e9 / unit_ns)
                bend = (c2 + x * (2.0 * c3 + x * 3.0 * c4)) * (1e18 / (unit_ns * unit_ns))
            else:
                lonely += 1
            for row in range(pulses[i], pulses[i + 1] if i + 1 < n else len(rate)):
                rate[row], acceleration[row] = slope, bend
    return lonely
