"""Compute an encoder's rate by local least-squares polynomials, for successive pieces of time.

Successive pieces are processed side by side, a column each of small tables, so that several are computed at once. The
result of a piece depends on its own window alone, bit for bit.
"""

from __future__ import annotations

import math
from typing import Any, TypeAlias

import numpy as np

from swath.georef.arrays import FloatArray, Int64Array
from swath.georef.compiled import jit_cached, jit_inline

Tile: TypeAlias = tuple[FloatArray, FloatArray]

PIECE_NS = 50_000  # pieces begin at whole multiples of it, whatever the batches
TIERS = (3, 6, 12, 24)  # pieces to either side of a window: 0.175 to 1.225 ms
REACH = TIERS[-1]
JUMP_RAD = 1.0
ENOUGH, FOR_QUARTIC, FOR_SQUARE = 24, 10, 6  # minimum pulses in a window
SPAN_NS = 260_000  # minimum time between its first and last, for anything but a line
ORDER, LINE = 5, 2  # coefficients of the longest polynomial, and of a line
LANES, TILE = 16, 64  # pieces side by side; pulses of each that are processed at once
SUMS, RIGHT = 14, 9  # rows of sums: of x^0 to x^8, then of y to x^4 y

# Columns of `pieces`: first pulse, train, place in time
FIRST, TRAIN, PLACE = range(3)
# Columns of windows: pulses from and to, the middle of the piece in ns
FROM, TO, MIDDLE = range(3)


@jit_cached
def cut(
    rows: Any,
    time_ns: Int64Array,
    facets: bool,
    pulses: Int64Array,
    pulse_ns: Int64Array,
    angle: FloatArray,
    pieces: Int64Array,
) -> tuple[int, int]:
    """Divide rows into pulses, and pulses into pieces of time; neither a piece nor a window crosses a jump.

    Args:
        rows, time_ns: (n,) `RETURN_DTYPE` in the order of emission; (n,) their GPS times; n > 0.
        facets: whether the channel is a polygon's facet.
        pulses, pulse_ns, angle: (n,) get the first row of each pulse, its time (ns) and reading.
        pieces: (n, 3) gets the pieces.

    Returns:
        Numbers of pulses and of pieces.
    """
    n, m, train = 0, 0, 0
    begins_ns, ends_ns = 0, 0
    last_ns, last_rad, last_id, last_channel = time_ns[0], rows[0].encoder_rad, rows[0].pulse_id, rows[0].channel
    for i in range(len(rows)):
        row, now_ns = rows[i], time_ns[i]
        encoder_rad, channel = row.encoder_rad, row.channel
        broken = n == 0
        if n:
            if now_ns == last_ns and row.pulse_id == last_id:
                continue
            facet = facets and channel != last_channel
            broken = facet or abs(encoder_rad - last_rad) > JUMP_RAD or now_ns < last_ns
        if broken or now_ns < begins_ns or now_ns >= ends_ns:
            place = now_ns // PIECE_NS
            begins_ns, ends_ns = place * PIECE_NS, (place + 1) * PIECE_NS
            train += 1 if broken and m else 0
            pieces[m, FIRST], pieces[m, TRAIN], pieces[m, PLACE] = n, train, place
            m += 1
        pulses[n], pulse_ns[n], angle[n] = i, now_ns, encoder_rad
        last_ns, last_rad, last_id, last_channel = now_ns, encoder_rad, row.pulse_id, channel
        n += 1
    return n, m


@jit_inline
def window_of(pieces: Int64Array, m: int, n: int, piece: int, reach: int) -> tuple[int, int]:
    """Return the range of pulses, from and to, of the pieces at most ``reach`` away in time and of the same train."""
    first, last = piece, piece
    train, place = pieces[piece, TRAIN], pieces[piece, PLACE]
    while first > 0 and pieces[first - 1, TRAIN] == train and place - pieces[first - 1, PLACE] <= reach:
        first -= 1
    while last + 1 < m and pieces[last + 1, TRAIN] == train and pieces[last + 1, PLACE] - place <= reach:
        last += 1
    return pieces[first, FIRST], pieces[last + 1, FIRST] if last + 1 < m else n


@jit_inline
def solve(normal: FloatArray, right: FloatArray, size: int) -> bool:
    """Solve normal equations by Cholesky in place; the solution is in ``right``. False: they are singular."""
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


