"""Xsens (Movella) MTi over serial: Xbus messages of type MTData2, with any items, order and number formats.

Sources: the maker's MTi user manual MT0605P (4.9, 4.12, 5.3) and MTi family reference manual MT1600P (4.3); names,
identifiers and number formats as in github.com/einride/xsens-go, whose decoding of two recordings the tests compare.

- Acceleration and RateOfTurn are means over the interval between two samples (the device integrates and divides
  again, MT0605P 4.9.3) in the axes of its housing. With ``sample = "increment"``, DeltaV and DeltaQ are used instead
  and divided by the interval 1/``rate_hz``.
- SampleTimeFine counts 0.1 ms (MT0605P 4.12.3).
- UtcTime gives the UTC of the sample; the first sample of each second makes a time message.
- Other items (orientation, position, high-rate data) are skipped by their length.
"""

from __future__ import annotations

import datetime as dt
import struct
from collections.abc import Mapping, Sequence
from fractions import Fraction
from math import atan2, hypot, isfinite, nan
from typing import Any, NamedTuple

import numpy as np

from swath.drivers.driver import STREAM_TRANSPORTS, Driver
from swath.drivers.framing.framer import Frame
from swath.drivers.framing.kinds import XBUS, XBUS_EXTENDED, XBUS_MTDATA2
from swath.drivers.framing.parser import FramedParser
from swath.drivers.imu.counters import CounterUnwrapper, GapCounter, nanoseconds
from swath.drivers.parser import DeviceSettings, DriverSettingsError
from swath.georef.records import (
    IMU_DTYPE,
    ImuSamples,
    NamesEdge,
    Record,
    TimeMessage,
    TimeScale,
    TimeTag,
)
from swath.georef.timescales.gps_time import SECOND_NS

PREAMBLE = b"\xfa\xff"  # a device alone on its line is bus identifier FF
ITEM_HEADER = struct.Struct(">HB")  # identifier, length (MT0605P 5.3)
TYPE_BITS = 0xF8F0  # bits of an identifier: group and type
FORMAT_BITS = 0x0003  # number format; bits 2 and 3 are for orientations only (MT0101P, revision W)
TICK_HZ = 10_000
COUNTER_BITS = 16
TICK_BITS = 32
UTC_VALID = 0x07  # time of week, week number and UTC (MT0605P 4.12.2)

TEMPERATURE = 0x0810
UTC_TIME = 0x1010
PACKET_COUNTER = 0x1020
SAMPLE_TIME_FINE = 0x1060
DELTA_V = 0x4010
ACCELERATION = 0x4020
RATE_OF_TURN = 0x8020
DELTA_Q = 0x8030
STATUS_BYTE = 0xE010
STATUS_WORD = 0xE020

UTC = struct.Struct(">IHBBBBBB")  # nanoseconds, year, month, day, hour, minute, second, flags
INTEGERS = {
    PACKET_COUNTER: struct.Struct(">H"),
    SAMPLE_TIME_FINE: struct.Struct(">I"),
    STATUS_BYTE: struct.Struct(">B"),
    STATUS_WORD: struct.Struct(">I"),
}
NUMBERS = {TEMPERATURE: 1, DELTA_V: 3, ACCELERATION: 3, RATE_OF_TURN: 3, DELTA_Q: 4}  # number of values in an item
FLOAT32, FP1220, FP1632, FLOAT64 = range(4)
NUMBER_BYTES = (4, 4, 6, 8)

Values = tuple[float, ...]


class Sample(NamedTuple):
    """Values of one message for a row, and its raw ticks (−1 where absent)."""

    host_time_ns: int
    ticks: int
    specific_force: Values
    angular_rate: Values
    temperature_c: float
    status: int


# --- numbers ----------------------------------------------------------------------------------------------------------


