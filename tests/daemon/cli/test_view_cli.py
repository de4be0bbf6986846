"""Tests ``swath view``: its page, its pictures, and its words for faults."""

from __future__ import annotations

import base64
import json
import re
import struct
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from pypdf import PdfReader
from pyproj import CRS

from swath.daemon.cli.main import run_app
from tests.daemon.builders import EAST_M, NORTH_M, lattice, plane, write_laz
from tests.daemon.processing.pages.builders import faults_of

pytestmark = pytest.mark.xdist_group("kernels")

PICTURES = ("height", "differences", "profile", "density", "intensity", "sigma")


class Page(HTMLParser):
    """What a browser would see: rows of tables, sources of pictures, tags left open."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.crossed: list[str] = []
        self.sources: list[str] = []
        self.links: list[str] = []
        self.rows: list[list[str]] = []
        self.words = ""
        self.feed(text.replace("\xa0", " "))  # between a number and its unit

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in ("meta", "img"):
            self.open.append(tag)
        for name, value in attrs:
            if name == "src":
                self.sources.append(value or "")
            if name in ("href", "srcset", "data"):
                self.links.append(value or "")
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self.rows[-1].append("")

    def handle_endtag(self, tag: str) -> None:
        if self.open.pop() != tag:
            self.crossed.append(tag)

    def handle_data(self, data: str) -> None:
        self.words += data
        if self.open and {"td", "th"} & set(self.open):
            self.rows[-1][-1] += data


@pytest.fixture(scope="module")
def products(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write two strips, the second 7 cm higher, with sigmas and a sidecar that lists them."""
    folder = tmp_path_factory.mktemp("products")
    for number, (south_m, lift_m) in enumerate([(0.0, 0.0), (30.0, 0.07)], start=1):
        x, y = lattice(EAST_M, NORTH_M + south_m, 120.0, 50.0, 0.5)
        z, sigma_m = plane(x, y) + lift_m, (0.031, 0.032, 0.0215)
        write_laz(folder / f"s{number}.laz", x, y, z, number, crs=CRS.from_epsg(25832), sigma_m=sigma_m)
    sidecar = {
        "software": "swath 0.1.0",
        "complete": False,
        "holes": ["part 2 of the session is missing"],
        "warnings": ["refraction is off: <b>3 mm</b> at the edge"],
        "strips": [{"file": "s1.laz"}, {"file": "s2.laz"}],
        "flights": [
            {
                "session": "one-20260615",
                "aircraft": "HB-ABC",
                "operator": "Survey AG",
                "calibrations": {"left": {"id": "cal-2026"}},
                "settings": {"atmosphere": {"ranges": "vacuum"}, "scanners": {"left": {"calibration": "x.toml"}}},
            }
        ],
        "counts": {"left": {"read": 48000, "written": 48000, "dropped": {}}},
    }
    (folder / "flight.json").write_text(json.dumps(sidecar))
    return folder


@pytest.fixture(scope="module")
def page(products: Path) -> Page:
    assert run_app(["view", str(products)]) == 0
    return Page((products / "view" / "index.html").read_text(encoding="utf-8"))


@pytest.mark.slow
def test_pictures_are_written_beside_the_page_and_embedded(products: Path, page: Page) -> None:
    assert len(page.sources) == len(PICTURES)
    for name, source in zip(PICTURES, page.sources, strict=True):
        kind, data = source.split(",", 1)
        assert kind == "data:image/png;base64"
        picture = (products / "view" / f"{name}.png").read_bytes()
        assert base64.b64decode(data) == picture
        width, height = struct.unpack(">II", picture[16:24])
        assert width > 1000
        assert height > 600


def test_the_head_names_log_aircraft_crs_calibration_and_the_pdf_its_author(products: Path, page: Page) -> None:
    for words in ("one-20260615", "HB-ABC", "ETRS89 / UTM zone 32N (EPSG:25832)", "cal-2026 of left"):
        assert words in page.words
    read = PdfReader(products / "view" / "index.pdf")
    assert read.metadata is not None
    assert (read.metadata.title, read.metadata.author) == (f"{products.name}: quick look", "Survey AG")
    assert "HB-ABC" in read.pages[0].extract_text()
    assert "Appendix" in read.pages[-1].extract_text()


def test_the_page_needs_no_network_and_is_well_formed(products: Path, page: Page) -> None:
    text = (products / "view" / "index.html").read_text(encoding="utf-8")
    assert page.links == []
    assert faults_of(text) == []
    assert (page.open, page.crossed) == ([], [])
    assert not re.search(r"https?://|@import|url\(|<script", text)
    assert "prefers-color-scheme: dark" in text


