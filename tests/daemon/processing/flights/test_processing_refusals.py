"""Tests that files which do not fit together are refused in one line that names both."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from swath.daemon.config.config import Config
from swath.daemon.config.load import parse_config
from swath.daemon.errors import UserError
from swath.daemon.processing.files import refuse_no_name
from swath.daemon.processing.flights.read import (
    note_strips_elsewhere,
    of_log,
    refuse_different_settings,
    refuse_overlap,
)
from swath.daemon.processing.flights.trajectory_choice import attitude_doubts, refuse_other_motion
from swath.daemon.processing.georeferencing.run import refuse_nothing
from swath.daemon.processing.georeferencing.sidecar import unit_doubts
from swath.daemon.processing.points.clocks import LogClocks
from swath.daemon.processing.points.time_checks import refuse_no_time, time_trouble
from swath.daemon.processing.setup.setup import Options
from swath.daemon.processing.undecoded import Undecoded, undecoded_lines
from swath.drivers.parser import Parser, ParserCounters
from swath.georef.mapping.frame import Mapping
from swath.georef.records import INS_DTYPE
from swath.georef.timescales import ClockStatus, TimeState
from swath.georef.trajectory.trajectory import Trajectory

S = 1_000_000_000
A, B = Path("a.mcap"), Path("b.mcap")
TEXT = """
[session]
name = "x"
directory = "."
[gnss.rover]
transport = "serial:/dev/null?baud=9600"
protocol = "novatel"
lever_arm_m = {arm}
[output]
crs = "{crs}"
epoch = {epoch}
"""


def config(arm: str = "[0.1, 0.0, -1.2]", crs: str = "EPSG:25832", epoch: float = 2026.5) -> Config:
    return parse_config(TEXT.format(arm=arm, crs=crs, epoch=epoch), Path("swath.toml"))


def line(refused: Any) -> str:
    """Return the error's text, which must be one line."""
    text = str(refused.value)
    assert "\n" not in text
    return text


def test_logs_with_different_frames_are_refused() -> None:
    configs = {A: config(), B: config(crs="EPSG:2056")}
    with pytest.raises(UserError) as refused:
        refuse_different_settings(configs, None)
    assert all(word in line(refused) for word in ("a.mcap", "b.mcap", "EPSG:2056", "EPSG:25832", "--crs"))
    refuse_different_settings(configs, "EPSG:25832")
    with pytest.raises(UserError, match=r"output\.epoch is 2020\.0"):
        refuse_different_settings({A: config(), B: config(epoch=2020.0)}, None)
    refuse_different_settings({A: config(), B: config()}, None)


def test_a_given_epoch_overrides_different_ones_and_a_frame_does_not() -> None:
    configs = {A: config(), B: config(epoch=2020.0)}
    refuse_different_settings(configs, None, epoch=2026.5)
    with pytest.raises(UserError, match=r"output\.epoch is 2020\.0, .* set one with --epoch"):
        refuse_different_settings(configs, "EPSG:25832")


def test_sessions_with_positions_in_different_datums_are_refused() -> None:
    other = parse_config(
        TEXT.format(arm="[0.1, 0.0, -1.2]", crs="EPSG:25832", epoch=2026.5).replace(
            'protocol = "novatel"', 'protocol = "novatel"\ndatum = "EPSG:7912"'
        ),
        Path("swath.toml"),
    )
    with pytest.raises(UserError) as refused:
        refuse_different_settings({A: config(), B: other}, None)
    words = ("b.mcap", "in EPSG:7912", "in an unspecified datum", "--trajectory-datum")
    assert all(word in line(refused) for word in words)
    refuse_different_settings({A: config(), B: other}, None, "EPSG:7912")
    refuse_different_settings({A: other, B: other}, None)


@pytest.mark.parametrize("name", ["../x", "/tmp/x", "a/b", "", ".", "..", "a\0b", "a\nb", "x" * 300])
def test_a_session_name_that_is_a_path_is_refused(name: str) -> None:
    with pytest.raises(UserError, match="is not a valid file name"):
        refuse_no_name(name, A)
    refuse_no_name("flight-20261125T101500Z-ab12", A)


def test_sessions_with_different_antennas_are_refused() -> None:
    with pytest.raises(UserError) as refused:
        refuse_different_settings({A: config(), B: config(arm="[0.1, 0.0, -1.3]")}, None)
    assert all(word in line(refused) for word in ("gnss.rover.lever_arm_m", "-1.3", "-1.2", "the antennas differ"))


def test_overlapping_logs_are_refused() -> None:
    refuse_overlap({B: (200, 300), A: (0, 200)})
    with pytest.raises(UserError) as refused:
        refuse_overlap({B: (199, 300), A: (0, 200)})
    assert all(word in line(refused) for word in ("a.mcap", "b.mcap", "the recordings overlap in time"))


