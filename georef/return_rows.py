"""Copy and inspect waiting returns as 64-bit numbers, since NumPy copies a structure with gaps field by field.

Rows are `RETURN_DTYPE`, or `AIMED_RETURN_DTYPE` for heads that give a direction by two angles. Compiled loops are made
for the first only: `plain` and `elevations` divide the second.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from swath.georef.arrays import BoolArray, FloatArray, Int64Array, StructArray, UInt64Array
from swath.georef.records import AIMED_RETURN_DTYPE, RETURN_DTYPE

WORDS = RETURN_DTYPE.itemsize // 8
_OFFSETS = {name: int(place[1]) for name, place in (RETURN_DTYPE.fields or {}).items()}


def words(rows: StructArray) -> UInt64Array:
    """Return rows as numbers (n, `WORDS` or more), whose copies are ten times as fast as those of a structure with
    gaps.
    """
    return np.ascontiguousarray(rows).view(np.uint64).reshape(-1, rows.dtype.itemsize // 8)


def plain(rows: StructArray) -> StructArray:
    """Return rows as `RETURN_DTYPE`: themselves, or a copy without their elevations."""
    if rows.dtype != AIMED_RETURN_DTYPE:
        return rows
    return words(rows)[:, :WORDS].copy().view(RETURN_DTYPE).reshape(-1)


def elevations(rows: StructArray) -> FloatArray:
    """Return the elevations (n,) of rows, radians; (0,) if they have none."""
    if rows.dtype != AIMED_RETURN_DTYPE:
        return np.zeros(0)
    return np.ascontiguousarray(rows["elevation_rad"], dtype=np.float64)


def any_has(rows: StructArray, name: str, bits: int) -> bool:
    """Return whether any row has all these bits set in a field of its last word."""
    offset = _OFFSETS[name]
    word = bits << 8 * (offset % 8)
    if not len(rows) or int(np.bitwise_or.reduce(words(rows)[:, offset // 8])) & word != word:
        return False
    return bool((rows[name] & bits == bits).any())


def take(rows: StructArray, mask: BoolArray) -> StructArray:
    """Return the rows of a mask."""
    return words(rows).take(np.flatnonzero(mask), axis=0).view(rows.dtype).reshape(-1)


def concatenate(pieces: list[NDArray[Any]], like: NDArray[Any]) -> NDArray[Any]:
    """Join pieces in order; a single piece is returned without a copy, no pieces give an empty array like ``like``."""
    pieces = [piece for piece in pieces if len(piece)]
    if not pieces:
        return like[:0]
    if len(pieces) == 1:
        return pieces[0]
    if pieces[0].dtype not in (RETURN_DTYPE, AIMED_RETURN_DTYPE):
        return np.concatenate(pieces)
    return np.concatenate([words(piece) for piece in pieces]).view(pieces[0].dtype).reshape(-1)


def compact(rows: StructArray) -> StructArray:
    """Return rows that may wait long, copied if they are views of a larger array.

    Parsers allocate room for every slot, which the copy releases.
    """
    spare = isinstance(rows.base, np.ndarray) and rows.base.nbytes > rows.nbytes + rows.nbytes // 4
    return words(rows).copy().view(rows.dtype).reshape(-1) if spare else rows


@dataclass(slots=True)
class WaitingReturns:
    """Returns that began to wait at one tick; their times if known."""

    rows: StructArray
    since_ns: int
    time_ns: Int64Array


def split_at(held: WaitingReturns, mask: BoolArray) -> tuple[list[WaitingReturns], list[WaitingReturns]]:
    """Split into the rows of the mask and the others, each in order; contiguous parts are not copied."""
    count = int(np.count_nonzero(mask))
    if count == len(mask):
        return [held], []
    if not count:
        return [], [held]
    if mask[:count].all():
        parts = [(held.rows[part], held.time_ns[part]) for part in (slice(count), slice(count, None))]
    else:
        parts = [(take(held.rows, part), held.time_ns[part]) for part in (mask, ~mask)]
    one, other = (WaitingReturns(rows, held.since_ns, time_ns) for rows, time_ns in parts)
    return [one], [other]


def after(queue: deque[WaitingReturns], max_rows: int) -> list[WaitingReturns]:
    """Remove the oldest entries from the queue until at most this many rows are left, and return them."""
    rows, oldest = sum(len(held.rows) for held in queue), []
    while rows > max_rows:
        oldest.append(queue.popleft())
        rows -= len(oldest[-1].rows)
    return oldest
