"""Tests protocol ``dbc``: samples from frames in any batches, counters, PPS latch, settings and bad input."""

from __future__ import annotations

import itertools
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from swath.drivers.can_frames import (
    CAN_EFF_FLAG,
    CAN_ERR_FLAG,
    CAN_FRAME_DTYPE,
    decode_can_frames,
    encode_can_frame,
)
from swath.drivers.driver import Driver, find_driver
from swath.drivers.imu.counters import CounterUnwrapper
from swath.drivers.imu.dbc.parser import DbcParser, make_clock_parser
from swath.drivers.parser import DeviceSettings, DriverSettingsError, Parser
from swath.georef.arrays import Int64Array, StructArray
from swath.georef.records import ChunkBatch, DeviceClockSamples, Record
from tests.drivers.harness import Snapshot, check_packet_damage, check_packets, packed_rows
from tests.drivers.imu_dbc import (
    ACC,
    IMU_DBC,
    acc_frame,
    clock_rows,
    feed,
    gyr_frame,
    imu_rows,
    sample_frame,
    settings,
    sync_frame,
    temp_frame,
    units,
    without,
)

KINDS = {  # rule -> kinds of frames in a sample, and signals that the map lacks under this rule
    "last": ("AGT", ("pps_ticks",)),
    "first": ("AGT", ("pps_ticks",)),
    "repeat": ("AG", ("sample_ticks", "pps_ticks", "temperature")),
}


def make(rule: str = "last", *drop: str, **config: Any) -> DbcParser:
    """Return a parser with one of the grouping rules."""
    return DbcParser(settings(signals=without(*drop), group="first" if rule == "first" else "last", **config))


def reference_samples(kinds: str, rule: str) -> tuple[list[dict[str, int]], int, int]:
    """Return samples by the documented rules, one frame at a time, and the incomplete and duplicate counts."""
    parts = set(KINDS[rule][0])
    good: list[dict[str, int]] = []
    group: list[tuple[str, int]] = []
    dropped = {"incomplete": 0, "duplicate": 0}

    def finish() -> None:
        there = [kind for kind, _ in group]
        if group and set(there) != parts:
            dropped["incomplete"] += 1
        elif group and len(there) != len(parts):
            dropped["duplicate"] += 1
        elif group:
            good.append(dict(group))
        group.clear()

    for number, kind in enumerate(kinds):
        if (rule == "first" and kind == "T") or (rule == "repeat" and kind in dict(group)):
            finish()
        group.append((kind, number))
        if (rule == "last" and kind == "T") or (rule == "repeat" and set(dict(group)) == parts):
            finish()
    if rule == "first":
        finish()
    return good, dropped["incomplete"], dropped["duplicate"]


@pytest.mark.parametrize("rule", ["last", "first", "repeat"])
def test_samples_follow_the_stated_rule_whatever_the_batches(rule: str) -> None:
    parts, drop = KINDS[rule]
    fresh = Snapshot(make(rule, *drop)).again

    @hypothesis_settings(max_examples=200, deadline=None, derandomize=True)
    @given(
        kinds=st.lists(st.sampled_from([parts, *parts]), max_size=25).map("".join),
        cuts=st.lists(st.integers(0, 60), max_size=6),
    )
    def property_holds(kinds: str, cuts: list[int]) -> None:
        frames = [_numbered(kind, number) for number, kind in enumerate(kinds)]
        parser = fresh()
        records: list[Record] = []
        edges = sorted({0, len(frames), *(cut for cut in cuts if cut < len(frames))})
        for start, end in itertools.pairwise(edges):
            host = np.arange(start, end, dtype=np.int64) * 1000
            records += parser.feed_batch(ChunkBatch("imu/main", host, units(frames[start:end])))
        records += parser.close()
        expected, incomplete, duplicate = reference_samples(kinds, rule)
        got = imu_rows(records) if records else np.empty(0, dtype=[("specific_force_b", "f8", 3)])
        assert [round(row[0] / 0.01) for row in got["specific_force_b"]] == [sample["A"] for sample in expected]
        if len(got):
            assert np.rint(np.degrees(got["angular_rate_b"][:, 0]) / 0.02).tolist() == [s["G"] for s in expected]
            assert got["host_time_ns"].tolist() == [max(sample.values()) * 1000 for sample in expected]
        assert parser.counters.errors["sample_incomplete"] == incomplete
        assert parser.counters.errors["sample_duplicate"] == duplicate

    property_holds()


