"""Tests the console's pages in Chromium: read and pressed as a person would, and looked at by their pixels."""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest
from axe_playwright_python.sync_playwright import Axe
from numpy.typing import NDArray
from PIL import Image
from playwright.sync_api import Page, expect
from pyproj import Transformer

from swath.daemon.console.painting import RAMPS
from swath.daemon.processing.live.frame import LocalFrame
from swath.daemon.processing.live.look import RECENT_DTYPE, RECENT_HEAD
from swath.daemon.processing.live.tiles import SIDE
from tests.daemon.console.builders import (
    WEB_ZOOM,
    WORLD_M,
    Asked,
    colours_of,
    console,
    verdict,
    write_map,
    write_mbtiles,
)
from tests.daemon.log_check import read_log
from tests.daemon.processing.live.builders import Utm, flight
from tests.daemon.rig import Recorder, free_udp_port, session_table, wait_until
from tests.peers.conftest import SIZES, Opened

pytestmark = pytest.mark.peers

SCRIPT = "<img src=x onerror=alert(1)>"
WAIT_MS = 20_000.0
SCALE = "30 m"  # at four pixels a metre
CELLS = 40  # along each side of the square that is painted
PROFILE = {
    "2": {"across_m": [10.0, 20.0, 30.0], "up_m": [4.0, 6.0, 3.0]},
    "3": {"across_m": [-40.0, -10.0, 15.0, 25.0], "up_m": [2.0, 5.0, 4.5, 5.5]},
}
OVERLAP = {
    "strip": 3, "cells": 1200, "median_m": -0.012, "rms_m": 0.093, "wanted": "QL2",
    "limits_m": {"QL0": 0.04, "QL2": 0.08},
    "against": [{"first": 2, "second": 3, "cells": 1200, "median_m": -0.012, "rms_m": 0.093}],
}  # fmt: skip
# as WCAG 2.1 AA, which axe knows by these names
RULES = {"runOnly": ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa", "best-practice"]}


@pytest.fixture(scope="module")
def aircraft(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Asked, Path]]:
    """Record a source that is silent, with a map and lines as live writes them."""
    folder = tmp_path_factory.mktemp("aircraft")
    logs = folder / "logs"
    logs.mkdir()
    config = session_table(logs) + f'[raw.camera]\ntransport = "udp:127.0.0.1:{free_udp_port()}"\n'
    config += '[console]\nmarks = ["line start"]\n'
    with Recorder(folder, config) as recorder, console(recorder.config) as (asked, _):
        write_live(logs / "live")
        wait_until(lambda: asked.snapshot()["sources"], "a source")
        yield asked, logs


def write_live(live: Path) -> None:
    """Write a square of `CELLS` metres with three points a square metre, the aircraft in its middle, two lines."""
    points = np.zeros((SIDE, SIDE), np.uint32)
    points[:CELLS, :CELLS] = 3
    write_map(live, {(0, 0): {"points": points, "height": np.where(points > 0, 5.0, np.nan)}})
    middle = CELLS / 2
    pose = {"east_m": middle, "north_m": middle, "heading_deg": 90.0, "track_deg": 90.0, "sigma_m": [0.02, 0.02, 0.04]}
    status = {"state": "following", "pose": pose, "tiles": {"sequence": 1}, "overlap": OVERLAP}
    (live / "live.json").write_text(json.dumps(status))
    (live / "profile.json").write_text(json.dumps({"track_deg": 90.0, "strips": PROFILE}))
    (live / "recent.bin").write_bytes(recent_points())
    again = {"name": "9", "state": "again", "flown_fraction": 0.5, "reasons": [{"text": f"GNSS lost {SCRIPT}"}]}
    flying = {"name": "4", "state": "flying", "flown_fraction": 0.25, "reasons": []}
    steering = {"line": "4", "cross_track_m": -12.0, "height_m": 7.0, "track_error_deg": 1.5, "to_begin_m": -400.0,
                "to_end_m": 1200.0, "to_begin_s": None, "to_end_s": 24.0, "speed_mps": 50.0, "wanted_speed_mps": 52.0,
                "bank_deg": 3.0, "bank_limit_deg": 20.0}  # fmt: skip
    (live / "lines.json").write_text(json.dumps({"lines": [flying, again], "current": "4", "next": "9"}))
    (live / "verdict.json").write_text(json.dumps(verdict(note=SCRIPT)))
    (live / "steering.json").write_text(json.dumps({"current": "4", "next": "9", "steering": steering}))


