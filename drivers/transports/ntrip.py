"""NTRIP client, versions 1 and 2 (RTCM 10410.1): a caster's stream of corrections; a unit is the bytes of one read.

If a version 2 caster sends in chunks (RFC 9112, 7.1), the chunks' contents are the units. The kernel gives no stamps
here.
"""

from __future__ import annotations

import base64
import math
import os
import re
import socket
import time
from collections.abc import Callable
from datetime import UTC, datetime

import numpy as np

from swath.drivers.framing.checksums import nmea_xor
from swath.drivers.transports.base import TransportError, UnitBlock
from swath.drivers.transports.descriptor import DescriptorTransport, Gate
from swath.drivers.transports.spec import TransportSpec, ntrip_position
from swath.drivers.transports.tcp_socket import CONNECT_S, connected, keep_alive, send_all, why_not_connected

SILENT_S = 60.0  # silence after which the connection counts as dead
READ_BYTES = 65536
MOST_HEADER_BYTES = 16384
MOST_TABLE_BYTES = 1 << 18
MOST_NAMED = 8  # mountpoints listed when the caster lacks the requested one
GGA_S = 10.0
_STATUS = re.compile(r"[0-9]{3}")  # RFC 9112, 4
_CHUNK_LENGTH = re.compile(rb"[0-9A-Fa-f]{1,16}")  # RFC 9112, 7.1; no caster sends more than 64 bits
_REFUSALS = {
    401: "the caster rejects user or password; check user and password_env",
    403: "the caster does not allow this user to read the mountpoint",
    404: "the caster has no such mountpoint",
    503: "the caster has no data for the mountpoint at present",
}


