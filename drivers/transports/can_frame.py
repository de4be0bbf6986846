"""Linux's CAN frames, the unit of a CAN channel: `struct can_frame` (16 bytes) and `struct canfd_frame` (72).

<linux/can.h>: can_id u32 with its flags, len u8, flags u8 (FD only), two reserved bytes, 8 or 64 bytes of data;
little-endian.
"""

from __future__ import annotations

import struct

import can

from swath.drivers.can_frames import (
    CAN_EFF_FLAG,
    CAN_EFF_MASK,
    CAN_ERR_FLAG,
    CAN_FRAME_BYTES,
    CAN_RTR_FLAG,
    CAN_SFF_MASK,
    CANFD_BRS,
    CANFD_FDF,
    CANFD_FRAME_BYTES,
)

HEADER = struct.Struct("<IBBxx")
ERROR_BUS_OFF = 0x40  # <linux/can/error.h>, CAN_ERR_BUSOFF, in the identifier of an error frame
FD_ERROR_STATE = 0x02  # CANFD_ESI


def pack_frame(message: can.Message) -> bytes:
    """The frame of a python-can message: 16 bytes, or 72 for CAN FD.

    Raises:
        ValueError: the message does not fit a frame (its identifier or its length).
    """
    flags = (
        (CAN_EFF_FLAG if message.is_extended_id else 0)
        | (CAN_RTR_FLAG if message.is_remote_frame else 0)
        | (CAN_ERR_FLAG if message.is_error_frame else 0)
    )
    largest = CAN_EFF_MASK if message.is_extended_id or message.is_error_frame else CAN_SFF_MASK
    data = b"" if message.is_remote_frame else bytes(message.data)
    length = message.dlc if message.is_remote_frame else len(data)
    if not 0 <= message.arbitration_id <= largest or not 0 <= length <= (64 if message.is_fd else 8):
        raise ValueError(f"no CAN frame: identifier {message.arbitration_id:#x}, {length} bytes")
    if not message.is_fd:
        return HEADER.pack(message.arbitration_id | flags, length, 0) + data.ljust(8, b"\0")
    fd_flags = (
        CANFD_FDF
        | (CANFD_BRS if message.bitrate_switch else 0)
        | (FD_ERROR_STATE if message.error_state_indicator else 0)
    )
    return HEADER.pack(message.arbitration_id | flags, length, fd_flags) + data.ljust(64, b"\0")


def unpack_frame(frame: bytes) -> can.Message:
    """The python-can message of a frame; its time stamp is 0.

    Raises:
        ValueError: not 16 or 72 bytes, or a length field beyond the data.
    """
    if len(frame) not in (CAN_FRAME_BYTES, CANFD_FRAME_BYTES):
        raise ValueError(f"a CAN frame has {CAN_FRAME_BYTES} or {CANFD_FRAME_BYTES} bytes, not {len(frame)}")
    identifier, length, fd_flags = HEADER.unpack_from(frame)
    if length > len(frame) - HEADER.size:
        raise ValueError(f"a CAN frame of {len(frame)} bytes cannot hold {length} bytes of data")
    extended, error = bool(identifier & CAN_EFF_FLAG), bool(identifier & CAN_ERR_FLAG)
    is_fd, remote = len(frame) == CANFD_FRAME_BYTES, bool(identifier & CAN_RTR_FLAG)
    return can.Message(
        arbitration_id=identifier & (CAN_EFF_MASK if extended or error else CAN_SFF_MASK),
        is_extended_id=extended,
        is_remote_frame=remote,
        is_error_frame=error,
        is_fd=is_fd,
        bitrate_switch=is_fd and bool(fd_flags & CANFD_BRS),
        error_state_indicator=is_fd and bool(fd_flags & FD_ERROR_STATE),
        dlc=length,
        data=None if remote else frame[HEADER.size : HEADER.size + length],
    )
