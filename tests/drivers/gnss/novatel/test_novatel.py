"""Tests NovAtel OEM7: every real recording against NovAtel's own decoder, cut and damaged in all ways."""

from __future__ import annotations

import math
from collections import Counter

import numpy as np
import pytest

from swath.drivers.driver import find_driver
from swath.drivers.gnss.novatel.parser import NovatelParser, make_time_parser
from swath.drivers.gnss.novatel.tables import FIX_TYPES
from swath.drivers.parser import DeviceSettings
from swath.georef.records import (
    Chunk,
    DeviceStatus,
    FixType,
    GnssFix,
    GnssHeading,
    ImuSamples,
    InsSolution,
    NamesEdge,
    TimeMessage,
)
from tests.drivers.builders import HOST_NS, NOVATEL_COUNTS, NOVATEL_SPAN, make_novatel, of_type, parse_novatel, rows_of
from tests.drivers.harness import (
    check_damage,
    check_every_cut,
    check_garbage,
    check_random_cuts,
    check_random_reads,
    check_stream,
    packed_rows,
)
from tests.drivers.novatel_ascii import WEEK_NS, AsciiLog, ascii_logs, recording

NO_MESSAGES = (
    "binary_sync_error.BIN",
    "short_ascii_sync_error.ASC",
    "abbreviated_ascii_sync_error.ASC",
    "nmea_sync_error.txt",
)
POSITION_TYPES = {  # as edie writes them -> the number in the binary log
    "NONE": 0,
    "SINGLE": 16,
    "WAAS": 18,
    "NARROW_FLOAT": 34,
    "NARROW_INT": 50,
    "INS_PSRSP": 53,
    "DOPPLER_VELOCITY": 8,
}
INS_STATUS = {
    "INS_INACTIVE": 0,
    "INS_ALIGNING": 1,
    "INS_HIGH_VARIANCE": 2,
    "INS_SOLUTION_GOOD": 3,
    "INS_SOLUTION_FREE": 6,
    "INS_ALIGNMENT_COMPLETE": 7,
    "WAITING_AZIMUTH": 10,
}


@pytest.mark.parametrize("name", NOVATEL_COUNTS)
def test_messages_match_the_reference_decoder(name: str) -> None:
    parser = make_novatel()
    parse_novatel(recording(name), parser)
    assert +parser.counters.messages == Counter(NOVATEL_COUNTS[name])
    assert parser.counters.bytes == parser.counters.bytes_framed + parser.counters.bytes_skipped
    assert parser.counters.bad_messages == 0


@pytest.mark.parametrize("name", NO_MESSAGES)
def test_recordings_without_novatel_logs_give_no_messages(name: str) -> None:
    parser = make_novatel()
    data = recording(name)
    assert parse_novatel(data, parser) == []
    assert not +parser.counters.messages
    assert parser.counters.bytes_skipped == len(data)


def test_a_prompt_between_logs_is_skipped() -> None:
    data = recording("bestpos-bestvel-psrdop2-sync.gps")
    parser = make_novatel()
    parse_novatel(data, parser)
    assert data.startswith(b"[ICOM1]")
    assert parser.counters.bytes_skipped == len(b"[ICOM1]")
    parser = make_novatel()
    log = recording("time.gps")[:76]
    assert len(of_type(parse_novatel(b"[COM1]" + log + b"\r\n<OK\r\n[COM1]" + log, parser), TimeMessage)) == 2
    assert parser.counters.bytes_skipped == 6 + 13


# --- cut and damaged


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    ["bestpos.gps", "ins1.gps", "align.gps", "time.gps", "unit_test_vectors.bin"],
)
def test_records_do_not_depend_on_how_a_recording_is_cut(name: str) -> None:
    whole = check_stream(make_novatel, recording(name))
    assert whole.counters["messages"] == NOVATEL_COUNTS[name]


@pytest.mark.slow
def test_records_do_not_depend_on_how_a_large_recording_is_cut() -> None:
    check_stream(make_novatel, recording(NOVATEL_SPAN)[: 160 * 1024])
    check_stream(make_novatel, recording("oemv_200911218.gps")[: 48 * 1024])
    prompts = recording("bestpos-bestvel-psrdop2-sync.gps")
    check_random_reads(make_novatel, prompts)
    check_every_cut(make_novatel, prompts, window=1024)
    check_random_cuts(make_novatel, prompts)


