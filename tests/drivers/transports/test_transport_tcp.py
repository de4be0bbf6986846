"""Tests the TCP client against servers on real sockets: every byte, the kernel's stamps, losses, silent ends."""

from __future__ import annotations

import socket
import struct
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from swath.drivers.session import Session, SessionState
from swath.drivers.transports.base import TransportError, UnitBlock
from swath.drivers.transports.opening import open_transport
from swath.drivers.transports.spec import parse_transport
from swath.drivers.transports.tcp_socket import TcpTransport

DATA = bytes(range(256)) * 20


@contextmanager
def server() -> Iterator[tuple[socket.socket, str]]:
    """Listen on the loopback; yield the server and the transport's text."""
    with socket.create_server(("127.0.0.1", 0)) as listening:
        listening.settimeout(10.0)
        yield listening, f"tcp:127.0.0.1:{listening.getsockname()[1]}"


def opened(text: str) -> TcpTransport:
    transport = TcpTransport(parse_transport(text))
    transport.open()
    return transport


def received(transport: TcpTransport, count: int) -> list[UnitBlock]:
    """Return the blocks of so many bytes, or those that came in 10 s."""
    blocks: list[UnitBlock] = []
    deadline_s = time.monotonic() + 10.0
    while sum(block.units.size for block in blocks) < count and time.monotonic() < deadline_s:
        blocks += transport.receive(0.2)
    return blocks


def test_bytes_arrive_completely_with_the_kernels_stamps_and_can_be_answered() -> None:
    with server() as (listening, text):
        transport = opened(text)
        peer, _ = listening.accept()
        before_ns = time.time_ns()
        peer.sendall(DATA)
        sent_ns = time.time_ns()
        time.sleep(0.1)  # the time of the read would be this late
        blocks = received(transport, len(DATA))
        assert b"".join(block.units.tobytes() for block in blocks) == DATA
        for block in blocks:
            assert block.kernel_realtime_ns is not None
            assert before_ns <= block.kernel_realtime_ns[0] < sent_ns + 50_000_000
        transport.send(b"log version\r\n")
        assert peer.recv(100) == b"log version\r\n"
        assert transport.receive(0.05) == []
        transport.close()
        peer.close()


def test_more_than_one_read_is_taken_in_one_receive() -> None:
    data = DATA * 200  # 1 MiB
    with server() as (listening, text):
        transport = opened(text)
        peer, _ = listening.accept()
        sending = threading.Thread(target=peer.sendall, args=(data,))
        sending.start()
        blocks = received(transport, len(data))
        sending.join()
        assert b"".join(block.units.tobytes() for block in blocks) == data
        transport.close()
        peer.close()


@pytest.mark.parametrize(
    ("linger", "says"),
    [(False, "the other end closed the connection"), (True, "the connection broke: Connection reset")],
)
def test_the_end_of_a_connection_is_an_error_after_its_last_bytes(linger: bool, says: str) -> None:
    with server() as (listening, text):
        transport = opened(text)
        peer, _ = listening.accept()
        peer.sendall(DATA)
        blocks = received(transport, len(DATA))
        assert b"".join(block.units.tobytes() for block in blocks) == DATA
        if linger:
            peer.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        peer.close()
        with pytest.raises(TransportError, match=says):
            received(transport, 1)
        transport.close()


def test_a_session_connects_anew_after_a_loss_and_loses_nothing_that_arrived() -> None:
    with server() as (listening, text):
        session: Session[UnitBlock] = Session(lambda: open_transport(parse_transport(text)))
        data = b""
        for number in range(3):
            while session.state is not SessionState.OPEN:
                session.receive(0.1)
            peer, _ = listening.accept()
            peer.sendall(bytes([number]) * 100)
            peer.close()
            while session.state is SessionState.OPEN:
                data += b"".join(block.units.tobytes() for block in session.receive(0.2))
        assert data == b"\0" * 100 + b"\1" * 100 + b"\2" * 100
        assert (session.openings, session.last_error) == (3, f"{text}: the other end closed the connection")
        session.close()


def test_a_mute_end_is_reported_and_connected_to_anew() -> None:
    with server() as (listening, text):
        session: Session[UnitBlock] = Session(lambda: open_transport(parse_transport(f"{text}?silent_s=1")))
        session.receive(0.1)
        mute, _ = listening.accept()
        started_s = time.monotonic()
        while session.openings < 2:
            session.receive(0.1)
        assert session.last_error == f"{text}?silent_s=1: no data for 1 s; it is connected to anew"
        assert 1.0 < time.monotonic() - started_s < 4.0
        peer, _ = listening.accept()
        peer.sendall(b"here")
        assert b"".join(block.units.tobytes() for block in session.receive(1.0)) == b"here"
        session.close()
        assert mute.recv(1) == b""  # the dead connection was closed
        mute.close()
        peer.close()


def test_the_kernel_probes_a_silent_connection() -> None:
    with server() as (listening, text):
        transport = opened(text)
        peer, _ = listening.accept()
        sock = transport._sock
        assert sock is not None
        assert sock.getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE) == 1
        options = (socket.TCP_KEEPIDLE, socket.TCP_KEEPINTVL, socket.TCP_KEEPCNT, socket.TCP_NODELAY)
        assert [sock.getsockopt(socket.IPPROTO_TCP, option) for option in options] == [10, 5, 3, 1]
        transport.close()
        peer.close()


def test_a_refusal_and_an_unknown_host_are_one_line_with_the_remedy() -> None:
    with server() as (_listening, text):
        pass
    with pytest.raises(TransportError, match=r"127\.0\.0\.1 refuses port \d+; check the port number") as caught:
        opened(text)
    assert str(caught.value).startswith(f"{text}: ")
    with pytest.raises(TransportError, match=r"the host name receiver\.invalid is unknown; check the name"):
        opened("tcp:receiver.invalid:5000")
