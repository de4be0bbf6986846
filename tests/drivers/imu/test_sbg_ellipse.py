"""Tests SBG Ellipse on CAN with frames made by cantools and the maker's DBC: identifiers, Sync In, settings."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cantools.database
import numpy as np
import pytest

from swath.drivers.can_frames import encode_can_frame
from swath.drivers.driver import find_driver
from swath.drivers.imu.dbc.parser import DbcParser
from swath.drivers.imu.sbg_ellipse import DBC_PATH, make_clock_parser, make_parser
from swath.drivers.parser import DeviceSettings, DriverSettingsError
from swath.georef.records import DeviceClockSamples
from tests.drivers.harness import check_packet_damage, check_packets
from tests.drivers.imu_dbc import clock_rows, feed, imu_rows

MAKERS_DBC = Path(__file__).parents[3] / "fixtures/sbg-ellipse/sbgCan.dbc"
MAKERS: Any = cantools.database.load_file(MAKERS_DBC, encoding="cp1252", strict=False)
STEP_US = 5000


def parser_of(**config: Any) -> DbcParser:
    return make_parser(DeviceSettings("imu/main", config))


def frame(name: str, values: dict[str, float], identifier: int | None = None, *, extended: bool = False) -> bytes:
    """Return a message of the maker's DBC, encoded by cantools."""
    message = MAKERS.get_message_by_name(f"SBG_ECAN_MSG_{name}")
    number = message.frame_id if identifier is None else identifier
    return encode_can_frame(number, message.encode(values, strict=False), extended=extended)


def cycles(count: int, first_us: int = 0) -> tuple[list[bytes], np.ndarray[Any, np.dtype[np.float64]]]:
    """Return frames of IMU cycles, and (n, 8) values before encoding: counter (µs), six rates, temperature."""
    rng = np.random.default_rng(11)
    values = np.empty((count, 8))
    values[:, 0] = first_us + STEP_US * np.arange(count)
    values[:, 1:4] = rng.integers(-32768, 32768, (count, 3)) * 0.01
    values[:, 4:7] = rng.integers(-32768, 32768, (count, 3)) * 0.001
    values[:, 7] = rng.integers(-4000, 8500, count) * 0.01
    frames = []
    for row in values.tolist():
        info = {"TIME_STAMP": int(row[0]) % 2**32, "STATUS": 0x3FF, "TEMPERATURE": row[7]}
        frames += [
            frame("IMU_INFO", info),
            frame("IMU_ACCEL", dict(zip(("ACCEL_X", "ACCEL_Y", "ACCEL_Z"), row[1:4], strict=True))),
            frame("IMU_GYRO", dict(zip(("GYRO_X", "GYRO_Y", "GYRO_Z"), row[4:7], strict=True))),
        ]
    return frames, values


def test_the_bundled_dbc_equals_the_manufacturers_file() -> None:
    ours: Any = cantools.database.load_file(DBC_PATH, encoding="utf-8", strict=False)
    theirs = {message.name: message for message in MAKERS.messages}
    assert {message.name for message in ours.messages} == set(theirs)
    for message in ours.messages:
        other = theirs[message.name]
        assert (message.frame_id, message.length, message.signal_tree) == (
            other.frame_id,
            other.length,
            other.signal_tree,
        )
        for one, two in zip(message.signals, other.signals, strict=True):
            layout = (one.name, one.start, one.length, one.byte_order, one.is_signed, one.scale, one.offset, one.unit)
            assert layout == (
                two.name,
                two.start,
                two.length,
                two.byte_order,
                two.is_signed,
                two.scale,
                two.offset,
                two.unit,
            )


def test_samples_match_frames_encoded_by_cantools_with_the_manufacturers_dbc() -> None:
    first_us = 2**32 - 100 * STEP_US
    frames, values = cycles(300, first_us)
    parser = parser_of()
    host_ns = np.repeat(np.arange(300, dtype=np.int64) * STEP_US * 1000, 3)
    rows = imu_rows([*feed(parser, frames, host_ns), *parser.close()])
    assert len(rows) == 300
    np.testing.assert_allclose(rows["specific_force_b"], values[:, 1:4], rtol=0, atol=1e-12)
    np.testing.assert_allclose(rows["angular_rate_b"], values[:, 4:7], rtol=0, atol=1e-12)
    np.testing.assert_array_equal(rows["temperature_c"], values[:, 7].astype(np.float32))
    assert (rows["device_time_ns"] == (values[:, 0] * 1000).astype(np.int64)).all(), "through the counter's wrap"
    assert set(rows["status"].tolist()) == {0x3FF}
    assert set(rows["pps_time_ns"].tolist()) == {-1}
    assert parser.counters.messages["SBG_ECAN_MSG_IMU_INFO"] == 300
    assert not +parser.counters.errors


def test_samples_do_not_depend_on_batches_and_damage_never_raises() -> None:
    frames, _ = cycles(40)
    whole = check_packets(parser_of, frames)
    assert len(whole.rows["ImuSamples"]) == 40
    check_packet_damage(parser_of, frames)


def test_a_lost_frame_drops_only_its_sample() -> None:
    frames, values = cycles(10)
    parser = parser_of()
    rows = imu_rows([*feed(parser, frames[:10] + frames[11:]), *parser.close()])  # the ACCEL of the fourth
    assert rows["device_time_ns"].tolist() == [int(us) * 1000 for i, us in enumerate(values[:, 0]) if i != 3]
    assert parser.counters.errors == {"sample_incomplete": 1}


