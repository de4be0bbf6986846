"""The first part: real recordings of a receiver, an inertial unit and a scanner."""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from pathlib import Path

from demo.captures import can_units, gnss_units, pps_units, scanner_units, until
from demo.proof import Show
from swath.daemon.replay.wire_player import TimedUnit
from swath.daemon.simulate.on_wires import free_ports

WHAT = {
    "gnss/rover": "NovAtel ProPak6 SPAN, 2014, through a pty",
    "imu/main": "CANmod.gps, 2021, through a CAN bus (udp_multicast)",
    "scanner/top": "Velodyne VLP-16 with PPS, 2016, through UDP",
    "scanner/top/aux": "its position packets, second UDP port",
    "pps/main": "edges of the GNSS recording",
}
REMARK = (
    "The recordings are of different days and places, so each source has its own time; "
    "only the GNSS recording has PPS edges."
)
CONFIG = """[session]
name = "demo"
directory = "{folder}/logs"
reserve_mb = 64

[pps.main]
source = "fixed:{folder}/pps"

[gnss.rover]
transport = "serial:{folder}/rover?baud=115200"
protocol = "novatel"
pps = "main"

[imu.main]
transport = "can:udp_multicast:239.74.163.2?port={can_port}"
protocol = "canmod-gps"

[scanner.top]
transport = "udp:127.0.0.1:{data_port}"
auxiliary = "udp:127.0.0.1:{position_port}"
protocol = "velodyne-vlp16"
installation = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
"""


def all_units(seconds: float) -> Iterator[TimedUnit]:
    """Yield the units of all sources in order of time."""
    streams = [
        until(stream, seconds) for stream in (gnss_units(), can_units(), scanner_units(seconds), pps_units(seconds))
    ]
    return heapq.merge(*streams, key=lambda unit: unit.time_ns)


def prepare(folder: Path, seconds: float) -> Show:
    """Write the configuration."""
    data_port, position_port, can_port = free_ports(3)
    text = CONFIG.format(folder=folder, can_port=can_port, data_port=data_port, position_port=position_port)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "swath.toml").write_text(text)
    return Show("real recordings, at their original speed", WHAT, all_units(seconds), seconds, REMARK)