@jit_inline
def take(
    pulse_ns: Int64Array, angle: FloatArray, windows: Int64Array, scale: FloatArray, begin: int, tile: Tile
) -> int:
    """Copy times and readings from pulse ``begin`` of each window on into the tile, a column each.

    Rows after a window's end are zero.

    Returns:
        The number of filled rows of the tile, which is even.
    """
    x_of, y_of = tile
    rows = 0
    for lane in range(LANES):
        rows = max(rows, min(TILE, windows[lane, TO] - windows[lane, FROM] - begin))
    rows += rows & 1
    for lane in range(LANES):
        first, middle_ns, share = windows[lane, FROM], windows[lane, MIDDLE], scale[lane]
        count = min(rows, max(windows[lane, TO] - first - begin, 0))
        for i in range(count):
            x_of[i, lane] = (pulse_ns[first + begin + i] - middle_ns) * share
            y_of[i, lane] = angle[first + begin + i] - angle[first]
        for i in range(count, rows):
            x_of[i, lane], y_of[i, lane] = 0.0, 0.0
    return rows


@jit_inline
def add_up(tile: Tile, rows: int, sums: FloatArray) -> None:
    """Add sums of x^k, k from 1 to 8, and of x^k y, k from 0 to 4; two rows at a time, one after the other."""
    x_of, y_of = tile
    for i in range(0, rows, 2):
        for lane in range(LANES):
            x, y, u, v = x_of[i, lane], y_of[i, lane], x_of[i + 1, lane], y_of[i + 1, lane]
            x2, u2 = x * x, u * u
            x3, x4, u3, u4 = x2 * x, x2 * x2, u2 * u, u2 * u2
            sums[1, lane] = sums[1, lane] + x + u
            sums[2, lane] = sums[2, lane] + x2 + u2
            sums[3, lane] = sums[3, lane] + x3 + u3
            sums[4, lane] = sums[4, lane] + x4 + u4
            sums[5, lane] = sums[5, lane] + x4 * x + u4 * u
            sums[6, lane] = sums[6, lane] + x4 * x2 + u4 * u2
            sums[7, lane] = sums[7, lane] + x4 * x3 + u4 * u3
            sums[8, lane] = sums[8, lane] + x4 * x4 + u4 * u4
            sums[RIGHT, lane] = sums[RIGHT, lane] + y + v
            sums[RIGHT + 1, lane] = sums[RIGHT + 1, lane] + x * y + u * v
            sums[RIGHT + 2, lane] = sums[RIGHT + 2, lane] + x2 * y + u2 * v
            sums[RIGHT + 3, lane] = sums[RIGHT + 3, lane] + x3 * y + u3 * v
            sums[RIGHT + 4, lane] = sums[RIGHT + 4, lane] + x4 * y + u4 * v


@jit_inline
def sum_up(
    pulse_ns: Int64Array,
    angle: FloatArray,
    windows: Int64Array,
    scale: FloatArray,
    tile: Tile,
    sums: FloatArray,
) -> None:
    """Sum over the windows' pulses, a column each, in (t − middle) · scale and relative to the first reading."""
    longest = 0
    for lane in range(LANES):
        count = windows[lane, TO] - windows[lane, FROM]
        longest = max(longest, count)
        sums[:, lane] = 0.0
        sums[0, lane] = float(count)
    for begin in range(0, longest, TILE):
        add_up(tile, take(pulse_ns, angle, windows, scale, begin, tile), sums)


@jit_inline
def fit(sums: FloatArray, lane: int, size: int, work: FloatArray) -> bool:
    """Fit the polynomial with these sums, in its window's unit, into row 0 of ``work``, with zeros after its end."""
    work[0] = 0.0
    for j in range(size):
        work[0, j] = sums[RIGHT + j, lane]
        for k in range(j + 1):
            work[1 + j, k] = sums[j + k, lane]
    return solve(work[1:], work[0], ORDER) if size == ORDER else solve(work[1:], work[0], size)


@jit_inline
def choose(pulse_ns: Int64Array, pieces: Int64Array, piece: int, steady: bool) -> tuple[int, int, int, int]:
    """Return the window of a piece and the number of coefficients; 0 if a fit is impossible.

    The window is from pulse, to pulse, and the number of pieces to either side.
    """
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
        return first, last, reach, LINE
    return first, last, reach, ORDER if count >= FOR_QUARTIC else 3


