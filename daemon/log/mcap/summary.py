"""Collects and writes the end of a part: channels, statistics, and the index of chunks, attachments and metadata."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from mcap import records
from mcap.data_stream import RecordBuilder

from swath.daemon.log.format import SCHEMA_IDS, SCHEMAS, ChannelSpec


@dataclass(slots=True)
class ChunkPieces:
    """The bytes of a chunk as they go to disk, and the values for its index entry."""

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
class Summary:
    """Collects the entries for the end of the file."""

    chunks: list[records.ChunkIndex] = field(default_factory=list)
    attachments: list[records.AttachmentIndex] = field(default_factory=list)
    metadata: list[records.MetadataIndex] = field(default_factory=list)
    messages: Counter[int] = field(default_factory=Counter)
    start: int | None = None
    end: int = 0

    def add_chunk(self, offset: int, pieces: ChunkPieces, counts: Counter[int]) -> None:
        """Add a chunk that has been written at ``offset``."""
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

    def sections(self, specs: Mapping[int, ChannelSpec], schemas: SchemaTable) -> list[tuple[int, list[bytes]]]:
        """Return the groups of the summary, each as opcode and records; channels without messages are left out."""
        used = {id_: specs[id_] for id_ in self.messages}
        names = sorted({spec.schema for spec in used.values() if spec.schema is not None})
        statistics = records.Statistics(
            attachment_count=len(self.attachments),
            channel_count=len(used),
            channel_message_counts=dict(self.messages),
            chunk_count=len(self.chunks),
            message_count=self.messages.total(),
            message_end_time=self.end,
            message_start_time=self.start or 0,
            metadata_count=len(self.metadata),
            schema_count=len(names),
        )
        return [
            (3, [record_bytes(schemas.record(name)) for name in names]),
            (4, [record_bytes(schemas.channel_record(id_, spec)) for id_, spec in used.items()]),
            (0x0B, [record_bytes(statistics)]),
            (0x08, [record_bytes(index) for index in self.chunks]),
            (0x0A, [record_bytes(index) for index in self.attachments]),
            (0x0D, [record_bytes(index) for index in self.metadata]),
        ]


def record_bytes(record: records.McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    data: bytes = builder.end()
    return data


class SchemaTable:
    """The schemas of a part by name: swath's own, and foreign ones that are copied with their messages."""

    def __init__(self) -> None:
        self._records = {
            name: records.Schema(data=data, encoding="jsonschema", id=SCHEMA_IDS[name], name=name)
            for name, data in SCHEMAS.items()
        }

    def add(self, schema: records.Schema) -> None:
        """Add a foreign schema under an id of this part; a schema whose name is known already is ignored."""
        if schema.name not in self._records:
            number = len(self._records) + 1
            self._records[schema.name] = records.Schema(
                data=schema.data, encoding=schema.encoding, id=number, name=schema.name
            )

    def record(self, name: str) -> records.Schema:
        """Return the schema record of this name."""
        return self._records[name]

    def channel_record(self, channel_id: int, spec: ChannelSpec) -> records.Channel:
        """Return the record of a channel, with its schema's id."""
        return records.Channel(
            id=channel_id,
            topic=spec.topic,
            message_encoding=spec.message_encoding,
            metadata=spec.metadata,
            schema_id=0 if spec.schema is None else self._records[spec.schema].id,
        )
