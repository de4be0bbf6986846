"""Tests GPS times of points of any LAS file: what header and times imply, and their week."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from swath.daemon.processing.point_times import PointClock, PointTimes, TimeKind, point_times_of, time_notes
from swath.daemon.processing.quicklook.run import look_at
from swath.georef.timescales.gps_time import WEEK_NS
from tests.daemon.builders import lattice, write_laz

WEEK = 2423
FLIGHT_NS = WEEK * WEEK_NS + 345_600_000_000_000  # a Thursday
ADJUSTED_S = FLIGHT_NS / 1e9 - 1e9


def tile(folder: Path, name: str, first_s: float, *, adjusted: bool, west_m: float = 0.0) -> PointTimes:
    """Write points of 20 s from a time on, with a header's kind of time, and return what is read of them."""
    x, y = lattice(500_000.0 + west_m, 5_200_000.0, 20.0, 20.0, 1.0)
    times = first_s + np.linspace(0.0, 20.0, len(x))
    return point_times_of(write_laz(folder / name, x, y, 0.0 * x + 400.0, gps_time=times, adjusted=adjusted))


def test_the_header_determines_the_kind_of_time(tmp_path: Path) -> None:
    of_week = tile(tmp_path, "week.laz", 345_600.0, adjusted=False)
    adjusted = tile(tmp_path, "adjusted.laz", ADJUSTED_S, adjusted=True)
    assert (of_week.kind, of_week.doubt) == (TimeKind.OF_WEEK, "")
    assert (adjusted.kind, adjusted.doubt) == (TimeKind.ADJUSTED, "")
    clock = PointClock([of_week, adjusted])
    for one, first_s in ((of_week, 345_600.5), (adjusted, ADJUSTED_S + 0.5)):
        assert clock.time_ns(one.path, np.array([first_s])).tolist() == [FLIGHT_NS + 500_000_000]
    assert clock.notes == []


def as_las_15(path: Path, offset: int) -> PointTimes:
    """Change a LAS 1.4 file to 1.5, with the flag of offset times, and return what is read of it.

    LAS 1.5 R00, 2.4: greatest and least time (two doubles) and the offset in millions of seconds (u16) come after the
    375 bytes of 1.4; 393 in all.
    """
    data = bytearray(path.read_bytes())
    more = struct.pack("<ddH", 0.0, 0.0, offset)
    (points_at,) = struct.unpack_from("<I", data, 96)
    data[375:375] = more
    data[25] = 5
    data[6] |= 1 << 6
    struct.pack_into("<HI", data, 94, 375 + len(more), points_at + len(more))
    path.write_bytes(data)
    return point_times_of(path)


@pytest.mark.parametrize("offset", [1000, 1250, 1500])
def test_times_of_las_15_use_the_offset_of_the_header(tmp_path: Path, offset: int) -> None:
    """The LAS working group recommends 1500 for 2023 to 2031, so times of today are negative."""
    first_s = FLIGHT_NS / 1e9 - offset * 1e6
    tile(tmp_path, "a.las", first_s, adjusted=True)
    one = as_las_15(tmp_path / "a.las", offset)
    assert (one.kind, one.doubt) == (TimeKind.ADJUSTED, "")
    of_week = tile(tmp_path, "week.laz", 345_600.0, adjusted=False)
    clock = PointClock([one, of_week])
    assert clock.time_ns(one.path, np.array([first_s + 0.5])).tolist() == [FLIGHT_NS + 500_000_000]
    assert clock.time_ns(of_week.path, np.array([345_600.5])).tolist() == [FLIGHT_NS + 500_000_000]


def test_the_quick_look_names_files_that_mix_kinds_of_time(tmp_path: Path) -> None:
    tile(tmp_path, "a.laz", 345_600.0, adjusted=False)
    for number in range(5):
        tile(tmp_path, f"b{number}.laz", ADJUSTED_S, adjusted=True, west_m=20.0)
    assert (
        "files have different kinds of times: seconds of the GPS week in a.laz; adjusted standard GPS time in b0.laz, "
        "b1.laz, b2.laz and 2 more; convert them to one kind before you merge them into a file"
        in look_at([tmp_path]).notes
    )


