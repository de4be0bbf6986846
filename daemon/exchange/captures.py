"""Reads a file that `swath import` accepts: its kind, the devices in it and their units."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from datetime import UTC, tzinfo
from functools import partial
from pathlib import Path
from typing import Any

from swath.daemon.exchange.routes import STREAMS, Port, Routes
from swath.daemon.exchange.sidecar import complete, cut_by_sidecar, sidecar_of
from swath.daemon.log.wires import Senders, mixed_text
from swath.drivers.captures.base import (
    LATEST_NS,
    Address,
    CapturedUnit,
    CaptureTally,
    read_lines,
    until_damage,
)
from swath.drivers.captures.opening import (
    BareTime,
    FileClock,
    LvxHead,
    chunk_table,
    read_bag,
    read_bare,
    read_can_log,
    read_lvx,
    read_network,
    read_serial,
    read_table,
    read_tagged,
)
from swath.drivers.captures.pcap.writer import NOBODY
from swath.drivers.transports.base import SENDERS_SHOWN
from swath.drivers.transports.ntrip import CasterReply

CAN_LOGS = ("candump", "asc", "blf", "trc", "mf4")


@dataclass(frozen=True, slots=True)
class ImportUnit:
    """One unit on its way into a log; ``peer`` is a datagram's sender."""

    time_ns: int
    port: Port
    data: bytes
    peer: Address | None = None


@dataclass(slots=True)
class Capture:
    """A file to import, its kind, and counts of the units found in it.

    Attributes:
        kind: "pcap", "serial", "lvx", "bag", "table", "pps", or a log of a CAN bus: "candump", "asc", "blf", "trc",
            "mf4".
        port: the port whose units it holds; None if the units identify their ports themselves.
        selector: the only CAN interface, UDP or TCP port number, or head of an lvx file, whose units are used.
        time: timing of the bytes of a serial file without times.
        heads: of an lvx file, by code. head_ports: the ports of those that are used, by code. start_ns: of a file
            whose times are not UTC, the time at which it begins. zone: of its local times; None: as UTC, with a note.
        notes: remarks for the user, one line each.
        topics: of a bag, the topics that are read, with their ports.
        tells_time: the fixes of a table also name seconds, as there is no table of time messages.
        units: number used, by source.
        senders: of its datagrams, by source. connections: of its streams of TCP, by source.
        passed: number that belong to no device, by port, interface or topic.
    """

    path: Path
    kind: str
    port: Port | None = None
    selector: str | None = None
    time: BareTime | None = None
    keep_copies: bool = False
    heads: Mapping[str, LvxHead] = field(default_factory=dict)
    head_ports: Mapping[str, Port] = field(default_factory=dict)
    start_ns: int | None = None
    zone: tzinfo | None = None
    notes: list[str] = field(default_factory=list)
    topics: Mapping[str, Port] = field(default_factory=dict)
    tells_time: bool = True
    tally: CaptureTally = field(default_factory=CaptureTally)
    units: Counter[str] = field(default_factory=Counter)
    passed: Counter[str] = field(default_factory=Counter)
    senders: dict[str, Senders] = field(default_factory=dict)
    connections: dict[str, Senders] = field(default_factory=dict)
    _replies: dict[tuple[Address, Address], CasterReply] = field(default_factory=dict)

    def files(self) -> list[Path]:
        """Return the files of the disk that hold it."""
        return sorted(path for path in self.path.iterdir() if path.is_file()) if self.path.is_dir() else [self.path]

    def read(self, routes: Routes) -> Iterator[ImportUnit]:
        """Yield the units that belong to a device, in the file's order; damage of the file is noted in ``tally``."""
        for unit in until_damage(self._captured(routes), self.tally):
            if not 0 <= unit.time_ns <= LATEST_NS:
                self.tally.damaged(f"{self.path}: a unit of {len(unit.data)} bytes has no time between 1970 and 2262")
                continue
            port = self._port_of(unit, routes)
            if port is None:
                continue
            data, peer = unit.data, unit.source if unit.source != NOBODY else None
            if unit.channel == "tcp":
                data, peer = self._of_connection(unit, port), None
                if not data:
                    continue
            self.units[port.source] += 1
            if peer is not None:
                self.senders.setdefault(port.source, Senders()).add(peer[0], unit.time_ns, unit.time_ns, 1)
            yield ImportUnit(unit.time_ns, port, data, peer)

    def _of_connection(self, unit: CapturedUnit, port: Port) -> bytes:
        """Return the device's bytes of a segment; of a caster's, what follows the head of its reply."""
        assert unit.source is not None
        assert unit.destination is not None
        name = "{}:{} to {}:{}".format(*unit.source, *unit.destination)
        self.connections.setdefault(port.source, Senders()).add(name, unit.time_ns, unit.time_ns, 1)
        if port.kind != "ntrip":
            return unit.data
        reply = self._replies.setdefault((unit.source, unit.destination), CasterReply())
        data = reply.feed(unit.data)
        if reply.wrong:
            self.tally.damaged(f"{self.path}: {name}: {reply.wrong}")
        return data

    def _captured(self, routes: Routes) -> Iterator[CapturedUnit]:
        if self.kind == "pcap":
            wanted = partial(self._wants_stream, routes)
            units = read_network(self.path, wanted, self.tally, drop_copies=not self.keep_copies)
            return complete(units, self.path)
        if self.kind == "bag":
            return read_bag(self.path, list(self.topics), self.tally)
        if self.kind == "table":
            assert self.port is not None
            device = self.port.source.partition("/")[0]
            return read_table(self.path, device, tells_time=self.tells_time, tally=self.tally)
        if self.kind in CAN_LOGS:
            clock = FileClock(self.start_ns, self.zone or UTC)
            units = read_can_log(self.path, self.kind, clock, self.tally)
            return complete(units, self.path, within_ns=1000) if self.kind == "candump" else units
        if self.kind == "lvx":
            return read_lvx(self.path, self.start_ns, self.tally)
        if self.kind == "pps":
            assert self.port is not None
            return complete(_edges(self.path, self.port.edge, self.tally), self.path)
        if sidecar_of(self.path).exists():
            return cut_by_sidecar(self.path)
        if chunk_table(self.path) is not None:
            return read_serial(self.path, tally=self.tally)
        if tag_of(self.path).exists():
            return read_tagged(self.path, tag_of(self.path), self.tally)
        assert self.time is not None
        return read_bare(self.path, self.time, self.tally)

    def _port_of(self, unit: CapturedUnit, routes: Routes) -> Port | None:
        if self.kind == "bag":
            return self.topics.get(unit.channel)
        if self.kind == "pcap":
            return self._port_of_packet(unit, routes)
        if self.kind == "lvx":
            found = self.head_ports.get(unit.channel)
        elif self.port is not None:
            found = self.port if self.selector in (None, unit.channel) else None
        else:
            found = routes.of_frame(unit)
        if found is None:
            self.passed[unit.channel] += 1
        return found

    def _port_of_packet(self, unit: CapturedUnit, routes: Routes) -> Port | None:
        """Return the port of a datagram, of a segment of TCP or of a CAN frame of a network capture."""
        if unit.destination is None or unit.source is None:
            wire, name = "can", unit.channel
            found = routes.of_frame(unit) if self.port is None else self.port
        elif unit.channel == "udp":
            wire, name = "udp", str(unit.destination[1])
            found = routes.of_datagram(unit) if self.port is None else self.port
        else:
            wire, name = "tcp", str(unit.source[1])
            found = self._port_of_stream(routes, unit.source)
        if found is not None and self.port is not None and wire != "tcp":
            found = found if found.kind == wire and self.selector in (None, name) else None
        if found is None:
            service = (
                str(min(unit.source[1], unit.destination[1]))
                if wire == "tcp" and unit.source and unit.destination
                else name
            )
            self.passed[{"udp": f"port {name}", "tcp": f"TCP port {service}", "can": name or "a CAN bus"}[wire]] += 1
        return found

    def _port_of_stream(self, routes: Routes, source: Address) -> Port | None:
        """Return the port that a stream of TCP from an address belongs to."""
        if self.port is None:
            return routes.of_stream(source)
        number = self.selector or str(self.port.tcp_port)
        return self.port if self.port.kind in STREAMS and number == str(source[1]) else None

    def _wants_stream(self, routes: Routes, source: Address, destination: Address) -> bool:
        return self._port_of_stream(routes, source) is not None

    def warnings(self) -> list[str]:
        """Return the warnings about a file: its notes, and a line for each source to which several devices send."""
        several = [f"{self.path}: {note}" for note in self.notes] + [
            f"{self.path}: {source}: {mixed_text(senders.counts, recorded=False)}"
            for source, senders in sorted(self.senders.items())
            if senders.mixed and not source.startswith("raw/")
        ]
        return several + [
            f"{self.path}: {source}: {len(one.counts)} connections at the same time are read as one stream: "
            f"{', '.join(name for name, _ in one.counts.most_common(SENDERS_SHOWN))}; "
            "keep one of them with `tcpdump -r FILE -w ONE port NUMBER`"
            for source, one in sorted(self.connections.items())
            if one.mixed
        ]

    def plain(self) -> dict[str, Any]:
        """Return the counts as plain values for ``--json``."""
        return {
            "file": str(self.path),
            "kind": self.kind,
            "units": dict(self.units),
            "notes": self.notes,
            "of_no_device": dict(self.passed),
            "heads": [_plain_head(head) for head in self.heads.values()],
            "mixed_senders": {name: dict(one.counts) for name, one in self.senders.items() if one.mixed},
            "passed_over": {what: count for what, count in self.tally.passed.items() if count},
            "missing_bytes": self.tally.missing_bytes,
            "damage": self.tally.damage,
            "first_damage": self.tally.first_damage or None,
        }


