"""Writes the files of an export, one class for each format; each class takes the batches of its source in log order."""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from collections import deque
from pathlib import Path
from typing import ClassVar

import numpy as np

from swath.daemon.exchange.sidecar import SidecarWriter
from swath.daemon.log.format import ChannelSpec
from swath.daemon.log.mcap.chunks import LogBatch
from swath.daemon.log.reader import LOOK_AHEAD_BYTES, LOOK_AHEAD_NS
from swath.drivers.captures.base import LATEST_NS, Address
from swath.drivers.captures.can.candump import candump_line, held_by_line
from swath.drivers.captures.pcap.writer import (
    FILE_HEADER,
    LATEST_PCAP_NS,
    NOBODY,
    is_address,
    largest_payload,
    pcap_frames,
)
from swath.drivers.captures.serial import TagWriter
from swath.drivers.transports.spec import TransportSpec, parse_transport
from swath.georef.arrays import Int64Array

# .ubx, .gps, .sbf: the names by which RTKLIB's convbin knows a format (app/convbin/convbin.c)
_SERIAL_SUFFIX = {"ubx": ".ubx", "novatel": ".gps", "sbf": ".sbf", "nmea": ".nmea"}

_EVER_NS = (1 << 63) - 1  # later than any stamp


class NativeFile(ABC):
    """A file that is being written, with its sidecar.

    Attributes:
        units: number of units so far, including those that only the sidecar holds.
    """

    kind: ClassVar[str]
    suffix: ClassVar[str]

    def __init__(self, path: Path) -> None:
        self.path = path
        self.units = 0
        self._stream = path.open("xb")
        self._sidecar = SidecarWriter(path)

    @classmethod
    def suffix_for(cls, channel: ChannelSpec) -> str:
        """Return the suffix of the file's name."""
        return cls.suffix

    @abstractmethod
    def add(self, source: str, batch: LogBatch) -> None:
        """Write the units of the next batch."""

    def notes(self) -> list[str]:
        """Return remarks for the reader of the file."""
        return []

    def close(self) -> None:
        """Finish the file and its sidecar."""
        self._stream.close()
        self._sidecar.close()


def _spec(channel: ChannelSpec) -> TransportSpec | None:
    """Return the transport of a channel; None if a foreign log does not give it."""
    try:
        return parse_transport(channel.metadata.get("transport", ""))
    except ValueError:
        return None


class SerialFile(NativeFile):
    """Writes all bytes of a source in sequence, with RTKLIB's time tags beside; the sidecar has bounds and times of
    reads.
    """

    kind = "serial"
    suffix = ".raw"

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._tags: TagWriter | None = None
        self._tag_stream = path.with_name(path.name + ".tag").open("xb")
        self._bytes = 0

    @classmethod
    def suffix_for(cls, channel: ChannelSpec) -> str:
        """Return the suffix for the channel's protocol."""
        return _SERIAL_SUFFIX.get(channel.metadata.get("protocol", ""), cls.suffix)

    def add(self, source: str, batch: LogBatch) -> None:
        """Write the units of the next batch."""
        count, length = batch.units.shape
        self._stream.write(batch.units.tobytes())
        if self._tags is None:
            self._tags = TagWriter(self._tag_stream, int(batch.log_time_ns[0]))
        self._tags.add(batch.log_time_ns, self._bytes + length * np.arange(1, count + 1, dtype=np.int64))
        for number, time_ns in enumerate(batch.log_time_ns.tolist(), start=self.units):
            self._sidecar.add(number, time_ns, length)
        self._bytes += count * length
        self.units += count

    def close(self) -> None:
        """Finish the file, its sidecar and its time tags."""
        super().close()
        self._tag_stream.close()


class CandumpFile(NativeFile):
    """Writes ``candump -L`` text, to the microsecond; the sidecar has nanoseconds, and bytes that a line
    cannot show.
    """

    kind = "candump"
    suffix = ".log"

    def add(self, source: str, batch: LogBatch) -> None:
        """Write the units of the next batch."""
        spec = _spec(batch.channel)
        interface = "".join(spec.channel.split()) if spec is not None and spec.kind == "can" else ""
        lines = []
        for time_ns, row in zip(batch.log_time_ns.tolist(), batch.units, strict=True):
            frame = row.tobytes()
            line = candump_line(max(0, time_ns), interface or "can0", frame)
            held = line is not None and held_by_line(frame)
            if line is not None:
                lines.append(line)
            if not held or time_ns % 1000:
                native, data = line is not None, None if held else frame
                self._sidecar.add(self.units, time_ns, len(frame), native=native, data=data)
            self.units += 1
        self._stream.write("".join(lines).encode())


