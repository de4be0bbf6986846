"""J1939 messages of a DBC: which frames carry them, and which of their values mean "no value".

The 29-bit identifier holds priority, parameter group number (PGN) and source address (SAE J1939-21). A DBC written for
J1939 names the parameter group; priority and source address in it are placeholders, because a device claims its address
when it starts (SAE J1939-81). Top bytes FE and FF of a parameter mean "error" and "not available" (SAE J1939-71,
transmitted signal ranges).
"""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from swath.drivers.can_frames import CAN_EFF_FLAG, CAN_ERR_FLAG, CAN_RTR_FLAG
from swath.drivers.imu.dbc.signals import SignalLayout
from swath.georef.arrays import BoolArray, UInt64Array

FLAGS = CAN_EFF_FLAG | CAN_RTR_FLAG | CAN_ERR_FLAG
BROADCAST_PGN_MASK = 0x03FF_FF00  # extended data page, data page, PDU format, group extension
ADDRESSED_PGN_MASK = 0x03FF_0000  # below that PDU format the next byte is a destination and no part of the PGN
BROADCAST_FORMAT = 240
PLACEHOLDER_ADDRESS = 0xFE  # the null address, which no device sends from; 0xFF is the global one
ERROR_CODE, NOT_AVAILABLE = 0xFE, 0xFF
CODED_LENGTHS = (8, 16, 24, 32)


def is_j1939(database: Any, message: Any) -> bool:
    """Return whether a cantools message is a J1939 parameter group.

    Its frame format says so (VFrameFormat), or the network's protocol (ProtocolType), or a source address from which
    no device sends.
    """
    if not message.is_extended_frame:
        return False
    if message.protocol == "j1939" or message.frame_id & 0xFF >= PLACEHOLDER_ADDRESS:
        return True
    network = getattr(getattr(database, "dbc", None), "attributes", None) or {}
    own = getattr(getattr(message, "dbc", None), "attributes", None) or {}
    protocol = network.get("ProtocolType")
    return "VFrameFormat" not in own and protocol is not None and str(protocol.value).upper() == "J1939"


def may_be_j1939(can_id: int) -> bool:
    """Return whether a ``can_id`` word looks like a broadcast parameter group: 29 bits, PDU format 240 or above."""
    return bool(can_id & CAN_EFF_FLAG) and can_id >> 16 & 0xFF >= BROADCAST_FORMAT


def pgn_mask(identifier: int) -> int:
    """Return the bits of a 29-bit identifier that form its PGN."""
    return BROADCAST_PGN_MASK if identifier >> 16 & 0xFF >= BROADCAST_FORMAT else ADDRESSED_PGN_MASK


def pgn_of(identifier: int) -> int:
    """Return the PGN of a 29-bit identifier."""
    return (identifier & pgn_mask(identifier)) >> 8


def parameter_codes(layout: SignalLayout, bits: UInt64Array) -> tuple[BoolArray, BoolArray]:
    """Return which (n,) right-aligned bits of a J1939 parameter mean "not available", and which "error"."""
    if layout.is_float or layout.signed or layout.length not in CODED_LENGTHS:
        nothing = np.zeros(len(bits), np.bool_)
        return nothing, nothing
    top = bits >> np.uint64(layout.length - 8)
    return top == NOT_AVAILABLE, top == ERROR_CODE


class SourceChoice:
    """Chooses the device whose frames are used, for messages that any source address may send.

    Messages with one source address in the DBC come from one device: the configured address, or the first that sends
    any of them.
    """

    def __init__(self, wanted: int | None) -> None:
        self._wanted = wanted
        self._used: dict[int, int] = {}  # address in the DBC -> address used
        self._others: dict[str, Counter[int]] = {}  # message -> frames of devices that are not used

    def settle(self, named: dict[int, NDArray[np.intp]], source: NDArray[np.uint32]) -> None:
        """Choose the device for each address in the DBC, by the first of its frames.

        Args:
            named: indices of the frames of a batch whose PGN matches, by the messages' address in the DBC.
            source: (n,) source address of each frame of the batch.
        """
        for address, where in named.items():
            if address not in self._used and len(where):
                self._used[address] = int(source[where.min()]) if self._wanted is None else self._wanted

    def pick(self, message: str, address: int, where: NDArray[np.intp], source: NDArray[np.uint32]) -> NDArray[np.intp]:
        """Return the frames of the device that is used, and count those of others."""
        mine = source[where] == self._used.get(address, -1)
        if not mine.all():
            self.note_others(message, source[where[~mine]])
        used: NDArray[np.intp] = where[mine]
        return used

    def note_others(self, message: str, source: NDArray[np.uint32]) -> None:
        """Count frames of a message that come from devices that are not used."""
        if len(source):
            counts = np.bincount(source, minlength=256)
            self._others.setdefault(message, Counter()).update({int(n): int(counts[n]) for n in np.flatnonzero(counts)})

    def lines(self, message: str, can_id: int, *, seen: int, chosen: bool) -> list[str]:
        """Return what the user should know of a message: other devices that send it, and the settings for them.

        Args:
            message: its name in the DBC.
            can_id: ``can_id`` word of the message in the DBC.
            seen: number of its frames that were used.
            chosen: whether its device was chosen among several.
        """
        others = self._others.get(message)
        if not others or (seen and not chosen):
            return []
        names = " and ".join(f"0x{address:02X}" for address, _ in sorted(others.items())[:4])
        first = others.most_common(1)[0][0]
        subject = f"PGN {pgn_of(can_id)} ({message}) comes from {names}"
        if seen:
            used = self._used.get(can_id & 0xFF, can_id & 0xFF)
            return [f"{subject} too; 0x{used:02X} is used; set source_address = {first} for the other device"]
        wanted = (
            f"the DBC says 0x{can_id & 0xFF:02X}"
            if self._wanted is None
            else f"source_address says 0x{self._wanted:02X}"
        )
        return [f"{subject}, {wanted}; set source_address = {first}"]
