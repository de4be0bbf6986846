"""Simulates devices that repeat themselves: a serial port, a sender of datagrams, a TCP server."""

from __future__ import annotations

import os
import threading
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from socket import AF_INET, SOCK_DGRAM, create_server, socket


@contextmanager
def repeating(job: Callable[[int], None], period_s: float = 0.05) -> Iterator[None]:
    """Call a job again and again in a thread of its own."""
    stop = threading.Event()

    def run() -> None:
        number = 0
        while not stop.wait(period_s):
            job(number)
            number += 1

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


@contextmanager
def pty(send: Callable[[int], bytes] | None = None) -> Iterator[str]:
    """Open a serial device that sends repeatedly, and yield its path."""
    main, secondary = os.openpty()
    tty.setraw(secondary)
    os.set_blocking(main, False)

    def write(number: int) -> None:
        if send is not None:
            try:
                os.write(main, send(number))
            except BlockingIOError:
                pass

    try:
        with repeating(write):
            yield os.ttyname(secondary)
    finally:
        os.close(main)
        os.close(secondary)


@contextmanager
def udp_sender(port: int, send: Callable[[int], bytes], own: str = "127.0.0.1") -> Iterator[None]:
    """Send datagrams repeatedly to a port of this computer, from its address ``own``."""
    with socket(AF_INET, SOCK_DGRAM) as sender:
        sender.bind((own, 0))
        with repeating(lambda n: _send(sender, port, send(n)), 0.01):
            yield


def _send(sender: socket, port: int, data: bytes) -> None:
    sender.sendto(data, ("127.0.0.1", port))


@contextmanager
def tcp_server(send: Callable[[int], bytes] | None = None) -> Iterator[int]:
    """Serve a TCP port as a device does, send repeatedly to every client, and yield the port."""
    with create_server(("127.0.0.1", 0)) as server:
        server.setblocking(False)
        peers: list[socket] = []

        def write(number: int) -> None:
            with suppress(BlockingIOError):
                peers.append(server.accept()[0])
            data = b"" if send is None else send(number)
            for peer in peers:
                with suppress(OSError):
                    peer.sendall(data)

        try:
            with repeating(write):
                yield server.getsockname()[1]
        finally:
            for peer in peers:
                peer.close()
