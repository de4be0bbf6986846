"""Tests foreign input to the recorder's commands: an answer, a sign, a status, any text."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from swath.daemon.errors import ExitCode, UserError, one_line
from swath.daemon.log.parts import RECORDING_SIGN, read_sign
from swath.daemon.monitor.source import usable_status
from swath.daemon.processing.live.follow import _parts_before
from swath.daemon.recorder import control_client
from swath.daemon.recorder.control_client import ask

ANSWER = {"ok": True, "session_id": "a", "part": 3, "recording": True, "reason": "", "time_ns": 5, "text": "x"}
SIGN = {"session_id": "a-20261121T100000Z-ab12", "part": 1, "path": "a_1.mcap", "boot_id": "b"}


def test_foreign_text_becomes_one_encodable_line() -> None:
    assert one_line("a\nb\x1b[2J\u2028σ") == "a b [2J σ"
    assert one_line("/mnt/\udcff.mcap").encode() == rb"/mnt/\udcff.mcap"


@pytest.mark.parametrize(
    "answer",
    [
        [],
        {},
        {"ok": 1},
        {**ANSWER, "part": True},
        {**ANSWER, "time_ns": 1e300},
        {**ANSWER, "time_ns": -1},
        {"ok": False},
    ],
)
def test_an_invalid_response_of_a_recorder_is_refused(answer: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(control_client, "_exchange", lambda *_: json.dumps(answer).encode())
    with pytest.raises(
        UserError, match="the recorder there is of another version; restart it after an update"
    ) as refused:
        ask(Path("/logs"), {"command": "mark", "text": "x"})
    assert refused.value.exit_code == ExitCode.IO


def test_a_response_contains_the_requested_fields_as_single_lines(monkeypatch: pytest.MonkeyPatch) -> None:
    said = json.dumps({**ANSWER, "text": "a\x1b\nb", "more": 1}).encode()
    monkeypatch.setattr(control_client, "_exchange", lambda *_: said)
    assert ask(Path("/logs"), {"command": "mark"}) == {**ANSWER, "text": "a b"}
    assert "time_ns" not in ask(Path("/logs"), {"command": "split"})


def test_an_empty_response_is_not_a_recorders_response(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(control_client, "_exchange", lambda *_: b"")
    with pytest.raises(UserError, match="the recorder there does not answer"):
        ask(Path("/logs"), {"command": "split"})


@pytest.mark.parametrize(
    "changes",
    [
        *({"part": value} for value in (-1, 1_000_000, True, 1.0, "1", None)),
        *({"path": value} for value in ("a_1.txt", "a\0.mcap", "\ud800.mcap", "..", "", 3)),
        *({"session_id": value} for value in ("../a", "a/b", "", "a\0", 5, "a" * 300)),
    ],
)
def test_an_invalid_recording_sign_is_ignored(changes: dict[str, Any], tmp_path: Path) -> None:
    (tmp_path / RECORDING_SIGN).write_text(json.dumps(SIGN))
    assert read_sign(tmp_path) is not None
    (tmp_path / RECORDING_SIGN).write_text(json.dumps(SIGN | changes))
    assert read_sign(tmp_path) is None


def test_previous_parts_are_the_existing_files_only(tmp_path: Path) -> None:
    """However high a number the sign names, each file is examined once."""
    (tmp_path / RECORDING_SIGN).write_text(json.dumps(SIGN | {"part": 999_999}))
    sign = read_sign(tmp_path)
    assert sign is not None
    names = [f"{sign.session_id}_{number}.mcap" for number in (0, 2, 10, 999_999, "01", "x")]
    for name in [*names, "other_0.mcap"]:
        (tmp_path / name).touch()
    assert [path.name for path in _parts_before(tmp_path, sign)] == names[:3]


def test_only_displayable_values_of_a_status_are_kept() -> None:
    good = {"units": 5, "bytes": 7, "lost_kernel": 1, "lost_queue": 0, "lost_write": 0, "state": "receiving"}
    assert usable_status({**good, "time_sigma_ns": 5.5}) == {**good, "last_unit_age_s": None, "time_sigma_ns": 5.5}
    strange = usable_status(
        {"units": "5", "bytes": True, "lost_write": 1 << 70, "last_unit_age_s": float("nan"), "state": []}
    )
    assert strange == dict.fromkeys(good, 0) | {"state": "[]", "last_unit_age_s": None}