@pytest.mark.parametrize("name", ["bestpos.gps", "unit_test_vectors.bin", NOVATEL_SPAN])
def test_damage_affects_only_the_logs_it_hits(name: str) -> None:
    check_damage(make_novatel, recording(name), examples=30, window=4096)


def test_garbage_never_raises() -> None:
    check_garbage(make_novatel)


# --- values


@pytest.mark.parametrize(
    "name",
    [NOVATEL_SPAN, "bestpos.gps", "bestpos-bestvel-psrdop2-sync.gps", "oemv_200911218.gps", "unit_test_vectors.bin"],
)
def test_bestpos_matches_edie(name: str) -> None:
    fixes = of_type(parse_novatel(recording(name)), GnssFix, "BESTPOS")
    expected = ascii_logs(name, "BESTPOS")
    assert len(fixes) == len(expected) == NOVATEL_COUNTS[name]["BESTPOS"]
    for fix, log in zip(fixes, expected, strict=True):
        assert_position(fix, log)


def assert_position(fix: GnssFix, log: AsciiLog) -> None:
    """Assert that a fix equals the ASCII log in place, sigmas, type, satellites and time."""
    assert fix.time.time_ns == log.time_ns
    assert fix.time.week == (log.week or None)
    position_type = POSITION_TYPES[log.fields[1]]
    assert fix.fix_type is FIX_TYPES.get(position_type, FixType.NONE)
    assert fix.valid == (log.fields[0] == "SOL_COMPUTED" and log.status == "FINESTEERING")
    assert fix.satellites == int(log.fields[14])
    if position_type == 0:
        assert (fix.lat_rad, fix.lon_rad, fix.height_m, fix.position_cov_l) == (None, None, None, None)
        return
    lat, lon, height, undulation = log.numbers(2, 3, 4, 5)
    assert fix.lat_rad is not None
    assert fix.lon_rad is not None
    assert fix.position_cov_l is not None
    assert math.degrees(fix.lat_rad) == pytest.approx(lat, abs=6e-12)
    assert math.degrees(fix.lon_rad) == pytest.approx(lon, abs=6e-12)
    assert fix.height_m == pytest.approx(height + undulation, abs=1.1e-4)
    np.testing.assert_allclose(np.sqrt(np.diag(fix.position_cov_l)), log.numbers(7, 8, 9), atol=6e-5)


@pytest.mark.parametrize("name", ["bestpos.gps", "bestpos-bestvel-psrdop2-sync.gps"])
def test_bestvel_matches_edie_with_the_latency_subtracted_from_its_time(name: str) -> None:
    fixes = of_type(parse_novatel(recording(name)), GnssFix, "BESTVEL")
    expected = ascii_logs(name, "BESTVEL")
    assert len(fixes) == len(expected) > 0
    for fix, log in zip(fixes, expected, strict=True):
        latency, horizontal, track, up = log.numbers(2, 4, 5, 6)
        assert fix.velocity_l is not None
        north, east, down = fix.velocity_l
        assert math.hypot(north, east) == pytest.approx(horizontal, abs=6e-5)
        assert math.degrees(math.atan2(east, north)) % 360.0 == pytest.approx(track, abs=1e-5)
        assert down == pytest.approx(-up, abs=6e-5)
        assert fix.time.time_ns == pytest.approx(log.time_ns - latency * 1e9, abs=1000)
        assert (fix.lat_rad, fix.height_m) == (None, None)


def test_time_matches_edie() -> None:
    times = of_type(parse_novatel(recording("time.gps")), TimeMessage)
    expected = ascii_logs("time.gps", "TIME")
    assert len(times) == len(expected) == 6
    for time, log in zip(times, expected, strict=True):
        assert (time.time.week, time.time.time_ns) == (log.week, log.time_ns)
        assert time.time.leap_seconds == 18 == round(-float(log.fields[3]))
        assert (time.bound, time.valid, time.names_edge) == (True, True, NamesEdge.PREVIOUS)
        assert time.quantisation_ns == pytest.approx(-float(log.fields[1]) * 1e9, abs=1e-9)
        assert time.host_time_ns == HOST_NS


