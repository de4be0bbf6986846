"""Receives many datagrams in one system call: recvmmsg(2) into prepared slots, stamps and senders read as arrays.

UDP and SocketCAN use it; their sockets differ only in the length of a unit and in having a sender. The layouts
are those of <sys/socket.h>: `struct mmsghdr`, `struct iovec` and the one control message requested,
SCM_TIMESTAMPNS (socket(7)).
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import mmap
import os
import socket
import struct
import time
from collections.abc import Iterator
from itertools import pairwise

import numpy as np

from swath.drivers.transports.base import HEAD_ROOM_BYTES, UnitBlock
from swath.georef.arrays import Int64Array, UInt64Array
from swath.georef.records import ByteRows

SO_TIMESTAMPNS = 35  # also SCM_TIMESTAMPNS, <asm-generic/socket.h>
SO_RCVBUFFORCE = 33
SO_MEMINFO = 55  # nine u32, <linux/sock_diag.h>
SK_MEMINFO_DROPS = 8
PEER_BYTES = 16  # struct sockaddr_in
MEMORY_BYTES = 2 << 20  # allocated at once; freed when the last block in it is written
LEAST_OFFERED = 32  # slots; with fewer left a read allocates new memory
FIRST_EXPECTED_BYTES = 1248  # a guess; if it is wrong, the units of the first read are copied
STAMPING_WITHIN_S = 1.0  # delay of a work queue on a busy machine; half a millisecond on an idle one
STAMPING_LOOK_S = 0.0005

_WORD = ctypes.sizeof(ctypes.c_void_p)
_MMSGHDR = np.dtype(  # struct msghdr in whole words, then msg_len
    {
        "names": ["name", "namelen", "iov", "iovlen", "control", "controllen", "flags", "len"],
        "formats": [np.uintp, np.uint32, np.uintp, np.uintp, np.uintp, np.uintp, np.int32, np.uint32],
        "offsets": [_WORD * word for word in range(8)],
        "itemsize": 8 * _WORD,
    }
)
_IOVEC = np.dtype([("base", np.uintp), ("len", np.uintp)])
_STAMP = np.dtype(  # struct cmsghdr with a struct timespec
    [("len", np.uintp), ("level", np.int32), ("type", np.int32), ("sec", np.intp), ("nsec", np.intp)]
)

_TIMESPEC = struct.Struct("@ll")

_libc = ctypes.CDLL(None, use_errno=True)
_recvmmsg = _libc.recvmmsg
_recvmmsg.argtypes = [ctypes.c_int, ctypes.c_void_p, ctypes.c_uint, ctypes.c_int, ctypes.c_void_p]
_recvmmsg.restype = ctypes.c_int


class MessageReader:
    """Receives up to ``slots`` datagrams of at most ``unit_bytes`` each at once; one reader serves one thread.

    Units are received at their final place in the log: one after the other, with room for a message's header before
    each, in memory that is passed on with the blocks. This needs their length in advance, so the reader expects the
    length of the last unit for the next. A longer unit overflows into the reader's own slots, and units of any other
    length are copied.
    """

    def __init__(self, unit_bytes: int, slots: int, *, peers: bool) -> None:
        self.slots = slots
        self.offered = 0  # slots of the last read
        self._unit_bytes = unit_bytes
        self._overflow: ByteRows = np.frombuffer(mmap.mmap(-1, slots * unit_bytes), np.uint8).reshape(slots, unit_bytes)
        self._memory = np.empty(0, np.uint8)
        self._taken = 0  # bytes of it that blocks use
        self._expected = min(unit_bytes, FIRST_EXPECTED_BYTES)
        self._peers = np.zeros((slots, PEER_BYTES), np.uint8)
        self._peer_keys: UInt64Array = self._peers.view(np.uint64)[:, 0]  # family, port, address
        self._stamps = np.zeros(slots, _STAMP)
        self._headers = np.zeros(slots, _MMSGHDR)
        self._iovecs = np.zeros((slots, 2), _IOVEC)
        self._number = np.arange(slots, dtype=np.uintp)
        self._peer_names: dict[int, tuple[str, int]] = {}
        self._with_peers = peers
        self._lay_out()

    def _lay_out(self) -> None:
        row = self._number
        self._iovecs["base"][:, 1] = self._overflow.ctypes.data + row * self._unit_bytes
        self._headers["iov"] = self._iovecs.ctypes.data + row * (2 * _IOVEC.itemsize)
        self._headers["iovlen"] = 2
        self._headers["control"] = self._stamps.ctypes.data + row * _STAMP.itemsize
        self._headers["controllen"] = _STAMP.itemsize
        if self._with_peers:
            self._headers["name"] = self._peers.ctypes.data + row * PEER_BYTES
            self._headers["namelen"] = PEER_BYTES
        self._headers_at = self._headers.ctypes.data

    def read(self, fd: int) -> int:
        """Fill slots with the datagrams of ``fd``, without waiting; return the number filled, of ``offered``.

        Raises:
            OSError: the call failed, other than for lack of data or by a signal.
        """
        self._offer()
        count: int = _recvmmsg(fd, self._headers_at, self.offered, socket.MSG_DONTWAIT, None)
        if count >= 0:
            return count
        number = ctypes.get_errno()
        if number in (errno.EAGAIN, errno.EINTR):
            return 0
        raise OSError(number, os.strerror(number))

    def _offer(self) -> None:
        """Place the slots of the next read after the memory of blocks, or in new memory where too little is left."""
        stride = HEAD_ROOM_BYTES + self._expected
        least = min(self.slots, LEAST_OFFERED) * stride
        if len(self._memory) - self._taken < least:
            self._memory, self._taken = np.empty(max(MEMORY_BYTES, least), np.uint8), 0
        self.offered = min(self.slots, (len(self._memory) - self._taken) // stride)
        at = self._memory.ctypes.data + self._taken + HEAD_ROOM_BYTES
        self._iovecs["base"][: self.offered, 0] = at + self._number[: self.offered] * stride
        self._iovecs["len"][: self.offered] = self._expected, self._unit_bytes - self._expected

    def rows(self, count: int) -> ByteRows:
        """Return the first slots of the last read, (count, room + expected length), as they lie in memory."""
        stride = HEAD_ROOM_BYTES + self._expected
        return self._memory[self._taken : self._taken + count * stride].reshape(count, stride)

    def blocks(self, count: int) -> list[UnitBlock]:
        """Return the first ``count`` slots as blocks: runs of equal length and sender, in order."""
        if count == 0:
            return []
        lengths = self._headers["len"][:count]
        stamps = self._take_stamps(count)
        changes = lengths[1:] != lengths[:-1]
        if self._with_peers:
            keys = self._peer_keys[:count]
            changes |= keys[1:] != keys[:-1]
        starts = [0, *(np.flatnonzero(changes) + 1).tolist(), count]
        rows = self.rows(count)
        blocks = [self._block(first, last, rows, stamps) for first, last in pairwise(starts)]
        self._taken += rows.size
        self._expected = int(lengths[-1])
        return blocks

    def _block(self, first: int, last: int, rows: ByteRows, stamps: Int64Array) -> UnitBlock:
        length, mine = int(self._headers["len"][first]), rows[first:last]
        peer = self._peer(first) if self._with_peers else None
        units = mine[:, HEAD_ROOM_BYTES : HEAD_ROOM_BYTES + length]
        if length == self._expected:
            return UnitBlock(units, stamps[first:last], peer, mine)
        beyond = self._overflow[first:last, : max(0, length - self._expected)]
        return UnitBlock(np.concatenate([units, beyond], axis=1), stamps[first:last], peer)

    def _take_stamps(self, count: int) -> Int64Array:
        """Return (count,) nanoseconds of CLOCK_REALTIME, 0 where the kernel gave none, and reset the headers for the
        next read.
        """
        rows = self._stamps[:count]
        nanoseconds: Int64Array = rows["sec"].astype(np.int64) * 1_000_000_000 + rows["nsec"]
        given = (
            (self._headers["controllen"][:count] == _STAMP.itemsize)
            & (rows["level"] == socket.SOL_SOCKET)
            & (rows["type"] == SO_TIMESTAMPNS)
        )
        nanoseconds[~given] = 0
        self._headers["controllen"][:count] = _STAMP.itemsize
        if self._with_peers:
            self._headers["namelen"][:count] = PEER_BYTES
        return nanoseconds

    def _peer(self, slot: int) -> tuple[str, int]:
        key = int(self._peer_keys[slot])
        if key not in self._peer_names:
            if len(self._peer_names) > 4096:  # a sender that changes its port with every datagram
                self._peer_names.clear()
            raw = self._peers[slot].tobytes()
            self._peer_names[key] = (socket.inet_ntoa(raw[4:8]), int.from_bytes(raw[2:4], "big"))
        return self._peer_names[key]


class DropCounter:
    """Counts the datagrams that the kernel dropped at one socket, from SO_MEMINFO, unwrapped over its 32 bits."""

    def __init__(self, sock: socket.socket) -> None:
        self._sock = sock
        self._last = 0
        self.total = 0

    def update(self) -> int:
        """Read the kernel's count and return the exact total since the socket was made."""
        count = self._kernel_count()
        self.total += (count - self._last) & 0xFFFFFFFF
        self._last = count
        return self.total

    def _kernel_count(self) -> int:
        info = self._sock.getsockopt(socket.SOL_SOCKET, SO_MEMINFO, 36)
        return int(np.frombuffer(info, np.uint32)[SK_MEMINFO_DROPS])


