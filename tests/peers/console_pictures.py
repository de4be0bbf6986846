"""Makes the pictures of docs/console.md: ``python -m tests.peers.console_pictures [FOLDER]`` (``make pictures``).

The virtual aircraft flies `small` into a log, with a scanner that is silent for two seconds on the first line. The log
grows again as in flight, beside live and the console. In the third line it stands still while Chromium opens the pages,
and grows slowly while they are photographed, so that live has no need to skip anything on a busy computer.
"""

from __future__ import annotations

import io
import json
import os
import shutil
import sys
import tempfile
import time
import uuid
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image
from playwright.sync_api import Page, Playwright, sync_playwright

from swath.daemon.config import load_config
from swath.daemon.console.replaying import GrowingCopy
from swath.daemon.log.reader import open_logs
from swath.daemon.simulate.into_log import fly_into_log
from swath.sim.companions import companion_files, config_text, default_wires
from swath.sim.fly import VirtualFlight
from swath.sim.plan.plan import Plan, load_plan
from swath.sim.site import Site, geodetic_from_e
from tests.builders import ROOT, running
from tests.daemon.console.builders import Asked, console

PICTURES = ROOT / "docs/console"
QUALITY = 82
AREA = ((-330.0, -230.0), (330.0, 230.0))  # metres east and north
PACE, SLOW_PACE = 2.0, 0.3
SETTLED_S = 8.0  # that open pages show before they are photographed
FLOWN = 0.4  # of the last line, when the pictures are made
LONGEST_S = 600.0


@dataclass(frozen=True)
class Shot:
    """A picture: its name, page and panel, the size of the screen, the light, and what to press before."""

    name: str
    size: tuple[int, int]
    scheme: str
    path: str = "/"
    panel: str = ""
    press: tuple[str, ...] = ()
    layer: str = "height"


SHOTS = (
    Shot("map-1920x1080-day", (1920, 1080), "light", panel="Lines"),
    Shot("data-1920x1080-night", (1920, 1080), "dark", panel="Data", layer="density"),
    Shot("data-1280x800-day", (1280, 800), "light", panel="Data", layer="difference"),
    Shot("sensors-1280x800-night", (1280, 800), "dark", panel="Sensors", press=("Track up",)),
    Shot("lines-800x1280-day", (800, 1280), "light", panel="Lines"),
    Shot("data-800x1280-night", (800, 1280), "dark", panel="Data"),
    Shot("pilot-1280x800", (1280, 800), "dark", path="/pilot"),
    Shot("landing-1280x800-day", (1280, 800), "light", path="/landing"),
)


class Paused(GrowingCopy):
    """A log that grows, and stands still while ``paused``."""

    paused = False

    def _wait(self, log_time_ns: int) -> None:
        super()._wait(log_time_ns)
        while self.paused and not self._ended.wait(0.1):
            self._clock = None


def fly(folder: Path) -> Path:
    """Fly into a log, whose configuration has the plan; return its folder."""
    planned = load_plan("small")
    silent = [{"source": "scanner/left", "kind": "silent", "at_s": _middle_s(planned), "for_s": 2.0}]
    plan = planned.changed({"fault": silent})
    flight = VirtualFlight(plan, None)
    for name, data in companion_files(plan, flight.site, flight.scene).items():
        (folder / name).write_bytes(data)
    (folder / "plan.toml").write_text(planned.text)
    (folder / "area.geojson").write_text(area_text(flight.site))
    text = config_text(plan, default_wires(plan), "logs").replace("nominal.toml", "true.toml")
    text = text.replace('file = "plan.toml"', 'file = "plan.toml"\narea = "area.geojson"')
    text += '[plan.wanted]\nquality_level = "QL1"\noverlap_percent = 10\ndensity_per_m2 = 2\n'
    (folder / "swath.toml").write_text(text)
    fly_into_log(load_config(folder / "swath.toml"), folder / "logs", flight, plan.tables.flight.seed)
    return folder / "logs"


def area_text(site: Site) -> str:
    """Return the ground between the first and the last line as GeoJSON."""
    (west, south), (east, north) = AREA
    corners = np.array([(west, south), (east, south), (east, north), (west, north), (west, south)])
    lat, lon, _ = geodetic_from_e(site.e_from_site(np.column_stack([corners, np.zeros(5)])))
    ring = np.degrees(np.column_stack([lon, lat])).tolist()
    return json.dumps({"type": "Polygon", "coordinates": [ring]})


def _middle_s(plan: Plan) -> float:
    """Return the time of the middle of the first line."""
    first = VirtualFlight(plan, None, 1.0).trajectory.lines[0]
    return 0.5 * (first.start_s + first.end_s)


def prepare(page: Page, asked: Asked, shot: Shot) -> None:
    """Open the page and press what the picture shows."""
    page.goto(asked.url + shot.path)
    if shot.panel:
        page.get_by_role("tab", name=shot.panel).click()
        page.get_by_label("Show").select_option(shot.layer)
    for name in shot.press:
        page.get_by_role("button", name=name, exact=True).click()


def wait_for_the_last_line(asked: Asked) -> None:
    """Wait until most of the last line is flown."""
    until_s = time.monotonic() + LONGEST_S
    for found in asked.feed():
        lines = found["lines"].get("lines") or [{}]
        if lines[-1].get("state") == "flying" and lines[-1].get("flown_fraction", 0.0) > FLOWN:
            return
        if time.monotonic() > until_s:
            raise SystemExit(f"the last line is not flown after {LONGEST_S:.0f} s: {found['header']}")


def keep(page: Page, path: Path) -> None:
    """Write what a page shows as WebP."""
    Image.open(io.BytesIO(page.screenshot())).convert("RGB").save(path, "WEBP", quality=QUALITY, method=6)


def main(target: Path) -> None:
    """Make all pictures."""
    program = shutil.which("chromium") or shutil.which("chromium-browser")
    if program is None:
        raise SystemExit("there is no chromium: make test-peers installs it")
    target.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as name, sync_playwright() as playwright:
        logs = fly(Path(name))
        folder = Path(name) / "grown"
        folder.mkdir()
        os.environ["SWATH_BOOT_ID"] = str(uuid.uuid4())  # of no log: time is the log's and not this computer's
        (session,) = open_logs([logs])
        status = folder / "live/live.json"
        growing = Paused(session, folder, PACE, status.exists)
        with running("live", "--accept-verdict", "--json", folder), console(folder) as (asked, _):
            growing.start()
            try:
                wait_for_the_last_line(asked)
                photograph(playwright, program, asked, target, growing)
            finally:
                growing.close()


def photograph(playwright: Playwright, program: str, asked: Asked, target: Path, growing: Paused) -> None:
    """Make the pictures of what the console shows now; opening pages takes long on a busy computer."""
    growing.paused, growing._pace = True, SLOW_PACE
    browser = playwright.chromium.launch(executable_path=program, args=["--no-sandbox"])
    pages = []
    for shot in SHOTS:
        width, height = shot.size
        context = browser.new_context(
            viewport={"width": width, "height": height}, color_scheme="dark" if shot.scheme == "dark" else "light"
        )
        pages.append((shot, context.new_page()))
        prepare(pages[-1][1], asked, shot)
    growing.paused = False
    time.sleep(SETTLED_S)
    for shot, page in pages:
        keep(page, target / f"{shot.name}.webp")
    browser.close()


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else PICTURES)
