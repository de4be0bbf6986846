"""Writes the parts of a log. Messages are laid out in bulk by NumPy; every chunk goes to the kernel at once.

MCAP specification, version 0: a message record is opcode 5, length u64, channel u16, sequence u32, log time u64,
publish time u64, data. Every chunk begins with the schemas and channels that it uses, so that it can be read alone.
"""

from __future__ import annotations

import errno
import json
import os
import struct
import time
import zlib
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import lz4.frame
import numpy as np
import zstandard
from mcap import records
from mcap.data_stream import RecordBuilder

from daemon.log.format import (
    CHUNK_BYTES,
    CHUNK_CLASSES,
    CHUNK_OPEN_NS,
    LIBRARY,
    MAGIC,
    PROFILE,
    SCHEMA_IDS,
    SCHEMAS,
    SESSION_METADATA,
    ChannelSpec,
    ChunkClass,
    SessionInfo,
)
from georef.records import ByteRows, Int64Array

MESSAGE_HEADER_BYTES = 31
_OP_MESSAGE, _OP_CHUNK, _OP_MESSAGE_INDEX, _OP_FOOTER = 5, 6, 7, 2
_FIXED_CHUNK_FIELDS = 40  # start u64, end u64, size u64, crc u32, compression length u32, records length u64


class LogWriteError(OSError):
    """The disk refused a record; the file was cut back to the last whole one and stays usable."""


@dataclass(frozen=True, slots=True)
class EncodedBlock:
    """Message records of one channel, ready to be laid into a chunk.

    Attributes:
        count: messages.
        log_time_ns: (n,) int64.
        offsets: (n,) int64, of each record within ``data``.
        data: the records.
    """

    channel_id: int
    count: int
    log_time_ns: Int64Array
    offsets: Int64Array
    data: memoryview


def encode_block(
    channel_id: int,
    first_sequence: int,
    log_time_ns: Int64Array,
    units: ByteRows,
    publish_time_ns: Int64Array | None = None,
) -> EncodedBlock:
    """Messages of equal length, one a unit.

    Args:
        channel_id: of all.
        first_sequence: number of the first; u32, wraps.
        log_time_ns: (n,).
        units: (n, length) uint8.
        publish_time_ns: (n,); the log time where None.
    """
    count, length = units.shape
    layout = np.dtype(
        [
            ("opcode", "u1"),
            ("length", "<u8"),
            ("channel", "<u2"),
            ("sequence", "<u4"),
            ("log_time", "<u8"),
            ("publish_time", "<u8"),
            ("data", "u1", (length,)),
        ]
    )
    rows = np.empty(count, layout)
    rows["opcode"] = _OP_MESSAGE
    rows["length"] = MESSAGE_HEADER_BYTES - 9 + length
    rows["channel"] = channel_id
    rows["sequence"] = (first_sequence + np.arange(count, dtype=np.uint64)) & 0xFFFFFFFF
    rows["log_time"] = log_time_ns
    rows["publish_time"] = log_time_ns if publish_time_ns is None else publish_time_ns
    rows["data"] = units
    offsets = np.arange(count, dtype=np.int64) * layout.itemsize
    return EncodedBlock(channel_id, count, log_time_ns, offsets, rows.view(np.uint8).data)


def encode_raw(channel_id: int, log_time_ns: Int64Array, rows: ByteRows) -> EncodedBlock:
    """Whole message records of a log, (n, 31 + length) uint8, to be written again as they are."""
    count, stride = rows.shape
    offsets = np.arange(count, dtype=np.int64) * stride
    return EncodedBlock(channel_id, count, log_time_ns, offsets, np.ascontiguousarray(rows).reshape(-1).data)


def encode_json(channel_id: int, sequence: int, log_time_ns: int, value: Mapping[str, Any]) -> EncodedBlock:
    """One JSON message."""
    text = json.dumps(value, separators=(",", ":"), allow_nan=False).encode()
    unit = np.frombuffer(text, np.uint8).reshape(1, -1)
    return encode_block(channel_id, sequence, np.array([log_time_ns], dtype=np.int64), unit)


@dataclass(slots=True)
class _OpenChunk:
    """Blocks that wait to be written together."""

    opened_ns: int
    pieces: list[memoryview | bytes] = field(default_factory=list)
    size: int = 0
    schemas: set[str] = field(default_factory=set)
    blocks: dict[int, list[tuple[int, EncodedBlock]]] = field(default_factory=dict)  # channel: (offset, block)

    def append(self, piece: memoryview | bytes) -> None:
        self.pieces.append(piece)
        self.size += len(piece)

    def counts(self) -> Counter[int]:
        """Messages by channel."""
        return Counter({id_: sum(block.count for _, block in blocks) for id_, blocks in self.blocks.items()})