class NtripTransport(DescriptorTransport):
    """Receives one mountpoint of one caster.

    Args:
        spec: ``ntrip:<host>:<port>/<mountpoint>``; options user, password_env (the variable that holds the password),
            version, position (latitude, longitude, height, sent as GGA for casters that make a station near it).
        stopped: returns whether the opening should end early.
    """

    def __init__(self, spec: TransportSpec, stopped: Callable[[], bool] = lambda: False) -> None:
        super().__init__(f"ntrip:{spec.address}")
        self._stopped = stopped
        self._spec = spec
        self._sock: socket.socket | None = None
        self._chunks: _Chunks | None = None
        self._first = b""
        self._heard_s = self._told_s = 0.0

    def _open_device(self) -> int:
        self._sock = connected(self.name, self._connect, self._stopped)
        self._heard_s = time.monotonic()
        self._told_s = -math.inf
        return self._sock.fileno()

    def _connect(self) -> socket.socket:
        """Connect, and return the connection once the caster begins to send data."""
        request = self._request()
        try:
            sock = socket.create_connection((self._spec.ntrip_host, self._spec.ntrip_port), CONNECT_S)
        except (OSError, UnicodeError) as error:  # UnicodeError: the name cannot be encoded for the resolver
            raise TransportError(self._why(error)) from error
        try:
            self._converse(sock, request)
        except OSError as error:
            sock.close()
            raise error if isinstance(error, TransportError) else TransportError(self._why(error)) from error
        return sock

    def _converse(self, sock: socket.socket, request: bytes) -> None:
        """Send the request, read the answer's head, and keep the data that came with it."""
        keep_alive(sock)
        sock.sendall(request)
        head, self._first = self._head(sock, time.monotonic() + CONNECT_S)
        lines = head.decode("latin-1").split("\r\n")
        fields = {name.strip().lower(): value.strip().lower() for name, _, value in (x.partition(":") for x in lines)}
        words = lines[0].split(maxsplit=2)
        code = int(words[1]) if len(words) > 1 and _STATUS.fullmatch(words[1]) else 0
        if words[:1] == ["SOURCETABLE"] or (code == 200 and "sourcetable" in fields.get("content-type", "")):
            raise TransportError(f"{self.name}: {self._not_in_table(sock)}")
        if code in _REFUSALS:
            raise TransportError(f"{self.name}: {_REFUSALS[code]}")
        if (
            code != 200
            or not words[0].startswith(("ICY", "HTTP/"))
            or fields.get("content-type", "").startswith("text/")
        ):
            raise TransportError(f"{self.name}: answers {_printable(lines[0])}; check that this is an NTRIP caster")
        self._chunks = _Chunks() if "chunked" in fields.get("transfer-encoding", "") else None
        sock.setblocking(False)

    def _request(self) -> bytes:
        spec = self._spec
        host = f"{spec.ntrip_host}:{spec.ntrip_port}"
        second = spec.options.get("version", "2") == "2"
        lines = [f"GET /{spec.mountpoint} HTTP/1.{1 if second else 0}", f"Host: {host}"]
        lines += ["Ntrip-Version: Ntrip/2.0", "Connection: close"] if second else []
        lines.append("User-Agent: NTRIP swath")
        user, variable = spec.options.get("user"), spec.options.get("password_env")
        if variable is not None and variable not in os.environ:
            raise TransportError(f"{self.name}: password_env={variable}: this environment variable is not set")
        if user is not None:
            secret = f"{user}:{os.environ[variable] if variable else ''}".encode()
            lines.append(f"Authorization: Basic {base64.b64encode(secret).decode()}")
        return "\r\n".join([*lines, "", ""]).encode()

    def _head(self, sock: socket.socket, deadline_s: float) -> tuple[bytes, bytes]:
        """Return the answer up to its empty line, and the data after it; for a bare ICY 200 OK of some casters, its
        first line.
        """
        data = b""
        while len(data) < MOST_HEADER_BYTES:
            head, found, rest = _split_head(data)
            if found:
                return head, rest
            sock.settimeout(max(0.01, deadline_s - time.monotonic()))
            more = sock.recv(READ_BYTES)
            if not more:
                if found := data.partition(b"\r\n")[1]:
                    return data.partition(b"\r\n")[0], data.partition(b"\r\n")[2]
                raise TransportError(f"{self.name}: the caster closed the connection without an answer")
            data += more
        raise TransportError(f"{self.name}: its answer does not end; check that this is an NTRIP caster")

    def _not_in_table(self, sock: socket.socket) -> str:
        """Read the source table that the caster sent in place of data, and explain it to the user."""
        table, deadline_s = self._first, time.monotonic() + CONNECT_S
        try:
            while b"ENDSOURCETABLE" not in table and len(table) < MOST_TABLE_BYTES and time.monotonic() < deadline_s:
                sock.settimeout(max(0.01, deadline_s - time.monotonic()))
                if not (data := sock.recv(READ_BYTES)):
                    break
                table += data
        except OSError:
            pass  # the received part is enough
        rows = (row.split(";") for row in table.decode("latin-1").splitlines())
        names = [_printable(row[1]) for row in rows if row[0] == "STR" and len(row) > 1]
        shown = ", ".join(names[:MOST_NAMED]) or "none"
        more = f" and {len(names) - MOST_NAMED} more" if len(names) > MOST_NAMED else ""
        if self._spec.mountpoint in names:
            return "the caster sends its table instead of this mountpoint's data; check that this user may read it"
        return f"the caster has no mountpoint {self._spec.mountpoint}; it has: {shown}{more}"

    def _why(self, error: OSError | UnicodeError) -> str:
        host, port = self._spec.ntrip_host, self._spec.ntrip_port
        return why_not_connected(self.name, host, port, error, "most casters use 2101")

    def _close_device(self) -> None:
        sock, self._sock = self._sock, None
        if sock is not None:
            sock.close()

    def _receive(self, gate: Gate, timeout_s: float) -> list[UnitBlock]:
        assert self._sock is not None
        self._tell_position()
        first, self._first = self._first, b""
        if first:
            return self._units(first)
        if not gate.wait(timeout_s):
            if time.monotonic() - self._heard_s > SILENT_S:
                raise TransportError(f"{self.name}: no data for {SILENT_S:g} s")
            return []
        try:
            data = self._sock.recv(READ_BYTES)
        except BlockingIOError:
            return []
        except OSError as error:
            raise TransportError(f"{self.name}: the connection broke: {error.strerror or error}") from error
        if not data:
            raise TransportError(f"{self.name}: the caster closed the connection")
        self._heard_s = time.monotonic()
        return self._units(data)

    def _units(self, data: bytes) -> list[UnitBlock]:
        if self._chunks is not None:
            try:
                data = self._chunks.feed(data)
            except ValueError as error:
                raise TransportError(f"{self.name}: {error}") from None
        return [UnitBlock(np.frombuffer(data, np.uint8)[np.newaxis, :])] if data else []

    def _tell_position(self) -> None:
        position = self._spec.options.get("position")
        if position is None or time.monotonic() - self._told_s < GGA_S:
            return
        self._told_s = time.monotonic()
        self._send(gga_sentence(*ntrip_position(position), datetime.now(UTC)))

    def _send(self, data: bytes) -> None:
        assert self._sock is not None
        send_all(self._sock, self.name, data)


