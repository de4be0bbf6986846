"""Tests NovAtel's recordings in other forms: its ROS driver's messages, its converter's formats, TCP packets."""

from __future__ import annotations

import csv
import datetime as dt
import io
import json
import math
from collections import Counter
from typing import Any

import dpkt
import numpy as np
import pytest

from swath.drivers.captures.opening import CaptureTally, read_pcap
from swath.drivers.framing.checksums import crc32_novatel
from swath.georef.records import DeviceStatus, GnssFix, GnssHeading, InsSolution, TimeMessage
from tests.drivers.builders import NOVATEL_COUNTS, make_novatel, of_type, parse_novatel, rows_of
from tests.drivers.novatel_ascii import FIXTURES, WEEK_NS, recording
from tests.drivers.ros_bag import Message, read_bag

TCP = "bestpos-bestvel-psrdop2-sync"
UTM = "BESTUTMBIN.GPS"

# --- the maker's ROS driver, that read the same bytes: doubles, not rounded as in ASCII


def ros_messages(name: str, topic: str) -> list[Message]:
    """Return what the driver published from a recording on one of its own topics."""
    return [message for found, message in read_bag(recording(f"{name}.bag")) if found == f"/novatel/oem7/{topic}"]


def gps_ns(message: Message) -> int:
    header = message["nov_header"]
    return int(header["gps_week_number"]) * WEEK_NS + int(header["gps_week_milliseconds"]) * 1_000_000


@pytest.mark.parametrize(
    ("name", "published"),
    [
        ("align", {"heading2": "HEADING2"}),
        ("bestpos", {"bestpos": "BESTPOS", "bestvel": "BESTVEL", "bestutm": "BESTUTM", "inspva": "INSPVAS"}),
        ("ins1", {"corrimu": "CORRIMUS", "insstdev": "INSSTDEV", "insconfig": "INSCONFIG"}),
        ("rxstatus", {"rxstatus": "RXSTATUS"}),
        ("time", {"time": "TIME"}),
    ],
)
def test_log_counts_match_the_ros_driver(name: str, published: dict[str, str]) -> None:
    topics = Counter(topic.removeprefix("/novatel/oem7/") for topic, _ in read_bag(recording(f"{name}.bag")))
    assert {topic: topics[topic] for topic in published} == {
        topic: NOVATEL_COUNTS[f"{name}.gps"][log] for topic, log in published.items()
    }


def test_positions_and_velocities_match_the_ros_driver() -> None:
    records = parse_novatel(recording("bestpos.gps"))
    for fix, theirs in zip(of_type(records, GnssFix, "BESTPOS"), ros_messages("bestpos", "bestpos"), strict=True):
        assert (fix.time.week or 0) * WEEK_NS + fix.time.time_ns == gps_ns(theirs)
        assert (fix.lat_rad, fix.lon_rad) == (math.radians(theirs["lat"]), math.radians(theirs["lon"]))
        assert fix.height_m == theirs["hgt"] + theirs["undulation"]
        assert fix.position_cov_l is not None
        sigmas = [theirs[f"{name}_stdev"] for name in ("lat", "lon", "hgt")]
        np.testing.assert_allclose(np.diag(fix.position_cov_l), np.square(sigmas), rtol=1e-15)
        assert fix.satellites == theirs["num_sol_svs"]
        assert fix.valid == (theirs["sol_status"]["status"] == 0)
    for fix, theirs in zip(of_type(records, GnssFix, "BESTVEL"), ros_messages("bestpos", "bestvel"), strict=True):
        assert fix.velocity_l is not None
        track = math.radians(theirs["trk_gnd"])
        horizontal = [theirs["hor_speed"] * part for part in (math.cos(track), math.sin(track))]
        np.testing.assert_allclose(fix.velocity_l, [*horizontal, -theirs["ver_speed"]], rtol=1e-12)


def test_solutions_match_the_ros_driver() -> None:
    rows = rows_of(parse_novatel(recording("bestpos.gps")), InsSolution)
    rows = rows[np.isnan(rows["position_sigma_l"][:, 0])]  # without INSPVAX, which the driver made no INSPVA of
    for row, theirs in zip(rows, ros_messages("bestpos", "inspva"), strict=True):
        assert row["gps_ns"] == gps_ns(theirs)
        assert (row["lat_rad"], row["lon_rad"]) == (math.radians(theirs["latitude"]), math.radians(theirs["longitude"]))
        assert row["height_m"] == theirs["height"]
        velocity = [theirs["north_velocity"], theirs["east_velocity"], -theirs["up_velocity"]]
        assert row["velocity_l"].tolist() == velocity
        angles = [row["roll_rad"], row["pitch_rad"], row["heading_rad"]]
        np.testing.assert_allclose(angles, np.radians([theirs[a] for a in ("roll", "pitch", "azimuth")]), rtol=1e-15)
        assert row["status"] == theirs["status"]["status"]


def test_headings_match_the_ros_driver() -> None:
    headings = of_type(parse_novatel(recording("align.gps")), GnssHeading)
    for heading, theirs in zip(headings, ros_messages("align", "heading2"), strict=True):
        assert heading.time is not None
        assert (heading.time.week or 0) * WEEK_NS + heading.time.time_ns == gps_ns(theirs)
        ours = [heading.heading_rad, heading.pitch_rad, heading.heading_sigma_rad]
        assert ours == [math.radians(theirs[name]) for name in ("heading", "pitch", "heading_stdev")]


