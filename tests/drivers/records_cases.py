"""Makes frames of protocol ``records`` of every kind, and the fixtures of it."""

from __future__ import annotations

import gzip
import struct
from pathlib import Path
from typing import Any

import numpy as np

from swath.drivers.captures.pcap.writer import FILE_HEADER, NOBODY, pcap_frames
from swath.drivers.record_frames import ROWS, RowKind, Scale, encode_frame

START_NS = 1_400_000_000_000_000_000  # GPS time
POSIX_NS = START_NS + 315_964_800_000_000_000 - 18_000_000_000
FOLDER = Path(__file__).parents[2] / "fixtures/records"


def rows_of(kind: RowKind, count: int, start_ns: int = START_NS, seed: int = 0) -> Any:
    """Return rows with plausible content, 40 ms apart."""
    rng = np.random.default_rng(seed + kind)
    rows = np.zeros(count, ROWS[kind])
    for name in rows.dtype.names or ():
        column = rows[name]
        if column.dtype.kind == "f":
            rows[name] = rng.uniform(0.1, 1.0, column.shape)
    rows["time_ns"] = start_ns + 40_000_000 * np.arange(count)
    texts = {"antenna": b"primary", "message": b"BESTPOS", "channel": b"EVENT1"}
    numbers = {"fix_type": 4, "valid": 1, "satellites": 17, "leap_seconds": 18, "count": 3, "pps_time_ns": -1}
    numbers |= {"return_number": 1, "number_of_returns": 1, "status": 3}
    for name, value in (texts | numbers).items():
        if name in (rows.dtype.names or ()):
            rows[name] = value if isinstance(value, int) or rows.dtype[name].kind == "S" else 2
    return rows


def stream() -> bytes:
    """Return a stream of receiver and inertial unit, with every kind, scale and some foreign bytes."""
    pieces = []
    for step in range(12):
        at_ns = step * 1_000_000_000
        for kind in (RowKind.TIME, RowKind.FIX, RowKind.HEADING, RowKind.SAMPLE, RowKind.SOLUTION, RowKind.MARK):
            scale = Scale.UTC if step % 3 == 1 else Scale.COUNTER if step == 5 else Scale.GPS
            start_ns = {Scale.GPS: START_NS, Scale.UTC: POSIX_NS, Scale.COUNTER: 0}[scale] + at_ns
            rows = rows_of(kind, 5 if kind is RowKind.SAMPLE else 1 + step % 2, start_ns, step)
            if step == 7 and kind is RowKind.FIX:  # a velocity alone
                rows["lat_rad"] = rows["lon_rad"] = rows["height_m"] = np.nan
                rows["position_cov_l"] = np.nan
            if step == 8:
                rows["time_ns"][0] = -1
            pieces.append(encode_frame(kind, rows, scale, step % 4))
        if step == 4:
            pieces.append(b"foreign bytes SwRc")
    return b"".join(pieces)


def datagrams() -> list[tuple[int, bytes]]:
    """Return datagrams of a scanner with their times."""
    found = []
    for step in range(24):
        kind = RowKind.POINT if step % 2 else RowKind.RETURN
        rows = rows_of(kind, 20, POSIX_NS + step * 50_000_000, step)
        rows["time_ns"] = rows["time_ns"][0] + 2_000_000 * np.arange(20)
        if step == 9:
            rows["x_m"][3:5], rows["y_m"][3:5], rows["z_m"][3:5] = (0.0, np.nan), 0.0, 0.0
        found.append((POSIX_NS + step * 50_000_000 + 45_000_000, encode_frame(kind, rows, Scale.UTC)))
    return found


def by_hand() -> bytes:
    """Return a frame with one point, laid out by the table of docs/devices/records.md, but for its CRC."""
    point = struct.pack("<q4fHBBB3x", START_NS, 3.0, -4.0, 12.0, 77.0, 5, 1, 2, 2)
    return b"SwRc" + struct.pack("<BBBBII", 1, 8, 0, 0, 16 + len(point) + 4, 1) + point


def write_fixtures() -> None:
    """Write the files of fixtures/records."""
    FOLDER.mkdir(exist_ok=True)
    (FOLDER / "stream.bin.gz").write_bytes(gzip.compress(stream(), mtime=0))
    content = FILE_HEADER
    for number, (time_ns, data) in enumerate(datagrams()):
        times_ns, rows = np.array([time_ns], np.int64), np.frombuffer(data, np.uint8).reshape(1, -1)
        content += pcap_frames(times_ns, number, NOBODY, ("127.0.0.1", 9000), rows).tobytes()
    (FOLDER / "points.pcap.gz").write_bytes(gzip.compress(content, mtime=0))
