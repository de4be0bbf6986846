"""Tests who may see the console: tokens, sessions, failures."""

from __future__ import annotations

from pathlib import Path

import pytest

from swath.daemon.console import serve
from swath.daemon.console.access import (
    FAILURES,
    IDLE_S,
    MOST_SESSIONS,
    OPERATOR,
    SESSION_S,
    VIEWER,
    Access,
    read_tokens,
)
from swath.daemon.errors import UserError


class Clock:
    """A clock that is set."""

    now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


def test_tokens_are_made_once_and_private(tmp_path: Path) -> None:
    folder = tmp_path / "state"
    tokens = read_tokens(folder)
    assert tokens == read_tokens(folder)
    assert set(tokens) == {VIEWER, OPERATOR}
    assert len(set(tokens.values())) == 2
    assert (folder / "tokens.json").stat().st_mode & 0o777 == 0o600
    (folder / "tokens.json").chmod(0o640)
    with pytest.raises(UserError, match="others may read it"):
        read_tokens(folder)


@pytest.mark.parametrize("content", ["", "{}", "[]", '{"viewer": "short", "operator": "short"}', '{"viewer": 1}'])
def test_a_file_without_tokens_is_refused_with_the_remedy(tmp_path: Path, content: str) -> None:
    path = tmp_path / "tokens.json"
    path.write_text(content)
    path.chmod(0o600)
    with pytest.raises(UserError, match="new ones are made"):
        read_tokens(tmp_path)


def test_the_service_and_its_user_have_one_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The user of the service pairs outside its unit, where systemd names no folder."""
    monkeypatch.delenv("STATE_DIRECTORY", raising=False)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "home"))
    monkeypatch.setattr(serve, "SERVICE_STATE", tmp_path / "service")
    assert serve.state_folder() == tmp_path / "home/swath-console"
    (tmp_path / "service").mkdir()
    assert serve.state_folder() == tmp_path / "service"
    monkeypatch.setenv("STATE_DIRECTORY", "/of/the/unit")
    assert serve.state_folder() == Path("/of/the/unit")


def test_sessions_have_the_role_of_their_token_and_end() -> None:
    clock = Clock()
    access = Access({VIEWER: "v" * 20, OPERATOR: "o" * 20}, clock)
    viewer, operator = access.open_session("v" * 20, "a"), access.open_session("o" * 20, "a")
    assert viewer is not None
    assert operator is not None
    assert [access.role_of(cookie) for cookie in (viewer, operator, "", viewer[:-1])] == [VIEWER, OPERATOR, None, None]
    access.end_session(viewer)
    assert access.role_of(viewer) is None
    clock.now_s = IDLE_S + 1.0
    assert access.role_of(operator) is None  # not used for so long
    busy = access.open_session("o" * 20, "a")
    assert busy is not None
    begun_s = clock.now_s
    while clock.now_s < begun_s + SESSION_S - IDLE_S / 2:
        clock.now_s += IDLE_S / 2
        assert access.role_of(busy) == OPERATOR
    clock.now_s = begun_s + SESSION_S + 1.0
    assert access.role_of(busy) is None


def test_an_address_that_fails_too_often_waits_and_others_do_not() -> None:
    clock = Clock()
    access = Access({VIEWER: "v" * 20, OPERATOR: "o" * 20}, clock)
    for _ in range(FAILURES):
        assert not access.must_wait("a")
        assert access.open_session("wrong", "a") is None
    assert access.must_wait("a")
    assert not access.must_wait("b")
    clock.now_s = 61.0
    assert not access.must_wait("a")


def test_memory_for_sessions_and_failures_is_bounded() -> None:
    access = Access({VIEWER: "v" * 20, OPERATOR: "o" * 20})
    cookies = [access.open_session("v" * 20, "a") for _ in range(MOST_SESSIONS + 1)]
    assert access.role_of(str(cookies[0])) is None
    assert access.role_of(str(cookies[-1])) == VIEWER
    for number in range(3000):
        access.open_session("wrong", str(number))
    assert len(access._failures) <= 1000
