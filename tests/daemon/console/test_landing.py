"""Tests the page before landing as the console serves it: verdict, exports, downloads, the operator's word."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from swath.daemon.console.landing import note
from swath.daemon.recorder.control import NOTE_CHARACTERS
from tests.daemon.console.builders import Asked, console, verdict
from tests.daemon.log_check import read_log
from tests.daemon.rig import Recorder, free_udp_port, session_table, wait_until

SCRIPT = "<script>alert(1)</script>"


def predict(live: Path) -> None:
    """Write what the lines flown would determine of the calibration, as live does."""
    row = {"scanner": "left", "name": "omega_deg", "unit": "°", "sigma": 0.004, "wanted": 0.005, "determined": True}
    (live / "calibration.json").write_text(json.dumps({"strips": 3, "planes": 80, "rows": [row]}))


@pytest.fixture(scope="module")
def aircraft(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Asked, Path]]:
    """Record a silent source, with lines and a verdict as live writes them."""
    folder = tmp_path_factory.mktemp("landing")
    logs = folder / "logs"
    (logs / "live").mkdir(parents=True)
    lines = {"lines": [{"name": "4", "state": "remarks"}, {"name": "9", "state": "again"}]}
    (logs / "live/lines.json").write_text(json.dumps(lines))
    (logs / "live/verdict.json").write_text(json.dumps(verdict(note=SCRIPT)))
    config = session_table(logs) + f'[raw.camera]\ntransport = "udp:127.0.0.1:{free_udp_port()}"\n'
    with Recorder(folder, config) as recorder, console(recorder.config) as (asked, _):
        wait_until(lambda: asked.snapshot()["landing"], "the verdict")
        yield asked, logs


def test_the_verdict_is_served_as_live_wrote_it_and_told_to_all_pages(aircraft: tuple[Asked, Path]) -> None:
    asked, logs = aircraft
    found = asked.get("/verdict").plain()
    assert found["verdict"] == verdict(note=SCRIPT) | {"predicted": {}}
    short = asked.snapshot()["landing"]
    predict(logs / "live")
    later = asked.get("/verdict").plain()
    assert later["verdict"]["predicted"]["rows"][0]["sigma"] == 0.004
    assert later["sign"] != found["sign"]
    assert short == {"sign": found["sign"], "state": "again", "sentence": "Fly again: line 9"}


def test_only_the_named_products_are_served(aircraft: tuple[Asked, Path]) -> None:
    asked, logs = aircraft
    assert asked.get("/coverage.kmz").status == 404
    assert asked.get("/verdict").plain()["downloads"] == []
    (logs / "live/coverage.kmz").write_bytes(b"kmz")
    (logs / "live/coverage.tif").symlink_to("/etc/passwd")
    assert asked.get("/verdict").plain()["downloads"] == [{"name": "coverage.kmz", "bytes": 3}]
    found = asked.get("/coverage.kmz")
    assert (found.status, found.body) == (200, b"kmz")
    assert "attachment" in found.headers["content-disposition"]
    for path in ("/coverage.tif", "/verdict.json", "/live.json", "/coverage.json", "/coverage.kmz/..%2flive.json"):
        assert asked.get(path).status == 404, path


def test_the_operator_s_word_and_the_verdict_go_into_the_log(aircraft: tuple[Asked, Path]) -> None:
    asked, logs = aircraft
    said = [
        asked.post("/overrule", {"line": "9", "verdict": "accepted", "note": f" clouds {SCRIPT} "}),
        asked.post("/overrule", {"line": "4", "verdict": "again"}),
        asked.post("/overrule", {"line": "4", "verdict": "reset", "note": ""}),
        asked.post("/landing", {}),
    ]
    wanted = [f"line 9: accepted, clouds {SCRIPT}", "line 4: again", "line 4: reset", "landing: Fly again: line 9"]
    assert [one.status for one in said] == [200] * 4, [one.body for one in said]
    (log,) = logs.glob("*.mcap")
    wait_until(lambda: [event["text"] for event in read_log(log).events("mark")] == wanted, "the marks in the log")
    for wrong in (
        {"line": "5", "verdict": "again"},
        {"line": "9", "verdict": "fine"},
        {"line": None, "verdict": "again"},
        {"line": "9", "verdict": "again", "note": 7},
        {"line": "9", "verdict": "again", "note": "x" * NOTE_CHARACTERS},
        {"line": "9", "verdict": "again", "note": "two\nlines"},
        {},
    ):
        assert asked.post("/overrule", wrong).status == 400, wrong


def test_a_sentence_fits_into_a_mark() -> None:
    assert note("landing: a\nb") == "landing: a b"
    long = note("landing: " + "line, " * 200)
    assert (len(long), long[-1]) == (NOTE_CHARACTERS, "…")


def test_without_a_verdict_nothing_is_written_or_printed(tmp_path: Path) -> None:
    with console(tmp_path) as (asked, _):
        assert asked.get("/verdict").plain() == {"verdict": None, "sign": "", "downloads": []}
        assert asked.get("/landing.pdf").status == 404
        assert asked.post("/landing", {}).status == 409
        assert asked.post("/overrule", {"line": "4", "verdict": "again"}).status == 400


@pytest.mark.slow
def test_page_and_pdf_are_made_once_for_each_verdict(aircraft: tuple[Asked, Path]) -> None:
    asked, logs = aircraft
    predict(logs / "live")
    pdf = asked.get("/landing.pdf")
    assert (pdf.status, pdf.headers["content-type"], pdf.body[:5]) == (200, "application/pdf", b"%PDF-")
    page = asked.get("/landing.html")
    assert page.status == 200
    text = page.body.decode()
    assert "Fly again: line 9." in text
    assert "left roll (ω)" in text
    assert SCRIPT not in text
    assert "attachment" in page.headers["content-disposition"]
    assert asked.get("/landing.pdf").body == pdf.body
    changed = logs / "live/verdict.new"
    changed.write_text(json.dumps(verdict(name="11")))
    os.replace(changed, logs / "live/verdict.json")
    assert b"Fly again: line 11." in asked.get("/landing.html").body
    (logs / "live/verdict.json").write_text("{}")
    assert asked.get("/landing.pdf").status == 500