def recent_points() -> bytes:
    """Return a slope of 50 m by 40 m that rises by 10 m to the east, of strips 2 and 3."""
    rows = np.zeros(500, RECENT_DTYPE)
    draw = np.random.default_rng(5)
    rows["east"], rows["north"] = draw.uniform(0.0, 50.0, 500), draw.uniform(0.0, 40.0, 500)
    rows["up"], rows["strip"], rows["seconds"] = 0.2 * rows["east"], 2 + (rows["north"] > 20.0), 30.0
    return RECENT_HEAD.pack(b"SWTR", 1, RECENT_HEAD.size, rows.itemsize, len(rows), 0) + rows.tobytes()


def zoom_to(page: Page, scale: str) -> None:
    """Change the zoom by its button until the scale bar has a length."""
    bar = page.locator(".leaflet-control-scale-line")
    for _ in range(20):  # a click while the map still moves has no effect
        if bar.text_content() == scale:
            break
        page.get_by_role("button", name="Zoom in").click()
        page.wait_for_timeout(700)


def keep_current(live: Path) -> None:
    """Give live's status a new time, as live does each second."""
    (live / "live.json").touch()


def test_header_sensors_and_lines_say_what_is(aircraft: tuple[Asked, Path], open_page: Callable[..., Opened]) -> None:
    asked, logs = aircraft
    keep_current(logs / "live")
    page = open_page(asked.url).page
    expect(page.locator("#state")).to_have_text("DEGRADED", timeout=WAIT_MS)
    expect(page.locator("#state-shape")).to_have_text("▲")
    expect(page.locator("#sentence")).to_contain_text("raw/camera", timeout=WAIT_MS)
    rows = page.locator("#lines-rows tr")
    expect(rows).to_have_count(2)
    expect(rows.nth(1)).to_contain_text("FLY AGAIN")
    expect(rows.nth(1)).to_contain_text(f"GNSS lost {SCRIPT}")  # as text, not as a picture
    page.get_by_role("tab", name="Sensors").click()
    expect(page.locator("#sensor-rows tr")).to_contain_text(["raw/camera"])
    page.get_by_role("tab", name="Graphs").click()
    expect(page.locator(".graph", has_text="disk free, GB")).to_be_visible()


def test_marks_are_written_by_button_and_key(aircraft: tuple[Asked, Path], open_page: Callable[..., Opened]) -> None:
    asked, logs = aircraft
    opened = open_page(asked.url)
    page = opened.page
    page.get_by_label("Mark", exact=True).fill(SCRIPT)
    page.get_by_role("button", name="Write").click()
    expect(page.locator("#answer")).to_contain_text(f"UTC: {SCRIPT}", timeout=WAIT_MS)
    page.keyboard.press("F1")
    expect(page.locator("#answer")).to_contain_text("line start", timeout=WAIT_MS)
    page.get_by_role("tab", name="Events").click()
    expect(page.locator("#event-rows li", has_text=SCRIPT)).to_be_visible(timeout=WAIT_MS)

    def marks() -> list[str]:
        logged = [read_log(path).events("mark") for path in sorted(logs.glob("*.mcap"))]
        return [event["text"] for events in logged for event in events]

    wait_until(lambda: marks()[-2:] == [SCRIPT, "line start"], "both marks in the log")
    assert opened.errors == []


def test_no_page_asks_another_machine_or_breaks_the_policy(
    aircraft: tuple[Asked, Path], open_page: Callable[..., Opened]
) -> None:
    asked, _ = aircraft
    for path in ("/", "/pilot", "/landing", "/login"):
        opened = open_page(asked.url + path)
        opened.page.wait_for_timeout(2500)
        assert {urlsplit(address).netloc for address in opened.asked if not address.startswith(("data:", "blob:"))} == {
            urlsplit(asked.url).netloc
        }
        assert opened.errors == [], path


