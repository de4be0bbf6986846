"""Builders and readers that several tests of the daemon use: commands, logs, devices' wires, files of points."""

from __future__ import annotations

import hashlib
import os
import socket
import subprocess
import sys
import time
import tty
from functools import reduce
from operator import xor
from pathlib import Path
from typing import Any

import laspy
import numpy as np
from numpy.typing import NDArray
from pyproj import CRS

from swath.daemon.log.format import ChannelSpec, SessionInfo
from swath.daemon.log.mcap.encode import encode_block, encode_json
from swath.daemon.log.mcap.writer import PartWriter
from tests.builders import ROOT
from tests.daemon.rig import HANGS_S, one_processor

CAPTURE = ROOT / "fixtures/novatel/propak6-basic-fix.gps.gz"


def swath(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run the command line as a process of its own."""
    return subprocess.run(
        [sys.executable, "-m", "swath.daemon.cli.main", *arguments],
        cwd=ROOT,
        env=os.environ | {"COLUMNS": "100", "NO_COLOR": "1"} | environment,
        capture_output=True,
        text=True,
        timeout=HANGS_S,
        check=False,
    )


def run_python(code: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run the command line in a process with an additional statement."""
    head = "import sys; import swath.daemon.cli.main as cli\n"
    return subprocess.run(
        [sys.executable, "-c", head + code],
        cwd=ROOT,
        env=os.environ | environment,
        capture_output=True,
        text=True,
        timeout=HANGS_S,
        check=False,
    )


def nmea_sentence(body: str) -> bytes:
    """Return a sentence with its checksum (NMEA 0183: exclusive or of the bytes between $ and *)."""
    return f"${body}*{reduce(xor, body.encode()):02X}\r\n".encode()


START_NS = 1_800_000_000_000_000_000
INFO = SessionInfo("flight-20261121T100000Z-ab12", "swath test", "host", "boot", START_NS, 1000)
SCANNER_CHANNEL = ChannelSpec("/scanner/left/raw", "x-swath-udp", {"protocol": "srep"}, None, "scanner")
ROVER_CHANNEL = ChannelSpec("/gnss/rover/raw", "x-swath-serial", {"protocol": "nmea"}, None, "other")
EVENTS_CHANNEL = ChannelSpec("/events", "json", {}, "swath.Event", "other")
Content = dict[str, list[tuple[int, bytes]]]


def write_part(
    path: Path, *, part: int = 0, compression: str = "auto", blocks: int = 60, finish: bool = True
) -> Content:
    """Write a part with two chunk classes and return its content."""
    rng = np.random.default_rng(part)
    content: Content = {"/scanner/left/raw": [], "/gnss/rover/raw": [], "/events": []}
    writer = PartWriter(path, INFO, part, compression=compression)
    writer.add_attachment("config.toml", "application/toml", b"[session]\n", START_NS)
    for channel_id, spec in enumerate((SCANNER_CHANNEL, ROVER_CHANNEL, EVENTS_CHANNEL), start=1):
        writer.add_channel(channel_id, spec)
    for number in range(blocks):
        base = START_NS + (part * 1000 + number) * 4_000_000
        units = rng.integers(0, 256, (20, 1206), dtype=np.uint8)
        times = base + np.arange(20, dtype=np.int64) * 200_000
        writer.add(encode_block(1, number * 20, times, units))
        content["/scanner/left/raw"] += [(int(t), u.tobytes()) for t, u in zip(times, units, strict=True)]
        read = rng.integers(0, 256, (1, 10 + number), dtype=np.uint8)
        writer.add(encode_block(2, number, np.array([base + 1000], dtype=np.int64), read))
        content["/gnss/rover/raw"].append((base + 1000, read.tobytes()))
        if number % 10 == 9:
            event = {"time_ns": base, "severity": "info", "source": "test", "code": "tick", "text": str(number)}
            block = encode_json(3, number // 10, base + 2000, event)
            writer.add(block)
            content["/events"].append((base + 2000, bytes(block.data)[31:]))
            writer.flush()
    if finish:
        writer.finish()
    else:
        writer.flush()
        writer.close()
    return content


def mcap_doctor(path: Path) -> subprocess.CompletedProcess[str]:
    """Check a file with `pymcap-cli doctor`."""
    command = [str(Path(sys.executable).parent / "pymcap-cli"), "doctor", str(path)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def scanner(port: int, options: str = "") -> str:
    """Return the configuration of a scanner that sends to a port of this host."""
    return f'[scanner.left]\ntransport = "udp:127.0.0.1:{port}{options}"\nprotocol = "srep"\nmirror_factor = 1.0\n'


class Numbers:
    """A sender of numbered datagrams to one port, from one processor, so that their order is kept."""

    def __init__(self, port: int) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.port = port
        self.sent = 0

    def send(self, count: int, pause_s: float = 0.0) -> None:
        """Send the next datagrams."""
        with one_processor():
            for _ in range(count):
                self._socket.sendto(self.sent.to_bytes(8, "little") + bytes(1198), ("127.0.0.1", self.port))
                self.sent += 1
                if pause_s:
                    time.sleep(pause_s)

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


SREP = """
[scanner.left]
transport = "udp:127.0.0.1:{port}"
protocol = "srep"
mirror_factor = 1.0
"""
ROVER_CONFIG = """
[gnss.rover]
transport = "serial:{path}?baud=921600"
protocol = "nmea"
pps = "main"
[pps.main]
source = "fixed:{fifo}"
"""


class Pty:
    """A serial port whose other end the test holds; the link is the device's name under udev."""

    def __init__(self, link: Path) -> None:
        self.master, self.slave = os.openpty()
        tty.setraw(self.slave)
        self.link = link
        link.unlink(missing_ok=True)
        link.symlink_to(os.ttyname(self.slave))

    def write(self, data: bytes) -> None:
        """Send bytes from the device."""
        os.write(self.master, data)

    def unplug(self) -> None:
        """Remove the device."""
        self.link.unlink(missing_ok=True)
        os.close(self.slave)
        os.close(self.master)


def nmea_zda(second: int) -> bytes:
    """Return a ZDA sentence at a second of the day."""
    body = f"GPZDA,{second // 3600:02d}{second // 60 % 60:02d}{second % 60:02d}.00,21,11,2026,00,00"
    checksum = 0
    for byte in body.encode():
        checksum ^= byte
    return f"${body}*{checksum:02X}\r\n".encode()


Array = NDArray[Any]
SIGMAS = ("sigma_easting", "sigma_northing", "sigma_height")
EAST_M, NORTH_M = 500_000.0, 5_200_000.0


def plane(x: Array, y: Array) -> Array:
    """Return heights of a slope of about 8 degrees."""
    return np.asarray(400.0 + 0.12 * (x - EAST_M) - 0.07 * (y - NORTH_M))


def lattice(west_m: float, south_m: float, width_m: float, height_m: float, spacing_m: float) -> tuple[Array, Array]:
    """Return places in order, `1 / spacing²` a square metre; none lies on the edge of a cell."""
    x, y = np.meshgrid(
        np.arange(west_m + 0.51 * spacing_m, west_m + width_m, spacing_m),
        np.arange(south_m + 0.49 * spacing_m, south_m + height_m, spacing_m),
        indexing="ij",
    )
    return x.ravel(), y.ravel()


def write_laz(
    path: Path,
    x: Array,
    y: Array,
    z: Array,
    strip: int | Array = 1,
    *,
    crs: CRS | None = None,
    sigma_m: tuple[Array | float, ...] | None = None,
    point_format: int = 6,
    scale: float = 0.0001,
    adjusted: bool = True,
    **columns: Array | int,
) -> Path:
    """Write a file of points; all are single returns unless the columns say otherwise.

    Its header says that GPS times are adjusted standard ones, or else seconds of the week.
    """
    header = laspy.LasHeader(point_format=point_format, version="1.4" if point_format > 5 else "1.2")
    header.global_encoding.gps_time_type = laspy.header.GpsTimeType(int(adjusted))
    header.scales, header.offsets = np.full(3, scale), np.floor([x.min(), y.min(), 0.0])
    if crs is not None:
        header.add_crs(crs)
    for name in SIGMAS if sigma_m else ():
        header.add_extra_dim(laspy.ExtraBytesParams(name, "u2", scales=np.array([1e-4]), offsets=np.array([0.0])))
    made = laspy.LasData(header)
    made.x, made.y, made.z = x, y, z
    made.point_source_id = np.broadcast_to(np.asarray(strip, np.uint16), x.shape)
    for name, value in ({"return_number": 1, "number_of_returns": 1} | columns).items():
        made[name] = np.broadcast_to(np.asarray(value), x.shape)
    for name, sigma in zip(SIGMAS, sigma_m or (), strict=False):
        made[name] = np.broadcast_to(np.asarray(sigma, float), x.shape)
    made.write(path)
    return path


def digests(output: Path) -> dict[str, str]:
    """Return the SHA-256 of each file of a folder, by name."""
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in sorted(output.iterdir())}
