"""Tests a running console: what it tells of a recording, what it asks of the recorder, whom it refuses."""

from __future__ import annotations

import json
import re
import socket
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import psutil
import pytest

from swath.daemon.console.guard import HEADERS
from swath.daemon.processing.live.tiles import SIDE
from tests.daemon.console.builders import Asked, console, write_map
from tests.daemon.log_check import read_log
from tests.daemon.rig import HANGS_S, Recorder, free_udp_port, session_table, wait_until

SCRIPT = "<img src=x onerror=alert(1)><script>alert(2)</script>"


@dataclass
class Aircraft:
    """A recorder with a scanner that sends nothing, and its console."""

    asked: Asked
    logs: Path
    memory: psutil.Process


@pytest.fixture(scope="module")
def aircraft(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Aircraft]:
    folder = tmp_path_factory.mktemp("aircraft")
    logs = folder / "logs"
    logs.mkdir()
    config = session_table(logs) + (
        f'[raw.camera]\ntransport = "udp:127.0.0.1:{free_udp_port()}"\n'
        '[console]\nmarks = ["line start", "turbulence"]\n'
    )
    with Recorder(folder, config) as recorder, console(recorder.config) as (asked, process):
        wait_until(lambda: asked.snapshot()["sources"], "a source")
        yield Aircraft(asked, logs, psutil.Process(process.pid))


def texts(asked: Asked) -> list[str]:
    return [event["text"] for event in asked.snapshot()["events"]]


@pytest.mark.slow
def test_a_recording_is_told_by_state_sentence_and_sources(aircraft: Aircraft) -> None:
    wait_until(lambda: aircraft.asked.snapshot()["sources"]["raw/camera"]["state"] == "silent", "a silent source")
    found = aircraft.asked.snapshot()
    assert found["header"]["state"] == "DEGRADED"
    assert "raw/camera" in found["header"]["sentence"]
    assert found["header"]["time"] is None
    assert found["header"]["hours_left"] is None or found["header"]["hours_left"] > 0.0
    assert abs(found["header"]["begun_ms"] - time.time() * 1000) < 600_000
    assert not found["live_is_current"]
    assert [event["code"] for event in found["events"]][:1] == ["session_started"]
    history = aircraft.asked.get("/history").plain()
    assert len(history["time_ms"]) == len(history["series"]["disk free, GB"]) > 0


def test_a_mark_is_in_the_log_and_on_the_page(aircraft: Aircraft) -> None:
    told = aircraft.asked.post("/mark", {"text": SCRIPT})
    assert told.status == 200, told.body
    assert told.plain()["text"] == SCRIPT
    wait_until(lambda: SCRIPT in texts(aircraft.asked), "the mark")
    (log,) = aircraft.logs.glob("*.mcap")
    wait_until(lambda: SCRIPT in [event["text"] for event in read_log(log).events("mark")], "the mark in the log")
    for wrong in ("", "  ", "x" * 5000, "line\nbreak", 7, None):
        assert aircraft.asked.post("/mark", {"text": wrong}).status in (400, 413), wrong


def test_the_keys_have_the_texts_of_the_configuration(aircraft: Aircraft) -> None:
    assert aircraft.asked.get("/about").plain() == {"marks": ["line start", "turbulence"], "asks": True}


def test_a_new_part_begins_when_asked(aircraft: Aircraft) -> None:
    before = aircraft.asked.snapshot()["header"]["part"]
    assert aircraft.asked.post("/split", {}).status == 200
    wait_until(lambda: aircraft.asked.snapshot()["header"]["part"] == before + 1, "the next part")


def test_the_console_loads_no_compiler(aircraft: Aircraft) -> None:
    """Its unit forbids memory that is both written and executed, without which llvmlite does not start."""
    mapped = {Path(one.path).name for one in aircraft.memory.memory_maps()}
    assert any(name.startswith("_multiarray_umath") for name in mapped)
    assert not any("llvmlite" in name for name in mapped)


def test_every_page_has_the_headers_that_keep_others_code_out(aircraft: Aircraft) -> None:
    pages = ("/", "/pilot", "/landing", "/login")
    for path in (*pages, "/assets/console.js", "/assets/leaflet/leaflet.js", "/about", "/nothing"):
        found = aircraft.asked.get(path)
        assert {name: found.headers.get(name) for name in HEADERS} == HEADERS, path
        if b"<html" in found.body:
            text = found.body.decode()
            assert "<style" not in text
            assert "style=" not in text
            assert not re.search(r"\son[a-z]+=", text)
            assert all("src=" in tag for tag in text.split("<script")[1:])


@pytest.mark.parametrize(
    "path",
    [
        "/assets/../serve.py",
        "/assets/..%2fserve.py",
        "/assets/%2e%2e/serve.py",
        "/assets/leaflet/../../../../../../etc/passwd",
        "/assets/leaflet/..%2f..%2f..%2f__init__.py",
        "/assets//etc/passwd",
        "/assets/console.js%00.html",
        "/tiles/height/0/0/0.png/../../../../etc/passwd",
        "/tiles/../../live.json",
        "/tiles/height/9/0/0.png",
        "/tiles/height/0/99999999999/0.png",
        "/tiles/nothing/0/0/0.png",
    ],
)
def test_nothing_but_the_console_s_own_files_is_served(aircraft: Aircraft, path: str) -> None:
    found = aircraft.asked.get(path)
    assert found.status == 404, (path, found.body[:200])
    assert b"root:" not in found.body
    assert b"import" not in found.body


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({"Host": "evil.example"}, 421),
        ({"Host": "127.0.0.1.evil.example:8470"}, 421),
        ({"Host": ""}, 421),
        ({"Origin": "http://evil.example"}, 403),
        ({"Origin": "null"}, 403),
        ({"Sec_Fetch_Site": "cross-site"}, 403),
        ({"Sec_Fetch_Site": "same-site"}, 403),
    ],
)
def test_another_site_s_page_gets_nothing(aircraft: Aircraft, headers: dict[str, str], status: int) -> None:
    for path in ("/feed", "/about", "/history"):
        assert aircraft.asked.get(path, **headers).status == status
    marked = aircraft.asked.post("/mark", {"text": "of a stranger"}, **headers)
    assert marked.status == status
    assert "of a stranger" not in texts(aircraft.asked)


