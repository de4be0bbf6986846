"""Tests that every page has a head, tables without empty columns, an appendix and a PDF."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
from pypdf import PdfReader

from swath import __version__
from swath.calib.labels import worded
from swath.calib.profiles.check import Check
from swath.daemon.processing.calibration.report.cuts import marks_of
from swath.daemon.processing.calibration.report.profiles import comparison_table
from swath.daemon.processing.pages import pdf
from swath.daemon.processing.pages.blocks import Cell, Image, Judged, Notes, Table, Words, reasons_of
from swath.daemon.processing.pages.head import (
    PageHead,
    calibration_words,
    crs_words,
    flown_words,
    head_of_sidecars,
)
from swath.daemon.processing.pages.names import OF_COMMAND, PRINTED
from swath.daemon.processing.pages.pdf import PdfUnavailableError, page_files, pdf_of
from swath.daemon.processing.pages.render import BEFORE_UNIT, Page, html_of
from swath.daemon.processing.quicklook.page import verdict_of
from swath.daemon.processing.quicklook.product_facts import rows_of
from swath.georef.trajectory.trajectory import gps_span_text
from swath.georef.verdicts import Level, Reason, Verdict
from tests.daemon.processing.pages.builders import faults_of

NINE_NS = 1_465_549_218_000_000_000  # 2026-06-15 09:00:00 UTC and 18 leap seconds
DAY_NS = 86_400_000_000_000
DOT = "data:image/svg+xml;base64,PHN2ZyB4bWxucz0iaHR0cDovL3d3dy53My5vcmcvMjAwMC9zdmciIHdpZHRoPSI5IiBoZWlnaHQ9IjkiLz4="


def flight_entry(**more: object) -> dict[str, object]:
    """Return a flight of a sidecar."""
    calibration = {"id": "c-1", "created": "2026-05-01T08:00:00+00:00", "verdict": "usable with care"}
    return {
        "session": "one",
        "aircraft": "HB-ABC",
        "operator": "Aero Survey",
        "returns_gps_ns": [NINE_NS, NINE_NS + 120_000_000_000],
        "calibrations": {"left": calibration},
        **more,
    }


def test_reasons_that_the_verdict_tells_are_not_repeated() -> None:
    told, other = Reason(Level.CARE, "a", "the arm is wrong", ""), Reason(Level.CARE, "b", "few fixes", "")
    sentence = "Usable with care: the arm is wrong."
    assert reasons_of(Verdict(Level.CARE, sentence, (told,))) == []
    (table,) = reasons_of(Verdict(Level.CARE, sentence, (told, other, replace(told, change="measure it"))))
    assert isinstance(table, Table)
    assert table.rows == [["few fixes", ""], ["the arm is wrong", "measure it"]]


def test_a_page_names_parameters_by_words() -> None:
    reasons = (Reason(Level.CARE, "a", "add −273 ± 61 µs to time_offset_us", "calibrate"),)
    (table,) = reasons_of(Verdict(Level.CARE, "Usable with care.", reasons))
    assert isinstance(table, Table)
    assert table.rows == [["add −273 ± 61 µs to time offset", "calibrate"]]
    assert worded("scan_angle_scale_ppm, scan_angle_offset_deg") == "scan angle scale, scan angle offset"
    assert worded("changed: omega_deg −0.2181 ± 0.0057 (38.6 σ), torsion_us2 +4 ± 1") == (
        "changed: boresight ω (roll) −0.2181 ± 0.0057° (38.6 σ), torsion +4 ± 1 µs²"
    )


@pytest.mark.parametrize(("count", "wide", "printed"), [(4, 7, 5), (6, 7, 3), (7, 7, 4), (8, 4, 4), (9, 5, 5)])
def test_rows_of_cards_have_equal_lengths(count: int, wide: int, printed: int) -> None:
    text = html_of(Page("Kind", "one", PageHead(), [], cards=[("1", "metre")] * count))
    assert f'style="--columns: {wide}; --printed: {printed}"' in text


def test_a_nominal_calibration_is_never_called_good() -> None:
    assert calibration_words("left", {"id": "c", "method": "nominal"}, "good") == "c of left, nominal, never estimated"
    assert calibration_words("left", {"id": "c"}, "good") == "c of left, good"


def test_a_quick_look_tells_the_verdict_on_what_the_points_were_made_with() -> None:
    """Each strip's file has the same sidecar; the sentence tells its reason once."""
    what = "calibration c of left is nominal: points may lie 2.5 m off; run swath calibrate"
    entry = {"level": "not to be used", "reasons": [{"level": "not to be used", "what": what}]}
    source = SimpleNamespace(sidecar={"format": "swath.georef", "verdict": entry})
    verdict = verdict_of(cast(Any, SimpleNamespace(sources=[source, source])))
    assert verdict is not None
    assert verdict.sentence == "Not to be used: calibration c of left is nominal: points may lie 2.5 m off."
    assert verdict_of(cast(Any, SimpleNamespace(sources=[SimpleNamespace(sidecar={})]))) is None


