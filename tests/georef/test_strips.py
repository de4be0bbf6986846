"""Tests strips from turns and from the laser, against flights drawn by hand."""

from __future__ import annotations

import numpy as np
import pytest

from swath.georef.arrays import FloatArray, Int64Array
from swath.georef.strips import (
    Segment,
    StripError,
    StripRules,
    common,
    cut,
    laser_spans,
    read_strips,
    segments,
    straight_spans,
)

S = 1_000_000_000
START = 1_479_297_618 * S
Flown = tuple[Int64Array, FloatArray, FloatArray]


def flown(*legs: tuple[float, float, float], rate_hz: float = 50.0, gusts_rad: float = 0.0) -> Flown:
    """Return GPS times (ns), headings 0 … 2π and rolls (rad) of legs of (seconds, °/s, bank in °), starting at 350°."""
    rates = np.concatenate([np.full(round(seconds * rate_hz), rate) for seconds, rate, _ in legs])
    banks = np.concatenate([np.full(round(seconds * rate_hz), bank) for seconds, _, bank in legs])
    time_s = np.arange(len(rates)) / rate_hz
    sway = gusts_rad * np.sin(2 * np.pi * time_s / 1.3)
    heading = np.radians(350.0 + np.cumsum(rates) / rate_hz) % (2 * np.pi) + sway
    return START + np.round(time_s * S).astype(np.int64), heading, np.radians(banks) + 2 * sway


def seconds(spans: list[tuple[int, int]]) -> list[tuple[float, float]]:
    """Return seconds since the start."""
    return [((start - START) / S, (end - START) / S) for start, end in spans]


def test_two_lines_are_separated_by_a_turn() -> None:
    found = seconds(straight_spans(*flown((60, 0, 0), (60, 3, 22), (60, 0, 0))))
    assert np.allclose(found, [(0, 60), (120, 180)], atol=2.0)  # half a window


def test_heading_through_north_is_not_a_turn() -> None:
    assert len(straight_spans(*flown((300, 0.05, 0)))) == 1


def test_a_flat_turn_and_a_banked_slip_both_count_as_turns() -> None:
    assert len(straight_spans(*flown((60, 0, 0), (30, 2, 0), (60, 0, 0)))) == 2
    assert len(straight_spans(*flown((60, 0, 0), (30, 0, 15), (60, 0, 0)))) == 2


def test_gusts_and_short_corrections_are_not_turns() -> None:
    assert len(straight_spans(*flown((60, 0, 0), (1.5, 0.2, 12), (60, 0, 0), gusts_rad=0.02))) == 1


def test_strips_do_not_depend_on_the_trajectory_rate() -> None:
    legs = ((60, 0, 0), (60, 3, 22), (60, 0, 0))
    few = np.array(straight_spans(*flown(*legs, rate_hz=10)))
    many = np.array(straight_spans(*flown(*legs, rate_hz=200)))
    assert (np.abs(few - many) < S // 5).all()


@pytest.mark.parametrize("epochs", [0, 1])
def test_a_trajectory_of_no_duration_has_no_strip(epochs: int) -> None:
    time_ns, heading, roll = flown((1, 0, 0))
    assert straight_spans(time_ns[:epochs], heading[:epochs], roll[:epochs]) == []


def test_laser_spans_separated_by_less_than_a_gap_are_joined() -> None:
    first = np.array([30, 0, 10, 40]) * S  # chunks of two scanners have no common order
    last = np.array([40, 9.5, 20, 45]) * S
    assert laser_spans(first, last.astype(np.int64)) == [(0, 20 * S + 1), (30 * S, 45 * S + 1)]


def test_strips_are_straight_flight_with_the_laser_on() -> None:
    straight, laser = [(0, 100 * S), (200 * S, 300 * S)], [(10 * S, 97 * S), (98 * S, 203 * S), (250 * S, 400 * S)]
    assert common(straight, laser) == [
        (10 * S, 97 * S),
        (98 * S, 100 * S),
        (200 * S, 203 * S),
        (250 * S, 300 * S),
    ]
    assert cut(straight, laser) == [(10 * S, 97 * S), (250 * S, 300 * S)]
    assert len(cut(straight, laser, StripRules(min_strip_s=2.5))) == 3


def test_segments_cover_the_time_without_overlap() -> None:
    tiles = segments([(10, 20), (20, 25), (40, 90)], 5, 50, first_number=4)
    assert tiles == [
        Segment(0, 5, 10),
        Segment(4, 10, 20),
        Segment(5, 20, 25),
        Segment(0, 25, 40),
        Segment(6, 40, 50),
    ]
    assert segments([(0, 3), (7, 9)], 3, 7) == [Segment(0, 3, 7)]
    assert segments([(0, 9)], 3, 7) == [Segment(1, 3, 7)]


def test_every_time_lies_in_one_segment() -> None:
    rng = np.random.default_rng(1)
    edges = np.unique(rng.integers(0, 1000, 40))[:20].tolist()
    tiles = segments(list(zip(edges[::2], edges[1::2], strict=True)), 100, 900)
    for time in range(100, 900):
        assert sum(tile.start_ns <= time < tile.end_ns for tile in tiles) == 1


def test_more_strips_than_a_file_can_number_are_refused() -> None:
    with pytest.raises(StripError, match="65535"):
        segments([(0, 1), (1, 2)], 0, 2, first_number=65_535)


def test_times_of_strips_are_read() -> None:
    text = "name, start_gps_ns, end_gps_ns\nb,300,400\na,100,200\n"
    assert read_strips(text, "times.csv") == [(100, 200), (300, 400)]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("start,end\n1,2\n", "column start_gps_ns is missing"),
        ("start_gps_ns,end_gps_ns\n1,2\n1.5,3\n", "line 3: needs two integers"),
        ("start_gps_ns,end_gps_ns\n1\n", "line 2: needs two integers"),
        ("start_gps_ns,end_gps_ns\n5,5\n", "line 2: the strip ends"),
        ("start_gps_ns,end_gps_ns\n1,5\n4,8\n", "overlaps"),
        ("start_gps_ns,end_gps_ns\n", "has no strips"),
        ("", "column start_gps_ns is missing"),
    ],
)
def test_wrong_strip_times_are_refused_with_their_line(text: str, message: str) -> None:
    with pytest.raises(StripError, match=message) as refused:
        read_strips(text, "times.csv")
    assert str(refused.value).startswith("times.csv: ")
    assert "\n" not in str(refused.value)
