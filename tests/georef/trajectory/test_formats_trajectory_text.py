"""Tests trajectories in text: the project's CSV, Waypoint's exports, RTKLIB's positions."""

from __future__ import annotations

import codecs
import datetime as dt
import tracemalloc
from typing import Any

import numpy as np
import pytest
from pyproj import Transformer

from swath.georef.formats.trajectory.csv import HEADER, csv_text
from swath.georef.formats.trajectory.file import read_trajectory
from swath.georef.geodesy.earth import prime_vertical_radius_m
from swath.georef.trajectory.trajectory import Trajectory, TrajectoryError
from tests.georef.flown import SECOND, START_NS, WEEK, flown

pytestmark = pytest.mark.xdist_group("kernels")

SPAN = (START_NS, START_NS + 20 * 10**9)
TO_ECEF = Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)


def read(text: str, **settings: Any) -> Trajectory:
    return read_trajectory(text.encode(), "file.txt", **settings)


def refusal(text: str, **settings: Any) -> str:
    with pytest.raises(TrajectoryError) as caught:
        read(text, **settings)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def same(one: Trajectory, other: Trajectory, metres: float, radians: float) -> None:
    np.testing.assert_array_equal(one.time_ns, other.time_ns)
    np.testing.assert_allclose(one.position_e, other.position_e, atol=metres)
    np.testing.assert_allclose(one.velocity_e, other.velocity_e, atol=metres)
    for here, there in zip(one.attitude(), other.attitude(), strict=True):
        np.testing.assert_allclose((here - there + np.pi) % (2 * np.pi) - np.pi, 0, atol=radians)


# -------------------------------------------------------------------------------------------------- CSV


def test_a_written_csv_is_read_back() -> None:
    trajectory = flown(100)
    back = read(csv_text(trajectory))
    same(back, trajectory, 2e-5, 1e-9)
    np.testing.assert_allclose(back.position_sigma_l, trajectory.position_sigma_l, atol=1e-5)
    np.testing.assert_allclose(back.attitude_sigma_rad, trajectory.attitude_sigma_rad, atol=2e-9)


def test_a_csv_written_by_hand_is_read() -> None:
    """Times keep their nanoseconds; sigmas may be absent or in another order."""
    rows = [
        "1479297618000000001,47.5,8.9,900,60,0,-1,1.5,-2,359.5",
        "1479297618050000003,47.5,8.9,900.05,60,0,-1,1.5,-2,0.5",
    ]
    trajectory = read("\n".join([HEADER, *rows]))
    assert trajectory.time_ns.tolist() == [1479297618000000001, 1479297618050000003]
    assert np.degrees([a[0] for a in trajectory.attitude()]) == pytest.approx([1.5, -2, 359.5])
    assert np.isnan(trajectory.position_sigma_l).all()
    with_sigmas = [f"{HEADER},sigma_heading_deg,sigma_lat_deg,sigma_d_m", *(f"{row},0.02,1e-6,0.07" for row in rows)]
    trajectory = read("\n".join(with_sigmas))
    assert np.degrees(trajectory.attitude_sigma_rad[0, 2]) == pytest.approx(0.02)
    assert trajectory.position_sigma_l[0, [0, 2]] == pytest.approx([0.11118, 0.07], abs=2e-5)
    assert np.isnan(trajectory.position_sigma_l[0, 1])


def degrees_as_radians(text: str) -> str:
    """Return a trajectory's text with roll, pitch and heading written in radians instead of degrees."""
    lines = text.splitlines()
    rows = [line.split(",") for line in lines[1:]]
    for row in rows:
        row[7:10] = [str(np.radians(float(value))) for value in row[7:10]]
    return "\n".join([lines[0], *(",".join(row) for row in rows)])


