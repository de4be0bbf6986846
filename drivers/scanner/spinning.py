"""What packets of spinning heads have in common, whoever made them: firings of one return mode, single or in pairs."""

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
from swath.georef.arrays import FloatArray
from swath.georef.records import Int64Array, StructArray

# A return as one 32-bit number: range, reflectivity, and 1 for a pair's second. ``strength`` is all but the range.
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
        host_time_ns: (packets,).
        number: (packets,) running number of each packet.
        most: firings a packet holds at most: packets' pulse ids are so far apart.
        device_time_ns: of each firing, made of arrays (packets · rounds, 1), (1, lasers) or of both, as
            `ReturnSlots.per_pulse` is.
        azimuth_rad: of each firing, likewise.
        channel: (lasers,) of a round.
        flags: of all returns.
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
        """Return their places for returns."""
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


def returns_of_packets(
    mode: NDArray[np.uint8], most: int, firings_of: Callable[[slice], Firings], fill: Fill
) -> StructArray:
    """Return returns of all packets in order, worked on in blocks of one return mode.

    Args:
        mode: (n,) return mode of each packet.
        most: returns a packet holds at most.
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
    """Single returns (packets, blocks, lasers) as slots (firings, 1)."""
    return _as_numbers(returns).view(_CONTENT).reshape(-1, 1)


def pair_content(returns: StructArray) -> StructArray:
    """Return dual returns (packets, blocks, lasers), a pair in neighbouring blocks, as slots (firings, 2) of rising
    range.

    Equal ranges are one return, the first block's. The one of greater reflectivity is the stronger, the second block's
    where they are equal, since a head puts the second strongest beside a strongest that is also the other.
    """
    one, other = _as_numbers(returns[:, 0::2]), _as_numbers(returns[:, 1::2], second=1)
    other *= one ^ other > 0xFFFF
    return in_order(one, other).view(_CONTENT)


def _as_numbers(returns: StructArray, second: int = 0) -> NDArray[np.uint32]:
    """Return returns as `_CONTENT` in one number each, flat; to put them together takes half as long as to write
    fields.
    """
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
