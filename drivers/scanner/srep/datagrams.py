"""SREP datagrams as received: blocks of equal length; lengths alternate like those of a scan."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain

import numpy as np
from fastcrc.crc32 import iso_hdlc as crc32

from swath.drivers.scanner.srep.layout import CRC, FLAG_PPS_LOCKED, HEADER_BYTES, HEADER_DTYPE, body_words, nanoseconds
from swath.georef.arrays import BoolArray, Int64Array, StructArray, UInt64Array
from swath.georef.records import DEVICE_CLOCK_DTYPE, ByteRows


@dataclass(frozen=True, slots=True)
class Datagrams:
    """Consecutive datagrams of any lengths.

    Attributes:
        host_time_ns: (n,) host time of each.
        blocks: uint8, (mᵢ, lengthᵢ) each and possibly strided, n rows together; each has at least one row.
    """

    host_time_ns: Int64Array
    blocks: Sequence[ByteRows]

    def __len__(self) -> int:
        return len(self.host_time_ns)

    def lengths(self) -> Int64Array:
        """Return (n,) bytes of each datagram."""
        lengths = np.array([block.shape[1] for block in self.blocks], dtype=np.int64)
        return lengths.repeat([len(block) for block in self.blocks])

    def where(self, wanted: BoolArray) -> Datagrams:
        """Return the wanted datagrams, (n,); data are not copied where all are wanted."""
        if wanted.all():
            return self
        blocks, first = [], 0
        for block in self.blocks:
            part = wanted[first : first + len(block)]
            first += len(block)
            if part.any():
                blocks.append(block[part])
        return Datagrams(self.host_time_ns[wanted], blocks)

    def headers(self) -> StructArray:
        """Return (n,) `HEADER_DTYPE`, of datagrams that are long enough."""
        if not self.blocks:
            return np.empty(0, dtype=HEADER_DTYPE)
        return np.concatenate([block[:, :HEADER_BYTES] for block in self.blocks]).view(HEADER_DTYPE)[:, 0]

    def agree_with_crc(self) -> BoolArray:
        """Return (n,) True where the last four bytes are the CRC of all bytes before."""
        if not self.blocks:
            return np.empty(0, dtype=np.bool_)
        stated = np.concatenate([block[:, -CRC.size :] for block in self.blocks]).view("<u4")[:, 0]
        found = chain.from_iterable(map(crc32, block[:, : -CRC.size]) for block in self.blocks)
        agree: BoolArray = np.fromiter(found, np.uint32, len(self)) == stated
        return agree

    def bodies(self) -> UInt64Array:
        """Return pulse records of all datagrams, one behind the other, in words: `body_words` of each datagram."""
        bodies = [block[:, HEADER_BYTES : -CRC.size] for block in self.blocks]
        words = np.empty(sum(body.size for body in bodies) // 8, dtype="<u8")
        data, at = words.view(np.uint8), 0
        for body in bodies:
            # row by row: copying field by field takes ten times as long
            data[at : at + body.size].reshape(body.shape)[:] = body
            at += body.size
        return words


def clock_samples(host_time_ns: Int64Array, header: StructArray, words: UInt64Array) -> StructArray:
    """Return `DEVICE_CLOCK_DTYPE` rows (n,), one a datagram: the counter at its last pulse and the latched counter.

    Args:
        host_time_ns, header: (n,) host times and headers of the datagrams.
        words: their `Datagrams.bodies`.
    """
    rows = np.empty(len(header), dtype=DEVICE_CLOCK_DTYPE)
    last_ticks = header["first_ticks"].copy()
    fired = header["pulses"] > 0
    last_pulse = np.cumsum(body_words(header)) - 1 - header["return_slots"]
    last_ticks[fired] += words[last_pulse[fired]] & np.uint64(0xFFFF_FFFF)  # its first four bytes
    latched = header["pps_count"] > 0
    rows["host_time_ns"] = host_time_ns
    rows["device_time_ns"] = nanoseconds(last_ticks, header["tick_hz"])
    rows["pps_time_ns"] = np.where(latched, nanoseconds(header["pps_ticks"], header["tick_hz"]), -1)
    rows["pps_count"] = header["pps_count"]
    rows["locked"] = header["flags"] & FLAG_PPS_LOCKED
    return rows
