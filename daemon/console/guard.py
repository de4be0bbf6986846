"""Stands before every page: host and origin, session and role, the headers that keep other sites' code out."""

from __future__ import annotations

import json
from collections.abc import Iterable
from http.cookies import CookieError, SimpleCookie
from typing import Any
from urllib.parse import urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import ClientDisconnect, Request
from starlette.responses import JSONResponse, RedirectResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from swath.daemon.console.access import OPERATOR, Access

COOKIE = "swath_console"
BODY_BYTES = 4096
OPEN_TO_ALL = ("/login", "/session")  # and the assets, which hold nothing of a flight
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; connect-src 'self'; "
    "manifest-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
HEADERS = {
    "content-security-policy": POLICY,
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
    "referrer-policy": "no-referrer",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "permissions-policy": "geolocation=(), camera=(), microphone=()",
}


class Guard:
    """Wraps the application; refuses what does not come from its own pages.

    Args:
        app: the application.
        access: who may do what.
        hosts: names and addresses, without port, under which the console may be called; a page that a foreign name
            leads here (DNS rebinding) is none of them.
        secure: True behind TLS.
    """

    def __init__(self, app: ASGIApp, access: Access, hosts: Iterable[str], *, secure: bool) -> None:
        self._app, self._access, self._secure = app, access, secure
        self._hosts = frozenset(host.lower() for host in hosts)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        if scope["type"] != "http":
            return  # nothing here speaks WebSocket
        refused = self._refused(scope)
        app = self._app if refused is None else refused
        await app(scope, _Limited(receive, BODY_BYTES), _with_headers(send))

    def _refused(self, scope: Scope) -> ASGIApp | None:
        headers = Headers(scope=scope)
        host = headers.get("host", "")
        if _name_of(host) not in self._hosts:
            return JSONResponse({"error": "the console is not called by this name"}, 421)
        origin = headers.get("origin")
        asks = scope["method"] not in ("GET", "HEAD")
        scheme = "https" if self._secure else "http"
        if origin is not None and origin.lower() != f"{scheme}://{host}".lower():
            return JSONResponse({"error": "another site's page may not ask the console"}, 403)
        if headers.get("sec-fetch-site", "none") not in ("none", "same-origin") and (asks or scope["path"] != "/"):
            return JSONResponse({"error": "another site's page may not ask the console"}, 403)
        if asks and (origin is None or headers.get("content-type", "").split(";")[0] != "application/json"):
            return JSONResponse({"error": "only the console's own pages may ask"}, 403)
        return self._without_role(scope, asks=asks)

    def _without_role(self, scope: Scope, *, asks: bool) -> ASGIApp | None:
        path = scope["path"]
        if path in OPEN_TO_ALL or path.startswith("/assets/"):
            return None
        role = self._access.role_of(cookie_of(scope))
        scope.setdefault("state", {})["role"] = role
        if role is None:
            is_page = not asks and "text/html" in Headers(scope=scope).get("accept", "")
            if is_page:
                return RedirectResponse("/login", 303)
            return JSONResponse({"error": "a token is needed: swath console pair"}, 401)
        if asks and role != OPERATOR:
            return JSONResponse({"error": "only the operator may do this"}, 403)
        return None


def cookie_of(scope: Scope) -> str:
    """Return the session's cookie; empty if there is none."""
    jar: SimpleCookie = SimpleCookie()
    try:
        jar.load(Headers(scope=scope).get("cookie", ""))
    except CookieError:
        return ""
    return jar[COOKIE].value if COOKIE in jar else ""


async def asked(request: Request) -> dict[str, Any]:
    """Return the request's JSON object; empty if it is none."""
    try:
        found = json.loads(await request.body())
    except (ValueError, RecursionError, ClientDisconnect):
        return {}
    return found if isinstance(found, dict) else {}


def _name_of(host: str) -> str:
    try:
        return (urlsplit(f"//{host}").hostname or "").lower()
    except ValueError:
        return ""


class _Limited:
    """Ends a request whose body is longer than any of ours."""

    def __init__(self, receive: Receive, most: int) -> None:
        self._receive, self._left = receive, most

    async def __call__(self) -> Message:
        message = await self._receive()
        if message["type"] == "http.request":
            self._left -= len(message.get("body", b""))
            if self._left < 0:
                return {"type": "http.disconnect"}
        return message


def _with_headers(send: Send) -> Send:
    async def sent(message: Message) -> None:
        if message["type"] == "http.response.start":
            headers = MutableHeaders(scope=message)
            for name, value in HEADERS.items():
                headers[name] = value
            headers.setdefault("cache-control", "no-store")
        await send(message)

    return sent
