"""Measure what the operator's console costs at the end of a long flight, with ten pages open.

python -m benchmarks.inflight.console [--seconds 20] [--clients 10] [--tiles 1600]

A folder of live's files is made up: 1,600 tiles of 128 by 128 cells (104 km² in cells of 2 m), 200 lines. Then eight
tiles, the lines and the status change each second, as live does it, while clients read the feed as pages do and ask
for the tiles of the map that have changed. No recorder runs beside it. Figures are processor time in per cent of a core
and resident memory of the console's process, and times of a client that connects anew: until the page and all that it
names have come, and until the first snapshot has. A browser's own time is not in them.
"""

from __future__ import annotations

import argparse
import http.client
import json
import math
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from swath.daemon.processing.live.files import exchange_file
from swath.daemon.processing.live.frame import LocalFrame
from swath.daemon.processing.live.tiles import Head, TileFolder, blank_tile
from swath.georef.geodesy.earth import e_from_geodetic

PORT = 8479
LINES, CELL_M, CHANGED = 200, 2.0, 8
PAGE = (
    "/",
    "/assets/console.js",
    "/assets/feed.js",
    "/assets/map.js",
    "/assets/console.css",
    "/assets/leaflet/leaflet.js",
)
LIMITS = {
    "processor, % of a core": 10.0,
    "memory, MB": 300.0,
    "page and what it names, s": 3.0,
    "first snapshot, s": 2.0,
}


class MadeFlight:
    """Files as live writes them."""

    def __init__(self, live: Path, tiles: int) -> None:
        self.live, self.folder = live, TileFolder(live)
        side = math.isqrt(tiles)
        self.places = [(column, row) for row in range(side) for column in range(side)]
        position_e = e_from_geodetic(np.radians(47.0), np.radians(9.0), 500.0)
        self.about: dict[str, Any] = {"cell_m": CELL_M, "placement": LocalFrame(position_e, None).placement()}
        self.draw = np.random.default_rng(1)
        self.text = "bank 12° over the limit of 10°, 100 to 400 m"
        self.write(self.places)

    def write(self, places: list[tuple[int, int]]) -> None:
        """Write some tiles, the lines and the status."""
        self.at = places[0]
        self.folder.write([(place, self._tile) for place in places], self.about)
        reason = {"code": "bank", "grave": False, "text": self.text, "value": 12.0}
        lines = [
            {"name": str(number), "state": "remarks", "reasons": [reason], "flown_fraction": 1.0, "passes": 1}
            for number in range(LINES)
        ]
        drawn = {str(n): [[47.0 + n * 4e-4, 9.0, 1500.0], [47.0 + n * 4e-4, 9.13, 1500.0]] for n in range(LINES)}
        told = {"plan": "made", "lines": lines, "current": None, "geometry": {"lines": drawn, "area": []}}
        exchange_file(self.live, "lines.json", json.dumps(told).encode())
        exchange_file(self.live, "live.json", json.dumps({"points": {}, "tiles": {"sequence": 1}}).encode())

    def _tile(self, head: Head) -> bytearray:
        data, layers = blank_tile(head)
        layers["points"][:] = self.draw.integers(0, 40, layers["points"].shape)
        layers["height"][:] = 500.0 + self.draw.random(layers["height"].shape)
        return data


def get(path: str) -> tuple[int, int]:
    """Return status and size of an answer."""
    connection = http.client.HTTPConnection("127.0.0.1", PORT, timeout=30)
    connection.request("GET", path)
    answer = connection.getresponse()
    return answer.status, len(answer.read())


def first_snapshot() -> float:
    """Return the seconds until a client that connects has the whole state."""
    began_s = time.monotonic()
    connection = http.client.HTTPConnection("127.0.0.1", PORT, timeout=30)
    connection.request("GET", "/feed")
    answer = connection.getresponse()
    while not answer.readline().startswith(b"data: {"):
        pass
    connection.close()
    return time.monotonic() - began_s


def page_seconds() -> float:
    """Return the seconds until the page and what it names have come, one after the other."""
    began_s = time.monotonic()
    for path in PAGE:
        get(path)
    return time.monotonic() - began_s


def follow(until_s: float, flight: MadeFlight) -> None:
    """Read the feed as a page does, and ask for the map's squares that have changed after each snapshot."""
    connection = http.client.HTTPConnection("127.0.0.1", PORT, timeout=30)
    connection.request("GET", "/feed")
    answer = connection.getresponse()
    number = 0
    while time.monotonic() < until_s:
        if answer.readline().startswith(b"data: {"):
            number += 1
            column, row = flight.at
            for x in (column // 4, column // 4 + 1):  # at 4 m a pixel, a square is four tiles wide
                status, size = get(f"/tiles/density/-2/{x}/{-1 - row // 4}.png?s={number}")
                assert status == 200, status
                assert size > 1000, "the map is not painted"
    connection.close()


def measure(seconds: float, clients: int, tiles: int) -> dict[str, float]:
    """Return the figures by the names of `LIMITS`."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "live").mkdir()
        flight = MadeFlight(folder / "live", tiles)
        words = [sys.executable, "-m", "swath.daemon.cli.main", "console", str(folder), "--listen", f"127.0.0.1:{PORT}"]
        with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as process:
            try:
                assert process.stdout is not None
                process.stdout.readline()
                until_s = time.monotonic() + 60.0
                while time.monotonic() < until_s:
                    try:
                        get("/about")
                        break
                    except OSError:
                        time.sleep(0.1)
                console = psutil.Process(process.pid)
                end_s = time.monotonic() + seconds
                readers = [threading.Thread(target=follow, args=(end_s, flight)) for _ in range(clients)]
                for reader in readers:
                    reader.start()
                time.sleep(3.0)  # the whole map has been read
                before, began_s, step = console.cpu_times(), time.monotonic(), 0
                while time.monotonic() < end_s - 1.0:
                    flight.write([flight.places[(step + place) % len(flight.places)] for place in range(CHANGED)])
                    step += CHANGED
                    time.sleep(1.0)
                after, passed_s = console.cpu_times(), time.monotonic() - began_s
                used_s = after.user + after.system - before.user - before.system
                figures = (
                    100.0 * used_s / passed_s,
                    console.memory_info().rss / 1e6,
                    page_seconds(),
                    first_snapshot(),
                )
                for reader in readers:
                    reader.join()
                return dict(zip(LIMITS, figures, strict=True))
            finally:
                process.terminate()


def main() -> None:
    """Measure and print the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=20.0, help="duration of the measurement")
    parser.add_argument("--clients", type=int, default=10, help="pages that are open")
    parser.add_argument("--tiles", type=int, default=1600, help="tiles of the map")
    arguments = parser.parse_args()
    print(f"the console, {arguments.clients} clients, {arguments.tiles} tiles, {LINES} lines")
    for name, value in measure(arguments.seconds, arguments.clients, arguments.tiles).items():
        print(f"  {name:<28} {value:>8.2f}   limit {LIMITS[name]:g}")


if __name__ == "__main__":
    main()
