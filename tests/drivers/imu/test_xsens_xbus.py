"""Tests Xbus on two recordings against another library's decoding; number formats, framing, times and gaps."""

from __future__ import annotations

import datetime as dt
import gzip
import re
import struct

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from swath.drivers.driver import STREAM_TRANSPORTS, find_driver
from swath.drivers.framing.framer import Framer
from swath.drivers.framing.kinds import XBUS, XBUS_MAX_DATA_BYTES
from swath.drivers.imu.xsens_xbus import wire as xbus
from swath.drivers.imu.xsens_xbus.parser import make_time_parser, rotation_vector
from swath.drivers.parser import DeviceSettings, DriverSettingsError, ParserCounters
from swath.georef.records import Chunk, ChunkBatch, NamesEdge, Record
from tests.drivers.builders import times
from tests.drivers.harness import (
    STREAM_HOST_NS,
    check_damage,
    check_garbage,
    check_stream,
    feed_pieces,
    outcome,
    run_stream,
)
from tests.drivers.imu_dbc import imu_rows
from tests.drivers.imu_xsens import FORMATS, NAMES, decoded, make, parse, recording, vector
from tests.drivers.recordings import FIXTURES

STARTS = (b"\xfa", b"\xfa\xff", b"\xfa\xff\x36\x20", b"\xfa\xff\x36\xff\x07\xff", b"\xfa\xff\x36\xff\xff\xff")
STATUS = {"StatusWord": 32, "StatusByte": 8}


def items_of(frame: bytes) -> xbus.Items:
    """Return the decoded items of a whole message."""
    found = xbus.split_items(frame[6 if frame[3] == 0xFF else 4 : -1])
    assert found is not None
    items = xbus.read_items(found)
    assert items is not None
    return items


# --- recordings ---


@pytest.mark.parametrize("name", NAMES)
def test_samples_match_the_reference_library(name: str) -> None:
    records, parser = parse(recording(name))
    rows = imu_rows(records)
    theirs = [block for block in decoded(name) if "Acceleration" in block]
    assert len(rows) == len(theirs) == 96
    assert rows["specific_force_b"].tolist() == [vector(block, "Acceleration") for block in theirs]
    assert rows["angular_rate_b"].tolist() == [vector(block, "RateOfTurn") for block in theirs]
    ticks = [int(block["SampleTimeFine"][0]) for block in theirs]
    assert rows["device_time_ns"].tolist() == [tick * 100_000 for tick in ticks]
    (status,) = set(STATUS) & set(theirs[0])
    assert rows["status"].tolist() == [int(block[status][0], 2) for block in theirs]
    assert np.isnan(rows["temperature_c"]).all()
    assert set(rows["pps_time_ns"].tolist()) == set(rows["gps_week"].tolist()) == {-1}
    assert parser.counters.messages == {"MTData2": 100}
    solutions = sum("LatLon" in block for block in theirs)
    assert parser.counters.errors == {"ins_no_solution": solutions}  # the unit does not call its orientation valid
    assert parser.counters.bytes_framed == len(recording(name))


@pytest.mark.parametrize("number", "12")
def test_message_boundaries_match_the_reference_library(number: str) -> None:
    text = gzip.decompress((FIXTURES / f"xsens/{number}_messages.golden.gz").read_bytes())
    theirs = [bytes.fromhex(line.decode()) for line in text.split()]
    assert len(theirs) == 100
    assert b"".join(theirs) == recording(f"{number}_output")
    assert [XBUS.measure(message, 0, True) for message in theirs] == [len(message) for message in theirs]
    framer = Framer((XBUS,), ParserCounters())
    assert [frame.data for frame in framer.feed(recording(f"{number}_output"), 0)] == theirs


ITEMS = {  # as the other library names them -> the identifier without number format
    "PacketCounter": xbus.PACKET_COUNTER,
    "SampleTimeFine": xbus.SAMPLE_TIME_FINE,
    "UTCTime": xbus.UTC_TIME,
    "StatusWord": xbus.STATUS_WORD,
    "StatusByte": xbus.STATUS_BYTE,
    "Acceleration": xbus.ACCELERATION,
    "DeltaV": xbus.DELTA_V,
    "RateOfTurn": xbus.RATE_OF_TURN,
    "DeltaQ": xbus.DELTA_Q,
}
FORMAT_NAMES = {"Float32": xbus.FLOAT32, "FP1220": xbus.FP1220}


