"""Tests NMEA 2000: a busy bus against another decoder's values, in order; sources; fast packets; damage."""

from __future__ import annotations

import gzip
import json
import struct
from math import degrees, pi, radians
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from swath.drivers.can_frames import encode_can_frame
from swath.drivers.driver import find_driver
from swath.drivers.imu.nmea2000 import Nmea2000Parser, make_time_parser, pgn_and_source
from swath.drivers.parser import DeviceSettings, DriverSettingsError
from swath.georef.records import DeviceStatus, FixType, GnssFix, GnssHeading, NamesEdge, Record, TimeMessage
from tests.drivers.builders import NMEA2000_COUNTS, NMEA2000_FIXTURES, nmea2000_bus
from tests.drivers.harness import STREAM_HOST_NS, check_packet_damage, check_packets, packet_batches, run_packets

SETTINGS = DeviceSettings("imu/main", {"protocol": "nmea2000"})
NAMES = {  # the other decoder's field -> ours
    "heading": "heading_rad",
    "deviation": "deviation_rad",
    "variation": "variation_rad",
    "rate": "rate_of_turn_radps",
    "heave": "heave_m",
    "yaw": "yaw_rad",
    "pitch": "pitch_rad",
    "roll": "roll_rad",
    "latitude": "lat_deg",
    "longitude": "lon_deg",
    "cog": "course_rad",
    "sog": "speed_mps",
}


def decoded(name: str) -> list[dict[str, Any]]:
    """Return the other decoder's messages in order."""
    with gzip.open(NMEA2000_FIXTURES / name, "rt") as file:
        return [json.loads(line) for line in file]


def parser_of(source_address: int | None = None, altitude: str | None = None) -> Nmea2000Parser:
    """Return a parser that listens to one device, or to the first of each PGN."""
    return Nmea2000Parser(DeviceSettings("imu/main", {"source_address": source_address, "altitude": altitude}))


def parse(units: list[bytes] | tuple[bytes, ...], parser: Nmea2000Parser) -> list[Record]:
    """Parse everything as one batch to the end."""
    records = [record for batch in packet_batches(units, lambda: len(units)) for record in parser.feed_batch(batch)]
    return records + parser.close()


def frame(pgn: int, data: bytes, source: int = 1, priority: int = 2) -> bytes:
    """Return a frame of a broadcast PGN."""
    return encode_can_frame(priority << 26 | pgn << 8 | source, data, extended=True)


def fast_frames(message: bytes, sequence: int, source: int = 1) -> list[bytes]:
    """Return a message of 129029 cut into frames by hand."""
    pieces = [bytes([len(message)]) + message[:6]]
    pieces += [message[start : start + 7] for start in range(6, len(message), 7)]
    return [
        frame(129029, bytes([sequence << 5 | number]) + piece.ljust(7, b"\xff"), source)
        for number, piece in enumerate(pieces)
    ]


def position(
    lat_deg: float,
    *,
    method: int = 1,
    days: int = 19326,
    time: int = 432_890_000,
    altitude: int = 43_000_000,
    separation: int = 4690,
) -> bytes:
    """Return the 43 bytes of 129029 without stations."""
    counts = struct.pack("<BHIqqq", 5, days, time, round(lat_deg * 1e16), round(8.5 * 1e16), altitude)
    return counts + struct.pack("<BBBhhiB", method << 4, 0xFC, 9, 90, 0x7FFF, separation, 0)


@pytest.mark.parametrize("name", NMEA2000_COUNTS)
def test_message_counts_match_another_decoder(name: str) -> None:
    parser = parser_of()
    parse(nmea2000_bus(name), parser)
    assert dict(parser.counters.messages) == NMEA2000_COUNTS[name]
    assert parser.counters.bad_messages == 0


def test_every_frame_of_the_bus_is_read() -> None:
    assert len(nmea2000_bus("can0-2_candump.log.gz")) == 47_166


