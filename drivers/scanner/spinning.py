"""Common parts of packets of spinning heads of all makers: firings of one return mode, single or in pairs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from swath.drivers.scanner.rows.slots import (
    BLOCK_SLOTS,
    Chosen,
    Fill,
    PairRule,
    ReturnSlots,
    common_words,
    in_order,
    returns_table,
)
from swath.georef.arrays import ByteArray, FloatArray, Int64Array, StructArray

# A return as one 32-bit number: range, reflectivity, and 1 for a pair's second. ``strength`` omits the range.
_CONTENT = np.dtype(
    {
        "names": ["strength", "intensity", "range"],
        "formats": ["<u2", "u1", "<u2"],
        "offsets": [0, 1, 2],
        "itemsize": 4,
    }
)


@dataclass(slots=True)
class Firings:
    """The firings of consecutive packets of one return mode, in order: rounds of all lasers.

    Attributes:
        returns: (packets, blocks, places), fields ``range`` and ``reflectivity``; in dual return a firing's first and
            second return are in neighbouring blocks.
        range_unit_m: metres of one unit of range.
        host_time_ns: (packets,) host time of each packet.
        number: (packets,) running number of each packet.
        most: maximum number of firings in a packet, the step between the pulse ids of packets.
        device_time_ns: makes the time of each firing from arrays (packets · rounds, 1), (1, lasers) or both, as
            `ReturnSlots.per_pulse` does.
        azimuth_rad: makes the azimuth of each firing in the same way.
        channel: (lasers,) channels of a round.
        flags: flags of all returns.
        pair: in dual return, whether one of the two is the strongest and whether one is the last return; else None.
    """

    returns: StructArray
    range_unit_m: float
    host_time_ns: Int64Array
    number: Int64Array
    most: int
    device_time_ns: Callable[[Chosen], Int64Array]
    azimuth_rad: Callable[[Chosen], FloatArray]
    channel: NDArray[np.uint16]
    flags: int
    pair: tuple[bool, bool] | None

    def slots(self) -> ReturnSlots:
        """Return the slots of these firings."""
        content = single_content(self.returns) if self.pair is None else pair_content(self.returns)
        packets, lasers = len(self.number), len(self.channel)
        rounds = len(content) // (packets * lasers)
        host_time_ns = np.repeat(self.host_time_ns, rounds)[:, np.newaxis]
        return ReturnSlots(
            content=content,
            range_unit_m=self.range_unit_m,
            common=common_words((1, lasers), channel=self.channel, flags=self.flags),
            shape=(packets * rounds, lasers),
            pulse_id=((self.number * self.most)[:, np.newaxis] + np.arange(rounds) * lasers).reshape(-1),
            per_pulse={
                "host_time_ns": lambda at: at(host_time_ns),
                "device_time_ns": self.device_time_ns,
                "encoder_rad": self.azimuth_rad,
            },
            pair=None if self.pair is None else PairRule(_strength, *self.pair),
        )


def returns_of_packets(mode: ByteArray, most: int, firings_of: Callable[[slice], Firings], fill: Fill) -> StructArray:
    """Decode the returns of all packets in order, in blocks of one return mode.

    Args:
        mode: (n,) return mode of each packet.
        most: maximum number of returns in a packet.
        firings_of: makes the firings of a slice of the packets.
        fill: writes their rows.
    """
    edges = [0, *(np.flatnonzero(mode[1:] != mode[:-1]) + 1).tolist(), len(mode)]
    table = returns_table(len(mode) * most)
    filled = 0
    for start, stop in pairwise(edges):
        for at in range(start, stop, BLOCK_SLOTS // most):
            part = slice(at, min(at + BLOCK_SLOTS // most, stop))
            filled += fill(firings_of(part).slots(), table[filled:])
    return table[:filled]


def single_content(returns: StructArray) -> StructArray:
    """Convert single returns (packets, blocks, lasers) to slots (firings, 1)."""
    return _as_numbers(returns).view(_CONTENT).reshape(-1, 1)


def pair_content(returns: StructArray) -> StructArray:
    """Convert dual returns (packets, blocks, lasers), a pair in neighbouring blocks, to slots (firings, 2) by rising
    range.

    Equal ranges are one return, the first block's. The return of greater reflectivity is the stronger, the second
    block's where they are equal, since a head sends the second strongest beside a strongest that is also the other.
    """
    one, other = _as_numbers(returns[:, 0::2]), _as_numbers(returns[:, 1::2], second=1)
    other *= one ^ other > 0xFFFF
    return in_order(one, other).view(_CONTENT)


def _as_numbers(returns: StructArray, second: int = 0) -> NDArray[np.uint32]:
    """Pack each return as `_CONTENT` into one number, flat; sorting numbers takes half as long as writing fields."""
    number = returns["range"].astype(np.uint32).reshape(-1)
    strength = returns["reflectivity"].astype(np.uint16).reshape(-1)
    number <<= 16
    strength <<= 8
    strength |= second
    number |= strength
    return number


def _strength(returns: StructArray) -> NDArray[np.uint16]:
    strength: NDArray[np.uint16] = returns["strength"]
    return strength
