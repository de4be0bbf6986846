"""The SREP/1 datagram (PROTOCOLS): its layout as tables, its encoder, its checks and its ticks in nanoseconds.

One datagram: header (48 bytes), N pulses of 8 + 8·R bytes, CRC-32. Little-endian.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from fastcrc.crc32 import iso_hdlc as crc32
from numpy.typing import ArrayLike, NDArray

from swath.georef.arrays import BoolArray, Int64Array, StructArray, UInt64Array
from swath.georef.timescales.gps_time import SECOND_NS

MAGIC = 0x50455253  # "SREP" in memory order
VERSION = 1
MAX_RETURN_SLOTS = 15
FLAG_PPS_LOCKED = 1
FLAG_RANGE_GATE = 2
FLAG_LASER_ON = 4
ZONE_UNKNOWN = 255
RANGE_UNIT_M = 1e-4
PULSE_WIDTH_UNIT_NS = 0.01

HEADER_DTYPE = np.dtype(
    [
        ("magic", "<u4"),
        ("version", "u1"),
        ("flags", "u1"),
        ("pulses", "<u2"),
        ("sequence", "<u4"),
        ("scanner_id", "<u2"),
        ("return_slots", "u1"),
        ("mta_zone", "u1"),
        ("pps_count", "<u4"),
        ("tick_hz", "<u4"),
        ("pps_ticks", "<u8"),
        ("first_ticks", "<u8"),
        ("encoder_counts", "<u4"),
        ("prf_mhz", "<u4"),
    ]
)
HEADER_BYTES = HEADER_DTYPE.itemsize
CRC = struct.Struct("<I")
PULSE_HEAD_BYTES = 8
SLOT_DTYPE = np.dtype([("range", "<u4"), ("intensity", "<u2"), ("pulse_width", "<u2")])
SLOT_BYTES = SLOT_DTYPE.itemsize
_SECONDS = 1 << 32


@cache
def pulse_dtype(return_slots: int) -> np.dtype[np.void]:
    """Return the dtype of one pulse record with R return slots: 8 + 8·R bytes."""
    return np.dtype([("ticks", "<u4"), ("encoder", "<i4"), ("slot", SLOT_DTYPE, (return_slots,))])


def datagram_bytes(pulses: int, return_slots: int) -> int:
    """Return the correct length of a datagram."""
    return HEADER_BYTES + pulses * (PULSE_HEAD_BYTES + SLOT_BYTES * return_slots) + CRC.size


def body_words(header: StructArray) -> Int64Array:
    """Return the number of 64-bit words of each datagram's pulses, (n,) of headers (n,)."""
    words: Int64Array = header["pulses"].astype(np.int64) * (1 + header["return_slots"].astype(np.int64))
    return words


@dataclass(frozen=True, slots=True)
class SrepHeader:
    """Fields of a datagram beside its pulses; names and units of the protocol page."""

    sequence: int = 0
    scanner_id: int = 0
    flags: int = 0
    mta_zone: int = 0
    pps_count: int = 0
    tick_hz: int = 10_000_000
    pps_ticks: int = 0
    first_ticks: int = 0
    encoder_counts: int = 524_288
    prf_mhz: int = 0


def encode_datagram(
    header: SrepHeader,
    ticks: ArrayLike,
    encoder: ArrayLike,
    range_0p1mm: ArrayLike,
    intensity: ArrayLike = 0,
    pulse_width_10ps: ArrayLike = 0,
) -> bytes:
    """Encode one datagram.

    Args:
        header: all fields of the header except N and R.
        ticks: (N,) u32 since first_ticks.
        encoder: (N,) i32 counts.
        range_0p1mm: (N, R) u32, 0 = no return; its shape gives N and R.
        intensity, pulse_width_10ps: (N, R) u16, or one value for all.
    """
    ranges = np.asarray(range_0p1mm, dtype=np.uint32)
    head = np.zeros(1, dtype=HEADER_DTYPE)
    for name in SrepHeader.__dataclass_fields__:
        head[name] = getattr(header, name)
    body = np.zeros(ranges.shape[:1], dtype=pulse_dtype(ranges.shape[1]))
    body["ticks"], body["encoder"] = ticks, encoder
    body["slot"]["range"], body["slot"]["intensity"], body["slot"]["pulse_width"] = ranges, intensity, pulse_width_10ps
    return encode_datagrams(head, body[np.newaxis])[0]


