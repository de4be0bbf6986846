"""Decides who may see and who may ask: tokens in a private file, sessions in memory, a limit on failures."""

from __future__ import annotations

import hashlib
import hmac
import json
import os
import secrets
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from swath.daemon.errors import ExitCode, UserError

VIEWER, OPERATOR = "viewer", "operator"
ROLES = (VIEWER, OPERATOR)
TOKENS = "tokens.json"
SESSION_S = 12 * 3600.0
IDLE_S = 2 * 3600.0
MOST_SESSIONS = 200
FAILURES, FAILURE_S = 10, 60.0  # so many of an address in so long, then it waits
MOST_ADDRESSES = 1000


def read_tokens(folder: Path) -> dict[str, str]:
    """Return the tokens by role; make them, readable by this user alone, if there are none.

    Raises:
        UserError: the file cannot be written, others may read it, or it holds no tokens.
    """
    path = folder / TOKENS
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        if not path.exists():
            made = {role: secrets.token_urlsafe(24) for role in ROLES}
            with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as file:
                json.dump(made, file)
        if path.stat().st_mode & 0o077:
            raise UserError(f"{path}: others may read it; chmod 600 {path}", ExitCode.USAGE)
        found = json.loads(path.read_text())
        tokens = {role: found[role] for role in ROLES}
    except OSError as error:
        raise UserError(f"{path}: {error.strerror}; the console keeps its tokens there", ExitCode.IO) from error
    except (ValueError, KeyError, TypeError) as error:
        raise UserError(f"{path}: holds no tokens; remove it, and new ones are made", ExitCode.USAGE) from error
    if not all(isinstance(token, str) and len(token) >= 16 for token in tokens.values()):
        raise UserError(
            f"{path}: a token is shorter than 16 characters; remove it, and new ones are made", ExitCode.USAGE
        )
    return tokens


@dataclass(slots=True)
class _Session:
    role: str
    until_s: float
    idle_until_s: float


@dataclass
class Access:
    """Tokens, sessions and failures.

    Args:
        tokens: token by role; empty: whoever reaches the port is the operator, which only localhost may be.
        now_s: clock.
    """

    tokens: dict[str, str]
    now_s: Callable[[], float] = time.monotonic
    _sessions: dict[str, _Session] = field(default_factory=dict)
    _failures: dict[str, list[float]] = field(default_factory=dict)

    def role_of(self, cookie: str) -> str | None:
        """Return the role of a session; None if there is no such session, or it has ended."""
        if not self.tokens:
            return OPERATOR
        session = self._sessions.get(_digest(cookie))
        now_s = self.now_s()
        if session is None or now_s > session.until_s or now_s > session.idle_until_s:
            self._sessions.pop(_digest(cookie), None)
            return None
        session.idle_until_s = now_s + IDLE_S
        return session.role

    def must_wait(self, address: str) -> bool:
        """Return True if an address has failed too often of late."""
        recent = [at_s for at_s in self._failures.get(address, ()) if self.now_s() - at_s < FAILURE_S]
        if recent:
            self._failures[address] = recent
        else:
            self._failures.pop(address, None)
        return len(recent) >= FAILURES

    def open_session(self, token: str, address: str) -> str | None:
        """Return a new session's cookie; None if no role has this token, which counts as a failure of the address."""
        role = None
        for name, known in self.tokens.items():  # all are compared, in constant time
            if hmac.compare_digest(known.encode(), token.encode()):
                role = name
        if role is None:
            while len(self._failures) >= MOST_ADDRESSES:
                self._failures.pop(next(iter(self._failures)))
            self._failures.setdefault(address, []).append(self.now_s())
            return None
        while len(self._sessions) >= MOST_SESSIONS:
            self._sessions.pop(next(iter(self._sessions)))
        cookie = secrets.token_urlsafe(32)
        self._sessions[_digest(cookie)] = _Session(role, self.now_s() + SESSION_S, self.now_s() + IDLE_S)
        return cookie

    def end_session(self, cookie: str) -> None:
        """End a session."""
        self._sessions.pop(_digest(cookie), None)


def _digest(cookie: str) -> str:
    return hashlib.sha256(cookie.encode()).hexdigest()
