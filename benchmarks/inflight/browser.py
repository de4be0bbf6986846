"""Measure the operator's console in a real browser: pulse to painted cell, a page that opens, one that comes back.

python -m benchmarks.inflight.browser [--seconds 40] [--prf-hz 50000]

First the end of a long flight, made up as for `inflight.console`: seconds until Chromium shows the state, 200 lines and
all squares of the map in view, each time without anything kept from before; and, when the network is back after ten
seconds without it, until the page has the newest state again. Then the virtual aircraft flies straight to the east on
wires, in real time, beside recorder, live and console, while a page follows it. Each column of 2 m that the map's front
passes is timed from its pulse: GPS time and place by the device's INS in the log, and the host's clock by the IMU's
arrivals. The page's squares are looked at every 50 ms, which counts as delay. The browser has no graphics hardware.
"""

from __future__ import annotations

import argparse
import contextlib
import shutil
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from playwright.sync_api import Browser, Page, sync_playwright

import swath
from benchmarks.inflight.console import LINES, PORT, MadeFlight, get
from swath.daemon.processing.live.tiles import Placement, TileReader
from swath.georef.arrays import FloatArray

LIMITS = {
    "page ready, median s": 3.0,
    "page ready, longest s": 3.0,
    "whole again, longest s": 2.0,
    "pulse to painted cell, median s": 2.0,
    "pulse to painted cell, 95 % s": 2.0,
}
TIMES, TILES, OFFLINE_S = 5, 1600, 10.0
COLUMN_M = 2.0
PLAN = """
[flight]
name = "browser"
speed_mps = 60.0
[[line]]
name = "east"
from_m = [-1500, 0]
to_m = [3500, 0]
height_m = 800
[terrain]
height_m = 470
[gnss.rover]
ins = true
rate_hz = 5
[scanner.left]
prf_hz = {prf_hz}
"""
AIR_PORT = PORT - 1  # of the network that can be cut; as many digits
READY = """(count) => {
    const images = [...document.querySelectorAll("#map img[data-where]")];
    const whole = images.length > 0 && images.every((image) => image.complete && image.naturalWidth > 0);
    const rows = document.querySelectorAll("#lines-rows tr").length;
    return whole && rows === count && document.getElementById("state").textContent ? performance.now() : false;
}"""
AGAIN = """(text) => document.getElementById("lines-rows").textContent.includes(text)"""
SAMPLE = """() => {
    window.fronts = [];
    const seen = new WeakMap();
    const canvas = document.createElement("canvas");
    canvas.width = canvas.height = 256;
    const pen = canvas.getContext("2d", {willReadFrequently: true});
    setInterval(() => {
        for (const image of document.querySelectorAll("#map img[data-where]")) {
            if (!image.complete || !image.naturalWidth || seen.get(image) === image.src) continue;
            seen.set(image, image.src);
            pen.clearRect(0, 0, 256, 256);
            pen.drawImage(image, 0, 0);
            const {data} = pen.getImageData(0, 0, 256, 256);
            let last = -1;
            for (let i = 3; i < data.length; i += 4) if (data[i]) last = Math.max(last, ((i - 3) / 4) % 256);
            const [z, x] = image.dataset.where.split("/").map(Number);
            if (last >= 0) window.fronts.push([Date.now(), (x * 256 + last + 1) / 2 ** z]);
        }
    }, 50);
}"""


@contextlib.contextmanager
def run(*words: str | Path) -> Iterator[subprocess.Popen[bytes]]:
    """Run a command of swath, and end it with the block."""
    command = [sys.executable, "-m", "swath.daemon.cli.main", *map(str, words)]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        try:
            yield process
        finally:
            process.terminate()


def wait_for_console() -> None:
    """Wait until the console answers."""
    until_s = time.monotonic() + 60.0
    while time.monotonic() < until_s:
        with contextlib.suppress(OSError):
            get("/about")
            return
        time.sleep(0.1)
    raise SystemExit("the console does not answer")


def opened(browser: Browser, port: int = PORT) -> Page:
    """Return a page of the console that keeps nothing from pages before."""
    page = browser.new_context(viewport={"width": 1280, "height": 800}).new_page()
    page.goto(f"http://127.0.0.1:{port}/")
    return page