def test_values_of_every_source_are_decoded_in_order() -> None:
    units = nmea2000_bus("can0-2_candump.log.gz")
    theirs = decoded("can0-2.nmea2000_decoded.jsonl.gz")
    dops = decoded("can0-2.129539_decoded.jsonl.gz")
    compared = 0
    for source in sorted({message["src"] for message in [*theirs, *dops]}):
        records = [r for r in parse(units, parser_of(source)) if isinstance(r, DeviceStatus | TimeMessage)]
        mine = [r for r in records if r.message == "129539"]
        for record, message in zip(mine, [one for one in dops if one["src"] == source], strict=True):
            assert isinstance(record, DeviceStatus)
            said = {key: value for key in ("hdop", "vdop", "tdop") if (value := message["fields"][key]) is not None}
            assert record.values == pytest.approx(said)
        mine = [r for r in records if r.message not in ("129029", "129539")]
        expected = [message for message in theirs if message["src"] == source]
        assert len(mine) == len(expected)
        for record, message in zip(mine, expected, strict=True):
            assert record.message == str(message["pgn"])
            fields = message["fields"]
            if isinstance(record, TimeMessage):
                assert str(record.time.date) == fields["date"]
                assert record.time.time_ns // 1_000_000_000 == seconds_of_day(fields["time"])
                continue
            said = {NAMES[key]: value for key, value in fields.items() if key in NAMES and value is not None}
            got = {key: value for key, value in record.values.items() if key != "reference"}
            assert got == pytest.approx(said, rel=1e-12, abs=1e-15)
            compared += len(said)
    assert compared > 15_000


def seconds_of_day(text: str) -> int:
    hours, minutes, seconds = (int(part) for part in text.split(":"))
    return hours * 3600 + minutes * 60 + seconds


def test_fast_packets_of_every_source_are_decoded_in_order() -> None:
    units, theirs = nmea2000_bus("can0-2_candump.log.gz"), decoded("can0-2.129029_decoded.jsonl.gz")
    types = {"GNSS fix": FixType.SINGLE, "DGNSS fix": FixType.DIFFERENTIAL}
    for source in sorted({message["src"] for message in theirs}):
        records = parse(units, parser_of(source))
        fixes = [record for record in records if isinstance(record, GnssFix)]
        status = [r.values for r in records if isinstance(r, DeviceStatus) and r.message == "129029"]
        expected = [message["fields"] for message in theirs if message["src"] == source]
        assert len(fixes) == len(status) == len(expected) >= 59
        for fix, values, fields in zip(fixes, status, expected, strict=True):
            assert fix.lat_rad is not None
            assert fix.lon_rad is not None
            assert degrees(fix.lat_rad) == pytest.approx(fields["latitude"], abs=1e-12)
            assert degrees(fix.lon_rad) == pytest.approx(fields["longitude"], abs=1e-12)
            assert (fix.satellites, fix.fix_type) == (fields["numberOfSvs"], types[fields["method"]])
            assert fix.time.time_ns // 1_000_000_000 == seconds_of_day(fields["time"])
            assert fix.height_m is None
            assert values["altitude_m"] == pytest.approx(fields["altitude"], abs=1e-9)
            assert values["geoidal_separation_m"] == pytest.approx(fields["geoidalSeparation"], abs=1e-9)
            assert (values["hdop"], values["pdop"]) == pytest.approx((fields["hdop"], fields["pdop"]))


@pytest.mark.parametrize(
    ("altitude", "heights"), [("ellipsoid", (43.0, 2.7)), ("geoid", (89.9, 49.6)), (None, (None, None))]
)
def test_a_setting_says_what_the_altitude_counts_from(altitude: str | None, heights: tuple[float | None, ...]) -> None:
    """Sources 20 and 0 of the bus send 43.0 m and 2.7 m at one place on the water: ellipsoid and sea."""
    units = nmea2000_bus("can0-2_candump.log.gz")[:3000]
    for source, height in zip((20, 0), heights, strict=True):
        parser = parser_of(source, altitude)
        fix = next(record for record in parse(units, parser) if isinstance(record, GnssFix))
        assert fix.height_m == (None if height is None else pytest.approx(height, abs=1e-6))
        assert fix.undulation_m == (None if height is None else pytest.approx(46.9))
        assert len(parser.remarks()) == (altitude is None)
    units = tuple(fast_frames(position(47.0), 0))
    parser = parser_of()
    parse(units, parser)
    (line,) = parser.remarks()
    assert "(here 43.0 m, geoidal separation 46.9 m); in the [imu.…] table of the bus set altitude = " in line


def test_an_altitude_that_is_not_available_gives_no_height() -> None:
    unknown = 0x7FFF_FFFF_FFFF_FFFF
    for altitude, message, height, errors in (
        ("ellipsoid", position(47.0, separation=0x7FFF_FFFF), 43.0, {}),
        ("geoid", position(47.0, separation=0x7FFF_FFFF), None, {"separation_not_available": 1}),
        ("geoid", position(47.0, altitude=unknown), None, {}),
        ("ellipsoid", position(47.0, altitude=unknown), None, {}),
        (None, position(47.0, altitude=unknown), None, {}),
    ):
        parser = parser_of(altitude=altitude)
        (fix,) = [record for record in parse(fast_frames(message, 0), parser) if isinstance(record, GnssFix)]
        assert (fix.height_m, fix.valid, parser.counters.errors, parser.remarks()) == (height, True, errors, [])
    with pytest.raises(DriverSettingsError, match="altitude: got 'sea', want ellipsoid or geoid"):
        parser_of(altitude="sea")


