"""Makes packets of Livox heads with Swath's encoder: a rosette before a wall, in every type of point and time."""

from __future__ import annotations

import datetime as dt
from pathlib import Path
from typing import Any

import numpy as np

from swath.drivers.captures.pcap.writer import FILE_HEADER, pcap_frames
from swath.drivers.scanner.livox.layout import (
    GPS_2,
    IMU_1,
    IMU_2,
    NO_SYNC,
    POINTS_1,
    POINTS_2,
    PPS_1,
    PPS_GPS_1,
    PTP,
    PointType,
    encode_packet_1,
    encode_packet_2,
    utc_bytes,
)
from swath.georef.arrays import FloatArray, StructArray

FIXTURES = Path(__file__).parents[2] / "fixtures" / "livox"
BEGUN = dt.datetime(2026, 11, 27, 10, 59, 59, 999_000, tzinfo=dt.UTC)
HOST_NS = 1_764_241_200_000_000_000
WALL_M = 40.0
GRAVITY_G = (0.01, -0.02, 1.0)


def rosette(at_s: FloatArray, fov_rad: float = 0.6) -> FloatArray:
    """Return unit vectors (n, 3) of two prisms that turn against each other about x."""
    first, second = 2 * np.pi * 121.6 * at_s, -2 * np.pi * 78.7 * at_s
    left = 0.5 * fov_rad * (np.cos(first) + np.cos(second))
    up = 0.5 * fov_rad * (np.sin(first) + np.sin(second))
    ray = np.stack([np.ones_like(left), left, up], axis=1)
    unit: FloatArray = ray / np.linalg.norm(ray, axis=1, keepdims=True)
    return unit


def wall(kind: PointType, at_s: FloatArray, *, behind_m: float = 3.5) -> StructArray:
    """Return pulses (n,) that meet a wall, and others behind it if the type has room; every 11th meets nothing."""
    table, ray = np.zeros(len(at_s), dtype=kind.dtype), rosette(at_s)
    for echo in range(kind.echoes):
        there = (np.arange(len(at_s)) % 11 != 0) & ((echo == 0) | (np.arange(len(at_s)) % (echo + 2) == 0))
        range_m = np.where(there, (WALL_M + behind_m * echo) / ray[:, 0], 0.0)
        row = table["echoes"][:, echo] if kind.echoes > 1 else table
        if kind.is_polar:
            row["range"] = np.rint(range_m / kind.unit_m)
        else:
            for axis, name in enumerate("xyz"):
                row[name] = np.rint(range_m * ray[:, axis] / kind.unit_m)
        row["reflectivity"] = np.where(there, 20 + 7 * echo, 0)
        if kind.has_tag:
            row["tag"] = (np.arange(len(at_s)) % 17 == 3) * 1 | echo << 4
    if kind.is_polar:
        table["zenith"] = np.rint(np.degrees(np.arccos(ray[:, 2])) * 100)
        table["azimuth"] = np.rint(np.degrees(np.arctan2(ray[:, 1], ray[:, 0])) % 360 * 100)
    return table


def packets_1(pulses_hz: int, kinds: tuple[int, ...], packets: int = 4) -> list[bytes]:
    """Return packets of SDK 1 with every type of points and time, and an IMU sample after every fourth."""
    units: list[bytes] = []
    passed = 0
    for number, (data_type, time_type) in enumerate((d, t) for t in (NO_SYNC, PTP, PPS_GPS_1, PPS_1) for d in kinds):
        kind = POINTS_1[data_type]
        for _ in range(packets):
            at_s = (passed + np.arange(kind.pulses)) / pulses_hz
            since_ns = passed * 1_000_000_000 // pulses_hz
            units.append(encode_packet_1(data_type, time_type, time_1(time_type, since_ns), wall(kind, at_s)))
            passed += kind.pulses
        imu: Any = [((0.001, -0.002, 0.1 * number), GRAVITY_G)]
        units.append(encode_packet_1(IMU_1, time_type, time_1(time_type, since_ns), imu))
    return units


def time_1(time_type: int, since_ns: int) -> int | bytes:
    """Return a header's time, nanoseconds after the beginning."""
    if time_type == PPS_GPS_1:
        return utc_bytes(BEGUN + dt.timedelta(microseconds=since_ns // 1000))
    if time_type == PPS_1:
        return (999_000_000 + since_ns) % 1_000_000_000
    return since_ns + (7_000_000_000 if time_type == NO_SYNC else HOST_NS)


def packets_2(step_ns: int, kinds: tuple[int, ...] = (1, 2, 3), packets: int = 4) -> list[bytes]:
    """Return packets of SDK 2 with every type of points and time; a Mid-360's points have no CRC."""
    units: list[bytes] = []
    for number, (data_type, time_type) in enumerate((d, t) for t in (NO_SYNC, PTP, GPS_2) for d in kinds):
        kind = POINTS_2[data_type]
        begin_ns = 7_000_000_000 if time_type == NO_SYNC else HOST_NS
        for packet in range(packets):
            passed = (number * packets + packet) * 96
            time_ns = begin_ns + passed * step_ns
            table = wall(kind, np.asarray((passed + np.arange(96)) * step_ns * 1e-9, np.float64))
            count = number * packets + packet
            units.append(
                encode_packet_2(
                    data_type,
                    time_type,
                    time_ns,
                    table,
                    span_100ns=95 * step_ns // 100,
                    count=count,
                    crc=number % 2 == 0,
                )
            )
        imu: Any = [((0.001, -0.002, 0.1 * number), GRAVITY_G)]
        units.append(encode_packet_2(IMU_2, time_type, begin_ns + passed * step_ns, imu, span_100ns=0, count=number))
    return units


FILES = {
    "mid40": lambda: packets_1(100_000, (0, 1)),
    "avia": lambda: packets_1(240_000, (2, 3, 4, 5, 7, 8), packets=2),
    "mid360": lambda: packets_2(5_000),
    "hap": lambda: packets_2(2_200, (1, 2)),
}
STEP_NS = {"mid40": 1_000_000, "avia": 200_000, "mid360": 480_000, "hap": 211_200}


def pcap_of(name: str) -> bytes:
    """Return the capture of a head, as it is in fixtures."""
    frames = [
        pcap_frames(
            np.array([HOST_NS + at * STEP_NS[name]], dtype=np.int64),
            at,
            ("192.168.1.12", 56_300),
            ("192.168.1.5", 56_301),
            np.frombuffer(unit, dtype=np.uint8)[np.newaxis],
        ).tobytes()
        for at, unit in enumerate(FILES[name]())
    ]
    return FILE_HEADER + b"".join(frames)


if __name__ == "__main__":
    for file in FILES:
        (FIXTURES / f"{file}.pcap").write_bytes(pcap_of(file))
