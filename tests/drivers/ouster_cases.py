"""Provides Ouster's fixtures, and heads of any profile for tests that send packets themselves."""

from __future__ import annotations

import gzip
import json
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from swath.drivers.captures.opening import read_pcap
from swath.drivers.parser import DeviceSettings
from swath.drivers.scanner.ouster.layout import PROFILES, LidarLayout
from swath.drivers.scanner.ouster.parser import OusterParser
from swath.georef.arrays import StructArray
from swath.georef.records import ImuSamples, Record

FIXTURES = Path(__file__).parents[2] / "fixtures" / "ouster"
EXPECTED: dict[str, dict[str, Any]] = json.loads((FIXTURES / "expected.json").read_text())
SERIAL = 122_247_000_785


def metadata_of(capture: str) -> bytes:
    """Return the metadata that belongs to a capture."""
    name = FIXTURES / EXPECTED[f"{capture}.pcap"]["metadata"]
    return name.read_bytes() if name.exists() else gzip.decompress(name.with_name(f"{name.name}.gz").read_bytes())


@cache
def payloads(capture: str) -> list[bytes]:
    return [unit.data for unit in read_pcap(FIXTURES / f"{capture}.pcap.gz")]


def parser_of(metadata: bytes, *, clock_only: bool = False, **config: Any) -> OusterParser:
    return OusterParser(DeviceSettings("scanner/left", config, {"geometry": metadata}), clock_only=clock_only)


def recorded(capture: str) -> OusterParser:
    return parser_of(metadata_of(capture))


def samples_of(records: list[Record]) -> StructArray:
    return np.concatenate([record.rows for record in records if isinstance(record, ImuSamples)])


def measurement_ids(rows: StructArray, columns: int) -> np.ndarray[Any, np.dtype[np.int64]]:
    """Return the column of a frame to which each return belongs."""
    return np.rint(-rows["encoder_rad"] / (2 * np.pi) * columns).astype(np.int64) % columns


def metadata(
    profile: str = "RNG19_RFL8_SIG16_NIR16",
    beams: int = 16,
    columns: int = 1024,
    window: tuple[int, int] | None = None,
    **config: Any,
) -> bytes:
    """Return sectioned metadata of an invented head."""
    unit = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
    table = {
        "sensor_info": {"prod_line": f"OS-1-{beams}", "prod_sn": str(SERIAL), "initialization_id": 77},
        "beam_intrinsics": {
            "beam_altitude_angles": np.linspace(20, -20, beams).tolist(),
            "beam_azimuth_angles": [4.2, 1.4, -1.4, -4.2] * (beams // 4),
            "beam_to_lidar_transform": [1, 0, 0, 15.806, *unit[4:]],
        },
        "lidar_intrinsics": {"lidar_to_sensor_transform": [-1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1, 36.18, 0, 0, 0, 1]},
        "imu_intrinsics": {"imu_to_sensor_transform": unit},
        "lidar_data_format": {
            "columns_per_frame": columns,
            "columns_per_packet": 16,
            "pixels_per_column": beams,
            "pixel_shift_by_row": [0] * beams,
            "column_window": list(window or (0, columns - 1)),
            "udp_profile_lidar": profile,
            "udp_profile_imu": "LEGACY",
        },
        "config_params": {"timestamp_mode": "TIME_FROM_INTERNAL_OSC", **config},
    }
    return json.dumps(table).encode()


def frames_of(layout: LidarLayout, packets: int, first: int = 0, seed: int = 1) -> list[bytes]:
    """Return packets of consecutive frames, with random ranges and light in every field of the profile."""
    random = np.random.default_rng(seed)
    head = layout.head
    per_frame = head.columns_per_frame // head.columns_per_packet
    units = []
    for at in range(first, first + packets):
        fields = random_fields(layout, random)
        time_ns = 5_000_000_000 + 97_656 * (at * head.columns_per_packet + np.arange(head.columns_per_packet))
        units.append(layout.encode(at // per_frame + 7, at % per_frame * head.columns_per_packet, time_ns, fields))
    return units


def random_fields(layout: LidarLayout, random: np.random.Generator) -> dict[str, np.ndarray[Any, np.dtype[np.int64]]]:
    """Return random values (columns, beams) by field name within each field's range, one in three ranges 0."""
    shape = (layout.head.columns_per_packet, layout.head.beams)
    fields = {}
    for name, bits in PROFILES[layout.head.profile].fields.items():
        values = random.integers(0, 1 << bits.size, shape) << bits.dropped
        fields[name] = values * (random.random(shape) > 0.33) if name.startswith("RANGE") else values
    return fields
