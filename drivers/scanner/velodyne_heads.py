"""Velodyne heads: how the lasers of a model are fired and where they point."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.scanner.beams import BeamTable, beam_table


@dataclass(frozen=True)
class SpinningHead:
    """One model.

    Attributes:
        name: as the maker writes it.
        product_id: second factory byte of its data packets.
        range_unit_m: metres of one unit of distance.
        channel: (32,) laser of each place in a data block.
        offset_ns: (32,) firing time of each place after the block's time.
        block_ns: from the time of one block's azimuth to the next one's.
        beams: design values of its lasers.
    """

    name: str
    product_id: int
    range_unit_m: float
    channel: NDArray[np.uint16]
    offset_ns: NDArray[np.int64]
    block_ns: int
    beams: BeamTable


_PLACES = np.arange(32)

# VLP-16 User Manual 63-9243 rev. D: distances in 2 mm (9.3.1.3); vertical angles and vertical corrections by laser id
# (table 9-1); 16 lasers 2.304 µs apart, then 18.43 µs of recharge, a sequence each 55.296 µs, two sequences in a data
# block (9.4, figure 9-9); product id 0x22 (table 9-2).
VLP16 = SpinningHead(
    name="VLP-16",
    product_id=0x22,
    range_unit_m=0.002,
    channel=(_PLACES % 16).astype(np.uint16),
    offset_ns=(_PLACES // 16) * 55_296 + (_PLACES % 16) * 2_304,
    block_ns=2 * 55_296,
    beams=beam_table(
        [-15, 1, -13, 3, -11, 5, -9, 7, -7, 9, -5, 11, -3, 13, -1, 15],
        up_m=1e-3
        * np.array([11.2, -0.7, 9.7, -2.2, 8.1, -3.7, 6.6, -5.1, 5.1, -6.6, 3.7, -8.1, 2.2, -9.7, 0.7, -11.2]),
    ),
)
