"""Reads an MCAP file record by record, whole or cut off, and trusts nothing: lengths are bounded, every CRC is checked.

It reads in one forward pass and holds one chunk in memory at a time. Errors are returned as `Damage`, and reading
continues at the next whole chunk. Records outside chunks have no CRC, so the content of each must match its opcode:
believing a damaged record could skip good chunks silently.
"""

from __future__ import annotations

import io
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import BinaryIO, TypeVar

import lz4.frame
import zstandard
from fastcrc.crc32 import iso_hdlc as crc32
from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError

from swath.daemon.log.format import MAGIC, LogError

# Chunks of swath have at most 1 MiB and one block: 16 MiB. Foreign chunks may be larger, up to this limit. Their
# messages may be as small as 31 bytes, and each then becomes an object of several hundred bytes.
MAX_CHUNK_BYTES = 32 << 20
MAX_RECORD_BYTES = 64 << 20
_HEAD = struct.Struct("<BQ")
_CHUNK_HEAD = struct.Struct("<QQQII")  # start, end, uncompressed size, crc, length of the compression's name
_COMPRESSION_NAME_MAX_BYTES = 32
_CHUNK_HEAD_MAX_BYTES = _CHUNK_HEAD.size + _COMPRESSION_NAME_MAX_BYTES + 8  # plus the length of the records
_MESSAGE_FIXED_BYTES = 22  # channel, sequence, log time, publish time

OP_HEADER, OP_FOOTER, OP_SCHEMA, OP_CHANNEL, OP_MESSAGE = 1, 2, 3, 4, 5
OP_CHUNK, OP_MESSAGE_INDEX, OP_ATTACHMENT, OP_STATISTICS, OP_METADATA, OP_DATA_END = 6, 7, 9, 11, 12, 15
OPCODES = frozenset(range(1, 16))
# Opcodes from 0x80 on are private and skipped. One that differs by one bit from a specified opcode is probably damage.
_FIRST_PRIVATE_OPCODE = 0x90
_FOOTER_BYTES = 20
_CONTENT: dict[int, type[records.McapRecord]] = {
    OP_HEADER: records.Header,
    OP_SCHEMA: records.Schema,
    OP_CHANNEL: records.Channel,
    OP_ATTACHMENT: records.Attachment,
    OP_METADATA: records.Metadata,
}
RecordT = TypeVar("RecordT", bound=records.McapRecord)
ChannelFilter = Callable[[int], bool]  # takes a channel's id
_RESYNC_STEP = 1 << 20


@dataclass(frozen=True, slots=True)
class Record:
    """A record outside chunks, or a chunk's records unpacked (opcode `OP_CHUNK`, CRC checked).

    Attributes:
        opcode: of the MCAP specification.
        offset: of the record in the file.
        length: including its head.
        body: the bytes after the head; for a chunk, its decompressed records.
    """

    opcode: int
    offset: int
    length: int
    body: bytes


NO_INDEX = "the file is incomplete: its index and footer were never written"
BAD_INDEX = "index and footer are missing, cut off or wrong"


@dataclass(frozen=True, slots=True)
class Damage:
    """A stretch of the file that could not be read.

    Attributes:
        offset, length: bytes of the file.
        what: description of the damage.
        messages: number of messages lost with it, if an index beside it gives the number; None if unknown.
    """

    offset: int
    length: int
    what: str
    messages: int | None = None

    @property
    def index_only(self) -> bool:
        """True if no message is lost: only the index and the footer, which follow from the messages."""
        return self.what in (NO_INDEX, BAD_INDEX)