def gga_sentence(lat_deg: float, lon_deg: float, height_m: float, now: datetime) -> bytes:
    """Return a GGA sentence of a position, as casters expect it (NMEA 0183): fix 1, ten satellites, no geoid
    separation.
    """
    parts = []
    for value, digits, letters in ((lat_deg, 2, "NS"), (lon_deg, 3, "EW")):
        minutes = round(abs(value) * 60.0, 4)
        whole = int(minutes // 60.0)
        parts += [f"{whole:0{digits}d}{minutes - 60.0 * whole:07.4f}", letters[value < 0.0]]
    body = f"GPGGA,{now:%H%M%S}.00,{','.join(parts)},1,10,1.0,{height_m:.1f},M,0.0,M,,".encode()
    return b"$%s*%02X\r\n" % (body, nmea_xor(body))


class CasterReply:
    """Takes the bytes of a stream of corrections out of a caster's reply, as captured.

    A stream that was captured from its middle on has no head; its bytes are taken as they are.

    Attributes:
        wrong: what is wrong with the bytes fed last, one line; "" where nothing is.
    """

    def __init__(self) -> None:
        self._head: bytes | None = None  # None: the stream begins here, or has begun
        self._chunks: _Chunks | None = None
        self.wrong = ""

    def feed(self, data: bytes) -> bytes:
        """Return what of the next bytes is the stream's."""
        self.wrong = ""
        if self._head is None and data.startswith((b"HTTP/", b"ICY ", b"SOURCETABLE ")):
            self._head, self._chunks = b"", None
        if self._head is not None:
            head, end, data = _split_head(self._head + data)
            if not end and len(head) < MOST_HEADER_BYTES:
                self._head = head
                return b""
            lines = head.decode("latin-1").lower().split("\r\n")
            self._head = None
            if not end or not (lines[0].startswith("icy 200") or " 200" in lines[0]):
                self.wrong = f"the caster answers {_printable(head.decode('latin-1').split(chr(13))[0])}"
                data = data if end else head
            chunked = any(line.startswith("transfer-encoding:") and "chunked" in line for line in lines)
            self._chunks = _Chunks() if chunked else None
        if self._chunks is None:
            return data
        try:
            return self._chunks.feed(data)
        except ValueError as error:  # bytes are missing: go on without the lengths, the parser finds its frames
            self._chunks, self.wrong = None, str(error)
            return data


def _split_head(data: bytes) -> tuple[bytes, bytes, bytes]:
    """Return an answer's head, its end ("" where it has not come) and the data behind; ICY 200 OK is a head itself."""
    if data.startswith(b"ICY 200"):
        line, found, rest = data.partition(b"\r\n")
        return line, found, rest.removeprefix(b"\r\n")
    return data.partition(b"\r\n\r\n")


class _Chunks:
    """Decodes the chunked transfer coding."""

    def __init__(self) -> None:
        self._held = b""
        self._left = 0  # bytes of the chunk still to come, its line end included

    def feed(self, data: bytes) -> bytes:
        """Return the contents; raises ValueError where the coding is invalid."""
        held, out = self._held + data, []
        while held:
            if self._left > 2:
                part = held[: self._left - 2]
                out.append(part)
                held, self._left = held[len(part) :], self._left - len(part)
            elif self._left:
                skipped = min(self._left, len(held))
                held, self._left = held[skipped:], self._left - skipped
            else:
                line, found, rest = held.partition(b"\r\n")
                if not found and len(held) < 64:
                    break
                length = _CHUNK_LENGTH.fullmatch(line.split(b";")[0].strip())
                if length is None:
                    raise ValueError(f"a chunk's length is {_printable(line[:20].decode('latin-1'))}")
                self._left, held = int(length[0], 16) + 2, rest
        self._held = held
        return b"".join(out)


def _printable(text: str) -> str:
    """Return a received line, shortened and without control characters."""
    return "".join(letter if letter.isprintable() else "·" for letter in text[:60]) or "nothing"
