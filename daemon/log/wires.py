"""Describes where the log stores the units of each port, socket and bus."""

from __future__ import annotations

from dataclasses import dataclass

from swath.daemon.config import DeviceEntry
from swath.daemon.log.format import ChunkClass
from swath.drivers.transports.spec import TransportSpec

SILENT_AFTER_S = 3.0
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
