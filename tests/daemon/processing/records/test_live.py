"""Tests the GPS times that records get as they come, against times that the test knows."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from swath.daemon.config import parse_config
from swath.daemon.log.format import SessionInfo
from swath.daemon.processing.records.live import LiveClocks, live_clocks
from swath.daemon.processing.records.tables import KINDS, table_of
from swath.georef.records import (
    DEVICE_CLOCK_DTYPE,
    IMU_DTYPE,
    INS_DTYPE,
    RETURN_DTYPE,
    DeviceClockSamples,
    DeviceStatus,
    EventMark,
    FixType,
    GnssFix,
    ImuSamples,
    InsSolution,
    NamesEdge,
    PpsEdge,
    ScannerReturns,
    TimeMessage,
    TimeScale,
    TimeTag,
)

S = 1_000_000_000
WEEK = 2400
START_NS = WEEK * 604_800 * S + 100_000 * S  # GPS
HOST_NS = 1_750_000_000 * S  # host time of the start; the host's clock runs 20 ppm fast
FAST = 1.00002
DEVICE_NS = 77 * S  # a device's counter at the start, 30 ppm slow
SLOW = 0.99997
TABLES = """
[session]
name = "x"
directory = "."
[pps.main]
source = "/dev/pps0"
[gnss.rover]
transport = "serial:/dev/ttyUSB0"
protocol = "nmea"
pps = "main"
[imu.main]
transport = "serial:/dev/ttyUSB1"
protocol = "vectornav"
rate_hz = 100
pps = "main"
[scanner.left]
transport = "udp:0.0.0.0:2368"
protocol = "srep"
mirror_factor = 1.0
pps = "main"
"""


def host(seconds: float) -> int:
    return HOST_NS + round(seconds * FAST * S)


def device(seconds: float) -> int:
    return DEVICE_NS + round(seconds * SLOW * S)


def tag(seconds: float) -> TimeTag:
    return TimeTag(TimeScale.GPS, 100_000 * S + round(seconds * S), week=WEEK)


def message(second: int, late_s: float = 0.1) -> TimeMessage:
    return TimeMessage(host(second + late_s), tag(second), NamesEdge.PREVIOUS, message="ZDA")


def made(config: str = TABLES) -> LiveClocks:
    info = SessionInfo("x", "", "", "", HOST_NS, 0)
    clocks = live_clocks(parse_config(config, Path("x.toml")), info)
    clocks.add_reading(HOST_NS, 0, 0)
    return clocks


def clock_row(seconds: float) -> DeviceClockSamples:
    row = np.zeros(1, DEVICE_CLOCK_DTYPE)
    row["host_time_ns"], row["device_time_ns"] = host(seconds + 0.002), device(seconds)
    row["pps_time_ns"], row["pps_count"], row["locked"] = device(int(seconds)), int(seconds) + 1, 1
    return DeviceClockSamples(row)


@pytest.fixture(scope="module")
def clocks() -> LiveClocks:
    """Run for 30 s: edges, messages 0.1 s after them, readings of the host's clocks, and the devices' counters."""
    clocks = made()
    for tenth in range(300):
        seconds = tenth / 10
        monotonic_ns = host(seconds) - HOST_NS
        clocks.add_reading(host(seconds), monotonic_ns, monotonic_ns)
        if tenth % 10 == 0:
            clocks.add_edge("pps/main", PpsEdge(host(seconds), tenth // 10))
        if tenth % 10 == 1:
            clocks.take("gnss/rover", [message(tenth // 10)])
        clocks.take("scanner/left", [clock_row(seconds)])
        clocks.take("imu/main", [samples(seconds)])
    return clocks


def samples(seconds: float, count: int = 10, **fields: Any) -> ImuSamples:
    rows = np.zeros(count, IMU_DTYPE)
    at = seconds + np.arange(count) / 100
    rows["host_time_ns"] = [host(one + 0.001) for one in at]
    rows["device_time_ns"] = [device(one) for one in at]
    rows["pps_time_ns"], rows["gps_week"] = [device(int(one)) for one in at], -1
    for name, value in fields.items():
        rows[name] = value
    return ImuSamples(rows)


def test_the_clock_of_the_pulse_is_known(clocks: LiveClocks) -> None:
    assert clocks.state("imu/main", host(30.0)) is None
    for source in ("pps/main", "gnss/rover"):
        found = clocks.state(source, host(30.0))
        assert found is not None
        assert found[0] == "LOCKED"
        assert 0.0 < found[1] < 1e-3


@pytest.mark.parametrize("source", ["imu/main", "scanner/left"])
def test_rows_have_the_time_of_their_devices_counter(clocks: LiveClocks, source: str) -> None:
    at = 29.9 + np.arange(5) / 100
    record: ImuSamples | ScannerReturns = samples(29.9, 5)
    if source == "scanner/left":
        rows = np.zeros(5, RETURN_DTYPE)
        rows["host_time_ns"] = [host(one + 0.002) for one in at]
        rows["device_time_ns"] = [device(one) for one in at]
        record = ScannerReturns(rows)
    (times,) = clocks.take(source, [record], late=True)
    error_s = (times.gps_ns - START_NS - np.rint(at * S)) * 1e-9
    assert (times.sigma_s > 0.0).all()
    assert (np.abs(error_s) < np.minimum(4.0 * times.sigma_s, 2e-4)).all()
    table = table_of(KINDS["samples" if source == "imu/main" else "returns"], [record], [times])
    assert table["gps_ns"].tolist() == times.gps_ns.tolist()
    assert table["time_sigma_s"].tolist() == times.sigma_s.tolist()


def test_records_have_the_time_that_they_name_and_others_that_of_their_arrival(clocks: LiveClocks) -> None:
    solution = np.zeros(2, INS_DTYPE)
    solution["gps_ns"], solution["host_time_ns"] = (START_NS, -1), host(29.0)
    fix = GnssFix(host(29.3), tag(29.2), 0.8, 0.1, 500.0, fix_type=FixType.SINGLE)
    mark = EventMark(host(29.3), tag(29.25), "1", sigma_s=2e-8)
    status = DeviceStatus(host(29.4))
    found = clocks.take("gnss/rover", [fix, InsSolution(solution), status, mark])
    assert [times.gps_ns.tolist() for times in found[:2]] == [[START_NS + 29_200_000_000], [START_NS, -1]]
    assert found[0].sigma_s.tolist() == [0.0]
    assert np.isnan(found[1].sigma_s).tolist() == [False, True]
    assert abs(int(found[2].gps_ns[0]) - START_NS - 29_400_000_000) < 1_000_000
    assert 0.0 < found[2].sigma_s[0] < 1e-3
    assert (found[3].gps_ns.tolist(), found[3].sigma_s.tolist()) == ([START_NS + 29_250_000_000], [2e-8])
    (own,) = clocks.take("imu/main", [samples(1.0, 2, gps_week=WEEK, device_time_ns=S)])
    assert own.gps_ns.tolist() == [WEEK * 604_800 * S + S] * 2
    assert own.sigma_s.tolist() == [0.0, 0.0]


def test_nothing_is_known_before_the_clock_and_of_late_messages() -> None:
    """Messages that lay in a port's buffer for 3 s would name wrong edges."""
    clocks = made()
    for second in range(12):
        clocks.add_edge("pps/main", PpsEdge(host(second), second))
        clocks.take("gnss/rover", [message(second, late_s=3.1)], late=True)
    (times,) = clocks.take("imu/main", [samples(11.5, 3)])
    assert times.gps_ns.tolist() == [-1] * 3
    assert np.isnan(times.sigma_s).all()
    (late,) = clocks.take("imu/main", [samples(11.6, 3, device_time_ns=-1)], late=True)
    assert late.gps_ns.tolist() == [-1] * 3
    state = clocks.state("pps/main", host(12.0))
    assert state is not None
    assert state[0] == "NO_TIME"
    assert clocks.take("gnss/rover", []) == []


def test_a_time_by_guessed_leap_seconds_says_so() -> None:
    """The day is after the built-in table of leap seconds, and the receiver does not send them."""
    clocks = made()
    date = np.datetime64("2100-01-01").astype(object)
    found = []
    for second in range(12):
        utc = TimeTag(TimeScale.UTC, second * S, date=date)
        clocks.add_edge("pps/main", PpsEdge(host(second), second))
        told = TimeMessage(host(second + 0.1), utc, NamesEdge.PREVIOUS, message="RMC")
        found += clocks.take("gnss/rover", [told, GnssFix(host(second + 0.1), utc, 0.8, 0.1, 500.0)])
    assert [times.sigma_s.tolist() for times in found[-2:]] == [[1.0], [1.0]]
