"""Hesai heads: layout of their packets, firing times of their lasers, and directions of their beams.

Sources: PandarXT-32 User Manual (3.1.2, Appendix I and II), PandarQT User Manual (3.1.2, Appendix I); the maker's
HesaiLidar_SDK_2.0 (correction/firetime_correction, libhesai/UdpProtocol) and HesaiLidar_General_SDK (pandarXT.h,
pandarQT.h) for the tables of firing times and design angles.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from swath.drivers.parser import DriverSettingsError
from swath.drivers.scanner.beams import BeamTable, beam_table, numbers
from swath.georef.arrays import Int64Array


@dataclass(frozen=True)
class HesaiHead:
    """One model of head.

    Attributes:
        name: the maker's name of it.
        protocol_major: number that identifies it in its packets.
        blocks, channels: size of a packet; a block is one round of firing, in dual return two blocks are.
        tail: fields of the tail in their order, `numpy` style.
        without_sequence: whether its packets may lack the UDP sequence number.
        round_ns: time from one round of firing to the next.
        stamped_round: whether the packet's time is that of its first or of its last round.
        start_ns: time from a round's stamp to the reading of its azimuth.
        offset_ns: (channels,) firing times after the reading of the azimuth.
        beams: design values; a device's own values are in its angle correction file.
    """

    name: str
    protocol_major: int
    blocks: int
    channels: int
    tail: tuple[tuple[str, object], ...]
    without_sequence: bool
    round_ns: float
    stamped_round: int
    start_ns: int
    offset_ns: Int64Array
    beams: BeamTable

    def packet_dtype(self, *, sequence: bool = True) -> np.dtype[np.void]:
        """Return the dtype of a point cloud packet: pre-header and header (12 bytes), body, tail (24 bytes), UDP
        sequence (4 bytes).
        """
        channel = np.dtype([("range", "<u2"), ("reflectivity", "u1"), ("reserved", "u1")])
        block = np.dtype([("azimuth", "<u2"), ("returns", channel, (self.channels,))])
        last = [("sequence", "<u4")] if sequence else []
        return np.dtype([*_HEADER, ("blocks", block, (self.blocks,)), *self.tail, *last])

    def round_start_ns(self, rounds: int) -> Int64Array:
        """Return (rounds,) times from the packet's time to the reading of each round's azimuth."""
        number = np.arange(rounds) - (rounds - 1 if self.stamped_round == LAST_ROUND else 0)
        start: Int64Array = np.rint(number * self.round_ns).astype(np.int64) + self.start_ns
        return start


FIRST_ROUND, LAST_ROUND = 0, -1

_HEADER: list[tuple[str, object]] = [
    ("sop", "<u2"),  # EE FF on the wire
    ("protocol_major", "u1"),
    ("protocol_minor", "u1"),
    ("reserved", "V2"),
    ("laser_num", "u1"),
    ("block_num", "u1"),
    ("first_block_return", "u1"),
    ("distance_unit_mm", "u1"),
    ("return_num", "u1"),
    ("flags", "u1"),  # bit 0: a UDP sequence follows the tail
]

# Point cloud packet 1080 bytes (3.1.2). Block N fires at t0 + 5.632 µs − 50 µs (8 − N), in dual return blocks 2N − 1
# and 2N at t0 + 5.632 µs − 50 µs (4 − N); channel n 0.368 µs + 1.512 µs (n − 1) after that (Appendix II; the maker's
# firetime correction file counts 6 µs + 1.512 µs (n − 1) from t0). Design angles 15° to −16°, no azimuth offsets.
XT32 = HesaiHead(
    name="PandarXT-32",
    protocol_major=6,
    blocks=8,
    channels=32,
    tail=(
        ("tail_reserved", "V10"),
        ("mode", "u1"),
        ("motor_rpm", "<u2"),
        ("utc", "V6"),
        ("microsecond", "<u4"),
        ("factory", "u1"),
    ),
    without_sequence=False,
    round_ns=50_000,
    stamped_round=LAST_ROUND,
    start_ns=0,
    offset_ns=6_000 + 1_512 * np.arange(32, dtype=np.int64),
    beams=beam_table(np.arange(15.0, -17.0, -1.0)),
)

# Point cloud packet 1072 bytes, 1068 without UDP sequence (3.1.2). Block N fires at t0 + 25.71 µs + 166.67 µs (N − 1),
# in dual return two blocks at once; channel n as listed by the firetime correction file, 10 µs after that
# (HesaiLidar_General_ROS). Angles as listed by pandarQT.h.
_QT_FIRES_US = """
2.31 4.37 6.43 8.49 10.54 12.6 14.66 16.71 19.16 21.22 23.28 25.34 27.39 29.45 31.5 33.56
36.61 38.67 40.73 42.78 44.84 46.9 48.95 51.01 53.45 55.52 57.58 59.63 61.69 63.74 65.8 67.86
70.9 72.97 75.02 77.08 79.14 81.19 83.25 85.3 87.75 89.82 91.87 93.93 95.98 98.04 100.1 102.15
105.2 107.26 109.32 111.38 113.43 115.49 117.54 119.6 122.05 124.11 126.17 128.22 130.28 132.34 134.39 136.45
"""
_QT_ELEVATION_DEG = """
-52.121 -49.785 -47.577 -45.477 -43.465 -41.528 -39.653 -37.831 -36.055 -34.32 -32.619 -30.95 -29.308 -27.69 -26.094
-24.517 -22.964 -21.42 -19.889 -18.372 -16.865 -15.368 -13.88 -12.399 -10.925 -9.457 -7.994 -6.535 -5.079 -3.626
-2.175 -0.725 0.725 2.175 3.626 5.079 6.534 7.993 9.456 10.923 12.397 13.877 15.365 16.861 18.368 19.885 21.415 22.959
24.524 26.101 27.697 29.315 30.957 32.627 34.328 36.064 37.84 39.662 41.537 43.475 45.487 47.587 49.795 52.133
"""
_QT_AZIMUTH_DEG = """
8.736 8.314 7.964 7.669 7.417 7.198 7.007 6.838 6.688 6.554 6.434 6.326 6.228 6.14 6.059 5.987 -5.27 -5.216 -5.167
-5.123 -5.083 -5.047 -5.016 -4.988 -4.963 -4.942 -4.924 -4.91 -4.898 -4.889 -4.884 -4.881 5.493 5.496 5.502 5.512
5.525 5.541 5.561 5.584 5.611 5.642 5.676 5.716 5.759 5.808 5.862 5.921 -5.33 -5.396 -5.469 -5.55 -5.64 -5.74 -5.85
-5.974 -6.113 -6.269 -6.447 -6.651 -6.887 -7.163 -7.493 -7.892
"""


QT64 = HesaiHead(
    name="PandarQT",
    protocol_major=3,
    blocks=4,
    channels=64,
    tail=(
        ("tail_reserved", "V10"),
        ("motor_rpm", "<u2"),
        ("microsecond", "<u4"),
        ("mode", "u1"),
        ("factory", "u1"),
        ("utc", "V6"),
    ),
    without_sequence=True,
    round_ns=500_000 / 3,
    stamped_round=FIRST_ROUND,
    start_ns=25_710 + 10_000,
    offset_ns=np.rint(1000 * np.array(numbers(_QT_FIRES_US))).astype(np.int64),
    beams=beam_table(numbers(_QT_ELEVATION_DEG), azimuth_deg=numbers(_QT_AZIMUTH_DEG)),
)


def read_angle_file(data: bytes, head: HesaiHead) -> BeamTable:
    """Read beams from a head's angle correction file: CSV of channel (from 1), elevation and azimuth in degrees.

    Raises:
        DriverSettingsError: the file is not an angle correction file, or is of another model.
    """
    found: dict[int, tuple[float, float]] = {}
    below_names = data.decode("utf-8-sig", "replace").splitlines()[1:]
    for line, text in enumerate(below_names, start=2):
        row = text.split(",")
        if not text.strip(", \t"):
            continue
        try:
            channel, elevation, azimuth = int(row[0]), float(row[1]), float(row[2])
        except (ValueError, IndexError):
            raise DriverSettingsError(
                f"geometry.file: line {line} is {text[:40]!r}, want channel, elevation, azimuth in degrees"
            ) from None
        if not (math.isfinite(azimuth) and abs(azimuth) <= 360 and abs(elevation) <= 90):
            raise DriverSettingsError(
                f"geometry.file: line {line}: elevation {elevation}, azimuth {azimuth}: not angles in degrees"
            )
        if channel in found:
            raise DriverSettingsError(f"geometry.file: line {line}: channel {channel} appears twice")
        found[channel] = (elevation, azimuth)
    if sorted(found) != list(range(1, head.channels + 1)):
        raise DriverSettingsError(
            f"geometry.file: {len(found)} channels, want channels 1 to {head.channels} of a {head.name}"
        )
    angles = np.array([found[channel] for channel in sorted(found)])
    return beam_table(angles[:, 0], azimuth_deg=angles[:, 1])