def test_an_uncertain_second_and_a_missing_time_are_refused() -> None:
    good = ClockStatus(TimeState.LOCKED, 100.0)
    settings = config()
    refuse_no_time(A, "pps/main", good, settings)
    with pytest.raises(UserError, match="uncertain: messages contradict"):
        refuse_no_time(A, "pps/main", ClockStatus(TimeState.COARSE, 1e8, ambiguous="messages contradict"), settings)
    silent = ClockStatus(TimeState.NO_TIME, float("inf"))
    with pytest.raises(UserError, match="the log has no time; record"):
        refuse_no_time(A, "gnss/rover", silent, settings)
    with pytest.raises(UserError, match="no source of time"):
        refuse_no_time(A, None, None, settings)


def test_edges_without_a_receiver_that_names_them_are_refused() -> None:
    silent = ClockStatus(TimeState.NO_TIME, float("inf"))
    with pytest.raises(UserError, match=r"no gnss.….pps is set") as refused:
        refuse_no_time(A, "pps/main", silent, config())
    assert "pps/main" in line(refused)
    tables = TEXT.format(arm="[0.1, 0.0, -1.2]", crs="EPSG:25832", epoch=2026.5)
    tables = tables.replace('"novatel"', '"novatel"\npps = "other"') + '[pps.other]\nsource = "/dev/pps1"\n'
    with pytest.raises(UserError, match=r'gnss.rover.pps is "other"'):
        refuse_no_time(A, "pps/main", silent, parse_config(tables, Path("swath.toml")))
    with pytest.raises(UserError, match="the log has no time; record"):
        refuse_no_time(A, "pps/other", silent, parse_config(tables, Path("swath.toml")))


@pytest.mark.parametrize(
    ("refused", "state", "words"),
    [
        ({"past_hour": 5}, TimeState.LOCKED, "locked to another second"),
        ({"spacing": 3}, TimeState.LOCKED, "3 edges that it latched"),
        ({}, TimeState.LOCKED, "run free"),
        ({}, TimeState.COARSE, "the host's clock is coarse"),
    ],
)
def test_the_reason_for_returns_without_time_is_given(refused: dict[str, int], state: TimeState, words: str) -> None:
    fates = {"no_time": 500, "georeferenced": 500}
    told = time_trouble("left", fates, refused, ClockStatus(state, 1.0))
    assert words in told
    assert "500 of 1,000 returns" in told
    assert time_trouble("left", {"no_time": 10, "georeferenced": 990}, refused, None) == ""
    with pytest.raises(UserError, match="have no time"):
        refuse_nothing(A, [told], "")
    with pytest.raises(UserError, match=r"a\.mcap: no return could be georeferenced: 7 outside trajectory"):
        refuse_nothing(A, [], "7 outside trajectory")


def turning(time_ns: np.ndarray[Any, np.dtype[np.int64]], seed: int = 1) -> Trajectory:
    """Return a flight that rolls slowly and at random, always in one place."""
    n = len(time_ns)
    since_s = (time_ns - time_ns[0])[:, np.newaxis] / 1e9
    phase = np.random.default_rng(seed).uniform(0.0, 2 * np.pi, 40)
    roll = 0.015 * np.sin(2 * np.pi * np.linspace(0.02, 0.16, 40) * since_s + phase).sum(axis=1)
    level, lat, lon, height = (np.full(n, value) for value in (0.0, 0.8, 0.15, 800.0))
    return Trajectory.from_geodetic(time_ns, lat, lon, height, np.zeros((n, 3)), roll, level, level)


