"""Finds the device of a configuration that the units of a capture belong to."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from ipaddress import ip_address

from swath.daemon.config import Config
from swath.daemon.log.format import ChannelSpec
from swath.daemon.log.wires import Wire, make_wire
from swath.drivers.captures.base import Address, CapturedUnit
from swath.drivers.captures.opening import LvxHead
from swath.drivers.transports.spec import TransportSpec

STREAMS = ("serial", "tcp", "ntrip")  # kinds of ports whose units are bytes in sequence


@dataclass(frozen=True, slots=True)
class Port:
    """A wire of the configuration: a device's port, or a PPS source.

    Attributes:
        source: ``kind/name``, with ``/aux`` for a second port.
        kind: "serial", "tcp", "ntrip", "can", "udp" or "pps".
        spec: its transport; None for PPS.
        channel: its channel in the log, without a sender.
        edge: of a PPS source, the edge that marks the second.
        serial: of a scanner, the serial number that the configuration gives.
    """

    source: str
    kind: str
    spec: TransportSpec | None
    channel: ChannelSpec
    edge: str = ""
    serial: str = ""

    @property
    def protocol(self) -> str:
        """The protocol of its device; empty for PPS."""
        return self.channel.metadata.get("protocol", "")

    @property
    def is_aux(self) -> bool:
        """True for a head's second port."""
        return self.source.endswith("/aux")

    @property
    def tcp_port(self) -> int:
        """The number of the port at which its device or caster serves; 0 where it comes otherwise."""
        if self.spec is None or self.kind not in ("tcp", "ntrip"):
            return 0
        return self.spec.port if self.kind == "tcp" else self.spec.ntrip_port

    @property
    def options(self) -> dict[str, str]:
        """Options of the transport."""
        return self.spec.options if self.spec is not None else {}


def _port(wire: Wire, spec: TransportSpec, serial: str) -> Port:
    channel = ChannelSpec(wire.topic, wire.encoding, wire.metadata, None, wire.chunk_class)
    return Port(wire.source, spec.kind, spec, channel, serial=serial)


def _ports(config: Config) -> Iterator[Port]:
    for name, pps in config.pps.items():
        channel = ChannelSpec(f"/pps/{name}", "json", {}, "swath.Pps", "other")
        yield Port(f"pps/{name}", "pps", None, channel, pps.edge)
    for device in config.devices():
        for spec, suffix in ((device.transport, ""), (device.auxiliary, "/aux")):
            if spec is not None and spec.carrier is None:
                serial = str(device.settings.config.get("serial", ""))
                yield _port(make_wire(device, spec, suffix), spec, serial)


@dataclass(slots=True)
class Routes:
    """The ports of a configuration, found by the address or interface that a capture gives for a unit."""

    ports: dict[str, Port]
    _udp: dict[int, list[Port]] = field(default_factory=dict)
    _can: dict[str, Port | None] = field(default_factory=dict)  # None: two buses share the name
    _tcp: dict[int, list[Port]] = field(default_factory=dict)

    @classmethod
    def of(cls, config: Config) -> Routes:
        """Make the routes of a configuration."""
        routes = cls({port.source: port for port in _ports(config)})
        for port in routes.ports.values():
            if port.spec is not None and port.kind == "udp":
                routes._udp.setdefault(port.spec.port, []).append(port)
            elif port.spec is not None and port.kind == "can":
                routes._can[port.spec.channel] = None if port.spec.channel in routes._can else port
            elif port.tcp_port:
                routes._tcp.setdefault(port.tcp_port, []).append(port)
        return routes

    def of_datagram(self, unit: CapturedUnit) -> Port | None:
        """Return the port that a datagram was sent to; its sender must be the configured one, if the configuration
        names one.

        If several sources on one port number are bound to different addresses or groups, the receiver's address
        decides.
        """
        assert unit.source is not None
        assert unit.destination is not None
        found = self._udp.get(unit.destination[1])
        if found is None or (len(found) == 1 and "source" not in found[0].options):
            return found[0] if found else None
        found = [port for port in found if port.options.get("source", unit.source[0]) == unit.source[0]]
        if len(found) > 1:
            found = [port for port in found if _bound_to(port) == unit.destination[0]]
        return found[0] if found else None

    def of_stream(self, source: Address) -> Port | None:
        """Return the port of the bytes that a device or caster sent by TCP from an address.

        Its port number must be the configured one, and so must its host where the configuration gives an address; a
        name is not looked up.
        """
        found = [port for port in self._tcp.get(source[1], ()) if _serves(port, source[0])]
        named = [port for port in found if _is_address(_host(port))]
        return named[0] if named else found[0] if len(found) == 1 else None

    def of_frame(self, unit: CapturedUnit) -> Port | None:
        """Return the port of a CAN frame by its interface; without a name of the interface, or with the number that a
        logger gives its channel, the only bus.
        """
        if unit.channel in self._can:
            return self._can[unit.channel]
        is_unnamed = not unit.channel or unit.channel.isdecimal()
        return next(iter(self._can.values())) if is_unnamed and len(self._can) == 1 else None

    def buses(self) -> list[str]:
        """Return the sources that are CAN buses."""
        return [port.source for port in self.ports.values() if port.kind == "can"]

    def bus_names(self) -> list[str]:
        """Return the names of the interfaces of the CAN buses."""
        return list(self._can)

    def of_heads(self, heads: Iterable[LvxHead]) -> dict[str, Port]:
        """Return the scanners, by code, that are the heads of a file: each is the one with the head's serial number, or
        the only one of its protocol where the file has only one head of it.
        """
        scanners, found, others = self._scanners(), dict[str, Port](), list[LvxHead]()
        for head in heads:
            named = [port for port in scanners if port.serial and head.code.upper().startswith(port.serial.upper())]
            if len(named) == 1:
                found[head.code] = named[0]
            elif not named:
                others.append(head)
        for head in others:
            free = [port for port in scanners if not port.serial and port.protocol == head.protocol]
            if len(free) == 1 and sum(other.protocol == head.protocol for other in others) == 1:
                found[head.code] = free[0]
        return found

    def _scanners(self) -> list[Port]:
        ports = self.ports.values()
        return [port for port in ports if port.kind == "udp" and port.source.startswith("scanner/") and not port.is_aux]

    def described(self, kind: str) -> str:
        """List the configured ports, buses or scanners for a message."""
        if kind == "lvx":
            named = [
                f"{one.source} ({one.protocol}{f', {one.serial}' if one.serial else ''})" for one in self._scanners()
            ]
            return ", ".join(named) or "none"
        buses = [f"{name} ({port.source if port else 'of two'})" for name, port in self._can.items()]
        if kind == "pcap":
            udp = [f"{number} ({ports[0].source})" for number, ports in self._udp.items()]
            tcp = [f"TCP {_host(one)}:{one.tcp_port} ({one.source})" for ports in self._tcp.values() for one in ports]
            return ", ".join(udp + tcp + buses) or "none"
        return ", ".join(buses) or "none"


def _host(port: Port) -> str:
    assert port.spec is not None
    return port.spec.host if port.kind == "tcp" else port.spec.ntrip_host


def _serves(port: Port, address: str) -> bool:
    """Return whether a device's host may have an address."""
    host = _host(port)
    return not _is_address(host) or ip_address(host) == ip_address(address)


def _is_address(text: str) -> bool:
    try:
        ip_address(text)
    except ValueError:
        return False
    return True


def _bound_to(port: Port) -> str:
    assert port.spec is not None
    return port.spec.options.get("group", port.spec.host)
