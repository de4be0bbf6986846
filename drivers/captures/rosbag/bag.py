"""Reads ROS 2 bags (SQLite, MCAP) and ROS 1 bags by the library rosbags; no ROS is needed.

A bag's messages come in the order of the bag's time. A folder with ``metadata.yaml`` is one bag, of all files that it
names; a single file needs none.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any
from urllib.parse import quote

from rosbags.interfaces import Connection, MessageDefinitionFormat, Nodetype
from rosbags.rosbag1 import Reader as Ros1Reader
from rosbags.rosbag2 import Reader as Ros2Reader
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from swath.drivers.captures.base import CaptureDamageError, CapturedUnit, CaptureTally, report
from swath.drivers.captures.rosbag.decoded import Records
from swath.drivers.captures.rosbag.kinds import HEAD_BYTES, MCAP, ROS1, SQLITE, BoundedPath, bag_kind
from swath.drivers.captures.rosbag.messages import (
    DECODED_TYPES,
    SECOND,
    SENTENCE,
    SPLIT_TYPE,
    TOPIC_TYPES,
    BagTopic,
    RawType,
)
from swath.drivers.captures.rosbag.unfinished import Unfinished, UnfinishedMcap, UnfinishedRos1
from swath.drivers.captures.rosbag.unwrap import Decoded, Form, Packets, Unwrapper
from swath.drivers.transports.base import TransportError

_MAGICS = (SQLITE, ROS1, MCAP)
_SPANS_NS = (10**9, 60 * 10**9, 3600 * 10**9)  # tried one after the other to find a topic's last message


class Bag:
    """An open bag, to be used in a ``with`` statement.

    Attributes:
        kind: "ROS 1" or "ROS 2".
        finished: False for a bag without its index, whose recorder was stopped.
        topics: all topics, by name.
        offsets_ns: of each topic that was read and whose units have times of their own, the first unit's time less the
            bag's time of its message.

    Raises:
        TransportError: the file is not a bag that can be read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._magic = b"" if path.is_dir() else self._magic_of(path)
        self.kind = "ROS 1" if self._magic == ROS1 else "ROS 2"
        self._reader = self._opened()
        self._connections: list[Connection] = self._reader.connections
        self.finished = not isinstance(self._reader, Unfinished)
        self.topics = {topic.name: topic for topic in self._topics()}
        self.offsets_ns: dict[str, int] = {}

    def _magic_of(self, path: Path) -> bytes:
        try:
            with path.open("rb") as stream:
                head = stream.read(HEAD_BYTES)
        except OSError as error:
            raise TransportError(f"{path}: {error.strerror}") from error
        if not bag_kind(path, head):
            raise TransportError(f"{path}: is no bag, or one that is compressed as a whole; unpack it first")
        return next(magic for magic in _MAGICS if head.startswith(magic))

    def _opened(self) -> Any:
        """Return the library's reader, or the own one of a bag without its index."""
        plugins, path = Ros2Reader.STORAGE_PLUGINS, BoundedPath(self.path)
        others: dict[bytes, Any] = {ROS1: UnfinishedRos1, MCAP: UnfinishedMcap}
        try:
            if not self._magic:
                reader: Any = plugins["dir"](path)
            elif self._magic == ROS1:
                reader = Ros1Reader(path)
            elif self._magic == SQLITE:
                reader = plugins[".db3"](Path(quote(str(self.path))))  # it is opened by a URI
            else:
                reader = plugins[".mcap"](path)
            reader.open()
        except Exception as error:  # a damaged file makes the library raise anything
            if self._magic in others:
                reader = others[self._magic](path)
                with suppress(Exception):  # what the library said of it tells more
                    reader.open()
                    return reader
            mend = "; give the folder with its metadata.yaml" if self._magic == SQLITE else ""
            raise TransportError(f"{self.path}: cannot be read as a bag: {_words(error)}{mend}") from error
        return reader

    def _topics(self) -> Iterator[BagTopic]:
        counts: dict[tuple[str, str], int] = {}
        formats: dict[tuple[str, str], str] = {}
        for connection in self._connections:
            key = connection.topic, connection.msgtype
            counts[key] = counts.get(key, 0) + connection.msgcount
            formats[key] = getattr(connection.ext, "serialization_format", "cdr")
        for (name, kind), count in counts.items():
            raw = TOPIC_TYPES.get(kind)
            if raw is not None and formats[name, kind] == "cdr":
                yield BagTopic(name, kind, count, raw)
                if kind == SPLIT_TYPE:
                    yield BagTopic(name + SECOND, kind, count, raw)
            elif raw is not None:
                yield BagTopic(name, kind, count, None, f"its messages are {formats[name, kind]!r}; want cdr")
            elif kind in DECODED_TYPES:
                yield BagTopic(name, kind, count, None, f"{DECODED_TYPES[kind]}, decoded; not imported yet")
            else:
                yield BagTopic(name, kind, count, None, "holds no bytes of a device")

    def close(self) -> None:
        """Close the bag."""
        with suppress(Exception):
            self._reader.close()

    def __enter__(self) -> Bag:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def span_ns(self, name: str) -> tuple[int, int] | None:
        """Return the bag's times of the first and the last message of a topic; None if it has none, or is damaged."""
        connections = [one for one in self._connections if one.topic == name.removesuffix(SECOND)]
        first_ns = next(self._times(connections, 0), None)
        end_ns = self._end_ns()
        for span_ns in (*_SPANS_NS, end_ns):
            last_ns = max(self._times(connections, end_ns - span_ns), default=None)
            if first_ns is not None and last_ns is not None:
                return first_ns, last_ns
        return None

    def _times(self, connections: list[Connection], start_ns: int) -> Iterator[int]:
        """Yield the times of the messages of some connections from a time on, up to damage."""
        with suppress(Exception):
            for _, time_ns, _ in self._reader.messages(connections, start=start_ns):
                yield time_ns

    def _end_ns(self) -> int:
        found = getattr(self._reader, "metadata", self._reader)
        return int(found.end_time)

    def units(self, names: Sequence[str], tally: CaptureTally | None = None) -> Iterator[CapturedUnit]:
        """Yield the units of some topics, as `swath.drivers.captures.opening.read_bag` describes them."""
        connections = self._of(names)
        unwrappers = {connection.id: self._unwrapper(connection) for connection in connections}
        for connection, time_ns, data in self._messages(connections):
            topic = connection.topic
            try:
                units = unwrappers[connection.id].units(data)
            except ValueError as error:
                report(tally, f"{self.path}: a message of {topic} is not {connection.msgtype}: {error}")
                continue
            arrived = TOPIC_TYPES[connection.msgtype].carries == "records"  # which hold their own times
            for stamp_ns, content, second in units:
                if content is None:
                    report(tally, f"{self.path}: a message of {topic} has a packet longer than its place")
                    continue
                channel = topic + SECOND if second else topic
                if stamp_ns and channel not in self.offsets_ns:
                    self.offsets_ns[channel] = stamp_ns - time_ns
                yield CapturedUnit(time_ns if arrived else stamp_ns or time_ns, content, channel)

    def _of(self, names: Sequence[str]) -> list[Connection]:
        wanted = {name.removesuffix(SECOND) for name in names}
        return [one for one in self._connections if one.topic in wanted and one.msgtype in TOPIC_TYPES]

    def _messages(self, connections: list[Connection]) -> Iterator[tuple[Connection, int, bytes]]:
        if not connections:  # which would mean all of them to the library
            return
        try:
            yield from self._reader.messages(connections)
        except Exception as error:  # a damaged file makes the library raise anything
            raise CaptureDamageError(f"{self.path}: cannot be read further: {_words(error)}") from error

    def _unwrapper(self, connection: Connection) -> Unwrapper:
        raw = TOPIC_TYPES[connection.msgtype]
        return Unwrapper(list(_forms(connection, raw, self.kind == "ROS 2")))