def test_a_trajectory_that_turns_at_another_time_is_warned_about_or_refused() -> None:
    time_ns = 1_465_549_218_000_000_000 + np.arange(0, 240 * S, S // 20)
    flown = turning(time_ns)
    clocks = LogClocks(
        cast(Any, None), np.empty(0, INS_DTYPE), time_ns, np.vstack([np.zeros(3), flown.turn_rates_b("i")])
    )
    assert refuse_other_motion(clocks, flown, "x.csv", A) == []
    (late,) = refuse_other_motion(clocks, replace(flown, time_ns=time_ns + S // 8), "x.csv", A)
    assert late.startswith("x.csv: its turns lag those of the IMU in a.mcap by 0.12")
    assert late.endswith("its time may be off by this amount")
    with pytest.raises(UserError, match=r"x\.csv: its time is UTC"):
        refuse_other_motion(clocks, replace(flown, time_ns=time_ns - 18 * S), "x.csv", A)


@dataclass
class Flew:
    """Stand-in for a flight to which a file of strips is compared."""

    span: tuple[int, int]
    holes: list[str] = field(default_factory=list)


def test_strip_times_outside_every_log_are_refused() -> None:
    flights: list[Any] = [Flew((0, 100)), Flew((200, 300))]
    note_strips_elsewhere("s.csv", [(50, 120), (250, 260)], flights)
    assert flights[0].holes == []
    note_strips_elsewhere("s.csv", [(50, 120), (300, 310)], flights)
    (hole,) = flights[0].holes
    assert hole.startswith("s.csv: its strip from GPS week 0")
    with pytest.raises(UserError, match=r"s\.csv: none of its strips lies in the logs"):
        note_strips_elsewhere("s.csv", [(120, 200), (300, 310)], flights)


def test_error_in_the_configuration_of_a_log_names_the_log() -> None:
    lines = ["imu.main: dbc: missing", "left.toml: calibration.scanner: is of another", 'output.crs = "x" is none']
    given = Options(crs="x", calibrations={"left": ("", "left.toml")})
    assert of_log(A, lines, given) == ["a.mcap: imu.main: dbc: missing", *lines[1:]]
    assert of_log(A, lines, Options()) == [f"a.mcap: {said}" for said in lines]


def test_undecoded_messages_are_reported() -> None:
    counts = {"left": {"bad_version": 3, "sequence_gap": 3, "bad_magic": 2}, "right": {"sequence_gap": 7}}
    holes, warnings = undecoded_lines("a.mcap", counts)
    assert holes == [
        "a.mcap: 3 messages of scanner/left were not read: a version of the protocol that this program does not read"
    ]
    assert warnings == [
        "a.mcap: 2 messages of scanner/left were not read: no sign of the protocol",
        "a.mcap: 7 messages of scanner/right did not arrive, by their sequence numbers",
    ]


def test_only_the_messages_of_the_piece_itself_count() -> None:
    parser = cast(Parser, SimpleNamespace(counters=ParserCounters()))
    unread = Undecoded({"left": parser})
    for own in (False, True, True, False):
        parser.counters.bad_checksums += 1
        parser.counters.errors["bad_version"] += 10
        parser.counters.errors["duplicate"] += 100
        unread.note(own=own)
    assert unread.counts == {"left": {"bad_checksum": 2, "bad_version": 20}}


@pytest.mark.parametrize(("crs", "doubts"), [("EPSG:32632", 0), ("EPSG:6529", 1)])
def test_a_height_unit_other_than_the_horizontal_unit_gives_a_warning(crs: str, doubts: int) -> None:
    flight = SimpleNamespace(setup=SimpleNamespace(mapping=Mapping(crs, datum="same")))
    lines = unit_doubts(cast(Any, flight))
    assert len(lines) == doubts
    assert all("in US survey foot, heights in metre above the ellipsoid: EPSG:6529" in line for line in lines)


def level_flight(
    heading_rad: float, roll_rad: float, course_rad: float = 1.0, speed_mps: float = 50.0, seconds: int = 60
) -> Trajectory:
    """Return a straight flight at constant speed; its place is constant, which does not matter here."""
    time_ns = 1_465_549_218_000_000_000 + np.arange(0, seconds * S, S // 10)
    n = len(time_ns)
    level, lat, lon, height = (np.full(n, value) for value in (0.0, 0.8, 0.15, 800.0))
    velocity = np.tile(speed_mps * np.array([np.cos(course_rad), np.sin(course_rad), 0.0]), (n, 1))
    return Trajectory.from_geodetic(
        time_ns, lat, lon, height, velocity, np.full(n, roll_rad), level, np.full(n, heading_rad)
    )


@pytest.mark.parametrize(
    ("flown", "words"),
    [
        (level_flight(1.0, 0.1), []),
        (level_flight(1.0 - np.radians(30.0), 0.0), []),  # the strongest crosswind that is accepted
        (level_flight(1.0, np.pi - 0.05), ["its z axis points up, so the body would fly upside down"]),
        (level_flight(1.0 + np.pi / 2, 0.0), ["its x axis points +90° beside the course"]),
        (level_flight(1.0 - np.radians(100.0), 0.0), ["its x axis points -100° beside the course"]),
        (level_flight(1.0 + np.pi, np.pi), ["its z axis points up", "its x axis points"]),
        (level_flight(2.0, 0.0, speed_mps=3.0), []),  # hovering, or on the ground
        (level_flight(1.0, 0.0, seconds=0), []),
    ],
)
def test_an_attitude_about_other_axes_gives_a_warning(flown: Trajectory, words: list[str]) -> None:
    lines = attitude_doubts(flown, "x.out")
    assert len(lines) == len(words)
    for line, word in zip(lines, words, strict=True):
        assert line.startswith(f"x.out: {word}")
        assert "rotation_b_imu" in line
