"""Tests that each event mark has a row, with the pose of its time or the reason for its absence."""

from __future__ import annotations

import csv
import io
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from swath.daemon.processing.navigation.inputs import Mark
from swath.daemon.processing.trajectory.event_marks import HEADER, PLACED, event_table
from swath.georef.records import EventMark, TimeScale, TimeTag
from swath.georef.trajectory.trajectory import Trajectory

pytestmark = pytest.mark.xdist_group("kernels")

S = 1_000_000_000
START = 1_465_549_218 * S
EVENT = EventMark(0, TimeTag(TimeScale.GPS, 0), "MARK2", count=7, sigma_s=1e-3)


@pytest.fixture(scope="module")
def trajectory() -> Trajectory:
    """Return level flight north at 60 m/s along a meridian, at 10 Hz, with a gap from 4 s to 6 s."""
    seconds = np.concatenate([np.arange(0, 4.05, 0.1), np.arange(6, 10.05, 0.1)])
    n = len(seconds)
    return Trajectory.from_geodetic(
        START + np.rint(seconds * S).astype(np.int64),
        0.8 + 60.0 * seconds / 6.37e6,
        np.full(n, 0.1),
        np.full(n, 500.0),
        np.tile([60.0, 0.0, 0.0], (n, 1)),
        np.full(n, 0.05),
        np.full(n, -0.02),
        np.full(n, 0.0) + 2 * np.pi - 0.01,
        position_sigma_l=np.tile([0.03, 0.04, 0.05], (n, 1)),
        attitude_sigma_rad=np.tile([1e-4, 2e-4, 3e-4], (n, 1)),
        name="north",
    )


def rows(marks: list[Mark], trajectory: Trajectory) -> list[dict[str, str]]:
    table = event_table(marks, trajectory)
    assert table.text.splitlines()[0] == HEADER
    found = list(csv.DictReader(io.StringIO(table.text)))
    assert len(found) == len(marks) == table.fates.total()
    return found


def mark(after_s: float | None, **changes: Any) -> Mark:
    at = None if after_s is None else START + round(after_s * S)
    return Mark("gnss/rover", replace(EVENT, **changes), at)


def test_an_event_mark_has_the_pose_at_its_time(trajectory: Trajectory) -> None:
    (row,) = rows([mark(2.345)], trajectory)
    assert row["fate"] == PLACED
    assert (row["source"], row["channel"], row["edge"], row["count"]) == ("gnss/rover", "MARK2", "rising", "7")
    assert int(row["gps_ns"]) == START + 2_345_000_000
    assert float(row["lat_deg"]) == pytest.approx(np.degrees(0.8 + 60.0 * 2.345 / 6.37e6), abs=1e-9)
    assert float(row["lon_deg"]) == pytest.approx(np.degrees(0.1), abs=1e-9)
    assert float(row["height_m"]) == pytest.approx(500.0, abs=1e-3)
    angles = [float(row[name]) for name in ("roll_deg", "pitch_deg", "heading_deg")]
    assert angles == pytest.approx(np.degrees([0.05, -0.02, 2 * np.pi - 0.01]).tolist(), abs=1e-5)
    assert float(row["sigma_heading_deg"]) == pytest.approx(np.degrees(3e-4), abs=1e-6)


def test_the_time_sigma_of_a_mark_becomes_a_sigma_along_the_track(trajectory: Trajectory) -> None:
    late, sharp = rows([mark(1.0), mark(1.0, sigma_s=None)], trajectory)
    assert float(late["sigma_n_m"]) == pytest.approx(np.hypot(0.03, 60.0 * 1e-3), abs=1e-4)
    assert float(late["sigma_e_m"]) == pytest.approx(0.04, abs=1e-4)
    assert float(late["sigma_time_s"]) == pytest.approx(1e-3)
    assert float(sharp["sigma_n_m"]) == pytest.approx(0.03, abs=1e-4)
    assert sharp["sigma_time_s"] == ""


def test_a_mark_without_a_pose_keeps_its_row_and_gives_the_reason(trajectory: Trajectory) -> None:
    marks = [mark(-1.0), mark(1.0), mark(5.0), mark(None), mark(None, valid=False), mark(10.5), mark(1.0, rising=False)]
    found = rows(marks, trajectory)
    assert [row["fate"] for row in found] == [
        "outside the trajectory",
        PLACED,
        "in a gap of the trajectory",
        "its time cannot be converted to GPS time",
        "the receiver does not vouch for its time",
        "outside the trajectory",
        PLACED,
    ]
    assert found[0]["gps_ns"] == str(START - S)
    assert {found[number]["lat_deg"] for number in (0, 2, 3, 4, 5)} == {""}
    assert found[1]["lat_deg"] == found[6]["lat_deg"]
    assert found[6]["edge"] == "falling"
    assert rows([mark(1.0, rising=None)], trajectory)[0]["edge"] == ""


def test_without_event_marks_only_the_header_is_written(trajectory: Trajectory) -> None:
    assert event_table([], trajectory).text == HEADER + "\n"
