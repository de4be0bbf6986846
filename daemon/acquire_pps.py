"""The receive thread of a PPS source."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from swath.daemon.log.channels import JsonChannel
from swath.daemon.log.events import Severity
from swath.daemon.log.host_clock import read_clock_pair
from swath.daemon.log.mcap.encode import MESSAGE_HEADER_BYTES
from swath.daemon.recorder.receivers import WAIT_S, Receiver, Shared
from swath.daemon.recorder.wire_trouble import WireTrouble
from swath.drivers.session import Session, SessionState
from swath.drivers.transports.base import RawEdge


class PpsReceiver(Receiver):
    """Takes the edges of one PPS source; every edge goes to ``/pps/<name>``, accepted by the clock or not.

    Args:
        overwrites: the kernel keeps the newest edge only, so that those it overwrote before they were fetched show
            as a jump of its sequence. (A FIFO holds every edge: what is missing there was never in it.)
    """

    def __init__(
        self,
        name: str,
        session: Session[RawEdge],
        shared: Shared,
        edge_seen: Callable[[int, int], None],
        *,
        overwrites: bool = True,
    ) -> None:
        super().__init__(f"pps/{name}", shared)
        self._session = session
        self._edge_seen = edge_seen
        self._channel = JsonChannel(shared.channels, self.source, f"/pps/{name}", "swath.Pps")
        self._overwrites = overwrites
        self._trouble = WireTrouble(self.source, shared.events)
        self._sequence: int | None = None
        self._openings = 0

    @property
    def opening(self) -> bool:
        """Whether the device is being opened at this moment."""
        return self._session.state is SessionState.OPENING

    def take(self, timeout_s: float) -> int | None:
        """Wait for edges and hand them over."""
        edges = self._session.receive(timeout_s)
        if not edges:
            return None
        stamps = np.array([edge.realtime_ns for edge in edges], dtype=np.int64)
        times = self.stamps.convert_at(stamps, len(edges), read_clock_pair())
        self.account.ambiguous = self.stamps.ambiguous
        for edge, host_ns in zip(edges, times.tolist(), strict=True):
            self._hand_over(edge, host_ns)
        return int(times[-1])

    def receive_once(self) -> None:
        """One wait, and what there is to tell of the device."""
        self.take(WAIT_S)
        self.account.trouble = self._trouble.look(self._session.poll_counters())
        self.tell_state(self._session.state, self._session.last_error)
        self.tell_account()

    def finish(self) -> None:
        """Take the rest, close and give the last account."""
        if self._session.state is SessionState.OPEN:
            self.drain()
        self._session.close()
        self.account.trouble = self._trouble.look(self._session.poll_counters())
        self.tell_account(now=True)

    def _hand_over(self, edge: RawEdge, host_ns: int) -> None:
        self._count_missed(edge.sequence)
        value: dict[str, object] = {
            "edge_time_ns": host_ns,
            "sequence": edge.sequence,
            "edge": edge.edge,
            "realtime_ns": edge.realtime_ns,
        }
        encoded = self._channel.encode(self.shared.clock.now_ns(), value)
        self.note_units(1, len(encoded.data) - MESSAGE_HEADER_BYTES, host_ns)
        self.hand_over(encoded)
        self._edge_seen(host_ns, edge.sequence)

    def _count_missed(self, sequence: int) -> None:
        """Edges since the last one, while the device was open, that were overwritten before they were fetched."""
        if self._openings != self._session.openings:
            self._openings, self._sequence = self._session.openings, None
        previous, self._sequence = self._sequence, sequence
        missed = 0 if previous is None else ((sequence - previous) & 0xFFFFFFFF) - 1
        if self._overwrites and 0 < missed < 1000:
            self.account.lost_kernel += missed
            self.account.units += missed
            text = f"{missed} edges were overwritten before they could be fetched"
            self.shared.events.post(Severity.ERROR, self.source, "lost_kernel", text)
