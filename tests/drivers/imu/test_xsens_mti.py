"""Tests Xsens MTi on CAN with frames packed by hand from MT1604P, in both byte orders: groups, gaps, settings."""

from __future__ import annotations

import struct
from typing import Any

import cantools.database
import numpy as np
import pytest

from swath.drivers.can_frames import encode_can_frame
from swath.drivers.driver import find_driver
from swath.drivers.imu.dbc.parser import DbcParser
from swath.drivers.imu.xsens_mti import dbc_text, make_parser
from swath.drivers.parser import DeviceSettings, DriverSettingsError
from tests.drivers.harness import check_packet_damage, check_packets
from tests.drivers.imu_dbc import feed, imu_rows

MARKS = {"big": ">", "little": "<"}


def parser_of(**config: Any) -> DbcParser:
    return make_parser(DeviceSettings("imu/main", {"tick_hz": 10_000, **config}))


def group(number: int, mark: str = ">", ticks: int | None = None) -> list[bytes]:
    """Return the frames of one sample: SampleTime first, then counter, status, rate of turn, acceleration."""
    return [
        encode_can_frame(0x005, struct.pack(f"{mark}I", (100 * number if ticks is None else ticks) & 0xFFFF_FFFF)),
        encode_can_frame(0x006, struct.pack(f"{mark}H", number & 0xFFFF)),
        encode_can_frame(0x011, struct.pack(f"{mark}I", 0x01800007)),
        encode_can_frame(0x032, struct.pack(f"{mark}3h", 512, -256, number % 100)),
        encode_can_frame(0x034, struct.pack(f"{mark}3h", -256, 128, 2511)),
    ]


def temperature(raw: int, mark: str = ">") -> bytes:
    return encode_can_frame(0x051, struct.pack(f"{mark}h", raw))


@pytest.mark.parametrize("order", ["big", "little"])
def test_values_follow_the_documented_layout(order: str) -> None:
    mark = MARKS[order]
    parser = parser_of(byte_order=order)
    frames = [temperature(0x1580, mark), *group(1, mark), *group(2, mark)]
    rows = imu_rows([*feed(parser, frames), *parser.close()])
    assert rows["angular_rate_b"].tolist() == [[1.0, -0.5, 1 / 512], [1.0, -0.5, 2 / 512]]
    assert rows["specific_force_b"].tolist() == [[-1.0, 0.5, 2511 / 256]] * 2
    assert rows["device_time_ns"].tolist() == [10_000_000, 20_000_000]
    assert rows["temperature_c"].tolist() == [21.5, 21.5]
    assert rows["status"].tolist() == [0x01800007, 0x01800007]
    assert not +parser.counters.errors


def test_the_tick_is_taken_from_the_configuration() -> None:
    parser = parser_of(tick_hz=1_000_000)
    rows = imu_rows([*feed(parser, [*group(1), *group(2)]), *parser.close()])
    assert rows["device_time_ns"].tolist() == [100_000, 200_000]


def test_byte_order_defaults_to_big_endian() -> None:
    frames = [*group(1), *group(2)]
    expected = imu_rows(feed(parser_of(byte_order="big"), frames))
    assert imu_rows(feed(parser_of(), frames)).tobytes() == expected.tobytes()


def test_the_counter_continues_through_its_wrap() -> None:
    parser = parser_of()
    frames = [*group(1, ticks=2**32 - 100), *group(2, ticks=0), *group(3, ticks=100)]
    rows = imu_rows([*feed(parser, frames), *parser.close()])
    assert np.diff(rows["device_time_ns"]).tolist() == [10_000_000, 10_000_000]


def test_missing_groups_are_counted_by_the_group_counter() -> None:
    parser = parser_of()
    numbers = [65533, 65534, 65537, 65538, 65538, 65540]  # two missing across the wrap, one repeated, one missing
    rows = imu_rows([*feed(parser, [frame for number in numbers for frame in group(number)]), *parser.close()])
    assert len(rows) == 6
    assert parser.counters.errors == {"packet_gap": 3}


def test_a_counter_that_steps_back_is_not_a_gap() -> None:
    parser = parser_of()
    feed(parser, [*group(30_000), *group(0), *group(1)])
    assert parser.counters.errors["packet_gap"] == 0


def test_samples_do_not_depend_on_batches_and_damage_never_raises() -> None:
    frames = [frame for number in range(30) if number != 7 for frame in group(number)]
    whole = check_packets(parser_of, frames)
    assert len(whole.rows["ImuSamples"]) == 29
    assert whole.counters["errors"] == {"packet_gap": 1}
    check_packet_damage(parser_of, frames)


def test_identifiers_can_be_configured() -> None:
    parser = parser_of(ids={"Acceleration": 0x18FF0034, "SampleTime": 0x18FF0005}, extended_ids=True)
    frames = [
        encode_can_frame(0x18FF0005, struct.pack(">I", 100), extended=True),
        encode_can_frame(0x032, struct.pack(">3h", 512, 0, 0), extended=True),
        *group(7),
        encode_can_frame(0x18FF0034, struct.pack(">3h", 256, 0, 0), extended=True),
    ]
    rows = imu_rows([*feed(parser, frames), *parser.close()])
    assert rows["specific_force_b"].tolist() == [[1.0, 0.0, 0.0]]


def test_the_layout_is_a_dbc_with_frames_of_the_documented_lengths() -> None:
    """MT1604P, section 6: SampleTime 4, GroupCounter 2, StatusWord 4, vectors 6, Temperature 2 bytes."""
    for order in MARKS:
        database: Any = cantools.database.load_string(dbc_text(order), database_format="dbc")
        lengths = {message.frame_id: message.length for message in database.messages}
        assert lengths == {0x005: 4, 0x006: 2, 0x011: 4, 0x032: 6, 0x034: 6, 0x051: 2}
        decoded = database.decode_message(0x032, struct.pack(f"{MARKS[order]}3h", 512, -256, 1))
        assert decoded == {"x": 1.0, "y": -0.5, "z": 1 / 512}


@pytest.mark.parametrize(
    ("config", "text"),
    [
        ({"tick_hz": None}, "tick_hz: missing; want 1000000 or 10000"),
        ({"byte_order": "middle"}, 'byte_order: got "middle", want "big" or "little"'),
        (
            {"ids": {"Gyro": 1}},
            "ids.Gyro: unknown message; there are: Acceleration, GroupCounter, RateOfTurn, SampleTime",
        ),
        ({"sample": "increment"}, 'sample: got "increment"'),
    ],
)
def test_wrong_settings_are_refused_in_one_line_that_names_them(config: dict[str, Any], text: str) -> None:
    with pytest.raises(DriverSettingsError, match=text):
        parser_of(**config)


def test_the_driver_requires_the_tick() -> None:
    assert find_driver("imu", "xsens-mti").needs == ("tick_hz",)
