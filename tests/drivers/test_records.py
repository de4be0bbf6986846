"""Tests protocol ``records``: a frame by hand, every kind of row, cuts and damage, times in every scale."""

from __future__ import annotations

import gzip
import math
import zlib
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from swath.drivers.captures.opening import read_pcap
from swath.drivers.driver import find_driver
from swath.drivers.imu.records import RecordsParser
from swath.drivers.parser import DeviceKind, DeviceSettings, Parser
from swath.drivers.record_frames import (
    NO_ARRIVAL,
    TELLS_TIME,
    RowKind,
    Scale,
    encode_frame,
    encode_frames,
    gps_from_posix,
    posix_from_gps,
)
from swath.drivers.scanner.records import ReturnsParser
from swath.georef.records import (
    Chunk,
    DeviceClockSamples,
    EventMark,
    FixType,
    GnssFix,
    GnssHeading,
    ImuSamples,
    InsSolution,
    NamesEdge,
    ScannerReturns,
    TimeMessage,
    TimeScale,
    TimeTag,
)
from swath.georef.timescales import gps_ns_from_unix, table_leap_seconds, utc_from_gps
from tests.drivers.harness import (
    check_damage,
    check_garbage,
    check_packet_damage,
    check_packets,
    check_random_reads,
    check_stream,
)
from tests.drivers.records_cases import FOLDER, POSIX_NS, START_NS, by_hand, datagrams, rows_of, stream

TAG = TimeTag(TimeScale.GPS, START_NS % 604_800_000_000_000, START_NS // 604_800_000_000_000)


def make(kind: DeviceKind, *, time: bool = False) -> Parser:
    driver = find_driver(kind, "records")
    maker = driver.make_time_parser if time else driver.make_parser
    assert maker is not None
    return maker(DeviceSettings(f"{kind}/test"))


def feed(kind: DeviceKind, frame: bytes, host_ns: int = 5) -> list[Any]:
    return [*make(kind).feed(Chunk(f"{kind}/test", host_ns, frame))]


def test_the_fixtures_are_those_of_their_generator() -> None:
    assert gzip.decompress((FOLDER / "stream.bin.gz").read_bytes()) == stream()
    read = [(unit.time_ns, unit.data) for unit in read_pcap(FOLDER / "points.pcap.gz")]
    assert read == datagrams()


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["gnss", "imu"])
def test_a_stream_is_read_alike_however_it_is_cut(kind: DeviceKind) -> None:
    """A receiver's rows without a time are three of -1, and six with a counter that arrive in 1970."""
    whole = check_stream(lambda: make(kind), stream())
    assert whole.counters["bytes_skipped"] == len(b"foreign bytes SwRc")
    assert whole.counters["errors"].pop("records_length_over_bound") == 1
    assert whole.counters["errors"] == ({"no_time": 9} if kind == "gnss" else {})


@pytest.mark.parametrize("kind", ["gnss", "imu"])
def test_a_stream_is_read_alike_in_random_pieces(kind: DeviceKind) -> None:
    check_random_reads(lambda: make(kind), stream())


@pytest.mark.slow
def test_damage_is_counted() -> None:
    check_damage(lambda: make("gnss"), stream())
    check_garbage(lambda: make("imu"), starts=[stream()[:300]])


def test_datagrams_are_read_alike_in_any_batches() -> None:
    whole = check_packets(lambda: make("scanner"), [data for _, data in datagrams()])
    assert whole.counters["errors"] == {"bad_point": 2}
    check_packet_damage(lambda: make("scanner"), [data for _, data in datagrams()], examples=15)


def test_a_frame_by_hand_is_a_return() -> None:
    """The triangle 3, 4, 5 with 12 gives 13; the CRC is zlib's."""
    frame = by_hand() + zlib.crc32(by_hand()).to_bytes(4, "little")
    message, clock, returns = feed("scanner", frame, 77)
    assert isinstance(message, TimeMessage)
    assert (message.time, message.host_time_ns, message.names_edge) == (TAG, 77, NamesEdge.PREVIOUS)
    assert isinstance(clock, DeviceClockSamples)
    assert isinstance(returns, ScannerReturns)
    [row] = returns.rows
    assert row["range_m"] == 13.0
    assert row["encoder_rad"] == math.atan2(-4.0, 3.0)
    assert row["elevation_rad"] == math.atan2(12.0, 5.0)
    assert (row["channel"], row["return_number"], row["number_of_returns"], row["flags"]) == (5, 1, 2, 2)
    assert row["intensity"] == 77.0
    tai_ns = START_NS + 315_964_800_000_000_000 + 19_000_000_000
    assert row["device_time_ns"] == clock.rows["device_time_ns"][0] == tai_ns