@pytest.mark.parametrize("size", SIZES)
def test_every_cell_is_painted_and_nothing_else(
    aircraft: tuple[Asked, Path], open_page: Callable[..., Opened], size: tuple[int, int]
) -> None:
    asked, _ = aircraft
    page = open_page(asked.url, size).page
    page.get_by_label("Show").select_option("density")
    zoom_to(page, SCALE)
    colour = np.array([int(RAMPS["density"][2][i : i + 2], 16) for i in (1, 3, 5)])
    pixel_m = 0.25
    wanted = (CELLS / pixel_m) ** 2

    def painted() -> NDArray[np.bool_]:
        shot = Image.open(io.BytesIO(page.locator("#map").screenshot())).convert("RGB")
        found = np.abs(np.asarray(shot, int) - colour).max(axis=-1) <= 2
        reach = round(CELLS / pixel_m)  # beyond, the legend shows the same colour
        rows, columns = (np.arange(length) - length // 2 for length in found.shape)
        return np.asarray(found & (np.abs(rows) < reach)[:, None] & (np.abs(columns) < reach))

    def is_whole() -> bool:
        found = painted()
        rows, columns = np.nonzero(found)
        hidden = 36**2  # of the aircraft's sign
        sides = [np.ptp(places) + 1 - CELLS / pixel_m for places in (rows, columns) if len(places)]
        # where the map's own place is no whole pixel, the pixels at an edge are mixed
        return len(rows) > 0.99 * wanted - hidden and bool(max(map(abs, sides), default=9.0) <= 1.0)

    def is_in_the_middle() -> bool:
        """Return whether the aircraft is: the header may grow by a line at any time, which moves the map."""
        frame = page.locator("#map").bounding_box()
        assert frame is not None
        places = zip(np.nonzero(painted()), (frame["height"], frame["width"]), strict=True)
        return all(len(found) > 0 and abs(found.mean() - length / 2) < 3.0 for found, length in places)

    wait_until(is_whole, "the square of cells, to a pixel", 60.0)
    wait_until(is_in_the_middle, "the aircraft in the middle of the map")


@pytest.mark.parametrize("path", ["/", "/#data", "/pilot", "/landing", "/login"])
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_no_barrier_is_found(
    aircraft: tuple[Asked, Path], open_page: Callable[..., Opened], path: str, scheme: str
) -> None:
    asked, logs = aircraft
    keep_current(logs / "live")
    page = open_page(asked.url + path, SIZES[2], scheme).page
    if path.endswith("#data"):
        page.get_by_role("tab", name="Data").click()
    page.wait_for_timeout(2500)
    found: Any = Axe().run(page, options=RULES)
    told = [f"{one['id']}: {[node['html'] for node in one['nodes']]}" for one in found.response["violations"]]
    assert told == []


def test_the_pilot_s_page_has_the_figures_of_the_line(
    aircraft: tuple[Asked, Path], open_page: Callable[..., Opened]
) -> None:
    asked, logs = aircraft
    keep_current(logs / "live")
    page = open_page(asked.url + "/pilot", SIZES[1]).page
    wanted = {"line": "Line 4", "next": "next: 9", "cross": "L 12 m", "height": "+7 m", "track": "+1.5°",
              "end": "1,200 m 24 s", "speed": "50.0 / 52.0 m/s", "bank": "3° / 20°"}  # fmt: skip
    for name, text in wanted.items():
        expect(page.locator(f"#{name}")).to_have_text(text, timeout=WAIT_MS)


def test_a_page_without_its_console_says_so_and_is_whole_again(
    tmp_path: Path, open_page: Callable[..., Opened]
) -> None:
    (tmp_path / "live").mkdir()
    with console(tmp_path) as (asked, process):
        page = open_page(asked.url).page
        expect(page.locator("#state")).to_have_text("NOT RECORDING", timeout=WAIT_MS)
        process.kill()
        expect(page.locator("#state")).to_have_text("CONSOLE SILENT", timeout=WAIT_MS)
        expect(page.locator("#sentence")).to_contain_text("is not known here")
    with console(tmp_path, port=asked.port):
        expect(page.locator("#state")).to_have_text("NOT RECORDING", timeout=WAIT_MS)


def test_the_user_s_map_lies_behind_where_proj_places_it(tmp_path: Path, open_page: Callable[..., Opened]) -> None:
    """The colours of the made-up map tell their place, to two pixels of a screen's picture."""
    frame = LocalFrame(flight().position_e[0], Utm())
    live = tmp_path / "live"
    write_map(live, {(3, 3): {"points": np.ones((SIDE, SIDE), np.uint32)}}, placement=frame.placement())
    pose = {"east_m": 0.0, "north_m": 0.0, "heading_deg": 30.0, "track_deg": 30.0}
    (live / "live.json").write_text(json.dumps({"state": "following", "pose": pose}))
    write_mbtiles(tmp_path / "map", frame)
    with console(tmp_path, "--background", tmp_path / "map") as (asked, _):
        opened = open_page(asked.url, SIZES[1])
        page = opened.page
        expect(page.locator("#attribution")).to_have_text("© Maps", timeout=WAIT_MS)
        zoom_to(page, "100 m")  # at a pixel a metre
        page.wait_for_timeout(3000)
        shot = np.asarray(Image.open(io.BytesIO(page.locator("#map").screenshot())).convert("RGB"), float)
        rows, columns = (length // 2 for length in shot.shape[:2])
        down, across = (grid.ravel() for grid in np.mgrid[-100:100:9, -100:100:9])
        free = np.hypot(across, down) > 40  # beside the aircraft
        x, y = Transformer.from_crs("EPSG:32632", "EPSG:3857").transform(
            frame.origin[0] + across[free] + 0.5, frame.origin[1] - down[free] - 0.5
        )
        place = [(0.5 + one / WORLD_M) * (256 << WEB_ZOOM) - 0.5 for one in (x, -y)]
        error = np.abs(shot[rows + down[free], columns + across[free]] - colours_of(*place))[:, :2]
        assert np.quantile(error, 0.95) < 2.0
        assert error.max() < 3.0
        assert page.locator("#grid-step").text_content() == ""
        page.get_by_role("button", name="Background").click()
        expect(page.locator("#grid-step")).to_have_text("grid 100 m")
        page.wait_for_timeout(1000)
        assert opened.errors == []


def test_grid_and_north_are_right_when_the_track_is_up(
    aircraft: tuple[Asked, Path], open_page: Callable[..., Opened]
) -> None:
    """The aircraft flies east: north is to the left, and upright lines of the grid are 50 m of 4 pixels apart."""
    asked, logs = aircraft
    keep_current(logs / "live")
    page = open_page(asked.url, SIZES[2]).page
    zoom_to(page, SCALE)
    buttons = {name: page.locator(name).bounding_box() for name in ("#zoom-in", "#scale", "#legend")}
    page.get_by_role("button", name="Track up").click()
    page.wait_for_timeout(2500)
    expect(page.locator("#grid-step")).to_have_text("grid 50 m")
    assert {name: page.locator(name).bounding_box() for name in buttons} == buttons  # nothing but the map turns
    angle = page.locator("#north").evaluate("(one) => new DOMMatrix(getComputedStyle(one).transform)")
    assert (round(angle["a"]), round(angle["b"])) == (0, -1)  # a quarter to the left
    shot = np.asarray(Image.open(io.BytesIO(page.locator("#map-section").screenshot())).convert("RGB"), int)
    middle = np.array(shot.shape[:2]) // 2
    below = shot[middle[0] + 100 : middle[0] + 150]  # of the painted square
    darker = (np.median(below, axis=(0, 1)) - below).sum(axis=-1).mean(axis=0)
    lines = np.flatnonzero((darker > 10.0) & (darker >= np.roll(darker, 1)) & (darker > np.roll(darker, -1)))
    assert len(lines) >= 3
    assert np.diff(lines).tolist() == pytest.approx([200.0] * (len(lines) - 1), abs=1.0)
    assert np.abs(lines - (middle[1] + 80)).min() <= 1  # the aircraft is 20 m north of a line, which lies to its right


def pixels_of(page: Page, canvas: str) -> NDArray[np.uint8]:
    """Return what a canvas holds (rows, columns, 4)."""
    script = """(canvas) => {
        const {width, height} = canvas;
        return {width, height, data: [...canvas.getContext("2d").getImageData(0, 0, width, height).data]};
    }"""
    found = page.locator(canvas).evaluate(script)
    return np.array(found["data"], np.uint8).reshape(found["height"], found["width"], 4)


def colour_of(page: Page, strip: int, place: str) -> tuple[int, ...]:
    """Return the colour of a strip by the legend, which a person reads."""
    sign = page.locator(f"{place} li", has_text=f"strip {strip}").locator("path")
    return tuple(int(str(sign.get_attribute("fill"))[at : at + 2], 16) for at in (1, 3, 5))


@pytest.fixture
def data_panel(aircraft: tuple[Asked, Path], open_page: Callable[..., Opened]) -> Page:
    asked, logs = aircraft
    keep_current(logs / "live")
    page = open_page(asked.url, SIZES[2]).page
    page.get_by_role("tab", name="Data").click()
    expect(page.locator("#cloud-words")).to_contain_text("500 points of the last 30 s", timeout=WAIT_MS)
    return page


def test_the_profile_shows_each_point_at_its_place_in_its_strip_s_colour(data_panel: Page) -> None:
    """The frame that the axes' figures are written from tells where each point has to be."""
    shown = pixels_of(data_panel, "#profile")[..., :3].astype(int)
    frame = json.loads(str(data_panel.locator("#profile").get_attribute("data-frame")))
    for name, strip in PROFILE.items():
        colour = np.array(colour_of(data_panel, int(name), "#profile-key"))
        is_strip = np.abs(shown - colour).max(axis=-1) < 40
        x = (
            frame["left"]
            + (np.array(strip["across_m"]) - frame["west"]) / (frame["east"] - frame["west"]) * frame["width"]
        )
        y = frame["top"] + (frame["high"] - np.array(strip["up_m"])) / (frame["high"] - frame["low"]) * frame["height"]
        near = np.zeros_like(is_strip)
        for column, row in zip(x, y, strict=True):
            around = np.s_[round(row) - 4 : round(row) + 4, round(column) - 4 : round(column) + 4]
            assert is_strip[around].any(), (name, column, row)
            near[around] = True
        assert not (is_strip & ~near).any(), name
    expect(data_panel.locator("#profile-words")).to_contain_text("strip 2: 3 points; strip 3: 4 points")


def test_the_points_are_seen_as_turning_and_nearness_demand(data_panel: Page) -> None:
    """NumPy turns the points by matrices about the vertical and the horizontal axis, and paints far ones first."""
    data_panel.get_by_label("Colour").select_option("strip")
    data_panel.locator("#cloud").focus()
    for key in ("ArrowLeft", "ArrowLeft", "ArrowUp", "+"):
        data_panel.keyboard.press(key)
    view = json.loads(str(data_panel.locator("#cloud").get_attribute("data-view")))
    shown = pixels_of(data_panel, "#cloud")
    rows = np.frombuffer(recent_points(), RECENT_DTYPE, 500, RECENT_HEAD.size)
    places = np.stack([rows["east"] - view["east"], rows["north"] - view["north"], rows["up"] - view["level"]], 1)
    azimuth, elevation = np.radians([view["azimuth"], view["elevation"]])
    turn = np.array([[np.cos(azimuth), -np.sin(azimuth), 0], [np.sin(azimuth), np.cos(azimuth), 0], [0, 0, 1]])
    tilt = np.array([[1, 0, 0], [0, np.sin(elevation), np.cos(elevation)], [0, np.cos(elevation), -np.sin(elevation)]])
    seen = places @ turn.T @ tilt.T  # right, up, away
    height, width = shown.shape[:2]
    wanted = np.zeros((height, width, 3), np.uint8)
    for k in np.argsort(-seen[:, 2]):
        column, row = int(width / 2 + seen[k, 0] * view["perM"]), int(height / 2 - seen[k, 1] * view["perM"])
        if 0 <= row < height and 0 <= column < width:
            wanted[row : row + 2, column : column + 2] = colour_of(data_panel, int(rows["strip"][k]), "#cloud-key")
    free = np.s_[: height - 40]  # the scale bar stands below
    differs = (shown[free][..., :3] != wanted[free]).any(axis=-1)
    assert (wanted[free].any(axis=-1)).sum() > 500
    assert differs.sum() < 0.01 * wanted.any(axis=-1).sum()
    assert view["azimuth"] != 20
    assert view["closer"] == 1.25


def test_two_fingers_bring_the_points_nearer_and_turn_nothing(data_panel: Page) -> None:
    box = data_panel.locator("#cloud").bounding_box()
    assert box is not None
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    before = json.loads(str(data_panel.locator("#cloud").get_attribute("data-view")))
    fingers = data_panel.context.new_cdp_session(data_panel)

    def touch(kind: str, *apart: float) -> None:
        points = [{"x": x + side * one, "y": y, "id": number} for one in apart for number, side in ((0, -1), (1, 1))]
        fingers.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})

    touch("touchStart", 40)
    for apart in (50, 60, 80):
        touch("touchMove", apart)
    touch("touchEnd")
    after = json.loads(str(data_panel.locator("#cloud").get_attribute("data-view")))
    assert after["closer"] == pytest.approx(2.0 * before["closer"], rel=0.05)
    assert (after["azimuth"], after["elevation"]) == (before["azimuth"], before["elevation"])


