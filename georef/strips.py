"""Strips: the stretches of a flight that are delivered, cut where the aircraft turns and where the laser is off.

Times are int64 nanoseconds on one scale of the caller's choice; spans are half open, [start, end).
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from swath.georef.arrays import BoolArray, FloatArray, Int64Array
from swath.georef.timescales.gps_time import SECOND_NS

LATEST_NS = 1 << 62  # of GPS time, in 2126: differences and sums of two stay within 64 bits
MAX_STRIPS = 65_535  # a point source id has 16 bits
CSV_COLUMNS = ("start_gps_ns", "end_gps_ns")
Span = tuple[int, int]


class StripError(ValueError):
    """Raised for impossible strips, or an unreadable file of strips; one line."""


@dataclass(frozen=True, slots=True)
class StripRules:
    """Limits that decide when an aircraft turns, and what is long enough for a strip.

    Attributes:
        turn_rate_radps, bank_rad: the aircraft turns if the mean over window_s of either is exceeded. A standard turn
            is 3°/s.
        window_s: time over which gusts are averaged.
        min_turn_s: minimum turn duration; shorter turns are ignored.
        min_strip_s: minimum strip duration; shorter stretches are ignored.
        laser_gap_s: time without data after which the laser counts as off.
    """

    turn_rate_radps: float = np.radians(1.0)
    bank_rad: float = np.radians(10.0)
    window_s: float = 4.0
    min_turn_s: float = 2.0
    min_strip_s: float = 5.0
    laser_gap_s: float = 1.0


@dataclass(frozen=True, slots=True)
class Segment:
    """A piece of the time span; all segments together cover it, without overlaps.

    Attributes:
        strip: its number from 1 in the order of time; 0: between strips.
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
    """Return spans of the times (n,) in which the aircraft does not turn, from heading and roll (n,).

    Spans without knowledge, ``unknown``, count as straight: missing data then become visible.
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
    """Return means over a window about each time, from the integral; at the ends over the existing part of it."""
    before = np.maximum(seconds - window_s / 2, seconds[0])
    after = np.minimum(seconds + window_s / 2, seconds[-1])
    mean: FloatArray = (np.interp(after, seconds, integral) - np.interp(before, seconds, integral)) / (after - before)
    return mean


def _integral(seconds: FloatArray, values: FloatArray) -> FloatArray:
    total = np.zeros(len(values))
    np.cumsum(np.diff(seconds) * (values[1:] + values[:-1]) / 2, out=total[1:])
    return total


def _runs(mask: BoolArray) -> list[tuple[int, int]]:
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


def _joined(spans: Sequence[Span], gap_ns: int) -> list[Span]:
    """Return spans in order, joined if less than a gap apart."""
    joined: list[Span] = []
    for start, end in spans:
        if joined and start - joined[-1][1] < gap_ns:
            joined[-1] = (joined[-1][0], max(end, joined[-1][1]))
        else:
            joined.append((start, end))
    return joined


def laser_spans(first_ns: Int64Array, last_ns: Int64Array, rules: StripRules | None = None) -> list[Span]:
    """Return spans in which the laser was on, from first and last times (n,) of pieces of its data, in any order."""
    order = np.argsort(first_ns, kind="stable")
    pieces = [(int(first_ns[i]), int(last_ns[i]) + 1) for i in order]
    return _joined(pieces, round((rules or StripRules()).laser_gap_s * SECOND_NS))


def common(one: Sequence[Span], other: Sequence[Span]) -> list[Span]:
    """Return the spans common to both, each of which is in order and without overlaps."""
    both = [(max(a, c), min(b, d)) for a, b in one for c, d in other if a < d and c < b]
    return sorted(both)


def cut(straight: Sequence[Span], laser: Sequence[Span], rules: StripRules | None = None) -> list[Span]:
    """Return strips: straight flight with the laser on, of at least the minimum duration."""
    shortest_ns = round((rules or StripRules()).min_strip_s * SECOND_NS)
    return [(start, end) for start, end in common(straight, laser) if end - start >= shortest_ns]


def segments(strips: Sequence[Span], first_ns: int, end_ns: int, *, first_number: int = 1) -> list[Segment]:
    """Return the span from first to end, tiled without gaps by numbered strips and the time between them.

    A strip keeps its number if only a part of it lies within; one that lies outside gives no segment.

    Raises:
        StripError: there are more strips than a file's field can number.
    """
    tiles: list[Segment] = []
    at = first_ns
    for number, (start, end) in enumerate(strips, start=first_number):
        if number > MAX_STRIPS:
            raise StripError(
                f"the flight has more than {MAX_STRIPS} strips, the most that a point source id can number"
            )
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
    """Return strips, in order of time, from a CSV file with the columns start_gps_ns and end_gps_ns.

    Other columns are ignored.

    Raises:
        StripError: a column is missing, a value is not an integer, a strip has no length, or two overlap.
    """
    rows = csv.DictReader(io.StringIO(text), skipinitialspace=True)
    try:
        strips = sorted(_spans(rows, name))
    except csv.Error as error:
        raise StripError(f"{name}: line {rows.reader.line_num}: not CSV: {error}") from None
    for (_, end), (start, _) in pairwise(strips):
        if start < end:
            raise StripError(f"{name}: the strip that begins at {start} overlaps the one before, which ends at {end}")
    if not strips:
        raise StripError(f"{name}: has no strips")
    return strips


def _spans(rows: csv.DictReader[str], name: str) -> Iterator[Span]:
    missing = [column for column in CSV_COLUMNS if column not in (rows.fieldnames or [])]
    if missing:
        raise StripError(f"{name}: column {missing[0]} is missing; the first line must be {','.join(CSV_COLUMNS)}")
    for row in rows:
        try:
            start, end = (int(row[column]) for column in CSV_COLUMNS)
        except (TypeError, ValueError):
            raise StripError(f"{name}: line {rows.line_num}: needs two integers, GPS nanoseconds") from None
        if end <= start:
            raise StripError(f"{name}: line {rows.line_num}: the strip ends at {end}, before it begins")
        if not 0 <= start < end <= LATEST_NS:
            raise StripError(
                f"{name}: line {rows.line_num}: {start} to {end} is outside GPS time; give nanoseconds since 1980"
            )
        yield start, end
