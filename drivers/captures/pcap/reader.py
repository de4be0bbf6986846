"""Reads what devices sent from pcap and pcapng files: UDP datagrams, the streams of TCP connections, CAN frames."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from pathlib import Path

from swath.drivers.captures.base import (
    LATEST_NS,
    Address,
    CaptureDamageError,
    CapturedUnit,
    CaptureTally,
    open_capture,
    report,
    until_damage,
)
from swath.drivers.captures.pcap.files import Packet, read_packets
from swath.drivers.captures.pcap.ip import TCP, UDP, IpPackets, Segment
from swath.drivers.captures.pcap.links import (
    CAN_LINKS,
    CutFrameError,
    NoFrameError,
    UnknownLinkError,
    can_channel,
    can_frame,
    ip_packet,
    is_can,
)
from swath.drivers.captures.pcap.tcp import Delivered, TcpStreams, parse_segment

StreamFilter = Callable[[Address, Address], bool]
_CUT = "payloads were cut off at capture; capture with snap length 0 (tcpdump -s 0)"
_MOST_FLOWS = 4096
_UDP_HEADER = struct.Struct(">HHH")


def read_pcap(
    path: Path | str, port: int | None = None, tally: CaptureTally | None = None, *, drop_copies: bool = False
) -> Iterator[CapturedUnit]:
    """Read the UDP datagrams of a pcap or pcapng file and join IP fragments; other packets are left out.

    A datagram in fragments has the time of the fragment that completes it.

    Args:
        path: the file, possibly gzipped.
        port: only datagrams to this port.
        tally: counts damaged and left-out packets; where None, damage is raised.
        drop_copies: see `IpPackets`.

    Raises:
        TransportError: the file is not a capture; without tally also: its link layer is unknown, it is cut short, or
            its payloads were cut off.
    """
    units = until_damage(_Reading(Path(path), tally, drop_copies, None).units(), tally)
    return units if port is None else (unit for unit in units if unit.destination and unit.destination[1] == port)


def read_network(
    path: Path | str, wanted: StreamFilter, tally: CaptureTally | None = None, *, drop_copies: bool = False
) -> Iterator[CapturedUnit]:
    """Read UDP datagrams, the bytes of TCP connections and CAN frames of a pcap or pcapng file, in the file's order.

    A unit's ``channel`` is ``udp``, ``tcp``, or the name of the CAN interface, which is "" where the file does not tell
    it. The wanted streams of TCP come in sequence, a unit a segment (`TcpStreams`); segments of others are as captured.

    Args:
        path: the file, possibly gzipped.
        wanted: returns whether the stream from one address to another is wanted.
        tally: counts damaged and left-out packets, and gaps of the wanted streams; where None, damage is raised.
        drop_copies: see `IpPackets`.

    Raises:
        TransportError: as `read_pcap`; without tally also: bytes of a wanted stream are missing.
    """
    return until_damage(_Reading(Path(path), tally, drop_copies, wanted).units(), tally)


class _Reading:
    """Reads one file; see `read_network`. Without ``wanted``, datagrams only."""

    def __init__(self, path: Path, tally: CaptureTally | None, drop_copies: bool, wanted: StreamFilter | None) -> None:
        self._path = path
        self._tally = tally
        self._wanted = wanted
        self._flows: dict[tuple[Address, Address], bool] = {}
        protocols = (UDP,) if wanted is None else (UDP, TCP)
        self._packets = IpPackets(drop_copies=drop_copies, protocols=protocols)
        self._streams = TcpStreams(lambda text: report(tally, f"{path}: {text}"))

    def units(self) -> Iterator[CapturedUnit]:
        """Yield the units of the file."""
        try:
            yield from self._packets_units()
            yield from _units(self._streams.finish())
        except CaptureDamageError:
            yield from _units(self._streams.finish())
            raise
        finally:
            self._tell()

    def _packets_units(self) -> Iterator[CapturedUnit]:
        links = CAN_LINKS if self._wanted is not None else ()
        with open_capture(self._path) as stream:
            for packet in read_packets(stream, self._path, self._tally):
                time_ns, interface, frame, _ = packet
                if interface.link in links and is_can(packet):
                    unit = self._frame(packet)
                elif (found := self._segment(time_ns, interface.link, frame)) is None:
                    continue
                elif found[0] == UDP:
                    unit = self._datagram(time_ns, found)
                else:
                    yield from self._of_stream(time_ns, found)
                    continue
                if unit is not None:
                    yield unit

    def _tell(self) -> None:
        tally, packets, streams = self._tally, self._packets, self._streams
        if tally is None:
            return
        what = "UDP" if self._wanted is None else "UDP, TCP or CAN"
        tally.passed.update({"packets captured twice": packets.copies, f"packets without {what}": packets.others})
        tally.passed.update(
            {
                "TCP streams captured from their middle on": streams.middles,
                "bytes of TCP from before the capture": streams.earlier,
                "bytes of TCP sent again": streams.repeated,
                "segments of TCP sent again with other bytes": streams.differing,
            }
        )
        tally.missing_bytes += streams.missing
        missing = packets.incomplete + packets.waiting
        if missing:
            tally.damaged(f"{self._path}: {missing} datagrams are incomplete, some of their fragments are missing")

    def _segment(self, time_ns: int, link: int, frame: bytes) -> Segment | None:
        """Return the datagram or segment that a frame holds or completes."""
        packets = self._packets
        cut_before = packets.cut
        try:
            found = packets.add(ip_packet(link, frame), time_ns)
        except UnknownLinkError as error:
            report(self._tally, f"{self._path}: {error}")
            return None
        if packets.cut > cut_before and (found is None or self._is_of_device(found)):
            report(self._tally, f"{self._path}: {_CUT}")
        return found

    def _is_of_device(self, found: Segment) -> bool:
        segment = parse_segment(*found[1:])
        return segment is not None and self._is_wanted(segment.source, segment.destination)

    def _datagram(self, time_ns: int, found: Segment) -> CapturedUnit | None:
        _, source, destination, segment = found
        from_port, to_port, length = _UDP_HEADER.unpack_from(segment) if len(segment) >= 8 else (0, 0, 0)
        if length > len(segment):
            report(self._tally, f"{self._path}: {_CUT}")
        elif length < 8 or not 0 <= time_ns <= LATEST_NS:
            self._pass("packets that are not datagrams")
        else:
            return CapturedUnit(time_ns, segment[8:length], "udp", (source, from_port), (destination, to_port))
        return None

    def _pass(self, what: str) -> None:
        if self._tally is not None:
            self._tally.passed[what] += 1

    def _frame(self, packet: Packet) -> CapturedUnit | None:
        try:
            return CapturedUnit(packet[0], can_frame(packet), can_channel(packet))
        except NoFrameError as error:
            self._pass(str(error))
        except CutFrameError:
            report(self._tally, f"{self._path}: {_CUT}")
        return None

    def _of_stream(self, time_ns: int, found: Segment) -> Iterator[CapturedUnit]:
        segment = parse_segment(*found[1:])
        if segment is None or not 0 <= time_ns <= LATEST_NS:
            self._pass("packets that are not segments of TCP")
            return
        if self._is_wanted(segment.source, segment.destination):
            yield from _units(self._streams.add(time_ns, segment))
        elif self._is_wanted(segment.destination, segment.source):
            if segment.data:
                self._pass("segments of TCP sent to devices")
            yield from _units(self._streams.answer(time_ns, segment))
        elif segment.data:
            yield CapturedUnit(time_ns, segment.data, "tcp", segment.source, segment.destination)

    def _is_wanted(self, source: Address, destination: Address) -> bool:
        assert self._wanted is not None
        known = self._flows.get((source, destination))
        if known is None:
            if len(self._flows) >= _MOST_FLOWS:
                self._flows.clear()
            known = self._flows[source, destination] = self._wanted(source, destination)
        return known


def _units(delivered: list[Delivered]) -> list[CapturedUnit]:
    return [CapturedUnit(time_ns, data, "tcp", source, to) for time_ns, source, to, data in delivered]
