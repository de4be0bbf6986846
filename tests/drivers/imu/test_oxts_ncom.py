"""Tests OxTS NCOM with a packet written by hand and packets of the encoder, because no recording was available."""

from __future__ import annotations

import gzip
import struct
from math import degrees, nan, radians
from typing import Any

import numpy as np
import pytest

from swath.drivers.driver import find_driver
from swath.drivers.imu import oxts_ncom as ncom
from swath.drivers.imu.oxts_ncom import NcomParser, encode_packet, make_time_parser
from swath.drivers.parser import DeviceSettings
from swath.georef.records import (
    Chunk,
    DeviceStatus,
    EventMark,
    ImuSamples,
    InsSolution,
    Record,
    TimeMessage,
)
from tests.drivers.harness import check_damage, check_garbage, check_stream
from tests.drivers.recordings import FIXTURES

WEEK = 2443
MINUTE = WEEK * 10_080 + 5_050  # 303 000 s of the week
TOW_NS = 303_000 * 10**9
UNDULATION = (48, struct.pack("<h6x", round(47.5 / 0.005)))


def modes(minute: int = MINUTE, position: int = 6) -> tuple[int, bytes]:
    return 0, struct.pack("<i4B", minute, 12, position, 6, 0x80)


def packet(millisecond: int, channel: tuple[int, bytes] = (255, bytes(8)), status: int = 4, **more: Any) -> bytes:
    values: dict[str, Any] = {
        "force": (0.5, -0.25, -9.75),
        "rate": (0.01, -0.02, 0.03),
        "position": (radians(47.5), radians(8.75), 500.0),
        "velocity": (50.0, 1.0, -2.0),
        "angles": (-1.5, 0.02, 0.01),
    }
    return encode_packet(status, millisecond, channel=channel[0], content=channel[1], **values | more)


def trigger(count: int, millisecond: int = 1500, fine: int = -25, minute: int = MINUTE) -> bytes:
    return struct.pack("<iHbB", minute, millisecond, fine, count)


def flight() -> bytes:
    """Return two seconds at 100 Hz across the end of a minute, which are the fixture that the fuzzer mutates."""
    channels = [
        *(
            modes(),
            UNDULATION,
            (3, struct.pack("<3HBB", 20, 30, 40, 0, 0xFF)),
            (4, struct.pack("<3HBB", 10, 20, 30, 0, 0)),
        ),
        *((5, struct.pack("<3HBB", 300, 200, 100, 0, 0)), (16, bytes(7) + bytes([(-18 << 1 | 1) & 0xFF]))),
        *((24, trigger(3)), (43, trigger(9)), (1, bytes(8)), (20, b"\x0a\0ABCD\0\0")),
    ]
    packets = []
    for cycle in range(200):
        minute, millisecond = divmod(59_000 + 10 * cycle, 60_000)
        channel = modes(MINUTE + minute) if cycle % 10 == 0 else channels[cycle % 10]
        packets.append(packet(millisecond, channel, rate=(0.0001 * cycle, 0.0, 0.0)))
        if cycle == 120:
            packets.append(packet(0, (24, trigger(4, 180, 5, MINUTE + 1)), status=22))
    packets += [packet(0, status=1), packet(0, modes(), status=10), packet(0, status=11), packet(990, status=2)]
    return b"".join(packets)


def make(**config: Any) -> NcomParser:
    return NcomParser(DeviceSettings("imu/main", config))


def parse(*data: bytes, **config: Any) -> tuple[list[Record], NcomParser]:
    parser = make(**config)
    return [*parser.feed(Chunk("imu/main", 7, b"".join(data))), *parser.close()], parser


def of(records: list[Record], kind: Any) -> list[Any]:
    return [record for record in records if isinstance(record, kind)]


def rows_of(records: list[Record], kind: Any) -> Any:
    found = [record.rows for record in of(records, kind)]
    return np.concatenate(found) if found else np.empty(0)


def test_a_packet_written_by_hand() -> None:
    """Offsets and units are those of NComRxC.h: time 1234 ms, force, rate, status 4, position, velocity, angles."""
    batch_a = bytes.fromhex("D204 881300 3CF6FF 2483FE E80300 30F8FF B80B00 04")
    batch_b = struct.pack("<2df", 0.829031394, 0.152716309, 500.0)
    batch_b += bytes.fromhex("20A107 102700 E0B1FF A01CE9 204E00 102700")
    body = batch_a + bytes([sum(batch_a) & 0xFF]) + batch_b
    body += bytes([sum(body) & 0xFF]) + bytes.fromhex("00 225A7701 0C 06 06 80")
    by_hand = b"\xe7" + body + bytes([sum(body) & 0xFF])
    assert len(by_hand) == 72
    assert ncom.intact(by_hand)
    position = (0.829031394, 0.152716309, 500.0)
    assert by_hand == packet(1234, (0, struct.pack("<i4B", 0x01775A22, 12, 6, 6, 0x80)), position=position)
    assert ncom.numbers_at(by_hand, ncom.FORCE_AT, ncom.FORCE_SCALE) == pytest.approx((0.5, -0.25, -9.75))
    assert ncom.numbers_at(by_hand, ncom.ANGLES_AT, ncom.ANGLE_SCALE) == pytest.approx((-1.5, 0.02, 0.01))


