"""Tests Ouster's metadata: both forms of real files, and every refusal in one line."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from swath.drivers.parser import DeviceSettings, DriverSettingsError
from swath.drivers.scanner.ouster.head import read_head
from swath.drivers.scanner.ouster.parser import OusterParser
from tests.drivers.ouster_cases import SERIAL, metadata, metadata_of, parser_of


def test_flat_metadata_of_older_firmware_is_read() -> None:
    head = read_head(metadata_of("OS-1-32-G_v2.1.1_1024x10"))
    assert (head.model, head.serial, head.init_id) == ("OS-1-32-G", 992_101_000_280, None)
    assert (head.profile, head.header, head.imu_profile) == ("LEGACY", "legacy", "LEGACY")
    assert (head.beams, head.columns_per_frame, head.column_window) == (32, 1024, (0, 1023))
    assert (head.timestamp_mode, head.return_order) == ("", "STRONGEST_TO_WEAKEST")
    np.testing.assert_allclose(np.degrees(head.altitude_rad[[0, 31]]), [12.75, -15.32])
    np.testing.assert_allclose(np.degrees(head.azimuth_rad[[0, 5]]), [-4.22, 1.44])
    assert head.beam_origin_m == (0.015806, 0.0)
    np.testing.assert_allclose(head.sensor_from_lidar[:3, 3], [0, 0, 0.03618])
    assert head.pixel_shift[:6].tolist() == [0, 0, 0, 0, 8, 16]


def test_sectioned_metadata_of_newer_firmware_is_read() -> None:
    head = read_head(metadata_of("windowed_frame1"))
    assert (head.model, head.serial, head.init_id) == ("OS-0-128", 992_108_000_265, 7_109_746)
    assert (head.profile, head.header) == ("RNG15_RFL8_NIR8", "standard")
    assert (head.beams, head.columns_per_frame, head.column_window) == (128, 512, (1, 256))
    assert (head.timestamp_mode, head.nmea_input) == ("TIME_FROM_PTP_1588", False)
    np.testing.assert_allclose(head.beam_origin_m, (0.02767, 0.0))
    newest = read_head(metadata_of("imu_zm_no_lidar"))
    assert (newest.imu_profile, newest.imu_samples) == ("ACCEL32_GYRO32_NMEA", 8)
    assert newest.profile == "RNG19_RFL8_SIG16_NIR16_ZONE16"


def changed(path: str, value: Any) -> bytes:
    """Return the metadata with one value changed, or removed if it is None."""
    table = json.loads(metadata())
    *sections, key = path.split("/")
    inner = table
    for section in sections:
        inner = inner[section]
    if value is None:
        del inner[key]
    else:
        inner[key] = value
    return json.dumps(table).encode()


@pytest.mark.parametrize(
    ("path", "value", "line"),
    [
        (
            "lidar_data_format",
            None,
            "data_format: got nothing, want the head's lidar_data_format, firmware 2.0 or later",
        ),
        (
            "lidar_data_format/pixels_per_column",
            16.5,
            "data_format.pixels_per_column: got 16.5, want a whole number 1 to 256",
        ),
        (
            "lidar_data_format/pixels_per_column",
            32,
            "beam_altitude_angles: got a list of 16, want 32 numbers within ±90",
        ),
        (
            "lidar_data_format/columns_per_frame",
            1000,
            "data_format.columns_per_frame: got 1000, want 512, 1024, 2048 or 4096…",
        ),
        (
            "lidar_data_format/column_window",
            [0, 1024],
            "data_format.column_window: got a list of 2, want 2 numbers within ±1023",
        ),
        (
            "lidar_data_format/column_window",
            [-1, 5],
            "data_format.column_window: got a list of 2, want measurement ids 0 to 1023",
        ),
        (
            "lidar_data_format/udp_profile_lidar",
            "RNG9",
            "udp_profile_lidar: 'RNG9' is not known; there are: LEGACY, RNG19_…",
        ),
        ("lidar_data_format/header_type", "ODD", 'data_format.header_type: got "ODD", want STANDARD or FUSA'),
        (
            "beam_intrinsics/beam_azimuth_angles",
            [361.0] * 16,
            "beam_azimuth_angles: got a list of 16, want 16 numbers within ±360",
        ),
        (
            "beam_intrinsics/beam_altitude_angles",
            [True] * 16,
            "beam_altitude_angles: got a list of 16, want 16 numbers within ±90",
        ),
        (
            "beam_intrinsics/beam_altitude_angles",
            [0, 0.0] * 8,
            "beam_altitude_angles: got a list of 16, want the head's own angles; 0 for all beams is not a calibration",
        ),
        (
            "beam_intrinsics/beam_to_lidar_transform",
            None,
            "lidar_origin_to_beam_origin_mm: got nothing, want a number within ±1000",
        ),
        (
            "lidar_intrinsics/lidar_to_sensor_transform",
            [1] * 16,
            "lidar_to_sensor_transform: got a list of 16, want a rotation…",
        ),
        ("lidar_intrinsics", None, "lidar_to_sensor_transform: got nothing, want 16 numbers within ±10000"),
        (
            "config_params/timestamp_mode",
            "TIME_FROM_SUN",
            'config_params.timestamp_mode: got "TIME_FROM_SUN", want TIME_FROM_…',
        ),
        ("config_params/return_order", "ANY", 'config_params.return_order: got "ANY", want STRONGEST_TO_WEAKEST, …'),
        (
            "config_params/lidar_frame_azimuth_offset",
            90_000,
            "config_params.lidar_frame_azimuth_offset: got 90000, want 0: turn…",
        ),
        ("config_params", [1], "config_params: got a list of 1, want a table"),
    ],
)
def test_impossible_metadata_is_refused_in_one_line(path: str, value: Any, line: str) -> None:
    with pytest.raises(DriverSettingsError) as caught:
        parser_of(changed(path, value))
    said = str(caught.value)
    assert said.startswith(f"geometry.file: {line.removesuffix('…')}")
    assert line.endswith("…") or said == f"geometry.file: {line}"
    assert "\n" not in said


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"", "not JSON"),
        (b"\xff\xfe{}", "not JSON"),
        (b"[1]", "not a JSON object"),
        (b'{"data_format": NaN}', "data_format: got NaN, want the head's"),
        (b'{"a":' * 100_000, "nested too deeply"),
        (b"[[1]" * 50, "not JSON"),
        (b'{"data_format": ' + b"9" * 5000 + b"}", "not JSON"),
    ],
)
def test_a_file_that_is_not_metadata_is_refused(content: bytes, reason: str) -> None:
    with pytest.raises(DriverSettingsError, match=reason) as caught:
        parser_of(content)
    assert "\n" not in str(caught.value)


def test_a_parser_needs_metadata() -> None:
    with pytest.raises(DriverSettingsError, match=r"geometry\.file: missing; want the head's metadata"):
        OusterParser(DeviceSettings("scanner/left"))


def test_metadata_of_another_head_is_refused() -> None:
    assert parser_of(metadata(), serial="").head.serial == SERIAL
    assert parser_of(metadata(), serial=str(SERIAL)).head.serial == SERIAL
    with pytest.raises(DriverSettingsError, match=f"is of head {SERIAL}, but serial is 99; use the metadata"):
        parser_of(metadata(), serial="99")


def refusal(content: bytes) -> str | None:
    try:
        parser_of(content)
    except DriverSettingsError as error:
        return str(error)
    return None


_values = st.recursive(
    st.one_of(st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=5)),
    lambda inner: st.one_of(st.lists(inner, max_size=4), st.dictionaries(st.text(max_size=3), inner, max_size=3)),
    max_leaves=6,
)


@given(data=st.data())
@settings(max_examples=300, deadline=None)
def test_altered_metadata_is_read_or_refused(data: st.DataObject) -> None:
    table = json.loads(metadata())
    table |= table.pop("beam_intrinsics") | {"data_format": table.pop("lidar_data_format")}
    section = data.draw(st.sampled_from([table, table["data_format"], table["config_params"], table["sensor_info"]]))
    section[data.draw(st.sampled_from(sorted(section)))] = data.draw(_values)
    said = refusal(json.dumps(table).encode())
    assert said is None or (said.startswith("geometry.file: ") and "\n" not in said)
