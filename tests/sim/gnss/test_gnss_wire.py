"""Tests the receiver's bytes with this project's and other parsers, against PROJ, SciPy and the calendar."""

from __future__ import annotations

import datetime as dt
import io
import math
import struct
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pynmea2
import pytest
from pyubx2 import UBXReader

from swath.daemon.config.tables import GnssConfig
from swath.drivers.driver import find_driver
from swath.drivers.parser import DeviceSettings
from swath.georef.arrays import FloatArray
from swath.georef.records import (
    Chunk,
    FixType,
    GnssFix,
    GnssHeading,
    InsSolution,
    NamesEdge,
    Record,
    TimeMessage,
)
from swath.georef.timescales import whole_gps_ns
from swath.sim.clocks import PulsePerSecond
from swath.sim.gnss.receiver import Receiver
from swath.sim.gnss.wire import GnssWire, config_table
from swath.sim.plan.errors import PlanError
from swath.sim.plan.plan import Plan, parse_plan
from swath.sim.plan.tables import PpsTable
from swath.sim.shots import WireUnit
from tests.sim.circling import Circling, geodetic

PLAN = """
[flight]
name = "gnss"
[[line]]
name = "a"
from_m = [0.0, 0.0]
to_m = [1000.0, 0.0]
height_m = 900.0
"""
LEVER_ARM = [0.8, -0.6, -1.9]
SECOND_ARM = [0.8, 0.9, -1.9]
PROTOCOLS = ("novatel", "ubx", "nmea")
LEAP_S = 18
EARTH_M = 6.4e6
# Half a unit of the wire, for latitude and longitude on the ground, height and velocity. NovAtel sends doubles, whose
# limit is the arithmetic of this test; NMEA sends 1e-8 minutes, 0.1 mm, 1e-4 knots, and 1e-4 degrees of course.
POSITION_M = {
    "novatel": 1e-6,
    "ubx": math.radians(0.5e-9) * EARTH_M + 1e-6,
    "nmea": math.radians(0.5e-8 / 60) * EARTH_M + 1e-6,
}
HEIGHT_M = {"novatel": 1e-6, "ubx": 0.5e-4 + 1e-6, "nmea": 1.0e-4 + 1e-6}  # nmea: altitude and separation
VELOCITY_MPS = {
    "novatel": 3e-6,
    "ubx": 0.5e-3 + 3e-6,
    "nmea": 0.5e-4 * 1852 / 3600 + 61 * math.radians(0.5e-4) + 3e-6,
}


@dataclass
class Flight:
    """A receiver on a circling body, and the bytes that it sends."""

    plan: Plan
    wire: GnssWire
    aircraft: Circling
    pulse: PulsePerSecond

    def units(self, stop_s: float) -> list[WireUnit]:
        """Return the units from the start."""
        return self.wire.units(0.0, stop_s)

    def records(self, stop_s: float) -> list[Record]:
        """Return what the project's parser reads from the bytes; host time is nanoseconds since the plan's start."""
        return parsed(self.plan, self.units(stop_s))

    def time_s(self, record: GnssFix | GnssHeading | TimeMessage) -> float:
        """Return the record's own time, seconds since the plan's start, by the calendar."""
        assert record.time is not None
        gps_ns = whole_gps_ns(record.time, LEAP_S)
        assert gps_ns is not None
        return (gps_ns - start_gps_ns(self.plan)) / 1e9


def start_gps_ns(plan: Plan) -> int:
    """Return the GPS time of the plan's start computed from the calendar alone."""
    since = plan.tables.flight.start - dt.datetime(1980, 1, 6, tzinfo=dt.UTC)
    return (round(since.total_seconds()) + LEAP_S) * 1_000_000_000


def flight(*, level: bool = False, start: str = "", noise: bool = False, end_s: float = 1000.0, **keys: Any) -> Flight:
    """Return a plan with one receiver; ``keys`` are those of its table."""
    changes: dict[str, Any] = {"flight": {"noise": noise}, "gnss": {"rover": {"lever_arm_m": LEVER_ARM} | keys}}
    text = PLAN.replace('name = "gnss"', f'name = "gnss"\nstart = {start}') if start else PLAN
    plan = parse_plan(text, Path()).changed(changes)
    table, aircraft = plan.tables.gnss["rover"], Circling(level=level, end_s=end_s)
    pulse = PulsePerSecond(PpsTable(jitter_ns=40.0), 5, "main", noise=True)
    receiver = Receiver(table, aircraft, seed=plan.tables.flight.seed, name="rover", noise=noise)
    return Flight(plan, GnssWire(plan, "rover", receiver, pulse), aircraft, pulse)