def decode_numbers(data: bytes, number_format: int) -> Values:
    """Decode numbers of one format: float32, fixed point 12.20 and 16.32, float64, all high byte first.

    16.32 comes as its 32 fraction bits, then its 16 whole bits.
    """
    if number_format == FLOAT32:
        return struct.unpack(f">{len(data) // 4}f", data)
    if number_format == FLOAT64:
        return struct.unpack(f">{len(data) // 8}d", data)
    if number_format == FP1220:
        return tuple(number / 2.0**20 for number in struct.unpack(f">{len(data) // 4}i", data))
    parts = struct.unpack(">" + "Ih" * (len(data) // 6), data)
    return tuple(whole + fraction / 2.0**32 for fraction, whole in zip(parts[::2], parts[1::2], strict=True))


def encode_numbers(values: Sequence[float], number_format: int) -> bytes:
    """Encode numbers as the inverse of `decode_numbers`, rounded to the format's resolution.

    Raises:
        struct.error: a value does not fit.
    """
    if number_format == FLOAT32:
        return struct.pack(f">{len(values)}f", *values)
    if number_format == FLOAT64:
        return struct.pack(f">{len(values)}d", *values)
    if number_format == FP1220:
        return struct.pack(f">{len(values)}i", *(round(value * 2**20) for value in values))
    scaled = [round(value * 2**32) for value in values]
    return b"".join(struct.pack(">Ih", number & 0xFFFF_FFFF, number >> 32) for number in scaled)


# --- writing ----------------------------------------------------------------------------------------------------------


def encode_message(identifier: int, data: bytes) -> bytes:
    """Encode one Xbus message, with an extended length where it needs one.

    Raises:
        ValueError: the data exceed the length of a message.
    """
    if len(data) + 7 > XBUS.max_bytes:
        raise ValueError(f"an Xbus message cannot hold {len(data)} bytes")
    length = bytes([len(data)]) if len(data) < XBUS_EXTENDED else bytes([XBUS_EXTENDED]) + struct.pack(">H", len(data))
    body = PREAMBLE[1:] + bytes([identifier]) + length + data
    return PREAMBLE[:1] + body + bytes([-sum(body) & 0xFF])


def encode_item(kind: int, values: Sequence[float | int], number_format: int = FLOAT32) -> bytes:
    """Encode one item of MTData2: a counter or status by its one value, `UTC_TIME` by its eight fields, else
    numbers.
    """
    if kind in INTEGERS:
        data = INTEGERS[kind].pack(*values)
        number_format = 0
    elif kind == UTC_TIME:
        data = UTC.pack(*values)
        number_format = 0
    else:
        data = encode_numbers(values, number_format)
    return ITEM_HEADER.pack(kind | number_format, len(data)) + data


def encode_mtdata2(*items: bytes) -> bytes:
    """Encode an MTData2 message of items."""
    return encode_message(XBUS_MTDATA2, b"".join(items))


# --- reading ----------------------------------------------------------------------------------------------------------


def split_items(data: bytes) -> dict[int, tuple[int, bytes]] | None:
    """Return format and content of each item by identifier without format; None where the items do not fill the
    message.
    """
    items: dict[int, tuple[int, bytes]] = {}
    position = 0
    while position + ITEM_HEADER.size <= len(data):
        identifier, length = ITEM_HEADER.unpack_from(data, position)
        start = position + ITEM_HEADER.size
        position = start + length
        items[identifier & TYPE_BITS] = (identifier & FORMAT_BITS, data[start:position])
    return items if position == len(data) else None


def rotation_vector(quaternion: Values) -> Values:
    """Return the rotation of a quaternion (scalar first, any length) as a vector in radians, by the shorter way."""
    scalar, *vector = quaternion if quaternion[0] >= 0.0 else tuple(-part for part in quaternion)
    length = hypot(*vector)
    factor = 2.0 * atan2(length, scalar) / length if length else 0.0
    return tuple(factor * part for part in vector)


def read_items(data: bytes) -> dict[int, tuple[Any, ...]] | None:
    """Return values of the known items; None where a length is wrong."""
    found = split_items(data)
    if found is None:
        return None
    values: dict[int, tuple[Any, ...]] = {}
    for kind, (number_format, contents) in found.items():
        layout = UTC if kind == UTC_TIME else INTEGERS.get(kind)
        count = NUMBERS.get(kind)
        if layout is not None:
            if len(contents) != layout.size:
                return None
            values[kind] = layout.unpack(contents)
        elif count is not None:
            if len(contents) != count * NUMBER_BYTES[number_format]:
                return None
            values[kind] = decode_numbers(contents, number_format)
    return values


class XbusParser(FramedParser):
    """Converts MTData2 to `ImuSamples` and, once a second, to `TimeMessage`."""

    def __init__(self, settings: DeviceSettings, *, time_only: bool = False) -> None:
        """Prepare a parser for one device.

        Args:
            settings: of the device's table, ``sample`` and ``rate_hz`` are read.
            time_only: return time messages only.

        Raises:
            DriverSettingsError: increments are configured without a rate to divide them by.
        """
        super().__init__((XBUS,))
        self._increments = settings.config.get("sample") == "increment"
        self._rate_hz = float(settings.config.get("rate_hz") or 0.0)
        if self._increments and self._rate_hz <= 0.0:
            raise DriverSettingsError('rate_hz: needed with sample = "increment", to divide by the interval')
        self._time_only = time_only
        self._gaps = GapCounter(COUNTER_BITS)
        self._unwrapper = CounterUnwrapper(TICK_BITS, TICK_HZ)
        self._last_second: tuple[Any, ...] | None = None

    def decode_frames(self, frames: list[Frame]) -> list[Record]:
        """Return time messages in order, then the samples of all frames."""
        records: list[Record] = []
        samples: list[Sample] = []
        packets: list[int] = []
        for frame in frames:
            if frame.data[2] != XBUS_MTDATA2:
                continue
            items = read_items(frame.data[6 if frame.data[3] == XBUS_EXTENDED else 4 : -1])
            if items is None:
                self.counters.count_bad("bad_length")
                continue
            packets += items.get(PACKET_COUNTER, ())
            records += self._time_message(frame.host_time_ns, items)
            if not self._time_only:
                samples += self._sample(frame.host_time_ns, items)
        missing = self._gaps.missing(np.array(packets, dtype=np.uint64))
        if missing:
            self.counters.errors["packet_gap"] += missing
        return [*records, self._rows(samples)] if samples else records

    def _time_message(self, host_time_ns: int, items: Mapping[int, Any]) -> list[TimeMessage]:
        """Return a message with the UTC of the first sample of each second; its edge is the one before its arrival."""
        if UTC_TIME not in items:
            return []
        nanosecond, year, month, day, hour, minute, second, flags = items[UTC_TIME]
        named = items[UTC_TIME][1:7]
        if named == self._last_second:
            return []
        try:
            date = dt.date(year, month, day)
        except ValueError:
            date = None
        if date is None or hour > 23 or minute > 59 or second > 60 or nanosecond > SECOND_NS:
            self.counters.errors["bad_value"] += 1
            return []
        self._last_second = named
        tag = TimeTag(TimeScale.UTC, ((hour * 60 + minute) * 60 + second) * SECOND_NS + nanosecond, date=date)
        valid = flags & UTC_VALID == UTC_VALID
        return [TimeMessage(host_time_ns, tag, NamesEdge.PREVIOUS, valid=valid, message="UtcTime")]

    def _sample(self, host_time_ns: int, items: Mapping[int, Any]) -> list[Sample]:
        """Return the sample of a message; an empty list, counted, for a message with only a part of it or with the
        other kind.
        """
        kinds = (DELTA_V, DELTA_Q) if self._increments else (ACCELERATION, RATE_OF_TURN)
        force, rate = (items.get(kind) for kind in kinds)
        if force is None or rate is None:
            if force is not None or rate is not None:
                self.counters.errors["sample_incomplete"] += 1
            elif self._increments and ACCELERATION in items:
                self.counters.errors["rates_only"] += 1
            elif not self._increments and DELTA_V in items:
                self.counters.errors["increments_only"] += 1
            return []
        if self._increments:
            force = tuple(part * self._rate_hz for part in force)
            rate = tuple(part * self._rate_hz for part in rotation_vector(rate))
        if not all(map(isfinite, (*force, *rate))):
            self.counters.count_bad("bad_value")
            return []
        (ticks,) = items.get(SAMPLE_TIME_FINE, (-1,))
        (celsius,) = items.get(TEMPERATURE, (nan,))
        (status,) = items.get(STATUS_WORD) or items.get(STATUS_BYTE) or (0,)
        return [Sample(host_time_ns, ticks, force, rate, celsius, status)]

    def _rows(self, samples: list[Sample]) -> ImuSamples:
        """Convert samples to rows and unwrap their ticks."""
        rows = np.zeros(len(samples), IMU_DTYPE)
        host, ticks, force, rate, celsius, status = zip(*samples, strict=True)
        rows["host_time_ns"], rows["specific_force_b"], rows["angular_rate_b"] = host, force, rate
        rows["temperature_c"], rows["status"] = celsius, status
        rows["pps_time_ns"] = rows["gps_week"] = rows["device_time_ns"] = -1
        raw = np.array(ticks, dtype=np.int64)
        timed = raw >= 0
        counts, restart = self._unwrapper.unwrap(raw[timed].astype(np.uint64), rows["host_time_ns"][timed])
        if restart.any():
            self.counters.errors["restart"] += int(restart.sum())
        rows["device_time_ns"][timed] = nanoseconds(counts, Fraction(TICK_HZ))
        return ImuSamples(rows)


def make_time_parser(settings: DeviceSettings) -> XbusParser:
    """Make the recorder's parser, which returns time messages only."""
    return XbusParser(settings, time_only=True)


DRIVERS = (
    Driver(
        protocol="xsens-xbus",
        kind="imu",
        transports=STREAM_TRANSPORTS,
        yields=(ImuSamples, TimeMessage),
        summary="Xsens MTi over serial: Xbus, MTData2",
        make_parser=XbusParser,
        make_time_parser=make_time_parser,
        names_edge=NamesEdge.PREVIOUS,
    ),
)
