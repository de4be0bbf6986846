"""Ouster heads: the head's description from its metadata, and the maker's formula for x, y, z.

The metadata is the JSON of the head's HTTP interface (``GET /api/v1/sensor/metadata``) or of Ouster's own recordings:
flat up to firmware 2.x, in sections from then on. Nothing is guessed: metadata that lacks a needed value is refused.
Source: Ouster Firmware User Manual, "Sensor Data" and "API reference, Get lidar data format"; github.com/ouster-lidar/
ouster-sdk @ 46b7bce for the names of the keys.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from swath.drivers.parser import DriverSettingsError
from swath.georef.arrays import FloatArray, Int64Array, StructArray

FILE = "geometry.file"
LARGEST_PACKET_BYTES = 65_507  # payload of a UDP datagram
COLUMNS_PER_FRAME = (512, 1024, 2048, 4096)
HEADERS = {"STANDARD": "standard", "FUSA": "fusa"}
FUSA_PROFILE = "FUSA_RNG15_RFL8_NIR8_DUAL"
SYNC_PULSE = "TIME_FROM_SYNC_PULSE_IN"
TIMESTAMP_MODES = ("TIME_FROM_INTERNAL_OSC", SYNC_PULSE, "TIME_FROM_PTP_1588")
RETURN_ORDERS = ("STRONGEST_TO_WEAKEST", "FARTHEST_TO_NEAREST", "NEAREST_TO_FARTHEST")
ROTATION_TOLERANCE = 1e-4  # for matrices printed with few digits
_SECTIONS = ("sensor_info", "beam_intrinsics", "lidar_intrinsics", "imu_intrinsics")


@dataclass(frozen=True, eq=False)
class OusterHead:
    """One head in one configuration.

    Attributes:
        model: product line, such as ``OS-1-128``.
        serial: serial number; None where the metadata has none.
        firmware: firmware version as text of the head.
        init_id: number of the start in which the metadata was read; None: not in the metadata.
        profile: profile of the lidar packets, such as ``RNG19_RFL8_SIG16_NIR16``.
        header: ``legacy``, ``standard`` or ``fusa``.
        beams: rows of a column.
        columns_per_packet, columns_per_frame: number of columns in a packet and in a frame.
        column_window: first and last measurement id sent; the first is the greater where 0 lies between.
        imu_profile: ``LEGACY``, ``ACCEL32_GYRO32_NMEA`` or ``OFF``.
        imu_samples: samples of a packet in profile ACCEL32_GYRO32_NMEA.
        timestamp_mode: one of `TIMESTAMP_MODES`; empty where the metadata lacks it.
        nmea_input: whether the head receives NMEA on its multipurpose pin.
        return_order: one of `RETURN_ORDERS`; firmware before 3.1 has the first only.
        altitude_rad, azimuth_rad: (beams,) angles of each row.
        pixel_shift: (beams,) columns by which a row of the staggered image is to be shifted.
        beam_origin_m: (x, z) of the beam origin in the frame that turns with the encoder.
        sensor_from_lidar: (4, 4) homogeneous, metres.
        rot_sensor_from_imu: (3, 3).
    """

    model: str
    serial: int | None
    firmware: str
    init_id: int | None
    profile: str
    header: str
    beams: int
    columns_per_packet: int
    columns_per_frame: int
    column_window: tuple[int, int]
    imu_profile: str
    imu_samples: int
    timestamp_mode: str
    nmea_input: bool
    return_order: str
    altitude_rad: FloatArray
    azimuth_rad: FloatArray
    pixel_shift: Int64Array
    beam_origin_m: tuple[float, float]
    sensor_from_lidar: FloatArray
    rot_sensor_from_imu: FloatArray

    def __deepcopy__(self, memo: dict[int, object]) -> OusterHead:
        """Return the same object: a head never changes, so a parser's copy shares it."""
        return self


def beam_points(rows: StructArray, head: OusterHead) -> FloatArray:
    """Return the points of returns in the maker's sensor frame (Sensor Data, "Lidar Range to XYZ" and "Sensor
    Coordinate Frame").

    The range counts from the encoder's axis along the path of the light, via the beam's origin at distance n from the
    axis. The beam from the origin is therefore range − n long.

    Args:
        rows: (n,) `RETURN_DTYPE`; ``encoder_rad`` is the encoder's angle, without the beam's own azimuth.
        head: the head that sent these rows.

    Returns:
        (n, 3) metres, s frame of CONVENTIONS' multi-beam scanners.
    """
    channel = rows["channel"]
    encoder, altitude = rows["encoder_rad"], head.altitude_rad[channel]
    direction = encoder - head.azimuth_rad[channel]
    origin_x, origin_z = head.beam_origin_m
    beam = rows["range_m"] - math.hypot(origin_x, origin_z)
    flat = beam * np.cos(altitude)
    lidar = np.stack(
        [
            flat * np.cos(direction) + origin_x * np.cos(encoder),
            flat * np.sin(direction) + origin_x * np.sin(encoder),
            beam * np.sin(altitude) + origin_z,
        ],
        axis=1,
    )
    points: FloatArray = lidar @ head.sensor_from_lidar[:3, :3].T + head.sensor_from_lidar[:3, 3]
    return points