@jit_inline
def pulses_of(pieces: Int64Array, piece: int, n: int) -> tuple[int, int]:
    """Return the range of pulses, from and to, of a piece."""
    return pieces[piece, FIRST], pieces[piece + 1, FIRST] if piece + 1 < len(pieces) else n


@jit_inline
def give(work: FloatArray, told: bool, pulse_ns: Any, middle_ns: int, unit_ns: float, slope: Any, bend: Any) -> None:
    """Evaluate rates and accelerations at times by the polynomial in row 0 of ``work``; 0 without a fit."""
    c1, c2, c3, c4 = work[0, 1], 2.0 * work[0, 2], 3.0 * work[0, 3], 4.0 * work[0, 4]
    per_s, per_s2 = 1e9 / unit_ns, 1e18 / (unit_ns * unit_ns)
    for i in range(len(pulse_ns)):
        x = (pulse_ns[i] - middle_ns) / unit_ns
        slope[i] = (c1 + x * (c2 + x * (c3 + x * c4))) * per_s
        bend[i] = (c2 + x * (2.0 * c3 + x * 3.0 * c4)) * per_s2
        if not told:
            slope[i], bend[i] = 0.0, 0.0


@jit_inline
def spread(
    pulses: Int64Array, first: int, last: int, slope: FloatArray, bend: FloatArray, rate: Any, more: Any
) -> None:
    """Copy values of pulses first to last to their rows, of which a pulse may have several."""
    for i in range(first, last):
        for row in range(pulses[i], pulses[i + 1] if i + 1 < len(pulses) else len(rate)):
            rate[row], more[row] = slope[i - first], bend[i - first]


@jit_cached
def rates(
    pulses: Int64Array,
    pulse_ns: Int64Array,
    angle: FloatArray,
    pieces: Int64Array,
    steady: bool,
    first_piece: int,
    last_piece: int,
    rate: FloatArray,
    acceleration: FloatArray,
) -> int:
    """Compute dθ/dt and d²θ/dt² of the rows of some pieces.

    Args:
        pulses, pulse_ns, angle: (n,) of `cut`.
        pieces: (m, 3) of `cut`.
        steady: a rotating shaft: a line, and no acceleration; else a polynomial of degree 4, or less if pulses are few.
        first_piece, last_piece: of those wanted.
        rate, acceleration: of all rows, get rad/s and rad/s²; 0 without a fit.

    Returns:
        The number of pulses without a fit.
    """
    n = len(pulses)
    tile, sums, work = (np.empty((TILE, LANES)), np.empty((TILE, LANES))), np.empty((SUMS, LANES)), np.zeros((6, ORDER))
    windows, unit_ns, size = np.zeros((LANES, 3), np.int64), np.ones(LANES), np.zeros(LANES, np.int64)
    slope, bend = np.empty(n), np.empty(n)
    lonely = 0
    for begin in range(first_piece, last_piece, LANES):
        count = min(LANES, last_piece - begin)
        for lane in range(count):
            first, last, reach, size[lane] = choose(pulse_ns, pieces, begin + lane, steady)
            windows[lane, FROM], windows[lane, TO] = first, last
            windows[lane, MIDDLE] = pieces[begin + lane, PLACE] * PIECE_NS + PIECE_NS // 2
            unit_ns[lane] = reach * float(PIECE_NS)
        sum_up(pulse_ns, angle, windows, 1.0 / unit_ns, tile, sums)
        for lane in range(count):
            told = size[lane] > 0 and fit(sums, lane, size[lane], work)
            first, last = pulses_of(pieces, begin + lane, n)
            lonely += 0 if told else last - first
            part_ns, middle_ns = pulse_ns[first:last], windows[lane, MIDDLE]
            rows = slice(pulses[first], pulses[last] if last < n else len(rate))
            if rows.stop - rows.start == last - first:
                give(work, told, part_ns, middle_ns, unit_ns[lane], rate[rows], acceleration[rows])
            else:
                give(work, told, part_ns, middle_ns, unit_ns[lane], slope, bend)
                spread(pulses, first, last, slope, bend, rate, acceleration)
    return lonely