def _numbered(kind: str, number: int) -> bytes:
    """Return a frame whose value is its number, so that a sample shows which frames made it."""
    return {"A": acc_frame(number), "G": gyr_frame(number), "T": sample_frame(number * 1000)}[kind]


def _stream(samples: int, *, with_latch: bool = True) -> list[bytes]:
    """Return a regular stream at 100 Hz with a latch a second, a lost frame, a doubled one and foreign traffic."""
    frames: list[bytes] = []
    for number in range(samples):
        ticks = 4_294_000_000 + number * 10_000  # wraps in the stream
        if with_latch and number % 100 == 0:
            frames.append(sync_frame(ticks - 5_000))
        frames += [acc_frame(number, -number, 981), gyr_frame(number)]
        if number == 50:
            frames.pop()
        if number == 60:
            frames.append(acc_frame(1))
        frames += [encode_can_frame(0x7FF, b"\x01"), sample_frame(ticks)]
    return frames


@pytest.mark.parametrize(("group", "good", "incomplete"), [("last", 298, 1), ("first", 297, 3)])
def test_samples_do_not_depend_on_how_a_stream_is_batched(group: str, good: int, incomplete: int) -> None:
    whole = check_packets(lambda: make(group), _stream(300))
    assert len(whole.rows["ImuSamples"]) == len(whole.rows["DeviceClockSamples"]) == good
    assert whole.counters["errors"] == {"sample_incomplete": incomplete, "sample_duplicate": 1}


def test_damaged_units_never_raise() -> None:
    check_packet_damage(make, _stream(12))


def test_units_and_scale_are_converted_to_si() -> None:
    parser = make("last", "pps_ticks")
    rows = imu_rows(feed(parser, [acc_frame(100, -200, 981), gyr_frame(50, -50, 9000), sample_frame(1, -55)]))
    np.testing.assert_allclose(rows["specific_force_b"][0], [1.0, -2.0, 9.81], rtol=1e-14)
    np.testing.assert_allclose(rows["angular_rate_b"][0], np.radians([1.0, -1.0, 180.0]), rtol=1e-14)
    assert rows["temperature_c"][0] == np.float32(-5.5)
    assert (rows["device_time_ns"][0], rows["pps_time_ns"][0], rows["gps_week"][0]) == (1000, -1, -1)
    assert rows["host_time_ns"][0] == 2_000_000, "the host time of the frame that completed the sample"


@pytest.mark.parametrize(
    ("unit", "factor"), [("g", 9.80665), ("G", 9.80665), ("m/s²", 1.0), ("m.s-2", 1.0), ("m/s2", 1.0)]
)
def test_units_of_specific_force_are_converted(unit: str, factor: float) -> None:
    parser = DbcParser(settings(IMU_DBC.replace("m/s^2", unit), without("pps_ticks")))
    rows = imu_rows(feed(parser, [acc_frame(100), gyr_frame(0), sample_frame(0)]))
    assert rows["specific_force_b"][0, 0] == pytest.approx(factor)


@pytest.mark.parametrize(("unit", "expected"), [("rad/s", 1.0), ("°/s", np.pi / 180), ("deg/s", np.pi / 180)])
def test_units_of_angular_rate_are_converted(unit: str, expected: float) -> None:
    parser = DbcParser(settings(IMU_DBC.replace("deg/s", unit), without("pps_ticks")))
    rows = imu_rows(feed(parser, [acc_frame(0), gyr_frame(50), sample_frame(0)]))
    assert rows["angular_rate_b"][0, 0] == pytest.approx(expected)