def read_head(content: bytes) -> OusterHead:
    """Read a head's metadata.

    Raises:
        DriverSettingsError: the metadata is invalid or incomplete; the text names the key and a valid value.
    """
    table = _merged(_json_object(content))
    layout = _Keys(
        table.plain("data_format", dict, "the head's lidar_data_format, firmware 2.0 or later"), "data_format."
    )
    config = _Keys(table.optional("config_params", dict, {}), "config_params.")
    beams = layout.whole("pixels_per_column", 1, 256)
    columns_per_packet = layout.whole("columns_per_packet", 1, 256)
    columns = layout.whole("columns_per_frame", columns_per_packet, max(COLUMNS_PER_FRAME))
    if columns not in COLUMNS_PER_FRAME or columns % columns_per_packet:
        raise _wrong("data_format.columns_per_frame", columns, "512, 1024, 2048 or 4096, whole packets")
    profile = layout.optional("udp_profile_lidar", str, "LEGACY")
    azimuth_offset = config.optional("lidar_frame_azimuth_offset", int, 0)
    if azimuth_offset:
        raise _wrong("config_params.lidar_frame_azimuth_offset", azimuth_offset, "0: turn the head by `installation`")
    timestamp_mode = config.optional("timestamp_mode", str, "")
    if timestamp_mode and timestamp_mode not in TIMESTAMP_MODES:
        raise _wrong("config_params.timestamp_mode", timestamp_mode, ", ".join(TIMESTAMP_MODES))
    imu_profile = layout.optional("udp_profile_imu", str, "LEGACY")
    imu_layout = _Keys(table.optional("imu_data_format", dict, {}), "imu_data_format.")
    modern_imu = imu_profile == "ACCEL32_GYRO32_NMEA"
    return OusterHead(
        model=table.optional("prod_line", str, ""),
        serial=_serial(table),
        firmware=table.optional("image_rev", str, "") or table.optional("build_rev", str, ""),
        init_id=table.optional("initialization_id", int, None),
        profile=profile,
        header=_header(layout, profile),
        beams=beams,
        columns_per_packet=columns_per_packet,
        columns_per_frame=columns,
        column_window=_window(layout, columns),
        imu_profile=imu_profile,
        imu_samples=imu_layout.whole("imu_measurements_per_packet", 1, 256) if modern_imu else 1,
        timestamp_mode=timestamp_mode,
        nmea_input=config.optional("multipurpose_io_mode", str, "") == "INPUT_NMEA_UART",
        return_order=_return_order(config),
        altitude_rad=_altitudes(table, beams),
        azimuth_rad=_angles(table, "beam_azimuth_angles", beams, 360.0),
        pixel_shift=layout.numbers("pixel_shift_by_row", beams, columns).astype(np.int64),
        beam_origin_m=_beam_origin(table),
        sensor_from_lidar=_transform(table, "lidar_to_sensor_transform"),
        rot_sensor_from_imu=_transform(table, "imu_to_sensor_transform")[:3, :3],
    )


# --- the file -------------------------------------------------------------------------------------------------------


def _wrong(key: str, got: object, want: str) -> DriverSettingsError:
    if isinstance(got, dict | list):
        shown = f"a list of {len(got)}" if isinstance(got, list) else "a table"
    else:
        text = "nothing" if got is None else json.dumps(got)
        shown = text if len(text) <= 60 else f"{text[:59]}…"
    return DriverSettingsError(f"{FILE}: {key}: got {shown}, want {want}")


def _json_object(content: bytes) -> dict[str, Any]:
    try:
        table = json.loads(content)
    except (ValueError, RecursionError) as error:
        reason = "nested too deeply" if isinstance(error, RecursionError) else str(error).split("\n")[0]
        raise DriverSettingsError(f"{FILE}: not JSON: {reason}; want the head's metadata") from error
    if not isinstance(table, dict):
        raise DriverSettingsError(f"{FILE}: not a JSON object; want the head's metadata")
    return table


def _merged(table: dict[str, Any]) -> _Keys:
    """Flatten the sections of newer files, so that they read like older ones."""
    flat = dict(table)
    for name in _SECTIONS:
        section = table.get(name)
        if isinstance(section, dict):
            flat.update(section)
    if "lidar_data_format" in table:
        flat["data_format"] = table["lidar_data_format"]
    return _Keys(flat, "")


