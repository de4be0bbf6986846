"""Reads bags whose recorder was stopped before it wrote the index: MCAP and ROS 1, record by record up to the damage.

Messages come in the order of the file. Layouts: https://mcap.dev/spec, http://wiki.ros.org/Bags/Format/2.0.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Collection, Iterator
from io import BytesIO
from pathlib import Path
from typing import Any

from mcap.records import Channel, Message, Schema
from mcap.stream_reader import StreamReader
from rosbags.interfaces import Connection, ConnectionExtRosbag2, MessageDefinition, MessageDefinitionFormat
from rosbags.rosbag1 import Reader as Ros1Reader
from rosbags.rosbag1.reader import Header, RecordType, decompressors, read_bytes, read_uint32

_FORMATS = {"ros2msg": MessageDefinitionFormat.MSG, "ros2idl": MessageDefinitionFormat.IDL}
_Found = tuple[int, int, bytes]  # connection, time, message


class Unfinished(ABC):
    """A bag without its index, with the methods of the library's readers.

    Attributes:
        connections: found by reading the whole file once.
        end_time: a nanosecond after the last message.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.connections: list[Connection] = []
        self.end_time = 0
        self._by_id: dict[int, Connection] = {}

    def open(self) -> None:
        """Read the file to its end or damage, for its connections; raises anything if it has none."""
        counts: Counter[int] = Counter()
        damage: Exception | None = None
        try:
            for number, time_ns, _ in self._read():
                counts[number] += 1
                self.end_time = max(self.end_time, time_ns + 1)
        except Exception as error:  # `messages` raises it again, where it is counted
            damage = error
        if not self._by_id:
            raise damage or ValueError("it holds no messages")
        self.connections = [one._replace(msgcount=counts[one.id]) for one in self._by_id.values()]

    def messages(self, connections: Collection[Connection], start: int = 0) -> Iterator[tuple[Connection, int, bytes]]:
        """Yield the messages of some connections from a time on; raises anything where the file is damaged."""
        wanted = {one.id: one for one in connections}
        for number, time_ns, data in self._read():
            if number in wanted and time_ns >= start:
                yield wanted[number], time_ns, data
        raise ValueError("its recorder was stopped before it wrote the end")

    def close(self) -> None:
        """Forget the connections; each reading opens and closes the file itself."""
        self.connections = []

    @abstractmethod
    def _read(self) -> Iterator[_Found]:
        """Yield messages and note their connections."""


class UnfinishedMcap(Unfinished):
    """An MCAP file without its summary."""

    def _read(self) -> Iterator[_Found]:
        schemas: dict[int, Schema] = {}
        with self.path.open("rb") as stream:
            for record in StreamReader(stream, validate_crcs=True).records:
                if isinstance(record, Schema):
                    schemas[record.id] = record
                elif isinstance(record, Channel) and record.id not in self._by_id:
                    self._by_id[record.id] = self._connection(record, schemas.get(record.schema_id))
                elif isinstance(record, Message):
                    yield record.channel_id, record.log_time, record.data

    def _connection(self, channel: Any, schema: Any) -> Connection:
        known = _FORMATS.get(schema.encoding) if schema is not None else None
        text = schema.data.decode() if known is not None else ""
        definition = MessageDefinition(known or MessageDefinitionFormat.NONE, text)
        kind = schema.name if schema is not None else ""
        extra = ConnectionExtRosbag2(channel.message_encoding, [])
        return Connection(channel.id, channel.topic, kind, definition, "", 0, extra, self)


class UnfinishedRos1(Unfinished):
    """A bag of ROS 1 without its index, such as ``.bag.active``."""

    def _read(self) -> Iterator[_Found]:
        with self.path.open("rb") as stream:
            stream.readline()
            while stream.peek(1):
                header = Header.read(stream)
                data = read_bytes(stream, read_uint32(stream))
                if header.get_uint8("op") == RecordType.CHUNK:
                    yield from self._chunk(decompressors[header.get_string("compression")](data))

    def _chunk(self, content: bytes) -> Iterator[_Found]:
        chunk = BytesIO(content)
        while chunk.tell() < len(content):
            begin = chunk.tell()
            header = Header.read(chunk)
            data = read_bytes(chunk, read_uint32(chunk))
            number = header.get_uint32("conn")
            if header.get_uint8("op") == RecordType.MSGDATA:
                yield number, header.get_time("time"), data
            elif number not in self._by_id:
                reader = Ros1Reader(self.path)
                reader.bio = BytesIO(content[begin : chunk.tell()])
                self._by_id[number] = reader.read_connection()
