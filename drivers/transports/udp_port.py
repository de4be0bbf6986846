"""An open local UDP port: unicast, broadcast or multicast, kernel stamps, exact count of datagrams dropped; and a port
that several transports share, told apart by their senders.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import select
import socket
import struct
import threading
import time
from collections import deque

from swath.drivers.transports.base import TransportCounters, TransportError, UnitBlock
from swath.drivers.transports.datagrams import DropCounter, MessageReader, ask_receive_buffer, ask_stamps
from swath.drivers.transports.holders import udp_port_holder
from swath.drivers.transports.spec import TransportSpec

MAX_DATAGRAM_BYTES = 65535  # total length of an IPv4 packet is 16 bits, RFC 791
SLOTS = 512
MAX_CALLS = 32  # bounds one read to 16384 datagrams
MAX_BYTES = 8 << 20  # bounds one read to this size and one more call
MAX_WAITING_BYTES = 64 << 20  # for one sender of a shared port: seconds of a scanner, while its own thread is held up
DEFAULT_BUFFER_MB = 32

_IP_ADD_SOURCE_MEMBERSHIP = 39  # <linux/in.h>
_IP_MULTICAST_ALL = 49
_SIOCGIFADDR = 0x8915
_IFREQ = struct.Struct("@16s24s")


class UdpPort:
    """One open socket of a local UDP port (IPv4).

    Args:
        spec: ``udp:<host>:<port>``; options group, source, interface, buffer_mb.

    Attributes:
        asked_bytes, granted_bytes: size of the receive buffer.

    Raises:
        TransportError: the port cannot be opened.
    """

    def __init__(self, spec: TransportSpec) -> None:
        self.spec = spec
        self.name = spec.text or f"udp:{spec.address}"
        self.sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK | socket.SOCK_CLOEXEC)
        self.asked_bytes = self.granted_bytes = 0
        self._looked_s = 0.0
        self.gone: TransportError | None = None  # the interface has gone, which every user of the port must notice
        try:
            self._configure()
            interface = spec.options.get("interface")
            self._interface_index = None if interface is None else socket.if_nametoindex(interface)
        except OSError as error:
            self.sock.close()
            raise TransportError(self._why(error)) from error
        self._drops = DropCounter(self.sock)
        self._reader = MessageReader(MAX_DATAGRAM_BYTES, SLOTS, peers=True)

    def _configure(self) -> None:
        """Set the options, bind, and join. A socket on a group binds to the group, so that it receives nothing else."""
        options, sock = self.spec.options, self.sock
        self.ask_buffer(int(options.get("buffer_mb", DEFAULT_BUFFER_MB)) << 20)
        ask_stamps(sock)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        group = options.get("group")
        interface = options.get("interface")
        if group is None:
            if interface is not None:
                sock.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, interface.encode())
            sock.bind((self.spec.host, self.spec.port))
            return
        # each listener of a group has its own copy of every datagram, so sharing the port costs no listener any
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        sock.bind((group, self.spec.port))
        self._join(group, _interface_address(sock, interface) if interface else self.spec.host)

    def ask_buffer(self, wanted_bytes: int) -> None:
        """Ask for a receive buffer, if it is larger than the one asked for so far."""
        if wanted_bytes > self.asked_bytes:
            self.asked_bytes = wanted_bytes
            self.granted_bytes = ask_receive_buffer(self.sock, wanted_bytes)

    def _join(self, group: str, interface_address: str) -> None:
        source = self.spec.options.get("source")
        self.sock.setsockopt(socket.IPPROTO_IP, _IP_MULTICAST_ALL, 0)
        request = socket.inet_aton(group) + socket.inet_aton(interface_address)
        if source is None:
            self.sock.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, request)
        else:
            request += socket.inet_aton(source)
            self.sock.setsockopt(socket.IPPROTO_IP, _IP_ADD_SOURCE_MEMBERSHIP, request)

    def _why(self, error: OSError) -> str:
        host, port = self.spec.host, self.spec.port
        if error.errno == errno.EADDRINUSE:
            return f"{self.name}: port {port} is in use by {udp_port_holder(port)}"
        if error.errno == errno.EADDRNOTAVAIL:
            return f"{self.name}: this computer has no address {host}; use 0.0.0.0 to listen on every interface"
        if error.errno == errno.EACCES:
            return f"{self.name}: port {port} is not permitted to this user; use a port of 1024 or above"
        if error.errno == errno.ENODEV and "interface" in self.spec.options:
            return f"{self.name}: no network interface {self.spec.options['interface']} with an IPv4 address"
        if error.errno == errno.ENODEV:
            return f"{self.name}: no network interface reaches the group; add ?interface=<name>"
        return f"{self.name}: cannot open: {error.strerror or error}"

    def close(self) -> None:
        """Close the socket."""
        self.sock.close()

    def dropped(self) -> int:
        """Return the number of datagrams that the kernel dropped at this socket."""
        return self._drops.update()

    def look_after_interface(self) -> None:
        """Check the interface on silence, once a second: a socket receives nothing after its interface went and came
        back.

        A group without a named interface is joined again on the interface that its route now uses.

        Raises:
            TransportError: the interface has gone.
        """
        if self.gone is not None:
            raise TransportError(str(self.gone))
        now_s = time.monotonic()
        if now_s < self._looked_s + 1.0:
            return
        self._looked_s = now_s
        interface, group = self.spec.options.get("interface"), self.spec.options.get("group")
        if interface is not None:
            try:
                same = socket.if_nametoindex(interface) == self._interface_index
            except OSError:
                same = False
            if not same:
                self.gone = TransportError(f"{self.name}: network interface {interface} has gone or was replaced")
                raise TransportError(str(self.gone))
        elif group is not None:
            with contextlib.suppress(OSError):  # joined there already, or no route just now
                self._join(group, self.spec.host)

    def read(self) -> tuple[list[UnitBlock], TransportError | None]:
        """Return the datagrams that the kernel holds, within bounds, and the error that ended the read."""
        blocks: list[UnitBlock] = []
        size = 0
        for _ in range(MAX_CALLS):
            try:
                count = self._reader.read(self.sock.fileno())
            except OSError as error:
                return blocks, TransportError(f"{self.name}: reading failed: {error.strerror}")
            more = self._reader.blocks(count)
            blocks += more
            size += sum(block.units.size for block in more)
            if count < self._reader.offered or size > MAX_BYTES:
                break
        return blocks, None


class Sharer:
    """One of the senders of a shared port: the queue of its datagrams, and a descriptor that is readable while the
    socket or the queue holds any.
    """

    def __init__(self, port: SharedPort, source: str, counters: TransportCounters) -> None:
        self.port = port
        self.source = source
        self.counters = counters
        self.waiting: deque[UnitBlock] = deque()
        self.waiting_bytes = 0
        self._noticed = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._poll = select.epoll()
        self._poll.register(port.socket.sock.fileno(), select.EPOLLIN)
        self._poll.register(self._noticed, select.EPOLLIN)

    def fileno(self) -> int:
        """Return the descriptor to wait on."""
        return self._poll.fileno()

    def put(self, block: UnitBlock) -> None:
        """Queue a block; where the queue is full, count its units as lost."""
        if self.waiting_bytes + block.units.size > MAX_WAITING_BYTES:
            self.counters.lost_kernel += len(block.units)
            return
        self.waiting.append(block)
        self.waiting_bytes += block.units.size

    def notice(self) -> None:
        """Make the descriptor readable."""
        os.eventfd_write(self._noticed, 1)

    def take(self) -> list[UnitBlock]:
        """Return and empty the queue."""
        blocks = list(self.waiting)
        self.waiting.clear()
        self.waiting_bytes = 0
        with contextlib.suppress(BlockingIOError):
            os.eventfd_read(self._noticed)
        return blocks

    def close(self) -> None:
        """Release the descriptors."""
        self._poll.close()
        os.close(self._noticed)


class SharedPort:
    """A UDP port with a transport for each configured sender, in one process; whichever thread reads serves all.

    Datagrams that the kernel dropped have no known sender, and those of other senders belong to no transport: both are
    counted once, at the transport that opened first; other senders' there even after it has left, so that one stranger
    is told once. What a transport's own sender sends after it has left belongs to nobody.
    """

    def __init__(self, spec: TransportSpec) -> None:
        self.socket = UdpPort(spec)
        self._sharers: dict[str, Sharer] = {}
        self._counters: dict[str, TransportCounters] = {}  # of all that ever joined, in this order
        self._lock = threading.Lock()
        self._dropped = 0

    def add(self, spec: TransportSpec, counters: TransportCounters) -> Sharer:
        """Add the transport of a sender; raises `TransportError` if the sender has one already."""
        source = spec.options["source"]
        with self._lock:
            if self.socket.gone is not None:  # until the others have left it too
                raise TransportError(str(self.socket.gone))
            if source in self._sharers:
                raise TransportError(f"{spec.text}: port {spec.port} is in use by this program itself")
            self.socket.ask_buffer(int(spec.options.get("buffer_mb", DEFAULT_BUFFER_MB)) << 20)
            sharer = self._sharers[source] = Sharer(self, source, counters)
            self._counters[source] = counters
        return sharer

    def remove(self, sharer: Sharer) -> bool:
        """Remove the transport of a sender; return whether none is left, and the socket closed."""
        with self._lock:
            self._sharers.pop(sharer.source, None)
            sharer.close()
            if not self._sharers:
                self.socket.close()
            return not self._sharers

    def receive(self, sharer: Sharer) -> tuple[list[UnitBlock], TransportError | None]:
        """Read the socket for all senders; return the datagrams of one of them, and the error that ended the read."""
        with self._lock:
            blocks, error = self.socket.read()
            for block in blocks:
                self._distribute(block, sharer)
            return sharer.take(), error

    def _distribute(self, block: UnitBlock, reading: Sharer) -> None:
        sender = "" if block.peer is None else block.peer[0]
        owner = self._sharers.get(sender)
        if owner is None:
            if sender not in self._counters:
                next(iter(self._counters.values())).refuse(sender, len(block.units))
            return
        owner.put(block)
        if owner is not reading:
            owner.notice()

    def refresh(self, sharer: Sharer) -> None:
        """Update a transport's counters from the kernel's."""
        with self._lock:
            if next(iter(self._sharers.values()), None) is sharer:
                dropped = self.socket.dropped()
                sharer.counters.lost_kernel += dropped - self._dropped
                self._dropped = dropped


_shared: dict[tuple[str, int, str], SharedPort] = {}
_shared_lock = threading.Lock()


def _key(spec: TransportSpec) -> tuple[str, int, str]:
    return spec.host, spec.port, spec.options.get("interface", "")


def share_port(spec: TransportSpec, counters: TransportCounters) -> Sharer:
    """Join the port of a transport with ``source``, which is opened for the first of its senders.

    Raises:
        TransportError: the port cannot be opened, or the sender has a transport already.
    """
    with _shared_lock:
        port = _shared.get(_key(spec))
        if port is None:
            port = SharedPort(spec)
        sharer = port.add(spec, counters)
        _shared[_key(spec)] = port
        return sharer


def leave_port(sharer: Sharer) -> None:
    """Leave a shared port; the last one closes it."""
    with _shared_lock:
        if sharer.port.remove(sharer):
            del _shared[_key(sharer.port.socket.spec)]


def _interface_address(sock: socket.socket, interface: str) -> str:
    """Return the IPv4 address of an interface; raise OSError ENODEV where the interface or its address is missing."""
    request = _IFREQ.pack(interface.encode()[:15], bytes(24))
    try:
        answer = fcntl.ioctl(sock, _SIOCGIFADDR, request)
    except OSError as error:
        raise OSError(errno.ENODEV, "no such interface, or without an IPv4 address") from error
    return socket.inet_ntoa(answer[20:24])