class PcapFile(NativeFile):
    """Writes datagrams with stamps in nanoseconds; Ethernet, IP and UDP headers are made anew.

    The two ports of a head are merged by their stamps; each keeps its own order, even where its stamps step back. One
    second of datagrams is held for the merge, because a log has blocks of one port after blocks of the other.
    """

    kind = "pcap"
    suffix = ".pcap"

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._stream.write(FILE_HEADER)
        self._unnamed = 0
        self._held: dict[str, deque[LogBatch]] = {}
        self._held_bytes = 0

    def add(self, source: str, batch: LogBatch) -> None:
        """Add the units of the next batch and write those that are due."""
        copy = LogBatch(batch.channel, batch.channel_id, batch.log_time_ns.copy(), batch.rows.copy())
        self._held.setdefault(source, deque()).append(copy)
        self._held_bytes += copy.rows.size
        until_ns = int(copy.log_time_ns.max()) - LOOK_AHEAD_NS
        self._write_held(until_ns if self._held_bytes <= LOOK_AHEAD_BYTES else _EVER_NS)

    def close(self) -> None:
        """Write the units that are still held; finish the file and its sidecar."""
        self._write_held(_EVER_NS)
        super().close()

    def _write_held(self, until_ns: int) -> None:
        """Write the held units up to a time, always from the port whose next stamp is earliest."""
        while waiting := [(int(batches[0].log_time_ns[0]), source) for source, batches in self._held.items()]:
            first_ns, source = min(waiting)
            if first_ns > until_ns:
                return
            batches = self._held[source]
            batch = batches.popleft()
            limit_ns = min([until_ns, *(time_ns for time_ns, other in waiting if other != source)])
            later = np.flatnonzero(batch.log_time_ns > limit_ns)
            count = int(later[0]) if later.size else len(batch.log_time_ns)
            if count < len(batch.log_time_ns):
                batches.appendleft(batch.between(count, len(batch.log_time_ns)))
            elif not batches:
                del self._held[source]
            self._held_bytes -= count * batch.rows.shape[1]
            self._write(batch.between(0, count))

    def _write(self, batch: LogBatch) -> None:
        sender, receiver = self._addresses(batch.channel)
        if sender == NOBODY:
            self._unnamed += len(batch.units)
        largest = largest_payload(sender, receiver)
        times: Int64Array = np.clip(batch.log_time_ns, 0, LATEST_PCAP_NS)
        too_long = batch.units.shape[1] > largest
        for number in np.flatnonzero(times != batch.log_time_ns).tolist() if not too_long else range(len(times)):
            time_ns = min(max(0, int(batch.log_time_ns[number])), LATEST_NS)
            data = batch.units[number].tobytes()
            self._sidecar.add(self.units + number, time_ns, len(data), data=data if too_long else None)
        payloads = batch.units[:, :largest]
        self._stream.write(pcap_frames(times, self.units, sender, receiver, payloads).tobytes())
        self.units += len(times)

    def notes(self) -> list[str]:
        """Return a remark if senders of datagrams are unknown."""
        return [f"{self._unnamed} datagrams of senders that the log does not name"] if self._unnamed else []

    def _addresses(self, channel: ChannelSpec) -> tuple[Address, Address]:
        """Return sender and receiver; the receiver is the address that the recorder's port was bound to."""
        metadata, spec = channel.metadata, _spec(channel)
        host, port = "0.0.0.0", _port(metadata.get("port", ""))
        if spec is not None and spec.kind == "udp":
            host, port = spec.options.get("group", spec.host), port or spec.port
        sender = metadata.get("source_address", "")
        return (sender, _port(metadata.get("source_port", ""))) if is_address(sender) else NOBODY, (host, port)


def _port(text: str) -> int:
    return int(text) if text.isdecimal() and int(text) <= 65_535 else 0


class PpsFile(NativeFile):
    """Writes a line ``edge_time_ns sequence`` for each edge, as ``fixed:`` sources read; the sidecar has
    the messages.
    """

    kind = "pps"
    suffix = ".txt"

    def add(self, source: str, batch: LogBatch) -> None:
        """Write the edges of the next batch."""
        for time_ns, row in zip(batch.log_time_ns.tolist(), batch.units, strict=True):
            line = _pps_line(row.tobytes())
            if line is not None:
                self._stream.write(line)
            self._sidecar.add(self.units, time_ns, len(row), native=line is not None, data=row.tobytes())
            self.units += 1


def _pps_line(message: bytes) -> bytes | None:
    """Return the line of a message; None if a foreign log's message is not an edge."""
    try:
        value = json.loads(message)
        edge_time_ns, sequence = value["edge_time_ns"], value["sequence"]
    except (ValueError, KeyError, TypeError, RecursionError):
        return None
    if not all(type(number) is int and 0 <= number <= LATEST_NS for number in (edge_time_ns, sequence)):
        return None
    return f"{edge_time_ns} {sequence}\n".encode()
