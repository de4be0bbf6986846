"""Strips: the stretches of a flight that are delivered, cut where the aircraft turns and where the laser is silent.

Times are int64 nanoseconds of one scale, the caller's; spans are half open, [start, end).
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from swath.georef.arrays import FloatArray
from swath.georef.records import Int64Array
from swath.georef.timescales.gps_time import SECOND_NS

LATEST_NS = 1 << 62  # of GPS time, in 2126: differences and sums of two stay within 64 bits
MAX_STRIPS = 65_535  # a point source id has 16 bits
CSV_COLUMNS = ("start_gps_ns", "end_gps_ns")
Span = tuple[int, int]


class StripError(ValueError):
    """Strips that cannot be, or a file of them that cannot be read; one line."""


@dataclass(frozen=True, slots=True)
class StripRules:
    """When an aircraft turns, and what is long enough for a strip.

    Attributes:
        turn_rate_radps, bank_rad: beyond either, as means over window_s, it turns. A standard turn is 3°/s.
        window_s: over which gusts are averaged.
        min_turn_s: less is no turn.
        min_strip_s: less is no strip.
        laser_gap_s: so long without data, and the laser was off.
    """

    turn_rate_radps: float = np.radians(1.0)
    bank_rad: float = np.radians(10.0)
    window_s: float = 4.0
    min_turn_s: float = 2.0
    min_strip_s: float = 5.0
    laser_gap_s: float = 1.0


@dataclass(frozen=True, slots=True)
class Segment:
    """A piece of the time; all of them together are the whole, and none overlaps another.

    Attributes:
        strip: its number from 1 in the order of time; 0: what lies between strips.
    """

    strip: int
    start_ns: int
    end_ns: int


def straight_spans(
    time_ns: Int64Array,
    heading_rad: FloatArray,
    roll_rad: FloatArray,
    rules: StripRules | None = None,
    unknown: Sequence[Span] = (),
) -> list[Span]:
    """Return where the aircraft does not turn: spans of the times (n,), with heading and roll (n,).

    Where nobody knows, it is taken not to: what is wanted there and cannot be had is then seen to be missing.
    """
    rules = rules or StripRules()
    if len(time_ns) < 2:
        return sorted(unknown)
    seconds = (time_ns - time_ns[0]) / SECOND_NS
    rate = _windowed(seconds, np.unwrap(heading_rad), rules.window_s)
    bank = _windowed(seconds, _integral(seconds, roll_rad), rules.window_s)
    turning = (np.abs(rate) > rules.turn_rate_radps) | (np.abs(bank) > rules.bank_rad)
    straight: list[Span] = []
    for start, end in _runs(~turning):
        straight.append((int(time_ns[start]), int(time_ns[end - 1]) + 1))
    return _joined(sorted([*straight, *unknown]), round(rules.min_turn_s * SECOND_NS))


def _windowed(seconds: FloatArray, integral: FloatArray, window_s: float) -> FloatArray:
    """Return mean over a window about each time of what has this integral; at the ends over what there is of the
    window.
    """
    before = np.maximum(seconds - window_s / 2, seconds[0])
    after = np.minimum(seconds + window_s / 2, seconds[-1])
    mean: FloatArray = (np.interp(after, seconds, integral) - np.interp(before, seconds, integral)) / (after - before)
    return mean


def _integral(seconds: FloatArray, values: FloatArray) -> FloatArray:
    total = np.zeros(len(values))
    np.cumsum(np.diff(seconds) * (values[1:] + values[:-1]) / 2, out=total[1:])
    return total


def _runs(mask: NDArray[np.bool_]) -> list[tuple[int, int]]:
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


def _joined(spans: Sequence[Span], gap_ns: int) -> list[Span]:
    """Return spans in order, those that are less than a gap apart made one."""
    joined: list[Span] = []
    for start, end in spans:
        if joined and start - joined[-1][1] < gap_ns:
            joined[-1] = (joined[-1][0], max(end, joined[-1][1]))
        else:
            joined.append((start, end))
    return joined


def laser_spans(first_ns: Int64Array, last_ns: Int64Array, rules: StripRules | None = None) -> list[Span]:
    """Return where the laser was on, from the first and last times (n,) of pieces of its data, in any order."""
    order = np.argsort(first_ns, kind="stable")
    pieces = [(int(first_ns[i]), int(last_ns[i]) + 1) for i in order]
    return _joined(pieces, round((rules or StripRules()).laser_gap_s * SECOND_NS))


def common(one: Sequence[Span], other: Sequence[Span]) -> list[Span]:
    """Return what lies in both, each in order and without overlaps."""
    both = [(max(a, c), min(b, d)) for a, b in one for c, d in other if a < d and c < b]
    return sorted(both)


def cut(straight: Sequence[Span], laser: Sequence[Span], rules: StripRules | None = None) -> list[Span]:
    """Return strips: straight flight with the laser on, as long as a strip must be at least."""
    shortest_ns = round((rules or StripRules()).min_strip_s * SECOND_NS)
    return [(start, end) for start, end in common(straight, laser) if end - start >= shortest_ns]


def segments(strips: Sequence[Span], first_ns: int, end_ns: int, *, first_number: int = 1) -> list[Segment]:
    """Return the span from first to end, tiled without gaps: strips as they are numbered, and what lies between.

    A strip keeps its number where only a part of it lies within; one that lies outside gives no segment.

    Raises:
        StripError: more strips than a file's field can number.
    """
    tiles: list[Segment] = []
    at = first_ns
    for number, (start, end) in enumerate(strips, start=first_number):
        if number > MAX_STRIPS:
            raise StripError(f"more than {MAX_STRIPS} strips, which is what a point source id can number")
        start, end = max(start, at), min(end, end_ns)
        if start >= end:
            continue
        if start > at:
            tiles.append(Segment(0, at, start))
        tiles.append(Segment(number, start, end))
        at = end
    if at < end_ns:
        tiles.append(Segment(0, at, end_ns))
    return tiles


def read_strips(text: str, name: str) -> list[Span]:
    """Return strips from a CSV file with the columns start_gps_ns and end_gps_ns (others are passed over), in order of
    time.

    Raises:
        StripError: a column is missing, a value is no integer, a strip has no length, or two overlap.
    """
    rows = csv.DictReader(io.StringIO(text), skipinitialspace=True)
    try:
        strips = sorted(_spans(rows, name))
    except csv.Error as error:
        raise StripError(f"{name}: line {rows.reader.line_num}: no CSV: {error}") from None
    for (_, end), (start, _) in pairwise(strips):
        if start < end:
            raise StripError(f"{name}: the strip that begins at {start} overlaps the one before, which ends at {end}")
    if not strips:
        raise StripError(f"{name}: has no strips")
    return strips


def _spans(rows: csv.DictReader[str], name: str) -> Iterator[Span]:
    missing = [column for column in CSV_COLUMNS if column not in (rows.fieldnames or [])]
    if missing:
        raise StripError(f"{name}: no column {missing[0]}; want a first line {','.join(CSV_COLUMNS)}")
    for row in rows:
        try:
            start, end = (int(row[column]) for column in CSV_COLUMNS)
        except (TypeError, ValueError):
            raise StripError(f"{name}: line {rows.line_num}: want two integers, GPS nanoseconds") from None
        if end <= start:
            raise StripError(f"{name}: line {rows.line_num}: the strip ends at {end}, before it begins")
        if not 0 <= start < end <= LATEST_NS:
            raise StripError(
                f"{name}: line {rows.line_num}: {start} to {end} is beyond all GPS time; want nanoseconds since 1980"
            )
        yield start, end
