"""Tests SREP: the page's test vector both ways, a decoder written from the page, and damage on the wire."""

from __future__ import annotations

import math
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from swath.drivers.driver import find_driver
from swath.drivers.parser import DeviceSettings, DriverSettingsError
from swath.drivers.scanner.srep.layout import SrepHeader, datagram_bytes, encode_datagram
from swath.drivers.scanner.srep.parser import SrepParser
from swath.georef.arrays import StructArray
from swath.georef.records import Chunk, ChunkBatch, DeviceClockSamples, DeviceStatus, Record, ScannerReturns
from tests.drivers.builders import clock_of, returns_of
from tests.drivers.harness import check_packet_damage, check_packets
from tests.drivers.srep_cases import TEST_VECTOR, reference_decode, scan_lines, split_datagrams

FIXTURES = Path(__file__).parents[4] / "fixtures" / "srep"
SOURCE = "scanner/left"


def make_parser(*, clock_only: bool = False, **config: Any) -> SrepParser:
    return SrepParser(DeviceSettings(SOURCE, {"mirror_factor": 2.0} | config), clock_only=clock_only)


def feed_all(parser: SrepParser, datagrams: list[bytes], step_ns: int = 320_000) -> list[Record]:
    records: list[Record] = []
    for at, datagram in enumerate(datagrams):
        records += parser.feed(Chunk(SOURCE, 1_000_000_000 + at * step_ns, datagram))
    return records


def feed_batched(parser: SrepParser, datagrams: list[bytes], sizes: list[int]) -> list[Record]:
    """Feed runs of equal length, cut at most ``sizes`` long in turn, as the log hands them over."""
    records: list[Record] = []
    at, turn = 0, 0
    while at < len(datagrams):
        stop = at + 1
        while stop < len(datagrams) and len(datagrams[stop]) == len(datagrams[at]) and stop - at < sizes[turn]:
            stop += 1
        units = np.frombuffer(b"".join(datagrams[at:stop]), dtype=np.uint8).reshape(stop - at, -1)
        host = 1_000_000_000 + np.arange(at, stop, dtype=np.int64) * 320_000
        records += parser.feed_batch(ChunkBatch(SOURCE, host, units))
        at, turn = stop, (turn + 1) % len(sizes)
    return records


def assert_as_reference(rows: StructArray, datagrams: list[bytes], mirror_factor: float, facets: int = 0) -> None:
    expected = [one for datagram in datagrams for one in reference_decode(datagram, mirror_factor, facets)]
    assert len(rows) == len(expected)
    for name, field, tolerance in (
        ("device_time_ns", "device_time_ns", 0.0),
        ("encoder_rad", "encoder_rad", 1e-12),
        ("range_m", "range_m", 1e-9),
        ("intensity", "intensity", 0.0),
        ("pulse_width_ns", "pulse_width_ns", 1e-4),
        ("channel", "facet", 0.0),
        ("return_number", "return_number", 0.0),
        ("number_of_returns", "number_of_returns", 0.0),
        ("mta_zone", "mta_zone", 0.0),
    ):
        want = np.array([getattr(one, field) for one in expected])
        off = np.abs(rows[name] - want)
        assert not len(off) or off.max() <= tolerance, name
    np.testing.assert_array_equal(rows["flags"] == 4, [one.locked for one in expected])


