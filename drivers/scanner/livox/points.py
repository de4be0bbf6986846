"""Converts the points of Livox packets to rows: range, azimuth and elevation of each return.

The frame is the maker's O-XYZ: x forward, y left, z up. Cartesian points are integers, so a return's own direction is
computed from its own coordinates; the angles of spherical points are zenith angle and azimuth of the same frame (user
manuals, "Point Cloud Data", "Coordinate"; livox_ros_driver, lds.h, RawPointConvert).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from swath.drivers.scanner.livox.layout import PointType
from swath.drivers.scanner.rows.slots import numbers_of
from swath.georef.arrays import BoolArray, FloatArray, Int64Array, StructArray, UInt64Array
from swath.georef.records import AIMED_RETURN_DTYPE, RETURN_FLAG_DOUBTED, RETURN_FLAG_LAST

WORDS = AIMED_RETURN_DTYPE.itemsize // 8
CONFIDENCE = 0x3F  # bits of a tag of SDK 2; of SDK 1 the upper two of them number the return
CONFIDENCE_1 = 0x0F
FULL_CIRCLE, HALF_CIRCLE = 36_000, 18_000  # 0.01°
_TO_RAD = np.pi / HALF_CIRCLE


@dataclass(frozen=True, slots=True)
class Pulses:
    """Pulses of consecutive packets with points of one type and number.

    Attributes:
        kind: of the points.
        table: (packets, pulses) of the type's dtype.
        host_time_ns: (packets,).
        time_ns: (packets, pulses) device time of each pulse.
        pulse_id: (packets,) id of the first pulse.
        lines: lasers that fire in turn.
        flags: of all returns.
        confidence: bits of a tag that doubt the return if one of them is set.
    """

    kind: PointType
    table: StructArray
    host_time_ns: Int64Array
    time_ns: Int64Array
    pulse_id: Int64Array
    lines: int
    flags: int
    confidence: int


def fill_rows(pulses: Pulses, table: StructArray) -> tuple[int, int]:
    """Write the returns in the order of the pulses, of each the nearest first, to the head of a table.

    A point in the origin is a pulse without a return. Returns of one pulse at one range are one return.

    Args:
        pulses: of one type of points.
        table: `AIMED_RETURN_DTYPE`, with at least as many rows as slots for returns.

    Returns:
        the number of rows; and that of the returns that were left out because their angles are none.
    """
    kind, several = pulses.kind, pulses.kind.echoes > 1
    sent = pulses.table.reshape(-1)
    each = (sent["echoes"] if several else sent[:, np.newaxis]).reshape(-1)
    pulse = np.repeat(np.arange(len(sent)), kind.echoes) if several else np.arange(len(sent))
    there, bad = _there(kind, sent, each, pulse)
    kept = np.flatnonzero(there)
    if len(kept) < len(each):
        each, pulse = each.take(kept), pulse.take(kept)
    range_m, azimuth, elevation = _polar(kind, each, sent, pulse) if kind.is_polar else _cartesian(kind, each)
    number = count = np.ones(len(each), dtype=np.uint8)
    if several:
        order, number, count = _numbered(pulse, range_m)
        each, pulse = each.take(order), pulse.take(order)
        range_m, azimuth, elevation = range_m.take(order), azimuth.take(order), elevation.take(order)
    words = np.empty((WORDS, len(each)), dtype=np.uint64)
    per_packet = pulses.time_ns.shape[1]
    packet = pulse // per_packet
    place = pulse - packet * per_packet
    words[0].view(np.int64)[:] = pulses.host_time_ns.take(packet)
    words[1].view(np.int64)[:] = pulses.time_ns.reshape(-1).take(pulse)
    words[2].view(np.float64)[:] = range_m
    words[3].view(np.float64)[:] = azimuth
    words[4].view(np.int64)[:] = pulses.pulse_id.take(packet) + place
    words[5].view(np.float32)[0::2] = each["reflectivity"]
    words[5].view(np.float32)[1::2] = 0
    _last_word(words[6], pulses, each, place, number, count)
    words[7].view(np.float64)[:] = elevation
    table[: len(each)].view(np.uint64).reshape(-1, WORDS)[:] = words.T
    return len(each), bad


def _there(kind: PointType, sent: StructArray, each: StructArray, pulse: NDArray[np.intp]) -> tuple[BoolArray, int]:
    """Return a mask of the returns that are there, and the number of those whose angles are none."""
    if not kind.is_polar:
        found: BoolArray = (each["x"] | each["y"] | each["z"]) != 0
        return found, 0
    found = each["range"] != 0
    right = (sent["zenith"] <= HALF_CIRCLE) & (sent["azimuth"] <= FULL_CIRCLE)
    if right.all():
        return found, 0
    good = found & right.take(pulse)
    return good, int(found.sum() - good.sum())


def _cartesian(kind: PointType, each: StructArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    x, y, z = (each[name].astype(np.float64) for name in "xyz")
    flat2 = x * x + y * y
    azimuth = np.arctan2(y, x)
    elevation = np.arctan2(z, np.sqrt(flat2))
    return np.sqrt(flat2 + z * z) * kind.unit_m, azimuth, elevation


def _polar(
    kind: PointType, each: StructArray, sent: StructArray, pulse: NDArray[np.intp]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    zenith = sent["zenith"].take(pulse).astype(np.float64)
    azimuth = sent["azimuth"].take(pulse).astype(np.float64)
    azimuth -= (azimuth > HALF_CIRCLE) * np.float64(FULL_CIRCLE)
    return each["range"] * kind.unit_m, azimuth * _TO_RAD, (HALF_CIRCLE / 2 - zenith) * _TO_RAD


def _numbered(pulse: NDArray[np.intp], range_m: FloatArray) -> tuple[NDArray[np.intp], Any, Any]:
    """Return the order of returns by pulse and range without repeated ones, and their numbers and counts."""
    same = pulse[1:] == pulse[:-1]
    turned = np.flatnonzero(same & (range_m[1:] < range_m[:-1]))
    order = np.arange(len(pulse))
    if len(turned) and (same[1:] & same[:-1]).any():  # three returns; sorting takes several times as long
        order = np.lexsort((range_m, pulse))
    elif len(turned):
        order[turned], order[turned + 1] = turned + 1, turned
    at = range_m.take(order)
    twice = np.flatnonzero(same & (at[1:] == at[:-1])) + 1
    if len(twice):
        order = np.delete(order, twice)
        pulse = np.delete(pulse, twice)
    return order, *numbers_of(pulse, 3)


def _last_word(
    word: UInt64Array, pulses: Pulses, each: StructArray, place: NDArray[np.intp], number: Any, count: Any
) -> None:
    """Fill the fields from the channel on, a byte each but the channel's two."""
    pairs = word.view("<u2")
    pairs[0::4] = place % pulses.lines if pulses.lines > 1 else 0
    pairs[1::4] = number | count.astype(np.uint16) << 8
    flags = np.full(len(each), pulses.flags, dtype=np.uint16)
    if pulses.kind.has_tag:
        flags |= ((each["tag"] & pulses.confidence) != 0) * np.uint16(RETURN_FLAG_DOUBTED)
    if pulses.kind.echoes > 1:
        flags |= (number == count) * np.uint16(RETURN_FLAG_LAST)
    pairs[2::4] = flags << 8  # above the MTA zone, which is 0
    pairs[3::4] = 0
