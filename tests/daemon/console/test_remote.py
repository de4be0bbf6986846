"""Tests a console beyond this computer: TLS, tokens, roles, pairing."""

from __future__ import annotations

import json
import ssl
from collections.abc import Iterator
from hashlib import sha256
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from swath.daemon.config.listen import parse_listen
from swath.daemon.config.tables import ConsoleConfig
from swath.daemon.console.access import FAILURES, OPERATOR, VIEWER
from swath.daemon.console.serve import pairing_text, state_folder
from swath.daemon.errors import UserError
from tests.daemon.console.builders import Asked, console

pytestmark = pytest.mark.slow


@pytest.fixture
def remote(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Asked]:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    (tmp_path / "logs").mkdir()
    with console(tmp_path / "logs", address="0.0.0.0") as (asked, _):
        yield asked


def token_of(role: str) -> str:
    token: str = json.loads((state_folder() / "tokens.json").read_text())[role]
    return token


def session_of(asked: Asked, role: str) -> str:
    opened = asked.post("/session", {"token": token_of(role)})
    assert opened.status == 200, opened.body
    cookie = opened.headers["set-cookie"]
    assert {"HttpOnly", "Secure", "SameSite=strict"} <= set(cookie.split("; "))
    return cookie.partition(";")[0]


def test_a_token_opens_what_its_role_may_do(remote: Asked) -> None:
    ours = ("/landing", "/verdict", "/landing.pdf", "/coverage.kmz")
    for path in ("/feed", "/about", "/history", "/tiles/height/0/0/0.png", "/", *ours):
        assert remote.get(path).status == 401, path
        assert remote.get(path, Cookie="swath_console=guessed").status == 401, path
    for path in ("/mark", "/split", "/session/end", "/landing", "/overrule"):
        assert remote.post(path, {"text": "of a stranger"}).status == 401, path
    page = remote.get("/", Accept="text/html")
    assert (page.status, page.headers["location"]) == (303, "/login")
    assert remote.get("/login").status == 200

    viewer, operator = session_of(remote, VIEWER), session_of(remote, OPERATOR)
    assert next(remote.feed(Cookie=viewer))["header"]["state"] == "NOT RECORDING"
    assert remote.post("/mark", {"text": "by a viewer"}, Cookie=viewer).status == 403
    assert remote.get("/verdict", Cookie=viewer).status == 200
    for path in ("/landing", "/overrule"):
        assert remote.post(path, {"line": "4", "verdict": "again"}, Cookie=viewer).status == 403
    refused = remote.post("/mark", {"text": "by the operator"}, Cookie=operator)
    assert (refused.status, "no recorder is running" in refused.plain()["error"]) == (409, True)
    assert remote.post("/session/end", {}, Cookie=operator).status == 200
    assert remote.get("/about", Cookie=operator).status == 401
    assert remote.get("/about", Cookie=viewer).status == 200


def test_guessing_is_slowed_down_and_files_are_private(remote: Asked) -> None:
    for wrong in ("", "wrong", 7, None, "x" * 3000, *("guess" for _ in range(FAILURES - 5))):
        assert remote.post("/session", {"token": wrong}).status == 401
    assert remote.post("/session", {"token": token_of(OPERATOR)}).status == 429
    for name in ("tokens.json", "key.pem"):
        assert (state_folder() / name).stat().st_mode & 0o777 == 0o600, name


def test_pairing_shows_address_token_and_the_certificate_that_is_served(remote: Asked) -> None:
    place = parse_listen(f"0.0.0.0:{remote.port}")
    text = pairing_text(place, ConsoleConfig(names=["aircraft.local"]), viewer=True)
    address = urlsplit(text.splitlines()[0])
    assert (address.scheme, address.hostname, address.port) == ("https", "aircraft.local", remote.port)
    assert (address.path, address.fragment) == ("/login", token_of(VIEWER))
    served = ssl.PEM_cert_to_DER_cert(ssl.get_server_certificate(("127.0.0.1", remote.port)))
    assert text.splitlines()[-1].replace(":", "").lower() == sha256(served).hexdigest()


def test_pairing_on_this_computer_only_is_refused_with_the_remedy() -> None:
    with pytest.raises(UserError, match="no token is needed"):
        pairing_text(parse_listen("127.0.0.1:8470"), ConsoleConfig(), viewer=False)
