"""Tests the page of the verdict before landing, its map, and the command that prints it."""

from __future__ import annotations

import base64
import io
import json
import re
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from PIL import Image

from swath.daemon.processing.landing.command import PAGE, PRINTED, PagePrinter
from swath.daemon.processing.landing.page import landing_page, map_svg
from swath.daemon.processing.live.tiles import SIDE, fit_placement
from tests.daemon.builders import swath
from tests.daemon.console.builders import verdict, write_map

SVG = "{http://www.w3.org/2000/svg}"
M_PER_DEG = 111_320.0


def place(east_m: float, north_m: float) -> list[float]:
    """Return latitude, longitude, height of a place in a frame that is even at the equator."""
    return [north_m / M_PER_DEG, east_m / M_PER_DEG, 900.0]


@pytest.fixture
def live(tmp_path: Path) -> Path:
    """Write a square of 120 m with points, but for a hole of 20 m, lines 4 and 9 along it, and an area of 100 m."""
    points = np.zeros((SIDE, SIDE), np.uint32)
    points[:120, :120] = 5
    points[40:60, 30:50] = 0
    steps = np.array([[up, across] for up in (-1.0, 0.0, 1.0) for across in (-1.0, 0.0, 1.0)]) * 0.01
    placement = fit_placement((0.0, 0.0), steps, np.zeros(2), steps[:, ::-1] * M_PER_DEG)
    write_map(tmp_path, {(0, 0): {"points": points}}, placement=placement)
    geometry = {
        "lines": {"4": [place(0, 30), place(120, 30)], "9": [place(120, 90), place(0, 90)]},
        "area": [[[one[:2] for one in (place(10, 10), place(110, 10), place(110, 110), place(10, 110))]]],
    }
    (tmp_path / "lines.json").write_text(json.dumps({"geometry": geometry}))
    (tmp_path / "verdict.json").write_text(json.dumps(verdict()))
    return tmp_path


def test_the_map_shows_holes_in_red_inside_the_area_and_lines_by_their_state(live: Path) -> None:
    root = ElementTree.fromstring(map_svg(live, verdict()))
    picture = root.find(f"{SVG}image")
    assert picture is not None
    data = base64.b64decode(picture.attrib["href"].partition(",")[2])
    image = np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))
    width_m = float(picture.attrib["width"]) / float(root.attrib["width"])
    assert width_m >= 1.0
    red = (image == (215, 25, 28)).all(axis=-1).mean()
    grey = (image == (201, 214, 222)).all(axis=-1).mean()
    assert grey / red == pytest.approx((120**2 - 400) / 400, rel=0.05)
    colours = [one.attrib["stroke"] for one in root.iter(f"{SVG}polyline")]
    assert colours == ["#8a4b00", "#b3261e"]
    circle = root.find(f"{SVG}circle")
    assert circle is not None
    scale = float(root.attrib["width"]) / (120.0 * 1.14)  # 7 % of margin on either side
    assert float(circle.attrib["cx"]) == pytest.approx((30.0 + 0.07 * 120.0) * scale, abs=1.0)
    assert {one.text for one in root.iter(f"{SVG}text")} >= {"4", "9", "1", "N", "20\u00a0m"}


def test_the_page_says_what_the_verdict_says_and_needs_no_other_file(live: Path) -> None:
    text = landing_page(live, verdict(note="<b>wind</b>"))
    words = re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", text))
    for said in (
        "Fly again: line 9.",
        "1 of 2 lines good",
        "4 gaps",
        "98.0 % of the area has points",
        "not known",
        "Plan plan.kml",
        "Aircraft HB-XYZ",
        "47.50000°, 8.90000°",
        "not covered",
        "and 3 more",
        "operator says accepted",
    ):
        assert said.replace("\u00a0", " ") in words.replace("\u00a0", " "), said
    assert "<b>wind</b>" not in text
    assert not re.search(r'(?:src|href)="(?!data:)', text)
    (live / "lines.json").unlink()
    (live / "tiles/index.json").unlink()
    assert "Map" not in re.findall(r"<h2>(.*?)</h2>", landing_page(live, verdict()))


@pytest.mark.slow
def test_the_command_prints_the_verdict_and_writes_page_and_pdf(
    live: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    page = tmp_path_factory.mktemp("out") / "landing.html"
    done = swath("landing", str(live), "-o", str(page))
    assert (done.returncode, done.stderr) == (1, "")
    lines = done.stdout.splitlines()
    assert lines[0] == "Fly again: line 9"
    assert re.fullmatch(r"Base data +unknown +no \[corrections\] are configured", lines[4])
    assert lines[-2:] == [str(page), str(page.with_suffix(".pdf"))]
    assert page.with_suffix(".pdf").read_bytes().startswith(b"%PDF-")
    again = swath("landing", str(live), "-o", str(page))
    assert (again.returncode, "already exists" in again.stderr) == (2, True)
    told = json.loads(swath("landing", str(live), "--json").stdout)
    assert told.pop("predicted")["why"].startswith("swath live writes what is needed")
    assert told == verdict()
    (live / "verdict.json").write_text(json.dumps(verdict() | {"state": "home", "version": 2}))
    other = swath("landing", str(live))
    assert (other.returncode, "another version" in other.stderr) == (4, True)
    (live / "verdict.json").write_text(json.dumps(verdict() | {"state": "home", "sentence": "You can go home"}))
    assert swath("landing", str(live)).returncode == 0


@pytest.mark.slow
def test_a_mark_has_page_and_pdf_written_beside_live_s_files(live: Path) -> None:
    printer = PagePrinter(live)
    printer.finish(60.0)
    assert not (live / PAGE).exists()
    printer.ask()
    printer.ask()  # while the first one is being made
    printer.finish(60.0)
    assert (live / PAGE).is_file()
    assert (live / PRINTED).read_bytes().startswith(b"%PDF-")
