"""What packets of spinning heads have in common, whoever made them: firings of one return mode, single or in pairs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.scanner.beams import FloatArray
from drivers.scanner.slots import BLOCK_SLOTS, ReturnSlots, common_words, returns_table
from georef.records import RETURN_FLAG_LAST, RETURN_FLAG_STRONGEST, Int64Array, StructArray


@dataclass(slots=True)
class Firings:
    """The firings of consecutive packets of one return mode, in order.

    Attributes:
        returns: (packets, blocks, lasers), fields ``range`` and ``reflectivity``; in dual return a firing's first and
            second return are in neighbouring blocks.
        range_unit_m: metres of one unit of range.
        host_time_ns: (packets,).
        number: (packets,) running number of each packet.
        most: firings a packet holds at most: packets' pulse ids are so far apart.
        device_time_ns: of each firing, the sum of these arrays, each (packets, firings), (packets, 1) or (1, firings).
        azimuth_rad: of each firing, (packets, …).
        channel: (lasers,) of a group of firings, which repeats.
        flags: of all returns.
        pair: in dual return, whether one of the two is the strongest and whether one is the last return; else None.
    """

    returns: StructArray
    range_unit_m: float
    host_time_ns: Int64Array
    number: Int64Array
    most: int
    device_time_ns: tuple[Int64Array, ...]
    azimuth_rad: FloatArray
    channel: NDArray[np.uint16]
    flags: int
    pair: tuple[bool, bool] | None

    def slots(self) -> ReturnSlots:
        """Their places for returns."""
        per_slot: dict[str, NDArray[Any]] = {}
        if self.pair is None:
            range_raw = self.returns["range"].reshape(1, -1)
            reflectivity = self.returns["reflectivity"].reshape(1, -1)
        else:
            range_raw, reflectivity, flags = pair_slots(self.returns, *self.pair)
            per_slot["flags"] = flags | np.uint8(self.flags)
        packets = len(self.number)
        firing = np.arange(range_raw.shape[1] // packets)
        shape = (packets, len(firing))
        return ReturnSlots(
            range_raw=range_raw,
            range_unit_m=self.range_unit_m,
            intensity=reflectivity,
            common=common_words((1, len(firing)), channel=self.channel[firing % len(self.channel)], flags=self.flags),
            shape=shape,
            per_pulse={
                "host_time_ns": (self.host_time_ns[:, np.newaxis],),
                "device_time_ns": self.device_time_ns,
                "encoder_rad": (self.azimuth_rad.reshape(shape),),
                "pulse_id": ((self.number * self.most)[:, np.newaxis], firing[np.newaxis]),
            },
            per_slot=per_slot,
        )


def returns_of_packets(mode: NDArray[np.uint8], most: int, firings_of: Callable[[slice], Firings]) -> StructArray:
    """Returns of all packets in order, worked on in blocks of one return mode.

    Args:
        mode: (n,) return mode of each packet.
        most: returns a packet holds at most.
        firings_of: makes the firings of a slice of the packets.
    """
    edges = [0, *(np.flatnonzero(mode[1:] != mode[:-1]) + 1).tolist(), len(mode)]
    table = returns_table(len(mode) * most)
    filled = 0
    for start, stop in pairwise(edges):
        for at in range(start, stop, BLOCK_SLOTS // most):
            part = slice(at, min(at + BLOCK_SLOTS // most, stop))
            filled += firings_of(part).slots().fill(table[filled:])
    return table[:filled]


def pair_slots(
    returns: StructArray, names_strongest: bool, names_last: bool
) -> tuple[NDArray[np.uint16], NDArray[np.uint8], NDArray[np.uint8]]:
    """Dual returns as slots (2, pulses): range, reflectivity and flags.

    Equal ranges are one return, the only one: strongest and last. Of two the nearer comes first. Where the pair holds
    the last return it is the farther; where it holds the strongest, that is the one of greater reflectivity (the second
    block's where they are equal), since a head puts the second strongest beside a strongest that is also the other.

    Args:
        returns: (packets, blocks, lasers), a pair in neighbouring blocks, range 0 = no return.
        names_strongest: one of the two is the strongest return.
        names_last: one of the two is the last return.
    """
    one, other = (returns["range"][:, at::2].reshape(-1) for at in (0, 1))
    one_light, other_light = (returns["reflectivity"][:, at::2].reshape(-1) for at in (0, 1))
    # choices are multiplications by 0 or 1: np.where takes ten times as long on conditions that keep changing
    other_is_far = other > one
    near, far = np.minimum(one, other), np.maximum(one, other)
    swap = (one_light ^ other_light) * other_is_far
    near_light, far_light = other_light ^ swap, one_light ^ swap
    two = (near > 0) & (near != far)
    near_strongest = (near_light > far_light) | ((near_light == far_light) & ~other_is_far)
    alone = np.uint8(RETURN_FLAG_STRONGEST | RETURN_FLAG_LAST)
    strongest, last = np.uint8(RETURN_FLAG_STRONGEST * names_strongest), np.uint8(RETURN_FLAG_LAST * names_last)
    ranges, (lights, flags) = np.empty((2, len(one)), np.uint16), np.empty((2, 2, len(one)), np.uint8)
    ranges[0], ranges[1] = near + far * (near == 0), far * two
    lights[0], lights[1] = far_light ^ (near_light ^ far_light) * two, far_light
    flags[0] = near_strongest * two * strongest + ~two * alone
    flags[1] = last + ~near_strongest * strongest
    return ranges, lights, flags