def test_a_wrong_csv_is_refused() -> None:
    good = csv_text(flown(100))
    lines = good.splitlines()
    swapped = good.replace("lat_deg,lon_deg", "lon_deg,lat_deg")
    assert "header of a trajectory CSV begins with gps_ns,lat_deg" in refusal(swapped)
    assert "column sigma_north is unknown; sigmas are sigma_n_m," in refusal(good.replace("sigma_n_m", "sigma_north"))
    assert "line 4:" in refusal("\n".join([*lines[:3], lines[3].replace(",", ";", 1), *lines[4:]]))
    assert "16 numbers are expected" in refusal("\n".join([*lines[:3], lines[3].replace(",", ";", 1), *lines[4:]]))
    assert "time goes back by 0.050 s at line 4" in refusal("\n".join([*lines[:2], lines[3], lines[2], *lines[4:]]))
    assert "has 0 epochs" in refusal(lines[0])
    assert "look like radians" in refusal(degrees_as_radians(good))
    assert "no number for height at line 3" in refusal(good.replace(lines[2].split(",")[3], "nan", 1))
    negative = [*lines[:5], lines[5].replace("0.00500", "-0.00500", 1), *lines[6:]]
    assert "a sigma of the attitude at line 6 is negative" in refusal("\n".join(negative))


def test_a_gap_takes_no_memory() -> None:
    """The first row is of another month, 2.6 million pieces of a second earlier, of which five are flown."""
    lines = csv_text(flown(100)).splitlines()
    alone_ns = START_NS - 30 * 86_400 * 10**9
    lines[1] = f"{alone_ns},{lines[1].partition(',')[2]}"
    read("\n".join(lines))
    tracemalloc.start()
    trajectory = read("\n".join(lines))
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert trajectory.gaps().tolist() == [[alone_ns, START_NS + 50_000_000]]
    assert most < 2_000_000


def test_a_trajectory_with_gaps_only_is_refused() -> None:
    lines = csv_text(flown(100)).splitlines()
    line = refusal("\n".join([lines[0], *lines[1::4]]))
    assert "its epochs are 0.200 s apart, and epochs more than 0.150 s apart count as a gap: export it at 10 Hz" in line
    assert len(read("\n".join([lines[0], *lines[1::2]]))) == 50


# -------------------------------------------------------------------------------------------------- Waypoint

HEAD = """\
Project:     flight-7
Program:     Inertial Explorer Version 8.90.6611
Profile:     Swath
Source:      GNSS/INS Epochs(Smoothed TC Combined)

Datum:       WGS84, (processing datum)
Master 1:    Name BASE, Status ENABLED
             Position 47 30 00.00000, 8 54 00.00000, 500.000 m (WGS84, Ellipsoidal hgt)
SD Scaling Settings:
   Position: 1.0000
   Attitude: 1.0000
"""


def dms(degrees: float) -> str:
    seconds = abs(degrees) * 3600
    return f"{'-' if degrees < 0 else ''}{int(seconds // 3600)} {int(seconds % 3600 // 60):02d} {seconds % 60:010.7f}"


def weeks(trajectory: Trajectory) -> list[str]:
    return [f"{t // 604_800_000_000_000} {t % 604_800_000_000_000 / 1e9:.4f}" for t in trajectory.time_ns.tolist()]


def export(trajectory: Trajectory, times: list[str], titles: str, units: str, head: str = HEAD) -> str:
    """Return a Waypoint export of a trajectory.

    After the columns of time come latitude, longitude (D M S), height, velocities, heading, pitch, roll, sigmas, Q.
    """
    lat, lon, height = trajectory.geodetic()
    north, east, down = trajectory.velocity_l().T
    roll, pitch, heading = np.degrees(trajectory.attitude())
    sigmas = np.hstack([trajectory.position_sigma_l, np.degrees(trajectory.attitude_sigma_rad)])
    lines = [
        f"{titles}       Latitude       Longitude     H-Ell    VEast   VNorth      VUp   Heading     Pitch      Roll"
        "  SDNorth   SDEast SDHeight   RollSD  PitchSD   HdngSD Q",
        f"{units}    (+/-D M S)     (+/-D M S)       (m)    (m/s)    (m/s)    (m/s)     (deg)     (deg)     (deg)"
        "      (m)      (m)      (m)    (deg)    (deg)    (deg)",
    ]
    for i, time in enumerate(times):
        place = f"{dms(np.degrees(lat[i]))} {dms(np.degrees(lon[i]))} {height[i]:.5f}"
        motion = f"{east[i]:.6f} {north[i]:.6f} {-down[i]:.6f} {heading[i]:.9f} {pitch[i]:.9f} {roll[i]:.9f}"
        lines.append(f"{time} {place} {motion} {' '.join(f'{sigma:.6f}' for sigma in sigmas[i])} 1")
    return "\n".join([head, *lines, "", "End of file, epochs: many"])


