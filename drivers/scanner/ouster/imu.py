"""Ouster's IMU packets: the head's own inertial samples, sent to a second port.

LEGACY: 48 bytes, one sample in g and °/s, read from accelerometer and gyroscope 0.2 ms apart; the maker advises the
mean of both stamps. ACCEL32_GYRO32_NMEA (firmware 3.2): packet header, the last NMEA sentence (100 bytes, not read
here), samples of 36 bytes in m/s² and rad/s, footer. Source: Ouster Firmware User Manual, "IMU Data Legacy";
github.com/ouster-lidar/ouster-sdk @ 46b7bce, ouster_client/src/parsing.cpp.
"""

from __future__ import annotations

from math import radians

import numpy as np
from numpy.typing import ArrayLike

from swath.drivers.scanner.ouster.head import OusterHead
from swath.drivers.scanner.ouster.layout import FOOTER_BYTES, HEADER_BYTES, IMU_PACKET, with_crc
from swath.georef.arrays import FloatArray, Int64Array, SingleArray, StructArray
from swath.georef.records import IMU_DTYPE, ByteRows

STANDARD_GRAVITY = 9.80665  # m/s², CGPM 1901
NMEA_BYTES = 100

LEGACY_DTYPE = np.dtype(
    [
        ("diagnostic_ns", "<u8"),
        ("accelerometer_ns", "<u8"),
        ("gyroscope_ns", "<u8"),
        ("acceleration_g", "<f4", (3,)),
        ("rate_deg_per_s", "<f4", (3,)),
    ]
)
SAMPLE_DTYPE = np.dtype(
    [
        ("time_ns", "<u8"),
        ("id", "<u2"),
        ("status", "<u2"),
        ("acceleration", "<f4", (3,)),  # m/s²
        ("rate", "<f4", (3,)),  # rad/s
    ]
)


def imu_packet_bytes(head: OusterHead) -> int:
    """Return the length of a head's IMU packets; 0 where it sends no packets of a known profile."""
    if head.imu_profile == "LEGACY":
        return LEGACY_DTYPE.itemsize
    if head.imu_profile != "ACCEL32_GYRO32_NMEA":
        return 0
    return HEADER_BYTES + NMEA_BYTES + head.imu_samples * SAMPLE_DTYPE.itemsize + FOOTER_BYTES


def imu_samples(host_time_ns: Int64Array, units: ByteRows, head: OusterHead) -> tuple[StructArray, int]:
    """Decode the samples of IMU packets in the axes of the maker's sensor frame, in order.

    Args:
        host_time_ns: (n,) host time of each packet.
        units: (n, `imu_packet_bytes`).
        head: the head that sent the packets.

    Returns:
        rows: (m,) `IMU_DTYPE`.
        bad: number of samples left out because their numbers are not finite or their stamp is impossible.
    """
    if head.imu_profile == "LEGACY":
        table = np.ascontiguousarray(units).view(LEGACY_DTYPE)[:, 0]
        host, status = host_time_ns, np.zeros(len(table), dtype=np.uint32)
        stamps = table["accelerometer_ns"] // 2 + table["gyroscope_ns"] // 2
        force = _doubles(table["acceleration_g"]) * STANDARD_GRAVITY
        rate = _doubles(table["rate_deg_per_s"]) * radians(1.0)
    else:
        begin, end = HEADER_BYTES + NMEA_BYTES, units.shape[1] - FOOTER_BYTES
        sent = np.ascontiguousarray(units[:, begin:end]).view(SAMPLE_DTYPE)
        valid = (sent["status"] & 1).astype(np.bool_)
        table = sent[valid]
        host, status = np.broadcast_to(host_time_ns[:, np.newaxis], valid.shape)[valid], table["status"]
        stamps = table["time_ns"]
        force, rate = _doubles(table["acceleration"]), _doubles(table["rate"])
    good = np.isfinite(force).all(axis=1) & np.isfinite(rate).all(axis=1) & (stamps < np.uint64(1 << 63))
    rows = np.zeros(int(good.sum()), dtype=IMU_DTYPE)
    rows["host_time_ns"], rows["device_time_ns"], rows["status"] = host[good], stamps[good], status[good]
    rows["pps_time_ns"] = rows["gps_week"] = -1
    rows["specific_force_b"] = force[good] @ head.rot_sensor_from_imu.T
    rows["angular_rate_b"] = rate[good] @ head.rot_sensor_from_imu.T
    rows["temperature_c"] = np.nan
    return rows, len(good) - len(rows)


def _doubles(values: SingleArray) -> FloatArray:
    with np.errstate(invalid="ignore"):  # a signalling NaN on the wire is a NaN like any other
        return values.astype(np.float64)


def encode_imu_packet(head: OusterHead, time_ns: ArrayLike, force: FloatArray, rate: FloatArray) -> bytes:
    """Encode one IMU packet of the head's profile.

    Args:
        head: the head whose profile and axes are used.
        time_ns: (samples,) device time; LEGACY takes one sample.
        force: (samples, 3) m/s², sensor frame.
        rate: (samples, 3) rad/s, sensor frame.
    """
    force, rate = force @ head.rot_sensor_from_imu, rate @ head.rot_sensor_from_imu
    if head.imu_profile == "LEGACY":
        packet = np.zeros(1, dtype=LEGACY_DTYPE)
        for name in ("diagnostic_ns", "accelerometer_ns", "gyroscope_ns"):
            packet[name] = time_ns
        packet["acceleration_g"], packet["rate_deg_per_s"] = force / STANDARD_GRAVITY, np.degrees(rate)
        return packet.tobytes()
    samples = np.zeros(head.imu_samples, dtype=SAMPLE_DTYPE)
    samples["time_ns"], samples["status"], samples["acceleration"], samples["rate"] = time_ns, 1, force, rate
    header = bytearray(HEADER_BYTES)
    header[0] = IMU_PACKET
    header[4:7] = (head.init_id or 0).to_bytes(3, "little")
    header[7:12] = (head.serial or 0).to_bytes(5, "little")
    return with_crc(bytes(header) + bytes(NMEA_BYTES) + samples.tobytes() + bytes(FOOTER_BYTES))