def scan(
    file: BinaryIO, size: int, *, chunks: bool = True, wanted: ChannelFilter | None = None
) -> Iterator[Record | Damage]:
    """Yield all records of the data section in order, and every damage, up to the end of the data or of the file.

    Args:
        file: seekable.
        size: read no further.
        chunks: False skips chunks without reading them.
        wanted: called with every channel that the index behind a chunk names; if it accepts none, the chunk is given
            unread, with an empty body.

    Raises:
        LogError: it is not an MCAP file.
    """
    held: Damage | None = None
    for found in _scan(file, size, chunks=chunks, wanted=wanted):
        if isinstance(found, Damage):
            if held is not None and (held.offset + held.length, held.what) == (found.offset, found.what):
                found = _joined(held, found)
            elif held is not None:
                yield held
            held = found
        else:
            if held is not None:
                yield held
                held = None
            yield found
    if held is not None:
        yield held


def _scan(file: BinaryIO, size: int, *, chunks: bool, wanted: ChannelFilter | None) -> Iterator[Record | Damage]:
    file.seek(0)
    if file.read(len(MAGIC)) != MAGIC:
        raise LogError("is not an MCAP file")
    offset = len(MAGIC)
    while offset < size:
        found = _read_record(file, offset, size, chunks=chunks, wanted=wanted)
        if isinstance(found, Damage) and not found.length:
            resumed = next_chunk(file, offset + 1, size)
            if resumed is None:
                cut = _is_cut(file, offset, size)
                what = "the file ends within a record" if cut else "unreadable bytes up to the end"
                yield Damage(offset, size - offset, what)
                return
            yield Damage(offset, resumed - offset, "unreadable bytes")
            offset = resumed
            continue
        if not isinstance(found, Record) or chunks or found.opcode != OP_CHUNK:
            yield found
        offset += found.length
        if isinstance(found, Record) and found.opcode == OP_DATA_END:
            if end_is_whole(file, offset, size):
                return
            resumed = next_chunk(file, offset, size)
            if resumed is None:
                yield Damage(offset, size - offset, BAD_INDEX)
                return
            yield Damage(offset, resumed - offset, "unreadable bytes")
            offset = resumed
    yield Damage(size, 0, NO_INDEX)


def _joined(one: Damage, other: Damage) -> Damage:
    known = one.messages is not None and other.messages is not None
    messages = (one.messages or 0) + (other.messages or 0) if known else None
    return Damage(one.offset, one.length + other.length, one.what, messages)


def summary_records(file: BinaryIO, offset: int, size: int) -> Iterator[Record]:
    """Yield the records between the end of the data, at ``offset``, and the footer; `scan` must have found the end
    whole.
    """
    while offset + _HEAD.size <= size:
        file.seek(offset)
        opcode, length = _HEAD.unpack(file.read(_HEAD.size))
        if opcode == OP_FOOTER or length > MAX_RECORD_BYTES or offset + _HEAD.size + length > size:
            return
        yield Record(opcode, offset, _HEAD.size + length, file.read(length))
        offset += _HEAD.size + length


def end_is_whole(file: BinaryIO, offset: int, size: int) -> bool:
    """Return True if a summary with correct CRC, the footer and the magic fill the file from ``offset`` to its end."""
    footer_at = size - len(MAGIC) - _FOOTER_BYTES - _HEAD.size
    if footer_at < offset:
        return False
    file.seek(footer_at)
    tail = file.read(size - footer_at)
    if tail[: _HEAD.size] != _HEAD.pack(OP_FOOTER, _FOOTER_BYTES) or not tail.endswith(MAGIC):
        return False
    summary_start, _, expected = struct.unpack_from("<QQI", tail, _HEAD.size)
    if summary_start != (offset if footer_at > offset else 0):
        return False
    crc = 0
    file.seek(offset)
    for at in range(offset, footer_at, _RESYNC_STEP):
        crc = crc32(file.read(min(_RESYNC_STEP, footer_at - at)), crc)
    return bool(expected == 0 or crc32(tail[: _HEAD.size + _FOOTER_BYTES - 4], crc) == expected)