def test_increments_are_divided_by_the_interval() -> None:
    dbc = IMU_DBC.replace("m/s^2", "m/s").replace("deg/s", "deg")
    parser = DbcParser(settings(dbc, without("pps_ticks"), sample="increment", rate_hz=200))
    rows = imu_rows(feed(parser, [acc_frame(5), gyr_frame(1), sample_frame(0)]))
    assert rows["specific_force_b"][0, 0] == pytest.approx(10.0)
    assert rows["angular_rate_b"][0, 0] == pytest.approx(np.radians(4.0))


def _sample(ticks: int) -> list[bytes]:
    return [acc_frame(0), gyr_frame(0), sample_frame(ticks)]


def _run(parser: Parser, ticks: list[int], host_s: list[float]) -> StructArray:
    """Return the rows of one sample for each counter value, arriving at the times given, s."""
    frames = [frame for value in ticks for frame in _sample(value)]
    return imu_rows(feed(parser, frames, np.repeat(np.array(host_s) * 1e9, 3).astype(np.int64)))


def test_a_counter_continues_through_its_wrap() -> None:
    parser = make("last", "pps_ticks")
    rows = _run(parser, [2**32 - 5000, 0, 5000], [0.0, 0.005, 0.010])
    assert np.diff(rows["device_time_ns"]).tolist() == [5_000_000, 5_000_000]
    assert parser.counters.errors["restart"] == 0


def test_wraps_during_a_gap_are_counted_from_host_time() -> None:
    parser = make("last", "pps_ticks")
    gap_s = 3 * 2**32 / 1e6 + 10.0
    rows = _run(parser, [1000, 1000 + 10_000_000], [0.0, gap_s - 0.3])
    assert np.diff(rows["device_time_ns"]).tolist() == [3 * 2**32 * 1000 + 10_000_000_000]


def test_a_restart_is_counted_and_starts_a_new_count() -> None:
    parser = make("last", "pps_ticks")
    rows = _run(parser, [100_000_000, 100_005_000, 3000, 8000], [0.0, 0.005, 4.0, 4.005])
    assert rows["device_time_ns"].tolist() == [100_000_000_000, 100_005_000_000, 3_000_000, 8_000_000]
    assert parser.counters.errors["restart"] == 1


def test_a_late_reader_is_not_taken_for_a_restart() -> None:
    parser = make("last", "pps_ticks")
    _run(parser, [0, 5000, 10_000, 15_000], [0.0, 1.5, 1.5, 1.5])
    assert parser.counters.errors["restart"] == 0


def test_a_fast_counter_that_may_have_wrapped_unseen_begins_anew() -> None:
    """One stamp is late by 40 ms, and the counter wraps in 65 ms; no whole wrap is derived from it."""
    unwrapper = CounterUnwrapper(16, 1e6)
    ticks = np.arange(40, dtype=np.uint64) * 5000
    host_ns = np.arange(40) * 5_000_000
    host_ns[10:18] = 18 * 5_000_000  # read at once, after a stall
    counts, restart = unwrapper.unwrap(ticks & np.uint64(0xFFFF), host_ns)
    assert np.flatnonzero(restart).tolist() == [10]
    assert set(np.diff(counts[10:]).tolist()) == set(np.diff(counts[:10]).tolist()) == {5000}
    assert unwrapper.restarts == 1


@pytest.mark.parametrize("rule", ["last", "first"])
def test_the_latched_counter_has_the_scale_of_the_sample_counter(rule: str) -> None:
    parser = make(rule)
    base = 2**32 - 20_000
    frames: list[bytes] = []
    for number in range(10):
        if number == 4:
            frames.append(sync_frame(base + 37_000))  # latched before the sample at +40 000, after the wrap
        frames += [acc_frame(0), gyr_frame(0), sample_frame(base + number * 10_000)]
    frames = frames if rule == "last" else [*frames[2:], acc_frame(0), gyr_frame(0)]
    rows = imu_rows([*feed(parser, frames), *parser.close()])
    known = rows["pps_time_ns"] >= 0
    assert known.any()
    assert not known.all()
    assert set(rows["pps_time_ns"][known].tolist()) == {(base + 37_000) * 1000}
    assert (rows["device_time_ns"][known] >= rows["pps_time_ns"][known] - 10_000_000).all()