class Air:
    """A network between browser and console that can be cut: its connections end, and no new one comes about."""

    def __init__(self) -> None:
        self._ends: list[socket.socket] = []
        self._door: socket.socket | None = None

    def close(self) -> None:
        """Cut the network: end its connections."""
        for one in [*self._ends, *([self._door] if self._door else [])]:
            with contextlib.suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)
            one.close()
        self._ends, self._door = [], None

    def open(self) -> None:
        """Let the browser through."""
        self._door = socket.create_server(("127.0.0.1", AIR_PORT))
        threading.Thread(target=self._accept, args=(self._door,), daemon=True).start()

    def _accept(self, door: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while True:
                here, _ = door.accept()
                there = socket.create_connection(("127.0.0.1", PORT))
                self._ends += [here, there]
                for ends in ((here, there), (there, here)):
                    threading.Thread(target=self._carry, args=ends, daemon=True).start()

    @staticmethod
    def _carry(source: socket.socket, sink: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while data := source.recv(1 << 16):
                sink.sendall(data.replace(b"127.0.0.1:%d" % AIR_PORT, b"127.0.0.1:%d" % PORT))
            sink.shutdown(socket.SHUT_WR)


def large_flight(browser: Browser) -> dict[str, float]:
    """Return how long pages take at the end of a long flight."""
    ready, whole = [], []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "live").mkdir()
        flight = MadeFlight(folder / "live", TILES)
        with run("console", folder, "--listen", f"127.0.0.1:{PORT}"):
            wait_for_console()
            air = Air()
            for number in range(TIMES):
                air.open()
                page = opened(browser, AIR_PORT)
                found: Any = page.wait_for_function(READY, arg=LINES).json_value()
                ready.append(float(found) / 1000.0)
                air.close()
                page.wait_for_timeout(1000 * OFFLINE_S)
                assert page.locator("#state").text_content() == "CONSOLE SILENT", (
                    "the page hears the console without a network"
                )
                flight.text = f"bank {20 + number}° over the limit"
                flight.write(flight.places[number : number + 1])
                page.wait_for_timeout(2000)  # the console has read it
                began_s = time.monotonic()
                air.open()
                page.wait_for_function(AGAIN, arg=flight.text)
                whole.append(time.monotonic() - began_s)
                page.context.close()
                air.close()
    figures = float(np.median(ready)), max(ready), max(whole)
    return dict(zip(list(LIMITS)[:3], figures, strict=True))


def painted(browser: Browser, seconds: float, prf_hz: float) -> dict[str, float]:
    """Return how long it takes from a pulse to the painted cell, while the virtual aircraft flies on wires."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        plan, wires = folder / "plan.toml", folder / "wires"
        plan.write_text(PLAN.format(prf_hz=prf_hz))
        with run("sim", "fly", plan, "--wire", "-o", wires, "--seconds", str(seconds), "--wait", "300") as flying:
            until_s = time.monotonic() + 120.0
            while not (wires / "pps-main").exists() and time.monotonic() < until_s:
                time.sleep(0.1)
            config = wires / "swath.toml"
            config.write_text(config.read_text().replace(".nominal.toml", ".true.toml"))
            (wires / "logs").mkdir(exist_ok=True)
            live = run("live", config, "--accept-verdict", "--from-start")
            with live, run("console", config, "--listen", f"127.0.0.1:{PORT}"):
                wait_for_console()
                page = opened(browser)
                page.evaluate(SAMPLE)
                time.sleep(10.0)  # live has compiled, or found its loops
                with run("run", config) as recorder:
                    began_ms = 1000.0 * time.time()
                    flying.wait()
                    page.wait_for_timeout(3000)
                    fronts = np.array(page.evaluate("window.fronts"))
                    recorder.terminate()
                    recorder.wait()
                page.context.close()
        delays = _delays(wires / "logs", fronts, began_ms)
    figures = float(np.median(delays)), float(np.quantile(delays, 0.95))
    return dict(zip(list(LIMITS)[3:], figures, strict=True))


def _delays(logs: Path, fronts: FloatArray, began_ms: float) -> FloatArray:
    """Return the seconds (n,) from the pulse to the painted cell, of each column that the map's front has passed.

    Args:
        logs: of the flight.
        fronts: (m, 2) Unix time in milliseconds, and how far to the east a square was painted, metres.
        began_ms: Unix time of the recording's begin; squares that were painted before are not of it.
    """
    reader = TileReader(logs / "live")
    reader.refresh()
    placement = Placement.of(reader.index)
    assert placement is not None, "live has painted nothing"
    with swath.open(logs) as log:
        way, samples = log["gnss/rover"].solutions(), log["imu/main"].samples()
    known = (way["gps_ns"] > 0) & np.isfinite(way["lat_rad"])
    way = way[known]
    east_m = placement.local(np.degrees(np.stack([way["lat_rad"], way["lon_rad"]], axis=-1)))[:, 0]
    timed = samples[samples["gps_ns"] > 0]
    later_ns = float(np.quantile((timed["host_time_ns"] - timed["gps_ns"]).astype(np.float64), 0.05))
    pulse_ms = (way["gps_ns"] + later_ns) / 1e6
    fronts = fronts[(fronts[:, 0] > began_ms) & (fronts[:, 1] <= east_m.max())]
    first_m = float(fronts[0, 1])  # live has begun, and the laser is on
    columns = np.arange(np.ceil(first_m / COLUMN_M), fronts[:, 1].max() // COLUMN_M) * COLUMN_M
    reached = np.maximum.accumulate(fronts[:, 1])
    seen_ms = fronts[np.searchsorted(reached, columns + COLUMN_M), 0]
    found: FloatArray = (seen_ms - np.interp(columns, east_m, pulse_ms)) / 1000.0
    return found


def main() -> None:
    """Measure and print the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=40.0, help="of the flight on wires")
    parser.add_argument("--prf-hz", type=float, default=50_000.0, help="pulses a second")
    arguments = parser.parse_args()
    program = shutil.which("chromium") or shutil.which("chromium-browser")
    if program is None:
        raise SystemExit("there is no chromium: make test-peers installs it")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=["--no-sandbox"])
        print(f"Chromium {browser.version}, {arguments.prf_hz:g} pulses a second")
        found = large_flight(browser) | painted(browser, arguments.seconds, arguments.prf_hz)
        browser.close()
    for name, value in found.items():
        print(f"  {name:<32} {value:>8.2f}   limit {LIMITS[name]:g}")


if __name__ == "__main__":
    main()