def encode_datagrams(header: StructArray, body: StructArray) -> list[bytes]:
    """Encode datagrams of equal length.

    Args:
        header: (m,) `HEADER_DTYPE`; magic, version, N and R are filled in here.
        body: (m, N) `pulse_dtype`, ticks since each datagram's first_ticks.
    """
    header["magic"], header["version"] = MAGIC, VERSION
    header["pulses"], header["return_slots"] = body.shape[1], body.dtype["slot"].shape[0]
    rows = np.empty((len(body), datagram_bytes(body.shape[1], body.dtype["slot"].shape[0])), dtype=np.uint8)
    rows[:, :HEADER_BYTES] = header.view(np.uint8).reshape(-1, HEADER_BYTES)
    content = np.ascontiguousarray(body).view(np.uint8)
    rows[:, HEADER_BYTES : -CRC.size] = content.reshape(len(body), rows.shape[1] - HEADER_BYTES - CRC.size)
    datagrams = (row[: -CRC.size].tobytes() for row in rows)
    return [data + CRC.pack(crc32(data)) for data in datagrams]


def nanoseconds(ticks: UInt64Array, tick_hz: NDArray[np.uint32]) -> Int64Array:
    """Convert the tick counter to device time, both (n,): floor(ticks · 10⁹ / tick_hz), seconds modulo 2³²."""
    hz = tick_hz.astype(np.uint64)
    seconds, rest = np.divmod(ticks, hz)
    return ((seconds % np.uint64(_SECONDS)) * np.uint64(SECOND_NS) + rest * np.uint64(SECOND_NS) // hz).astype(np.int64)


def header_checks(header: StructArray, length: Int64Array) -> list[tuple[str, BoolArray]]:
    """Check headers (n,) of datagrams of these lengths (n,).

    Returns:
        (error code, (n,) True where the check passes) of each check.
    """
    pulses, slots = header["pulses"], header["return_slots"]
    return [
        ("bad_magic", header["magic"] == MAGIC),
        ("bad_version", header["version"] == VERSION),
        ("bad_length", HEADER_BYTES + 8 * body_words(header) + CRC.size == length),
        (
            "bad_header",
            (slots >= 1)
            & (slots <= MAX_RETURN_SLOTS)
            & (header["tick_hz"] > 0)
            & ((header["encoder_counts"] > 0) | (pulses == 0)),
        ),
    ]


@dataclass(frozen=True, slots=True)
class PulseRows:
    """Arrangement of the pulses of datagrams: a row is a datagram where all have equally many pulses, else a pulse.

    Attributes:
        shape: number of rows, pulses of each.
        counts: pulses of each datagram (n,), where a row is a pulse.
    """

    shape: tuple[int, int]
    counts: NDArray[np.intp] | None = None

    @classmethod
    def of(cls, pulses: NDArray[np.uint16]) -> PulseRows:
        """Make the arrangement for datagrams with these numbers of pulses (n,)."""
        if (pulses == pulses[0]).all():
            return cls((len(pulses), int(pulses[0])))
        counts = pulses.astype(np.intp)
        return cls((int(counts.sum()), 1), counts)

    def spread(self, values: NDArray[Any]) -> NDArray[Any]:
        """Repeat values of datagrams (n,) for each row."""
        return values if self.counts is None else np.repeat(values, self.counts)

    def first_ids(self, ids: Int64Array) -> Int64Array:
        """Return the id of each row's first pulse; ``ids`` are those of each datagram's first pulse (n,), and the
        others count up.
        """
        if self.counts is None:
            return ids
        before = np.cumsum(self.counts) - self.counts
        first: Int64Array = self.spread(ids - before)
        first += np.arange(len(first))
        return first


def pulse_times(header: StructArray, ticks: NDArray[np.uint32], rows: PulseRows) -> Int64Array:
    """Return device times of pulses ``ticks`` after each datagram's first, of datagrams (n,) with one tick_hz.

    The whole seconds are split off before: (rest + ticks) · 10⁹ < 2³³ · 10⁹ fits int64. Ticks and times are arranged
    as ``rows``.
    """
    hz = int(header["tick_hz"][0])
    seconds, left = np.divmod(header["first_ticks"], np.uint64(hz))
    base = (seconds % np.uint64(_SECONDS)).astype(np.int64) * SECOND_NS
    rest = left.astype(np.int64)
    after = ticks.astype(np.int64)
    if SECOND_NS % hz == 0:
        after *= SECOND_NS // hz
        base += rest * (SECOND_NS // hz)
    else:
        after += rows.spread(rest)[:, np.newaxis]
        after *= SECOND_NS
        after //= hz
    after += rows.spread(base)[:, np.newaxis]
    return after