def test_times_that_contradict_their_header_are_reported(tmp_path: Path) -> None:
    """Adjusted times without the bit are common; small numbers with it would be of September 2011."""
    unset = tile(tmp_path, "unset.laz", ADJUSTED_S, adjusted=False)
    assert unset.kind is TimeKind.ADJUSTED
    assert "its header says seconds of the GPS week, but its times, from 465,7" in unset.doubt
    small = tile(tmp_path, "small.laz", 345_600.0, adjusted=True)
    assert small.kind is TimeKind.ADJUSTED
    assert "belong to 2011-09-18; if they are seconds of the GPS week, clear bit 0" in small.doubt
    assert time_notes([unset, small]) == [unset.doubt, small.doubt]


@pytest.mark.parametrize("adjusted", [True, False])
@pytest.mark.parametrize(
    ("first_s", "told"),
    [
        (
            1_174_893_536.0,
            "then belong to 2048-12-06, in the future; they look like GPS seconds: subtract 1,000,000,000 s from",
        ),
        (
            1_490_858_318.0,
            "then belong to 2058-12-11, in the future; they look like seconds since 1970: subtract 1,315,964,800",
        ),
        (3_900_000_000.0, "belong to 2135-"),
    ],
)
def test_times_in_the_future_are_reported_with_their_probable_kind(
    tmp_path: Path, first_s: float, told: str, adjusted: bool
) -> None:
    """The moment is 2017-03-30 07:18:38 UTC in GPS and in Unix seconds, under either bit (LAStools' list)."""
    one = tile(tmp_path, "future.laz", first_s, adjusted=adjusted)
    assert one.kind is TimeKind.ADJUSTED
    assert told in one.doubt
    assert one.doubt in look_at([tmp_path]).notes


@pytest.mark.parametrize("after_s", [0.0, 604_800.0], ids=["begins anew", "counts on"])
def test_a_flight_from_saturday_into_sunday_spans_two_weeks(tmp_path: Path, after_s: float) -> None:
    before = tile(tmp_path, "saturday.laz", 604_700.0, adjusted=False)
    after = tile(tmp_path, "sunday.laz", after_s + 50.0, adjusted=False)
    clock = PointClock([after, before], week=WEEK)
    for one, second, since_s in ((before, 604_701.0, 604_701), (after, after_s + 51.0, 604_851)):
        assert clock.time_ns(one.path, np.array([second])).tolist() == [WEEK * WEEK_NS + since_s * 1_000_000_000]


def test_seconds_of_an_unknown_week_are_comparable_and_reported(tmp_path: Path) -> None:
    one = tile(tmp_path, "a.laz", 345_600.0, adjusted=False)
    clock = PointClock([one])
    assert clock.notes == [
        "a.laz: times are seconds of the GPS week, and no file gives the week, so times are only relative to "
        "each other; give the week with --week"
    ]
    assert np.diff(clock.time_ns(one.path, np.array([345_600.0, 345_601.5]))).tolist() == [1_500_000_000]


def test_points_without_times_have_none(tmp_path: Path) -> None:
    x, y = lattice(500_000.0, 5_200_000.0, 20.0, 20.0, 1.0)
    none = point_times_of(write_laz(tmp_path / "n.las", x, y, 0.0 * x, point_format=0))
    zero = point_times_of(write_laz(tmp_path / "z.las", x, y, 0.0 * x))
    assert [one.kind for one in (none, zero)] == [TimeKind.NONE] * 2
    nowhere = np.array([np.nan, np.inf, 1e300, 1.0])
    assert PointClock([none]).time_ns(none.path, nowhere).tolist() == [0, 0, 0, 0]
    adjusted = tile(tmp_path, "a.laz", ADJUSTED_S, adjusted=True)
    assert PointClock([adjusted]).time_ns(adjusted.path, nowhere)[:3].tolist() == [0, 0, 0]
