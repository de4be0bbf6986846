"""Common parts of the readers of recordings: the unit they yield, opening a file, and reporting damage."""

from __future__ import annotations

import gzip
import zlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from io import BufferedIOBase
from pathlib import Path
from typing import TypeVar

from swath.drivers.transports.base import TransportError

Address = tuple[str, int]
UnitT = TypeVar("UnitT")
LATEST_NS = 2**63 - 1
MAX_LINE_BYTES = 4096  # the longest valid line of a text format here has some 300


@dataclass(frozen=True, slots=True)
class CapturedUnit:
    """One unit as recorded, with its time and origin.

    Attributes:
        time_ns: the recorder's wall clock, nanoseconds since 1970.
        data: a datagram's payload, a SocketCAN frame of 16 or 72 bytes, or the bytes of one read of a stream.
        channel: the CAN interface's name; ``udp``, ``tcp`` or ``serial``.
        source, destination: address and port of a datagram or of a segment of TCP.
    """

    time_ns: int
    data: bytes
    channel: str
    source: Address | None = None
    destination: Address | None = None


class CaptureDamageError(TransportError):
    """A file is damaged from some place on."""


@dataclass(slots=True)
class CaptureTally:
    """Counts what a reader found beside units; a reader with a tally counts damage and goes on, without one it raises.

    Attributes:
        damage: number of places that could not be read. first_damage: the first of them, one line.
        passed: number of items left out on purpose, by kind.
        missing_bytes: bytes of streams that the file should hold and does not; each gap is damage too.
    """

    damage: int = 0
    first_damage: str = ""
    missing_bytes: int = 0
    passed: Counter[str] = field(default_factory=Counter)

    def damaged(self, text: str) -> None:
        """Count a bad place and remember the first one."""
        if not self.damage:
            self.first_damage = text
        self.damage += 1


def report(tally: CaptureTally | None, text: str) -> None:
    """Count a bad place in the tally, or raise `CaptureDamageError` without one."""
    if tally is None:
        raise CaptureDamageError(text)
    tally.damaged(text)


def until_damage(units: Iterator[UnitT], tally: CaptureTally | None) -> Iterator[UnitT]:
    """Yield units up to the place after which the file cannot be read."""
    try:
        yield from units
    except CaptureDamageError as error:
        report(tally, str(error))


def open_capture(path: Path) -> BufferedIOBase:
    """Open the file's content as a stream and decompress it if it begins with the gzip magic."""
    try:
        plain = path.open("rb")
        packed = plain.peek(2)[:2] == b"\x1f\x8b"
    except OSError as error:
        raise TransportError(f"{path}: {error.strerror}") from error
    if not packed:
        return plain
    plain.close()
    return gzip.open(path, "rb")


def read_beginning(path: Path, count: int) -> tuple[bytes, str]:
    """Return up to ``count`` bytes of a file's content, and the error that ended the reading early ("" if none did).

    Raises:
        TransportError: nothing can be read.
    """
    data, damage = b"", ""
    with open_capture(path) as stream:
        try:
            while len(data) < count and (piece := stream.read1(count - len(data))):
                data += piece
        except (EOFError, OSError, zlib.error) as error:
            if not data:
                raise TransportError(f"{path}: cannot be read: {error}") from error
            damage = str(error)
    return data, damage


def read_bytes(stream: BufferedIOBase, count: int, path: Path) -> bytes:
    """Return up to ``count`` bytes, fewer at the end of the file only."""
    try:
        return stream.read(count)
    except (EOFError, OSError, zlib.error) as error:
        raise CaptureDamageError(f"{path}: cannot be read further: {error}") from error


def read_lines(path: Path, tally: CaptureTally | None = None) -> Iterator[tuple[int, str]]:
    """Yield the lines that are not empty, with their numbers; a line longer than any format here allows is damage."""
    with open_capture(path) as stream:
        number = 0
        while line := _read_line(stream, path):
            number += 1
            if len(line) > MAX_LINE_BYTES:
                report(tally, f"{path}: line {number} is longer than {MAX_LINE_BYTES} bytes")
                while line and not line.endswith(b"\n"):
                    line = _read_line(stream, path)
                continue
            text = line.decode("ascii", "replace").strip()
            if text:
                yield number, text


def _read_line(stream: BufferedIOBase, path: Path) -> bytes:
    try:
        return stream.readline(MAX_LINE_BYTES + 1)
    except (EOFError, OSError, zlib.error) as error:
        raise CaptureDamageError(f"{path}: cannot be read further: {error}") from error