class PartWriter:
    """Writes one part. Belongs to one thread; nothing is buffered here but the open chunks.

    Attributes:
        written, lost: messages by channel whose chunk reached the kernel, or was refused.
        bytes_written: size of the file so far.
    """

    def __init__(self, path: Path, session: SessionInfo, part: int, *, compression: str = "auto") -> None:
        """Create the file exclusively, with header and session; both and the directory entry are made durable.

        Raises:
            OSError: it exists, or cannot be created or written.
        """
        self.path = path
        self.written: Counter[int] = Counter()
        self.lost: Counter[int] = Counter()
        self.bytes_written = 0
        self._compression = compression
        self._specs: dict[int, ChannelSpec] = {}
        self._chunks: dict[ChunkClass, _OpenChunk] = {}
        self._summary = _Summary()
        self._fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o640)
        try:
            self._write([MAGIC, _record(records.Header(profile=PROFILE, library=LIBRARY))])
            self.add_metadata(SESSION_METADATA, session.to_metadata(part))
            os.fsync(self._fd)
            _sync_directory(path.parent)
        except OSError:
            os.close(self._fd)
            raise

    # ------------------------------------------------------------------ what stands outside chunks

    def add_channel(self, channel_id: int, spec: ChannelSpec) -> None:
        """Make a channel known; it is written with the first chunk that uses it, and every one after."""
        self._specs[channel_id] = spec

    def add_metadata(self, name: str, values: dict[str, str]) -> None:
        """Write a metadata record; raises `LogWriteError`."""
        record = _record(records.Metadata(name=name, metadata=values))
        offset = self._write([record])
        self._summary.metadata.append(records.MetadataIndex(offset=offset, length=len(record), name=name))

    def add_attachment(self, name: str, media_type: str, data: bytes, log_time_ns: int) -> None:
        """Write an attachment; raises `LogWriteError`."""
        attachment = records.Attachment(
            create_time=log_time_ns, log_time=log_time_ns, name=name, media_type=media_type, data=data
        )
        record = _record(attachment)
        offset = self._write([record])
        index = records.AttachmentIndex(
            offset=offset,
            length=len(record),
            log_time=log_time_ns,
            create_time=log_time_ns,
            data_size=len(data),
            name=name,
            media_type=media_type,
        )
        self._summary.attachments.append(index)

    # ------------------------------------------------------------------ messages

    def add(self, block: EncodedBlock) -> None:
        """Lay a block into the open chunk of its class; close the chunk when it is full.

        Raises:
            LogWriteError: the chunk could not be written; its messages are counted in ``lost``.
        """
        spec = self._specs[block.channel_id]
        chunk = self._chunks.get(spec.chunk_class)
        if chunk is None:
            chunk = self._chunks[spec.chunk_class] = _OpenChunk(time.monotonic_ns())
        if block.channel_id not in chunk.blocks:
            self._introduce(chunk, block.channel_id, spec)
        chunk.blocks[block.channel_id].append((chunk.size, block))
        chunk.append(block.data)
        if chunk.size >= CHUNK_BYTES:
            self._close_chunk(spec.chunk_class)

    def close_due(self, now_ns: int) -> None:
        """Close chunks that have been open for 250 ms (CLOCK_MONOTONIC); raises `LogWriteError`."""
        for chunk_class in CHUNK_CLASSES:
            chunk = self._chunks.get(chunk_class)
            if chunk is not None and now_ns - chunk.opened_ns >= CHUNK_OPEN_NS:
                self._close_chunk(chunk_class)

    def flush(self) -> None:
        """Close all chunks; raises `LogWriteError` after having tried them all."""
        failed: LogWriteError | None = None
        for chunk_class in CHUNK_CLASSES:
            if chunk_class in self._chunks:
                try:
                    self._close_chunk(chunk_class)
                except LogWriteError as error:
                    failed = error
        if failed is not None:
            raise failed

    def sync(self) -> None:
        """Make durable what has been written."""
        os.fdatasync(self._fd)

    def finish(self) -> None:
        """Write index and footer, make them durable, close; raises `LogWriteError`. The file is closed either way."""
        try:
            self.flush()
            self._write_end()
            os.fsync(self._fd)
        finally:
            self.close()

    def close(self) -> None:
        """Close without an end; a second call does nothing."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1

    # ------------------------------------------------------------------ chunks

    def _introduce(self, chunk: _OpenChunk, channel_id: int, spec: ChannelSpec) -> None:
        """The channel's record, and its schema's, before its first message in a chunk."""
        chunk.blocks[channel_id] = []
        if spec.schema is not None and spec.schema not in chunk.schemas:
            chunk.schemas.add(spec.schema)
            chunk.append(_record(_schema(spec.schema)))
        chunk.append(_record(_channel(channel_id, spec)))

    def _close_chunk(self, chunk_class: ChunkClass) -> None:
        chunk = self._chunks.pop(chunk_class)
        counts = chunk.counts()
        pieces = self._lay_out(chunk_class, chunk)
        try:
            offset = self._write(pieces.all)
        except LogWriteError:
            self.lost.update(counts)
            raise
        self.written.update(counts)
        self._summary.add_chunk(offset, pieces, counts)

    def _lay_out(self, chunk_class: ChunkClass, chunk: _OpenChunk) -> _ChunkPieces:
        crc = 0
        for piece in chunk.pieces:
            crc = zlib.crc32(piece, crc)
        name, body = self._compress(chunk_class, chunk.pieces)
        stored = sum(len(piece) for piece in body)
        times = [block.log_time_ns for blocks in chunk.blocks.values() for _, block in blocks]
        start, end = min(int(t.min()) for t in times), max(int(t.max()) for t in times)
        head = struct.pack("<BQ", _OP_CHUNK, _FIXED_CHUNK_FIELDS + len(name) + stored)
        head += struct.pack("<QQQII", start, end, chunk.size, crc, len(name)) + name + struct.pack("<Q", stored)
        index_offsets: dict[int, int] = {}
        indexes: list[bytes] = []
        position = len(head) + stored
        chunk_length = position
        for channel_id, blocks in chunk.blocks.items():
            index_offsets[channel_id] = position
            indexes.append(_message_index(channel_id, blocks))
            position += len(indexes[-1])
        return _ChunkPieces(
            [head, *body, *indexes],
            start,
            end,
            chunk_length,
            position - chunk_length,
            index_offsets,
            name,
            stored,
            chunk.size,
        )

    def _compress(self, chunk_class: ChunkClass, pieces: Sequence[memoryview | bytes]) -> tuple[bytes, list[Any]]:
        kind = self._compression
        if kind == "auto":
            kind = "none" if chunk_class == "scanner" else "lz4"
        if kind == "none":
            return b"", list(pieces)
        joined = b"".join(pieces)
        if kind == "lz4":
            return b"lz4", [lz4.frame.compress(joined)]
        return b"zstd", [zstandard.ZstdCompressor(level=1).compress(joined)]

    # ------------------------------------------------------------------ the end

    def _write_end(self) -> None:
        data_end = _record(records.DataEnd(data_section_crc=0))
        self._write([data_end])
        summary_start = self.bytes_written
        sections = self._summary.sections(self._specs)
        body = b"".join(record for _, group in sections for record in group)
        offsets, position = b"", summary_start
        for opcode, group in sections:
            length = sum(map(len, group))
            if length:
                offset = records.SummaryOffset(group_opcode=opcode, group_start=position, group_length=length)
                offsets += _record(offset)
            position += length
        offset_start = summary_start + len(body)
        footer_head = struct.pack("<BQQQ", _OP_FOOTER, 20, summary_start, offset_start)
        crc = zlib.crc32(body + offsets + footer_head)
        self._write([body, offsets, footer_head, struct.pack("<I", crc), MAGIC])

    def _write(self, pieces: Sequence[Any]) -> int:
        """Write all pieces at the end of the file; returns where they begin."""
        start = self.bytes_written
        views = [memoryview(piece) for piece in pieces if len(piece)]
        total = sum(view.nbytes for view in views)
        limit = os.sysconf("SC_IOV_MAX")
        done = 0
        try:
            while views:
                count = os.writev(self._fd, views[:limit])
                if count == 0:
                    raise OSError(errno.EIO, "nothing was written")
                done += count
                views = _after(views, count)
        except OSError as error:
            self._cut_back(start)
            raise LogWriteError(error.errno, error.strerror or "cannot write", str(self.path)) from error
        self.bytes_written = start + total
        return start

    def _cut_back(self, size: int) -> None:
        """Leave no half record behind."""
        try:
            os.ftruncate(self._fd, size)
            os.lseek(self._fd, size, os.SEEK_SET)
        except OSError as error:
            # the next write would stand behind garbage: there must be none
            self.close()
            raise LogWriteError(error.errno, error.strerror or "cannot truncate", str(self.path)) from error


def _after(views: list[memoryview], count: int) -> list[memoryview]:
    """What is left of views after ``count`` bytes of them were written."""
    for number, view in enumerate(views):
        if count < view.nbytes:
            return [view[count:], *views[number + 1 :]]
        count -= view.nbytes
    return []


@dataclass(slots=True)
class _ChunkPieces:
    """A chunk as it goes to disk, and what its index entry needs."""

    all: list[Any]
    start: int
    end: int
    chunk_length: int
    index_length: int
    index_offsets: dict[int, int]
    compression: bytes
    stored: int
    size: int


@dataclass(slots=True)
class _Summary:
    """What the end of the file will say."""

    chunks: list[records.ChunkIndex] = field(default_factory=list)
    attachments: list[records.AttachmentIndex] = field(default_factory=list)
    metadata: list[records.MetadataIndex] = field(default_factory=list)
    messages: Counter[int] = field(default_factory=Counter)
    start: int | None = None
    end: int = 0

    def add_chunk(self, offset: int, pieces: _ChunkPieces, counts: Counter[int]) -> None:
        """Note a chunk that has been written at ``offset``."""
        self.messages.update(counts)
        self.start = pieces.start if self.start is None else min(self.start, pieces.start)
        self.end = max(self.end, pieces.end)
        index = records.ChunkIndex(
            chunk_length=pieces.chunk_length,
            chunk_start_offset=offset,
            compression=pieces.compression.decode(),
            compressed_size=pieces.stored,
            message_end_time=pieces.end,
            message_index_length=pieces.index_length,
            message_index_offsets={id_: offset + at for id_, at in pieces.index_offsets.items()},
            message_start_time=pieces.start,
            uncompressed_size=pieces.size,
        )
        self.chunks.append(index)

    def sections(self, specs: Mapping[int, ChannelSpec]) -> list[tuple[int, list[bytes]]]:
        """The summary's groups: opcode and records, those of the channels that have messages."""
        used = {id_: specs[id_] for id_ in self.messages}
        schemas = sorted({spec.schema for spec in used.values() if spec.schema is not None})
        statistics = records.Statistics(
            attachment_count=len(self.attachments),
            channel_count=len(used),
            channel_message_counts=dict(self.messages),
            chunk_count=len(self.chunks),
            message_count=self.messages.total(),
            message_end_time=self.end,
            message_start_time=self.start or 0,
            metadata_count=len(self.metadata),
            schema_count=len(schemas),
        )
        return [
            (3, [_record(_schema(name)) for name in schemas]),
            (4, [_record(_channel(id_, spec)) for id_, spec in used.items()]),
            (0x0B, [_record(statistics)]),
            (0x08, [_record(index) for index in self.chunks]),
            (0x0A, [_record(index) for index in self.attachments]),
            (0x0D, [_record(index) for index in self.metadata]),
        ]