def test_the_first_source_of_each_pgn_is_used_and_the_others_counted() -> None:
    units, theirs = nmea2000_bus("can0-2_candump.log.gz"), decoded("can0-2.nmea2000_decoded.jsonl.gz")
    first: dict[int, int] = {}
    for message in theirs:
        first.setdefault(message["pgn"], message["src"])
    parser = parser_of()
    records = parse(units, parser)
    rates = [
        r.values["rate_of_turn_radps"] for r in records if r_message(r) == "127251" and isinstance(r, DeviceStatus)
    ]
    expected = [m["fields"]["rate"] for m in theirs if m["pgn"] == 127251 and m["src"] == first[127251]]
    assert rates == pytest.approx(expected, rel=1e-12)
    used = sum(first[message["pgn"]] == message["src"] for message in theirs)
    used += sum(r_message(record) == "129539" for record in records) - 356
    fixes = sum(isinstance(record, GnssFix) for record in records)
    assert parser.counters.errors["other_source"] == len(theirs) - used + 356 - fixes
    assert 59 <= fixes <= 60


def r_message(record: Record) -> str:
    """Return the name of the message, if the record has one."""
    return getattr(record, "message", "")


def test_records_do_not_depend_on_batches() -> None:
    whole = check_packets(parser_of, nmea2000_bus("can0-2_candump.log.gz")[:3000])
    assert whole.counters["errors"]["other_source"] > 100
    assert whole.counters["messages"]["129029"] > 10


def test_damaged_frames_never_raise() -> None:
    check_packet_damage(parser_of, nmea2000_bus("can0-2_candump.log.gz")[100:])


@settings(max_examples=150, deadline=None, derandomize=True)
@given(
    st.lists(
        st.tuples(
            st.sampled_from([126992, 127250, 127251, 127252, 127257, 129025, 129026, 129029]),
            st.integers(0, 3),
            st.binary(max_size=8),
        ),
        min_size=1,
        max_size=60,
    ),
    st.integers(1, 20),
)
def test_random_data_never_raises_whatever_the_batches(frames: list[tuple[int, int, bytes]], size: int) -> None:
    units = [frame(pgn, data, source) for pgn, source, data in frames]
    assert run_packets(parser_of, units, lambda: size) == run_packets(parser_of, units, lambda: len(units))


def test_identifier_is_split_into_pgn_and_source() -> None:
    broadcast, addressed = 0x09F11217, 0x18EA2314  # 127250 from 23; ISO request 59904 to 0x23 from 20
    pgn, source = pgn_and_source(np.array([broadcast, addressed], np.uint32))
    assert pgn.tolist() == [127250, 59904]
    assert source.tolist() == [23, 20]


def test_interleaved_sources_and_sequences_are_reassembled() -> None:
    packets = [fast_frames(position(47.0 + n), n % 8, source=3) for n in range(2)]
    others = fast_frames(position(-30.0), 0, source=4)
    units = [unit for trio in zip(*packets, others, strict=True) for unit in trio]
    fixes = [record for record in parse(units, parser_of(3)) if isinstance(record, GnssFix)]
    assert [degrees(fix.lat_rad or 0.0) for fix in fixes] == pytest.approx([47.0, 48.0])
    assert [str(fix.time.date) for fix in fixes] == ["2022-11-30"] * 2
    assert fixes[0].time.time_ns == 43_289_000_000_000


@pytest.mark.parametrize("missing", range(7))
def test_a_missing_frame_costs_its_message_and_is_counted_once(missing: int) -> None:
    packets = [fast_frames(position(10.0 + n), n) for n in range(3)]
    units = [packets[0], [u for n, u in enumerate(packets[1]) if n != missing], packets[2]]
    parser = parser_of()
    fixes = [r for r in parse([u for packet in units for u in packet], parser) if isinstance(r, GnssFix)]
    assert [round(degrees(fix.lat_rad or 0.0)) for fix in fixes] == [10, 12]
    assert parser.counters.errors == {"fast_packet_incomplete": 1}


