"""Serves the verdict before landing, its page and PDF, live's products for others, and takes the operator's word."""

from __future__ import annotations

import asyncio
import subprocess
import tempfile
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, Response
from starlette.routing import Route

from swath.daemon.console.guard import asked
from swath.daemon.console.watch import Watch
from swath.daemon.processing.landing.command import MARK, PAGE, PRINT_S, PRINTED, page_command
from swath.daemon.recorder.control import NOTE_CHARACTERS

DOWNLOADS = {"coverage.tif": "image/tiff", "coverage.kmz": "application/vnd.google-earth.kmz"}
EXPORTS = {PAGE: "text/html", PRINTED: "application/pdf"}
WORDS = ("accepted", "again", "reset")
MOST_BYTES = 1 << 26  # of a page

Ask = Callable[[dict[str, str]], Awaitable[Response]]


class Landing:
    """Answers what the page before landing and the panel of lines ask.

    Args:
        watch: reads live's files.
        ask: sends a command to the recorder.
    """

    def __init__(self, watch: Watch, ask: Ask) -> None:
        self._watch, self._ask = watch, ask
        self._printing = asyncio.Lock()
        self._printed: tuple[str, dict[str, bytes]] = ("", {})

    def routes(self) -> list[Route]:
        """Return what can be asked."""
        return [
            Route("/verdict", self.verdict),
            *(Route(f"/{name}", self.export) for name in EXPORTS),
            *(Route(f"/{name}", self.download) for name in DOWNLOADS),
            Route("/landing", self.write, methods=["POST"]),
            Route("/overrule", self.overrule, methods=["POST"]),
        ]

    async def verdict(self, request: Request) -> Response:
        """Return the verdict as live wrote it, its sign, and which files can be had."""
        content, sign = await run_in_threadpool(self._watch.verdict)
        there = await run_in_threadpool(self._downloads)
        return JSONResponse({"verdict": content, "sign": sign, "downloads": there})

    def _downloads(self) -> list[dict[str, Any]]:
        found = []
        for name in DOWNLOADS:
            path = self._watch.live / name
            if path.is_file() and not path.is_symlink():
                found.append({"name": name, "bytes": path.stat().st_size})
        return found

    async def download(self, request: Request) -> Response:
        """Return one of live's products."""
        name = request.url.path.removeprefix("/")
        path = self._watch.live / name
        if not await run_in_threadpool(lambda: path.is_file() and not path.is_symlink()):
            return JSONResponse({"error": f"{name}: swath live writes it at its end"}, 404)
        return FileResponse(path, media_type=DOWNLOADS[name], filename=name)

    async def export(self, request: Request) -> Response:
        """Return the verdict's page or its PDF; they are made once for each verdict, one at a time."""
        name = request.url.path.removeprefix("/")
        _, sign = await run_in_threadpool(self._watch.verdict)
        if not sign:
            return JSONResponse({"error": "there is no verdict: swath live writes it while it runs"}, 404)
        async with self._printing:
            if self._printed[0] != sign:
                self._printed = sign, await run_in_threadpool(printed, self._watch.live)
            data = self._printed[1].get(name)
            if data is None:
                self._printed = "", {}
                return JSONResponse({"error": f"{name}: it cannot be made; try swath landing on this computer"}, 500)
        headers = {"content-disposition": f'attachment; filename="{name}"'}
        return Response(data, media_type=EXPORTS[name], headers=headers)

    async def write(self, request: Request) -> Response:
        """Write the verdict's sentence into the log, as a mark."""
        content, _ = await run_in_threadpool(self._watch.verdict)
        if content is None:
            return JSONResponse({"error": "there is no verdict: swath live writes it while it runs"}, 409)
        return await self._ask({"command": "mark", "text": note(f"{MARK} {content.get('sentence', '')}")})

    async def overrule(self, request: Request) -> Response:
        """Write the operator's word on a line into the log, as a mark; live then takes it."""
        what = await asked(request)
        line, word, said = what.get("line"), what.get("verdict"), what.get("note", "")
        known = [one.get("name") for one in self._watch.latest.get("lines", {}).get("lines", [])]
        if line not in known or word not in WORDS or not isinstance(said, str):
            return JSONResponse({"error": f"an overrule has a line, one of {', '.join(WORDS)}, and a note"}, 400)
        text = f"line {line}: {word}" + (f", {said.strip()}" if said.strip() else "")
        if len(text) > NOTE_CHARACTERS or not text.isprintable():
            return JSONResponse({"error": f"line and note have at most {NOTE_CHARACTERS} printable characters"}, 400)
        return await self._ask({"command": "mark", "text": text})


def note(text: str) -> str:
    """Return a text as the recorder takes it for a mark."""
    shown = "".join(letter if letter.isprintable() else " " for letter in text)
    return shown if len(shown) <= NOTE_CHARACTERS else f"{shown[: NOTE_CHARACTERS - 1]}…"


def printed(live: Path) -> dict[str, bytes]:
    """Return page and PDF of the verdict in a folder of live's files; without what cannot be made.

    A process of its own makes them: what that needs of memory is not the console's for ever.
    """
    with tempfile.TemporaryDirectory(prefix="swath-landing-") as folder:
        page = Path(folder) / PAGE
        null = subprocess.DEVNULL
        try:
            subprocess.run(page_command(live, page), stdin=null, stdout=null, stderr=null, timeout=PRINT_S, check=False)
        except (OSError, subprocess.TimeoutExpired):
            return {}
        found = {name: Path(folder) / name for name in EXPORTS}
        return {
            name: path.read_bytes()
            for name, path in found.items()
            if path.is_file() and path.stat().st_size <= MOST_BYTES
        }