def test_a_latch_without_new_edges_does_not_move_with_the_wraps() -> None:
    parser = make()
    records = feed(parser, [sync_frame(500), *_sample(1000)])
    for number in range(1, 6):
        host = np.full(3, number * 1_000_000_000_000, np.int64)
        records += feed(parser, _sample(1000 + number * 1_000_000_000), host)
    assert set(imu_rows(records)["pps_time_ns"].tolist()) == {500_000}


def test_after_a_restart_the_latch_is_unknown_until_the_next_edge() -> None:
    parser = make()
    host = np.repeat(np.array([0, 10, 10.01]) * 1e9, [4, 3, 4]).astype(np.int64)
    frames = [sync_frame(90_000_000), *_sample(90_001_000), *_sample(5000), sync_frame(12_000), *_sample(15_000)]
    rows = imu_rows(feed(parser, frames, host))
    assert rows["pps_time_ns"].tolist() == [90_000_000_000, -1, 12_000_000]


def test_clock_samples_pair_host_device_and_edge() -> None:
    parser = make_clock_parser(settings())
    records = feed(parser, [sync_frame(500), *_sample(1000)])
    assert [type(record) for record in records] == [DeviceClockSamples]
    (row,) = clock_rows(records)
    assert (row["device_time_ns"], row["pps_time_ns"]) == (1_000_000, 500_000)
    assert (row["host_time_ns"], row["pps_count"], row["locked"]) == (3_000_000, -1, -1)


def test_a_temperature_from_its_own_message_is_kept_for_later_samples() -> None:
    signals = {**without("pps_ticks"), "temperature": "TEMP.celsius"}
    parser = DbcParser(settings(signals=signals))
    rows = imu_rows(feed(parser, [*_sample(0), temp_frame(215), *_sample(5000), *_sample(10_000)]))
    np.testing.assert_array_equal(rows["temperature_c"], np.array([np.nan, 21.5, 21.5], np.float32))


STATUS_DBC = (
    IMU_DBC
    + """
BO_ 262 STATE: 8 IMU
 SG_ word : 0|40@1+ (1,0) [0|0] "" IMU
 SG_ count : 40|8@1+ (1,0) [0|0] "" IMU
"""
)


def state_frame(word: int, count: int) -> bytes:
    return encode_can_frame(262, word.to_bytes(5, "little") + bytes([count & 0xFF, 0, 0]))


def test_a_status_word_is_stored_with_each_sample_and_kept_for_later_ones() -> None:
    signals = {**without("pps_ticks"), "status": "STATE.word"}
    parser = DbcParser(settings(STATUS_DBC, signals=signals))
    rows = imu_rows(feed(parser, [*_sample(0), state_frame(0xAB_8000_0001, 0), *_sample(5000), *_sample(10_000)]))
    assert rows["status"].tolist() == [0, 0x8000_0001, 0x8000_0001], "its low 32 bits"


def test_samples_skipped_by_the_packet_counter_are_counted_whatever_the_batches() -> None:
    signals = {**without("pps_ticks"), "packet_counter": "STATE.count"}
    counts = [254, 255, 256, 256, 259, 260, 264, 200, 201]  # repeated, 2 and 3 missing, gone back by 64
    frames = [
        frame for number, count in enumerate(counts) for frame in (*_sample(5000 * number), state_frame(0, count))
    ]
    for size in (1, 3, 7, len(frames)):
        parser = DbcParser(settings(STATUS_DBC, signals=signals))
        for start in range(0, len(frames), size):
            feed(parser, frames[start : start + size], np.arange(start, len(frames))[:size] * 1_000_000)
        assert parser.counters.errors == {"packet_gap": 5}


