"""Makes logs of CAN buses in the forms of other programs, for tests."""

from __future__ import annotations

import struct
import zlib

ASC_HEAD = "date Tue Nov 14 11:13:20.125 pm 2023\nbase hex  timestamps absolute\ninternal events logged\n// version 9\n"
ASC_LINES = """Begin Triggerblock Die Nov 14 11:13:20.125 pm 2023
   0.000000 Start of measurement
   0.015991 CAN 1 Status:chip status error active
   0.5000001 1  123             Rx   d 2 0A FF  Length = 0 BitCount = 0 ID = 291
   0.600000 2  18FF50E5x       Tx   d 0
   0.700000 1  123             Rx   r 4
   0.710000 1  123             TxRq d 1 00
   0.720000 1  ErrorFrame
   0.800000 CANFD   1 Rx  18EBFF00x  Some_Name  1 0 9 12 00 01 02 03 04 05 06 07 08 09 0A 0B 0 0 3000 0 0 0 0 0
   0.900000 CANFD   2 Rx        300  1 1 1  1 07 0 0 7000 0 0 0 0 0
   1.000000 CANFD   2 Rx        300  0 0 2  2 07 08 0 0 0 0 0 0 0 0
   1.100000 1  Statistic: D 0 R 0 XD 1 XR 0 E 0 O 0 B 0.00%
   1.200000 1  12G             Rx   d 1 00
   1.300000 1  123             Rx   d 3 00 11
End TriggerBlock
"""


TRC_HEAD = ";$FILEVERSION={}\n;$STARTTIME=45244.9675925926;\n;$COLUMNS={}\n;---+-- ----+---- --+--\n"

BLF_CLASSIC = struct.pack("<HBBI8s", 3, 0, 2, 0x98FF50E5, b"\1\2")
BLF_REMOTE = struct.pack("<HBBI8s", 1, 0x80, 4, 0x123, b"")
BLF_CLASSIC_64 = struct.pack("<BBBBLLLLLLLHBBL", 1, 2, 2, 0, 0x123, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0) + b"\7\10"
BLF_FD_64 = struct.pack("<BBBBLLLLLLLHBBL", 2, 9, 12, 0, 0x123, 0, 0x7000, 0, 0, 0, 0, 0, 0, 0, 0) + bytes(range(12))
BLF_FD_CUT = struct.pack("<BBBBLLLLLLLHBBL", 2, 9, 12, 0, 0x123, 0, 0x1000, 0, 0, 0, 0, 0, 0, 76, 0) + b"abcdmore"


def blf_object(kind: int, body: bytes, time: tuple[int, int] = (2, 0), version: int = 1) -> bytes:
    """Return an object with its header and the bytes that fill it up."""
    head = struct.pack("<I4xQ", *time) + (bytes(8) if version == 2 else b"")
    size = 16 + len(head) + len(body)
    return struct.pack("<4sHHII", b"LOBJ", 16 + len(head), version, size, kind) + head + body + bytes(size % 4)


def blf_container(data: bytes, method: int = 2) -> bytes:
    packed = zlib.compress(data) if method == 2 else data
    size = 32 + len(packed)
    head = struct.pack("<4sHHII", b"LOBJ", 16, 1, size, 10) + struct.pack("<H6xI4x", method, len(data))
    return head + packed + bytes(size % 4)


def blf_file(*objects: bytes, start: tuple[int, ...] = (2023, 11, 2, 14, 23, 13, 20, 500)) -> bytes:
    return struct.pack("<4sI32x8H", b"LOGG", 144, *start).ljust(144, b"\0") + b"".join(objects)