def parsed(plan: Plan, units: list[WireUnit]) -> list[Record]:
    """Parse unit by unit, as the recorder does."""
    parser = find_driver("gnss", plan.tables.gnss["rover"].protocol).make_parser(DeviceSettings("gnss/rover", {}))
    records = [r for unit in units for r in parser.feed(Chunk(unit.source, round(unit.time_s * 1e9), unit.data))]
    records += parser.close()
    assert parser.counters.bad_messages == 0
    assert not parser.counters.errors
    return records


def of(kind: type[Any], records: list[Record]) -> list[Any]:
    """Return the records of a type."""
    return [record for record in records if isinstance(record, kind)]


def stream(units: list[WireUnit]) -> bytes:
    """Return all bytes."""
    return b"".join(unit.data for unit in units)


def true_geodetic(at: Flight, time_s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the true position of the antenna."""
    return geodetic(at.aircraft.point_e(LEVER_ARM, time_s))


def ground_m(lat: FloatArray, lon: FloatArray, true_lat: FloatArray, true_lon: FloatArray) -> FloatArray:
    """Return approximately the larger of the north and east differences, m."""
    return np.maximum(np.abs(lat - true_lat), np.abs(lon - true_lon)) * EARTH_M


# ------------------------------------------------------------------------------------- what the messages say


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_positions_match_the_antenna(protocol: str) -> None:
    at = flight(protocol=protocol, rate_hz=10, undulation_m=47.3)
    fixes = [fix for fix in of(GnssFix, at.records(8.0)) if fix.lat_rad is not None]
    time_s = np.array([at.time_s(fix) for fix in fixes])
    assert np.abs(time_s - np.arange(len(fixes)) / 10).max() < 1e-9
    assert len(fixes) == 80
    lat, lon, height = true_geodetic(at, time_s)
    found = np.array([(fix.lat_rad, fix.lon_rad, fix.height_m) for fix in fixes])
    assert ground_m(found[:, 0], found[:, 1], lat, lon).max() < POSITION_M[protocol]
    assert np.abs(found[:, 2] - height).max() < HEIGHT_M[protocol]
    assert {fix.fix_type for fix in fixes} == {FixType.RTK_FIXED}
    assert {fix.satellites for fix in fixes} == {20}
    assert all(fix.valid and fix.antenna == "primary" for fix in fixes)


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_velocities_match_the_antenna_at_their_stated_time(protocol: str) -> None:
    at = flight(protocol=protocol, rate_hz=20)
    fixes = [fix for fix in of(GnssFix, at.records(8.0)) if fix.velocity_l is not None]
    time_s = np.array([at.time_s(fix) for fix in fixes])
    assert len(fixes) > 155
    error_l = np.array([fix.velocity_l for fix in fixes]) - at.aircraft.velocity_of(LEVER_ARM, time_s)
    if protocol == "nmea":
        assert np.isnan(error_l[:, 2]).all()
        error_l = error_l[:, :2]
    assert np.abs(error_l).max() < VELOCITY_MPS[protocol]


@pytest.mark.parametrize("protocol", PROTOCOLS)
@pytest.mark.parametrize(("grade", "sigma"), [("rtk", [0.0108, 0.0108, 0.0208]), ("spp", [1.2166, 1.2166, 2.01])])
def test_sigmas_and_fix_types_match_the_grade(protocol: str, grade: str, sigma: list[float]) -> None:
    at = flight(protocol=protocol, grade=grade)
    fix = next(fix for fix in of(GnssFix, at.records(3.0)) if fix.lat_rad is not None)
    assert fix.fix_type is (FixType.RTK_FIXED if grade == "rtk" else FixType.SINGLE)
    assert fix.position_cov_l is not None
    reported = np.sqrt(np.diag(fix.position_cov_l))
    np.testing.assert_allclose(reported, 0.8 * np.array(sigma), rtol=0.005)


def test_ubx_epoch_carries_its_velocity_covariance() -> None:
    fix = of(GnssFix, flight(protocol="ubx").records(3.0))[0]
    np.testing.assert_allclose(np.sqrt(np.diag(fix.velocity_cov_l)), 0.8 * np.array([0.01, 0.01, 0.02]), rtol=1e-6)


@pytest.mark.parametrize("protocol", ["novatel", "nmea"])
def test_heading_of_an_antenna_to_the_right_is_ninety_degrees_more(protocol: str) -> None:
    at = flight(protocol=protocol, level=True, secondary_lever_arm_m=SECOND_ARM, rate_hz=1)
    headings = of(GnssHeading, at.records(65.0))  # more than a full turn
    assert len(headings) == 65
    time_s = np.arange(65.0)
    want = at.aircraft.attitude(time_s)[2] + math.pi / 2
    error = (np.array([heading.heading_rad for heading in headings]) - want + math.pi) % (2 * math.pi) - math.pi
    # float32 of up to 360 degrees; four digits of a degree
    assert np.abs(error).max() < math.radians(2.0**-16 if protocol == "novatel" else 0.5e-4) + 1e-6
    if protocol == "novatel":
        assert [at.time_s(heading) for heading in headings] == pytest.approx(time_s, abs=1e-9)
        assert np.abs([heading.pitch_rad for heading in headings]).max() < 1e-6
        assert {heading.baseline_m for heading in headings} == {1.5}


def test_novatel_baseline_pitches_down_with_the_right_wing() -> None:
    at = flight(protocol="novatel", secondary_lever_arm_m=SECOND_ARM)
    headings = of(GnssHeading, at.records(10.0))
    roll, pitch, _ = at.aircraft.attitude(np.array([at.time_s(heading) for heading in headings]))
    found = np.array([heading.pitch_rad for heading in headings])
    assert roll.min() > 0.19
    assert np.abs(found + np.arcsin(np.sin(roll) * np.cos(pitch))).max() < 3e-6
    sigmas = np.degrees([headings[0].heading_sigma_rad, headings[0].pitch_sigma_rad])
    np.testing.assert_allclose(sigmas, [0.8 * 0.2 / 1.5, 0.8 * 0.4 / 1.5], rtol=1e-6)


def test_novatel_ins_gives_the_body_a_hundred_times_a_second() -> None:
    at = flight(protocol="novatel", ins=True, undulation_m=47.3)
    rows = np.concatenate([solution.rows for solution in of(InsSolution, at.records(5.0))])
    fine = rows[np.isnan(rows["position_sigma_l"][:, 0])]
    for found, rate_hz in ((fine, 100), (rows[~np.isnan(rows["position_sigma_l"][:, 0])], 1)):
        time_s = (found["gps_ns"] - start_gps_ns(at.plan)) / 1e9
        assert np.abs(time_s - np.arange(len(found)) / rate_hz).max() < 1e-6
        assert len(found) > 4.8 * rate_hz
        lat, lon, height = geodetic(at.aircraft.position_e(time_s))
        assert ground_m(found["lat_rad"], found["lon_rad"], lat, lon).max() < 1e-6
        assert np.abs(found["height_m"] - height).max() < 1e-6
        assert np.abs(found["velocity_l"] - at.aircraft.velocity_l(time_s)).max() < 3e-6
        attitude = np.stack([found[name] for name in ("roll_rad", "pitch_rad", "heading_rad")])
        assert np.abs(attitude - np.stack(at.aircraft.attitude(time_s))).max() < 1e-9
        assert set(found["status"]) == {3}
    whole = rows[~np.isnan(rows["position_sigma_l"][:, 0])]
    np.testing.assert_allclose(whole["position_sigma_l"][0], [0.012, 0.012, 0.020], rtol=1e-6)
    np.testing.assert_allclose(np.degrees(whole["attitude_sigma_rad"][0]), [0.005, 0.005, 0.010], rtol=1e-6)


# ------------------------------------------------------------------------------------- other people's decoders


def test_pyubx2_reads_the_ubx_messages() -> None:
    at = flight(protocol="ubx", rate_hz=5, undulation_m=47.3)
    reader = UBXReader(io.BytesIO(stream(at.units(5.0))), quitonerror=2)
    messages = [message for _, message in reader]
    first = {message.identity: message for message in reversed(messages)}
    assert set(first) == {
        *("NAV-TIMEGPS", "NAV-PVT", "NAV-HPPOSLLH", "NAV-COV", "NAV-TIMELS", "NAV-EOE", "TIM-TP"),
    }
    fine = [message for message in messages if message.identity == "NAV-HPPOSLLH"]
    time_s = np.arange(len(fine)) / 5
    lat, lon, height = true_geodetic(at, time_s)
    found_lat, found_lon = (np.radians([getattr(message, name) for message in fine]) for name in ("lat", "lon"))
    assert ground_m(found_lat, found_lon, lat, lon).max() < POSITION_M["ubx"]
    assert np.abs(np.array([message.height for message in fine]) / 1e3 - height).max() < HEIGHT_M["ubx"]
    msl_m = np.array([message.hMSL for message in fine]) / 1e3
    assert np.abs(msl_m + 47.3 - height).max() < HEIGHT_M["ubx"]
    velocity_l = at.aircraft.velocity_of(LEVER_ARM, time_s)
    solutions = [message for message in messages if message.identity == "NAV-PVT"]
    for row, (solution, (north, east, down)) in enumerate(zip(solutions, velocity_l, strict=True)):
        assert (solution.fixType, solution.gnssFixOk, solution.carrSoln, solution.numSV) == (3, 1, 2, 20)
        found = np.array([solution.velN, solution.velE, solution.velD, solution.gSpeed]) / 1e3
        assert np.abs(found - [north, east, down, math.hypot(north, east)]).max() < VELOCITY_MPS["ubx"]
        # half a unit, and half a unit of NAV-HPPOSLLH, which is rounded first
        assert abs(solution.lat - math.degrees(lat[row])) < 0.506e-7
        assert abs(solution.lon - math.degrees(lon[row])) < 0.506e-7
        assert abs(solution.height - 1e3 * height[row]) < 0.551
        assert abs(solution.hMSL + 47300 - 1e3 * height[row]) < 0.551
        off = (solution.headMot - math.degrees(math.atan2(east, north)) + 180) % 360 - 180
        assert abs(off) < 0.5e-5 + 1e-5
    # hAcc combines both axes (NN + EE of NAV-COV)
    assert fine[0].hAcc / 1e3 == pytest.approx(
        math.sqrt(first["NAV-COV"].posCovNN + first["NAV-COV"].posCovEE), abs=1e-4
    )
    assert first["NAV-TIMELS"].currLs == first["NAV-TIMEGPS"].leapS == LEAP_S
    assert [m.identity for m in messages[:7]] == [
        *("NAV-TIMEGPS", "NAV-PVT", "NAV-HPPOSLLH", "NAV-COV", "NAV-TIMELS", "NAV-EOE", "TIM-TP")
    ]


def test_pynmea2_reads_the_nmea_sentences() -> None:
    at = flight(protocol="nmea", rate_hz=5, undulation_m=47.3, secondary_lever_arm_m=SECOND_ARM)
    lines = stream(at.units(5.0)).decode("ascii").split("\r\n")[:-1]
    sentences = [pynmea2.parse(line, check=True) for line in lines]
    kinds = [sentence.sentence_type for sentence in sentences]
    assert kinds[:11] == ["GGA", "RMC", "ZDA", "VTG", "GST", "HDT", "GGA", "RMC", "VTG", "GST", "HDT"]
    of_kind = {kind: [s for s in sentences if s.sentence_type == kind] for kind in set(kinds)}
    count = len(of_kind["HDT"])
    time_s = np.arange(count) / 5
    lat, lon, height = true_geodetic(at, time_s)
    velocity_l = at.aircraft.velocity_of(LEVER_ARM, time_s)
    for k in range(count):
        gga, rmc, vtg = of_kind["GGA"][k], of_kind["RMC"][k], of_kind["VTG"][k]
        for sentence in (gga, rmc):
            assert abs(math.radians(sentence.latitude) - lat[k]) * EARTH_M < POSITION_M["nmea"]
            assert abs(math.radians(sentence.longitude) - lon[k]) * EARTH_M < POSITION_M["nmea"]
        assert abs(float(gga.altitude) + float(gga.geo_sep) - height[k]) < HEIGHT_M["nmea"]
        assert float(gga.geo_sep) == 47.3
        assert gga.gps_qual == 4
        stamp = dt.datetime.combine(rmc.datestamp, rmc.timestamp)
        assert stamp == dt.datetime(2026, 6, 15, 9, tzinfo=dt.UTC) + dt.timedelta(seconds=float(time_s[k]))
        assert gga.timestamp == rmc.timestamp == of_kind["GST"][k].timestamp
        speed, course = math.hypot(*velocity_l[k, :2]), math.degrees(math.atan2(*velocity_l[k, 1::-1]))
        assert float(rmc.spd_over_grnd) * 1852 / 3600 == pytest.approx(speed, abs=3e-5)
        assert float(vtg.spd_over_grnd_kmph) / 3.6 == pytest.approx(speed, abs=3e-5)
        for found in (rmc.true_course, vtg.true_track):
            assert abs((float(found) - course + 180) % 360 - 180) < 1e-4


def test_novatel_position_follows_the_offsets_of_the_manual() -> None:
    """The BESTPOS header has 28 bytes; fields follow at H, H+4, H+8, H+16, H+24, H+32, H+40 … (OEM7, table BESTPOS)."""
    at = flight(protocol="novatel", undulation_m=47.3, start="2026-11-21T12:00:00Z")
    data = stream(at.units(2.0))
    bodies: dict[int, bytes] = {}
    place = 0
    while place < len(data) - 28:
        header_bytes, number, _, _, length = struct.unpack_from("<BHbBH", data, place + 3)
        assert data[place : place + 4] == b"\xaa\x44\x12\x1c"
        bodies.setdefault(number, data[place : place + header_bytes + length])
        place += header_bytes + length + 4
    position = bodies[42]
    assert struct.unpack_from("<HI", position, 14) == (2445, 561_618_000)  # FORMULAS 12
    assert position[13] == 180  # FINESTEERING
    assert struct.unpack_from("<II", position, 28) == (0, 50)
    lat_deg, lon_deg, height_m = struct.unpack_from("<ddd", position, 28 + 8)
    (undulation_m,) = struct.unpack_from("<f", position, 28 + 32)
    lat, lon, height = true_geodetic(at, np.zeros(1))
    assert abs(math.radians(lat_deg) - lat[0]) * EARTH_M < 1e-6
    assert abs(math.radians(lon_deg) - lon[0]) * EARTH_M < 1e-6
    assert height_m + undulation_m == pytest.approx(height[0], abs=1e-6)
    assert undulation_m == pytest.approx(47.3, abs=2e-6)
    # TIME: clock status H, offset H+4, σ H+12, UTC offset H+20, year H+28, month, day, hour, minute, ms H+36
    status, offset_s, _, utc_offset_s = struct.unpack_from("<Iddd", bodies[101], 28)
    assert (status, utc_offset_s) == (0, -18.0)
    assert offset_s == pytest.approx(-at.pulse.edges(np.zeros(1, np.int64))[0], abs=1e-15)
    assert struct.unpack_from("<IBBBBI", bodies[101], 28 + 28) == (2026, 11, 21, 12, 0, 0)


# ------------------------------------------------------------------------------------- time


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_whole_seconds_are_named_just_after_or_just_before_their_edge(protocol: str) -> None:
    at = flight(protocol=protocol, rate_hz=2, noise=True)
    messages = [m for m in of(TimeMessage, at.records(10.0)) if m.time.week is not None or m.time.date is not None]
    seen = set()
    for message in messages:
        named_s, arrival_s = at.time_s(message), message.host_time_ns / 1e9
        if abs(named_s - round(named_s)) > 1e-3:
            continue
        seen.add(message.message)
        assert message.valid
        if message.names_edge is NamesEdge.NEXT:
            assert 0.05 < named_s - arrival_s < 0.99
        else:
            assert 0.05 < arrival_s - named_s < 0.12
    assert (
        seen
        == {
            "novatel": {"TIME", "BESTPOS"},
            "ubx": {"NAV-PVT", "NAV-TIMEGPS", "TIM-TP"},
            "nmea": {"RMC", "ZDA"},
        }[protocol]
    )


@pytest.mark.parametrize(("protocol", "name", "resolution_ns"), [("novatel", "TIME", 1e-6), ("ubx", "TIM-TP", 5e-4)])
def test_the_bound_message_gives_the_error_of_its_edge(protocol: str, name: str, resolution_ns: float) -> None:
    at = flight(protocol=protocol, rate_hz=1, noise=True)
    bound = [message for message in of(TimeMessage, at.records(60.0)) if message.message == name]
    seconds = np.array([round(at.time_s(message)) for message in bound])
    first = 0 if name == "TIME" else 1
    np.testing.assert_array_equal(seconds, np.arange(first, 60 + first))
    edges_ns = (at.pulse.edges(seconds) - seconds) * 1e9
    assert edges_ns.std() > 30
    told_ns = np.array([message.quantisation_ns for message in bound])
    assert np.abs(told_ns - edges_ns).max() < resolution_ns + 1e-5  # float64 of 60 s: 7e-6 ns
    assert all(message.bound for message in bound)


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_week_and_day_change_during_the_flight(protocol: str) -> None:
    """On Saturday night the GPS week changes at 23:59:42 UTC, and the day 18 s later."""
    at = flight(protocol=protocol, rate_hz=2, start="2026-06-13T23:59:40Z", ins=protocol == "novatel")
    records = at.records(24.0)
    fixes = [fix for fix in of(GnssFix, records) if fix.lat_rad is not None]
    assert [at.time_s(fix) for fix in fixes] == pytest.approx(np.arange(len(fixes)) / 2, abs=1e-9)
    assert len(fixes) == 48
    for message in of(TimeMessage, records):
        if message.time.week is not None or message.time.date is not None:
            delay_s = message.host_time_ns / 1e9 - at.time_s(message)
            assert -1.0 < delay_s < -0.8 or 0.0 < delay_s < 0.12
    tags = [fix.time for fix in fixes]
    if protocol == "nmea":
        assert [tag.date for tag in tags[39:41]] == [dt.date(2026, 6, 13), dt.date(2026, 6, 14)]
    else:
        assert [(tag.week, tag.time_ns) for tag in tags[3:5]] == [(2422, 604_799_500_000_000), (2423, 0)]
    for solution in of(InsSolution, records):
        time_s = (solution.rows["gps_ns"] - start_gps_ns(at.plan)) / 1e9
        assert np.abs(time_s - np.rint(time_s * 100) / 100).max() < 1e-6


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_an_outage_has_no_solutions_but_keeps_time(protocol: str) -> None:
    second: dict[str, Any] = {} if protocol == "ubx" else {"secondary_lever_arm_m": SECOND_ARM}
    at = flight(protocol=protocol, outage=[{"at_s": 5.0, "for_s": 4.0}], **second)
    records = at.records(25.0)
    positions = [fix for fix in of(GnssFix, records) if fix.message != "BESTVEL"]
    time_s = np.array([at.time_s(fix) for fix in positions])
    assert np.abs(time_s - np.arange(len(positions)) / 5).max() < 1e-9
    want = np.full(len(positions), int(FixType.RTK_FIXED))
    want[(time_s >= 5) & (time_s < 9)] = FixType.NONE
    want[(time_s >= 9) & (time_s < 19)] = FixType.RTK_FLOAT
    np.testing.assert_array_equal([int(fix.fix_type) for fix in positions], want)
    assert [fix.valid for fix in positions] == (want != 0).tolist()
    assert {fix.satellites for fix in positions if fix.fix_type is FixType.NONE} == {0}
    gone = [fix for fix in of(GnssFix, records) if fix.fix_type is FixType.NONE]
    assert all(fix.velocity_l is None and fix.lat_rad is None for fix in gone)
    if protocol == "novatel":
        assert [heading.valid for heading in of(GnssHeading, records)][:50] == (want[:50] != 0).tolist()
    if protocol == "nmea":
        assert len(of(GnssHeading, records)) == len(positions) - 20
    named = {round(at.time_s(m), 6): m.valid for m in of(TimeMessage, records) if m.time.week or m.time.date}
    for number in range(1, 25):
        # RMC without a fix (status V) cannot confirm its time; the binary messages can
        assert named[float(number)] == (protocol != "nmea" or not 5 <= number < 9)


def test_a_jump_moves_the_sent_positions() -> None:
    at = flight(protocol="ubx", jump=[{"at_s": 2.0, "for_s": 1.0, "offset_l_m": [0.0, 0.0, -2.5]}])
    fixes = of(GnssFix, at.records(5.0))
    time_s = np.array([at.time_s(fix) for fix in fixes])
    moved_m = np.array([fix.height_m for fix in fixes]) - true_geodetic(at, time_s)[2]
    want = np.where((time_s >= 2.0) & (time_s < 3.0), 2.5, 0.0)
    assert np.abs(moved_m - want).max() < HEIGHT_M["ubx"]
    assert {fix.fix_type for fix in fixes} == {FixType.RTK_FIXED}


# ------------------------------------------------------------------------------------- the serial line


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_units_do_not_depend_on_how_time_is_cut(protocol: str) -> None:
    keys: dict[str, Any] = {"protocol": protocol, "noise": True, "rate_hz": 20, "baud": 115_200}
    keys |= {"ins": True, "secondary_lever_arm_m": SECOND_ARM, "baud": 460_800} if protocol == "novatel" else {}
    whole = flight(**keys).units(6.0)
    cuts = np.concatenate([[0.0], np.sort(np.random.default_rng(3).uniform(0, 6, 50)), np.arange(1, 11) / 10, [6.0]])
    pieces, at = [], flight(**keys)
    edges = np.unique(cuts).tolist()
    for start_s, stop_s in pairwise(edges):
        part = at.wire.units(start_s, stop_s)
        assert all(start_s <= unit.time_s < stop_s for unit in part)
        pieces += part
    assert pieces == whole
    assert all(a.time_s < b.time_s for a, b in pairwise(whole))
    assert {unit.source for unit in whole} == {"gnss/rover"}
    assert stream(flight(**keys).units(6.0)) == stream(whole)


def test_units_must_go_on_where_they_ended() -> None:
    at = flight()
    at.wire.units(0.0, 1.0)
    with pytest.raises(ValueError, match=r"from 2\.0 s on, but the last ones ended at 1\.0 s"):
        at.wire.units(2.0, 3.0)


def test_bytes_arrive_in_succession_and_are_read_in_intervals() -> None:
    """Without noise a burst leaves 80 ms after its epoch, each byte takes ten bits, and a read takes what is there."""
    baud, latency_s = 19_200, 0.080
    at = flight(protocol="nmea", rate_hz=1, baud=baud, latency_ms=80.0)
    units = at.units(10.0)
    lines = stream(units).splitlines(keepends=True)
    bursts: list[int] = []
    for line in lines:
        if line.startswith(b"$GNGGA"):
            bursts.append(0)
        bursts[-1] += len(line)
    assert len(bursts) == 10
    taken = 0
    for unit in units:
        taken += len(unit.data)
        there = [(unit.time_s - second - latency_s) * baud / 10 for second in range(10)]
        assert taken == sum(min(max(math.floor(n + 1e-6), 0), size) for n, size in zip(there, bursts, strict=True))
    assert taken == sum(bursts)
    read_ms = np.array([unit.time_s for unit in units]) * 1e3
    assert np.abs((read_ms - read_ms[0]) / 10 - np.rint((read_ms - read_ms[0]) / 10)).max() < 1e-6
    assert len(units) > 100  # 200 bytes at 1920 a second, 19 a read


def test_latency_varies_by_some_milliseconds() -> None:
    at = flight(protocol="ubx", rate_hz=10, noise=True, baud=4_000_000)
    changes = {"host": {"serial_read_ms": 0.05}}
    plan = at.plan.changed(changes)
    receiver = Receiver(plan.tables.gnss["rover"], at.aircraft, seed=1, name="rover", noise=True)
    units = GnssWire(plan, "rover", receiver, at.pulse).units(0.0, 30.0)
    times = np.array([unit.time_s for unit in units])
    first = times[np.searchsorted(times, np.arange(300) / 10)]
    delay_ms = 1e3 * (first - np.arange(300) / 10)
    assert 60.0 <= delay_ms.min() < 60.2
    assert delay_ms.max() < 70.1
    # |N(0, 2 ms)| has mean 2 √(2/π) = 1.6 ms, sigma 1.2 ms; half a read of 0.05 ms
    assert abs(delay_ms.mean() - 60.0 - 2 * math.sqrt(2 / math.pi) - 0.025) < 4.5 * 1.21 / math.sqrt(300)


def test_after_the_flight_only_units_under_way_arrive() -> None:
    at = flight(protocol="nmea", rate_hz=1, latency_ms=500.0, end_s=3.2)
    assert stream(at.wire.units(0.0, 3.2)).count(b"GGA") == 3
    tail = at.wire.units(3.2, 6.0)
    assert stream(tail).count(b"GGA") == 1
    assert tail[-1].time_s < 3.6


# ------------------------------------------------------------------------------------- users' mistakes, configuration


@pytest.mark.parametrize(
    ("keys", "error"),
    [
        ({"baud": 9600, "rate_hz": 20}, r"gnss\.rover\.baud: 9600 is too slow for \d+ bytes a second; set 57600 or"),
        ({"baud": 57_600, "ins": True}, r"gnss\.rover\.baud: 57600 is too slow for \d+ bytes a second; set 230400 or"),
        (
            {"baud": 9600, "rate_hz": 1, "latency_ms": 700.0},
            r"gnss\.rover\.baud: 9600: messages would come 1\.\d\d s after the second they name; set 19200 or more",
        ),
        (
            {"latency_ms": 950.0},
            r"gnss\.rover\.latency_ms: 950: messages would come 0\.98 s after .*; set at most 87\d",
        ),
        ({"protocol": "ubx", "secondary_lever_arm_m": SECOND_ARM}, r"gnss\.rover\.secondary_lever_arm_m: .*novatel"),
        (
            {"protocol": "nmea", "ins": True},
            r'gnss\.rover\.ins: "nmea" has no such messages; use protocol = "novatel"',
        ),
    ],
)
def test_a_rate_beyond_the_line_capacity_is_refused(keys: dict[str, Any], error: str) -> None:
    with pytest.raises(PlanError, match=f"^{error}") as caught:
        flight(**keys)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_the_baud_rate_suggested_by_the_refusal_is_sufficient(protocol: str) -> None:
    with pytest.raises(PlanError) as caught:
        flight(protocol=protocol, baud=4800, rate_hz=20)
    baud = int(str(caught.value).split("; set ")[1].split()[0])
    at = flight(protocol=protocol, baud=baud, rate_hz=20)
    named = [m for m in of(TimeMessage, at.records(4.0)) if m.names_edge is NamesEdge.PREVIOUS and m.time.week]
    assert all(0.0 < m.host_time_ns / 1e9 - at.time_s(m) < 0.9 for m in named)
    with pytest.raises(PlanError) as caught:
        flight(protocol=protocol, latency_ms=1500.0)
    flight(protocol=protocol, latency_ms=float(str(caught.value).split("at most ")[1]))


def test_satellites_out_of_sight_do_not_hide_a_slow_line() -> None:
    with pytest.raises(PlanError, match="baud: 9600 is too slow"):
        flight(protocol="nmea", baud=9600, rate_hz=5, outage=[{"at_s": 0.0, "for_s": 20.0}])


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_its_configuration_is_valid(protocol: str) -> None:
    second: dict[str, Any] = {} if protocol == "ubx" else {"secondary_lever_arm_m": SECOND_ARM}
    table = flight(protocol=protocol, **second).plan.tables.gnss["rover"]
    config = GnssConfig.model_validate(config_table(table, "rover", "serial:/dev/ttyUSB0?baud=460800", LEAP_S))
    assert (config.protocol, config.pps) == (protocol, "main")
    assert config.leap_seconds == (LEAP_S if protocol == "nmea" else None)  # other protocols state it
    assert config.lever_arm_m == LEVER_ARM
    assert config.secondary_lever_arm_m == second.get("secondary_lever_arm_m")
    unwired = table.model_copy(update={"pps": None})
    assert "pps" not in config_table(unwired, "rover", "serial:/dev/ttyUSB0")


def test_without_a_wired_pulse_no_pulse_is_announced() -> None:
    at = flight(protocol="ubx")
    receiver = Receiver(at.plan.tables.gnss["rover"], at.aircraft, seed=1, name="rover", noise=False)
    records = parsed(at.plan, GnssWire(at.plan, "rover", receiver, None).units(0.0, 5.0))
    assert {message.message for message in of(TimeMessage, records)} == {"NAV-TIMEGPS", "NAV-PVT", "NAV-TIMELS"}
