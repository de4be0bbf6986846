"""Tests what an operator reads in Chromium while the virtual aircraft flies on wires, with faults by script.

The aircraft flies straight to the east past five planned lines, and then turns too early.
"""

from __future__ import annotations

import contextlib
import json
import shutil
import subprocess
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Page, expect

from swath.sim.plan.plan import parse_plan
from swath.sim.site import Site, geodetic_from_e
from tests.builders import running
from tests.daemon.console.builders import Asked, console
from tests.daemon.processing.live.builders import config_of
from tests.daemon.rig import HANGS_S, Recorder, disk_of, session_table, wait_until
from tests.peers.conftest import Opened

pytestmark = pytest.mark.peers

WAIT_MS = 30_000.0
FLOWN = """
[flight]
name = "faults"
seed = 3
speed_mps = 60.0
lead_s = 2.5
turbulence = "light"
bank_max_deg = 35.0
[[line]]
name = "east"
from_m = [-1500, 0]
to_m = [650, 0]
height_m = 800
[[line]]  # only begun: the aircraft turns to it
name = "back"
from_m = [600, 1100]
to_m = [300, 1100]
height_m = 800
[[line]]  # never flown: so that there is ground where the turn tilts the swath to
name = "south"
from_m = [300, -600]
to_m = [1100, -600]
height_m = 800
[terrain]
height_m = 470
[gnss.rover]
ins = true
rate_hz = 5
[[gnss.rover.outage]]
at_s = 38.2
for_s = 4.0
[scanner.left]
prf_hz = 20000
on_lines_only = false
[[fault]]
source = "scanner/left"
kind = "silent"
at_s = 28.5
for_s = 5.0
"""
SECONDS = 64.0
# name: from and to, metres east, and how far to the north; the aircraft passes -1500 m at 10.5 s with 60 m/s
PLANNED = {"1": (-1490.0, -1070.0, 0.0), "2": (-1010.0, -590.0, 30.0), "3": (-530.0, 10.0, 0.0),
           "4": (70.0, 490.0, 0.0), "5": (540.0, 890.0, 0.0)}  # fmt: skip
AREA = ((-1480.0, -50.0), (480.0, 50.0))  # below lines 1 to 4
DISK_MB, RESERVE_MB = 6_000, 50
SILENT_M = 300.0  # flown while the scanner is silent
SHAPES = {"RECORDING": "●", "DEGRADED": "▲", "NOT RECORDING": "■"}
GLANCE = """() => {
    const text = (id) => document.getElementById(id).textContent;
    const cells = (row) => [...row.cells].map((one) => one.textContent);
    const rows = [...document.querySelectorAll("#lines-rows tr")].map(cells);
    return {state: text("state"), shape: text("state-shape"), sentence: text("sentence"), rows};
}"""


@dataclass
class Glances:
    """What a page showed, each time that it showed something else.

    Attributes:
        shown: ``state``, ``shape``, ``sentence`` and the ``rows`` of lines.
    """

    page: Page
    shown: list[dict[str, Any]] = field(default_factory=list)

    def look(self, is_enough: Callable[[], bool], what: str, timeout_s: float = 120.0) -> None:
        """Look five times a second until something is so."""
        until_s = time.monotonic() + timeout_s
        while not is_enough():
            found = self.page.evaluate(GLANCE)
            if not self.shown or found != self.shown[-1]:
                self.shown.append(found)
            assert time.monotonic() < until_s, (what, self.shown[-3:])
            self.page.wait_for_timeout(200)

    def words(self, line: str) -> list[str]:
        """Return the states of a line in words, in their order."""
        found = [row[1] for one in self.shown for row in one["rows"] if row[0] == line]
        return [word for word, before in zip(found, ["", *found], strict=False) if word != before]

    def reasons(self, line: str) -> str:
        """Return why a line is not simply good, as last shown."""
        return next(str(row[3]) for row in self.shown[-1]["rows"] if row[0] == line)

    def sentences(self, state: str) -> set[str]:
        """Return the sentences beside a state of the header."""
        return {str(one["sentence"]) for one in self.shown if one["state"] == state}


def planned_text() -> str:
    """Return lines and area as GeoJSON, by the simulator's own geometry."""
    site = Site.at(*parse_plan(FLOWN, Path()).tables.flight.origin_deg)

    def places(*points: tuple[float, float, float]) -> list[list[float]]:
        lat, lon, height = geodetic_from_e(site.e_from_site(np.array(points)))
        found: list[list[float]] = np.stack([np.degrees(lon), np.degrees(lat), height], axis=-1).tolist()
        return found

    features: list[dict[str, Any]] = [
        {"properties": {"name": name}, "geometry": {"type": "LineString", "coordinates": places(
            (begin, north, 800.0), (end, north, 800.0))}}
        for name, (begin, end, north) in PLANNED.items()
    ]  # fmt: skip
    (west, south), (east, north) = AREA
    ring = places(
        *((x, y, 800.0) for x, y in ((west, south), (east, south), (east, north), (west, north), (west, south)))
    )
    features.append({"properties": {}, "geometry": {"type": "Polygon", "coordinates": [ring]}})
    return json.dumps({"type": "FeatureCollection", "features": [{"type": "Feature"} | one for one in features]})