@pytest.mark.parametrize("key", ["status", "packet_counter"])
def test_a_floating_point_status_or_counter_is_refused(key: str) -> None:
    text = STATUS_DBC.replace("word : 0|40@1+", "word : 0|32@1-") + "\nSIG_VALTYPE_ 262 word : 1;\n"
    with pytest.raises(DriverSettingsError, match=f"signals.{key}: STATE.word is a float"):
        DbcParser(settings(text, signals={**without("pps_ticks"), key: "STATE.word"}))


def test_error_and_remote_frames_are_counted_not_decoded() -> None:
    error = np.zeros(1, CAN_FRAME_DTYPE)
    error["can_id"] = CAN_ERR_FLAG | ACC
    remote = encode_can_frame(ACC, b"", remote=True)
    parser = make("last", "pps_ticks")
    rows = imu_rows(feed(parser, [error.tobytes(), remote, *_sample(0)]))
    assert len(rows) == 1
    assert parser.counters.errors == {"error_frame": 1, "rtr_frame": 1}


def test_an_extended_identifier_is_another_message() -> None:
    parser = make("last", "pps_ticks")
    other = encode_can_frame(ACC, struct.pack("<3h", 7, 7, 7), extended=True)
    assert imu_rows(feed(parser, [other, *_sample(0)]))["specific_force_b"][0, 0] == 0.0


def test_short_frames_and_odd_units_are_counted() -> None:
    parser = make("last", "pps_ticks")
    assert feed(parser, [encode_can_frame(ACC, b"\x01\x02"), encode_can_frame(ACC, b"")]) == []
    assert feed(parser, [b"\x00" * 15]) == []
    assert parser.counters.errors["bad_length"] == 3
    assert parser.counters.bad_messages == 3


def test_fd_frames_give_the_same_samples_as_classic_frames_and_can_be_mixed() -> None:
    def as_fd(frame: bytes) -> bytes:
        return frame + bytes(56)

    expected = imu_rows(feed(make("last", "pps_ticks"), _sample(0)))
    parser = make("last", "pps_ticks")
    classic, fd = _sample(0)[:1], [as_fd(frame) for frame in _sample(0)[1:]]
    records = [*feed(parser, classic), *feed(parser, fd, np.array([1, 2]) * 1_000_000)]
    assert packed_rows(imu_rows(records)) == packed_rows(expected)


def test_one_long_fd_frame_carries_a_whole_sample() -> None:
    names = [f"{kind}{axis}" for kind in ("a", "w") for axis in "xyz"]
    lines = [
        f' SG_ {name} : {number * 64}|64@1- (1,0) [0|0] "{"m/s2" if name[0] == "a" else "rad/s"}" X'
        for number, name in enumerate(names)
    ]
    text = 'VERSION ""\nNS_ :\nBS_:\nBU_: X\n\nBO_ 100 M: 48 X\n' + "\n".join(lines) + "\n\n"
    text += "".join(f"SIG_VALTYPE_ 100 {name} : 2;\n" for name in names)
    signals = {"specific_force": ["M.ax", "M.ay", "M.az"], "angular_rate": ["M.wx", "M.wy", "M.wz"]}
    parser = DbcParser(settings(text, signals))
    values = [0.1, 0.2, 9.8, -0.1, -0.2, -0.3]
    rows = imu_rows(feed(parser, [encode_can_frame(100, struct.pack("<6d", *values), fd=True)]))
    assert [*rows["specific_force_b"][0], *rows["angular_rate_b"][0]] == values


MULTIPLEXED = """VERSION ""
NS_ :
BS_:
BU_: X

BO_ 100 M: 8 X
 SG_ page M : 0|8@1+ (1,0) [0|0] "" X
 SG_ ax m1 : 8|16@1- (1,0) [0|0] "m/s2" X
 SG_ ay m1 : 24|16@1- (1,0) [0|0] "m/s2" X
 SG_ az m1 : 40|16@1- (1,0) [0|0] "m/s2" X
 SG_ wx m2 : 8|16@1- (1,0) [0|0] "rad/s" X
 SG_ wy m2 : 24|16@1- (1,0) [0|0] "rad/s" X
 SG_ wz m2 : 40|16@1- (1,0) [0|0] "rad/s" X
 SG_ count : 56|8@1+ (1,0) [0|0] "" X
"""
MULTIPLEXED_SIGNALS = {"specific_force": ["M.ax", "M.ay", "M.az"], "angular_rate": ["M.wx", "M.wy", "M.wz"]}


