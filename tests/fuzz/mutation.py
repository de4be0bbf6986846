"""Damages bytes: numbers at their limits break most decoders, so these are laid over fields."""

from __future__ import annotations

import random
import struct

LARGEST_CASE_BYTES = 24 * 1024

_BITS = (7, 8, 15, 16, 31, 32, 53, 63, 64)
_WHOLE = sorted({value for bits in _BITS for value in ((1 << bits) - 1, 1 << bits, (1 << bits) - 2)} | {0, 1, 2, 100})
_FLOATS = (0.0, -0.0, 1.0, -1.0, 1e300, -1e300, 1e38, -3.4e38, 1e-310, 1e19, -1e19, float("inf"), float("-inf"))
_NANS = (struct.pack("<Q", 0x7FF0_0000_0000_0001), struct.pack("<d", float("nan")), struct.pack("<I", 0x7F80_0001))


def bounds(rng: random.Random) -> bytes:
    """Draw a number at the limit of some type: whole or float, 1 to 8 bytes, either byte order, or a NaN."""
    kind = rng.randrange(8)
    if kind == 0:
        return rng.choice(_NANS)
    if kind < 3:
        value = rng.choice(_FLOATS)
        try:
            packed = struct.pack(rng.choice("fd"), value)
        except OverflowError:
            packed = struct.pack("d", value)
        return packed if rng.random() < 0.8 else packed[::-1]
    width = rng.choice((1, 1, 2, 2, 4, 4, 8))
    whole = rng.choice(_WHOLE) & ((1 << 8 * width) - 1)
    if rng.random() < 0.2:
        whole = (1 << 8 * width) - 1 - whole
    return whole.to_bytes(width, rng.choice(("little", "little", "big")))


def damage(rng: random.Random, data: bytes, *, resize: bool = True, start: int = 0) -> bytes:
    """Make one to six changes at places from ``start`` on; without ``resize`` the length stays."""
    changed = bytearray(data)
    for _ in range(1 + int(5 * rng.random() ** 2)):
        if len(changed) <= start:
            return bytes(changed) + (rng.randbytes(rng.randrange(8)) if resize else b"")
        at = rng.randrange(start, len(changed))
        kind = rng.randrange(9 if resize else 6)
        if kind < 3:
            _overlay(changed, at, bounds(rng))
        elif kind == 3:
            changed[at] ^= 1 << rng.randrange(8)
        elif kind == 4:
            _overlay(changed, at, rng.randbytes(rng.choice((1, 2, 4, 8, 40))))
        elif kind == 5:
            other = rng.randrange(start, len(changed))
            _overlay(changed, at, bytes(changed[other : other + rng.choice((1, 2, 4, 8, 32))]))
        elif kind == 6:
            del changed[at : at + rng.choice((1, 2, 4, 8, 64, 1000))]
        elif kind == 7:
            changed[at:at] = rng.choice(
                (bounds(rng), rng.randbytes(rng.randrange(1, 40)), bytes(changed[at : at + 64]))
            )
        else:
            changed[at:at] = changed[at : at + rng.randrange(1, 9)] * rng.choice((2, 8, 64))
    return bytes(changed[:LARGEST_CASE_BYTES])


def _overlay(data: bytearray, at: int, piece: bytes) -> None:
    end = min(len(data), at + len(piece))
    data[at:end] = piece[: end - at]
