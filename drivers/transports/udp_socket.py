"""UDP port: unicast, broadcast or multicast, kernel stamps, exact count of datagrams that the kernel dropped.

Datagrams of other senders than ``source`` are not units: they are discarded after the kernel delivered them, and
counted in `TransportCounters.refused`. (A filter in the kernel would count them among the socket's drops, and a
connected socket receives no broadcasts, which scanners send by default.) A port bound to 0.0.0.0 receives broadcasts
too; a port bound to one address of this machine does not.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import socket
import struct
import time

from swath.drivers.transports.base import TransportError, UnitBlock
from swath.drivers.transports.datagrams import DropCounter, MessageReader, ask_receive_buffer, ask_stamps
from swath.drivers.transports.descriptor import DescriptorTransport, Gate
from swath.drivers.transports.holders import udp_port_holder
from swath.drivers.transports.spec import TransportSpec

MAX_DATAGRAM_BYTES = 65535  # total length of an IPv4 packet is 16 bits, RFC 791
SLOTS = 512
BATCH_S = 0.016  # 320 datagrams at 20 000 a second; the kernel stamps them, so that only wake-ups are delayed
SMALL_BUFFER_BYTES = 4 << 20  # a receive buffer below this may hold less than a batch: the default holds 4.6 ms
SMALL_BUFFER_BATCH_S = 0.002
MAX_CALLS = 32  # bounds one receive to 16384 datagrams
MAX_BYTES = 8 << 20  # bounds one receive to this size and one more call
DEFAULT_BUFFER_MB = 32

_IP_ADD_SOURCE_MEMBERSHIP = 39  # <linux/in.h>
_IP_MULTICAST_ALL = 49
_SIOCGIFADDR = 0x8915
_IFREQ = struct.Struct("@16s24s")


class UdpTransport(DescriptorTransport):
    """Receives from one local UDP port (IPv4).

    Args:
        spec: ``udp:<host>:<port>``; options group, source, interface, buffer_mb.
        batch_s: wait for more datagrams after the first, so that one call receives many. The kernel's stamps are
            unaffected.
    """

    def __init__(self, spec: TransportSpec, batch_s: float = BATCH_S) -> None:
        super().__init__(spec.text or f"udp:{spec.address}")
        self._spec = spec
        self._batch_s = batch_s
        self._source = spec.options.get("source")
        self._sock: socket.socket | None = None
        self._drops: DropCounter | None = None
        self._reader: MessageReader | None = None
        self._interface_index: int | None = None
        self._looked_s = 0.0

    def _open_device(self) -> int:
        sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK | socket.SOCK_CLOEXEC)
        try:
            self._configure(sock)
            interface = self._spec.options.get("interface")
            self._interface_index = None if interface is None else socket.if_nametoindex(interface)
        except OSError as error:
            sock.close()
            raise TransportError(self._why(error)) from error
        self._sock = sock
        self._drops = DropCounter(sock)
        if self._reader is None:
            self._reader = MessageReader(MAX_DATAGRAM_BYTES, SLOTS, peers=True)
        return sock.fileno()

    def _configure(self, sock: socket.socket) -> None:
        """Set the options, bind, and join. A socket on a group binds to the group, so that it receives nothing else."""
        options = self._spec.options
        asked = int(options.get("buffer_mb", DEFAULT_BUFFER_MB)) << 20
        self.counters.receive_buffer_asked_bytes = asked
        self.counters.receive_buffer_bytes = ask_receive_buffer(sock, asked)
        ask_stamps(sock)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        group = options.get("group")
        interface = options.get("interface")
        if group is None:
            if interface is not None:
                sock.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, interface.encode())
            sock.bind((self._spec.host, self._spec.port))
            return
        # each listener of a group has its own copy of every datagram, so sharing the port costs no listener any
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        sock.bind((group, self._spec.port))
        self._join(sock, group, _interface_address(sock, interface) if interface else self._spec.host)

    def _join(self, sock: socket.socket, group: str, interface_address: str) -> None:
        sock.setsockopt(socket.IPPROTO_IP, _IP_MULTICAST_ALL, 0)
        request = socket.inet_aton(group) + socket.inet_aton(interface_address)
        if self._source is None:
            sock.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, request)
        else:
            request += socket.inet_aton(self._source)
            sock.setsockopt(socket.IPPROTO_IP, _IP_ADD_SOURCE_MEMBERSHIP, request)

    def _why(self, error: OSError) -> str:
        host, port = self._spec.host, self._spec.port
        if error.errno == errno.EADDRINUSE:
            return f"{self.name}: port {port} is in use by {udp_port_holder(port)}"
        if error.errno == errno.EADDRNOTAVAIL:
            return f"{self.name}: this computer has no address {host}; use 0.0.0.0 to listen on every interface"
        if error.errno == errno.EACCES:
            return f"{self.name}: port {port} is not permitted to this user; use a port of 1024 or above"
        if error.errno == errno.ENODEV and "interface" in self._spec.options:
            return f"{self.name}: no network interface {self._spec.options['interface']} with an IPv4 address"
        if error.errno == errno.ENODEV:
            return f"{self.name}: no network interface reaches the group; add ?interface=<name>"
        return f"{self.name}: cannot open: {error.strerror or error}"

    def _close_device(self) -> None:
        if self._sock is not None:
            self._sock.close()
            self._sock = None

    def _refresh_counters(self) -> None:
        if self._drops is not None:
            self.counters.lost_kernel = self._drops.update()

    def _receive(self, gate: Gate, timeout_s: float) -> list[UnitBlock]:
        deadline_s = time.monotonic() + timeout_s
        if not gate.wait(timeout_s):
            self._look_after_interface()
            return []
        batch_s = min(self._batch_s, deadline_s - time.monotonic())
        if self.counters.receive_buffer_bytes < SMALL_BUFFER_BYTES:
            batch_s = min(batch_s, SMALL_BUFFER_BATCH_S)
        if batch_s > 0:
            time.sleep(batch_s)
        return self._drain()

    def _look_after_interface(self) -> None:
        """Check the interface on silence, once a second: a socket receives nothing after its interface went and came
        back.

        A group without a named interface is joined again on the interface that its route now uses.
        """
        now_s = time.monotonic()
        if self._sock is None or now_s < self._looked_s + 1.0:
            return
        self._looked_s = now_s
        interface, group = self._spec.options.get("interface"), self._spec.options.get("group")
        if interface is not None:
            try:
                same = socket.if_nametoindex(interface) == self._interface_index
            except OSError:
                same = False
            if not same:
                raise TransportError(f"{self.name}: network interface {interface} has gone or was replaced")
        elif group is not None:
            with contextlib.suppress(OSError):  # joined there already, or no route just now
                self._join(self._sock, group, self._spec.host)

    def _drain(self) -> list[UnitBlock]:
        assert self._sock is not None
        assert self._reader is not None
        blocks: list[UnitBlock] = []
        size = 0
        for _ in range(MAX_CALLS):
            try:
                count = self._reader.read(self._sock.fileno())
            except OSError as error:
                self._fail_after(blocks, TransportError(f"{self.name}: reading failed: {error.strerror}"))
                break
            more = self._reader.blocks(count)
            blocks += more
            size += sum(block.units.size for block in more)
            if count < self._reader.offered or size > MAX_BYTES:
                break
        return blocks if self._source is None else self._accepted(blocks)

    def _accepted(self, blocks: list[UnitBlock]) -> list[UnitBlock]:
        accepted = [block for block in blocks if block.peer is not None and block.peer[0] == self._source]
        if len(accepted) < len(blocks):
            self.counters.refused += sum(len(b.units) for b in blocks) - sum(len(b.units) for b in accepted)
        return accepted

    def _send(self, data: bytes) -> None:
        """Send to the group, or to the accepted sender at the same port number."""
        target = self._spec.options.get("group") or self._source
        if target is None:
            raise TransportError(f"{self.name}: has no address to send to; add ?source=<address> or ?group=<address>")
        assert self._sock is not None
        try:
            self._sock.sendto(data, (target, self._spec.port))
        except OSError as error:
            raise TransportError(f"{self.name}: sending {len(data)} bytes failed: {error.strerror}") from error


def _interface_address(sock: socket.socket, interface: str) -> str:
    """Return the IPv4 address of an interface; raise OSError ENODEV where the interface or its address is missing."""
    request = _IFREQ.pack(interface.encode()[:15], bytes(24))
    try:
        answer = fcntl.ioctl(sock, _SIOCGIFADDR, request)
    except OSError as error:
        raise OSError(errno.ENODEV, "no such interface, or without an IPv4 address") from error
    return socket.inet_ntoa(answer[20:24])