def test_test_vector_is_decoded_as_the_protocol_page_states() -> None:
    """The sentence before the vector has id 42 and pps_count 3; the bytes, by the page's table, have the reverse."""
    records = feed_all(make_parser(), [TEST_VECTOR])
    rows = returns_of(records)
    np.testing.assert_allclose(rows["range_m"], [912.3456, 925.0, 913.0001], atol=1e-9)
    assert rows["intensity"].tolist() == [800, 120, 810]
    np.testing.assert_allclose(rows["pulse_width_ns"], [4.5, 0.0, 0.0], atol=1e-6)
    assert rows["return_number"].tolist() == [1, 2, 1]
    assert rows["number_of_returns"].tolist() == [2, 2, 1]
    assert np.diff(rows["device_time_ns"]).tolist() == [0, 5000]
    np.testing.assert_allclose(rows["encoder_rad"], np.array([-1000, -1000, -990]) * 2 * math.tau / 524288, atol=1e-15)
    assert (rows["flags"] == 4).all()
    assert (rows["mta_zone"] == 0).all()
    clock = clock_of(records)
    assert clock["pps_count"].tolist() == [42]
    assert clock["pps_time_ns"].tolist() == [100_000_000_000]
    assert clock["device_time_ns"].tolist() == [100_400_005_000]
    assert clock["locked"].tolist() == [1]
    status = next(record for record in records if isinstance(record, DeviceStatus))
    assert status.values == {
        "scanner_id": 3, "pps_locked": True, "range_gate_active": False, "laser_on": True, "prf_hz": 200_000.0,
    }  # fmt: skip


def test_test_vector_is_encoded_byte_for_byte() -> None:
    header = SrepHeader(7, 3, 5, 0, 42, 10_000_000, 1_000_000_000, 1_004_000_000, 524_288, 200_000_000)
    ranges = [[9_123_456, 9_250_000], [9_130_001, 0]]
    written = encode_datagram(header, [0, 50], [-1000, -990], ranges, [[800, 120], [810, 0]], [[450, 0], [0, 0]])
    assert written.hex() == TEST_VECTOR.hex()


def test_fixtures_equal_the_output_of_their_generator() -> None:
    assert (FIXTURES / "test_vector.bin").read_bytes() == TEST_VECTOR
    assert (FIXTURES / "scan_lines.bin").read_bytes() == b"".join(scan_lines())


def test_scan_lines_agree_with_the_reference() -> None:
    datagrams = split_datagrams((FIXTURES / "scan_lines.bin").read_bytes())
    parser = make_parser()
    records = feed_all(parser, datagrams)
    rows = returns_of(records)
    assert len(rows) == 1823
    assert_as_reference(rows, datagrams, 2.0)
    assert parser.counters.messages["srep"] == 24
    assert parser.counters.bytes == parser.counters.bytes_framed == sum(map(len, datagrams))
    assert not parser.counters.errors  # the sequence wraps in the middle: no gap
    assert clock_of(records)["pps_time_ns"].tolist()[:4] == [-1, -1, -1, 99_999_000_000]
    assert [r.values["pps_locked"] for r in records if isinstance(r, DeviceStatus)] == [False, True]
    pulse = rows["pulse_id"]
    assert (np.diff(pulse.astype(np.int64)) >= 0).all()
    assert len(np.unique(pulse)) == np.count_nonzero(rows["return_number"] == 1)


@pytest.mark.parametrize("sizes", [[1], [2, 3], [5, 1, 7], [1000]])
def test_returns_do_not_depend_on_how_batches_are_cut(sizes: list[int]) -> None:
    datagrams = scan_lines(40, 16)
    del datagrams[20:23]
    datagrams[30] = datagrams[30][:50] + b"\xff" + datagrams[30][51:]
    whole, cut = make_parser(), make_parser()
    one, other = feed_all(whole, datagrams), feed_batched(cut, datagrams, sizes)
    np.testing.assert_array_equal(returns_of(one), returns_of(other))
    np.testing.assert_array_equal(clock_of(one), clock_of(other))
    assert [r for r in one if isinstance(r, DeviceStatus)] == [r for r in other if isinstance(r, DeviceStatus)]
    assert whole.counters == cut.counters
    assert cut.counters.errors["sequence_gap"] == 4
    assert cut.counters.bad_checksums == 1


def test_a_recording_passes_the_common_driver_checks() -> None:
    check_packets(make_parser, scan_lines(60, 20))
    check_packets(lambda: make_parser(clock_only=True), scan_lines(60, 20))
    check_packet_damage(make_parser, scan_lines(12, 4))
    check_packet_damage(lambda: make_parser(clock_only=True), scan_lines(12, 4))


