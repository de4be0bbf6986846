"""UDP port: unicast, broadcast or multicast, kernel stamps, exact count of datagrams that the kernel dropped.

Datagrams of other senders than ``source`` are not units: they are discarded after the kernel delivered them, and
counted in `TransportCounters.refused`, with their senders. (A filter in the kernel would count them among the socket's
drops, and a connected socket receives no broadcasts, which scanners send by default.) Transports with ``source`` on one
port share its socket: two heads that send to one port, as their maker delivers them. A port bound to 0.0.0.0 receives
broadcasts too; a port bound to one address of this machine does not.
"""

from __future__ import annotations

import time

from swath.drivers.transports.base import TransportError, UnitBlock
from swath.drivers.transports.descriptor import DescriptorTransport, Gate
from swath.drivers.transports.spec import TransportSpec
from swath.drivers.transports.udp_port import DEFAULT_BUFFER_MB, Sharer, UdpPort, leave_port, share_port

BATCH_S = 0.016  # 320 datagrams at 20 000 a second; the kernel stamps them, so that only wake-ups are delayed
SMALL_BUFFER_BYTES = 4 << 20  # a receive buffer below this may hold less than a batch: the default holds 4.6 ms
SMALL_BUFFER_BATCH_S = 0.002


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
        self._port: UdpPort | None = None
        self._sharer: Sharer | None = None  # where the port is shared: this transport's part of it

    def _open_device(self) -> int:
        if self._source is not None and "group" not in self._spec.options:
            self._sharer = share_port(self._spec, self.counters)
            self._port, fd = self._sharer.port.socket, self._sharer.fileno()
        else:
            self._port = UdpPort(self._spec)
            fd = self._port.sock.fileno()
        self.counters.receive_buffer_asked_bytes = int(self._spec.options.get("buffer_mb", DEFAULT_BUFFER_MB)) << 20
        self.counters.receive_buffer_bytes = self._port.granted_bytes
        return fd

    def _close_device(self) -> None:
        port, self._port = self._port, None
        sharer, self._sharer = self._sharer, None
        if sharer is not None:
            leave_port(sharer)
        elif port is not None:
            port.close()

    def _refresh_counters(self) -> None:
        if self._sharer is not None:
            self._sharer.port.refresh(self._sharer)
        elif self._port is not None:
            self.counters.lost_kernel = self._port.dropped()

    def _receive(self, gate: Gate, timeout_s: float) -> list[UnitBlock]:
        assert self._port is not None
        deadline_s = time.monotonic() + timeout_s
        if not gate.wait(timeout_s):
            self._port.look_after_interface()
            return []
        batch_s = min(self._batch_s, deadline_s - time.monotonic())
        if self.counters.receive_buffer_bytes < SMALL_BUFFER_BYTES:
            batch_s = min(batch_s, SMALL_BUFFER_BATCH_S)
        if batch_s > 0:
            time.sleep(batch_s)
        if self._sharer is not None:
            blocks, error = self._sharer.port.receive(self._sharer)
        else:
            blocks, error = self._port.read()
        if error is not None:
            self._fail_after(blocks, error)
        return blocks if self._source is None else self._accepted(blocks)

    def _accepted(self, blocks: list[UnitBlock]) -> list[UnitBlock]:
        accepted = []
        for block in blocks:
            if block.peer is not None and block.peer[0] == self._source:
                accepted.append(block)
            else:
                self.counters.refuse("" if block.peer is None else block.peer[0], len(block.units))
        return accepted

    def _send(self, data: bytes) -> None:
        """Send to the group, or to the accepted sender at the same port number."""
        target = self._spec.options.get("group") or self._source
        if target is None:
            raise TransportError(f"{self.name}: has no address to send to; add ?source=<address> or ?group=<address>")
        assert self._port is not None
        try:
            self._port.sock.sendto(data, (target, self._spec.port))
        except OSError as error:
            raise TransportError(f"{self.name}: sending {len(data)} bytes failed: {error.strerror}") from error
