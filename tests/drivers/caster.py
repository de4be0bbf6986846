"""Serves an NTRIP caster for tests: a TCP server that sends what a script says and keeps the requests."""

from __future__ import annotations

import contextlib
import socket
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

Script = Callable[[socket.socket, int], None]


@dataclass
class Caster:
    """An NTRIP server on the loopback.

    Attributes:
        port: where it listens.
        requests: heads of the requests, in order.
        said: what clients sent after their request.
    """

    port: int
    requests: list[str] = field(default_factory=list)
    said: bytearray = field(default_factory=bytearray)
    ended: threading.Event = field(default_factory=threading.Event)


def read_head(sock: socket.socket) -> bytes:
    """Read a request up to its empty line."""
    data = b""
    while not data.endswith(b"\r\n\r\n"):
        more = sock.recv(1)
        if not more:
            break
        data += more
    return data


@contextlib.contextmanager
def caster(script: Script) -> Iterator[Caster]:
    """Serve a caster in which ``script(socket, number)`` answers each connection after its request was read."""
    server = socket.create_server(("127.0.0.1", 0))
    found = Caster(server.getsockname()[1])

    def serve() -> None:
        number = 0
        while True:
            try:
                sock, _ = server.accept()
            except OSError:
                return
            with sock, contextlib.suppress(OSError):
                found.requests.append(read_head(sock).decode())
                script(sock, number)
            number += 1

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    try:
        yield found
    finally:
        found.ended.set()
        server.shutdown(socket.SHUT_RDWR)
        server.close()
        thread.join(10.0)


def listen(found: Caster, sock: socket.socket, seconds: float) -> None:
    """Keep what a client sends until it hangs up or the time is over."""
    sock.settimeout(seconds)
    with contextlib.suppress(TimeoutError):
        while data := sock.recv(4096):
            found.said += data
