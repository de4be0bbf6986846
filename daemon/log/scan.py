"""Reads an MCAP file record by record, whole or cut off, trusting nothing: lengths are bounded, every CRC is checked.

One pass, forward, a chunk in memory at a time. What is wrong is given as `Damage` and the reading goes on at the next
place where a record can begin.
"""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import BinaryIO, TypeVar

import lz4.frame
import zstandard
from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError

from daemon.log.format import MAGIC, LogError

# Chunks of ours are 1 MiB and one block: 16 MiB. A stranger's may be larger; beyond this they are refused.
MAX_CHUNK_BYTES = 256 << 20
MAX_RECORD_BYTES = 256 << 20
_HEAD = struct.Struct("<BQ")
_CHUNK_HEAD = struct.Struct("<QQQII")  # start, end, uncompressed size, crc, length of the compression's name

OP_HEADER, OP_FOOTER, OP_SCHEMA, OP_CHANNEL, OP_MESSAGE = 1, 2, 3, 4, 5
OP_CHUNK, OP_MESSAGE_INDEX, OP_ATTACHMENT, OP_METADATA, OP_DATA_END = 6, 7, 9, 12, 15
_OPCODES = frozenset(range(1, 16))
_CONTENT: dict[int, type[records.McapRecord]] = {
    OP_HEADER: records.Header,
    OP_SCHEMA: records.Schema,
    OP_CHANNEL: records.Channel,
    OP_ATTACHMENT: records.Attachment,
    OP_METADATA: records.Metadata,
}
RecordT = TypeVar("RecordT", bound=records.McapRecord)
_RESYNC_STEP = 1 << 20


@dataclass(frozen=True, slots=True)
class Record:
    """A record outside chunks, or a chunk's records unpacked (opcode `OP_CHUNK`, CRC checked).

    Attributes:
        opcode: of the MCAP specification.
        offset: of the record in the file.
        length: with its head.
        body: what follows the head; of a chunk, its records, decompressed.
    """

    opcode: int
    offset: int
    length: int
    body: bytes


@dataclass(frozen=True, slots=True)
class Damage:
    """A stretch of the file that could not be read.

    Attributes:
        offset, length: bytes of the file.
        what: in words.
        messages: how many are lost with it, where an index beside it tells; None: unknown.
    """

    offset: int
    length: int
    what: str
    messages: int | None = None


def scan(file: BinaryIO, size: int) -> Iterator[Record | Damage]:
    """All records of the data section, in order, and every damage; ends at the data's end, the footer or the cut.

    Raises:
        LogError: it is no MCAP file.
    """
    file.seek(0)
    if file.read(len(MAGIC)) != MAGIC:
        raise LogError("is no MCAP file")
    offset = len(MAGIC)
    lost_from: int | None = None
    while offset < size:
        found = _read_record(file, offset, size)
        if isinstance(found, Record):
            if lost_from is not None:
                yield Damage(lost_from, offset - lost_from, "unreadable bytes")
                lost_from = None
            yield found
            if found.opcode in (OP_DATA_END, OP_FOOTER):
                return
            offset += found.length
        elif found.length:
            yield found
            offset += found.length
        else:
            lost_from = offset if lost_from is None else lost_from
            resumed = _resync(file, offset + 1, size)
            if resumed is None:
                cut = _is_cut(file, offset, size)
                what = "the file ends within a record" if cut else "unreadable bytes up to the end"
                yield Damage(lost_from, size - lost_from, what)
                return
            offset = resumed
    yield Damage(size, 0, "the file has no end: its index and footer were never written")


def _is_cut(file: BinaryIO, offset: int, size: int) -> bool:
    """Whether a plausible record begins here and only its end is missing."""
    file.seek(offset)
    head = file.read(_HEAD.size)
    if len(head) < _HEAD.size:
        return True
    opcode, length = _HEAD.unpack(head)
    beyond: bool = offset + _HEAD.size + length > size
    return opcode in _OPCODES and length <= MAX_RECORD_BYTES and beyond


def _read_record(file: BinaryIO, offset: int, size: int) -> Record | Damage:
    """The record at an offset; `Damage` of length 0 where none can begin there."""
    file.seek(offset)
    head = file.read(_HEAD.size)
    nothing = Damage(offset, 0, "")
    if len(head) < _HEAD.size:
        return nothing
    opcode, length = _HEAD.unpack(head)
    total = _HEAD.size + length
    if opcode not in _OPCODES or length > MAX_RECORD_BYTES or offset + total > size:
        return nothing
    if opcode != OP_CHUNK:
        return _outside_chunks(opcode, offset, total, file.read(length))
    body = file.read(length)
    if len(body) < _CHUNK_HEAD.size or not _plausible_chunk(body):
        return nothing
    try:
        return Record(opcode, offset, total, unpack_chunk(body))
    except LogError as error:
        return Damage(offset, total, str(error), _indexed_messages(file, offset + total, size))