def test_multiplexed_signals_are_read_from_their_own_frames() -> None:
    parser = DbcParser(settings(MULTIPLEXED, MULTIPLEXED_SIGNALS))
    pages = [encode_can_frame(100, struct.pack("<B3hB", page, page, 10, 20, 0)) for page in (1, 3, 2)]
    rows = imu_rows(feed(parser, pages))
    assert rows["specific_force_b"].tolist() == [[1.0, 10.0, 20.0]]
    assert rows["angular_rate_b"].tolist() == [[2.0, 10.0, 20.0]]


def test_a_signal_on_every_page_is_refused_beside_signals_of_two_pages() -> None:
    with pytest.raises(DriverSettingsError, match=r"M.count is in every frame of M"):
        DbcParser(settings(MULTIPLEXED, {**MULTIPLEXED_SIGNALS, "sample_ticks": "M.count"}))


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"signals": {**without(), "specific_force": ["ACC.acc_x"]}}, "signals.specific_force must name three signals"),
        (
            {"signals": {**without(), "angular_rates": "x"}},
            "signals.angular_rates: unknown signal; there are: specific_force",
        ),
        ({"signals": without("angular_rate")}, "signals.angular_rate must name three signals"),
        ({"signals": without("sample_ticks")}, "signals.pps_ticks needs signals.sample_ticks"),
        (
            {"signals": {**without(), "sample_ticks": "SAMPLE.tick"}},
            "no signal SAMPLE.tick in imu.dbc; did you mean ticks",
        ),
        (
            {"signals": {**without(), "specific_force": ["TEMP.celsius"] * 3}},
            'has unit "degC"; specific_force needs m/s2',
        ),
        ({"tick_hz": 0}, "tick_hz: got 0, want counts per second, above 0"),
        ({"group": "middle"}, 'group: got "middle", want "last" or "first"'),
        ({"sample": "increment"}, "rate_hz: needed with sample"),
    ],
)
def test_wrong_settings_are_refused_in_one_line_that_names_them(changes: dict[str, Any], text: str) -> None:
    with pytest.raises(DriverSettingsError, match=text) as caught:
        DbcParser(settings(**changes))
    assert "\n" not in str(caught.value)


def test_the_tick_defaults_to_a_microsecond() -> None:
    parser = make("last", "pps_ticks", tick_hz=None)
    assert _run(parser, [1000, 6000], [0.0, 0.005])["device_time_ns"].tolist() == [1_000_000, 6_000_000]


def test_the_driver_is_registered_and_gives_the_recorder_its_clock() -> None:
    driver: Driver = find_driver("imu", "dbc")
    assert driver.transports == ("can",)
    assert driver.make_time_parser is not None
    records = feed(driver.make_time_parser(settings()), [sync_frame(500), *_sample(1000)])
    assert len(clock_rows(records)) == 1


def test_frames_are_unchanged_by_the_log_layout() -> None:
    unit = encode_can_frame(0x1ABCDEF, b"\x01\x02\x03", extended=True)
    assert unit == bytes.fromhex("efcdab81 03 000000 0102030000000000".replace(" ", ""))
    frames = decode_can_frames(units([unit]))
    assert frames is not None
    assert (frames["can_id"][0], frames["length"][0]) == (CAN_EFF_FLAG | 0x1ABCDEF, 3)
    with pytest.raises(ValueError, match="does not fit 11 bits"):
        encode_can_frame(0x800, b"")
    with pytest.raises(ValueError, match="carries 8 bytes, not 9"):
        encode_can_frame(1, bytes(9))
    with pytest.raises(ValueError, match="cannot carry 9 bytes"):
        encode_can_frame(1, bytes(9), fd=True)