def _is_cut(file: BinaryIO, offset: int, size: int) -> bool:
    """Return whether a plausible record begins here and only its end is missing."""
    file.seek(offset)
    head = file.read(_HEAD.size)
    if len(head) < _HEAD.size:
        return True
    opcode, length = _HEAD.unpack(head)
    beyond: bool = offset + _HEAD.size + length > size
    return opcode in OPCODES and length <= MAX_RECORD_BYTES and beyond


def _read_record(
    file: BinaryIO, offset: int, size: int, *, chunks: bool = True, wanted: ChannelFilter | None = None
) -> Record | Damage:
    """Return the record at an offset; return `Damage` of length 0 if no record can begin there."""
    file.seek(offset)
    head = file.read(_HEAD.size)
    nothing = Damage(offset, 0, "")
    if len(head) < _HEAD.size:
        return nothing
    opcode, length = _HEAD.unpack(head)
    total = _HEAD.size + length
    if opcode == 0 or length > MAX_RECORD_BYTES or offset + total > size:
        return nothing
    if opcode not in OPCODES:
        if not _may_begin(file, offset + total, size):
            return nothing
        private = opcode >= _FIRST_PRIVATE_OPCODE
        return Record(opcode, offset, total, b"") if private else Damage(offset, total, "record of an unknown kind")
    if opcode != OP_CHUNK:
        return _outside_chunks(file, opcode, offset, total, size)
    start = file.read(min(length, _CHUNK_HEAD_MAX_BYTES))
    if not _plausible_chunk(start, length):
        return nothing
    if not chunks and _may_begin(file, offset + total, size):
        return Record(opcode, offset, total, b"")
    if wanted is not None:
        indexed = [channel for channel, _ in _indexed(file, offset + total, size)]
        if indexed and not any(wanted(channel) for channel in indexed):
            return Record(opcode, offset, total, b"")
    file.seek(offset + _HEAD.size)
    try:
        _refuse_large_chunk(_CHUNK_HEAD.unpack_from(start)[2], length)
        return Record(opcode, offset, total, unpack_chunk(file.read(length)))
    except LogError as error:
        return Damage(offset, total, str(error), _indexed_messages(file, offset + total, size))


def _may_begin(file: BinaryIO, offset: int, size: int) -> bool:
    """Return True if the head of a specified record is at this offset, or the file ends there."""
    file.seek(offset)
    head = file.read(_HEAD.size)
    if len(head) < _HEAD.size:
        return offset + len(head) == size
    opcode, length = _HEAD.unpack(head)
    return opcode in OPCODES and length <= MAX_RECORD_BYTES


def _outside_chunks(file: BinaryIO, opcode: int, offset: int, total: int, size: int) -> Record | Damage:
    """Return a record outside chunks if its content matches its opcode; only attachments have a CRC of their own."""
    nothing = Damage(offset, 0, "")
    length = total - _HEAD.size
    if opcode not in _CONTENT:
        body = file.read(min(length, 6))
        if opcode == OP_MESSAGE_INDEX:
            entries = int.from_bytes(body[2:6], "little")
            return Record(opcode, offset, total, b"") if entries == length - 6 and not entries % 16 else nothing
        if opcode == OP_DATA_END:
            return Record(opcode, offset, total, body) if length == 4 else nothing
        if opcode == OP_MESSAGE and length >= _MESSAGE_FIXED_BYTES and _may_begin(file, offset + total, size):
            return Damage(offset, total, "messages outside a chunk, which no CRC covers", 1)
        return nothing  # all other records belong behind the data's end
    body = file.read(length)
    if opcode == OP_ATTACHMENT and not _attachment_is_whole(body):
        whole_frame = _may_begin(file, offset + total, size)
        return Damage(offset, total, "attachment with a wrong CRC") if whole_frame else nothing
    try:
        stream = ReadDataStream(io.BytesIO(body))
        _parse(_CONTENT[opcode], stream)
    except LogError as error:
        return Damage(offset, total, str(error)) if _may_begin(file, offset + total, size) else nothing
    # a later version of the specification may have appended fields, which are skipped
    if stream.count != length and not _may_begin(file, offset + total, size):
        return nothing
    return Record(opcode, offset, total, body)