def test_the_overlap_is_told_against_the_quality_level_wanted(data_panel: Page) -> None:
    expect(data_panel.locator("#overlap-words")).to_have_text(
        "Strip 3: median −1.2 cm, RMSDz 9.3 cm in 1,200 cells, BEYOND QL2 (8.0 cm)", timeout=WAIT_MS
    )
    expect(data_panel.locator("#overlap-rows tr")).to_contain_text(["2 − 3"])


def marks_of(logs: Path) -> list[str]:
    """Return the texts of all marks in the logs."""
    logged = [read_log(path).events("mark") for path in sorted(logs.glob("*.mcap"))]
    return [event["text"] for events in logged for event in events]


@pytest.mark.parametrize("size", SIZES)
def test_the_verdict_before_landing_is_read_printed_and_written_into_the_log(
    aircraft: tuple[Asked, Path], open_page: Callable[..., Opened], size: tuple[int, int]
) -> None:
    asked, logs = aircraft
    keep_current(logs / "live")
    opened = open_page(asked.url + "/landing", size)
    page = opened.page
    expect(page.locator("#state")).to_have_text("FLY AGAIN", timeout=WAIT_MS)
    expect(page.locator("#sentence")).to_have_text("Fly again: line 9")
    expect(page.locator("#check-rows tr", has_text="Base data")).to_contain_text("? not known")
    expect(page.locator("#check-rows tr", has_text="Base data")).to_contain_text(SCRIPT)  # as text
    expect(page.locator("#check-rows tr", has_text="Overlap")).to_contain_text("● good")
    expect(page.locator("#line-rows tr").nth(1)).to_contain_text("FLY AGAIN")
    expect(page.locator("#gaps-note")).to_contain_text("3 smaller ones")
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    with page.expect_download(timeout=120_000) as download:
        page.get_by_role("link", name="PDF").click()
    assert download.value.suggested_filename == "landing.pdf"
    assert Path(download.value.path()).read_bytes().startswith(b"%PDF-")
    before = marks_of(logs)
    page.get_by_role("button", name="Write into the log").click()
    expect(page.locator("#answer")).to_contain_text("landing: Fly again: line 9", timeout=WAIT_MS)
    wait_until(lambda: marks_of(logs) == [*before, "landing: Fly again: line 9"], "the verdict in the log")
    page.locator("#gap-rows a").click()
    expect(page.locator("#follow")).to_have_attribute("aria-pressed", "false", timeout=WAIT_MS)
    expect(page.locator("#legend")).to_contain_text("gap", timeout=WAIT_MS)
    assert opened.errors == []


