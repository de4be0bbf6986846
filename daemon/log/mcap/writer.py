"""Writes the parts of a log; every completed chunk goes to the kernel at once.

Every chunk begins with the schemas and channels that it uses, so that it can be read on its own.
"""

from __future__ import annotations

import contextlib
import errno
import os
import struct
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import lz4.frame
import zstandard
from fastcrc.crc32 import iso_hdlc as crc32
from mcap import records

from swath.daemon.log.claim import claim, stands_at
from swath.daemon.log.durable import begin_writing_out, sync_directory
from swath.daemon.log.format import (
    CHUNK_BYTES,
    CHUNK_CLASSES,
    CHUNK_OPEN_NS,
    LIBRARY,
    MAGIC,
    PROFILE,
    SESSION_METADATA,
    ChannelSpec,
    ChunkClass,
    SessionInfo,
)
from swath.daemon.log.mcap.encode import EncodedBlock, message_index
from swath.daemon.log.mcap.summary import ChunkPieces, SchemaTable, Summary, record_bytes

_OP_CHUNK, _OP_FOOTER = 6, 2
WRITE_OUT_BYTES = 8 << 20  # passed to the disk early; syncing a whole second of data at once takes too long
CHUNK_SPAN_NS = 2 * CHUNK_OPEN_NS  # of log time; a writer that was held up adds several seconds at once
_FIXED_CHUNK_FIELDS = 40  # start u64, end u64, size u64, crc u32, compression length u32, records length u64


class LogWriteError(OSError):
    """The disk refused a record; the file was cut back to the last whole record and stays usable."""


@dataclass(slots=True)
class _OpenChunk:
    """Blocks that are collected to be written together."""

    opened_ns: int
    first_log_ns: int
    pieces: list[memoryview | bytes] = field(default_factory=list)
    size: int = 0
    schemas: set[str] = field(default_factory=set)
    blocks: dict[int, list[tuple[int, EncodedBlock]]] = field(default_factory=dict)  # channel: (offset, block)

    def append(self, piece: memoryview | bytes) -> None:
        self.pieces.append(piece)
        self.size += len(piece)

    def counts(self) -> Counter[int]:
        """Return the number of messages by channel."""
        return Counter({id_: sum(block.count for _, block in blocks) for id_, blocks in self.blocks.items()})


def create_exclusively(path: Path) -> int:
    """Create the file of a part and return its descriptor, open for writing.

    Raises:
        FileExistsError: the path exists already.
        OSError: it cannot be created.
    """
    return os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o640)


