"""Tests CANmod.gps: two real recordings against cantools' decoding of them, frame by frame."""

from __future__ import annotations

import csv
import datetime as dt
import gzip
import json
from dataclasses import dataclass
from pathlib import Path

import can
import numpy as np
import pytest

from swath.drivers.can_frames import encode_can_frame
from swath.drivers.driver import find_driver
from swath.drivers.imu.canmod_gps import CanmodGpsParser, make_time_parser, utc_tag
from swath.drivers.parser import DeviceSettings
from swath.georef.records import DeviceStatus, FixType, GnssFix, Record, TimeMessage
from tests.drivers.harness import STREAM_HOST_NS, check_packet_damage, check_packets, packet_batches
from tests.drivers.imu_dbc import imu_rows

FIXTURES = Path(__file__).parents[3] / "fixtures/canmod-gps"
SETTINGS = DeviceSettings("imu/main", {"protocol": "canmod-gps"})


@dataclass(frozen=True)
class Expected:
    """The result of an existing decoder (python-can with cantools)."""

    name: str
    frames: int
    imu: int
    gnss: int
    mean: tuple[float, ...]
    std: tuple[float, ...]


RECORDINGS = (
    Expected(
        "2F6913DB_00000004_00000001",
        5588,
        4724,
        44,
        (-0.12511, 1.00011, 10.01762, 0.46645, -0.50831, -0.99709),
        (0.11699, 0.00813, 0.04805, 0.08902, 0.07236, 0.14937),
    ),
    Expected(
        "3BA199E2_00000164_00000005",
        5477,
        4518,
        41,
        (9.64058, 0.15214, 0.46345, 4.52291, -0.02219, 0.01129),
        (0.35368, 0.63264, 0.93563, 9.00438, 1.24829, 1.42811),
    ),
)


def candump_units(name: str, tmp_path: Path) -> list[bytes]:
    """Return all frames of both channels of a recording, in the log's form."""
    path = tmp_path / f"{name}.log"
    path.write_bytes(gzip.decompress((FIXTURES / f"{name}_candump.log.gz").read_bytes()))
    with can.CanutilsLogReader(path) as reader:
        return [
            encode_can_frame(message.arbitration_id, bytes(message.data), extended=message.is_extended_id)
            for message in reader
        ]


def decoded(name: str) -> list[tuple[str, dict[str, float]]]:
    """Return cantools' decoding in order."""
    with gzip.open(FIXTURES / f"{name}.decoded.csv.gz", "rt", newline="") as file:
        return [(row["message"], json.loads(row["signals_json"])) for row in csv.DictReader(file)]


def parse(units: list[bytes], parser: CanmodGpsParser) -> list[Record]:
    """Parse everything as one run of batches."""
    return [record for batch in packet_batches(units, lambda: len(units)) for record in parser.feed_batch(batch)]


@pytest.mark.parametrize("expected", RECORDINGS, ids=lambda expected: expected.name)
def test_imu_samples_match_cantools(expected: Expected, tmp_path: Path) -> None:
    units = candump_units(expected.name, tmp_path)
    assert len(units) == expected.frames
    parser = CanmodGpsParser(SETTINGS)
    rows = imu_rows(parse(units, parser))
    values = np.hstack([rows["specific_force_b"], np.degrees(rows["angular_rate_b"])])
    theirs = [signals for message, signals in decoded(expected.name) if message == "gnss_imu"]
    names = [f"{kind}{axis}" for kind in ("Acceleration", "AngularRate") for axis in "XYZ"]
    assert len(rows) == expected.imu == len(theirs)
    np.testing.assert_allclose(values, [[signals[name] for name in names] for signals in theirs], rtol=0, atol=1e-12)
    np.testing.assert_allclose(values.mean(axis=0), expected.mean, atol=6e-6)
    np.testing.assert_allclose(values.std(axis=0), expected.std, rtol=1.2e-4, atol=6e-6)
    assert (rows["device_time_ns"] == -1).all()
    assert parser.counters.messages["gnss_imu"] == expected.imu
    assert all(parser.counters.messages[name] == expected.gnss for name in ("gnss_time", "gnss_pos", "gnss_altitude"))
    assert not +parser.counters.errors


@pytest.mark.parametrize("expected", RECORDINGS, ids=lambda expected: expected.name)
def test_gnss_records_match_cantools(expected: Expected, tmp_path: Path) -> None:
    records = parse(candump_units(expected.name, tmp_path), CanmodGpsParser(SETTINGS))
    theirs = decoded(expected.name)
    times = [record for record in records if isinstance(record, TimeMessage)]
    epochs = [signals["Epoch"] for message, signals in theirs if message == "gnss_time"]
    assert len(times) == len(epochs) == expected.gnss
    for time, epoch in zip(times, epochs, strict=True):
        assert time.valid
        assert time.time.date is not None
        days = (time.time.date - dt.date(1970, 1, 1)).days
        assert abs(days * 86400 + time.time.time_ns / 1e9 - epoch) < 0.0011
        assert time.time.time_ns % 1_000_000_000 == 0, "its second votes"
    fixes = [record for record in records if isinstance(record, GnssFix)]
    positions = [signals for message, signals in theirs if message == "gnss_pos"]
    altitudes = [signals for message, signals in theirs if message == "gnss_altitude"]
    assert len(fixes) == len(positions)
    for fix, position, altitude in zip(fixes, positions, altitudes, strict=True):
        assert fix.lat_rad == pytest.approx(np.radians(position["Latitude"]), abs=1e-15)
        assert fix.lon_rad == pytest.approx(np.radians(position["Longitude"]), abs=1e-15)
        assert fix.height_m == altitude["Altitude"]
        assert fix.position_cov_l is not None
        assert fix.position_cov_l[2, 2] == altitude["AltitudeAccuracy"] ** 2
        assert 2.0 * fix.position_cov_l[0, 0] == pytest.approx(position["PositionAccuracy"] ** 2)
        assert fix.fix_type is FixType.SINGLE
    status = [r.values["altitude_m"] for r in records if isinstance(r, DeviceStatus) and r.message == "gnss_altitude"]
    assert status == [altitude["Altitude"] for altitude in altitudes]