def configured(wires: Path, folder: Path, disk: Path) -> str:
    """Return the configuration that records the flight on a small disk, with the planned lines."""
    text = config_of(wires, folder).replace('file = "plan.toml"', 'file = "plan.geojson"')
    (folder / "plan.geojson").write_text(planned_text())
    head = session_table(disk, name='"faults"', reserve_mb=RESERVE_MB)
    wanted = '[plan.wanted]\nfix = "any"\ndensity_per_m2 = 0.5\noverlap_percent = 20\nstatic_s = 0\n'
    return text.replace(text[: text.index("[pps.main]")], head) + wanted


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Asked, Path, Callable[[], None]]]:
    """Prepare wires, recorder, live and console; the last value lets the flight begin."""
    folder = tmp_path_factory.mktemp("flight")
    wires, plan = folder / "wires", folder / "flown.toml"
    plan.write_text(FLOWN)
    fly = ("sim", "fly", plan, "--wire", "-o", wires, "--seconds", f"{SECONDS:g}", "--wait", f"{HANGS_S:g}")
    with disk_of(folder / "disk", DISK_MB) as disk, running(*fly):
        config = folder / "swath.toml"
        config.write_text(configured(wires, folder, disk))
        said = folder / "said"
        with (
            said.open("w") as output,
            running("live", config, "--accept-verdict", output=output),
            console(config) as (asked, _),
        ):
            wait_until(lambda: "waiting for a recording" in said.read_text(), "live waits")
            with contextlib.ExitStack() as recording:

                def begin() -> None:
                    recording.enter_context(Recorder(folder, config.read_text()))

                yield asked, disk, begin


def resize(disk: Path, size_mb: int) -> None:
    """Make a disk smaller, as if another program filled it, or larger again."""
    subprocess.run(["mount", "-o", f"remount,size={size_mb}m", str(disk)], check=True)


def test_faults_of_a_flight_are_told_and_judged_as_they_happen(
    flight: tuple[Asked, Path, Callable[[], None]], open_page: Callable[..., Opened]
) -> None:
    """What is expected follows from the script above; a good line is never told to be flown again on the way."""
    asked, disk, begin = flight
    opened = open_page(asked.url)
    glances = Glances(opened.page)
    begin()
    glances.look(lambda: glances.words("5")[-1:] == ["FLY AGAIN"], "line 5 is judged")
    resize(disk, shutil.disk_usage(disk).used // 1_000_000 + RESERVE_MB - 15)
    paused = "recording is paused until there is more space"
    glances.look(lambda: any(paused in one for one in glances.sentences("NOT RECORDING")), "the disk is full")
    resize(disk, DISK_MB)
    glances.look(lambda: glances.shown[-1]["state"] == "DEGRADED", "the disk has space again")

    assert all(one["shape"] == SHAPES[one["state"]] for one in glances.shown)
    assert "Everything is recording" in glances.sentences("RECORDING")
    assert "Everything is recording; fly again: 2, 3, 5" in glances.sentences("RECORDING")
    assert {f"scanner/left {what}" for what in ("silent for 4 s", "1000 missing in its sequence")} <= glances.sentences(
        "DEGRADED"
    )
    assert "units lost" in glances.shown[-1]["sentence"]
    flown = ["planned", "flying"]
    assert {name: glances.words(name) for name in PLANNED} == {
        "1": [*flown, "good"],
        "2": [*flown, "FLY AGAIN"],
        "3": [*flown, "FLY AGAIN"],
        "4": [*flown, "good, with remarks"],
        "5": [*flown, "FLY AGAIN"],
    }
    assert glances.reasons("1") == ""
    assert glances.reasons("2") == "30 m right of the line, over 20 m, on the whole line"
    assert glances.reasons("3").startswith("no returns from 100 to 400 m")  # the fault's 5 s at 60 m/s
    assert glances.reasons("4").startswith("no GNSS position for 4 s")
    assert glances.reasons("5").startswith("bank 32° over the limit of 10°, 200 to 350 m")
    assert_verdict(open_page(asked.url + "/landing").page)
    assert opened.errors == []


def assert_verdict(page: Page) -> None:
    """Ask for the verdict before landing, and read it; the gap is the way of the silence by the area's width."""
    page.get_by_role("button", name="Write into the log").click(timeout=WAIT_MS)
    expect(page.locator("#check-rows tr", has_text="Log")).to_contain_text("units lost: gnss/rover", timeout=WAIT_MS)
    expect(page.locator("#state")).to_have_text("FLY AGAIN")
    expect(page.locator("#sentence")).to_have_text("Fly again: lines 2, 3, 5")
    checks = page.locator("#check-rows tr")
    for title, answer in (("Lines", "■ fly again"), ("Gaps", "■ fly again"), ("Log", "▲ look at it")):
        expect(checks.filter(has=page.get_by_role("cell", name=title, exact=True))).to_contain_text(answer)
    expect(checks.first).to_contain_text("1 good, 1 with remarks, lines 2, 3, 5 to be flown again")
    states = ["good", "FLY AGAIN", "FLY AGAIN", "good, with remarks", "FLY AGAIN"]
    assert page.locator("#line-rows tr td:nth-child(2)").all_text_contents() == states
    (gap,) = page.locator("#gap-rows tr").all()
    number, size, _, line, *_ = gap.locator("td").all_text_contents()
    assert (number, line) == ("1", "3")
    assert float(size.removesuffix(" ha")) == pytest.approx(SILENT_M * (AREA[1][1] - AREA[0][1]) / 1e4, rel=0.1)