def test_all_three_checksums_guard_a_public_packet() -> None:
    good = packet(0)
    for at in (5, 30, 65):
        broken = bytearray(good)
        broken[at] ^= 1
        assert not ncom.intact(bytes(broken))
        broken[71] = sum(broken[1:71]) & 0xFF
        assert ncom.intact(bytes(broken)) == (at == 65)
    assert ncom.intact(packet(0, status=11))
    assert not ncom.intact(packet(0, status=12))


def test_the_made_stream_however_cut_and_damaged() -> None:
    data = gzip.decompress((FIXTURES / "oxts-ncom/made.bin.gz").read_bytes())
    assert data == flight()
    check_damage(make, data, examples=15, window=3000, starts=[b"\xe7", b"\xe7" * 3])
    check_garbage(make, examples=15, starts=[b"\xe7"])
    records, parser = parse(data)
    assert parser.counters.messages == {"regular": 202, "trigger": 1, "empty": 1, "internal": 1}
    assert parser.counters.bytes_skipped == 0
    assert parser.counters.errors == {"undulation_unknown": 1, "ins_no_solution": 2}
    rows = rows_of(records, ImuSamples)
    assert (rows["gps_week"] >= 0).sum() == 201
    steps = np.diff(rows["device_time_ns"][:200])
    assert set(steps) == {10_000_000}
    assert [time.time.time_ns - TOW_NS for time in of(records, TimeMessage)] == [59 * 10**9, 60 * 10**9]


def test_the_makers_decoder_reads_the_same_values_in_the_made_stream() -> None:
    """The values are NComRxC's, from fixtures/oxts-ncom/SOURCE.md."""
    records, _ = parse(flight())
    samples, solutions = rows_of(records, ImuSamples), rows_of(records, InsSolution)
    for number, time_s, rate in ((59, 1477829459.59, 0.3380451), (198, 1477829460.98, 1.1344564)):
        sample = samples[number]
        assert sample["gps_week"] * 604_800 + sample["device_time_ns"] * 1e-9 == pytest.approx(time_s, abs=1e-6)
        assert degrees(sample["angular_rate_b"][0]) == pytest.approx(rate, abs=1e-7)
        [row] = solutions[solutions["gps_ns"] == round(time_s * 100) * 10**7]
        angles = degrees(row["heading_rad"]) % 360, degrees(row["pitch_rad"]), degrees(row["roll_rad"])
        assert angles == pytest.approx((274.05633073, 1.14591559, 0.57295780), abs=1e-7)
        assert row["height_m"] == 500 + 47.5
        sigmas = row["position_sigma_l"][0], row["velocity_sigma_l"][2], degrees(row["attitude_sigma_rad"][2])
        assert sigmas == pytest.approx((0.02, 0.03, 0.1718873), rel=1e-6)
    assert 1477829460.180020 in [
        pytest.approx(mark.time.week * 604_800 + mark.time.time_ns * 1e-9, abs=1e-6) for mark in of(records, EventMark)
    ]
    assert {time.time.leap_seconds for time in of(records, TimeMessage)} <= {None, 18}


@pytest.mark.slow
def test_the_made_stream_cut_everywhere() -> None:
    check_stream(make, flight()[:6000])


def test_solutions_and_samples() -> None:
    sigmas = [
        *((3, struct.pack("<3HBB", 20, 30, 40, 0, 0xFF)), (4, struct.pack("<3HBB", 10, 20, 30, 149, 0))),
        (5, struct.pack("<3HBB", 300, 200, 100, 0, 0)),
    ]
    records, parser = parse(
        packet(0), packet(10, modes()), packet(20, UNDULATION), *(packet(30, one) for one in sigmas)
    )
    rows = rows_of(records, InsSolution)
    assert (rows["gps_ns"] - WEEK * 604_800 * 10**9 - TOW_NS).tolist() == [20_000_000] + [30_000_000] * 3
    row = rows[-1]
    assert (degrees(row["lat_rad"]), degrees(row["lon_rad"]), row["height_m"]) == pytest.approx((47.5, 8.75, 547.5))
    np.testing.assert_allclose(row["velocity_l"], [50, 1, -2])
    assert (row["roll_rad"], row["pitch_rad"], row["heading_rad"]) == pytest.approx((0.01, 0.02, -1.5))
    np.testing.assert_allclose(row["position_sigma_l"], [0.02, 0.03, 0.04], rtol=1e-6)
    np.testing.assert_allclose(row["velocity_sigma_l"], [0.01, 0.02, 0.03], rtol=1e-6)
    np.testing.assert_allclose(row["attitude_sigma_rad"], [0.001, 0.002, 0.003], rtol=1e-6)
    assert np.isnan(rows["position_sigma_l"][0]).all()
    assert parser.counters.errors == {"time_unknown": 1, "undulation_unknown": 1}
    samples = rows_of(records, ImuSamples)
    assert samples["gps_week"].tolist() == [-1] + [WEEK] * 5
    assert samples["device_time_ns"][:2].tolist() == [-1, TOW_NS + 10_000_000]
    np.testing.assert_allclose(samples["specific_force_b"][0], [0.5, -0.25, -9.75])
    np.testing.assert_allclose(samples["angular_rate_b"][0], [0.01, -0.02, 0.03])
    old = parse(packet(0, modes()), packet(0, UNDULATION), packet(0, (3, struct.pack("<3HBB", 1, 1, 1, 150, 0))))[0]
    assert np.isnan(rows_of(old, InsSolution)["position_sigma_l"]).all()