def test_a_position_without_a_valid_altitude_after_it_has_no_height(tmp_path: Path) -> None:
    units = [unit for unit in candump_units(RECORDINGS[0].name, tmp_path) if unit[:4] != b"\x04\0\0\0"]
    fixes = [record for record in parse(units, CanmodGpsParser(SETTINGS)) if isinstance(record, GnssFix)]
    assert len(fixes) == RECORDINGS[0].gnss
    assert all(fix.valid and fix.height_m is None for fix in fixes)
    parser = CanmodGpsParser(SETTINGS)
    last = max(n for n, unit in enumerate(units) if unit[:4] == b"\x03\0\0\0")
    found = sum(isinstance(record, GnssFix) for record in parse(units[: last + 1], parser))
    assert (found, len(parser.close())) == (RECORDINGS[0].gnss - 1, 1)


@pytest.mark.parametrize("expected", RECORDINGS, ids=lambda expected: expected.name)
def test_attitude_distance_and_fences_match_cantools(expected: Expected, tmp_path: Path) -> None:
    records = parse(candump_units(expected.name, tmp_path), CanmodGpsParser(SETTINGS))
    theirs = decoded(expected.name)
    for message, valid, names in (
        ("gnss_attitude", "AttitudeValid", {"Roll": "roll", "Pitch": "pitch", "Heading": "heading"}),
        ("gnss_odo", "DistanceValid", {"DistanceTrip": "distance_trip_m", "DistanceAccuracy": "distance_accuracy_m"}),
        ("gnss_geofence", "FenceValid", {"FenceCombined": "fence_combined", "Fence1": "fence_1", "Fence4": "fence_4"}),
    ):
        found = [r.values for r in records if isinstance(r, DeviceStatus) and r.message == message]
        signals = [one for name, one in theirs if name == message]
        assert len(found) == len(signals) == expected.gnss
        for values, said in zip(found, signals, strict=True):
            assert bool(values) == bool(said[valid])
            for signal, key in names.items() if values else ():
                if message != "gnss_attitude":
                    assert values[key] == said[signal]
                    continue
                assert values[f"{key}_rad"] == pytest.approx(np.radians(said[signal]), abs=1e-12)
                assert values[f"{key}_accuracy_rad"] == pytest.approx(np.radians(said[f"{signal}Accuracy"]), abs=1e-12)


def test_records_do_not_depend_on_batches(tmp_path: Path) -> None:
    units = candump_units(RECORDINGS[0].name, tmp_path)[500:2500]
    whole = check_packets(lambda: CanmodGpsParser(SETTINGS), units)
    assert whole.counters["messages"]["gnss_time"] > 5
    assert len(whole.events) > 20


def test_damaged_frames_never_raise(tmp_path: Path) -> None:
    units = [unit for unit in candump_units(RECORDINGS[1].name, tmp_path) if unit[1:4] == bytes(3)]
    check_packet_damage(lambda: CanmodGpsParser(SETTINGS), units[60:])


def test_invalid_samples_are_dropped_and_counted() -> None:
    parser = CanmodGpsParser(SETTINGS)
    good, bad = (encode_can_frame(9, bytes.fromhex(data)) for data in ("9BE4CFC000FEAF7F", "9AE4CFC000FEAF7F"))
    rows = imu_rows(parse([good, bad, good], parser))
    assert rows["host_time_ns"].tolist() == [STREAM_HOST_NS, STREAM_HOST_NS + 2_000_000]
    assert parser.counters.errors == {"imu_invalid": 1}
    assert parser.counters.bytes == 48


def test_the_recorder_gets_time_messages_only(tmp_path: Path) -> None:
    units = candump_units(RECORDINGS[0].name, tmp_path)
    records = parse(units, make_time_parser(SETTINGS))
    assert {type(record) for record in records} == {TimeMessage}
    assert len(records) == 44
    driver = find_driver("imu", "canmod-gps")
    assert driver.make_time_parser is make_time_parser


def test_a_truncated_millisecond_is_rounded_to_the_whole_second() -> None:
    for unix_s in (1641469624.999, 1641469625.0):
        tag = utc_tag(unix_s)
        assert (str(tag.date), tag.time_ns) == ("2022-01-06", (11 * 3600 + 47 * 60 + 5) * 1_000_000_000)
    assert utc_tag(1641469625.2).time_ns % 1_000_000_000 == 200_000_000
    assert str(utc_tag(1641513599.999).date) == "2022-01-07", "the day turns with it"
