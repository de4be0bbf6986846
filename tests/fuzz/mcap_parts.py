"""Splits an MCAP file and reassembles it with any content, with right lengths and checksums."""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass, field

import lz4.frame
import zstandard

MAGIC = b"\x89MCAP0\r\n"
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX = 1, 2, 3, 4, 5, 6, 7
ATTACHMENT, STATISTICS, METADATA, DATA_END = 9, 11, 12, 15
_HEAD = struct.Struct("<BQ")
_CHUNK_HEAD = struct.Struct("<QQQII")


def text(value: bytes | str) -> bytes:
    """Return a string in MCAP encoding."""
    content = value.encode() if isinstance(value, str) else value
    return struct.pack("<I", len(content)) + content


def record(opcode: int, body: bytes) -> bytes:
    """Return a record with its head."""
    return _HEAD.pack(opcode, len(body)) + body


def channel(number: int, topic: bytes | str, *, schema: int = 0, encoding: str = "x-swath-serial") -> bytes:
    """Return the body of a channel record without metadata."""
    return struct.pack("<HH", number, schema) + text(topic) + text(encoding) + struct.pack("<I", 0)


def schema(number: int, name: str, data: bytes = b"{}") -> bytes:
    """Return the body of a schema record."""
    return struct.pack("<H", number) + text(name) + text("jsonschema") + text(data)


def message(number: int, time_ns: int, data: bytes, *, sequence: int = 0) -> bytes:
    """Return the body of a message record; a negative time is written as its two's complement."""
    time = time_ns & ((1 << 64) - 1)
    return struct.pack("<HIQQ", number, sequence, time, time) + data


def metadata(name: str, values: dict[str, str]) -> bytes:
    """Return the body of a metadata record."""
    pairs = b"".join(text(key) + text(value) for key, value in values.items())
    return text(name) + struct.pack("<I", len(pairs)) + pairs


def attachment(name: bytes | str, data: bytes, *, claimed: int | None = None) -> bytes:
    """Return the body of an attachment record; ``claimed`` is the length that it states for its data."""
    size = len(data) if claimed is None else claimed
    body = struct.pack("<QQ", 1, 1) + text(name) + text("text/plain") + struct.pack("<Q", size) + data
    return body + struct.pack("<I", zlib.crc32(body))


@dataclass(slots=True)
class Piece:
    """A record; for a chunk, ``inner`` has its records and ``body`` the name of its compression."""

    opcode: int
    body: bytes
    inner: list[Piece] | None = None
    claimed: int | None = None  # the size stated by a chunk, if it is wrong

    def encode(self) -> bytes:
        """Encode with its head and a valid CRC."""
        if self.inner is not None:
            return record(CHUNK, chunk_body(b"".join(one.encode() for one in self.inner), self.body, self.claimed))
        if self.opcode == ATTACHMENT and len(self.body) >= 4:
            return record(ATTACHMENT, self.body[:-4] + struct.pack("<I", zlib.crc32(self.body[:-4])))
        return record(self.opcode, self.body)


def chunk_body(content: bytes, compression: bytes, claimed: int | None = None) -> bytes:
    """Return the body of a chunk with that content."""
    stored = content
    if compression == b"lz4":
        stored = lz4.frame.compress(content)
    elif compression == b"zstd":
        stored = zstandard.ZstdCompressor(level=1).compress(content)
    size = len(content) if claimed is None else claimed
    head = _CHUNK_HEAD.pack(0, 1, size, zlib.crc32(content), len(compression))
    return head + compression + struct.pack("<Q", len(stored)) + stored


@dataclass(slots=True)
class LogParts:
    """A file: its records, and what follows the last whole one."""

    pieces: list[Piece] = field(default_factory=list)
    rest: bytes = b""

    def encode(self) -> bytes:
        """Return the file, with a footer that fits if it has one."""
        done = MAGIC
        summary_start = 0
        for piece in self.pieces:
            if piece.opcode == FOOTER:
                start = summary_start if 0 < summary_start < len(done) else 0
                footer = _HEAD.pack(FOOTER, 20) + struct.pack("<QQ", start, 0)
                crc = zlib.crc32(footer, zlib.crc32(done[summary_start:]) if start else 0)
                done += footer + struct.pack("<I", crc)
                continue
            done += piece.encode()
            if piece.opcode == DATA_END:
                summary_start = len(done)
        return done + self.rest


def take_apart(data: bytes) -> LogParts:
    """Split a file into records as far as its lengths allow."""
    pieces, at = _records(data, len(MAGIC))
    for piece in pieces:
        if piece.opcode == CHUNK:
            _open_chunk(piece)
    return LogParts(pieces, data[at:])


def _records(data: bytes, at: int) -> tuple[list[Piece], int]:
    pieces = []
    while at + _HEAD.size <= len(data):
        opcode, length = _HEAD.unpack_from(data, at)
        if length > len(data) - at - _HEAD.size:
            break
        pieces.append(Piece(opcode, data[at + _HEAD.size : at + _HEAD.size + length]))
        at += _HEAD.size + length
    return pieces, at


def _open_chunk(piece: Piece) -> None:
    if len(piece.body) < _CHUNK_HEAD.size:
        return
    _, _, size, _, name_length = _CHUNK_HEAD.unpack_from(piece.body)
    name = piece.body[_CHUNK_HEAD.size : _CHUNK_HEAD.size + name_length]
    stored = piece.body[_CHUNK_HEAD.size + name_length + 8 :]
    if size > 1 << 20:
        return
    try:
        if name == b"lz4":
            stored = lz4.frame.LZ4FrameDecompressor().decompress(stored, max_length=1 << 20)
        elif name == b"zstd":
            stored = zstandard.ZstdDecompressor().decompress(stored, max_output_size=1 << 20)
    except (RuntimeError, EOFError, zstandard.ZstdError):
        return
    piece.inner, piece.body = _records(stored, 0)[0], name