def test_strided_rows_of_a_log_chunk_are_read() -> None:
    """Rows in the log have a message header before each, so they are a view, not a copy."""
    datagrams = [d for d in scan_lines() if len(d) == datagram_bytes(64, 2)]
    table = np.zeros((len(datagrams), 31 + len(datagrams[0])), dtype=np.uint8)
    table[:, 31:] = np.frombuffer(b"".join(datagrams), dtype=np.uint8).reshape(len(datagrams), -1)
    batch = ChunkBatch(SOURCE, np.zeros(len(datagrams), dtype=np.int64), table[:, 31:])
    assert_as_reference(returns_of(make_parser().feed_batch(batch)), datagrams, 2.0)


@st.composite
def random_datagram(draw: st.DrawFn) -> bytes:
    n, r = draw(st.integers(0, 6)), draw(st.integers(1, 15))
    u32, u16 = st.integers(0, 2**32 - 1), st.integers(0, 2**16 - 1)
    table = st.lists(st.lists(st.one_of(st.just(0), u32), min_size=r, max_size=r), min_size=n, max_size=n)
    small = st.lists(st.lists(u16, min_size=r, max_size=r), min_size=n, max_size=n)
    hz = draw(st.integers(1, 2**32 - 1))
    header = SrepHeader(
        sequence=draw(u32),
        scanner_id=draw(u16),
        flags=draw(st.integers(0, 7)),
        mta_zone=draw(st.integers(0, 255)),
        pps_count=draw(u32),
        tick_hz=hz,
        pps_ticks=draw(st.integers(0, 2**64 - 1)),
        first_ticks=draw(st.integers(0, min(2**64, hz << 32) - 2**32 - 1 if hz > 1 else 0)),
        encoder_counts=draw(st.integers(1, 2**32 - 1)),
        prf_mhz=draw(u32),
    )
    ticks = sorted(draw(st.lists(u32, min_size=n, max_size=n)))
    encoder = draw(st.lists(st.integers(-(2**31), 2**31 - 1), min_size=n, max_size=n))
    ranges = np.array(draw(table), dtype=np.uint32).reshape(n, r)
    intensity = np.array(draw(small), dtype=np.uint16).reshape(n, r)
    return encode_datagram(header, ticks, encoder, ranges, intensity, intensity[::-1])


@given(datagram=random_datagram(), factor=st.sampled_from([1.0, 2.0, -2.0]), facets=st.integers(2, 24))
@settings(max_examples=150, deadline=None)
def test_any_datagram_agrees_with_the_reference(datagram: bytes, factor: float, facets: int) -> None:
    for parser, count in (
        (make_parser(mirror_factor=factor), 0),
        (make_parser(geometry={"type": "polygon", "facets": facets}), facets),
    ):
        records = feed_all(parser, [datagram])
        found = [r.rows for r in records if isinstance(r, ScannerReturns)]
        expected = reference_decode(datagram, factor, count)
        assert bool(found) == bool(expected)
        if not found:
            continue
        rows = found[0]
        assert rows["device_time_ns"].tolist() == [one.device_time_ns for one in expected]
        np.testing.assert_allclose(rows["encoder_rad"], [one.encoder_rad for one in expected], rtol=1e-14, atol=1e-12)
        assert rows["channel"].tolist() == [one.facet for one in expected]
        np.testing.assert_allclose(rows["range_m"], [one.range_m for one in expected], rtol=1e-15)
        assert rows["return_number"].tolist() == [one.return_number for one in expected]
        assert rows["number_of_returns"].tolist() == [one.number_of_returns for one in expected]
        assert (rows["pulse_id"] & np.uint64(0xFFFF)).tolist() == [one.pulse for one in expected]


