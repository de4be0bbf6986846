"""Tests that samples dropped for their values or stamps become gaps of the trajectory if they last."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

import numpy as np
import pytest

from swath.daemon.processing.navigation.inputs import _missing
from swath.daemon.processing.navigation.times import ImuTimes, Stretch
from swath.georef.arrays import Int64Array, StructArray
from swath.georef.navigation.samples import Sampler
from swath.georef.records import IMU_DTYPE

S = 1_000_000_000
RATE_HZ = 100.0
BEGIN_NS = 1_479_297_618 * S
FIRST = 400  # the first spoilt sample
Spoil = Callable[[StructArray, Int64Array, slice], None]


def holes(spoil: Spoil, count: int) -> list[Stretch]:
    """Return the stretches missing from 20 s at 100 Hz, of which `count` samples from 4 s on are spoilt."""
    rows = np.zeros(2000, IMU_DTYPE)
    rows["specific_force_b"] = [0.0, 0.0, -9.81]
    stamps_ns = BEGIN_NS + np.arange(2000) * (S // 100)
    rows["host_time_ns"] = stamps_ns + 7 * S
    spoil(rows, stamps_ns, slice(FIRST, FIRST + count))
    sampler = Sampler(RATE_HZ)
    sampler.feed(rows, stamps_ns)
    times = ImuTimes(rows, stamps_ns, np.zeros(len(rows)), np.ones(len(rows), np.bool_), "gps", Counter())
    return _missing(times, sampler, (), RATE_HZ)


def no_numbers(rows: StructArray, stamps_ns: Int64Array, at: slice) -> None:
    rows["angular_rate_b"][at, 1] = np.nan


def far_back(rows: StructArray, stamps_ns: Int64Array, at: slice) -> None:
    stamps_ns[at] -= 200 * S


def again(rows: StructArray, stamps_ns: Int64Array, at: slice) -> None:
    """Set a clock back by the spoilt time, so that the same times occur twice."""
    stamps_ns[at.start :] -= (at.stop - at.start) * (S // 100)


def stuck(rows: StructArray, stamps_ns: Int64Array, at: slice) -> None:
    stamps_ns[at] = stamps_ns[at.start - 1]


def lone(rows: StructArray, stamps_ns: Int64Array, at: slice) -> None:
    """Give each sample a stamp far from all others, each farther away than the one before."""
    stamps_ns[at] += np.arange(1, at.stop - at.start + 1) * 600 * S


@pytest.mark.parametrize(
    ("spoil", "begin_s", "why"),
    [
        (no_numbers, 3.99, "samples that are not numbers"),
        (far_back, 3.99, "samples whose time jumped back"),
        (again, 3.3, "samples out of order"),
        (stuck, 3.99, "samples of a time that another had"),
        (lone, 3.99, "samples whose time stands alone"),
    ],
)
def test_a_long_run_of_dropped_samples_is_reported_as_one_gap(spoil: Spoil, begin_s: float, why: str) -> None:
    """It is reported once, with the reason, and lasts as long as the samples: 0.7 s."""
    (hole,) = holes(spoil, 70)
    assert hole.why == why
    assert (hole.begin_ns - BEGIN_NS) / S == pytest.approx(begin_s, abs=0.001)
    assert hole.seconds == pytest.approx(0.7, abs=0.011)
    assert holes(spoil, 40) == []


def test_a_gap_that_dropped_samples_explain_only_in_part_is_reported_separately() -> None:
    def stuck_then_silent(rows: StructArray, stamps_ns: Int64Array, at: slice) -> None:
        stuck(rows, stamps_ns, at)
        stamps_ns[at.stop :] += 5 * S

    silent, same = sorted(holes(stuck_then_silent, 70), key=lambda one: -one.seconds)
    assert (silent.why, same.why) == ("no samples", "samples of a time that another had")
    assert silent.seconds == pytest.approx(5.7, abs=0.011)