def test_what_changes_something_takes_json_from_the_own_origin_only(aircraft: Aircraft) -> None:
    body = json.dumps({"text": "of a form"}).encode()
    own = {"Origin": aircraft.asked.url}
    assert aircraft.asked.ask("POST", "/mark", body, {"Content-Type": "application/json"}).status == 403
    assert aircraft.asked.ask("POST", "/mark", body, own | {"Content-Type": "text/plain"}).status == 403
    assert aircraft.asked.get("/mark").status == 405
    assert "of a form" not in texts(aircraft.asked)


def test_long_requests_are_ended(aircraft: Aircraft) -> None:
    long = json.dumps({"text": "x" * 1_000_000}).encode()
    own = {"Origin": aircraft.asked.url, "Content-Type": "application/json"}
    try:
        assert aircraft.asked.ask("POST", "/mark", long, own).status >= 400
    except OSError:
        pass  # the connection was closed while the body was being sent
    assert aircraft.asked.get("/" + "x" * 100_000).status >= 400
    assert aircraft.asked.get("/about").status == 200


@pytest.mark.slow
def test_a_thousand_connections_and_readers_that_read_nothing_leave_it_well(aircraft: Aircraft) -> None:
    """Silent connections are closed, feeds beyond the limit refused; memory is bounded and pages go on."""
    before = aircraft.memory.memory_info().rss
    opened = []
    try:
        for number in range(1000):
            sock = socket.create_connection(("127.0.0.1", aircraft.asked.port), HANGS_S)
            opened.append(sock)
            if number % 10 == 0:
                sock.sendall(f"GET /feed HTTP/1.1\r\nHost: 127.0.0.1:{aircraft.asked.port}\r\n\r\n".encode())

        def asked_again() -> bool:
            try:
                return aircraft.asked.get("/about").status == 200
            except OSError:
                return False

        wait_until(asked_again, "an answer once the silent connections are closed", 60.0)
        assert aircraft.memory.memory_info().rss - before < 100e6
    finally:
        for sock in opened:
            sock.close()
    wait_until(lambda: aircraft.asked.snapshot()["header"]["state"], "a snapshot")


def test_the_map_is_painted_as_live_writes_it(tmp_path: Path) -> None:
    (tmp_path / "live").mkdir()
    with console(tmp_path) as (asked, _):
        assert asked.snapshot()["header"]["state"] == "NOT RECORDING"
        assert asked.snapshot()["extent_m"] is None
        empty = asked.get("/tiles/density/0/0/-1.png")
        points = np.full((SIDE, SIDE), 5, np.uint32)
        write_map(tmp_path / "live", {(0, 0): {"points": points}})
        (tmp_path / "live/live.json").write_text(json.dumps({"state": "following", "tiles": {"sequence": 1}}))
        wait_until(lambda: asked.snapshot()["live"].get("tiles") == {"sequence": 1}, "live's status")
        painted = asked.get("/tiles/density/0/0/-1.png?s=1")
        assert painted.headers["content-type"] == "image/png"
        assert painted.body != empty.body
        wait_until(lambda: asked.snapshot()["extent_m"] == [0.0, 0.0, 128.0, 128.0], "the map's edges")
        the_last_moments_are_given_once(asked, tmp_path / "live")


def the_last_moments_are_given_once(asked: Asked, live: Path) -> None:
    """Ask with the sign of what a page has: it gets nothing until live replaces the file."""
    assert asked.get("/look/profile").status == asked.get("/look/recent").status == 204  # live has written none yet
    assert asked.get("/look/live").status == asked.get("/look/..%2flive.json").status == 404
    for name, file in (("profile", "profile.json"), ("recent", "recent.bin")):
        (live / file).write_bytes(b"before")
        first = asked.get(f"/look/{name}")
        assert (first.status, first.body) == (200, b"before")
        sign = first.headers["etag"]
        assert asked.get(f"/look/{name}", If_None_Match=sign).status == 304
        (live / file).write_bytes(b"afterwards")
        assert asked.get(f"/look/{name}", If_None_Match=sign).body == b"afterwards"


def test_pages_are_told_that_the_map_has_changed(tmp_path: Path) -> None:
    live = tmp_path / "live"
    with console(tmp_path) as (asked, _):
        shown = (found["map"] for found in asked.feed())
        seen = [next(shown)]
        for _ in range(3):
            write_map(live, {(0, 0): {"points": np.ones((SIDE, SIDE), np.uint32)}})
            seen.append(next(sign for sign in shown if sign != seen[-1]))
        assert asked.snapshot()["map"] == seen[-1]
    assert (seen[0], len(set(seen))) == ("", 4)


def test_files_that_are_no_json_leave_the_console_well(tmp_path: Path) -> None:
    live = tmp_path / "live"
    live.mkdir()
    for content in (b"", b"{", b"[1]", b"\xff\xfe", b"[" * 100_000, b"null"):
        (live / "live.json").write_bytes(content)
        (live / "lines.json").write_bytes(content)
    with console(tmp_path) as (asked, _):
        found = asked.snapshot()
        assert found["live"] == {}
        assert found["lines"] == {}