@dataclass(frozen=True)
class _Keys:
    """Reads a table's values; ``prefix`` is the table's path for error messages."""

    table: dict[str, Any]
    prefix: str

    def plain(self, key: str, kind: type, want: str) -> Any:
        """Return a value of the given type."""
        value = self.table.get(key)
        if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
            raise _wrong(self.prefix + key, value, want)
        return value

    def optional(self, key: str, kind: type, default: Any) -> Any:
        """Return a value of the given type, or the default where the key is missing."""
        wanted = {dict: "a table", str: "text", int: "a whole number"}[kind]
        return default if self.table.get(key) is None else self.plain(key, kind, wanted)

    def whole(self, key: str, low: int, high: int) -> int:
        """Return a whole number within bounds."""
        want = f"a whole number {low} to {high}"
        value: int = self.plain(key, int, want)
        if not low <= value <= high:
            raise _wrong(self.prefix + key, value, want)
        return value

    def number(self, key: str, bound: float) -> float:
        """Return a number within ±bound."""
        value = self.table.get(key)
        if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= bound:
            raise _wrong(self.prefix + key, value, f"a number within ±{bound:g}")
        return float(value)

    def numbers(self, key: str, count: int, bound: float) -> FloatArray:
        """Return ``count`` numbers, all within ±bound."""
        want = f"{count} numbers within ±{bound:g}"
        values = self.plain(key, list, want)
        flat = [item for value in values for item in (value if isinstance(value, list) else [value])]
        fits = len(flat) == count and all(type(item) in (int, float) and abs(item) <= bound for item in flat)
        if not fits:
            raise _wrong(self.prefix + key, values, want)
        return np.array(flat, dtype=np.float64)


def _serial(table: _Keys) -> int | None:
    text = str(table.table.get("prod_sn", ""))
    return int(text) if text.isascii() and text.isdigit() and len(text) <= 18 else None


def _header(layout: _Keys, profile: str) -> str:
    """Return the kind of packet header; the FUSA profile implies its own header."""
    if profile == "LEGACY":
        return "legacy"
    name = layout.optional("header_type", str, "FUSA" if profile == FUSA_PROFILE else "STANDARD")
    if name not in HEADERS:
        raise _wrong("data_format.header_type", name, " or ".join(HEADERS))
    return HEADERS[name]


def _window(layout: _Keys, columns: int) -> tuple[int, int]:
    if layout.table.get("column_window") is None:
        return 0, columns - 1
    first, last = layout.numbers("column_window", 2, columns - 1).tolist()
    if min(first, last) < 0 or first % 1 or last % 1:
        raise _wrong("data_format.column_window", [first, last], f"measurement ids 0 to {columns - 1}")
    return int(first), int(last)


def _return_order(config: _Keys) -> str:
    order: str = config.optional("return_order", str, RETURN_ORDERS[0])
    if order not in RETURN_ORDERS:
        raise _wrong("config_params.return_order", order, ", ".join(RETURN_ORDERS))
    return order


def _angles(table: _Keys, key: str, beams: int, bound_deg: float) -> FloatArray:
    return np.radians(table.numbers(key, beams, bound_deg))


def _altitudes(table: _Keys, beams: int) -> FloatArray:
    """Read each beam's altitude; refuse all zeros, which a head without its factory calibration reports."""
    altitude_rad = _angles(table, "beam_altitude_angles", beams, 90.0)
    if beams > 1 and not altitude_rad.any():
        raise _wrong(
            "beam_altitude_angles", altitude_rad.tolist(), "the head's own angles; 0 for all beams is not a calibration"
        )
    return altitude_rad


def _transform(table: _Keys, key: str) -> FloatArray:
    """Return a (4, 4) matrix from sixteen numbers, row by row, translations in millimetres."""
    matrix = table.numbers(key, 16, 10_000.0).reshape(4, 4)
    rotation = matrix[:3, :3]
    proper = np.abs(rotation @ rotation.T - np.eye(3)).max() < ROTATION_TOLERANCE and np.linalg.det(rotation) > 0
    if not proper or not np.array_equal(matrix[3], [0, 0, 0, 1]):
        raise _wrong(key, matrix.reshape(-1).tolist(), "a rotation and a translation, 4 × 4, row by row")
    matrix[:3, 3] *= 1e-3
    return matrix


def _beam_origin(table: _Keys) -> tuple[float, float]:
    """Read the beam origin from the transform of newer files, or the one number of older files without an offset along
    z.
    """
    if table.table.get("beam_to_lidar_transform") is not None:
        matrix = _transform(table, "beam_to_lidar_transform")
        return float(matrix[0, 3]), float(matrix[2, 3])
    return table.number("lidar_origin_to_beam_origin_mm", 1000.0) * 1e-3, 0.0
