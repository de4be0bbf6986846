"""Asks a running recorder for something, over the control socket of its log directory."""

from __future__ import annotations

import json
import socket
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from daemon.control import socket_address
from daemon.errors import ExitCode, UserError, one_line
from daemon.parts import read_sign
from daemon.places import CONTROL_LINK

ANSWER_S = 5.0
ANSWER_BYTES = 1 << 16
NEW_PART_S = 15.0  # the next one is tried again after 10 s


def ask(directory: Path, request: Mapping[str, object]) -> dict[str, Any]:
    """A request and its answer.

    Raises:
        UserError: no recorder runs there, it may not be asked, it does not answer, or it refuses.
    """
    try:
        answer = json.loads(_exchange(directory / CONTROL_LINK, json.dumps(request).encode() + b"\n"))
    except (FileNotFoundError, ConnectionRefusedError) as error:
        raise UserError(f"{directory}: no recorder is running there", ExitCode.IO) from error
    except PermissionError as error:
        text = f"{directory}: not permitted; only the recorder's own user and root may, such as with sudo"
        raise UserError(text, ExitCode.IO) from error
    except (OSError, ValueError) as error:  # a time-out is one, no JSON the other
        raise UserError(f"{directory}: the recorder there does not answer", ExitCode.IO) from error
    if not answer.get("ok"):
        raise UserError(f"{directory}: {one_line(str(answer.get('error', 'refused')))}", ExitCode.PROBLEM)
    return dict(answer)


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
    """Connect, in turn where others wait too."""
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
    """Name of the part that grows once it is a later one than ``after``; None: there was none in the time."""
    deadline_s = time.monotonic() + timeout_s
    while time.monotonic() < deadline_s:
        sign = read_sign(directory)
        if sign is not None and sign.session_id == session_id and sign.part > after:
            return sign.path.name
        time.sleep(0.05)
    return None