def test_going_home_is_blue_only_where_nothing_is_open_to_doubt(
    tmp_path: Path, open_page: Callable[..., Opened]
) -> None:
    (tmp_path / "live").mkdir()
    path = tmp_path / "live/verdict.json"
    home = verdict() | {"state": "home", "sentence": "You can go home"}
    with console(tmp_path) as (asked, _):
        page = open_page(asked.url + "/landing").page
        expect(page.locator("#state")).to_have_text("NO VERDICT", timeout=WAIT_MS)
        for unknown, state in (("unknown", "GO HOME, WITH CARE"), ("good", "GO HOME"), ("open", "GO HOME")):
            checks = [home["checks"][2], home["checks"][3] | {"state": unknown}]
            path.write_text(json.dumps(home | {"checks": checks, "area": None, "lines": []}))
            expect(page.locator("#state")).to_have_text(state, timeout=WAIT_MS)
            expect(page.locator("#gaps-note")).to_have_text("No point yet")


def test_the_operator_overrules_a_line_by_the_panel(
    aircraft: tuple[Asked, Path], open_page: Callable[..., Opened]
) -> None:
    asked, logs = aircraft
    page = open_page(asked.url, SIZES[2]).page
    page.get_by_label("Line", exact=True).select_option("9", timeout=WAIT_MS)
    page.get_by_label("is", exact=True).select_option("accepted")
    page.get_by_label("because").fill(f"clouds {SCRIPT}")
    before = marks_of(logs)
    page.get_by_role("button", name="Overrule").click()
    text = f"line 9: accepted, clouds {SCRIPT}"
    expect(page.locator("#overruled")).to_contain_text(text, timeout=WAIT_MS)
    expect(page.get_by_label("because")).to_have_value("")
    wait_until(lambda: marks_of(logs) == [*before, text], "the overrule in the log")
