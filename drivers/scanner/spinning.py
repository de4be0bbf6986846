"""Common parts of packets of spinning heads of all makers: firings of one return mode, with one to three returns."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from swath.drivers.scanner.rows.slots import (
    BLOCK_SLOTS,
    Chosen,
    Fill,
    FlagRule,
    ReturnSlots,
    common_words,
    in_order,
    returns_table,
)
from swath.georef.arrays import FloatArray, Int64Array, StructArray

# A return as one 32-bit number: range, reflectivity, and its block's number of the firing's. ``strength`` omits the
# range.
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
        returns: (packets, blocks, places), fields ``range`` and ``reflectivity``; several returns of a firing are in
            neighbouring blocks.
        range_unit_m: metres of one unit of range.
        host_time_ns: (packets,) host time of each packet.
        number: (packets,) running number of each packet.
        most: maximum number of firings in a packet, the step between the pulse ids of packets.
        device_time_ns: makes the time of each firing from arrays (packets · rounds, 1), (1, lasers) or both, as
            `ReturnSlots.per_pulse` does.
        azimuth_rad: makes the azimuth of each firing in the same way.
        channel: (lasers,) channels of a round.
        flags: flags of all returns.
        echoes: number of blocks that a firing's returns take: 1, 2 or 3.
        names: where there are several, whether one of them is the strongest and whether one is the last return.
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
    echoes: int = 1
    names: tuple[bool, bool] = (False, False)

    def slots(self) -> ReturnSlots:
        """Return the slots of these firings."""
        content = _CONTENT_OF[self.echoes](self.returns)
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
            rule=None if self.echoes == 1 else FlagRule(_strength, *self.names),
        )


def returns_of_packets(
    mode: NDArray[np.integer], most: int, firings_of: Callable[[slice], Firings], fill: Fill
) -> StructArray:
    """Decode the returns of all packets in order, in blocks of one return mode.

    Args:
        mode: (n,) return mode of each packet, and what else is one for a block.
        most: maximum number of returns in a packet.
        firings_of: makes the firings of a slice of the packets.
        fill: writes their rows.
    """
    table = returns_table(len(mode) * most)
    filled = 0
    for part in parts_of(mode, most):
        filled += fill(firings_of(part).slots(), table[filled:])
    return table[:filled]


def parts_of(mode: NDArray[np.integer], most: int) -> Iterator[slice]:
    """Divide packets into blocks of one return mode; see `returns_of_packets`."""
    edges = [0, *(np.flatnonzero(mode[1:] != mode[:-1]) + 1).tolist(), len(mode)]
    for start, stop in pairwise(edges):
        for at in range(start, stop, BLOCK_SLOTS // most):
            yield slice(at, min(at + BLOCK_SLOTS // most, stop))


def single_content(returns: StructArray) -> StructArray:
    """Convert single returns (packets, blocks, lasers) to slots (firings, 1)."""
    return _as_numbers(returns).view(_CONTENT).reshape(-1, 1)


def pair_content(returns: StructArray) -> StructArray:
    """Convert dual returns (packets, blocks, lasers), a pair in neighbouring blocks, to slots (firings, 2) by rising
    range.

    Equal ranges are one return, the first block's. The return of greater reflectivity is the stronger, the second
    block's where they are equal, since a head sends the second strongest beside a strongest that is also the other.
    """
    one, other = _as_numbers(returns[:, 0::2]), _as_numbers(returns[:, 1::2], block=1)
    other *= one ^ other > 0xFFFF
    return in_order(one, other).view(_CONTENT)


def triple_content(returns: StructArray) -> StructArray:
    """Convert triple returns (packets, blocks, lasers), three in neighbouring blocks, to slots (firings, 3) by rising
    range.

    Equal ranges are one return, that of the latest block, which is the one that names the strongest.
    """
    one, two, three = (_as_numbers(returns[:, at::3], at) for at in range(3))
    one *= (one ^ two > 0xFFFF) & (one ^ three > 0xFFFF)
    two *= two ^ three > 0xFFFF
    slots = np.empty((len(one), 3), dtype=np.uint32)
    near, far = np.minimum(one, two), np.maximum(one, two)
    np.minimum(near, three, out=slots[:, 0])
    middle = np.maximum(near, three)
    np.minimum(middle, far, out=slots[:, 1])
    np.maximum(middle, far, out=slots[:, 2])
    return slots.view(_CONTENT)


_CONTENT_OF = {1: single_content, 2: pair_content, 3: triple_content}


def _as_numbers(returns: StructArray, block: int = 0) -> NDArray[np.uint32]:
    """Pack each return as `_CONTENT` into one number, flat; sorting numbers takes half as long as writing fields."""
    number = returns["range"].astype(np.uint32).reshape(-1)
    strength = returns["reflectivity"].astype(np.uint16).reshape(-1)
    number <<= 16
    strength <<= 8
    strength |= block
    number |= strength
    return number


def _strength(returns: StructArray) -> NDArray[np.uint16]:
    strength: NDArray[np.uint16] = returns["strength"]
    return strength
