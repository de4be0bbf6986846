"""Makes what the console's tests share: requests to a running console, and a map of tiles."""

from __future__ import annotations

import http.client
import json
import select
import socket
import ssl
import subprocess
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from swath.daemon.processing.live.tiles import SIDE, STORED, TileFolder, pack_tile
from tests.builders import running
from tests.daemon.rig import HANGS_S


@dataclass
class Answered:
    """A console's answer."""

    status: int
    headers: Mapping[str, str]
    body: bytes

    def plain(self) -> Any:
        """Return the body's JSON."""
        return json.loads(self.body)


@dataclass
class Asked:
    """A console that can be asked; with TLS if it listens beyond this computer."""

    port: int
    secure: bool = False

    @property
    def url(self) -> str:
        return f"http{'s' if self.secure else ''}://127.0.0.1:{self.port}"

    def _connection(self) -> http.client.HTTPConnection:
        if not self.secure:
            return http.client.HTTPConnection("127.0.0.1", self.port, timeout=HANGS_S)
        context = ssl.create_default_context()
        context.check_hostname, context.verify_mode = False, ssl.CERT_NONE  # no authority knows its certificate
        return http.client.HTTPSConnection("127.0.0.1", self.port, timeout=HANGS_S, context=context)

    def get(self, path: str, **headers: str) -> Answered:
        return self.ask("GET", path, None, headers)

    def post(self, path: str, what: Any, **headers: str) -> Answered:
        """Ask as the console's own pages do."""
        own = {"Origin": self.url, "Content-Type": "application/json"}
        return self.ask("POST", path, json.dumps(what).encode(), own | headers)

    def ask(self, method: str, path: str, body: bytes | None, headers: Mapping[str, str]) -> Answered:
        connection = self._connection()
        named = {name.replace("_", "-"): value for name, value in headers.items()}
        try:
            connection.request(method, path, body, named)
            found = connection.getresponse()
            return Answered(found.status, {key.lower(): value for key, value in found.getheaders()}, found.read())
        finally:
            connection.close()

    def feed(self, **headers: str) -> Iterator[dict[str, Any]]:
        """Yield snapshots as they come."""
        connection = self._connection()
        try:
            connection.request("GET", "/feed", headers=headers)
            answer = connection.getresponse()
            assert answer.status == 200, answer.read()
            event = ""
            while True:
                line = answer.readline().decode().rstrip("\n")
                if line.startswith("event: "):
                    event = line[7:]
                elif line.startswith("data: ") and not event:
                    yield json.loads(line[6:])
                elif not line:
                    event = ""
        finally:
            connection.close()

    def snapshot(self) -> dict[str, Any]:
        """Return the newest snapshot."""
        return next(self.feed())


@contextmanager
def console(
    *words: str | Path, address: str = "127.0.0.1", port: int = 0
) -> Iterator[tuple[Asked, subprocess.Popen[str]]]:
    """Run a console, at a free port unless one is given, and wait until it answers."""
    if not port:
        with socket.socket() as sock:
            sock.bind(("127.0.0.1", 0))
            port = sock.getsockname()[1]
    with running("console", *words, "--listen", f"{address}:{port}", output=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert select.select([process.stdout], [], [], HANGS_S)[0], "the console says nothing"
        scheme = "http" if address == "127.0.0.1" else "https"
        assert process.stdout.readline().strip() == f"{scheme}://{address}:{port}/", process.communicate()
        asked, until_s = Asked(port, scheme == "https"), time.monotonic() + HANGS_S
        while True:
            try:
                asked.get("/about")
                break
            except OSError:
                assert process.poll() is None, process.communicate()
                assert time.monotonic() < until_s, "the console does not answer"
                time.sleep(0.05)
        yield asked, process


def write_map(
    live: Path, tiles: Mapping[tuple[int, int], Mapping[str, NDArray[Any]]], cell_m: float = 1.0, **about: Any
) -> None:
    """Write a map of tiles, each by stored layers (`SIDE`, `SIDE`), rows from the south; the others are zero."""
    live.mkdir(parents=True, exist_ok=True)
    nothing = {name: np.zeros((SIDE, SIDE), kind) for name, kind in STORED.items()}
    made = [
        (place, lambda head, layers=layers: pack_tile(head, nothing | dict(layers))) for place, layers in tiles.items()
    ]
    TileFolder(live).write(made, {"cell_m": cell_m} | about)