@pytest.mark.parametrize("extended", [False, True])
def test_identifiers_can_be_configured(extended: bool) -> None:
    ids = {"IMU_INFO": 0x320, "IMU_ACCEL": 0x10, "IMU_GYRO": 0x7FF}
    parser = parser_of(ids=ids, extended_ids=extended)
    info = {"TIME_STAMP": 1000, "STATUS": 0, "TEMPERATURE": 20.0}
    acceleration = {"ACCEL_X": 1.0, "ACCEL_Y": -2.0, "ACCEL_Z": 9.81}
    rate = {"GYRO_X": 0.1, "GYRO_Y": 0.2, "GYRO_Z": -0.3}
    others, _ = cycles(2)
    frames = [
        frame("IMU_INFO", info, ids["IMU_INFO"], extended=extended),
        others[0],
        frame("IMU_ACCEL", acceleration, ids["IMU_ACCEL"], extended=extended),
        frame("IMU_ACCEL", {**acceleration, "ACCEL_X": 5.0}, ids["IMU_ACCEL"], extended=not extended),
        frame("IMU_GYRO", rate, ids["IMU_GYRO"], extended=extended),
        *others,
    ]
    rows = imu_rows([*feed(parser, frames), *parser.close()])
    np.testing.assert_allclose(rows["specific_force_b"], [[1.0, -2.0, 9.81]])
    np.testing.assert_allclose(rows["angular_rate_b"], [[0.1, 0.2, -0.3]])
    assert not +parser.counters.errors


def test_the_deprecated_messages_decode_like_the_current_ones() -> None:
    """By canProtocol.md IMU_DELTA_VEL and IMU_DELTA_ANGLE are the same as IMU_ACCEL and IMU_GYRO."""
    parser = parser_of(ids={"IMU_ACCEL": 0x123, "IMU_GYRO": 0x124})
    frames = [
        frame("IMU_INFO", {"TIME_STAMP": 0, "STATUS": 0, "TEMPERATURE": 0.0}),
        frame("IMU_DELTA_VEL", {"DELTA_VEL_X": 1.0, "DELTA_VEL_Y": 2.0, "DELTA_VEL_Z": 3.0}),
        frame("IMU_DELTA_ANGLE", {"DELTA_ANGLE_X": 0.1, "DELTA_ANGLE_Y": 0.2, "DELTA_ANGLE_Z": 0.3}),
    ]
    rows = imu_rows([*feed(parser, frames), *parser.close()])
    np.testing.assert_allclose(rows["specific_force_b"], [[1.0, 2.0, 3.0]])
    np.testing.assert_allclose(rows["angular_rate_b"], [[0.1, 0.2, 0.3]])


@pytest.mark.parametrize("event", "ABCDE")
def test_a_pps_on_sync_in_latches_the_counter(event: str) -> None:
    """The frame has 6 bytes in the document and 8 in the DBC, and both have the time stamp."""
    frames, _ = cycles(4)
    stamp = {"TIME_STAMP": 7500.0, "STATUS": 0.0}
    long = frame(f"EVENT_INFO_{event}", stamp)
    short = encode_can_frame(0x200 + 2 * "ABCDE".index(event), long[8:14])
    for pulse in (short, long):
        settings = DeviceSettings("imu/main", {"pps_event": event})
        parser = make_clock_parser(settings)
        records = [*feed(parser, [*frames[:6], pulse, *frames[6:]]), *parser.close()]
        assert {type(record) for record in records} == {DeviceClockSamples}
        rows = clock_rows(records)
        assert rows["device_time_ns"].tolist() == [0, 5_000_000, 10_000_000, 15_000_000]
        assert rows["pps_time_ns"].tolist()[2:] == [7_500_000, 7_500_000]
        assert rows["pps_time_ns"][0] == -1


@pytest.mark.parametrize(
    ("config", "text"),
    [
        ({"ids": {"GYRO": 1}}, "ids.GYRO: unknown message; there are: IMU_ACCEL, IMU_GYRO, IMU_INFO"),
        ({"ids": {"IMU_GYRO": 0x120}}, "ids: IMU_GYRO and IMU_INFO are both 0x120; give each its own"),
        ({"ids": {"IMU_GYRO": 0x800}}, "0x800 does not fit 11 bits; want 0 to 0x7FF; 29 bits need extended_ids = true"),
        ({"ids": {"IMU_GYRO": -1}}, "does not fit 11 bits"),
        ({"ids": {"IMU_GYRO": 1 << 29}, "extended_ids": True}, "does not fit 29 bits; want 0 to 0x1FFFFFFF$"),
        ({"sample": "increment"}, 'sample: got "increment"'),
        ({"pps_event": "F"}, "no message SBG_ECAN_MSG_EVENT_INFO_F in sbg-ellipse.dbc"),
    ],
)
def test_wrong_settings_are_refused_in_one_line_that_names_them(config: dict[str, Any], text: str) -> None:
    with pytest.raises(DriverSettingsError, match=text) as caught:
        parser_of(**config)
    assert "\n" not in str(caught.value)


def test_the_driver_is_registered() -> None:
    driver = find_driver("imu", "sbg-ellipse")
    assert driver.transports == ("can",)
    assert driver.make_time_parser is make_clock_parser
