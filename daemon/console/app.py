"""The console's pages and what they ask: a feed of snapshots, map tiles, marks and new parts."""

from __future__ import annotations

import asyncio
import contextlib
import json
import re
from collections.abc import AsyncIterator
from importlib import resources
from pathlib import Path
from typing import Any

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, Response, StreamingResponse
from starlette.routing import Route
from xstatic.pkg import leaflet

from swath.daemon.config.tables import ConsoleConfig
from swath.daemon.console.access import Access
from swath.daemon.console.guard import COOKIE, Guard, asked, cookie_of
from swath.daemon.console.landing import Landing
from swath.daemon.console.painting import RAMPS, ZOOMS
from swath.daemon.console.watch import Watch
from swath.daemon.errors import UserError, one_line
from swath.daemon.recorder.control import NOTE_CHARACTERS
from swath.daemon.recorder.control_client import ask

PAGES = {"/": "console.html", "/pilot": "pilot.html", "/landing": "landing.html", "/login": "login.html"}
TYPES = {
    ".js": "text/javascript",
    ".css": "text/css",
    ".html": "text/html",
    ".svg": "image/svg+xml",
    ".png": "image/png",
}
MOST_FEEDS = 64
ALIVE_S = 10.0  # a feed without news says that it is alive
RETRY_MS = 1000


class Feed:
    """Wakes the pages when there is a new snapshot; a slow page gets the newest one and none of those between."""

    def __init__(self, watch: Watch) -> None:
        self._watch = watch
        self._changed = asyncio.Condition()
        self._loop: asyncio.AbstractEventLoop | None = None
        self.readers = 0
        self._made: tuple[dict[str, Any] | None, bytes] = (None, b"")

    def begin(self) -> None:
        """Bind to the running loop."""
        self._loop = asyncio.get_running_loop()

    def tell(self) -> None:
        """Say from the watching thread that there is a new snapshot."""
        if self._loop is not None and not self._loop.is_closed():
            with contextlib.suppress(RuntimeError):  # the loop closed meanwhile
                asyncio.run_coroutine_threadsafe(self._wake(), self._loop)

    async def _wake(self) -> None:
        async with self._changed:
            self._changed.notify_all()

    def _encoded(self, latest: dict[str, Any]) -> bytes:
        """Return a snapshot as a page reads it, made once for all pages."""
        if self._made[0] is not latest:
            self._made = latest, f"data: {json.dumps(latest, separators=(',', ':'))}\n\n".encode()
        return self._made[1]

    async def lines(self, role: str) -> AsyncIterator[bytes]:
        """Yield server-sent events: the role, then the newest snapshot and how to steer when they have changed."""
        self.readers += 1
        try:
            yield f"retry: {RETRY_MS}\nevent: role\ndata: {json.dumps(role)}\n\n".encode()
            shown: tuple[object, object] = (None, None)
            while True:
                latest, steering = self._watch.latest, self._watch.steering
                if steering is not shown[1]:
                    yield f"event: steering\ndata: {json.dumps(steering, separators=(',', ':'))}\n\n".encode()
                if latest is not shown[0]:
                    yield self._encoded(latest)
                shown = latest, steering
                try:
                    async with self._changed:
                        if self._watch.latest is latest and self._watch.steering is steering:
                            await asyncio.wait_for(self._changed.wait(), ALIVE_S)
                except TimeoutError:
                    yield b": alive\n\n"
        finally:
            self.readers -= 1