def test_a_manufacturers_dbc_with_the_counter_first_is_decoded() -> None:
    """SBG Ellipse's IMU_INFO with the time stamp opens a sample; ACCEL and GYRO follow (sbgECom, canProtocol.md)."""
    prefix = "SBG_ECAN_MSG_IMU_"
    signals = {
        "specific_force": [f"{prefix}ACCEL.ACCEL_{axis}" for axis in "XYZ"],
        "angular_rate": [f"{prefix}GYRO.GYRO_{axis}" for axis in "XYZ"],
        "sample_ticks": f"{prefix}INFO.TIME_STAMP",
        "temperature": f"{prefix}INFO.TEMPERATURE",
    }
    dbc = (Path(__file__).parents[4] / "fixtures/sbg-ellipse/sbgCan.dbc").read_bytes()
    config = {"dbc": "sbgCan.dbc", "signals": signals, "group": "first", "tick_hz": 1_000_000}
    parser = DbcParser(DeviceSettings("imu/main", config, {"dbc": dbc}))
    frames = [
        frame
        for number in range(3)
        for frame in (
            encode_can_frame(0x120, struct.pack("<IHh", 5000 * number, 0, 2150)),
            encode_can_frame(0x121, struct.pack("<3h", 1, -2, 981)),
            encode_can_frame(0x122, struct.pack("<3h", 100, 0, -100)),
        )
    ]
    assert len(imu_rows(feed(parser, frames))) == 2, "the third may still get a second frame of a kind"
    rows = imu_rows([*feed(parser, frames[:1]), *parser.close()])
    np.testing.assert_allclose(rows["specific_force_b"], [[0.01, -0.02, 9.81]])
    np.testing.assert_allclose(rows["angular_rate_b"], [[0.1, 0.0, -0.1]])
    assert rows["temperature_c"].tolist() == [21.5]
    assert rows["device_time_ns"].tolist() == [10_000_000]


# ---------------------------------------------------------------------- samples without a stated rule


def _burst(order: str, pauses_ms: float, samples: int = 80) -> tuple[list[bytes], Int64Array]:
    """Return frames of numbered samples in an order, 0.2 ms apart with a pause after each sample, and their times.

    The first sample lacks its first frame.
    """
    frames, times, at = [], [], 0.0
    for number in range(samples):
        for kind in order[1:] if number == 0 else order:
            frames.append(_numbered(kind, number))
            times.append(round(at * 1e6))
            at += 0.2
        at += pauses_ms
    return frames, np.array(times, np.int64)


@pytest.mark.parametrize("order", ["AGT", "TAG", "ATG", "GTA"])
@pytest.mark.parametrize("drop", [(), ("sample_ticks", "pps_ticks", "temperature")], ids=["ticks", "bare"])
@pytest.mark.parametrize("batch", [1, 7, 1000])
def test_an_unspecified_group_is_derived_from_the_pauses_between_samples(
    order: str, drop: tuple[str, ...], batch: int
) -> None:
    """Force and rate belong to one sample, whichever frame is last, though the log begins within a sample."""
    order = order.replace("T", "") if drop else order
    parser = DbcParser(settings(signals=without(*drop) if drop else None, group=None))
    frames, times = _burst(order, 4.4)
    records: list[Record] = []
    for first in range(0, len(frames), batch):
        part = slice(first, first + batch)
        records += feed(parser, frames[part], times[part])
    rows = imu_rows(records + parser.close())
    assert len(rows) >= 79
    force, rate = rows["specific_force_b"][:, 0], rows["angular_rate_b"][:, 0]  # as their samples' numbers
    assert np.allclose(force * rate[-1], rate * force[-1])
    assert parser.warnings == ()


def test_evenly_spaced_frames_leave_the_group_undecided() -> None:
    parser = DbcParser(settings(group=None))
    frames, _ = _burst("TAG", 0.0)
    rows = imu_rows(feed(parser, frames) + parser.close())
    assert len(rows) > 70
    (doubt,) = parser.warnings
    assert 'set group = "last" or "first"' in doubt
    assert DbcParser(settings()).warnings == ()
