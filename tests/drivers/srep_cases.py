"""Makes SREP for tests: the page's test vector, datagrams of a flight line, and a decoder written from the page.

The decoder works pulse by pulse with `struct` and integers of any size; it shares nothing with the driver.
"""

from __future__ import annotations

import math
import struct
import zlib
from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from swath.drivers.scanner.srep.layout import SrepHeader, encode_datagram

TEST_VECTOR = bytes.fromhex(
    "535245500105020007000000030002002a0000008096980000ca9a3b0000000000d3d73b000000000000080000c2eb0b"
    "0000000018fcffff80368b002003c201d0248d00780000003200000022fcffff11508b002a03000000000000000000001d20bec5"
)
COUNTS = 524_288
TICK_HZ = 10_000_000


@dataclass(frozen=True)
class Return:
    """One return as the page defines it."""

    device_time_ns: int
    encoder_rad: float
    facet: int
    range_m: float
    intensity: int
    pulse_width_ns: float
    return_number: int
    number_of_returns: int
    mta_zone: int
    locked: bool
    pulse: int


def reference_decode(datagram: bytes, mirror_factor: float, facets: int = 0) -> list[Return]:
    """Return all returns of one good datagram, and assert that it is good."""
    magic, version, flags, n, _seq, _id, r, zone = struct.unpack_from("<IBBHIHBB", datagram, 0)
    _pps_count, hz, _pps_ticks, first, counts, _prf = struct.unpack_from("<IIQQII", datagram, 16)
    assert (magic, version, len(datagram)) == (0x50455253, 1, 48 + n * (8 + 8 * r) + 4)
    assert struct.unpack("<I", datagram[-4:])[0] == zlib.crc32(datagram[:-4])
    returns = []
    for pulse in range(n):
        at = 48 + pulse * (8 + 8 * r)
        ticks, encoder = struct.unpack_from("<Ii", datagram, at)
        slots = [struct.unpack_from("<IHH", datagram, at + 8 + 8 * slot) for slot in range(r)]
        there = [slot for slot in slots if slot[0]]
        turns = Fraction(encoder, counts)
        facet = math.floor(turns * facets) % facets if facets else 0
        if facets:
            centre = Fraction(2 * math.floor(turns * facets) + 1, 2 * facets)
            angle = 2 * math.tau * float(turns - centre)
        else:
            angle = math.tau * float(turns) * mirror_factor
        time_ns = (first + ticks) * 10**9 // hz
        for number, (tenth_mm, intensity, width) in enumerate(there, start=1):
            returns.append(
                Return(
                    time_ns, angle, facet, tenth_mm / 1e4, intensity, width / 100, number, len(there), zone,
                    bool(flags & 1), pulse,
                )
            )  # fmt: skip
    return returns


def scan_lines(datagrams: int = 24, pulses: int = 64) -> list[bytes]:
    """Return datagrams of an oscillating mirror over rolling ground at 200 kHz, with PPS latched each second.

    Some pulses have two returns. The stream has an unlocked start, a heartbeat, returns lost to the sky, a zone change
    and a sequence wrap.
    """
    random = np.random.default_rng(20_261_121)
    stream = []
    for at in range(datagrams):
        number = at * pulses + np.arange(pulses)
        encoder = np.rint(40_000 * np.sin(number / 300.0)).astype(np.int32)
        first = np.rint(9_000_000 / np.cos(encoder / COUNTS * math.tau) + 3_000 * np.sin(number / 50.0))
        second = np.where(random.random(pulses) < 0.3, first + 12_000, 0)
        first[random.random(pulses) < 0.05] = 0
        ranges = np.stack([first, np.where(first == 0, 0, second)], axis=1).astype(np.uint32)
        if at == 7:
            ranges = ranges[:0]
        header = SrepHeader(
            sequence=(0xFFFF_FFF4 + at) % (1 << 32),
            scanner_id=42,
            flags=6 if at < 3 else 7,
            mta_zone=1 if at >= 16 else 0,
            pps_count=0 if at < 3 else 1 + at // 12,
            tick_hz=TICK_HZ,
            pps_ticks=0 if at < 3 else 999_990_000 + 10_000_000 * (at // 12),
            first_ticks=1_000_000_000 + at * pulses * 50,
            encoder_counts=COUNTS,
            prf_mhz=200_000_000,
        )
        count = len(ranges)
        intensity = random.integers(50, 2000, ranges.shape)
        width = random.integers(300, 700, ranges.shape)
        stream.append(encode_datagram(header, np.arange(count) * 50, encoder[:count], ranges, intensity, width))
    return stream


def split_datagrams(data: bytes) -> list[bytes]:
    """Return datagrams laid end to end, cut by their own headers."""
    found = []
    while data:
        n, r = struct.unpack_from("<H", data, 6)[0], data[14]
        length = 48 + n * (8 + 8 * r) + 4
        found.append(data[:length])
        data = data[length:]
    return found
