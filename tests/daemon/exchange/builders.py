"""Makes logs from units and units from logs, for the tests of `swath import` and `swath export`."""

from __future__ import annotations

from collections import Counter, defaultdict
from pathlib import Path

import numpy as np

from swath.daemon.config import Config, load_config
from swath.daemon.exchange.capture_files import ImportOptions, find_captures
from swath.daemon.exchange.captures import Capture
from swath.daemon.exchange.import_ import ImportReport, import_captures
from swath.daemon.exchange.routes import Routes
from swath.daemon.log.format import ChannelSpec, SessionInfo
from swath.daemon.log.mcap.encode import encode_block
from swath.daemon.log.mcap.writer import PartWriter
from swath.daemon.log.reader import open_logs

CONFIG = """
[session]
name = "exchange"
directory = "logs"

[pps.main]
source = "/dev/pps0"

[gnss.rover]
transport = "serial:/dev/ttyUSB0?baud=115200"
protocol = "novatel"

[imu.main]
transport = "can:socketcan:can1?bitrate=500000"
protocol = "canmod-gps"

[scanner.top]
transport = "udp:0.0.0.0:2368"
auxiliary = "udp:0.0.0.0:8308"
protocol = "velodyne-vlp16"
installation = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
"""

# a unit in a log: source, log time, bytes, and for a datagram its sender
Unit = tuple[str, int, bytes, tuple[str, int] | None]
Content = dict[str, list[tuple[int, bytes, tuple[tuple[str, str], ...]]]]


def write_config(folder: Path, text: str = CONFIG) -> Config:
    """Write a configuration file and load it."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "swath.toml"
    path.write_text(text)
    return load_config(path)


def write_log(folder: Path, config: Config, units: list[Unit], session: str = "made-20261121T101500Z-ab12") -> Path:
    """Write a log with one message for each unit, in this order, with the channels of a recorder's configuration."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{session}_0.mcap"
    first_ns = units[0][1] if units else 0
    writer = PartWriter(path, SessionInfo(session, "swath test", "host", "boot", first_ns, 1000), 0)
    for name, media_type, data in config.attachments():
        writer.add_attachment(name, media_type, data, first_ns)
    ports = Routes.of(config).ports
    ids: dict[tuple[str, tuple[str, int] | None], int] = {}
    sequences: Counter[int] = Counter()
    for source, time_ns, data, peer in units:
        spec = ports[source].channel
        if (source, peer) not in ids:
            ids[source, peer] = len(ids) + 1
            sender = {} if peer is None else {"source_address": peer[0], "source_port": str(peer[1])}
            metadata = spec.metadata | sender
            named = ChannelSpec(spec.topic, spec.message_encoding, metadata, spec.schema, spec.chunk_class)
            writer.add_channel(ids[source, peer], named)
        channel_id = ids[source, peer]
        row = np.frombuffer(data, np.uint8).reshape(1, len(data))
        writer.add(encode_block(channel_id, sequences[channel_id], np.array([time_ns], np.int64), row))
        sequences[channel_id] += 1
    writer.finish()
    return path


def content_of(*paths: Path) -> Content:
    """Return for each topic, in file order, log time, bytes and channel metadata of every raw unit and edge."""
    content: Content = defaultdict(list)
    for session in open_logs(list(paths)):
        for batch in session.batches(lambda topic: topic.endswith("/raw") or topic.startswith("/pps/")):
            metadata = tuple(sorted(batch.channel.metadata.items()))
            for time_ns, row in zip(batch.log_time_ns.tolist(), batch.units, strict=True):
                content[batch.channel.topic].append((time_ns, row.tobytes(), metadata))
    return dict(content)


def run_import(
    config: Config, files: list[Path], output: Path, told: ImportOptions | None = None
) -> tuple[ImportReport, list[Capture]]:
    """Import within this process, and return the report and what was found in each file."""
    routes = Routes.of(config)
    captures = find_captures(routes, files, told or ImportOptions())
    return import_captures(config, routes, captures, output), captures
