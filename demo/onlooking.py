"""Shows the flight on the operator's console while it is recorded."""

from __future__ import annotations

import contextlib
import socket
import subprocess
from collections.abc import Iterator
from pathlib import Path

from rich.console import Console

from demo.points import SWATH

ADDRESS, PORT = "127.0.0.1", 8470
END_S = 20.0


def free_port() -> int:
    """Return the console's own port, or another one if that is in use."""
    for port in (PORT, 0):
        with socket.socket() as sock, contextlib.suppress(OSError):
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            sock.bind((ADDRESS, port))
            return int(sock.getsockname()[1])
    return PORT


@contextlib.contextmanager
def shown(console: Console, folder: Path, compiling: subprocess.Popen[bytes]) -> Iterator[None]:
    """Run ``swath console`` and ``swath live`` for the folder's configuration during the block."""
    with console.status("compiling the loops of processing, once on a new installation"):
        compiling.wait()
    config, port = str(folder / "swath.toml"), free_port()
    commands = (
        ("console", config, "--listen", f"{ADDRESS}:{port}"),
        ("live", config, "--from-start", "--accept-verdict"),
    )
    running: list[subprocess.Popen[bytes]] = []
    for words in commands:
        with (folder / f"{words[0]}.txt").open("wb") as said:
            running.append(subprocess.Popen([*SWATH, *words], stdout=said, stderr=said))
    address = f"http://{ADDRESS}:{port}/"
    console.print(f"[bold]the operator's console shows the flight: {address}[/]", soft_wrap=True, highlight=False)
    try:
        yield
    finally:
        for one in running:
            one.terminate()
        for one in running:
            with contextlib.suppress(subprocess.TimeoutExpired):
                one.wait(END_S)
            one.kill()