def test_an_altitude_above_the_ellipsoid_needs_no_undulation() -> None:
    [row] = rows_of(parse(packet(0, modes()), altitude="ellipsoid")[0], InsSolution)
    assert row["height_m"] == 500.0
    unset = (48, struct.pack("<h6x", -32768))
    _, parser = parse(packet(0, modes()), packet(0, UNDULATION), packet(0, unset))
    assert parser.counters.errors == {"undulation_unknown": 2}


def test_the_minute_is_counted_on_and_unknown_after_a_jump_or_a_pause() -> None:
    rows = rows_of(parse(packet(59_990, modes()), packet(0), packet(10))[0], ImuSamples)
    assert (rows["device_time_ns"] - TOW_NS).tolist() == [59_990_000_000, 60_000_000_000, 60_010_000_000]
    records, parser = parse(packet(50_000, modes()), packet(40_000), packet(40_010, modes()), packet(60_001))
    assert rows_of(records, ImuSamples)["gps_week"].tolist() == [WEEK, -1, WEEK, -1]
    assert parser.counters.errors["time_jump"] == 2
    parser = make()
    for host_ns, data in ((0, packet(0, modes())), (31 * 10**9, packet(10))):
        records = parser.feed(Chunk("imu/main", host_ns, data))
    assert rows_of(records, ImuSamples)["gps_week"].tolist() == [-1]
    assert parser.counters.errors["time_jump"] == 1


def test_the_second_is_named_with_the_leap_seconds_of_its_channel() -> None:
    offset = (16, bytes(7) + bytes([(-18 << 1 | 1) & 0xFF]))
    data = packet(990, modes()), packet(1000, offset), packet(1010)
    [time] = of(parse(*data)[0], TimeMessage)
    assert (time.time.time_ns, time.time.week, time.time.leap_seconds) == (TOW_NS + 10**9, WEEK, 18)
    assert make_time_parser(DeviceSettings("imu/main")).feed(Chunk("imu/main", 7, b"".join(data))) == [time]
    [time] = of(parse(packet(0, modes()))[0], TimeMessage)
    assert time.time.leap_seconds is None


def test_events_are_marks_when_their_count_changes() -> None:
    records, parser = parse(
        *(packet(0, (24, trigger(3))), packet(0, (24, trigger(4))), packet(10, (24, trigger(4)))),
        *(packet(0, (43, trigger(0)), status=22), packet(0, (65, trigger(7, minute=-1)), status=21)),
    )
    marks = of(records, EventMark)
    assert [(mark.channel, mark.rising, mark.count) for mark in marks] == [("In1", False, 4), ("In1", True, 0)]
    assert {mark.time.time_ns for mark in marks} == {TOW_NS + 1_499_900_000}
    assert parser.counters.errors["time_unknown"] == 1 + 3  # the last event, and solutions before any minute
    assert len(rows_of(records, ImuSamples)) == 3


def test_state_is_given_when_a_mode_changes() -> None:
    states = of(parse(packet(0, modes()), packet(10, modes()), packet(20, modes(position=5)))[0], DeviceStatus)
    assert [state.values["position_mode"] for state in states] == [6, 5]
    assert "attitude_mode" not in states[0].values


def test_missing_and_wrong_numbers_are_counted() -> None:
    raw = packet(0, status=1)
    lost = packet(0, modes(), rate=(nan, 0, 0)), packet(0, angles=(nan, 0, 0)), packet(0, position=(nan, 0, 0))
    old = packet(0, modes(minute=1000 * 10_080))
    records, parser = parse(raw, *lost, old, altitude="ellipsoid")
    assert parser.counters.errors == {
        **{"ins_no_solution": 1, "sample_incomplete": 1, "bad_value": 2, "date_before_floor": 1, "time_unknown": 1}
    }
    assert len(rows_of(records, ImuSamples)) == 4
    with pytest.raises(ValueError, match="8 bytes"):
        encode_packet(4, 0, content=b"")


def test_the_driver_is_registered() -> None:
    assert find_driver("imu", "oxts-ncom").make_time_parser is make_time_parser