def _plain_head(head: LvxHead) -> dict[str, Any]:
    angles, place = ("roll_deg", "pitch_deg", "yaw_deg"), ("x_m", "y_m", "z_m")
    claimed = dict(zip((*angles, *place), (*head.angles_deg, *head.place_m), strict=True))
    return {"code": head.code, "model": head.model, "protocol": head.protocol or None, "used": head.enabled} | claimed


def tag_of(path: Path) -> Path:
    """Return the path of RTKLIB's time tags of a stream; the stream may have been gzipped since."""
    return path.with_name(path.name.removesuffix(".gz") + ".tag")


def has_times(path: Path) -> bool:
    """Return whether a file beside a serial file gives the times of its bytes."""
    return sidecar_of(path).exists() or chunk_table(path) is not None or tag_of(path).exists()


def _edges(path: Path, edge: str, tally: CaptureTally) -> Iterator[CapturedUnit]:
    """Yield lines ``realtime_ns sequence`` as messages of ``/pps``."""
    for number, line in read_lines(path, tally):
        fields = line.split()
        if len(fields) != 2 or not all(text.isdecimal() and int(text) <= LATEST_NS for text in fields):
            tally.damaged(f"{path}: line {number} is not an edge; want realtime_ns sequence")
            continue
        time_ns, sequence = map(int, fields)
        value = {"edge_time_ns": time_ns, "sequence": sequence, "edge": edge}
        yield CapturedUnit(time_ns, json.dumps(value, separators=(",", ":")).encode(), "pps")
