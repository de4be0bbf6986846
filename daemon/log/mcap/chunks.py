"""Reads the messages inside a chunk, as runs of equal channel and length, and the channels that they belong to."""

from __future__ import annotations

import json
import struct
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from mcap import records

from swath.daemon.log.format import ChannelSpec, ChunkClass, LogError
from swath.daemon.log.mcap.scan import OP_CHANNEL, OP_MESSAGE, OP_SCHEMA, Damage, Record, parse_record
from swath.georef.arrays import Int64Array
from swath.georef.records import ByteRows

TopicFilter = Callable[[str], bool]
_MESSAGE_HEAD = 31
ONE_BY_ONE = 32  # messages at the start of a run that are compared one by one
_HEAD = struct.Struct("<BQ")

# Limits on the memory that a foreign log may take; logs of swath stay far below.
MAX_CHANNELS = 8192  # of a part
MAX_CHANNEL_BYTES = 8192
MAX_SCHEMAS = 256
MAX_SCHEMA_BYTES = 256 << 10
MAX_JSON_BYTES = 1 << 20  # of a message


@dataclass(frozen=True, slots=True)
class LogBatch:
    """Consecutive messages of one channel and equal length, as they are stored in a chunk.

    Attributes:
        log_time_ns: (n,) host time.
        rows: (n, 31 + length) uint8, the whole message records, a view into the chunk.
    """

    channel: ChannelSpec
    channel_id: int
    log_time_ns: Int64Array
    rows: ByteRows

    @property
    def units(self) -> ByteRows:
        """Data of the messages, (n, length) uint8, a view into the chunk."""
        return self.rows[:, _MESSAGE_HEAD:]

    def between(self, first: int, last: int) -> LogBatch:
        """Return the messages with indices ``first`` to ``last`` − 1."""
        return LogBatch(self.channel, self.channel_id, self.log_time_ns[first:last], self.rows[first:last])


def chunk_batches(
    data: bytes,
    channels: dict[int, ChannelSpec],
    schemas: dict[int, records.Schema],
    topics: TopicFilter | None = None,
    lost: Counter[str] | None = None,
) -> Iterator[LogBatch]:
    """Yield the messages of an unpacked chunk as runs of equal channel and length, and learn the chunk's channels.

    Args:
        data: the chunk's records.
        channels, schemas: known so far, by id; new ones are added.
        topics: selects the wanted topics; None selects all.
        lost: counts unusable messages by reason: their channel's record is lost, or their time is invalid; if None,
            such messages are an error.

    Raises:
        LogError: a record is malformed, or a channel differs from its earlier description.
    """
    at, size = 0, len(data)
    array = np.frombuffer(data, np.uint8)
    while at + _HEAD.size <= size:
        opcode, length = _HEAD.unpack_from(data, at)
        end = at + _HEAD.size + length
        if end > size:
            raise LogError("chunk with a record that extends beyond its end")
        if opcode == 0:
            raise LogError("chunk with a record of an unknown kind")
        if opcode == OP_MESSAGE and length >= _MESSAGE_HEAD - _HEAD.size:
            stride = end - at
            count = _run_length(data, at, stride)
            channel_id = int.from_bytes(data[at + 9 : at + 11], "little")
            spec = channels.get(channel_id)
            if spec is None:
                _lose(lost, f"messages of channel {channel_id}, whose record is lost", count)
            elif topics is None or topics(spec.topic):
                batch = _batch(spec, channel_id, array[at : at + count * stride].reshape(count, stride), lost)
                if len(batch.log_time_ns):
                    yield batch
            end = at + count * stride
        elif opcode == OP_CHANNEL:
            _take_channel(data[at + _HEAD.size : end], channels, schemas)
        elif opcode == OP_SCHEMA:
            _take_schema(data[at + _HEAD.size : end], schemas)
        at = end


