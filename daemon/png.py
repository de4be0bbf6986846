"""Writes pictures as PNG (ISO/IEC 15948) for programs that need no plots and have to start quickly."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

_INDEXED, _RGBA = 3, 6  # types of colour


def png(pixels: NDArray[np.uint8], palette: Sequence[int] = ()) -> bytes:
    """Return a PNG.

    Args:
        pixels: (rows, columns, 4) red, green, blue and opacity; or (rows, columns) places in a palette.
        palette: colours as 0xRRGGBB, of which the first is clear.
    """
    rows, columns = pixels.shape[:2]
    lines = np.zeros((rows, 1 + pixels[0].size), np.uint8)  # each line begins with the number of its filter: 0
    lines[:, 1:] = pixels.reshape(rows, -1)
    head = struct.pack(">IIBBBBB", columns, rows, 8, _INDEXED if palette else _RGBA, 0, 0, 0)
    pieces = [(b"IHDR", head)]
    if palette:
        pieces += [(b"PLTE", b"".join(colour.to_bytes(3, "big") for colour in palette)), (b"tRNS", b"\0")]
    pieces += [(b"IDAT", zlib.compress(lines.tobytes(), 1)), (b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data)) for kind, data in pieces
    )