def test_increments_match_the_ros_driver() -> None:
    status = of_type(parse_novatel(recording("ins1.gps")), DeviceStatus, "CORRIMUS")
    for record, theirs in zip(status, ros_messages("ins1", "corrimu"), strict=True):
        values = record.values
        turned = [values[f"delta_angle_{axis}_rad"] for axis in "xyz"]
        assert turned == [theirs["roll_rate"], theirs["pitch_rate"], -theirs["yaw_rate"]]
        gained = [values[f"delta_velocity_{axis}_mps"] for axis in "xyz"]
        assert gained == [theirs["longitudinal_acc"], theirs["lateral_acc"], -theirs["vertical_acc"]]
        assert values["imu_samples"] == theirs["imu_data_count"]


def test_times_match_the_ros_driver() -> None:
    times = of_type(parse_novatel(recording("time.gps")), TimeMessage)
    for time, theirs in zip(times, ros_messages("time", "time"), strict=True):
        assert (time.time.week or 0) * WEEK_NS + time.time.time_ns == gps_ns(theirs)
        assert time.time.leap_seconds == round(-theirs["utc_offset"])
        assert time.quantisation_ns == pytest.approx(-theirs["offset"] * 1e9, rel=1e-12)
        date = dt.datetime(theirs["utc_year"], theirs["utc_month"], theirs["utc_day"], tzinfo=dt.UTC)
        second = theirs["utc_hour"] * 3600 + theirs["utc_min"] * 60 + theirs["utc_msec"] / 1000
        since = date - dt.datetime(1980, 1, 6, tzinfo=dt.UTC)
        assert since.total_seconds() + second + 18 == gps_ns(theirs) / 1e9


# --- the maker's converter


def test_a_log_with_altered_bytes_is_refused() -> None:
    """A text filter put CR before each LF, in the binary log too, which is refused until that is undone."""
    data, parser = recording(UTM), make_novatel()
    assert parse_novatel(data, parser) == []
    in_ascii = +parser.counters.messages
    assert parser.counters.bad_checksums == 1
    parser = make_novatel()
    parse_novatel(data.replace(b"\r\n", b"\n"), parser)
    assert parser.counters.messages - in_ascii == {"BESTUTM": 1}
    assert parser.counters.bad_checksums == 0


@pytest.mark.parametrize("form", ["BINARY", "FLATTENED_BINARY"])
def test_binary_output_of_the_converter_is_framed(form: str) -> None:
    """The same two logs are in its JSON; arrays are also filled up to their greatest length."""
    data, parser = recording(f"{UTM}.{form}"), make_novatel()
    parse_novatel(data, parser)
    assert parser.counters.messages == {"BESTUTM": 1, "VERSION": 1}
    assert parser.counters.bytes_framed == len(data)
    decoder, text, at = json.JSONDecoder(), recording(f"{UTM}.JSON").decode(), 0
    start = 0
    while at < len(text):
        log, at = decoder.raw_decode(text, at)
        header: dict[str, Any] = log["header"]
        assert int.from_bytes(data[start + 4 : start + 6], "little") == header["id"]
        assert int.from_bytes(data[start + 14 : start + 16], "little") == header["week"]
        assert int.from_bytes(data[start + 16 : start + 20], "little") == round(header["seconds"] * 1000)
        start += 28 + int.from_bytes(data[start + 8 : start + 10], "little") + 4
    assert start == len(data)


def test_ascii_output_of_the_converter_is_framed() -> None:
    data, parser = recording(f"{UTM}.ASCII"), make_novatel()
    assert parse_novatel(data, parser) == []
    assert parser.counters.messages == {"BESTUTM": 1, "VERSION": 1}
    assert parser.counters.bytes_framed == len(data)


@pytest.mark.parametrize("form", ["ABBREV_ASCII", "JSON"])
def test_text_output_of_the_converter_contains_no_log(form: str) -> None:
    data, parser = recording(f"{UTM}.{form}"), make_novatel()
    assert parse_novatel(data, parser) == []
    assert not +parser.counters.messages
    assert parser.counters.bytes_skipped == len(data)


def test_checksum_matches_the_ascii_examples_of_the_manual() -> None:
    """By the OEM7 manual, "32-bit CRC", the characters between # and * have the same CRC as a binary log."""
    lines = recording(f"{UTM}.edie.ascii").splitlines()
    assert lines == recording(f"{UTM}.ASCII").splitlines()
    assert all(line in recording(UTM) for line in lines)
    for line in lines:
        body, _, crc = line[1:].rpartition(b"*")
        assert crc32_novatel(body) == int(crc, 16)


# --- the packets of the TCP stream


def test_stream_joins_tcp_payloads_in_sequence_order() -> None:
    """Bytes to the host are in the order of their sequence numbers, and each chunk has the time of its packet."""
    chunks: list[tuple[str, int, int]] = []
    stream = b""
    first: int | None = None
    for time, frame in dpkt.pcap.Reader(io.BytesIO(recording(f"{TCP}.pcap"))):
        segment = dpkt.ethernet.Ethernet(frame).data.data
        if segment.sport != 3001 or not segment.data:
            continue
        first = segment.seq if first is None else first
        new = segment.data[len(stream) - (segment.seq - first) :]
        chunks.append((str(time), len(stream), len(new)))
        stream += new
    assert stream == recording(f"{TCP}.gps")
    with (FIXTURES / f"{TCP}.chunks.csv").open(newline="") as file:
        table = [(row["arrival_unix_s"], int(row["offset"]), int(row["length"])) for row in csv.DictReader(file)]
    assert [(float(time), *rest) for time, *rest in table] == [(float(time), *rest) for time, *rest in chunks]


def test_a_capture_of_tcp_has_no_datagrams() -> None:
    tally = CaptureTally()
    assert list(read_pcap(FIXTURES / f"{TCP}.pcap.gz", tally=tally)) == []
    assert tally.passed["packets without UDP"] == 128
    assert tally.damage == 0