def json_objects(batch: LogBatch) -> Iterator[tuple[int, dict[str, Any]]]:
    """Yield JSON objects with their log times; other JSON values and messages larger than 1 MiB are skipped."""
    if batch.units.shape[1] > MAX_JSON_BYTES:
        return
    for time_ns, row in zip(batch.log_time_ns.tolist(), batch.units, strict=True):
        try:
            value = json.loads(row.tobytes())
        except (ValueError, RecursionError):
            continue
        if isinstance(value, dict):
            yield time_ns, value


def damage_within(chunk: Record, lost: Counter[str]) -> Damage:
    """Describe the messages lost from an otherwise good chunk, with the reasons."""
    reasons = sorted(lost)
    more = f" and {len(reasons) - 3} more reasons" if len(reasons) > 3 else ""
    return Damage(chunk.offset, chunk.length, "; ".join(reasons[:3]) + more, lost.total())


def _lose(lost: Counter[str] | None, why: str, count: int) -> None:
    if lost is None:
        raise LogError(f"chunk with {why}")
    lost[why] += count


def _run_length(data: bytes, at: int, stride: int) -> int:
    """Return the number of messages from here on with the same opcode, length and channel: the same first
    eleven bytes.
    """
    possible, head = (len(data) - at) // stride, data[at : at + 11]
    # most runs in a chunk of several channels or lengths are short: compare one by one before all at once
    for count in range(1, min(possible, ONE_BY_ONE)):
        if not data.startswith(head, at + count * stride):
            return count
    heads = np.frombuffer(data, np.uint8, possible * stride, at).reshape(possible, stride)[:, :11]
    differs = np.flatnonzero((heads != heads[0]).any(axis=1))
    return int(differs[0]) if len(differs) else possible


def _batch(spec: ChannelSpec, channel_id: int, rows: ByteRows, lost: Counter[str] | None) -> LogBatch:
    times: Int64Array = rows[:, 15:23].copy().view("<i8")[:, 0]
    timeless = times < 0
    if timeless.any():  # beyond the year 2262, which signed 64-bit times cannot hold
        _lose(lost, "messages with an impossible time", int(timeless.sum()))
        times, rows = times[~timeless], rows[~timeless]
    return LogBatch(spec, channel_id, times, rows)


def take_description(record: Record, channels: dict[int, ChannelSpec], schemas: dict[int, records.Schema]) -> None:
    """Learn a channel or schema from a record outside chunks.

    Raises:
        LogError: it is malformed, or a channel differs from its earlier description.
    """
    if record.opcode == OP_CHANNEL:
        _take_channel(record.body, channels, schemas)
    else:
        _take_schema(record.body, schemas)


def _take_channel(body: bytes, channels: dict[int, ChannelSpec], schemas: dict[int, records.Schema]) -> None:
    if len(body) > MAX_CHANNEL_BYTES:
        raise LogError(f"channel record of {len(body)} bytes, more than {MAX_CHANNEL_BYTES}")
    channel = parse_record(records.Channel, body)
    chunk_class: ChunkClass = "scanner" if channel.topic.startswith("/scanner/") else "other"
    before = channels.get(channel.id)
    if before is None and len(channels) >= MAX_CHANNELS:
        raise LogError(f"more than {MAX_CHANNELS} channels")
    if before is not None and (before.topic, before.message_encoding) != (channel.topic, channel.message_encoding):
        raise LogError(f"channel {channel.id} is described as {channel.topic!r}, before as {before.topic!r}")
    schema = schemas.get(channel.schema_id)
    channels[channel.id] = ChannelSpec(
        channel.topic, channel.message_encoding, channel.metadata, schema.name if schema else None, chunk_class
    )


def _take_schema(body: bytes, schemas: dict[int, records.Schema]) -> None:
    if len(body) > MAX_SCHEMA_BYTES:
        raise LogError(f"schema record of {len(body)} bytes, more than {MAX_SCHEMA_BYTES}")
    schema = parse_record(records.Schema, body)
    if schema.id not in schemas and len(schemas) >= MAX_SCHEMAS:
        raise LogError(f"more than {MAX_SCHEMAS} schemas")
    schemas[schema.id] = schema
