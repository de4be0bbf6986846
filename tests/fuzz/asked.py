"""Targets for answers: an operator to the recorder, the recorder to an operator, a caster, a device's set-up."""

from __future__ import annotations

import contextlib
import io
import json
import random
import socket
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

from swath.daemon.cli import mark, split
from swath.daemon.errors import one_line
from swath.daemon.log.block_queue import BlockQueue
from swath.daemon.log.channels import ChannelTable
from swath.daemon.log.events import Event, Events, Severity
from swath.daemon.recorder import control, control_client
from swath.daemon.recorder.control import LINE_BYTES, Control
from swath.daemon.recorder.writer import WriterHealth
from swath.drivers.driver import KINDS, all_drivers
from swath.drivers.parser import DeviceSettings
from swath.drivers.startup import MAX_REPLY_BYTES, StartupOptions
from swath.drivers.transports import ntrip as ntrip_client
from swath.drivers.transports.base import TransportError
from swath.drivers.transports.descriptor import Gate
from swath.drivers.transports.ntrip import NtripTransport
from swath.drivers.transports.spec import parse_transport
from tests.drivers.harness import random_pieces
from tests.fuzz.engine import FindingError, Target
from tests.fuzz.frames import FramePool, mutate_stream
from tests.fuzz.mutation import damage
from tests.fuzz.recordings import streams_of
from tests.fuzz.texts import NUMBERS, OF_JSON, changed_text, told

SESSION = "fuzz-20261121T100000Z-ab12"
NOW_NS = 1_800_000_000_000_000_000
OF_HTTP = (
    *("HTTP/1.1", "ICY", "200", "401", "2²", "chunked", "gnss/sourcetable", "text/html", "\r\n\r\n", "-5", "f" * 40),
    *("\x1b[2J", "STR", "ENDSOURCETABLE", "\xff", "+1", "0"),
)


def asked_targets() -> Iterator[tuple[str, Callable[[], Target]]]:
    """Yield the targets of both sides of the control socket, NTRIP casters and answers to start-up messages."""
    yield "control-request", _requests
    yield "control-answer", _answers
    yield "ntrip", _casters
    yield "startup-answers", _startup


# --- the control socket ---------------------------------------------------------------------------------------------


class _Heard(Events):
    """Event sink that keeps events."""

    def __init__(self, clock: Any) -> None:
        super().__init__(clock, BlockQueue(1 << 20), ChannelTable())
        self.heard: list[Event] = []

    def post(self, severity: Severity, source: str, code: str, text: str) -> Event:
        self.heard.append(super().post(severity, source, code, text))
        return self.heard[-1]


def _control(folder: Path) -> Control:
    """Return the control of a working recorder that notes and begins parts."""
    clock: Any = SimpleNamespace(now_ns=lambda: NOW_NS)
    recording: Any = SimpleNamespace(
        parts=SimpleNamespace(directory=folder, part=3),
        info=SimpleNamespace(session_id=SESSION),
        recorder=SimpleNamespace(health=WriterHealth(), new_part=SimpleNamespace(set=lambda: None)),
    )
    return Control(recording, _Heard(clock))


def _requests() -> Target:
    seeds = [
        *(json.dumps({"command": "mark", "text": text}).encode() + b"\n" for text in ("line 4 start", "\tσ\u2028x")),
        *(b'{"command": "split"}\n', b'{"command": "mark"', b"[]\n{}", b"\n"),
    ]
    folder = Path(tempfile.gettempdir())

    def run(data: bytes) -> Iterator[str]:
        one = _control(folder)
        ours, theirs = socket.socketpair()
        with ours, theirs:
            ours.setblocking(False)
            _say(one, ours, theirs, data)
            return iter(list(_answered(theirs, one)))

    return Target("control-request", seeds, lambda rng, base: changed_text(rng, base, (*NUMBERS, *OF_JSON)), run)


def _say(one: Control, ours: socket.socket, theirs: socket.socket, data: bytes) -> None:
    """Send the input in pieces until the peer is finished."""
    peer = control._Peer(ours, time.monotonic() + 60.0)
    sizes = random.Random(len(data))
    while data:
        size = sizes.choice((1, 7, 100, LINE_BYTES))
        theirs.sendall(data[:size])
        data = data[size:]
        if one._is_done(peer, True, time.monotonic()):
            return
        if len(peer.received) >= LINE_BYTES:
            raise FindingError(f"{len(peer.received)} bytes are kept of a peer")
    theirs.shutdown(socket.SHUT_WR)
    if not one._is_done(peer, True, time.monotonic()):
        raise FindingError("a peer that has left is waited for")


def _answered(sock: socket.socket, one: Control) -> Iterator[str]:
    """Yield the answer, which is a line, or "ignored" for what is no request; check that events can be printed."""
    said = b""
    with contextlib.suppress(ConnectionResetError):  # of what was sent behind the line
        said = sock.recv(1 << 16)
    if not said:
        assert one.ignored == 1
        yield "ignored"
        return
    assert said.endswith(b"\n")
    assert said.count(b"\n") == 1
    assert isinstance(one._events, _Heard)
    for event in one._events.heard:
        event.text.encode()
        assert one_line(event.text) == event.text
    answer = json.loads(said)
    yield from (f"{key} {type(value).__name__}" for key, value in answer.items())
    yield str(answer.get("error"))


