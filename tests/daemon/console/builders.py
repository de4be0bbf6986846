"""Makes what the console's tests share: requests to a running console, and a map of tiles."""

from __future__ import annotations

import http.client
import io
import json
import math
import select
import socket
import sqlite3
import ssl
import subprocess
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from pyproj import Transformer

from swath.daemon.processing.live.frame import LocalFrame
from swath.daemon.processing.live.tiles import Head, TileFolder, blank_tile
from tests.builders import running
from tests.daemon.rig import HANGS_S

WEB_ZOOM, WEB_REACH = 17, 3  # of the tiles of a made-up map, and how many there are to each side of a frame's origin
WORLD_M = 2.0 * math.pi * 6_378_137.0
FOLD = 250  # a colour rises by one a pixel up to here, and falls again


@dataclass
class Answered:
    """A console's answer."""

    status: int
    headers: Mapping[str, str]
    body: bytes

    def plain(self) -> Any:
        """Return the body's JSON."""
        return json.loads(self.body)


@dataclass
class Asked:
    """A console that can be asked; with TLS if it listens beyond this computer."""

    port: int
    secure: bool = False

    @property
    def url(self) -> str:
        return f"http{'s' if self.secure else ''}://127.0.0.1:{self.port}"

    def _connection(self) -> http.client.HTTPConnection:
        if not self.secure:
            return http.client.HTTPConnection("127.0.0.1", self.port, timeout=HANGS_S)
        context = ssl.create_default_context()
        context.check_hostname, context.verify_mode = False, ssl.CERT_NONE  # no authority knows its certificate
        return http.client.HTTPSConnection("127.0.0.1", self.port, timeout=HANGS_S, context=context)

    def get(self, path: str, **headers: str) -> Answered:
        return self.ask("GET", path, None, headers)

    def post(self, path: str, what: Any, **headers: str) -> Answered:
        """Ask as the console's own pages do."""
        own = {"Origin": self.url, "Content-Type": "application/json"}
        return self.ask("POST", path, json.dumps(what).encode(), own | headers)

    def ask(self, method: str, path: str, body: bytes | None, headers: Mapping[str, str]) -> Answered:
        connection = self._connection()
        named = {name.replace("_", "-"): value for name, value in headers.items()}
        try:
            connection.request(method, path, body, named)
            found = connection.getresponse()
            return Answered(found.status, {key.lower(): value for key, value in found.getheaders()}, found.read())
        finally:
            connection.close()

    def feed(self, **headers: str) -> Iterator[dict[str, Any]]:
        """Yield snapshots as they come."""
        connection = self._connection()
        try:
            connection.request("GET", "/feed", headers=headers)
            answer = connection.getresponse()
            assert answer.status == 200, answer.read()
            event = ""
            while True:
                line = answer.readline().decode().rstrip("\n")
                if line.startswith("event: "):
                    event = line[7:]
                elif line.startswith("data: ") and not event:
                    yield json.loads(line[6:])
                elif not line:
                    event = ""
        finally:
            connection.close()

    def snapshot(self) -> dict[str, Any]:
        """Return the newest snapshot."""
        return next(self.feed())