def test_a_late_frame_is_assigned_to_no_message() -> None:
    units = fast_frames(position(1.0), 0)
    parser = parser_of()
    host = STREAM_HOST_NS + np.where(np.arange(len(units)) < 3, 0, 1_000_000_000)
    records = parser.parse_units(host, np.frombuffer(b"".join(units), np.uint8).reshape(len(units), -1))
    assert records + parser.close() == []
    assert parser.counters.errors == {"fast_packet_incomplete": 1}


def test_memory_is_bounded_by_sources_and_sequences() -> None:
    parser = parser_of()
    units = [frame(129029, bytes([n << 5, 223]) + bytes(6), source) for source in range(256) for n in range(8)]
    parse(units * 3, parser)
    assert parser.counters.errors["fast_packet_incomplete"] == 3 * 2048
    assert parser.counters.messages.total() == 0


def test_values_marked_not_available_are_omitted() -> None:
    units = [
        frame(127257, bytes.fromhex("00FF7F1F02FE7FFF")),
        frame(129025, bytes.fromhex("FFFFFF7FFFFFFF7F")),
        frame(126992, bytes.fromhex("00F0FFFFFFFFFFFF")),
    ]
    parser = parser_of()
    records = parse(units, parser)
    assert [r.values for r in records if isinstance(r, DeviceStatus)] == [{"pitch_rad": pytest.approx(0.0543)}, {}]
    assert len(records) == 2
    assert parser.counters.errors == {"time_not_available": 1}


def test_headings_are_true_or_omitted() -> None:
    def heading(reference: int, deviation: int, variation: int) -> bytes:
        return frame(127250, struct.pack("<BHhhB", 0, 60000, deviation, variation, 0xFC | reference))

    units = [heading(0, 0x7FFF, 0x7FFF), heading(1, 0x7FFF, 0x7FFF), heading(1, 0x7FFF, 318), heading(1, -100, 4000)]
    records = parse(units, parser_of())
    headings = [record.heading_rad for record in records if isinstance(record, GnssHeading)]
    assert headings == pytest.approx([6.0, 6.0318, 6.39 - 2 * pi])
    assert len(records) == 7


def test_times_of_local_clocks_are_invalid() -> None:
    units = [frame(126992, struct.pack("<BBHI", 0, 0xF0 | source, 19326, 432_890_000)) for source in (0, 1, 2, 5)]
    units.append(frame(126992, struct.pack("<BBHI", 0, 0xF0, 19326, 900_000_000)))
    parser = parser_of()
    times = [record for record in parse(units, parser) if isinstance(record, TimeMessage)]
    assert [time.valid for time in times] == [True, True, False, False]
    assert {time.names_edge for time in times} == {NamesEdge.PREVIOUS}
    assert parser.counters.errors == {"bad_value": 1}


def test_impossible_positions_give_no_fix() -> None:
    parser = parser_of()
    units = fast_frames(position(91.0), 0) + fast_frames(position(45.0, method=0), 1) + fast_frames(bytes(20), 2)
    fixes = [record for record in parse(units, parser) if isinstance(record, GnssFix)]
    assert [(fix.valid, fix.fix_type) for fix in fixes] == [(False, FixType.NONE)]
    assert fixes[0].lat_rad == pytest.approx(radians(45.0))
    assert parser.counters.errors == {"bad_value": 1, "bad_length": 1}


def test_remote_error_and_short_frames_are_counted() -> None:
    parser = parser_of()
    short = frame(127251, b"\0\0")
    remote = encode_can_frame(0x09F11217, b"", extended=True, remote=True)
    base = struct.pack("<I", 0x2000_0004) + bytes([8, 0, 0, 0]) + bytes(8)
    standard = encode_can_frame(0x123, bytes(8))
    assert parse([short, remote, base, standard], parser) == []
    assert parser.counters.errors == {"bad_length": 1, "rtr_frame": 1, "error_frame": 1}


@pytest.mark.parametrize("wrong", [-1, 254, "23", True])
def test_a_wrong_source_address_is_refused(wrong: Any) -> None:
    with pytest.raises(DriverSettingsError, match=r"source_address: got .*, want 0 to 253"):
        Nmea2000Parser(DeviceSettings("imu/main", {"source_address": wrong}))


def test_the_recorder_gets_time_messages_only() -> None:
    records = parse(nmea2000_bus("can0-2_candump.log.gz"), make_time_parser(SETTINGS))
    assert {type(record) for record in records} == {TimeMessage}
    assert len(records) == 60
    assert find_driver("imu", "nmea2000").make_time_parser is make_time_parser
