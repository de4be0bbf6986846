"""Describes Hesai heads: layout of the packets, firing times of the lasers, directions of the beams.

A packet has a header, blocks, a tail. A block is the azimuth and one return of each laser; one, two or three blocks
with the same azimuth are a round of firing. The models are in `swath.drivers.scanner.hesai.models`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np

from swath.drivers.parser import DriverSettingsError
from swath.drivers.scanner.beams import BeamTable, beam_table
from swath.georef.arrays import BoolArray, Int64Array, StructArray
from swath.georef.records import RETURN_FLAG_LAST, RETURN_FLAG_STRONGEST

Fields: TypeAlias = tuple[tuple[str, object], ...]

FIRST_ROUND, LAST_ROUND = 0, -1
NEAR_MM = 2_850

# bits of the header's flags, and what they add to a packet (udp_protocol_header.h of HesaiLidar_SDK_2.0)
SEQUENCE, IMU, SAFETY, SIGNATURE, CONFIDENCE, WEIGHT, LIGHT = (1 << bit for bit in range(7))
OF_EACH_CHANNEL = CONFIDENCE | WEIGHT | LIGHT  # one byte behind each return
SAFETY_BYTES, IMU_BYTES, SIGNATURE_BYTES = 17, 22, 32

MODE_FIRST, MODE_SECOND, MODE_STRONGEST, MODE_LAST = 0x33, 0x34, 0x37, 0x38
MODE_LAST_STRONGEST, MODE_FIRST_SECOND, MODE_LAST_FIRST, MODE_FIRST_STRONGEST = 0x39, 0x3A, 0x3B, 0x3C
MODE_FIRST_LAST_STRONGEST, MODE_STRONGEST_SECOND = 0x3D, 0x3E
SINGLE_FLAGS = {MODE_FIRST: 0, MODE_SECOND: 0, MODE_STRONGEST: RETURN_FLAG_STRONGEST, MODE_LAST: RETURN_FLAG_LAST}
SEVERAL_NAMES = {  # by mode: includes the strongest, includes the last
    MODE_LAST_STRONGEST: (True, True),
    MODE_FIRST_SECOND: (False, False),
    MODE_LAST_FIRST: (False, True),
    MODE_FIRST_STRONGEST: (True, False),
    MODE_FIRST_LAST_STRONGEST: (True, True),
    MODE_STRONGEST_SECOND: (True, False),
}
USUAL_MODES = (
    *(MODE_FIRST, MODE_STRONGEST, MODE_LAST),
    *(MODE_LAST_STRONGEST, MODE_LAST_FIRST, MODE_FIRST_STRONGEST),
)


def echoes_of(mode: int) -> int:
    """Return the number of blocks of a round of firing."""
    return 3 if mode == MODE_FIRST_LAST_STRONGEST else 2 if mode in SEVERAL_NAMES else 1


HEADER: Fields = (
    ("sop", "<u2"),  # EE FF on the wire
    ("protocol_major", "u1"),
    ("protocol_minor", "u1"),
    ("reserved", "V2"),
    ("laser_num", "u1"),
    ("block_num", "u1"),
    ("first_block_return", "u1"),
    ("distance_unit_mm", "u1"),
    ("return_num", "u1"),
    ("flags", "u1"),
)
BLOCK: Fields = (("azimuth", "<u2"),)
SOP, BLOCK_SOP = 0xFFEE, 0xEEFF
NO_BEAMS = beam_table([])


@dataclass(frozen=True)
class HesaiHead:
    """One model of head.

    Attributes:
        name: the maker's name of it.
        protocol_major: number that identifies it in its packets.
        protocol_minor: number that its packets state besides.
        blocks, channels: size of a packet.
        tail: fields of the tail in their order, `numpy` style.
        flags: bits of the header's flags of its usual packets.
        optional: bits that may differ from that.
        round_ns: time from one round of firing to the next.
        stamped_round: whether the packet's time is that of its first or of its last round.
        start_ns: time from a round's stamp to the reading of its azimuth.
        offset_ns: (states, channels) firing times after the reading of the azimuth.
        beams: design values; a device's own values are in its angle correction file. Empty: its directions depend on
            the angle of mirrors, and only that file gives them.
        channel_bytes: bytes of a return without those that the flags add.
        has_crc: whether a CRC follows the body, and one the tail.
        checks_crc: whether it is known which CRC that is, so that packets with a wrong one are refused.
        units_mm: units of distance that it may send.
        modes: return modes that it may send.
        states: makes the (n, rounds) rows of ``offset_ns`` that apply to the rounds of packets; None: the only one.
        near_ns: (states, channels) firing times of lasers whose farthest return is nearer than `NEAR_MM`.
        pace: makes the (n,) multiples of ``round_ns`` between the rounds of packets; None: 1.
        header, block: fields of the header and at the beginning of a block; empty where the packet has no header.
        year_base: year from which the date counts; from 1900, a year byte of 0 says that seconds since 1970 follow.
        least_range: smaller raw ranges are codes of the head, not distances.
        duty: part of the time in which the head fires.
        older: the same model with the earlier protocol, which it may send as well.
    """

    name: str
    protocol_major: int
    blocks: int
    channels: int
    tail: Fields
    flags: int
    round_ns: float
    stamped_round: int
    start_ns: int
    offset_ns: Int64Array
    beams: BeamTable = NO_BEAMS
    protocol_minor: int = 1
    optional: int = 0
    channel_bytes: int = 4
    has_crc: bool = False
    checks_crc: bool = False
    units_mm: tuple[int, ...] = (4,)
    modes: tuple[int, ...] = USUAL_MODES
    states: Callable[[StructArray, int], Int64Array] | None = field(default=None, compare=False)
    near_ns: Int64Array | None = field(default=None, compare=False)
    pace: Callable[[StructArray], Int64Array] | None = field(default=None, compare=False)
    header: Fields = HEADER
    block: Fields = BLOCK
    year_base: int = 1900
    least_range: int = 1
    duty: float = 1.0
    older: HesaiHead | None = None

    def packet_dtype(self, flags: int | None = None) -> np.dtype[np.void]:
        """Return the dtype of a point cloud packet with these flags (None: the usual ones)."""
        flags = self.flags if flags is None else flags
        more = (flags & OF_EACH_CHANNEL).bit_count()
        channel = np.dtype(
            {
                "names": ["range", "reflectivity"],
                "formats": ["<u2", "u1"],
                "offsets": [0, 2],
                "itemsize": self.channel_bytes + more,
            }
        )
        block = np.dtype([*self.block, ("returns", channel, (self.channels,))])
        fields: list[tuple[Any, ...]] = [*self.header]
        fields.append(("blocks", block, (self.blocks,)))
        for name, kind, there in (
            ("body_crc", "<u4", self.has_crc),
            ("safety", f"V{SAFETY_BYTES}", flags & SAFETY),
            *((name, kind, True) for name, kind in self.tail),
            ("sequence", "<u4", flags & SEQUENCE),
            ("imu", f"V{IMU_BYTES}", flags & IMU),
            ("tail_crc", "<u4", self.has_crc),
            ("signature", f"V{SIGNATURE_BYTES}", flags & SIGNATURE),
        ):
            if there:
                fields.append((name, kind))
        return np.dtype(fields)

    def layouts(self) -> dict[int, Layout]:
        """Return the layouts of all packets that the head may send, by their lengths."""
        known = self.flags | self.optional
        bits = [bit for bit in (1 << at for at in range(8)) if bit & self.optional]
        found: dict[int, Layout] = {}
        for chosen in range(1 << len(bits)):
            flags = self.flags & ~self.optional | sum(bit for at, bit in enumerate(bits) if chosen >> at & 1)
            dtype = self.packet_dtype(flags)
            layout = found.setdefault(dtype.itemsize, Layout(self, dtype, np.zeros(256, dtype=np.bool_)))
            layout.fits[(np.arange(256) & known) == flags] = True
        return found if self.older is None else self.older.layouts() | found

    def round_start_ns(self, rounds: int) -> Int64Array:
        """Return (rounds,) times from the packet's time to the reading of each round's azimuth."""
        number = np.arange(rounds) - (rounds - 1 if self.stamped_round == LAST_ROUND else 0)
        start: Int64Array = np.rint(number * self.round_ns).astype(np.int64) + self.start_ns
        return start

    def rounds_ns(self, packets: StructArray, rounds: int) -> Int64Array:
        """Return times from the packet's time to the reading of each round's azimuth: (1, rounds) or (n, rounds)."""
        start = self.round_start_ns(rounds)[np.newaxis]
        if self.pace is None:
            return start
        paced: Int64Array = (start - self.start_ns) * self.pace(packets)[:, np.newaxis] + self.start_ns
        return paced

    def firing_ns(self, packets: StructArray, rounds: int) -> Int64Array:
        """Return times of firings after the reading of the azimuth: (1, channels), or (n · rounds, channels)."""
        if self.states is None:
            return self.offset_ns
        states = self.states(packets, rounds).reshape(-1)
        times: Int64Array = self.offset_ns[states]
        if self.near_ns is not None:
            ranges = packets["blocks"]["returns"]["range"].reshape(len(states), -1, self.channels).max(axis=1)
            unit_mm = np.repeat(packets["distance_unit_mm"], rounds)[:, np.newaxis]
            times = np.where(ranges.astype(np.int64) * unit_mm < NEAR_MM, self.near_ns[states], times)
        return times

    @property
    def bytes_per_s(self) -> float:
        """The most that the head sends: its usual packets in the return mode with the fewest rounds in a packet."""
        rounds = self.blocks // max(map(echoes_of, self.modes))
        return self.duty * 1e9 * self.packet_dtype().itemsize / (rounds * self.round_ns)

    def last_ns(self, mode: int) -> int:
        """Return the time from the packet's time to its last firing."""
        return int(self.round_start_ns(self.blocks // echoes_of(mode))[-1] + self.offset_ns.max())


@dataclass(frozen=True)
class Layout:
    """Layout of packets of one length.

    Attributes:
        head: the model with the protocol of these packets.
        dtype: the packet.
        fits: (256,) True for flags of the header with which a packet has this layout.
    """

    head: HesaiHead
    dtype: np.dtype[np.void]
    fits: BoolArray


def read_angle_file(data: bytes, head: HesaiHead) -> BeamTable:
    """Read beams from a head's angle correction file: CSV of channel (from 1), elevation and azimuth in degrees.

    Raises:
        DriverSettingsError: the file is not an angle correction file, or is of another model.
    """
    found: dict[int, tuple[float, float]] = {}
    below_names = data.decode("utf-8-sig", "replace").splitlines()[1:]
    for line, text in enumerate(below_names, start=2):
        row = text.split(",")
        if not text.strip(", \t"):
            continue
        try:
            channel, elevation, azimuth = int(row[0]), float(row[1]), float(row[2])
        except (ValueError, IndexError):
            raise DriverSettingsError(
                f"geometry.file: line {line} is {text[:40]!r}, want channel, elevation, azimuth in degrees"
            ) from None
        if not (math.isfinite(azimuth) and abs(azimuth) <= 360 and abs(elevation) <= 90):
            raise DriverSettingsError(
                f"geometry.file: line {line}: elevation {elevation}, azimuth {azimuth}: not angles in degrees"
            )
        if channel in found:
            raise DriverSettingsError(f"geometry.file: line {line}: channel {channel} appears twice")
        found[channel] = (elevation, azimuth)
    if sorted(found) != list(range(1, head.channels + 1)):
        raise DriverSettingsError(
            f"geometry.file: {len(found)} channels, want channels 1 to {head.channels} of a {head.name}"
        )
    angles = np.array([found[channel] for channel in sorted(found)])
    return beam_table(angles[:, 0], azimuth_deg=angles[:, 1])
