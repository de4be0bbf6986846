"""Velodyne heads: firing order and beam directions of each model. A further model is an entry here."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from swath.drivers.scanner.beams import BeamTable, beam_table, numbers
from swath.georef.arrays import Int64Array

BLOCKS = 12  # blocks of a data packet
PLACES = 32  # places of a block
PACKET_BYTES = 1206


@dataclass(frozen=True)
class SpinningHead:
    """One model of head.

    Blocks that carry one azimuth are a group: one block, or one for each bank of lasers. In dual return every block
    appears twice, and blocks that do not fill a group are empty.

    Attributes:
        name: the maker's name of it.
        product_ids: second factory byte of its data packets.
        range_unit_m: metres of one unit of distance.
        channel: (places,) laser of each place in a group.
        offset_ns: (places,) firing time of each place after the group's first.
        group_ns: time from one group's azimuth to the next one's.
        beams: design values of its lasers.
        stamp_ns: the first firing's time less the packet's stamp.
        block_flags: first two bytes of the blocks of a group.
    """

    name: str
    product_ids: tuple[int, ...]
    range_unit_m: float
    channel: NDArray[np.uint16]
    offset_ns: Int64Array
    group_ns: int
    beams: BeamTable
    stamp_ns: int = 0
    block_flags: tuple[int, ...] = (0xEEFF,)  # FF EE on the wire

    def groups(self, *, dual: bool) -> int:
        """Return the number of groups in a packet."""
        return BLOCKS // (len(self.block_flags) * (2 if dual else 1))

    @property
    def packet_bytes_per_ns(self) -> float:
        """Bytes of data packets per nanosecond in dual return, the most that it sends."""
        return PACKET_BYTES / (self.group_ns * self.groups(dual=True))

    def used_block_flags(self, *, dual: bool) -> NDArray[np.uint16]:
        """Return the flags of a packet's blocks, one for each block in use."""
        group = np.repeat(np.array(self.block_flags, dtype=np.uint16), 2 if dual else 1)
        return np.tile(group, self.groups(dual=dual))


_PLACES = np.arange(PLACES)