def calendar(gps_ns: int, leap_s: int = 0) -> dt.datetime:
    return dt.datetime(1980, 1, 6, tzinfo=dt.UTC) + dt.timedelta(microseconds=gps_ns // 1000, seconds=-leap_s)


WEEKS = ("Week GPSTime", "(weeks) (sec)")


@pytest.mark.parametrize(
    ("mark", "encoding"),
    [  # UTF-16 is "Unicode" of Windows' Notepad and PowerShell
        (codecs.BOM_UTF16_LE, "utf-16-le"),
        (codecs.BOM_UTF16_BE, "utf-16-be"),
        (codecs.BOM_UTF32_LE, "utf-32-le"),
        (codecs.BOM_UTF8, "utf-8"),
    ],
)
def test_texts_are_read_by_their_byte_order_mark(mark: bytes, encoding: str) -> None:
    trajectory = flown(20)
    for text in (csv_text(trajectory), export(trajectory, weeks(trajectory), *WEEKS)):
        got = read_trajectory(mark + text.replace("\n", "\r\n").encode(encoding), "file.txt")
        same(got, read(text), 0.0, 0.0)


def test_waypoint_export_is_read() -> None:
    trajectory = flown(100, lon_rad=-0.001 + 1e-7 * np.arange(100), velocity_l=np.full((100, 3), np.nan))  # 0° W
    text = export(trajectory, weeks(trajectory), *WEEKS)
    text = text.replace("nan", "0")
    back = read(text)
    np.testing.assert_allclose(back.position_e, trajectory.position_e, atol=2e-5)
    trajectory = flown(100)
    back = read(export(trajectory, weeks(trajectory), *WEEKS))
    same(back, trajectory, 2e-5, 1e-10)
    np.testing.assert_allclose(back.position_sigma_l, trajectory.position_sigma_l, atol=1e-6)
    np.testing.assert_allclose(back.attitude_sigma_rad, trajectory.attitude_sigma_rad, atol=1e-8)


NAMED = "Week GPSTime Latitude Longitude H-Ell Roll Pitch Heading Q"
UNITS = "(weeks) (sec) (deg) (deg) (m) (deg) (deg) (deg)"  # Q has none


def separated(mark: str, comma: bool, dms_cells: bool = False) -> str:
    """Return an export of four epochs with a mark between its columns; the third row of data has an empty Q."""
    place = ("-8 30 0.0", "47 24 1.5") if dms_cells else ("-8.5000000000", "47.4004166667")
    units = UNITS.replace("(deg) (deg) (m)", "(+/-D!M!S) (+/-D!M!S) (m)") if dms_cells else UNITS
    lines = [mark.join(NAMED.split()), mark.join(units.split()).replace("!", " ")]
    if mark == ";":  # some programs end each line with a delimiter
        lines = [line + mark for line in lines]
    for i in range(4):
        cells = [
            str(WEEK),
            f"{SECOND}.{i}00",
            place[1],
            place[0],
            "500.250",
            "1.5",
            "-2.5",
            "359.0",
            "" if i == 3 else "1",
        ]
        lines.append(mark.join(cell.replace(".", ",") if comma else cell for cell in cells) + mark * (mark == ";"))
    return "\n".join([HEAD, *lines, ""])


@pytest.mark.parametrize(
    ("mark", "comma", "dms_cells"),
    [
        (",", False, False),
        (",", False, True),
        (", ", False, False),
        (";", False, False),
        (";", True, False),
        (";", True, True),
        ("\t", False, False),
        ("\t", True, True),
        ("  ", True, False),
    ],
)
def test_waypoint_columns_may_be_separated_by_delimiters(mark: str, comma: bool, dms_cells: bool) -> None:
    text = separated(mark, comma, dms_cells)
    trajectory = read(f"{text.rstrip()} 1" if mark == "  " else text)  # blanks cannot delimit an empty cell
    assert trajectory.span == (START_NS, START_NS + 300_000_000)
    lat, lon, height = trajectory.geodetic()
    assert np.degrees([lat[3], lon[3]]) == pytest.approx([47.4 + 1.5 / 3600, -8.5], abs=1e-9)
    assert height == pytest.approx([500.25] * 4)
    assert np.degrees([angle[3] for angle in trajectory.attitude()]) == pytest.approx([1.5, -2.5, 359.0])


def test_error_for_waypoint_decimal_commas_names_the_export_setting() -> None:
    told = refusal(separated(",", True))
    assert "decimal commas cannot be distinguished from commas between columns; export it with decimal points" in told


def test_waypoint_sigmas_are_scaled_back_to_one_sigma() -> None:
    trajectory = flown(100)
    twice = HEAD.replace("Position: 1.0000", "Position: 2.0000")
    back = read(export(trajectory, weeks(trajectory), *WEEKS, head=twice))
    np.testing.assert_allclose(back.position_sigma_l, trajectory.position_sigma_l / 2, atol=1e-6)


def test_waypoint_decimal_degrees_and_units_without_brackets_are_read() -> None:
    rows = [f"{WEEK} {SECOND}.{i}00 {SECOND - 18}.{i}00 121.0000{i} 31.0 10.5 359.0 1.0 -2.0" for i in range(4)]
    titles = "Week     GPSTime     UTCTime       Longitude       Latitude     H-Ell     Heading      Pitch      Roll"
    units = "week       (sec)       (sec)           (deg)          (deg)       (m)       (deg)      (deg)     (deg)"
    trajectory = read("\n".join(["Program: Inertial Explorer", "", titles, units, *rows]))
    assert trajectory.span == (START_NS, START_NS + 300_000_000)
    lat, lon, height = trajectory.geodetic()
    assert np.degrees([lat[0], lon[0], lon[3]]) == pytest.approx([31.0, 121.0, 121.00003])
    assert height == pytest.approx([10.5] * 4)
    assert np.degrees([angle[0] for angle in trajectory.attitude()]) == pytest.approx([-2.0, 1.0, 359.0])
    # the file has no velocities; those of the path are 1e-5° of longitude each 0.1 s
    eastwards_mps = 10 * (prime_vertical_radius_m(lat[0]) + 10.5) * np.cos(lat[0]) * np.radians(1e-5)
    np.testing.assert_allclose(trajectory.velocity_l(), np.tile([0.0, eastwards_mps, 0.0], (4, 1)), atol=1e-5)


def dates(trajectory: Trajectory, form: str, leap_s: int = 0) -> list[str]:
    moments = [calendar(t, leap_s) for t in trajectory.time_ns.tolist()]
    return [moment.strftime(form) for moment in moments]


@pytest.mark.parametrize(
    ("titles", "units", "form", "settings"),
    [
        ("CorrTime", "(sec)", None, {"span_ns": SPAN}),
        ("CorrTime", "(sec)", None, {"week": WEEK}),
        ("GPSDate GPSTime", "(MDY) (HMS)", "%m/%d/%Y %H:%M:%S.%f", {}),
        ("GPSDate GPSTime", "(YMD) (HMS)", "%Y/%m/%d %H:%M:%S.%f", {}),
        ("Date UTCTime", "(YMD) (HMS)", "%Y/%m/%d %H:%M:%S.%f", {"leap_seconds": 18}),
    ],
)
def test_waypoint_times_are_read(titles: str, units: str, form: str | None, settings: dict[str, Any]) -> None:
    trajectory = flown(100)
    seconds = [time.split()[1] for time in weeks(trajectory)]
    times = seconds if form is None else dates(trajectory, form, 18 if "UTC" in titles else 0)
    np.testing.assert_array_equal(
        read(export(trajectory, times, titles, units), **settings).time_ns, trajectory.time_ns
    )


def test_waypoint_seconds_with_a_date_are_of_the_week_or_of_the_day() -> None:
    trajectory = flown(100)
    of_week = [f"{s.split()[1]} {d}" for s, d in zip(weeks(trajectory), dates(trajectory, "%m/%d/%Y"), strict=True)]
    assert read(export(trajectory, of_week, "CorrTime Date", "(sec) (MDY)")).span == trajectory.span
    of_day = [f"{float(text.split()[0]) - 6 * 86_400:.4f} {text.split()[1]}" for text in of_week]
    assert read(export(trajectory, of_day, "CorrTime Date", "(sec) (MDY)")).span == trajectory.span
    other_day = [text.replace("11/21/2026", "11/20/2026") for text in of_week]
    assert "dates and its seconds of the week are of different days" in refusal(
        export(trajectory, other_day, "CorrTime Date", "(sec) (MDY)")
    )


def test_waypoint_utc_takes_the_offset_of_its_header() -> None:
    trajectory = flown(100)
    times = dates(trajectory, "%m/%d/%Y %H:%M:%S.%f", 18)
    told = HEAD + "UTC Offset:  18 s\n"
    assert read(export(trajectory, times, "UTCDate UTCTime", "(MDY) (HMS)", told)).span == trajectory.span
    seconds = [f"{float(time.split()[1]) - 18:.4f}" for time in weeks(trajectory)]
    text = export(trajectory, seconds, "UTCTime", "(sec)", told)
    assert read(text, span_ns=SPAN).span == trajectory.span
    unsaid = export(trajectory, seconds, "UTCTime", "(sec)")
    assert "its time is UTC, of unknown leap seconds; export GPSTime and Week" in refusal(unsaid, span_ns=SPAN)
    unsure = export(trajectory, times, "UTCDate UTCTime", "(MDY) (HMS)")
    assert "this program knows leap seconds only until 2026-06-28; export it in GPS time" in refusal(unsure)


def test_a_wrong_waypoint_export_is_refused() -> None:
    trajectory = flown(100)
    good = export(trajectory, weeks(trajectory), *WEEKS)
    lines = good.splitlines()
    first = next(i for i, line in enumerate(lines) if line.startswith(str(WEEK)))
    assert "heights are above the geoid (H-MSL); export H-Ell" in refusal(good.replace("H-Ell ", "H-MSL "))
    assert "has no column of time; export GPSTime and Week" in refusal(good.replace("GPSTime", "Epoch  "))
    short = [*lines[: first + 5], lines[first + 5].rsplit(" ", 1)[0], *lines[first + 6 :]]
    assert f"line {first + 6}: 22 words are expected, 21 were found" in refusal("\n".join(short))
    letters = [*lines[: first + 5], lines[first + 5].replace("8 54", "8 x4"), *lines[first + 6 :]]
    assert f"counted from line {first + 1}" in refusal("\n".join(letters))
    turned = [*lines[:first], lines[first + 1], lines[first], *lines[first + 2 :]]
    assert f"time goes back by 0.050 s at line {first + 2}" in refusal("\n".join(turned))
    assert "has no column Roll; export roll, pitch and heading" in refusal(good.replace(" Roll ", " Rool "))
    none = good.replace(" Roll ", "    R ").replace(" Pitch ", "     P ").replace(" Heading ", "       H ")
    assert "no attitude; georeferencing needs roll, pitch and heading" in refusal(none)


@pytest.mark.parametrize(
    ("units", "others", "says"),
    [
        ("S)       (m)    (m/s)", "S)      (ft)    (m/s)", "its height is in (ft); export it in (m)"),
        ("(m/s)     (deg)", "(kph)     (deg)", "its v up is in (kph); export it in (m/s)"),
        ("(deg)      (m)", "(deg)     (ft)", "its sigma n is in (ft); export it in (m)"),
        ("(m)    (deg)", "(m)   (amin)", "its sigma roll is in (amin); export it in (deg) or (rad)"),
    ],
)
def test_waypoint_export_in_other_units_is_refused(units: str, others: str, says: str) -> None:
    """Heights of 900 ft would otherwise be read as 900 m without any other sign."""
    trajectory = flown(100)
    text = export(trajectory, weeks(trajectory), *WEEKS)
    assert text.count(units) == 1
    assert says in refusal(text.replace(units, others))


def test_waypoint_yaw_is_not_taken_for_heading() -> None:
    """Yaw counts from north to west: a yaw of 350° is a heading of 10°."""
    trajectory = flown(100)
    text = export(trajectory, weeks(trajectory), *WEEKS)
    assert "has no column Heading; export roll, pitch and heading" in refusal(text.replace(" Heading ", "     Yaw "))
    both = text.replace("   Heading     Pitch      Roll  SDNorth ", "   Yaw   Heading     Pitch      Roll  ")
    units = both.replace("     (deg)     (deg)     (deg)      (m) ", "     (deg)     (deg)     (deg)     (deg)")
    turned = [" ".join(move(line.split())) for line in units.splitlines() if line.startswith(str(WEEK))]
    lines = [line for line in units.splitlines() if not line.startswith(str(WEEK))]
    same(read("\n".join([*lines[:-2], *turned])), trajectory, 2e-5, 1e-10)


def move(words: list[str]) -> list[str]:
    """Return a line's cells with the heading twice, first as yaw, in place of the first sigma."""
    return [*words[:12], str(-float(words[12])), *words[12:15], *words[16:]]


# ---------------------------------------------------------------------------------------------------- RTKLIB

# The first lines of drive_0708/gnss_1934_sf.pos of rtklibexplorer/GNSS_IMU (BSD-3-Clause)
DRIVE = """\
%  GPST            latitude(deg) longitude(deg) height(m) Q         ns        sdn(m)    sde(m)    sdu(m)    sdne(m)   \
sdeu(m)   sdun(m)  age(s)     ratio     vn(m/s)   ve(m/s)    vu(m/s)    sdvn      sdve     sdvu   sdvne sdveu  sdvun
2025/07/08 19:34:18.499 40.0966268 -105.1474483 1601.4740000 1.0000000 21.0000000 0.0098995 0.0098995 0.0100000 \
0.0 0.0 0.0 0.0 0.0 0.0100000 -0.0020000 0.0090000 0.0586899 0.0586899 0.0586899 0.0 0.0 0.0
2025/07/08 19:34:18.749 40.0966268 -105.1474483 1601.4760000 1.0000000 21.0000000 0.0098995 0.0098995 0.0100000 \
0.0 0.0 0.0 0.0 0.0 0.0010000 0.0020000 -0.0060000 0.0558614 0.0558614 0.0558614 0.0 0.0 0.0
"""
ELLIPSOIDAL = "% (lat/lon/height=WGS84/ellipsoidal,Q=1:fix,2:float,3:sbas,4:dgps,5:single,6:ppp,ns=# of satellites)\n"
PROGRAM = "% program   : RTKPOST ver.2.4.3\n% inp file  : rover.obs\n" + ELLIPSOIDAL


def positions(text: str, **settings: Any) -> Trajectory:
    return read(text, needs_attitude=False, **settings)


def test_rtklib_positions_of_a_drive_are_read() -> None:
    """By the data set's notes the first epoch is 243 258.499 s of week 2374; sigmas and velocities are as printed."""
    drive = positions(DRIVE)
    assert drive.time_ns.tolist() == [2374 * 604_800 * 10**9 + ms * 10**6 for ms in (243_258_499, 243_258_749)]
    lat, lon, height = drive.geodetic()
    assert np.degrees([lat[0], lon[0]]) == pytest.approx([40.0966268, -105.1474483], abs=1e-12)
    assert height == pytest.approx([1601.474, 1601.476], abs=1e-8)
    assert drive.position_sigma_l[0] == pytest.approx([0.0098995, 0.0098995, 0.01])
    assert drive.velocity_l()[1] == pytest.approx([0.001, 0.002, 0.006])
    assert not drive.has_attitude
    assert "has positions but no attitude; georeferencing needs roll, pitch and heading" in refusal(DRIVE)


def test_rtklib_weeks_utc_degrees_minutes_and_separators_are_read() -> None:
    gpst = positions(DRIVE)
    by_week = DRIVE.replace("2025/07/08 19:34:18.499", "2374 243258.499").replace(
        "2025/07/08 19:34:18.749", "2374 243258.749"
    )
    assert positions(by_week).span == gpst.span
    utc = DRIVE.replace("GPST", "UTC ").replace("19:34:18", "19:34:00")
    assert positions(utc).span == gpst.span
    assert positions(utc, leap_seconds=17).span[0] == gpst.span[0] - 10**9
    assert positions(PROGRAM + DRIVE.replace("  GPST", "%  GPST").replace("%%", "%")).span == gpst.span
    sexagesimal = (
        DRIVE.replace("(deg)", "(d'\")")
        .replace("40.0966268", "40 5 47.85648")
        .replace("-105.1474483", "-105 8 50.81388")
    )
    np.testing.assert_allclose(positions(sexagesimal).position_e, gpst.position_e, atol=1e-3)
    head, *rows = DRIVE.splitlines()
    commas = "\n".join([head, *(row.replace(" ", ",") for row in rows)])
    np.testing.assert_array_equal(positions(commas).position_e, gpst.position_e)


def test_rtklib_earth_centred_positions_and_their_sigmas_are_read() -> None:
    """A covariance of north, east, down of 1, 2, 3 cm, rotated to ECEF by differences of PROJ, is recovered."""
    place = np.array([-60.0, 47.5, 600.0])
    to_e = np.stack(
        [
            np.subtract(*(TO_ECEF.transform(*(place + sign * np.array(shift))) for sign in (1, -1)))
            for shift in ([0, 1e-5, 0], [1e-5, 0, 0], [0, 0, -1.0])
        ],
        axis=1,
    )
    to_e /= np.linalg.norm(to_e, axis=0)
    covariance = to_e @ np.diag([1e-4, 4e-4, 9e-4]) @ to_e.T
    sd = [
        np.sign(v) * np.sqrt(abs(v))
        for v in (*np.diag(covariance), covariance[0, 1], covariance[1, 2], covariance[2, 0])
    ]
    x, y, z = TO_ECEF.transform(*place)
    rows = [
        f"2026/11/21 12:00:0{i}.000 {x:.4f} {y:.4f} {z:.4f} 1 9 {' '.join(f'{s:.9f}' for s in sd)} 0 9" for i in (0, 1)
    ]
    columns = "%  GPST  x-ecef(m) y-ecef(m) z-ecef(m) Q ns sdx(m) sdy(m) sdz(m) sdxy(m) sdyz(m) sdzx(m) age(s) ratio"
    found = positions("\n".join(["% (x/y/z-ecef=WGS84,Q=1:fix)", columns, *rows]))
    assert found.position_sigma_l[0] == pytest.approx([0.01, 0.02, 0.03], abs=1e-7)
    assert found.position_e[0] == pytest.approx([x, y, z], abs=1e-4)


def test_a_wrong_rtklib_file_is_refused() -> None:
    assert "heights are above the geoid; export ellipsoidal heights" in refusal(
        ELLIPSOIDAL.replace("ellipsoidal", "geodetic") + DRIVE
    )
    assert "Japan Standard Time; export it in GPST" in refusal(DRIVE.replace("GPST", "JST "))
    assert "'19-34-18.499' is not a time of day" in refusal(DRIVE.replace("19:34:18.499", "19-34-18.499"))
    assert "'19:34:inf' is not a time of day" in refusal(DRIVE.replace("19:34:18.749", "19:34:inf"))
    for date in ("2025-07-08 19:34:18.499", "237x 243258.499", "2374 nan"):
        said = f"'{date}' is neither a date with a time of day nor a GPS week with its seconds"
        assert said in refusal(DRIVE.replace("2025/07/08 19:34:18.499", date))
    assert "has no positions" in refusal(DRIVE.splitlines()[0] + "\n")
    assert "line 3: 24 fields are expected, 23 were found" in refusal(DRIVE.replace("-0.0060000 ", ""))
    baseline = DRIVE.replace("latitude(deg) longitude(deg) height(m)", "e-baseline(m) n-baseline(m) u-baseline(m)")
    assert "has neither latitude, longitude and height nor ECEF" in refusal(baseline)


@pytest.mark.parametrize("text", ["<kml></kml>", "time lat lon\n1 2 3\n", "% a comment\n1 2 3\n", " \n"])
def test_other_text_files_are_refused_as_trajectories(text: str) -> None:
    assert "is not a trajectory; give SBET, Waypoint text, RTKLIB .pos or trajectory CSV" in refusal(text)
