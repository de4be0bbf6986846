"""Sends a request to a running recorder, over the control socket of its log directory."""

from __future__ import annotations

import json
import socket
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from swath.daemon.errors import ExitCode, UserError, one_line
from swath.daemon.log.directory import CONTROL_LINK
from swath.daemon.log.parts import read_sign
from swath.daemon.recorder.control import socket_address

ANSWER_S = 5.0
ANSWER_BYTES = 1 << 16
SHOWN_CHARACTERS = 1000  # of a text in the answer
LATEST_NS = 1 << 63
NEW_PART_S = 15.0  # the recorder retries a failed new part after 10 s


_OF_ALL: dict[str, type] = {"session_id": str, "part": int, "recording": bool, "reason": str}
_OF_COMMAND: dict[str, dict[str, type]] = {"mark": {"time_ns": int, "text": str}}


def ask(directory: Path, request: Mapping[str, str]) -> dict[str, Any]:
    """Send a request and return its answer, which has all keys of the command's answer, with each text in one line.

    Raises:
        UserError: no recorder runs there, this user may not ask it, it gives no valid answer, or it refuses.
    """
    try:
        reply = _exchange(directory / CONTROL_LINK, json.dumps(request).encode() + b"\n")
    except (FileNotFoundError, ConnectionRefusedError) as error:
        raise UserError(f"{directory}: no recorder is running there", ExitCode.IO) from error
    except PermissionError as error:
        text = (
            f"{directory}: not permitted; run this as root (sudo), as a member of group swath or as the recorder's user"
        )
        raise UserError(text, ExitCode.IO) from error
    except OSError as error:  # includes a time-out
        raise UserError(f"{directory}: the recorder there does not answer; see its journal", ExitCode.IO) from error
    if not reply:
        raise UserError(f"{directory}: the recorder there does not answer; see its journal", ExitCode.IO)
    try:
        answer = _understood(reply, _OF_ALL | _OF_COMMAND.get(request["command"], {}))
    except (ValueError, RecursionError) as error:
        text = f"{directory}: the recorder there is of another version; restart it after an update"
        raise UserError(text, ExitCode.IO) from error
    if not answer["ok"]:
        raise UserError(f"{directory}: {answer['error']}", ExitCode.PROBLEM)
    return answer


def _understood(reply: bytes, wanted: Mapping[str, type]) -> dict[str, Any]:
    """Parse an answer or a refusal; raises ValueError or RecursionError if it is neither."""
    answer = json.loads(reply)
    refused = isinstance(answer, dict) and answer.get("ok") is False
    wanted = {"ok": bool} | ({"error": str} if refused else dict(wanted))
    if not isinstance(answer, dict) or not all(type(answer.get(key)) is kind for key, kind in wanted.items()):
        raise ValueError(f"want {', '.join(wanted)}")
    if "time_ns" in wanted and not 0 <= answer["time_ns"] < LATEST_NS:
        raise ValueError("want a time of this age")
    return {
        key: one_line(answer[key])[:SHOWN_CHARACTERS] if kind is str else answer[key] for key, kind in wanted.items()
    }


def _exchange(place: Path, line: bytes) -> bytes:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as sock, socket_address(place) as address:
        sock.settimeout(ANSWER_S)
        _connect(sock, address)
        sock.sendall(line)
        answer = b""
        while b"\n" not in answer and len(answer) < ANSWER_BYTES and (got := sock.recv(4096)):
            answer += got
        return answer


def _connect(sock: socket.socket, address: str) -> None:
    """Connect, and retry while the queue of waiting connections is full."""
    deadline_s = time.monotonic() + ANSWER_S
    while True:
        try:
            sock.connect(address)
        except BlockingIOError:
            if time.monotonic() > deadline_s:
                raise
            time.sleep(0.01)
        else:
            return


def wait_for_part(directory: Path, session_id: str, after: int, timeout_s: float = NEW_PART_S) -> str | None:
    """Wait for a part later than ``after`` and return its file name; return None if none begins in time."""
    deadline_s = time.monotonic() + timeout_s
    while time.monotonic() < deadline_s:
        sign = read_sign(directory)
        if sign is not None and sign.session_id == session_id and sign.part > after:
            return sign.path.name
        time.sleep(0.05)
    return None