# VLP-16 User Manual 63-9243 rev. D: distances in 2 mm (9.3.1.3); vertical angles and vertical corrections by laser id
# (table 9-1); 16 lasers 2.304 µs apart, then 18.43 µs of recharge, a sequence each 55.296 µs, two sequences in a data
# block (9.4, figure 9-9); product ids 0x22, and 0x23 of the Puck LITE, which differs in weight only (table 9-2).
VLP16 = SpinningHead(
    name="VLP-16",
    product_ids=(0x22, 0x23),
    range_unit_m=0.002,
    channel=(_PLACES % 16).astype(np.uint16),
    offset_ns=(_PLACES // 16) * 55_296 + (_PLACES % 16) * 2_304,
    group_ns=2 * 55_296,
    beams=beam_table(
        [-15, 1, -13, 3, -11, 5, -9, 7, -7, 9, -5, 11, -3, 13, -1, 15],
        up_m=1e-3
        * np.array([11.2, -0.7, 9.7, -2.2, 8.1, -3.7, 6.6, -5.1, 5.1, -6.6, 3.7, -8.1, 2.2, -9.7, 0.7, -11.2]),
    ),
)

# Puck Hi-Res: as the VLP-16, but with lasers 4/3° apart. Vertical angles and vertical corrections of table 9-1; the
# corrections also stand in the maker's envelope drawing 86-0129 rev. A (velodyne-decoder 3.1.0, calib_db.cpp). They are
# up to 0.5 mm more than 41.91 mm · tan of the angle, by which those of the VLP-16 are explained. Product id 0x24.
VLP16_HIRES = replace(
    VLP16,
    name="Puck Hi-Res (VLP-16 Hi-Res)",
    product_ids=(0x24,),
    beams=beam_table(
        [-10, 0.667, -8.667, 2, -7.333, 3.333, -6, 4.667, -4.667, 6, -3.333, 7.333, -2, 8.667, -0.667, 10],
        up_m=1e-3 * np.array([7.4, -0.9, 6.5, -1.8, 5.5, -2.7, 4.6, -3.7, 3.7, -4.6, 2.7, -5.5, 1.8, -6.5, 0.9, -7.4]),
    ),
)


def _focal_beams(focal_m: float, elevation_deg: list[float], azimuth_deg: list[float]) -> BeamTable:
    """Return beams that cross in one point at ``focal_m`` from the spin axis, so that they leave the axis at other
    heights.

    The focal distances are from velodyne-decoder 3.1.0 (calib_db.cpp, which cites the maker's envelope drawings of
    other models); the VLP-16 manual's vertical corrections follow from its 41.91 mm.
    """
    height_m = -focal_m * np.tan(np.radians(elevation_deg))
    return beam_table(elevation_deg, azimuth_deg=azimuth_deg, up_m=height_m)


# VLP-32C User Manual 63-9325 rev. C: distances in 4 mm; 16 pairs of lasers 2.304 µs apart, a sequence each 55.296 µs
# and in each data block (9.4); vertical angles and azimuth offsets (tables 9-2 and 9-6, with the signs of 9.5: those
# of the maker's XML and of nebula's calib_VLP32.yaml are opposite); product id 0x28 (VLP-16 manual, table 9-2).
_VLP32C_ELEVATION_DEG = """
-25 -1 -1.667 -15.639 -11.31 0 -0.667 -8.843 -7.254 0.333 -0.333 -6.148 -5.333 1.333 0.667 -4
-4.667 1.667 1 -3.667 -3.333 3.333 2.333 -2.667 -3 7 4.667 -2.333 -2 15 10.333 -1.333
"""
_VLP32C_AZIMUTH_DEG = """
1.4 -4.2 1.4 -1.4 1.4 -1.4 4.2 -1.4 1.4 -4.2 1.4 -1.4 4.2 -1.4 4.2 -1.4
1.4 -4.2 1.4 -4.2 4.2 -1.4 1.4 -1.4 1.4 -1.4 1.4 -4.2 4.2 -1.4 1.4 -1.4
"""
VLP32C = SpinningHead(
    name="VLP-32C",
    product_ids=(0x28,),
    range_unit_m=0.004,
    channel=_PLACES.astype(np.uint16),
    offset_ns=(_PLACES // 2) * 2_304,
    group_ns=55_296,
    beams=_focal_beams(0.0424, numbers(_VLP32C_ELEVATION_DEG), numbers(_VLP32C_AZIMUTH_DEG)),
)

# VLS-128 User Manual 63-9483 rev. A: distances in 4 mm (9.3.1.3); four banks of 32 lasers, a block each, FF EE, FF DD,
# FF CC, FF BB on the wire; in dual return one sequence in eight blocks and four empty ones (p. 57). Groups of eight
# lasers fire 2.665 µs apart, a group's time is left out after eight groups, three at the end: 53.3 µs; the stamp is
# adjusted by 8.7 µs (9.4). Vertical angles and azimuth offsets as in ros-drivers/velodyne's VLS128.yaml and
# velodyne-decoder's calib_db.cpp, with the manual's sign. Product id 0xA1 on the wire (ros-drivers/velodyne, 161);
# 0x63 in table 9-2 of the VLP-16 manual.
_VLS128_ELEVATION_DEG = """
-11.742 -1.99 3.4 -5.29 -0.78 4.61 -4.08 1.31 -6.5 -1.11 4.28 -4.41 0.1 6.48 -3.2 2.19
-3.86 1.53 -9.244 -1.77 2.74 -5.95 -0.56 4.83 -2.98 2.41 -6.28 -0.89 3.62 -5.07 0.32 7.58
-0.34 5.18 -3.64 1.75 -25 -2.43 2.96 -5.73 0.54 9.7 -2.76 2.63 -7.65 -1.55 3.84 -4.85
3.18 -5.51 -0.12 5.73 -4.3 1.09 -16.042 -2.21 4.06 -4.63 0.76 15 -3.42 1.97 -6.85 -1.33
-5.62 -0.23 5.43 -3.53 0.98 -19.582 -2.32 3.07 -4.74 0.65 11.75 -2.65 1.86 -7.15 -1.44 3.95
-2.1 3.29 -5.4 -0.01 4.5 -4.19 1.2 -13.565 -1.22 4.17 -4.52 0.87 6.08 -3.31 2.08 -6.65
1.42 -10.346 -1.88 3.51 -6.06 -0.67 4.72 -3.97 2.3 -6.39 -1 4.39 -5.18 0.21 6.98 -3.09
4.98 -3.75 1.64 -8.352 -2.54 2.85 -5.84 -0.45 8.43 -2.87 2.52 -6.17 -1.66 3.73 -4.96 0.43
"""
_VLS128_AZIMUTH_DEG = 16 * [6.354, 4.548, 2.732, 0.911, -0.911, -2.732, -4.548, -6.354]
_FIRING_GROUP = np.arange(128) // 8
VLS128 = SpinningHead(
    name="VLS-128",
    product_ids=(0xA1, 0x63),
    range_unit_m=0.004,
    channel=np.arange(128, dtype=np.uint16),
    offset_ns=(_FIRING_GROUP + _FIRING_GROUP // 8) * 2_665,
    group_ns=53_300,
    beams=_focal_beams(0.05863, numbers(_VLS128_ELEVATION_DEG), _VLS128_AZIMUTH_DEG),
    stamp_ns=-8_700,
    block_flags=(0xEEFF, 0xDDFF, 0xCCFF, 0xBBFF),
)

# HDL-32E: distances in 2 mm (User's Manual, appendix B); 32 lasers 1.152 µs apart, a sequence each 46.08 µs and in
# each data block, times after the stamp (application note 63-9277 rev. D, as velodyne-decoder has it); vertical angles
# of the maker's XML (ros-drivers/velodyne, 32db.yaml); vertical corrections of the envelope drawing 86-0106 rev. B
# (velodyne-decoder, calib_db.cpp); product id 0x21 (VLP-16 manual, table 9-2).
_HDL32E_ELEVATION_DEG = """
-30.67 -9.33 -29.33 -8 -28 -6.67 -26.67 -5.33 -25.33 -4 -24 -2.67 -22.67 -1.33 -21.33 0
-20 1.33 -18.67 2.67 -17.33 4 -16 5.33 -14.67 6.67 -13.33 8 -12 9.33 -10.67 10.67
"""
_HDL32E_HEIGHT_MM = """
17.17 4.76 16.27 4.07 15.4 3.38 14.54 2.7 13.71 2.02 12.89 1.35 12.09 0.67 11.31 0
10.54 -0.67 9.78 -1.35 9.04 -2.02 8.3 -2.7 7.58 -3.38 6.86 -4.07 6.15 -4.76 5.45 -5.45
"""
HDL32E = SpinningHead(
    name="HDL-32E",
    product_ids=(0x21,),
    range_unit_m=0.002,
    channel=_PLACES.astype(np.uint16),
    offset_ns=_PLACES * 1_152,
    group_ns=46_080,
    beams=beam_table(numbers(_HDL32E_ELEVATION_DEG), up_m=1e-3 * np.array(numbers(_HDL32E_HEIGHT_MM))),
)
