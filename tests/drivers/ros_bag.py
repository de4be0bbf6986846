"""Reads ROS 1 bags as far as the fixtures need it: chunks without compression, messages by the definitions in the bag.

Layouts: wiki.ros.org/Bags/Format/2.0 and wiki.ros.org/msg.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from typing import Any

MAGIC = b"#ROSBAG V2.0\n"
MESSAGE_DATA, CHUNK, CONNECTION = b"\x02", b"\x05", b"\x07"
PRIMITIVES = {
    "bool": "?", "byte": "b", "char": "B", "int8": "b", "uint8": "B", "int16": "h", "uint16": "H", "int32": "i",
    "uint32": "I", "int64": "q", "uint64": "Q", "float32": "f", "float64": "d", "time": "II", "duration": "ii",
}  # fmt: skip
FIELD = re.compile(r"^\s*([\w/]+)(\[(\d*)\])?\s+(\w+)\s*(?:#.*)?$")

Message = dict[str, Any]
Fields = list[tuple[str, str | None, str]]  # type, length of an array (empty: variable; None: no array), name


def read_bag(data: bytes) -> Iterator[tuple[str, Message]]:
    """Yield topic and fields of each message, in order."""
    assert data.startswith(MAGIC)
    connections: dict[bytes, tuple[str, dict[str, Fields]]] = {}
    for header, chunk in _records(data[len(MAGIC) :]):
        if header["op"] != CHUNK:
            continue
        assert header["compression"] == b"none"
        for inner, body in _records(chunk):
            if inner["op"] == CONNECTION:
                text = _header(body)["message_definition"].decode()
                connections[inner["conn"]] = (inner["topic"].decode(), _definitions(text))
            elif inner["op"] == MESSAGE_DATA:
                topic, types = connections[inner["conn"]]
                message, end = _decode(body, 0, "", types)
                assert end == len(body)
                yield topic, message


def _records(data: bytes) -> Iterator[tuple[dict[str, bytes], bytes]]:
    at = 0
    while at < len(data):
        header, at = _block(data, at)
        body, at = _block(data, at)
        yield _header(header), body


def _block(data: bytes, at: int) -> tuple[bytes, int]:
    end = at + 4 + int.from_bytes(data[at : at + 4], "little")
    return data[at + 4 : end], end


def _header(data: bytes) -> dict[str, bytes]:
    fields, at = {}, 0
    while at < len(data):
        field, at = _block(data, at)
        name, _, value = field.partition(b"=")
        fields[name.decode()] = value
    return fields


def _definitions(text: str) -> dict[str, Fields]:
    """Return the fields of each type by its name without package; the message's own have an empty name."""
    types: dict[str, Fields] = {}
    for section in re.split(r"^=+\s*$", text, flags=re.MULTILINE):
        head, _, rest = section.strip().partition("\n")
        name, lines = (head.split("/")[-1].strip(), rest) if head.startswith("MSG:") else ("", section)
        found = [match for line in lines.splitlines() if (match := FIELD.match(line))]
        types[name] = [(match[1].split("/")[-1], match[3] if match[2] else None, match[4]) for match in found]
    return types


def _decode(data: bytes, at: int, name: str, types: dict[str, Fields]) -> tuple[Message, int]:
    message: Message = {}
    for kind, length, field in types[name]:
        if length is None:
            message[field], at = _value(data, at, kind, types)
            continue
        if not length:
            count, at = int.from_bytes(data[at : at + 4], "little"), at + 4
        items = []
        for _ in range(int(length) if length else count):
            item, at = _value(data, at, kind, types)
            items.append(item)
        message[field] = items
    return message, at


def _value(data: bytes, at: int, kind: str, types: dict[str, Fields]) -> tuple[Any, int]:
    if kind == "string":
        return _block(data, at)
    if kind not in PRIMITIVES:
        return _decode(data, at, kind, types)
    layout = struct.Struct("<" + PRIMITIVES[kind])
    values = layout.unpack_from(data, at)
    return values[0] if len(values) == 1 else values, at + layout.size