def _outside_chunks(opcode: int, offset: int, total: int, body: bytes) -> Record | Damage:
    """A record that has no CRC of its own (but an attachment's): its content must be what its opcode says."""
    if opcode == OP_ATTACHMENT and not _attachment_is_whole(body):
        return Damage(offset, total, "attachment with a wrong CRC")
    try:
        if opcode in _CONTENT:
            parse_record(_CONTENT[opcode], body)
    except LogError as error:
        return Damage(offset, total, str(error))
    return Record(opcode, offset, total, body)


def parse_record(kind: type[RecordT], body: bytes) -> RecordT:
    """The content of a record.

    Raises:
        LogError: it is not what its opcode says.
    """
    try:
        parsed: RecordT = kind.read(ReadDataStream(io.BytesIO(body)))  # type: ignore[attr-defined]
    except (McapError, struct.error, ValueError, MemoryError, OverflowError) as error:
        raise LogError(f"{kind.__name__} record that cannot be read: {error}") from error
    return parsed


def _plausible_chunk(body: bytes) -> bool:
    name_length: int = _CHUNK_HEAD.unpack_from(body)[4]
    at = _CHUNK_HEAD.size + name_length
    if name_length > 32 or len(body) < at + 8:
        return False
    return int(struct.unpack_from("<Q", body, at)[0]) == len(body) - at - 8


def unpack_chunk(body: bytes) -> bytes:
    """The records of a chunk.

    Raises:
        LogError: unknown compression, absurd size, undecodable, or a wrong CRC.
    """
    _, _, size, crc, name_length = _CHUNK_HEAD.unpack_from(body)
    name = body[_CHUNK_HEAD.size : _CHUNK_HEAD.size + name_length]
    stored = body[_CHUNK_HEAD.size + name_length + 8 :]
    if size > MAX_CHUNK_BYTES:
        raise LogError(f"chunk claims {size} bytes, more than {MAX_CHUNK_BYTES}")
    records = _decompress(name, stored, size)
    if len(records) != size:
        raise LogError(f"chunk holds {len(records)} bytes instead of {size}")
    if crc and zlib.crc32(records) != crc:
        raise LogError("chunk with a wrong CRC")
    return records


def _decompress(name: bytes, stored: bytes, size: int) -> bytes:
    """Never more than ``size`` bytes and one, whatever the stored bytes would unfold to."""
    if name == b"":
        return stored
    try:
        if name == b"lz4":
            unpacked: bytes = lz4.frame.LZ4FrameDecompressor().decompress(stored, max_length=size + 1)
            return unpacked
        if name == b"zstd":
            with zstandard.ZstdDecompressor().stream_reader(stored) as reader:
                return bytes(reader.read(size + 1))
    except (RuntimeError, EOFError, zstandard.ZstdError, MemoryError) as error:
        raise LogError(f"chunk cannot be decompressed: {error}") from error
    raise LogError(f"chunk with unknown compression {name!r}")


def _attachment_is_whole(body: bytes) -> bool:
    crc = int.from_bytes(body[-4:], "little")
    return crc == 0 or zlib.crc32(body[:-4]) == crc


def _indexed_messages(file: BinaryIO, offset: int, size: int) -> int | None:
    """Messages that the index records right behind a chunk speak of."""
    total: int | None = None
    while offset + _HEAD.size <= size:
        file.seek(offset)
        opcode, length = _HEAD.unpack(file.read(_HEAD.size))
        if opcode != OP_MESSAGE_INDEX or not 6 <= length <= MAX_RECORD_BYTES:
            break
        file.seek(2, 1)
        entries = int.from_bytes(file.read(4), "little")
        if entries != length - 6:
            break
        total = (total or 0) + entries // 16
        offset += _HEAD.size + length
    return total


def _resync(file: BinaryIO, offset: int, size: int) -> int | None:
    """The next place where a chunk begins that can be unpacked."""
    while offset < size:
        file.seek(offset)
        window = file.read(_RESYNC_STEP + _HEAD.size)
        at = window.find(OP_CHUNK, 0, _RESYNC_STEP)
        while at >= 0:
            if at + _HEAD.size <= len(window):
                length = _HEAD.unpack_from(window, at)[1]
                if _CHUNK_HEAD.size < length <= MAX_RECORD_BYTES and offset + at + _HEAD.size + length <= size:
                    found = _read_record(file, offset + at, size)
                    if isinstance(found, Record):
                        return offset + at
            at = window.find(OP_CHUNK, at + 1, _RESYNC_STEP)
        offset += _RESYNC_STEP
    return None