def parse_record(kind: type[RecordT], body: bytes) -> RecordT:
    """Parse the content of a record.

    Raises:
        LogError: it does not match its opcode.
    """
    return _parse(kind, ReadDataStream(io.BytesIO(body)))


def _parse(kind: type[RecordT], stream: ReadDataStream) -> RecordT:
    try:
        parsed: RecordT = kind.read(stream)  # type: ignore[attr-defined]
    except (McapError, struct.error, ValueError, MemoryError, OverflowError) as error:
        raise LogError(f"{kind.__name__} record that cannot be read: {error}") from error
    return parsed


def _plausible_chunk(start: bytes, length: int) -> bool:
    """Return True if these bytes can begin a whole chunk of this length, that is, if its lengths agree with
    each other.
    """
    if len(start) < _CHUNK_HEAD.size + 8:
        return False
    size, name_length = _CHUNK_HEAD.unpack_from(start)[2], _CHUNK_HEAD.unpack_from(start)[4]
    at = _CHUNK_HEAD.size + name_length
    if name_length > _COMPRESSION_NAME_MAX_BYTES or len(start) < at + 8:
        return False
    stored = int(struct.unpack_from("<Q", start, at)[0])
    return bool(stored == length - at - 8 and (name_length > 0 or stored == size))


def unpack_chunk(body: bytes) -> bytes:
    """Unpack the records of a chunk and check its CRC.

    Raises:
        LogError: unknown compression, excessive size, undecodable data, or a wrong CRC.
    """
    _, _, size, crc, name_length = _CHUNK_HEAD.unpack_from(body)
    name = body[_CHUNK_HEAD.size : _CHUNK_HEAD.size + name_length]
    stored = body[_CHUNK_HEAD.size + name_length + 8 :]
    _refuse_large_chunk(size, len(stored))
    records = _decompress(name, stored, size)
    if len(records) != size:
        raise LogError(f"chunk holds {len(records)} bytes instead of {size}")
    if crc32(records) != crc:
        raise LogError("chunk with a wrong CRC" if crc else "chunk without a CRC")
    return records


def _refuse_large_chunk(size: int, stored: int) -> None:
    if size > MAX_CHUNK_BYTES:
        raise LogError(f"chunk claims {size} bytes, more than {MAX_CHUNK_BYTES}")
    if stored > MAX_CHUNK_BYTES + MAX_CHUNK_BYTES // 64:  # compression can lengthen incompressible data a little
        raise LogError(f"chunk of {stored} bytes, more than {MAX_CHUNK_BYTES}")


def _decompress(name: bytes, stored: bytes, size: int) -> bytes:
    """Decompress a chunk, but never more than ``size`` + 1 bytes, however far the stored bytes would expand."""
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
    return crc == 0 or crc32(body[:-4]) == crc


def _indexed_messages(file: BinaryIO, offset: int, size: int) -> int | None:
    """Return the number of messages that the index records right behind a chunk list; None without index records."""
    counts = [entries // 16 for _, entries in _indexed(file, offset, size)]
    return sum(counts) if counts else None


def _indexed(file: BinaryIO, offset: int, size: int) -> Iterator[tuple[int, int]]:
    """Yield channel, and number of bytes of entries, of each index record right behind a chunk."""
    while offset + _HEAD.size <= size:
        file.seek(offset)
        opcode, length = _HEAD.unpack(file.read(_HEAD.size))
        if opcode != OP_MESSAGE_INDEX or not 6 <= length <= MAX_RECORD_BYTES:
            return
        channel, entries = struct.unpack("<HI", file.read(6).ljust(6, b"\0"))
        if entries != length - 6:
            return
        yield channel, entries
        offset += _HEAD.size + length


def next_chunk(file: BinaryIO, offset: int, size: int) -> int | None:
    """Return the offset of the next chunk that can be unpacked; None if there is none."""
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