def test_profiles_of_no_kind_are_words_and_no_empty_table() -> None:
    table = comparison_table(Check((), (), {("left", "roll"): "the flight has no two lines"}))
    assert isinstance(table, Words)
    assert table.text.endswith("Roll has no profiles: the flight has no two lines.")


def test_strips_of_one_colour_have_different_marks() -> None:
    assert marks_of(["red", "blue", "red", "red"]) == ["o", "o", "^", "s"]


def test_a_span_of_gps_time_names_its_week_once() -> None:
    assert gps_span_text(1_465_549_218_000_000_000, 1_465_549_220_500_000_000) == (
        "GPS week 2423, 118818.000 to 118820.500 s"
    )
    assert gps_span_text(604_799_000_000_000, 604_801_000_000_000) == "GPS week 0, 604799.000 s to GPS week 1, 1.000 s"


def test_times_of_a_short_flight_have_seconds() -> None:
    assert flown_words([(NINE_NS, NINE_NS + 55_000_000_000)]) == "2026-06-15, 09:00:00 to 09:00:55 UTC"


def test_a_unit_stays_with_its_number() -> None:
    assert "<li>shifted by 4\u00a0σ, −3\u00a0cm</li>" in html_of(
        Page("Kind", "one", PageHead(), [Notes(["shifted by 4 σ, -3 cm"])])
    )
    assert BEFORE_UNIT.sub("_", "12 knots, 5 s apart; 4.5 cm (15.3 σ), 3 strips, 20 % of 2 m²") == (
        "12 knots, 5_s apart; 4.5_cm (15.3_σ), 3 strips, 20_% of 2_m²"
    )


def test_a_unit_at_the_end_of_a_key_stands_behind_its_number() -> None:
    rows = rows_of(
        {"atmosphere": {"temperature_c": 15.0, "pressure_hpa": 1013.0, "model": "standard", "height_m": 0.0}}
    )
    assert rows == [("atmosphere", "temperature 15 °C, pressure 1013 hPa, model standard, height 0 m")]
    crs = rows_of({"crs": {"crs": "EPSG:32632", "accuracy_m": 0.5}})
    assert crs == [("CRS", "EPSG:32632"), ("CRS: accuracy", "0.5 m")]


def test_the_head_gives_flight_logs_aircraft_crs_calibration_and_software() -> None:
    crs = {"name": "ETRS89 / UTM zone 32N", "crs": "EPSG:25832", "heights": "ellipsoidal (GRS 1980)"}
    sidecar = {"software": "swath 0.0.9", "crs": crs, "flights": [flight_entry(), flight_entry(session="two")]}
    head = head_of_sidecars([sidecar, sidecar])
    assert head.rows() == [
        ("Flown", "2026-06-15, 09:00 to 09:02 UTC"),
        ("Logs", "one, two"),
        ("Aircraft", "HB-ABC"),
        ("CRS", "ETRS89 / UTM zone 32N (EPSG:25832); heights ellipsoidal (GRS 1980)"),
        ("Calibration", "c-1 of left, made 2026-05-01, usable with care"),
        ("By", "Aero Survey"),
        ("Software", f"Swath {__version__}; data by swath 0.0.9"),
    ]


def test_the_head_leaves_out_what_is_not_known() -> None:
    assert PageHead().rows() == [("Software", f"Swath {__version__}")]
    strange = {"flights": [3, {"returns_gps_ns": [1], "calibrations": 4, "session": None}], "crs": "EPSG:1"}
    assert head_of_sidecars([{}, strange], "local").rows() == [("CRS", "local"), ("Software", f"Swath {__version__}")]


def test_a_flight_over_midnight_has_both_dates() -> None:
    assert flown_words([]) == ""
    words = flown_words([(NINE_NS + DAY_NS, NINE_NS + DAY_NS + 60_000_000_000), (NINE_NS, NINE_NS + 1)])
    assert words == "2026-06-15 09:00 to 2026-06-16 09:01 UTC"