@given(datagram=random_datagram(), data=st.data())
@settings(max_examples=100, deadline=None)
def test_one_flipped_bit_gives_no_returns(datagram: bytes, data: st.DataObject) -> None:
    bit = data.draw(st.integers(0, 8 * len(datagram) - 1))
    broken = bytearray(datagram)
    broken[bit // 8] ^= 1 << bit % 8
    parser = make_parser()
    assert feed_all(parser, [bytes(broken)]) == []
    assert parser.counters.bad_checksums + parser.counters.bad_messages == 1
    assert parser.counters.bytes == parser.counters.bytes_skipped == len(broken)


def test_truncated_datagrams_are_counted() -> None:
    parser = make_parser()
    assert feed_all(parser, [TEST_VECTOR[:length] for length in range(len(TEST_VECTOR))]) == []
    assert parser.counters.errors == {"bad_length": 100}
    assert len(returns_of(feed_all(parser, [TEST_VECTOR]))) == 3


def with_bytes(at: int, new: bytes) -> bytes:
    """Return the test vector with bytes replaced and its CRC corrected."""
    data = TEST_VECTOR[:at] + new + TEST_VECTOR[at + len(new) : -4]
    return data + struct.pack("<I", zlib.crc32(data))


@pytest.mark.parametrize(
    ("datagram", "code"),
    [
        (with_bytes(0, b"SREQ"), "bad_magic"),
        (with_bytes(4, b"\x02"), "bad_version"),
        (with_bytes(6, b"\x03\x00"), "bad_length"),
        (with_bytes(20, b"\x00\x00\x00\x00"), "bad_header"),
        (with_bytes(40, b"\x00\x00\x00\x00"), "bad_header"),
        (with_bytes(6, b"\x06\x00\x07\x00\x00\x00\x03\x00\x00"), "bad_header"),
    ],
)
def test_impossible_headers_are_counted(datagram: bytes, code: str) -> None:
    parser = make_parser()
    assert feed_all(parser, [datagram]) == []
    assert parser.counters.errors == {code: 1}
    assert parser.counters.bad_messages == 1


def test_bad_crc_is_counted_and_the_rest_of_the_batch_kept() -> None:
    parser = make_parser()
    broken = TEST_VECTOR[:60] + b"\x00\x01" + TEST_VECTOR[62:]
    records = feed_batched(parser, [TEST_VECTOR, broken, with_bytes(8, b"\x08")], [3])
    assert len(returns_of(records)) == 6
    assert parser.counters.bad_checksums == 1


def line(sequence: int, first_ticks: int, pps_count: int = 1, tick_hz: int = 10_000_000) -> bytes:
    header = SrepHeader(sequence=sequence, first_ticks=first_ticks, pps_count=pps_count, tick_hz=tick_hz)
    return encode_datagram(header, [0], [0], [[10_000]])


def test_gaps_late_and_repeated_datagrams_are_distinguished() -> None:
    parser = make_parser()
    order = [0xFFFF_FFFE, 0xFFFF_FFFF, 2, 1, 3, 3, 4, 10]
    unwrapped = [number - 0xFFFF_FFFE if number > 100 else number + 2 for number in order]
    rows = returns_of(feed_all(parser, [line(n, 1000 * u) for n, u in zip(order, unwrapped, strict=True)]))
    assert parser.counters.errors == {"sequence_gap": 2 + 5, "out_of_order": 1, "duplicate": 1}
    pulses = ((rows["pulse_id"] >> np.uint64(16)) - np.uint64(0xFFFF_FFFE)).astype(int).tolist()
    assert pulses == [0, 1, 4, 3, 5, 6, 12]


@pytest.mark.parametrize("cut", [1, 3, 100])
def test_repeated_and_reordered_datagrams_give_each_pulse_once_in_time_order(cut: int) -> None:
    """Neighbours are swapped throughout, every fifth datagram comes again five places later; they are 70 ms apart."""
    order = [number ^ 1 for number in range(200)]
    for at in range(195, -1, -5):
        order.insert(at + 5, order[at])
    parser = make_parser()
    records = feed_batched(parser, [line(n, 700_000 * n) for n in order], [cut])
    assert (np.sort(returns_of(records)["pulse_id"] >> np.uint64(16)) == np.unique(order)).all()
    errors = parser.counters.errors
    assert errors["duplicate"] == 40
    assert errors["out_of_order"] == 100
    assert errors["sequence_gap"] == 100 - 1  # each late one was missing first, except the one before the very first
    assert set(errors) == {"duplicate", "out_of_order", "sequence_gap"}
    clock = np.concatenate([record.rows for record in records if isinstance(record, DeviceClockSamples)])
    assert (np.diff(clock["device_time_ns"]) > 0).all()


@pytest.mark.parametrize("cut", [1, 100])
def test_restart_begins_a_segment_without_a_gap(cut: int) -> None:
    parser = make_parser()
    before = [line(900 + at, 10**9 + 1000 * at, 50) for at in range(5)]
    after = [line(at, 1000 * at, 0) for at in range(5)]
    latched_again = [line(5, 6000, 3), line(6, 7000, 1)]
    rows = returns_of(feed_batched(parser, before + after + latched_again, [cut]))
    assert parser.counters.errors == {"restart": 2}
    assert (rows["pulse_id"] >> np.uint64(16)).tolist() == list(range(900, 912))


@pytest.mark.parametrize("before", [1, 2, 40, 64, 66])
@pytest.mark.parametrize("off_s", [1.5, 10.0])
def test_an_early_scanner_restart_is_not_taken_for_repeated_datagrams(before: int, off_s: float) -> None:
    """The second beginning has the numbers and times of the first; only the arrival differs."""
    datagrams = [*(line(at, 1000 * at + 10) for at in range(before)), *(line(at, 1000 * at) for at in range(100))]
    host_s = [*(at * 1e-4 for at in range(before)), *(off_s + at * 1e-4 for at in range(100))]
    units = np.frombuffer(b"".join(datagrams), dtype=np.uint8).reshape(len(datagrams), -1)
    parser = make_parser()
    rows = returns_of(parser.feed_batch(ChunkBatch(SOURCE, np.rint(np.array(host_s) * 1e9).astype(np.int64), units)))
    assert parser.counters.errors == {"restart": 1}
    assert (rows["pulse_id"] >> np.uint64(16)).tolist() == list(range(before + 100))


def test_datagrams_of_equal_length_and_different_layout_share_a_batch() -> None:
    """N = 2, R = 2 and N = 3, R = 1 both have 100 bytes; tick rates differ too."""
    other = encode_datagram(
        SrepHeader(8, tick_hz=3, first_ticks=1000, pps_count=3), [0, 1, 2], [1, 2, 3], [[5], [0], [7]]
    )
    third = encode_datagram(
        SrepHeader(9, tick_hz=7, first_ticks=10_000, pps_count=3), [0, 1, 2], [1, 2, 3], [[5], [6], [7]]
    )
    assert len(other) == len(TEST_VECTOR)
    rows = returns_of(feed_batched(make_parser(), [TEST_VECTOR, other, third], [3]))
    assert_as_reference(rows, [TEST_VECTOR, other, third], 2.0)


@pytest.mark.parametrize("tick_hz", [1, 3, 10_000_000, 12_500_001, 2**32 - 1])
@pytest.mark.parametrize("first_ticks", [0, 2**53 + 1, 2**63 - 1, 2**63, 2**64 - 1])
def test_counters_of_64_bits_are_exact(tick_hz: int, first_ticks: int) -> None:
    header = SrepHeader(tick_hz=tick_hz, first_ticks=first_ticks, pps_ticks=first_ticks, pps_count=2**32 - 1)
    datagram = encode_datagram(header, [0, 1, 2**32 - 1], [0, 2**31 - 1, -(2**31)], [[1], [2**32 - 1], [1]])
    records = feed_all(make_parser(), [datagram])
    seconds, rest = divmod(first_ticks, tick_hz)
    base = seconds % 2**32 * 10**9
    want = [base + (rest + ticks) * 10**9 // tick_hz for ticks in (0, 1, 2**32 - 1)]
    assert returns_of(records)["device_time_ns"].tolist() == want
    assert clock_of(records)["pps_time_ns"].tolist() == [want[0]]
    assert clock_of(records)["pps_count"].tolist() == [2**32 - 1]


def test_polygon_facets_are_derived_from_the_shaft_angle() -> None:
    """Four facets take 90° of shaft each: beam angle 0 in the middle, ±90° at the edges, in both directions."""
    counts = 3600
    shaft_deg = np.array([45.0, 0.0, 89.9, 90.0, 135.0, 315.0, 359.9, 360.0, 405.0, -0.1, -45.0, -90.0])
    encoder = np.rint(shaft_deg * 10).astype(np.int32)
    datagram = encode_datagram(
        SrepHeader(encoder_counts=counts), np.arange(len(encoder)), encoder, np.full((len(encoder), 1), 10)
    )
    rows = returns_of(feed_all(make_parser(geometry={"type": "polygon", "facets": 4}), [datagram]))
    assert rows["channel"].tolist() == [0, 0, 0, 1, 1, 3, 3, 0, 0, 3, 3, 3]
    want = [0, -90, 89.8, -90, 0, 0, 89.8, -90, 0, 89.8, 0, -90]
    np.testing.assert_allclose(np.degrees(rows["encoder_rad"]), want, atol=1e-9)


def test_an_unknown_zone_is_passed_on() -> None:
    datagram = encode_datagram(SrepHeader(mta_zone=255), [0], [0], [[123]])
    assert returns_of(feed_all(make_parser(), [datagram]))["mta_zone"].tolist() == [255]


def test_a_heartbeat_gives_only_the_clock() -> None:
    header = SrepHeader(pps_count=9, pps_ticks=50, first_ticks=70, tick_hz=1000, encoder_counts=0)
    records = feed_all(make_parser(), [encode_datagram(header, [], [], np.zeros((0, 1)))])
    assert not any(isinstance(record, ScannerReturns) for record in records)
    assert clock_of(records)[["device_time_ns", "pps_time_ns"]].tolist() == [(70_000_000, 50_000_000)]


@pytest.mark.parametrize(
    ("config", "key"),
    [
        ({}, "mirror_factor"),
        ({"mirror_factor": True}, "mirror_factor"),
        ({"mirror_factor": 0.0}, "mirror_factor"),
        ({"mirror_factor": math.nan}, "mirror_factor"),
        ({"mirror_factor": "2"}, "mirror_factor"),
        ({"mirror_factor": 2.0, "geometry": {"type": "polygon"}}, "geometry.facets"),
        ({"mirror_factor": 2.0, "geometry": {"type": "polygon", "facets": 1}}, "geometry.facets"),
    ],
)
def test_wrong_settings_are_refused_when_the_parser_is_made(config: dict[str, Any], key: str) -> None:
    driver = find_driver("scanner", "srep")
    assert driver.make_time_parser is not None
    for make in (driver.make_parser, driver.make_time_parser):
        with pytest.raises(DriverSettingsError, match=key):
            make(DeviceSettings(SOURCE, config))


@pytest.mark.parametrize("sizes", [[1], [3, 8], [1000]])
def test_time_parser_thins_out_but_counts_every_gap(sizes: list[int]) -> None:
    datagrams = scan_lines(600, 4)
    del datagrams[100:110]
    datagrams[200] = datagrams[200][:9] + b"\x55" + datagrams[200][10:]  # a wrong sequence with a wrong CRC
    parser = make_parser(clock_only=True)
    records = feed_batched(parser, datagrams, sizes)
    assert not any(isinstance(record, ScannerReturns) for record in records)
    clock = clock_of(records)
    assert len(clock) == 4  # 590 datagrams of 0.32 ms lie in 4 bins of 50 ms
    whole = clock_of(feed_all(make_parser(), datagrams))
    np.testing.assert_array_equal(clock, whole[np.isin(whole["host_time_ns"], clock["host_time_ns"])])
    assert parser.counters.errors == {"sequence_gap": 10 + 1}
    assert parser.counters.bad_checksums == 1