def _words(error: Exception) -> str:
    return " ".join(str(error).split())[:200] or type(error).__name__


def _forms(connection: Connection, raw: RawType, ros2: bool) -> Iterator[Form]:
    """Yield the ways to read a topic's messages: by the bag's own definition if it has one, then by the known ones."""
    definition = connection.msgdef
    texts = list(raw.definitions)
    own = definition.format != MessageDefinitionFormat.NONE and raw.name != SENTENCE
    if own:
        texts.insert(0, definition.data)
    if not texts:  # of ROS's own packages, which the library knows
        texts.append("")
    for number, text in enumerate(texts):
        idl = own and number == 0 and definition.format == MessageDefinitionFormat.IDL
        with suppress(Exception):  # a damaged definition makes the library raise anything; it is then no way
            parsed = get_types_from_idl if idl else partial(get_types_from_msg, name=connection.msgtype)
            types = parsed(text) if text else {}
            store = get_typestore(Stores.ROS2_HUMBLE if ros2 else Stores.ROS1_NOETIC)
            store.register({name: fields for name, fields in types.items() if name not in store.fielddefs})
            if raw.carries == "records":
                yield Records(raw, _decoder(raw, store, ros2), ros2=ros2)
            else:
                yield _packets(raw, store, ros2) or Decoded(raw, _decoder(raw, store, ros2))


def _decoder(raw: RawType, store: Typestore, ros2: bool) -> Callable[[bytes], Any]:
    """Return a function that decodes messages by the library."""
    decode = store.deserialize_cdr if ros2 else store.deserialize_ros1

    def decoded(data: bytes) -> Any:
        try:
            return decode(data, raw.name)
        except Exception as error:  # damaged data, or a damaged definition, make the library raise anything
            raise ValueError(_words(error)) from error

    return decoded


def _packets(raw: RawType, store: Typestore, ros2: bool) -> Packets | None:
    """Return the reader of a message that consists of a header and packets of bytes, or None if it does not."""

    fields: list[tuple[str, Any]] = list(store.fielddefs[raw.name][1])
    header = fields[0] == ("header", (Nodetype.NAME, "std_msgs/msg/Header"))
    if len(fields) != 1 + header or fields[-1][0] != "packets" or fields[-1][1][0] != Nodetype.SEQUENCE:
        return None
    kind, name = fields[-1][1][1][0]
    if kind != Nodetype.NAME:
        return None
    stamp, data, *rest = store.fielddefs[name][1]
    byte: Any = (Nodetype.BASE, ("uint8", 0))
    sized = [*rest] == [("size", (Nodetype.BASE, ("uint32", 0)))]
    described: Any = data[1]
    if stamp != ("stamp", (Nodetype.NAME, "builtin_interfaces/msg/Time")) or (rest and not sized):
        return None
    if data[0] != "data" or described[0] not in (Nodetype.ARRAY, Nodetype.SEQUENCE) or described[1][0] != byte:
        return None
    return Packets(ros2, header, described[1][1] if described[0] == Nodetype.ARRAY else None, sized)