class Pages:
    """Answers the requests of pages.

    Args:
        directory: log directory, for the recorder's control socket; None: a finished log is shown and nobody is asked.
        config: texts of the marks and more.
    """

    def __init__(self, watch: Watch, access: Access, directory: Path | None, config: ConsoleConfig) -> None:
        self._watch, self._access, self._directory, self._config = watch, access, directory, config
        self.feed = Feed(watch)
        self._landing = Landing(watch, self._ask)

    def routes(self) -> list[Route]:
        """Return what can be asked."""
        return [
            *(Route(path, self.page) for path in PAGES),
            Route("/assets/{name}", self.asset),
            Route("/assets/leaflet/{name:path}", self.leaflet),
            Route("/feed", self.events),
            Route("/history", self.history),
            Route("/about", self.about),
            Route("/tiles/{layer}/{square:path}", self.tile),
            Route("/background/{square:path}", self.background),
            Route("/look/{name}", self.look),
            *self._landing.routes(),
            Route("/mark", self.mark, methods=["POST"]),
            Route("/split", self.split, methods=["POST"]),
            Route("/session", self.begin_session, methods=["POST"]),
            Route("/session/end", self.end_session, methods=["POST"]),
        ]

    # ------------------------------------------------------------------ pages

    async def page(self, request: Request) -> Response:
        """Return a page."""
        return _packaged(PAGES[request.url.path])

    async def asset(self, request: Request) -> Response:
        """Return a script, a style sheet or a picture of the pages."""
        return _packaged(request.path_params["name"])

    async def leaflet(self, request: Request) -> Response:
        """Return a file of the map library."""
        return await run_in_threadpool(_of_leaflet, request.path_params["name"])

    async def about(self, request: Request) -> Response:
        """Return what does not change: texts of the marks, whether a recorder can be asked."""
        return JSONResponse({"marks": self._config.marks, "asks": self._directory is not None})

    # ------------------------------------------------------------------ what is shown

    async def events(self, request: Request) -> Response:
        """Return the feed of snapshots."""
        if self.feed.readers >= MOST_FEEDS:
            return JSONResponse({"error": f"{MOST_FEEDS} pages are open already; close one"}, 503)
        headers = {"x-accel-buffering": "no"}
        return StreamingResponse(self.feed.lines(request.state.role), media_type="text/event-stream", headers=headers)

    async def history(self, request: Request) -> Response:
        """Return the graphs' last ten minutes."""
        return JSONResponse(await run_in_threadpool(self._watch.history))

    async def tile(self, request: Request) -> Response:
        """Return a square of the map."""
        layer, place = request.path_params["layer"], _square(request.path_params["square"])
        if layer not in RAMPS or place is None:
            return _missing()
        picture = await run_in_threadpool(self._watch.painter.picture, layer, *place)
        return Response(picture, media_type="image/png", headers={"cache-control": "no-cache"})

    async def background(self, request: Request) -> Response:
        """Return a square of the user's map behind live's."""
        place = _square(request.path_params["square"])
        if self._watch.background is None or place is None:
            return _missing()
        picture = await run_in_threadpool(self._watch.background.picture, *place)
        if picture is None:
            return Response(status_code=204)
        kind = "image/png" if picture.startswith(b"\x89PNG") else "image/jpeg"
        return Response(picture, media_type=kind, headers={"cache-control": "max-age=3600"})

    async def look(self, request: Request) -> Response:
        """Return the profile or the last minute's points, unless the page has them already."""
        file = self._watch.looks.get(request.path_params["name"])
        if file is None:
            return _missing()
        sign, data = await run_in_threadpool(file.read, request.headers.get("if-none-match", ""))
        if data is None:
            return Response(status_code=304 if sign else 204)
        return Response(data, media_type=file.media_type, headers={"etag": sign})

    # ------------------------------------------------------------------ what is asked of the recorder

    async def mark(self, request: Request) -> Response:
        """Write a mark into the log."""
        text = (await asked(request)).get("text")
        if not isinstance(text, str) or not text.strip() or len(text) > NOTE_CHARACTERS or not text.isprintable():
            return JSONResponse({"error": f"a mark has 1 to {NOTE_CHARACTERS} printable characters"}, 400)
        return await self._ask({"command": "mark", "text": text})

    async def split(self, request: Request) -> Response:
        """Begin a part of the log."""
        return await self._ask({"command": "split"})

    async def _ask(self, command: dict[str, str]) -> Response:
        if self._directory is None:
            return JSONResponse({"error": "a finished log takes no marks"}, 409)
        try:
            answer = await run_in_threadpool(ask, self._directory, command)
        except UserError as error:
            return JSONResponse({"error": one_line(str(error))}, 409)
        shown = {key: answer[key] for key in ("part", "recording", "reason", "text", "time_ns") if key in answer}
        return JSONResponse(shown)

    # ------------------------------------------------------------------ sessions

    async def begin_session(self, request: Request) -> Response:
        """Take a token and give a session."""
        address = request.client.host if request.client else ""
        if self._access.must_wait(address):
            return JSONResponse({"error": "too many wrong tokens; wait a minute"}, 429)
        token = (await asked(request)).get("token")
        cookie = self._access.open_session(token if isinstance(token, str) else "", address)
        if cookie is None:
            return JSONResponse({"error": "this token is not known: swath console pair shows the right one"}, 401)
        answer = JSONResponse({"ok": True})
        secure = request.url.scheme == "https"
        answer.set_cookie(COOKIE, cookie, httponly=True, samesite="strict", secure=secure, path="/")
        return answer

    async def end_session(self, request: Request) -> Response:
        """End the session."""
        self._access.end_session(cookie_of(request.scope))
        answer = JSONResponse({"ok": True})
        answer.delete_cookie(COOKIE, path="/")
        return answer


def _square(text: str) -> tuple[int, int, int] | None:
    """Return zoom, x and y of ``zoom/x/y.png``; None: the map has no such square."""
    found = re.fullmatch(r"(-?[0-9]{1,2})/(-?[0-9]{1,7})/(-?[0-9]{1,7})\.png", text)
    if found is None or int(found[1]) not in ZOOMS:
        return None
    return int(found[1]), int(found[2]), int(found[3])


def _packaged(name: str) -> Response:
    """Return one of the files beside this module."""
    path = resources.files("swath.daemon.console") / "assets" / name
    suffix = Path(name).suffix
    if "/" in name or "\\" in name or suffix not in TYPES or not path.is_file():
        return _missing()
    return Response(path.read_bytes(), media_type=TYPES[suffix])


def _of_leaflet(name: str) -> Response:
    root = Path(leaflet.BASE_DIR).resolve()
    path = (root / name).resolve()
    if not path.is_relative_to(root) or path.suffix not in TYPES or not path.is_file():
        return _missing()
    return FileResponse(path, media_type=TYPES[path.suffix], headers={"cache-control": "max-age=86400"})


def _missing() -> Response:
    return JSONResponse({"error": "there is no such page"}, 404)


def make_app(
    watch: Watch,
    access: Access,
    directory: Path | None,
    config: ConsoleConfig,
    hosts: list[str],
    *,
    secure: bool = False,
) -> tuple[Guard, Feed]:
    """Return the application and its feed, which the watch tells of news."""
    pages = Pages(watch, access, directory, config)

    @contextlib.asynccontextmanager
    async def lifespan(_: Starlette) -> AsyncIterator[None]:
        pages.feed.begin()
        yield

    return Guard(Starlette(routes=pages.routes(), lifespan=lifespan), access, hosts, secure=secure), pages.feed
