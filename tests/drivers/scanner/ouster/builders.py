"""Packets of Ouster's recordings that several tests read."""

from __future__ import annotations

import numpy as np

from swath.drivers.scanner.ouster.head import read_head
from swath.drivers.scanner.ouster.layout import LidarLayout
from swath.georef.arrays import StructArray
from tests.drivers.ouster_cases import metadata_of, payloads


def lidar_packets(capture: str) -> tuple[LidarLayout, StructArray]:
    """Return the layout and the lidar packets of a capture."""
    layout = LidarLayout(read_head(metadata_of(capture)))
    units = b"".join(unit for unit in payloads(capture) if len(unit) == layout.packet_bytes)
    return layout, np.frombuffer(units, dtype=layout.dtype)