def test_tables_match_the_input(page: Page) -> None:
    rows = {row[0]: row for row in page.rows}
    assert rows["1 − 2"][2:7] == ["−7.0", "−7.0", "7.0", "7.0", "7.0"]
    assert rows["1"][1] == rows["1"][2] == "24\u202f000"
    assert rows["1"][5] == "4"
    assert rows["1"][6:] == ["3.1", "3.2", "2.2", "2.2"]
    assert rows["s1.laz"][1:] == ["24\u202f000", "1.4, 6", "ETRS89 / UTM zone 32N", "left: cal-2026", "whole"]
    assert rows["RMSDz"][1:4] == ["7.0 cm", "≤ 4 cm not met", "≤ 8 cm met"]
    assert rows["pulses per m²"][2] == "≥ 8 not met"
    assert rows["pulses per m²"][4] == "≥ 2 met"
    assert "strips meet the 10 cm class" in page.words
    assert "ETRS89 / UTM zone 32N (EPSG:25832)" in page.words


def test_the_page_shows_the_sidecar_with_escaped_markup(page: Page) -> None:
    rows = {row[0]: row[1] for row in page.rows if len(row) == 2}
    assert rows["calibration"] == "left: cal-2026"
    assert rows["atmosphere"] == "ranges vacuum"
    assert rows["complete"] == "no, partial"
    assert "refraction is off: <b>3 mm</b> at the edge" in page.words
    assert "part 2 of the session is missing" in page.words


@pytest.mark.slow
def test_the_command_prints_the_path_of_the_page(products: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = products / "elsewhere"
    assert run_app(["view", str(products / "s1.laz"), "-o", str(folder)]) == 0
    assert capsys.readouterr().out == f"1 strip, 24,000 points: {folder / 'index.html'}\n"
    assert not (folder / "differences.png").exists()  # one strip only
    assert (folder / "profile.png").exists()


@pytest.mark.slow
def test_json_has_the_numbers(products: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    ends = f"{EAST_M},{NORTH_M + 40},{EAST_M + 100},{NORTH_M + 40}"
    code = run_app(["view", str(products), "-o", str(tmp_path), "--json", "--cell", "4", "--profile", ends])
    numbers = json.loads(capsys.readouterr().out)
    assert code == 0
    assert numbers["cell_m"] == 4.0
    assert numbers["overlap"]["median_m"] == -0.07
    assert numbers["page"] == str(tmp_path / "index.html")


@pytest.mark.parametrize(
    ("content", "arguments", "code", "words"),
    [
        (None, [], 3, "no such file or folder"),
        (b"", [], 3, "cannot be read as a LAS or LAZ file"),
        (b"PK\x03\x04 something else entirely", [], 3, "cannot be read as a LAS or LAZ file"),
        (b"LASF" + bytes(500), [], 3, "cannot be read as a LAS or LAZ file"),
        (b"", ["--cell", "-1"], 2, "--cell: got -1, want metres above 0"),
        (b"", ["--profile", "1,2,3"], 2, "--profile: got 1,2,3, want x1,y1,x2,y2"),
    ],
)
def test_wrong_input_is_refused_in_one_line(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    content: bytes | None,
    arguments: list[str],
    code: int,
    words: str,
) -> None:
    path = tmp_path / "x.las"
    if content is not None:
        path.write_bytes(content)
    assert run_app(["view", str(path), *arguments]) == code
    (line,) = capsys.readouterr().err.splitlines()
    assert words in line
    assert not (tmp_path / "view").exists()


def test_files_without_points_and_folders_without_files_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_app(["view", str(tmp_path)]) == 3
    assert "has no LAS or LAZ file" in capsys.readouterr().err
    x, y = lattice(0.0, 0.0, 1.0, 1.0, 0.5)
    path = write_laz(tmp_path / "none.las", x, y, x)
    raw = bytearray(path.read_bytes())[:375]
    raw[247:255] = bytes(8)
    path.write_bytes(raw)
    assert run_app(["view", str(path)]) == 3
    assert "no points" in capsys.readouterr().err


def test_a_truncated_file_is_shown_in_part_and_exits_with_the_damage_code(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    x, y = lattice(EAST_M, NORTH_M, 100.0, 100.0, 0.5)
    path = write_laz(tmp_path / "cut.las", x, y, plane(x, y))
    path.write_bytes(path.read_bytes()[:-100_000])
    assert run_app(["view", str(path)]) == 4
    assert "points could be read" in capsys.readouterr().err
    assert "partial" in (tmp_path / "view" / "index.html").read_text(encoding="utf-8")


def test_a_single_point_is_shown(tmp_path: Path) -> None:
    write_laz(tmp_path / "one.las", np.array([EAST_M]), np.array([NORTH_M]), np.array([400.0]))
    assert run_app(["view", str(tmp_path)]) == 0
