"""Describes where the log stores the units of each wire, and finds several devices that send to one port."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field

from swath.daemon.config import DeviceEntry
from swath.daemon.log.format import ChunkClass
from swath.drivers.transports.spec import TransportSpec

SILENT_AFTER_S = 3.0
LEAST_RETURNS = 2  # a device that got another address, and then its own one again, returns once
SENDERS_SHOWN = 4
MAX_SENDERS = 256  # that get a channel on one UDP port; a port scanner must not fill the log with channels
BLOCK_BYTES = 512 * 1024  # a larger block is split, so that chunks stay near their 1 MiB

_ENCODINGS = {
    "serial": "x-swath-serial",
    "tcp": "x-swath-serial",
    "ntrip": "x-swath-serial",
    "can": "x-swath-can",
    "udp": "x-swath-udp",
}


def make_wire(device: DeviceEntry, transport: TransportSpec, suffix: str) -> Wire:
    """Describe where the log stores the units of a device's port; ``suffix`` is ``/aux`` for a second port."""
    metadata = {"protocol": device.protocol, "transport": transport.text}
    if transport.kind == "udp":
        metadata["port"] = str(transport.port)
    if "dbc" in device.files:
        metadata["dbc"] = f"dbc/{device.files['dbc'].name}"
    return Wire(
        source=f"{device.source}{suffix}",
        topic=f"/{device.source}{suffix}/raw",
        encoding=_ENCODINGS[transport.kind],
        chunk_class="scanner" if device.kind == "scanner" else "other",
        metadata=metadata,
    )


@dataclass(frozen=True, slots=True)
class Wire:
    """One port, socket or bus of a device, and the place of its units in the log.

    Attributes:
        source: name of its account: ``kind/name``, with ``/aux`` for a scanner's second port.
        topic: of the raw channel.
        encoding: MCAP message encoding, ``x-swath-serial``, ``x-swath-can`` or ``x-swath-udp``.
        chunk_class: "scanner" or "other".
        metadata: of the channel, without the sender's address.
    """

    source: str
    topic: str
    encoding: str
    chunk_class: ChunkClass
    metadata: dict[str, str]


@dataclass(slots=True)
class Senders:
    """Counts the datagrams of one source by sender, run by run.

    Attributes:
        counts: datagrams by the sender's address.
        mixed: whether several send at the same time; one device that changes its address does not.
    """

    counts: Counter[str] = field(default_factory=Counter)
    mixed: bool = False
    _latest_ns: dict[str, int] = field(default_factory=dict)
    _last: str = ""
    _returns: int = 0

    def add(self, address: str, first_ns: int, last_ns: int, count: int) -> None:
        """Take a run of datagrams of one sender, with the times of the first and the last."""
        if self._last not in ("", address):
            self._returns += address in self.counts
            self.mixed |= self._returns >= LEAST_RETURNS or first_ns < self._latest_ns[self._last]
        self.counts[address] += count
        self._latest_ns[address] = max(last_ns, self._latest_ns.get(address, last_ns))
        self._last = address


def mixed_text(counts: Mapping[str, int], *, recorded: bool) -> str:
    """Return a line on datagrams of several senders, with the remedy.

    Args:
        counts: datagrams by address.
        recorded: whether they are in a log already.
    """
    named = ", ".join(address for address, _ in Counter(counts).most_common(SENDERS_SHOWN))
    more = f" and {len(counts) - SENDERS_SHOWN} more" if len(counts) > SENDERS_SHOWN else ""
    again = "; with swath export and swath import the log can be made anew with it" if recorded else ""
    return (
        f"{len(counts)} devices send to its port at the same time and are read as one: {named}{more}; give each a "
        f"section of its own with ?source=ADDRESS in its transport{again}"
    )
