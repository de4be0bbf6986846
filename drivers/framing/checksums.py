"""Checksums of the serial protocols, each fast enough to run on every byte that arrives.

Cyclic checksums are linear, so a message followed by its own checksum gives 0: `crc24q` and `crc32_novatel` of a
whole frame are 0 when it is intact. SBF has its checksum in front, lowest byte first, so it must be compared.
"""

from __future__ import annotations

import binascii
import zlib
from functools import cache
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from swath.georef.arrays import ByteArray

Bytes: TypeAlias = bytes | bytearray | memoryview

CRC24Q_POLYNOMIAL = 0x1864CFB  # RTCM 10403.3, 4.1.2 (Qualcomm's)
CRC24Q_STEP_BYTES = 1029  # the longest RTCM3 frame goes through the table at once
CRC24Q_MARKED_BYTES = 2 * CRC24Q_STEP_BYTES
FLETCHER_STEP_BYTES = 8192 + 8  # the longest UBX frame is summed at once


# Shifts in bits, by the bit length of a body's last index: halves of the smallest power of two not below its length.
_FOLDS = [tuple(8 << power for power in reversed(range(places))) for places in range(32)]


def nmea_xor(body: Bytes) -> int:
    """Return the exclusive or of the bytes between ``$`` and ``*`` (NMEA 0183, 5.3).

    The number is folded in halves: after a shift by half its length and an XOR, its low half is the XOR of both halves.
    """
    folded = int.from_bytes(body, "little")
    for shift in _FOLDS[(len(body) - 1).bit_length()] if body else ():
        folded ^= folded >> shift
    return folded & 0xFF


@cache
def _fletcher_weights() -> ByteArray:
    """Return the weights of the last n bytes in the second sum: n … 2, 1, modulo 256."""
    return np.arange(FLETCHER_STEP_BYTES, 0, -1).astype(np.uint8)


@cache
def _fletcher_ones() -> ByteArray:
    return np.ones(FLETCHER_STEP_BYTES, dtype=np.uint8)


def ubx_fletcher(body: Bytes) -> tuple[int, int]:
    """Return CK_A and CK_B over class, id, length and payload (u-blox M8 protocol, 32.4): sums modulo 256, as uint8
    wraps.
    """
    first = second = 0
    view = np.frombuffer(body, dtype=np.uint8)
    for start in range(0, len(view), FLETCHER_STEP_BYTES):
        part = view[start : start + FLETCHER_STEP_BYTES]
        count = len(part)
        second += count * first + int(np.dot(part, _fletcher_weights()[-count:]))
        first += int(np.dot(part, _fletcher_ones()[:count]))
    return first & 0xFF, second & 0xFF


@cache
def _crc24q_table() -> tuple[NDArray[np.uint32], NDArray[np.intp]]:
    """Return the CRC of each byte value followed by k zero bytes, flat over (k descending, value), and the rows'
    offsets.
    """
    row = np.arange(256, dtype=np.uint32) << np.uint32(16)
    for _ in range(8):
        row = (row << np.uint32(1)) ^ np.where(row & np.uint32(0x80_0000), np.uint32(CRC24Q_POLYNOMIAL), np.uint32(0))
    step = row & np.uint32(0xFF_FFFF)
    table = np.empty((CRC24Q_STEP_BYTES, 256), dtype=np.uint32)
    table[-1] = step
    for k in range(CRC24Q_STEP_BYTES - 2, -1, -1):
        after = table[k + 1]  # one more zero byte: the top byte goes through the table
        table[k] = ((after << np.uint32(8)) & np.uint32(0xFF_FFFF)) ^ step[after >> np.uint32(16)]
    return table.reshape(-1), np.arange(CRC24Q_STEP_BYTES, dtype=np.intp) * 256


def crc24q(data: Bytes) -> int:
    """Return the CRC-24Q with initial value 0 (RTCM 10403.3, 4.1.2)."""
    table, offsets = _crc24q_table()
    crc = 0
    for start in range(0, len(data), CRC24Q_STEP_BYTES):
        part = np.frombuffer(data[start : start + CRC24Q_STEP_BYTES], dtype=np.uint8)
        places = offsets[-len(part) :] + part
        for index in range(min(3, len(part)) if crc else 0):  # the register so far overlaps the next three bytes
            places[index] ^= (crc >> (16 - 8 * index)) & 0xFF
        rest = (crc << (8 * len(part))) & 0xFF_FFFF if len(part) < 3 else 0
        crc = int(np.bitwise_xor.reduce(table[places])) ^ rest
    return crc


@cache
def _crc24q_mark_table() -> tuple[NDArray[np.uint32], NDArray[np.intp]]:
    """Return the CRC of each byte value at place k, divided by x⁸ for each byte before it, flat over (k, value), and
    the rows' offsets.
    """
    divided = np.arange(256, dtype=np.uint32)  # low byte of a register, by x⁸
    for _ in range(8):
        divided = (divided ^ (divided & np.uint32(1)) * np.uint32(CRC24Q_POLYNOMIAL)) >> np.uint32(1)
    table = np.empty((CRC24Q_MARKED_BYTES, 256), dtype=np.uint32)
    table[0] = _crc24q_table()[0][-256:]
    for k in range(1, CRC24Q_MARKED_BYTES):
        table[k] = (table[k - 1] >> np.uint32(8)) ^ divided[table[k - 1] & np.uint32(0xFF)]
    return table.reshape(-1), np.arange(CRC24Q_MARKED_BYTES, dtype=np.intp) * 256


def crc24q_marks(data: Bytes) -> NDArray[np.uint32]:
    """Return one number for each place between bytes; ``crc24q(data[a:b]) == 0`` exactly where those at a and b are
    equal.

    The CRC up to a place, divided by x⁸ for every byte before it (the polynomial ends in 1, so that x has an inverse),
    is a sum to which each byte adds its own part, independent of later bytes. The bytes between two places add 0 to
    the sum if and only if their own CRC is 0.

    Args:
        data: at most CRC24Q_MARKED_BYTES bytes.
    """
    table, offsets = _crc24q_mark_table()
    marks = np.zeros(len(data) + 1, dtype=np.uint32)
    part = np.frombuffer(data, dtype=np.uint8)
    np.bitwise_xor.accumulate(table[offsets[: len(part)] + part], out=marks[1:])
    return marks


def crc32_novatel(data: Bytes) -> int:
    """Return NovAtel's CRC-32 (OEM7 manual, 32-bit CRC): the IEEE polynomial reflected, from 0, no final inversion.

    zlib inverts the register before and after; inverting its seed and its result takes both away.
    """
    return zlib.crc32(data, 0xFFFF_FFFF) ^ 0xFFFF_FFFF


def crc16_ccitt(data: Bytes) -> int:
    """Return the CRC-16 of SBF (PolaRx5TR reference guide, 4.1.1): x¹⁶ + x¹² + x⁵ + 1 from 0, high bit first, no
    inversion.
    """
    return binascii.crc_hqx(data, 0)