def test_rows_of_a_receiver_become_records() -> None:
    fix_row, mark_row, heading_row = (rows_of(kind, 1) for kind in (RowKind.FIX, RowKind.MARK, RowKind.HEADING))
    [fix] = feed("gnss", encode_frame(RowKind.FIX, fix_row))
    assert isinstance(fix, GnssFix)
    [row] = fix_row
    assert (fix.time, fix.fix_type, fix.satellites, fix.valid) == (TAG, FixType.RTK_FIXED, 17, True)
    assert (fix.lat_rad, fix.height_m, fix.undulation_m) == (row["lat_rad"], row["height_m"], row["undulation_m"])
    assert fix.velocity_l == tuple(row["velocity_l"])
    nn, ne, nd, ee, ed, dd = row["position_cov_l"]
    assert fix.position_cov_l is not None
    np.testing.assert_array_equal(fix.position_cov_l, [[nn, ne, nd], [ne, ee, ed], [nd, ed, dd]])
    assert (fix.antenna, fix.message) == ("primary", "BESTPOS")
    [mark] = feed("gnss", encode_frame(RowKind.MARK, mark_row))
    assert isinstance(mark, EventMark)
    assert (mark.channel, mark.rising, mark.count, mark.time) == ("EVENT1", False, 3, TAG)
    [heading] = feed("gnss", encode_frame(RowKind.HEADING, heading_row))
    assert isinstance(heading, GnssHeading)
    assert (heading.heading_rad, heading.baseline_m) == (heading_row["heading_rad"][0], heading_row["baseline_m"][0])
    time_rows = rows_of(RowKind.TIME, 1)
    time_rows["names_next"] = 1
    [message] = feed("gnss", encode_frame(RowKind.TIME, time_rows))
    assert isinstance(message, TimeMessage)
    assert (message.names_edge, message.bound, message.time) == (NamesEdge.NEXT, False, replace(TAG, leap_seconds=18))


def test_what_is_not_given_stays_unknown() -> None:
    rows = rows_of(RowKind.FIX, 2)
    for name in ("lat_rad", "lon_rad", "height_m", "undulation_m", "position_cov_l", "velocity_cov_l"):
        rows[name] = np.nan
    rows["satellites"], rows["fix_type"] = -1, 99
    rows["time_ns"][1] = -1
    parser = make("gnss")
    [fix] = parser.feed(Chunk("gnss/test", 5, encode_frame(RowKind.FIX, rows)))
    assert isinstance(fix, GnssFix)
    assert (fix.lat_rad, fix.height_m, fix.position_cov_l, fix.velocity_cov_l, fix.satellites) == (None,) * 5
    assert fix.fix_type is FixType.NONE
    assert fix.velocity_l is not None
    assert parser.counters.errors == {"no_time": 1}


def test_fixes_name_their_second_once_and_by_their_arrival() -> None:
    """Of fixes without an arrival 0.25 s are taken, which the clock of a receiver without pulse takes off again."""
    rows = rows_of(RowKind.FIX, 30, START_NS + 40_000_000)
    for flags, host_ns, begun_ns in (
        (TELLS_TIME, 9_140_000_000, 9_100_000_000),
        (TELLS_TIME | NO_ARRIVAL, 9_040_000_000, 9_250_000_000),
    ):
        messages = [
            record
            for record in feed("gnss", encode_frame(RowKind.FIX, rows, Scale.GPS, flags), host_ns)
            if isinstance(record, TimeMessage)
        ]
        assert [message.time.time_ns - TAG.time_ns for message in messages] == [0, 1_000_000_000]
        assert messages[0].host_time_ns == begun_ns
    assert not any(isinstance(one, TimeMessage) for one in feed("gnss", encode_frame(RowKind.FIX, rows)))
    [told] = make("gnss", time=True).feed(Chunk("g", 9, encode_frame(RowKind.FIX, rows[:1], Scale.GPS, TELLS_TIME)))
    assert isinstance(told, TimeMessage)