def test_solutions_on_a_whole_second_name_it_once_and_only_with_a_valid_time() -> None:
    times = of_type(parse_novatel(recording(NOVATEL_SPAN), make_time_parser(DeviceSettings("gnss/rover"))), TimeMessage)
    seconds = [time.time.time_ns // 1_000_000_000 for time in times]
    assert seconds == sorted(set(seconds))
    assert len(seconds) == 199
    assert not any(time.bound for time in times)
    oemv = of_type(parse_novatel(recording("oemv_200911218.gps")), TimeMessage)
    assert {time.time.week for time in oemv} == {1562}
    assert len(oemv) == sum(log.status == "FINESTEERING" for log in ascii_logs("oemv_200911218.gps", "BESTPOS")) == 46


@pytest.mark.parametrize(("name", "log"), [("bestpos.gps", "INSPVAS"), ("ins1.gps", "INSPVAS")])
def test_inspvas_matches_edie(name: str, log: str) -> None:
    parser = NovatelParser(DeviceSettings("gnss/rover"), wanted=(InsSolution,))
    rows = rows_of(parse_novatel(recording(name), parser), InsSolution)
    if name == "bestpos.gps":
        rows = rows[np.isnan(rows["position_sigma_l"][:, 0])]  # INSPVAX has sigmas
    expected = ascii_logs(name, log)
    assert len(rows) == len(expected) > 0
    for row, line in zip(rows, expected, strict=True):
        week, seconds = int(line.fields[0]), float(line.fields[1])
        assert row["gps_ns"] == week * WEEK_NS + round(seconds * 1e9)
        assert_solution(row, line.numbers(*range(2, 11)), 0.0)
        assert row["status"] == INS_STATUS[line.fields[11]]


@pytest.mark.parametrize("name", [NOVATEL_SPAN, "bestpos.gps"])
def test_inspvax_matches_edie(name: str) -> None:
    rows = rows_of(parse_novatel(recording(name)), InsSolution)
    rows = rows[~np.isnan(rows["position_sigma_l"][:, 0])]
    expected = ascii_logs(name, "INSPVAX")
    assert len(rows) == len(expected) > 0
    for row, line in zip(rows, expected, strict=True):
        assert row["gps_ns"] == line.week * WEEK_NS + line.time_ns
        numbers = line.numbers(2, 3, 4, 6, 7, 8, 9, 10, 11)
        assert_solution(row, numbers, float(line.fields[5]))
        assert row["status"] == INS_STATUS[line.fields[0]]
        np.testing.assert_allclose(row["position_sigma_l"], line.numbers(12, 13, 14), atol=6e-5)
        np.testing.assert_allclose(row["velocity_sigma_l"], line.numbers(15, 16, 17), atol=6e-5)
        np.testing.assert_allclose(np.degrees(row["attitude_sigma_rad"]), line.numbers(18, 19, 20), atol=6e-5)


def assert_solution(row: np.void, numbers: list[float], undulation: float) -> None:
    """Assert that a solution equals the ASCII log in position, velocity and attitude."""
    assert np.degrees(row["lat_rad"]) == pytest.approx(numbers[0], abs=6e-12)
    assert np.degrees(row["lon_rad"]) == pytest.approx(numbers[1], abs=6e-12)
    assert row["height_m"] == pytest.approx(numbers[2] + undulation, abs=1.1e-4)
    np.testing.assert_allclose(row["velocity_l"], [numbers[3], numbers[4], -numbers[5]], atol=6e-5)
    angles = np.degrees([row["roll_rad"], row["pitch_rad"], row["heading_rad"]])
    np.testing.assert_allclose(angles, numbers[6:9], atol=6e-10)


def test_heights_of_ins_and_position_agree_on_the_ellipsoid() -> None:
    records = parse_novatel(recording("bestpos.gps"))
    heights = [fix.height_m for fix in of_type(records, GnssFix, "BESTPOS")]
    rows = rows_of(records, InsSolution)
    assert len(heights) == 5
    assert all(abs(height - rows["height_m"].mean()) < 1.0 for height in heights if height is not None)


def test_heading2_matches_edie() -> None:
    headings = of_type(parse_novatel(recording("align.gps")), GnssHeading)
    expected = ascii_logs("align.gps", "HEADING2")
    assert len(headings) == len(expected) == 12
    for heading, log in zip(headings, expected, strict=True):
        assert heading.time is not None
        assert (heading.time.week, heading.time.time_ns) == (log.week, log.time_ns)
        assert math.degrees(heading.heading_rad) == pytest.approx(float(log.fields[3]), abs=1e-5)
        assert heading.pitch_rad is not None
        assert math.degrees(heading.pitch_rad) == pytest.approx(float(log.fields[4]), abs=1e-6)
        assert heading.heading_sigma_rad is not None
        assert math.degrees(heading.heading_sigma_rad) == pytest.approx(float(log.fields[6]), abs=1e-6)
        assert heading.baseline_m is None, "the log says −1"
        assert heading.valid


def test_rawimusx_matches_edie_and_measures_one_g() -> None:
    rows = rows_of(parse_novatel(recording("unit_test_vectors.bin")), ImuSamples)
    expected = ascii_logs("unit_test_vectors.bin", "RAWIMUSX")
    assert len(rows) == len(expected) == 4
    scales = {  # type -> m/s², rad/s a count
        "11": (2.0**-27 * 0.3048 * 100.0, 2.0**-33 * 100.0),  # HG1700-AG58: increments in ft/s and rad at 100 Hz
        "41": (0.2e-3 * 9.80665 / 65536.0, math.radians(0.008 / 65536.0)),  # Epson G320: rates in mg and deg/s
    }
    for row, log in zip(rows, expected, strict=True):
        force, rate = scales[log.fields[1]]
        accel_z, accel_y, accel_x, gyro_z, gyro_y, gyro_x = log.numbers(5, 6, 7, 8, 9, 10)
        np.testing.assert_allclose(row["specific_force_b"], np.array([accel_x, -accel_y, accel_z]) * force, rtol=1e-13)
        np.testing.assert_allclose(row["angular_rate_b"], np.array([gyro_x, -gyro_y, gyro_z]) * rate, rtol=1e-13)
        assert np.linalg.norm(row["specific_force_b"]) == pytest.approx(9.81, abs=0.02)
        assert row["device_time_ns"] == round(float(log.fields[3]) * 1e9)
        assert row["gps_week"] == (int(log.fields[2]) or -1)
        assert row["status"] == int(log.fields[4], 16)


@pytest.mark.parametrize(
    ("name", "rows", "kind"),
    [("unit_test_vectors.bin", 4, ImuSamples), (NOVATEL_SPAN, 1988, InsSolution), ("ins1.gps", 243, InsSolution)],
)
def test_imu_parser_of_the_gnss_stream_gives_the_samples_of_the_gnss_parser(
    name: str, rows: int, kind: type[InsSolution] | type[ImuSamples]
) -> None:
    """The parser of ``transport = "gnss:rover"`` reads the same bytes; the SPAN recording has CORRIMUDATA only."""
    parser = find_driver("imu", "novatel").make_parser(DeviceSettings("imu/main"))
    records = [*parser.feed(Chunk("imu/main", HOST_NS, recording(name))), *parser.close()]
    assert {type(record) for record in records} <= {ImuSamples, InsSolution}
    inside = rows_of(records, kind)
    assert len(inside) == rows
    assert packed_rows(inside) == packed_rows(rows_of(parse_novatel(recording(name)), kind))
    assert (kind is ImuSamples) == any(isinstance(record, ImuSamples) for record in records)


@pytest.mark.parametrize(("name", "message", "first"), [("ins1.gps", "CORRIMUS", 1), (NOVATEL_SPAN, "CORRIMUDATA", 2)])
def test_corrected_increments_match_edie(name: str, message: str, first: int) -> None:
    status = of_type(parse_novatel(recording(name)), DeviceStatus, message)
    expected = ascii_logs(name, message)
    assert len(status) == len(expected) > 0
    for record, log in zip(status, expected, strict=True):
        pitch, roll, yaw, lateral, longitudinal, vertical = log.numbers(*range(first, first + 6))
        values = record.values
        angles = [values[f"delta_angle_{axis}_rad"] for axis in "xyz"]
        velocities = [values[f"delta_velocity_{axis}_mps"] for axis in "xyz"]
        np.testing.assert_allclose(np.array(angles, float), [roll, pitch, -yaw], atol=1e-12)
        np.testing.assert_allclose(np.array(velocities, float), [longitudinal, lateral, -vertical], atol=1e-12)
        assert values["time_of_week_s"] == pytest.approx(log.seconds, abs=1e-9)
        if message == "CORRIMUS":
            assert values["imu_samples"] == int(log.fields[0])


def test_the_recorder_gets_time_messages_only() -> None:
    for name in NOVATEL_COUNTS:
        records = parse_novatel(recording(name), make_time_parser(DeviceSettings("gnss/rover")))
        assert {type(record) for record in records} <= {TimeMessage}