def ask_receive_buffer(sock: socket.socket, wanted_bytes: int) -> int:
    """Request a receive buffer and return the granted size in bytes.

    The kernel reserves, and getsockopt returns, twice the requested value (for its own bookkeeping, socket(7)); half of
    it is returned here, so that it compares with the request and with net.core.rmem_max.
    """
    try:
        sock.setsockopt(socket.SOL_SOCKET, SO_RCVBUFFORCE, wanted_bytes)
    except PermissionError:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, wanted_bytes)  # capped silently at rmem_max
    return sock.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) // 2


def ask_stamps(sock: socket.socket) -> None:
    """Make the kernel stamp every datagram with CLOCK_REALTIME on arrival; call it before the socket receives its
    first.
    """
    with stamping():
        sock.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)


@contextlib.contextmanager
def stamping() -> Iterator[None]:
    """Keep the kernel's stamping of arrivals on while the caller opens a socket that requests stamps, for any protocol.

    The kernel stamps arrivals only while some socket of the machine requests stamps, and starts a while after the first
    request (net_enable_timestamp of net/core/dev.c leaves it to a work queue). A datagram that arrived earlier is
    stamped when it is read, late by the reader's batch wait, and its stamp does not show that. Where no datagram
    returns from this machine's own address, the function does not wait.
    """
    with contextlib.ExitStack() as held:
        with contextlib.suppress(OSError):
            probe = held.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC))
            probe.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
            probe.settimeout(STAMPING_WITHIN_S)
            probe.bind(("127.0.0.1", 0))
            deadline_s = time.monotonic() + STAMPING_WITHIN_S
            while not _stamps_on_arrival(probe) and time.monotonic() < deadline_s:
                pass
        yield


def _stamps_on_arrival(probe: socket.socket) -> bool:
    """Return whether a datagram that the probe sends to itself has a stamp from before the read."""
    probe.sendto(b"", probe.getsockname())
    time.sleep(STAMPING_LOOK_S)
    before_reading_ns = time.time_ns()
    _, control, _, _ = probe.recvmsg(0, socket.CMSG_SPACE(_TIMESPEC.size))
    seconds, nanoseconds = _TIMESPEC.unpack(control[0][2])
    return bool(seconds * 1_000_000_000 + nanoseconds < before_reading_ns)