def _record(record: records.McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    data: bytes = builder.end()
    return data


def _schema(name: str) -> records.Schema:
    return records.Schema(data=SCHEMAS[name], encoding="jsonschema", id=SCHEMA_IDS[name], name=name)


def _channel(channel_id: int, spec: ChannelSpec) -> records.Channel:
    return records.Channel(
        id=channel_id,
        topic=spec.topic,
        message_encoding=spec.message_encoding,
        metadata=spec.metadata,
        schema_id=0 if spec.schema is None else SCHEMA_IDS[spec.schema],
    )


def _message_index(channel_id: int, blocks: list[tuple[int, EncodedBlock]]) -> bytes:
    """The message index record of one channel in a chunk: (log time, offset) pairs."""
    count = sum(block.count for _, block in blocks)
    pairs = np.empty(count, np.dtype([("time", "<u8"), ("offset", "<u8")]))
    at = 0
    for start, block in blocks:
        pairs["time"][at : at + block.count] = block.log_time_ns
        pairs["offset"][at : at + block.count] = block.offsets + start
        at += block.count
    body = pairs.tobytes()
    return struct.pack("<BQHI", _OP_MESSAGE_INDEX, 6 + len(body), channel_id, len(body)) + body


def _sync_directory(folder: Path) -> None:
    fd = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)