def test_a_calibration_without_a_verdict_is_called_nominal_only_if_it_is() -> None:
    assert calibration_words("left", {"id": "a", "method": "nominal"}) == "a of left, nominal, never estimated"
    assert calibration_words("left", {"id": "a", "method": "planes"}) == "a of left"
    assert calibration_words("", {"id": "a", "method": "nominal", "verdict": "good"}) == "a, good"


def test_a_long_definition_of_a_crs_is_not_repeated() -> None:
    assert crs_words({"name": "Local", "crs": "PROJCRS[" + 80 * "x"}) == "Local"
    assert crs_words({"name": "EPSG:4978", "crs": "EPSG:4978", "heights": "none: earth-centred"}) == "EPSG:4978"


def test_columns_that_say_nothing_are_left_out() -> None:
    rows: list[list[Cell]] = [["a", "–", "", "1", Judged("–", good=True), "x"], ["b", "–", "–", "–", "–", "y"]]
    table = Table("T", ("name", "none", "empty", "some", "judged", "words"), rows, left=(0, 4, 5), hashes=(5,))
    shown = table.known_columns()
    assert list(shown.heads) == ["name", "some", "words"]
    assert [list(row) for row in shown.rows] == [["a", "1", "x"], ["b", "–", "y"]]
    assert (shown.left, shown.hashes) == ((0, 2), (2,))
    full = Table("T", ("name", "some"), [["–", "1"]])
    assert full.known_columns() is full


def page_of(rows: int = 3) -> Page:
    """Return a page with a picture, a table and an appendix."""
    table = Table("Rows", ("name", "value, cm", "unknown"), [[f"row {n}", f"{n}", "–"] for n in range(rows)])
    head = PageHead("2026-06-15", ["one"], "HB-ABC", author="Aero <Survey>")
    return Page(
        "Test page", "Title & more", head, [Image("A map", DOT), table], appendix=[Words("x = a + b", "Formulas")]
    )


def test_numbers_have_a_minus_and_names_keep_their_hyphens() -> None:
    lines = ["add -0.5 to (-3) a-1", "2026-06-15", "+lat_0=-33", "x,-1.5"]
    text = html_of(Page("Test page", "Title", PageHead(), [Words(line) for line in lines]))
    for words in ("add −0.5 to (−3) a-1", "2026-06-15", "+lat_0=-33", "x,-1.5"):
        assert words in text, words


def test_a_page_ends_with_its_appendix_and_shows_no_empty_column() -> None:
    text = html_of(page_of())
    assert text.index("HB-ABC") < text.index("row 2") < text.index("<h1>Appendix</h1>") < text.index("x = a + b")
    assert "unknown" not in text
    assert faults_of(text) == []
    assert "<title>Title &amp; more: test page</title>" in text
    assert '<meta name="author" content="Aero &lt;Survey&gt;">' in text
    assert "Appendix" not in html_of(Page("Test page", "Title", PageHead(), []))


@pytest.mark.slow
def test_the_pdf_has_title_author_bookmarks_page_numbers_and_repeats_heads_of_tables() -> None:
    read = PdfReader(io.BytesIO(pdf_of(html_of(page_of(rows=200)))))
    assert read.metadata is not None
    assert (read.metadata.title, read.metadata.author) == ("Title & more: test page", "Aero <Survey>")
    assert read.metadata.creator == f"Swath {__version__}"
    assert titles_of(read.outline) == ["Title & more", ["A map", "Rows"], "Appendix", ["Formulas"]]
    pages = [page.extract_text() for page in read.pages]
    assert len(pages) >= 5
    for number, text in enumerate(pages, start=1):
        assert f"{number} of {len(pages)}" in text
        assert ("value, cm" in text) == ("row " in text)
    assert pages[-1].index("Appendix") < pages[-1].index("x = a + b")
    assert pages[-1].rfind("row ") < pages[-1].index("Appendix")


def titles_of(outline: Any) -> list[Any]:
    """Return the titles of bookmarks, those below one in a list after it."""
    return [titles_of(one) if isinstance(one, list) else one.title for one in outline]


def test_without_pango_the_page_is_written_alone_with_one_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(page: str) -> bytes:
        raise PdfUnavailableError(pdf.NO_PANGO)

    monkeypatch.setattr(pdf, "pdf_of", fails)
    warnings: list[str] = []
    assert page_files(Path("out/strips.html"), "text", warnings) == {Path("out/strips.html"): b"text"}
    assert warnings == [f"out/strips.pdf: not written, {pdf.NO_PANGO}; strips.html shows the same"]


def test_every_page_has_its_pdf_among_the_names() -> None:
    for names in OF_COMMAND.values():
        (page,) = (name for name in names if name.endswith(".html"))
        assert str(Path(page).with_suffix(PRINTED)) in names