class PartWriter:
    """Writes one part. It belongs to one thread and buffers only the open chunks.

    Attributes:
        written, lost: messages by channel whose chunk reached the kernel, or was refused.
        bytes_written: size of the file so far.
    """

    def __init__(
        self, path: Path, session: SessionInfo, part: int, *, compression: str = "auto", fd: int | None = None
    ) -> None:
        """Create the file exclusively, with header and session; both and the directory entry are made durable.

        Args:
            path: of the file.
            session, part: content of its session record.
            compression: of the chunks; ``auto`` chooses by their class.
            fd: descriptor, if the caller has created and claimed the file; it is closed with the part.

        Raises:
            OSError: it exists, or cannot be created or written.
        """
        self.path = path
        self.written: Counter[int] = Counter()
        self.lost: Counter[int] = Counter()
        self.bytes_written = 0
        self._written_out = 0  # of these, bytes already passed to the disk
        self._compression = compression
        self._specs: dict[int, ChannelSpec] = {}
        self._chunks: dict[ChunkClass, _OpenChunk] = {}
        self._summary = Summary()
        self._schemas = SchemaTable()
        self._fd = create_exclusively(path) if fd is None else fd
        claim(self._fd)
        try:
            self._write([MAGIC, record_bytes(records.Header(profile=PROFILE, library=LIBRARY))])
            self.add_metadata(SESSION_METADATA, session.to_metadata(part))
            os.fsync(self._fd)
            sync_directory(path.parent)
        except OSError:
            self.abandon()
            raise

    def stands_at(self, path: Path) -> bool:
        """Return whether a path still names this file."""
        return stands_at(self._fd, path)

    def is_unlinked(self) -> bool:
        """Return True if no directory entry names this file any more; data written to it is lost when the
        process ends.
        """
        return self._fd < 0 or os.fstat(self._fd).st_nlink == 0

    # ------------------------------------------------------------------ records outside chunks

    def add_channel(self, channel_id: int, spec: ChannelSpec) -> None:
        """Register a channel; its record is written into the first chunk that uses it and into every later one."""
        self._specs[channel_id] = spec

    def add_schema(self, schema: records.Schema) -> None:
        """Register a foreign schema for the channels that name it."""
        self._schemas.add(schema)

    def add_metadata(self, name: str, values: dict[str, str]) -> None:
        """Write a metadata record; raises `LogWriteError`."""
        record = record_bytes(records.Metadata(name=name, metadata=values))
        offset = self._write([record])
        self._summary.metadata.append(records.MetadataIndex(offset=offset, length=len(record), name=name))

    def add_attachment(self, name: str, media_type: str, data: bytes, log_time_ns: int) -> None:
        """Write an attachment; raises `LogWriteError`."""
        attachment = records.Attachment(
            create_time=log_time_ns, log_time=log_time_ns, name=name, media_type=media_type, data=data
        )
        record = record_bytes(attachment)
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
        """Add a block to the open chunk of its class; close the chunk when it is full, and any chunk whose span is
        exceeded.

        Raises:
            LogWriteError: the chunk could not be written; its messages are counted in ``lost``.
        """
        if not block.count:
            return
        first_log_ns = int(block.log_time_ns[0])
        spec = self._specs[block.channel_id]
        chunk = self._chunks.get(spec.chunk_class)
        if chunk is None:
            chunk = self._chunks[spec.chunk_class] = _OpenChunk(time.monotonic_ns(), first_log_ns)
        if block.channel_id not in chunk.blocks:
            self._introduce(chunk, block.channel_id, spec)
        chunk.blocks[block.channel_id].append((chunk.size, block))
        chunk.append(block.data)
        if chunk.size >= CHUNK_BYTES:
            self._close_chunk(spec.chunk_class)
        for late in [name for name, open_ in self._chunks.items() if first_log_ns - open_.first_log_ns > CHUNK_SPAN_NS]:
            self._close_chunk(late)

    def close_due(self, now_ns: int) -> None:
        """Close chunks that have been open for 250 ms (CLOCK_MONOTONIC); raises `LogWriteError`."""
        for chunk_class in CHUNK_CLASSES:
            chunk = self._chunks.get(chunk_class)
            if chunk is not None and now_ns - chunk.opened_ns >= CHUNK_OPEN_NS:
                self._close_chunk(chunk_class)

    def flush(self) -> None:
        """Close all chunks; raise `LogWriteError` only after having tried them all."""
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
        """Make all written data durable."""
        os.fdatasync(self._fd)

    def finish(self) -> None:
        """Write index and footer, make them durable and close the file, which is closed even on error.

        If the disk refuses the last chunks, the end may still fit: the file is then whole without those chunks.

        Raises:
            LogWriteError: the last chunks or the end could not be written.
        """
        try:
            try:
                self.flush()
            finally:
                self._write_end()
                os.fsync(self._fd)
        finally:
            self.close()

    def abandon(self) -> None:
        """Close and remove a file that holds no message yet, so that its name can be used again."""
        with contextlib.suppress(OSError):
            if self.stands_at(self.path):
                self.path.unlink()
        self.close()

    def close(self) -> None:
        """Close the file without writing an end; a second call does nothing."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1

    # ------------------------------------------------------------------ chunks

    def _introduce(self, chunk: _OpenChunk, channel_id: int, spec: ChannelSpec) -> None:
        """Add the record of a channel, and of its schema, before the channel's first message in a chunk."""
        chunk.blocks[channel_id] = []
        if spec.schema is not None and spec.schema not in chunk.schemas:
            chunk.schemas.add(spec.schema)
            chunk.append(record_bytes(self._schemas.record(spec.schema)))
        chunk.append(record_bytes(self._schemas.channel_record(channel_id, spec)))

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

    def _lay_out(self, chunk_class: ChunkClass, chunk: _OpenChunk) -> ChunkPieces:
        crc = 0
        for piece in chunk.pieces:
            crc = crc32(piece, crc)
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
            indexes.append(message_index(channel_id, blocks))
            position += len(indexes[-1])
        return ChunkPieces(
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
        """Write the end of the file in one piece, so that the file has its whole end or, if the disk refuses, no part
        of it.
        """
        data_end = record_bytes(records.DataEnd(data_section_crc=0))
        summary_start = self.bytes_written + len(data_end)
        sections = self._summary.sections(self._specs, self._schemas)
        body = b"".join(record for _, group in sections for record in group)
        offsets, position = b"", summary_start
        for opcode, group in sections:
            length = sum(map(len, group))
            if length:
                offset = records.SummaryOffset(group_opcode=opcode, group_start=position, group_length=length)
                offsets += record_bytes(offset)
            position += length
        footer_head = struct.pack("<BQQQ", _OP_FOOTER, 20, summary_start, summary_start + len(body))
        crc = crc32(body + offsets + footer_head)
        self._write([data_end, body, offsets, footer_head, struct.pack("<I", crc), MAGIC])

    def _write(self, pieces: Sequence[Any]) -> int:
        """Write all pieces at the end of the file; return the offset where they begin."""
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
        if self.bytes_written - self._written_out >= WRITE_OUT_BYTES:
            begin_writing_out(self._fd, self._written_out, self.bytes_written - self._written_out)
            self._written_out = self.bytes_written
        return start

    def _cut_back(self, size: int) -> None:
        """Truncate the file so that no partial record remains."""
        try:
            os.ftruncate(self._fd, size)
            os.lseek(self._fd, size, os.SEEK_SET)
        except OSError as error:
            # a further write would follow a partial record, so the file is closed
            self.close()
            raise LogWriteError(error.errno, error.strerror or "cannot truncate", str(self.path)) from error


def _after(views: list[memoryview], count: int) -> list[memoryview]:
    """Return the remaining views after ``count`` bytes of them were written."""
    for number, view in enumerate(views):
        if count < view.nbytes:
            return [view[count:], *views[number + 1 :]]
        count -= view.nbytes
    return []