@contextmanager
def console(
    *words: str | Path, address: str = "127.0.0.1", port: int = 0
) -> Iterator[tuple[Asked, subprocess.Popen[str]]]:
    """Run a console, at a free port unless one is given, and wait until it answers."""
    if not port:
        with socket.socket() as sock:
            sock.bind(("127.0.0.1", 0))
            port = sock.getsockname()[1]
    with running("console", *words, "--listen", f"{address}:{port}", output=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert select.select([process.stdout], [], [], HANGS_S)[0], "the console says nothing"
        scheme = "http" if address == "127.0.0.1" else "https"
        assert process.stdout.readline().strip() == f"{scheme}://{address}:{port}/", process.communicate()
        asked, until_s = Asked(port, scheme == "https"), time.monotonic() + HANGS_S
        while True:
            try:
                asked.get("/about")
                break
            except OSError:
                assert process.poll() is None, process.communicate()
                assert time.monotonic() < until_s, "the console does not answer"
                time.sleep(0.05)
        yield asked, process


def write_map(
    live: Path, tiles: Mapping[tuple[int, int], Mapping[str, NDArray[Any]]], cell_m: float = 1.0, **about: Any
) -> None:
    """Write a map of tiles, each by stored layers (`SIDE`, `SIDE`), rows from the south; the others are zero."""
    live.mkdir(parents=True, exist_ok=True)

    def packed(layers: Mapping[str, NDArray[Any]], head: Head) -> bytearray:
        data, stored = blank_tile(head)
        for name, values in layers.items():
            stored[name][:] = values
        return data

    made = [(place, partial(packed, layers)) for place, layers in tiles.items()]
    TileFolder(live).write(made, {"cell_m": cell_m} | about)


def colours_of(columns: NDArray[np.float64], rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a colour (…, 3) that tells a pixel's place by a slope of one a pixel."""
    return np.stack([np.abs((one + FOLD) % (2 * FOLD) - FOLD) for one in (columns, rows, columns + rows)], axis=-1)


def web_tiles(frame: LocalFrame) -> dict[tuple[int, int], NDArray[np.uint8]]:
    """Return the tiles around the frame's origin by column and row from the north-west."""
    x, y = Transformer.from_crs("EPSG:32632", "EPSG:3857").transform(*frame.origin[:2])
    middle = [math.floor((0.5 + one / WORLD_M) * (1 << WEB_ZOOM)) for one in (x, -y)]
    made = {}
    for column in range(middle[0] - WEB_REACH, middle[0] + WEB_REACH + 1):
        for row in range(middle[1] - WEB_REACH, middle[1] + WEB_REACH + 1):
            across, down = np.meshgrid(256 * column + np.arange(256.0), 256 * row + np.arange(256.0))
            made[column, row] = colours_of(across, down).astype(np.uint8)
    return made


def as_file(pixels: NDArray[np.uint8], kind: str) -> bytes:
    """Return pixels (rows, columns, 3) as a file of a kind, without loss."""
    file = io.BytesIO()
    Image.fromarray(pixels).save(
        file, kind, **({"lossless": True, "exact": True, "method": 0} if kind == "WEBP" else {})
    )
    return file.getvalue()


def write_mbtiles(
    path: Path, frame: LocalFrame, kind: str = "png", attribution: str = "<a href='x'>© Maps</a>"
) -> None:
    """Write a database of tiles whose colours tell their place by `colours_of`."""
    with sqlite3.connect(path) as base:
        base.execute("CREATE TABLE metadata (name text, value text)")
        base.execute("CREATE TABLE tiles (zoom_level integer, tile_column integer, tile_row integer, tile_data blob)")
        base.executemany("INSERT INTO metadata VALUES (?, ?)", [("format", kind), ("attribution", attribution)])
        for (column, row), pixels in web_tiles(frame).items():
            data = as_file(pixels, "PNG") if kind == "png" else b"\x1f\x8b\x08 of vectors"
            base.execute("INSERT INTO tiles VALUES (?, ?, ?, ?)", (WEB_ZOOM, column, (1 << WEB_ZOOM) - 1 - row, data))
    base.close()


def verdict(*, name: str = "9", note: str = "") -> dict[str, Any]:
    """Return a verdict before landing as live writes it: one line good, one to be flown again, a gap beside it."""
    gap = {
        "number": 1,
        "east_m": 30.0,
        "north_m": 12.0,
        "lat_deg": 47.5,
        "lon_deg": 8.9,
        "area_m2": 420.0,
        "width_m": 9.0,
        "length_m": 50.0,
        "line": name,
        "under": [],
        "grave": True,
        "text": f"420 m², 9 m wide, nearest to line {name}",
    }
    checks = [
        ("lines", "Lines", "again", f"1 good, line {name} to be flown again", [f"line {name}: {note}"]),
        ("gaps", "Gaps", "again", "1 of 100 m² and more", [gap["text"]]),
        ("overlap", "Overlap", "good", "as wanted", []),
        ("base", "Base data", "unknown", "no [corrections] are configured", [f"gnss/rover: {note}"]),
        ("static", "Standing still", "open", "after landing stand still for 60 s", []),
    ]
    accepted = {"verdict": "accepted", "note": note, "time_ns": 5}
    return {
        "version": 1,
        "session_id": "flight-1",
        "plan": "plan.kml",
        "head": {"aircraft": "HB-XYZ", "author": "", "crs": "", "calibrations": ["left, nominal"]},
        "log_time_ns": 1_781_514_000_000_000_000,
        "flown_gps_ns": [1_465_549_218_000_000_000, 1_465_549_712_000_000_000],
        "has_ended": False,
        "state": "again",
        "sentence": f"Fly again: line {name}",
        "checks": [dict(zip(("code", "title", "state", "text", "details"), one, strict=True)) for one in checks],
        "area": {"planned": True, "wanted_m2": 5e5, "covered_m2": 4.9e5, "cell_m": 2.0, "gaps": [gap], "more_gaps": 3,
                 "density_per_m2": {"p05": 4.0, "p50": 6.0}},
        "lines": [
            {"name": "4", "state": "remarks", "flown_fraction": 1.0, "why": ["speed"], "overruled": accepted},
            {"name": name, "state": "again", "flown_fraction": 0.5, "why": ["GNSS lost"], "overruled": None},
        ],
    }  # fmt: skip
