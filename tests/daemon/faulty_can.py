"""A CAN adapter with switches, which python-can loads as an interface: ``can:faulty:<path of a socket>``.

The test at the other end of the socket sends SocketCAN frames of 16 bytes, which the bus passes on. Any other message
is an error of the adapter, which the bus raises. If a file ``<path>.off`` exists, the adapter cannot be opened.
"""

from __future__ import annotations

import socket
from pathlib import Path
from typing import Any

import can

from swath.drivers.can_frames import CAN_FRAME_BYTES
from swath.drivers.transports.can.adapter import unpack_frame

ENTRY_POINT = "[can.interface]\nfaulty = tests.daemon.faulty_can:FaultyBus\n"


class FaultyBus(can.BusABC):
    """A bus that python-can opens by its plugin interface."""

    def __init__(self, channel: str, **keywords: Any) -> None:
        if Path(channel + ".off").exists():
            raise can.CanInitializationError("the controller is bus-off")
        path = Path(channel)
        path.unlink(missing_ok=True)
        self._path = path
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(channel)
        self._socket.setblocking(False)
        super().__init__(channel, **keywords)

    def fileno(self) -> int:
        """Return a file descriptor to wait on."""
        return self._socket.fileno()

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        try:
            data = self._socket.recv(256)
        except BlockingIOError:
            return None, False
        if len(data) != CAN_FRAME_BYTES:
            raise can.CanOperationError(data.decode())
        return unpack_frame(data), False

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Discard a frame."""

    def shutdown(self) -> None:
        """Close and take the socket away."""
        super().shutdown()
        self._socket.close()
        self._path.unlink(missing_ok=True)


def install(folder: Path) -> str:
    """Make the interface known to python-can in processes that have ``folder`` on their PYTHONPATH."""
    made = folder / "faulty_can-0.dist-info"
    made.mkdir()
    (made / "METADATA").write_text("Metadata-Version: 2.1\nName: faulty-can\nVersion: 0\n")
    (made / "entry_points.txt").write_text(ENTRY_POINT)
    return str(folder)