@pytest.mark.parametrize("number", "12")
def test_identifiers_match_the_output_configuration_of_the_device(number: str) -> None:
    """The identifiers and rates that the device was configured to send are compared with the library's names."""
    data = (FIXTURES / f"xsens/{number}_outputconfig.bin").read_bytes()
    text = (FIXTURES / f"xsens/{number}_outputconfig.golden").read_text()
    said = re.findall(r"^(\w+)(?:\((.*)\))?:\n  (?:(Max)|(\d+) Hz)", text, re.MULTILINE)
    pairs = list(struct.iter_unpack(">HH", data))
    assert len(said) == len(pairs) == 13
    known = 0
    for (name, form, unlimited, rate_hz), (identifier, rate) in zip(said, pairs, strict=True):
        assert rate == (0xFFFF if unlimited else int(rate_hz))
        number_format = FORMAT_NAMES[form.rpartition(",")[2]] if form else 0
        if name in ITEMS:
            assert identifier == ITEMS[name] | number_format, name
            known += 1
    assert known == 8
    parser = make()
    assert feed_pieces(parser, [xbus.encode_message(0xC1, data)]) == []  # ReqOutputConfigurationAck
    assert parser.counters.messages == {"XBUS-C1": 1}


@pytest.mark.parametrize("name", NAMES)
def test_every_decoded_item_matches_the_reference_library(name: str) -> None:
    """Delta V, delta Q, the counter and UTC are compared too, from the items themselves."""
    data, position = recording(name), 0
    for block in decoded(name):
        length = XBUS.measure(data, position, True)
        items = items_of(data[position : position + length])
        assert items[xbus.PACKET_COUNTER] == (int(block["PacketCounter"][0]),)
        for item, kind in (("DeltaV", xbus.DELTA_V), ("DeltaQ", xbus.DELTA_Q)):
            assert (list(items[kind]) if kind in items else None) == (vector(block, item) if item in block else None)
        nanosecond, year, month, day, hour, minute, second, flags = items[xbus.UTC_TIME]
        utc = dt.datetime(year, month, day, hour, minute, second, nanosecond // 1000, dt.UTC)
        assert utc == dt.datetime.fromisoformat(block["UTCTime"][0])
        assert flags & 7 == 7
        position += length
    assert position == len(data)


@pytest.mark.parametrize("name", NAMES)
def test_increments_are_divided_by_the_interval(name: str) -> None:
    rows = imu_rows(parse(recording(name), sample="increment", rate_hz=100)[0])
    theirs = [block for block in decoded(name) if "DeltaV" in block]
    expected = 100.0 * np.array([vector(block, "DeltaV") for block in theirs])
    np.testing.assert_allclose(rows["specific_force_b"], expected, rtol=1e-15)
    quaternions = np.roll([vector(block, "DeltaQ") for block in theirs], -1, axis=1)
    np.testing.assert_allclose(rows["angular_rate_b"], 100.0 * Rotation.from_quat(quaternions).as_rotvec(), rtol=1e-6)


def test_rate_of_turn_equals_its_increment_divided_by_the_interval() -> None:
    """They agree in float32; 12.20 resolves 2e-4 rad/s of an increment."""
    rates = imu_rows(parse(recording("1_output"))[0])
    increments = imu_rows(parse(recording("1_output"), sample="increment", rate_hz=100)[0])
    np.testing.assert_allclose(increments["angular_rate_b"], rates["angular_rate_b"], rtol=1e-5, atol=1e-8)


@pytest.mark.parametrize("name", NAMES)
def test_each_second_gives_one_time_message(name: str) -> None:
    found = times(parse(recording(name))[0])
    theirs = [dt.datetime.fromisoformat(block["UTCTime"][0]) for block in decoded(name) if "GNSSPVTData" not in block]
    firsts = [
        now for before, now in zip([None, *theirs], theirs, strict=False) if not before or before.second != now.second
    ]
    assert len(found) == len(firsts) >= 2
    for message, utc in zip(found, firsts, strict=True):
        assert (message.time.date, message.names_edge, message.valid) == (utc.date(), NamesEdge.PREVIOUS, True)
        midnight = utc.replace(hour=0, minute=0, second=0, microsecond=0)
        assert message.time.time_ns == (utc - midnight) // dt.timedelta(seconds=1) * 1_000_000_000
    assert [message.time.leap_seconds for message in found][0::1] == [None, *[18] * (len(found) - 1)]
    parser = make_time_parser(DeviceSettings("imu/main"))
    assert parser.feed(Chunk("imu/main", 1_000_000_000, recording(name))) == found


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_records_do_not_depend_on_how_recordings_are_cut(name: str) -> None:
    outcome = check_stream(make, recording(name))
    assert len(outcome.rows["ImuSamples"]) == 96


@pytest.mark.parametrize("size", [1, 64, 143, 1024])
def test_a_batch_of_reads_gives_the_records_of_its_single_reads(size: int) -> None:
    data = recording("1_output")[: len(recording("1_output")) // size * size]
    units = np.frombuffer(data, np.uint8).reshape(-1, size)
    parser = make()
    host_ns = np.full(len(units), STREAM_HOST_NS, np.int64)
    records = [*parser.feed_batch(ChunkBatch("imu/main", host_ns, units)), *parser.close()]
    assert outcome(records, parser) == run_stream(make, (unit.tobytes() for unit in units))


def test_damaged_recordings_never_raise() -> None:
    check_damage(make, recording("1_output"), starts=STARTS)
    check_garbage(make, starts=STARTS)


# --- numbers ---


@pytest.mark.parametrize(
    ("number_format", "value", "wire"),
    [
        (xbus.FLOAT32, -1.5, "bfc00000"),
        (xbus.FP1220, -1.5, "ffe80000"),
        (xbus.FP1220, 2047.5, "7ff80000"),
        (xbus.FP1632, -1.5, "80000000fffe"),  # the fraction first, then the whole part
        (xbus.FP1632, 32767.25, "400000007fff"),
        (xbus.FP1632, 1.0, "000000000001"),
        (xbus.FLOAT64, -1.5, "bff8000000000000"),
    ],
)
def test_number_formats_are_decoded(number_format: int, value: float, wire: str) -> None:
    assert xbus.decode_numbers(bytes.fromhex(wire), number_format) == (value,)
    assert xbus.encode_numbers([value], number_format).hex() == wire


@pytest.mark.parametrize("number_format", FORMATS)
def test_a_message_of_every_number_format_is_read_back(number_format: int) -> None:
    force, rate = (0.25, -9.8125, 1.5), (-0.125, 0.0625, 2.0)
    message = xbus.encode_mtdata2(
        xbus.encode_item(xbus.TEMPERATURE, [36.5], number_format),
        xbus.encode_item(xbus.SAMPLE_TIME_FINE, [12345]),
        xbus.encode_item(0x2030, (1.0, 2.0, 3.0), number_format),
        xbus.encode_item(xbus.RATE_OF_TURN, rate, number_format),
        xbus.encode_item(xbus.ACCELERATION, force, number_format),
        xbus.encode_item(xbus.STATUS_WORD, [0xDEADBEEF]),
    )
    records, parser = parse(message)
    (row,) = imu_rows(records)
    assert (tuple(row["specific_force_b"]), tuple(row["angular_rate_b"])) == (force, rate)
    assert (row["temperature_c"], row["status"], row["device_time_ns"]) == (36.5, 0xDEADBEEF, 1_234_500_000)
    assert parser.counters.bytes_framed == len(message)


def test_orientation_bits_of_an_identifier_do_not_rotate_the_sample() -> None:
    """Bits 2 and 3 of an identifier choose the frame of orientations; inertial items stay in the housing's axes."""
    for turned in (0x0, 0x4, 0x8):
        message = xbus.encode_mtdata2(
            xbus.encode_item(xbus.ACCELERATION | turned, (1.0, 2.0, 3.0)),
            xbus.encode_item(xbus.RATE_OF_TURN | turned, (4.0, 5.0, 6.0)),
        )
        assert imu_rows(parse(message)[0])["specific_force_b"].tolist() == [[1.0, 2.0, 3.0]]


def test_rotation_vectors_match_scipy() -> None:
    rng = np.random.default_rng(5)
    quaternions = rng.normal(size=(200, 4))
    quaternions[:100, 1:] *= 10.0 ** rng.uniform(-9, 0, (100, 1))  # small angles, as of one sample
    for quaternion in quaternions.tolist():
        expected = Rotation.from_quat([*quaternion[1:], quaternion[0]]).as_rotvec()
        np.testing.assert_allclose(rotation_vector(tuple(quaternion)), expected, rtol=1e-9, atol=1e-15)
    assert rotation_vector((1.0, 0.0, 0.0, 0.0)) == (0.0, 0.0, 0.0)


# --- framing ---


def test_a_long_message_has_an_extended_length() -> None:
    items = [xbus.encode_item(xbus.ACCELERATION, (1.0, 2.0, 3.0)), xbus.encode_item(xbus.RATE_OF_TURN, (4.0, 5.0, 6.0))]
    filler = xbus.ITEM_HEADER.pack(0x7020, 250) + bytes(250)
    longest = [*items, *[filler] * 7]
    longest.append(
        xbus.ITEM_HEADER.pack(0x7020, rest := XBUS_MAX_DATA_BYTES - 3 - sum(map(len, longest))) + bytes(rest)
    )
    for message in (xbus.encode_mtdata2(*items, filler), xbus.encode_mtdata2(*longest)):
        assert message[3] == 0xFF
        assert struct.unpack_from(">H", message, 4)[0] == len(message) - 7
        records, parser = parse(message)
        assert len(imu_rows(records)) == 1
        assert parser.counters.bytes_framed == len(message)
    with pytest.raises(ValueError, match="cannot hold 2049 bytes"):
        xbus.encode_message(0x36, bytes(2049))


def test_both_length_encodings_are_read_at_the_border_between_them() -> None:
    for size in (0, 1, 253, 254, 255, 256):
        message = xbus.encode_message(0x3F, bytes(size))
        assert (len(message), sum(message[1:]) & 0xFF) == (size + (5 if size < 255 else 7), 0)
        _, parser = parse(message)
        assert parser.counters.messages == {"XBUS-3F": 1}


def test_a_length_beyond_the_bound_is_counted_and_not_waited_for() -> None:
    good = xbus.encode_message(0x3E, b"")
    parser = make()
    parser.feed(Chunk("imu/main", 0, b"\xfa\xff\x36\xff\x08\x01" + good))
    assert parser.counters.messages == {"WakeUp": 1}
    assert parser.counters.errors == {"xbus_length_over_bound": 1}


def test_host_commands_are_not_decoded() -> None:
    """A device answers with odd identifiers; GoToConfig (30) on the line is an echo."""
    _, parser = parse(xbus.encode_message(0x30, b"") + xbus.encode_message(0x31, b""))
    assert parser.counters.messages == {"XBUS-31": 1}
    assert parser.counters.bytes_skipped == 5


@pytest.mark.parametrize(
    "data",
    [
        xbus.encode_item(xbus.ACCELERATION, (1.0, 2.0, 3.0)) + b"\x80",  # half a header
        xbus.encode_item(xbus.ACCELERATION, (1.0, 2.0, 3.0))[:-1],  # an item longer than the message
        xbus.ITEM_HEADER.pack(xbus.ACCELERATION, 11) + bytes(11),
        xbus.ITEM_HEADER.pack(xbus.PACKET_COUNTER, 3) + bytes(3),
        xbus.ITEM_HEADER.pack(xbus.UTC_TIME, 11) + bytes(11),
    ],
)
def test_items_of_a_wrong_length_are_counted(data: bytes) -> None:
    records, parser = parse(xbus.encode_message(0x36, data))
    assert records == []
    assert (parser.counters.bad_messages, parser.counters.errors) == (1, {"bad_length": 1})


# --- what is missing, wrong or restarts ---


def sample(number: int, ticks: int | None = None) -> bytes:
    return xbus.encode_mtdata2(
        xbus.encode_item(xbus.PACKET_COUNTER, [number & 0xFFFF]),
        xbus.encode_item(xbus.SAMPLE_TIME_FINE, [(100 * number if ticks is None else ticks) & 0xFFFF_FFFF]),
        xbus.encode_item(xbus.ACCELERATION, (0.0, 0.0, 9.8)),
        xbus.encode_item(xbus.RATE_OF_TURN, (0.0, 0.0, 0.0)),
    )


def test_missing_packets_are_counted_through_the_counter_wrap() -> None:
    records, parser = parse(*(sample(number) for number in (65534, 65535, 65536, 65539, 65540)))
    assert len(imu_rows(records)) == 5
    assert parser.counters.errors == {"packet_gap": 2}


def test_the_tick_counter_continues_through_its_wrap_and_shows_a_restart() -> None:
    parser = make()
    records: list[Record] = []
    for second, ticks in enumerate([2**32 - 10_000, 0, 10_000, 5_000, 15_000]):
        host_ns = 10_000_000_000 + second * 1_000_000_000 + (5_000_000_000 if second > 2 else 0)
        records += parser.feed(Chunk("imu/main", host_ns, sample(second, ticks)))
    found = imu_rows(records)["device_time_ns"]
    assert np.diff(found)[:2].tolist() == [1_000_000_000, 1_000_000_000]
    assert found[3:].tolist() == [500_000_000, 1_500_000_000]
    assert parser.counters.errors == {"restart": 1}


def test_a_message_with_half_a_sample_or_the_other_kind_is_counted() -> None:
    force = xbus.encode_item(xbus.ACCELERATION, (0.0, 0.0, 9.8))
    rate = xbus.encode_item(xbus.RATE_OF_TURN, (0.0, 0.0, 0.0))
    delta = xbus.encode_item(xbus.DELTA_V, (0.0, 0.0, 0.098)) + xbus.encode_item(xbus.DELTA_Q, (1.0, 0.0, 0.0, 0.0))
    for config, items, code in (
        ({}, [force], "sample_incomplete"),
        ({}, [delta], "increments_only"),
        ({"sample": "increment", "rate_hz": 100}, [force, rate], "rates_only"),
    ):
        records, parser = parse(xbus.encode_mtdata2(*items), **config)
        assert records == []
        assert parser.counters.errors == {code: 1}


def test_a_non_finite_value_gives_no_sample() -> None:
    nan = xbus.encode_item(xbus.ACCELERATION, (0.0, float("nan"), 0.0))
    records, parser = parse(xbus.encode_mtdata2(nan, xbus.encode_item(xbus.RATE_OF_TURN, (0.0, 0.0, 0.0))))
    assert records == []
    assert parser.counters.errors == {"bad_value": 1}


def test_a_sample_without_a_counter_has_no_device_time() -> None:
    bare = xbus.encode_mtdata2(
        xbus.encode_item(xbus.ACCELERATION, (0.0, 0.0, 9.8)), xbus.encode_item(xbus.RATE_OF_TURN, (0.0, 0.0, 0.0))
    )
    rows = imu_rows(parse(sample(1), bare, sample(2))[0])
    assert rows["device_time_ns"].tolist() == [10_000_000, -1, 20_000_000]


@pytest.mark.parametrize(
    ("fields", "valid"),
    [((0, 2026, 11, 21, 12, 0, 0, 0x07), True), ((0, 2026, 11, 21, 12, 0, 0, 0x03), False)],
)
def test_a_time_is_valid_only_while_the_device_declares_it_valid(fields: tuple[int, ...], valid: bool) -> None:
    records, _ = parse(xbus.encode_mtdata2(xbus.encode_item(xbus.UTC_TIME, fields)))
    assert [message.valid for message in times(records)] == [valid]


@pytest.mark.parametrize(
    "fields", [(0, 2026, 0, 1, 0, 0, 0, 7), (0, 2026, 1, 1, 24, 0, 0, 7), (0, 0, 0, 0, 0, 0, 0, 0)]
)
def test_an_impossible_time_is_counted(fields: tuple[int, ...]) -> None:
    records, parser = parse(xbus.encode_mtdata2(xbus.encode_item(xbus.UTC_TIME, fields)))
    assert records == []
    assert parser.counters.errors == {"bad_value": 1}


def test_increments_need_the_rate() -> None:
    with pytest.raises(DriverSettingsError, match="rate_hz: needed with sample"):
        make(sample="increment", rate_hz=None)


def test_the_driver_is_registered() -> None:
    driver = find_driver("imu", "xsens-xbus")
    assert driver.transports == STREAM_TRANSPORTS
    assert driver.make_time_parser is make_time_parser
