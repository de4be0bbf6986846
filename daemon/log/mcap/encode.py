"""Encodes messages in bulk with NumPy, in the form in which a chunk stores them.

MCAP specification, version 0: a message record is opcode 5, length u64, channel u16, sequence u32, log time u64,
publish time u64, data.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from swath.georef.arrays import Int64Array
from swath.georef.records import ByteRows

MESSAGE_HEADER_BYTES = 31
_OP_MESSAGE, _OP_MESSAGE_INDEX = 5, 7
_MESSAGE = struct.Struct("<BQHIQQ")
_FIRST = np.zeros(1, np.int64)


@dataclass(frozen=True, slots=True)
class EncodedBlock:
    """Message records of one channel, ready to be put into a chunk.

    Attributes:
        count: number of messages, n.
        log_time_ns: (n,) int64.
        offsets: (n,) int64, of each record within ``data``.
        data: the records.
    """

    channel_id: int
    count: int
    log_time_ns: Int64Array
    offsets: Int64Array
    data: memoryview


@lru_cache(maxsize=1024)
def _layout(length: int) -> np.dtype[np.void]:
    """Return the dtype of a message record with ``length`` bytes of data."""
    return np.dtype(
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


def encode_block(
    channel_id: int,
    first_sequence: int,
    log_time_ns: Int64Array,
    units: ByteRows,
    publish_time_ns: Int64Array | None = None,
    rows: ByteRows | None = None,
) -> EncodedBlock:
    """Encode messages of equal length, one for each unit.

    Args:
        channel_id: channel of all messages.
        first_sequence: sequence number of the first message; u32, wraps.
        log_time_ns: (n,).
        units: (n, length) uint8.
        publish_time_ns: (n,); None uses the log time.
        rows: (n, 31 + length) contiguous memory that already holds the units, each behind room for its header; the
            headers are written there.
    """
    count, length = units.shape
    if count == 1:  # typical of a serial port: NumPy's overhead would be several times the cost of the message
        log_time = int(log_time_ns[0])
        publish_time = log_time if publish_time_ns is None else int(publish_time_ns[0])
        sequence = first_sequence & 0xFFFFFFFF
        content = MESSAGE_HEADER_BYTES - 9 + length
        head = _MESSAGE.pack(_OP_MESSAGE, content, channel_id, sequence, log_time, publish_time)
        return EncodedBlock(channel_id, 1, log_time_ns, _FIRST, memoryview(head + units.tobytes()))
    layout = _layout(length)
    records = np.empty(count, layout) if rows is None else rows.view(layout)[:, 0]
    records["opcode"] = _OP_MESSAGE
    records["length"] = MESSAGE_HEADER_BYTES - 9 + length
    records["channel"] = channel_id
    records["sequence"] = (first_sequence + np.arange(count, dtype=np.uint64)) & 0xFFFFFFFF
    records["log_time"] = log_time_ns
    records["publish_time"] = log_time_ns if publish_time_ns is None else publish_time_ns
    if rows is None:
        records["data"] = units
    offsets = np.arange(count, dtype=np.int64) * layout.itemsize
    return EncodedBlock(channel_id, count, log_time_ns, offsets, records.view(np.uint8).data)


def encode_raw(channel_id: int, log_time_ns: Int64Array, rows: ByteRows) -> EncodedBlock:
    """Wrap whole message records of a log, (n, 31 + length) uint8, so that they can be written again unchanged."""
    count, stride = rows.shape
    offsets = np.arange(count, dtype=np.int64) * stride
    return EncodedBlock(channel_id, count, log_time_ns, offsets, np.ascontiguousarray(rows).reshape(-1).data)


def encode_json(channel_id: int, sequence: int, log_time_ns: int, value: Mapping[str, Any]) -> EncodedBlock:
    """Encode one JSON message."""
    text = json.dumps(value, separators=(",", ":"), allow_nan=False).encode()
    unit = np.frombuffer(text, np.uint8).reshape(1, -1)
    return encode_block(channel_id, sequence, np.array([log_time_ns], dtype=np.int64), unit)


def message_index(channel_id: int, blocks: list[tuple[int, EncodedBlock]]) -> bytes:
    """Return the message index record of one channel in a chunk: (log time, offset) pairs."""
    count = sum(block.count for _, block in blocks)
    pairs = np.empty(count, np.dtype([("time", "<u8"), ("offset", "<u8")]))
    at = 0
    for start, block in blocks:
        pairs["time"][at : at + block.count] = block.log_time_ns
        pairs["offset"][at : at + block.count] = block.offsets + start
        at += block.count
    body = pairs.tobytes()
    return struct.pack("<BQHI", _OP_MESSAGE_INDEX, 6 + len(body), channel_id, len(body)) + body