def test_samples_have_gps_time_with_its_sigma_or_a_counter() -> None:
    rows = rows_of(RowKind.SAMPLE, 3)
    rows["time_sigma_s"] = (0.0, 0.25, np.nan)
    [samples] = feed("imu", encode_frame(RowKind.SAMPLE, rows))
    assert isinstance(samples, ImuSamples)
    assert samples.rows["gps_week"].tolist() == [TAG.week] * 3
    assert (samples.rows["device_time_ns"] - TAG.time_ns).tolist() == [0, 40_000_000, 80_000_000]
    assert samples.rows["time_sigma_s"].tolist() == [0.0, 0.25, 1.0]
    np.testing.assert_array_equal(samples.rows["specific_force_b"], rows["specific_force_b"])
    np.testing.assert_array_equal(samples.rows["angular_rate_b"], rows["angular_rate_b"])
    rows["time_ns"] = (100, 200, -1)
    [samples] = feed("imu", encode_frame(RowKind.SAMPLE, rows, Scale.COUNTER))
    assert samples.rows["gps_week"].tolist() == [-1] * 3
    assert samples.rows["device_time_ns"].tolist() == [100, 200, -1]
    solution_rows = rows_of(RowKind.SOLUTION, 3)
    solution_rows["valid"][1] = 0  # of an INS that still aligns
    [solutions] = feed("imu", encode_frame(RowKind.SOLUTION, solution_rows))
    solution_rows = solution_rows[[0, 2]]
    assert isinstance(solutions, InsSolution)
    for name in ("lat_rad", "velocity_l", "heading_rad", "attitude_sigma_rad", "status"):
        np.testing.assert_array_equal(solutions.rows[name], solution_rows[name])
    assert solutions.rows["gps_ns"].tolist() == solution_rows["time_ns"].tolist()


def test_utc_becomes_gps_time_by_the_table_of_leap_seconds() -> None:
    """The times are compared with the functions of `swath.georef.timescales`, one by one, over every leap second."""
    unix_ns = np.arange(320_000_000, 1_800_000_000, 7_777_777, dtype=np.int64) * 1_000_000_000
    expected = []
    for one in unix_ns.tolist():
        leap, _ = table_leap_seconds(utc_from_gps(gps_ns_from_unix(one, 0), 0)[0])
        expected.append(gps_ns_from_unix(one, leap))
    assert gps_from_posix(unix_ns).tolist() == expected
    assert posix_from_gps(np.array(expected)).tolist() == unix_ns.tolist()
    assert gps_from_posix(np.array([0, -1, (1 << 63) - 1])).tolist() == [-1, -1, -1]
    [fix] = feed("gnss", encode_frame(RowKind.FIX, rows_of(RowKind.FIX, 1, POSIX_NS), Scale.UTC))
    assert isinstance(fix, GnssFix)
    assert fix.time == TAG
    late = RecordsParser(DeviceSettings("gnss/rover"), (GnssFix,))
    rows = rows_of(RowKind.FIX, 1, 1_790_000_000_000_000_000)
    late.feed(Chunk("gnss/rover", 0, encode_frame(RowKind.FIX, rows, Scale.UTC)))
    [line] = late.remarks()
    assert "GPS − UTC is taken as 18 s" in line


def test_other_versions_and_kinds_are_counted_and_passed_over() -> None:
    good = encode_frame(RowKind.SAMPLE, rows_of(RowKind.SAMPLE, 2))
    for at, value, code in ((4, 2, "bad_version"), (5, 77, "bad_kind"), (6, 9, "bad_scale"), (12, 3, "bad_length")):
        changed = bytearray(good[:-4])
        changed[at] = value
        frame = bytes(changed) + zlib.crc32(changed).to_bytes(4, "little")
        for kind in ("imu", "scanner"):
            parser = make(kind)
            assert parser.feed(Chunk("x/y", 0, frame)) == []
            assert parser.counters.errors == {code: 1}
            assert parser.counters.bytes_framed == len(frame)


def test_many_rows_become_several_frames() -> None:
    frames = list(encode_frames(RowKind.POINT, rows_of(RowKind.POINT, 5000)))
    assert len(frames) == 3
    parser = ReturnsParser(DeviceSettings("scanner/x"))
    found = [record for frame in frames for record in parser.feed(Chunk("scanner/x", 0, frame))]
    rows = np.concatenate([record.rows for record in found if isinstance(record, ScannerReturns)])
    assert rows["pulse_id"].tolist() == list(range(5000))
    with pytest.raises(ValueError, match="5000 rows need 160020 bytes, a frame has 60000 at most"):
        encode_frame(RowKind.POINT, rows_of(RowKind.POINT, 5000))
