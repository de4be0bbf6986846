"""Provides a small DBC of an inertial unit and frames for it, for the tests of the CAN drivers."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np

from swath.drivers.can_frames import encode_can_frame
from swath.drivers.parser import DeviceSettings, Parser
from swath.georef.arrays import Int64Array, StructArray
from swath.georef.records import IMU_DTYPE, ByteRows, ChunkBatch, DeviceClockSamples, ImuSamples, Record

ACC, GYR, SAMPLE, SYNC, TEMP = 0x101, 0x102, 0x103, 0x104, 0x105

IMU_DBC = """VERSION ""
NS_ :
BS_:
BU_: IMU

BO_ 257 ACC: 6 IMU
 SG_ acc_x : 0|16@1- (0.01,0) [0|0] "m/s^2" IMU
 SG_ acc_y : 16|16@1- (0.01,0) [0|0] "m/s^2" IMU
 SG_ acc_z : 32|16@1- (0.01,0) [0|0] "m/s^2" IMU

BO_ 258 GYR: 6 IMU
 SG_ gyr_x : 7|16@0- (0.02,0) [0|0] "deg/s" IMU
 SG_ gyr_y : 23|16@0- (0.02,0) [0|0] "deg/s" IMU
 SG_ gyr_z : 39|16@0- (0.02,0) [0|0] "deg/s" IMU

BO_ 259 SAMPLE: 8 IMU
 SG_ ticks : 0|32@1+ (1,0) [0|0] "us" IMU
 SG_ temperature : 32|16@1- (0.1,0) [0|0] "degC" IMU

BO_ 260 SYNC: 4 IMU
 SG_ pps_ticks : 0|32@1+ (1,0) [0|0] "us" IMU

BO_ 261 TEMP: 2 IMU
 SG_ celsius : 0|16@1- (0.1,0) [0|0] "degC" IMU
"""

SIGNALS: dict[str, Any] = {
    "specific_force": ["ACC.acc_x", "ACC.acc_y", "ACC.acc_z"],
    "angular_rate": ["GYR.gyr_x", "GYR.gyr_y", "GYR.gyr_z"],
    "sample_ticks": "SAMPLE.ticks",
    "pps_ticks": "SYNC.pps_ticks",
    "temperature": "SAMPLE.temperature",
}


def settings(dbc: str = IMU_DBC, signals: dict[str, Any] | None = None, **config: Any) -> DeviceSettings:
    """Return settings of an IMU on CAN; keywords override the configuration's keys."""
    table = {
        "dbc": "imu.dbc",
        "tick_hz": 1_000_000,
        "group": "last",
        "signals": SIGNALS if signals is None else signals,
    }
    return DeviceSettings("imu/main", {**table, **config}, {"dbc": dbc.encode()})


def without(*keys: str) -> dict[str, Any]:
    """Return the signal map without some keys."""
    return {key: value for key, value in SIGNALS.items() if key not in keys}


def acc_frame(x: int, y: int = 0, z: int = 0) -> bytes:
    """Return the frame ACC with raw counts."""
    return encode_can_frame(ACC, struct.pack("<3h", x, y, z))


def gyr_frame(x: int, y: int = 0, z: int = 0) -> bytes:
    """Return the frame GYR with raw counts."""
    return encode_can_frame(GYR, struct.pack(">3h", x, y, z))


def sample_frame(ticks: int, temperature: int = 250) -> bytes:
    """Return the frame SAMPLE with the counter."""
    return encode_can_frame(SAMPLE, struct.pack("<IhH", ticks & 0xFFFF_FFFF, temperature, 0))


def sync_frame(ticks: int) -> bytes:
    """Return the frame SYNC with the latched counter."""
    return encode_can_frame(SYNC, struct.pack("<I", ticks & 0xFFFF_FFFF))


def temp_frame(tenths: int) -> bytes:
    """Return the frame TEMP, in tenths of a degree."""
    return encode_can_frame(TEMP, struct.pack("<h", tenths))


def units(frames: list[bytes]) -> ByteRows:
    """Return frames of one length as rows."""
    return np.frombuffer(b"".join(frames), np.uint8).reshape(len(frames), -1)


def feed(parser: Parser, frames: list[bytes], host_time_ns: Int64Array | None = None) -> list[Record]:
    """Feed frames as one batch, 1 ms apart unless times are given."""
    host = np.arange(len(frames), dtype=np.int64) * 1_000_000 if host_time_ns is None else host_time_ns
    return parser.feed_batch(ChunkBatch("imu/main", host, units(frames)))


def imu_rows(records: list[Record]) -> StructArray:
    """Return all `ImuSamples` rows of records, with zeros between their fields, so that bytes can be compared."""
    rows = [record.rows for record in records if isinstance(record, ImuSamples)]
    assert rows, "no samples"
    together = np.zeros(sum(map(len, rows)), IMU_DTYPE)
    return np.concatenate(rows, out=together)


def clock_rows(records: list[Record]) -> StructArray:
    """Return all `DeviceClockSamples` rows of records."""
    rows = [record.rows for record in records if isinstance(record, DeviceClockSamples)]
    assert rows, "no clock samples"
    return np.concatenate(rows)