def _answers() -> Target:
    whole = {"ok": True, "session_id": SESSION, "part": 3, "recording": True, "reason": ""}
    seeds = [
        json.dumps(one).encode() + b"\n"
        for one in (whole | {"time_ns": NOW_NS, "text": "σ"}, whole, {"ok": False, "error": "too many notes"})
    ]

    def run(data: bytes) -> Iterator[str]:
        seen = set()
        with (
            tempfile.TemporaryDirectory(prefix="swath-fuzz-") as folder,
            patch.object(control_client, "_exchange", lambda place, line: data),
            patch.object(
                control_client, "wait_for_part", lambda directory, session_id, after: f"{session_id}_{after + 1}"
            ),
        ):
            for as_json in (False, True):
                seen |= told(partial(_printed, partial(mark.command, "note", Path(folder), as_json)))
                seen |= told(partial(_printed, partial(split.command, Path(folder), as_json)))
        return iter(seen)

    return Target("control-answer", seeds, lambda rng, base: changed_text(rng, base, (*NUMBERS, *OF_JSON)), run)


def _printed(command: Callable[[], None]) -> Iterator[str]:
    """Print on a terminal that expects lines in UTF-8."""
    out = io.BytesIO()
    terminal = io.TextIOWrapper(out, encoding="utf-8", write_through=True)
    with contextlib.redirect_stdout(terminal):
        command()
    said = out.getvalue().decode()
    if "\x1b" in said or "\r" in said:
        raise FindingError(f"control characters on the terminal: {said!r}")
    yield said[:6]


# --- a caster -------------------------------------------------------------------------------------------------------


def _casters() -> Target:
    first, second = b"ICY 200 OK\r\n\r\n", b"HTTP/1.1 200 OK\r\nNtrip-Version: Ntrip/2.0\r\n"
    table = b"STR;OTHER;town;RTCM 3.2;\r\nSTR;MOUNT;x\r\nENDSOURCETABLE\r\n"
    seeds = [
        first + bytes(range(200)),
        second + b"Transfer-Encoding: chunked\r\n\r\n5\r\nabcde\r\n1f;x=y\r\n" + bytes(31) + b"\r\n0\r\n\r\n",
        second + b"Content-Type: gnss/data\r\n\r\n" + bytes(100),
        b"SOURCETABLE 200 OK\r\nContent-Length: 60\r\n\r\n" + table,
        second + b"Content-Type: gnss/sourcetable\r\n\r\n" + table,
        *(b"HTTP/1.1 %d no\r\n\r\n" % code for code in (401, 404, 503, 302)),
    ]
    spec = parse_transport("ntrip:caster:2101/MOUNT")

    def run(data: bytes) -> Iterator[str]:
        ours, theirs = socket.socketpair()
        with (
            theirs,
            patch.object(socket, "create_connection", lambda *_: ours),
            patch.object(ntrip_client, "keep_alive", lambda _: None),
        ):
            theirs.sendall(data)
            theirs.shutdown(socket.SHUT_WR)
            return iter(_received(NtripTransport(spec), ours, len(data)))

    return Target("ntrip", seeds, lambda rng, base: changed_text(rng, base, (*NUMBERS, *OF_HTTP)), run)


def _received(transport: NtripTransport, sock: socket.socket, most: int) -> set[str]:
    """Return the data received, and the line that reports the end."""
    seen, count, gate = set(), 0, Gate(sock.fileno())
    try:
        transport._sock = transport._connect()
        while count <= most:
            for block in transport._receive(gate, 0.0):
                count += block.units.size
                seen.add(f"data {block.units.size.bit_length()}")
    except TransportError as error:
        if one_line(str(error)) != str(error):
            raise FindingError(f"more than a line: {error}") from error
        return seen | {str(error).removeprefix(transport.name)[:12]}
    finally:
        gate.close()
        sock.close()
    raise FindingError(f"{count} bytes of {most}")


# --- receivers that are set up --------------------------------------------------------------------------------------


def _startup() -> Target:
    drivers = [one for kind in KINDS for one in all_drivers(kind).values() if one.startup is not None]
    asked = [
        message
        for driver in drivers
        if driver.startup is not None
        for message in driver.startup(DeviceSettings(f"{driver.kind}/fuzz"), StartupOptions(save=True, baud=230_400))
    ]
    said = [recording[:2000] for driver in drivers for recording in streams_of(driver)[:2]]
    seeds = [
        *said,
        b"\r\n<OK\r\n[COM1]log versiona\r\n<ERROR:Invalid Message ID\r\n",
        b"$R: setDataInOut, COM1, CMD, SBF\r\n  DataInOut, COM1, CMD, SBF, (on)\r\nCOM1>\r\n$R? setX: Invalid!\r\n",
        b"\xb5\x62\x05\x01\x02\x00\x06\x8a\x98\xc1\xb5\x62\x05\x00\x02\x00\x06\x8a\x97\xbc",
    ]
    pool = FramePool(seeds)

    def run(data: bytes) -> Iterator[str]:
        seen = set()
        for message in {one.lines[0]: one for one in asked}.values():
            listener = message.listen()
            for piece in random_pieces(data, len(data)):
                if (answer := listener.hear(piece)) is not None:
                    break
            else:
                answer = listener.close()
            if answer is not None:
                assert len(answer.text) <= MAX_REPLY_BYTES
                seen.add(f"{answer.accepted} {answer.text[:6]}")
        return iter(seen | {"heard"})

    def mutate(rng: random.Random, base: bytes) -> bytes:
        return mutate_stream(rng, base, pool) if rng.random() < 0.5 else damage(rng, base)

    return Target("startup-answers", seeds, mutate, run)
