"""CAN frames as Linux lays them out in memory: ``struct can_frame`` and ``struct canfd_frame`` (linux/can.h).

This is the layout of a CAN unit in the log (LOG_FORMAT, ``x-swath-can``) and on a SocketCAN socket. The bus defines
no byte order for the identifier; in the log it is little-endian.
"""

from __future__ import annotations

import struct

import numpy as np

from swath.georef.arrays import StructArray
from swath.georef.records import ByteRows

CAN_EFF_FLAG = 0x8000_0000  # 29-bit identifier
CAN_RTR_FLAG = 0x4000_0000  # remote request: carries no data
CAN_ERR_FLAG = 0x2000_0000  # error frame: sent by the controller, not by a node
CAN_SFF_MASK = 0x0000_07FF
CAN_EFF_MASK = 0x1FFF_FFFF

CAN_FRAME_BYTES = 16  # CAN_MTU
CANFD_FRAME_BYTES = 72  # CANFD_MTU
CANFD_FDF = 0x04  # flags byte: this is an FD frame
CANFD_BRS = 0x01  # flags byte: sent with the second bit rate
CANFD_ESI = 0x02  # flags byte: its sender was error passive

CAN_FRAME_DTYPE = np.dtype(
    [("can_id", "<u4"), ("length", "u1"), ("flags", "u1"), ("reserved", "u1", 2), ("data", "u1", 8)]
)
CANFD_FRAME_DTYPE = np.dtype(
    [("can_id", "<u4"), ("length", "u1"), ("flags", "u1"), ("reserved", "u1", 2), ("data", "u1", 64)]
)
_CLASSIC, _FD = struct.Struct("<IBBxx8s"), struct.Struct("<IBBxx64s")
CANFD_LENGTHS = (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)  # ISO 11898-1, data length code


def frame_id(identifier: int, *, extended: bool) -> int:
    """Return the ``can_id`` word of a data frame: the identifier with its flag.

    Raises:
        ValueError: the identifier has more bits than its format.
    """
    mask = CAN_EFF_MASK if extended else CAN_SFF_MASK
    if not 0 <= identifier <= mask:
        raise ValueError(f"CAN identifier 0x{identifier:X} does not fit {29 if extended else 11} bits")
    return identifier | (CAN_EFF_FLAG if extended else 0)


def encode_can_frame(
    identifier: int, data: bytes, *, extended: bool = False, fd: bool = False, remote: bool = False
) -> bytes:
    """Encode one unit of 16 bytes (classic) or 72 bytes (``fd``) in the layout of the log and of SocketCAN.

    Raises:
        ValueError: the identifier or the data do not fit.
    """
    can_id = frame_id(identifier, extended=extended) | (CAN_RTR_FLAG if remote else 0)
    if fd and len(data) not in CANFD_LENGTHS:
        raise ValueError(f"a CAN FD frame cannot carry {len(data)} bytes")
    if not fd and len(data) > 8:
        raise ValueError(f"a classic CAN frame carries 8 bytes, not {len(data)}")
    frame = np.zeros(1, dtype=CANFD_FRAME_DTYPE if fd else CAN_FRAME_DTYPE)
    frame["can_id"] = can_id
    frame["length"] = len(data)
    frame["flags"] = CANFD_FDF if fd else 0
    frame["data"][0, : len(data)] = np.frombuffer(data, dtype=np.uint8)
    return frame.tobytes()


def data_frame(can_id: int, data: bytes, *, is_fd: bool, flags: int = 0, remote_length: int | None = None) -> bytes:
    """Return the unit of a frame that a log of another program describes.

    Args:
        can_id: the identifier with the flag of its format.
        data: of the frame; "" of a remote request.
        is_fd: whether it is an FD frame; ``flags`` are then its `CANFD_BRS` and `CANFD_ESI`.
        remote_length: of a remote request, the length that it asks for.

    Raises:
        ValueError: the identifier or the data do not fit.
    """
    identifier = can_id & ~CAN_EFF_FLAG
    frame_id(identifier, extended=bool(can_id & CAN_EFF_FLAG))
    if remote_length is not None:
        if not 0 <= remote_length <= 8:
            raise ValueError(f"a remote request asks for at most 8 bytes, not {remote_length}")
        return _CLASSIC.pack(can_id | CAN_RTR_FLAG, remote_length, 0, b"")
    if is_fd:
        if len(data) not in CANFD_LENGTHS:
            raise ValueError(f"a CAN FD frame cannot carry {len(data)} bytes")
        return _FD.pack(can_id, len(data), flags | CANFD_FDF, data)
    if len(data) > 8:
        raise ValueError(f"a classic CAN frame carries 8 bytes, not {len(data)}")
    return _CLASSIC.pack(can_id, len(data), 0, data)


def decode_can_frames(units: ByteRows) -> StructArray | None:
    """View units of one length as frames; return None where the length is neither 16 nor 72 bytes."""
    dtype = {CAN_FRAME_BYTES: CAN_FRAME_DTYPE, CANFD_FRAME_BYTES: CANFD_FRAME_DTYPE}.get(units.shape[1])
    if dtype is None:
        return None
    return np.ascontiguousarray(units).view(dtype).reshape(-1)
