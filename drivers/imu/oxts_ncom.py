"""OxTS RT, xNAV, Survey+ and AV units: NCOM packets of 72 bytes, over UDP or a serial line.

Source: OxTS's own decoder NComRxC (github.com/OxfordTechnicalSolutions/oxts_ros2_driver, ``NComRxC.h`` and
``NComRxC.c``): offsets, units, navigation status, status channels, and the checksums, each the sum of all bytes before
it but the sync. Frames by OxTS's RT3000 v4 manual ("OxTS NED navigation frame", "Vehicle frame").

- Batch A (bytes 1 to 20): milliseconds of the minute, specific force, rate. Batch B (23 to 60): position, velocity,
  heading, pitch, roll. Batch S (63 to 70): one of many status channels, in turn.
- Axes: x forward, y right, z down; angles from north, east, down: Swath's own.
- Time: GPS time; the minute comes in status channel 0, once in a few hundred packets, and is counted on between.
- Height: the unit's altitude is above the geoid, unless configured otherwise; status channel 48 has the undulation.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from math import isfinite, nan
from typing import TypeAlias

from swath.drivers.driver import STREAM_TRANSPORTS, Driver, receiver_inside, times_only
from swath.drivers.framing.framer import Frame, FrameKind
from swath.drivers.framing.parser import FramedParser
from swath.drivers.imu.unit_time import WEEK_NS, Moment, UnitTime
from swath.drivers.parser import DeviceSettings
from swath.drivers.record_rows import Row
from swath.georef.records import (
    DeviceStatus,
    EventMark,
    ImuSamples,
    InsSolution,
    NamesEdge,
    Record,
    TimeMessage,
)
from swath.georef.timescales.gps_time import MILLISECOND_NS, SECOND_NS

Items: TypeAlias = list[Record | Row]
Triple: TypeAlias = tuple[float, float, float]

SYNC = 0xE7
PACKET_BYTES = 72
TIME = slice(1, 3)
FORCE_AT, RATE_AT, STATUS_AT, CHECKSUM_1 = 3, 12, 21, 22
POSITION_AT, VELOCITY_AT, ANGLES_AT, CHECKSUM_2 = 23, 43, 52, 61
CHANNEL_AT, CHANNEL = 62, slice(63, 71)
POSITION = struct.Struct("<2df")  # latitude, longitude (rad), altitude
INVALID = -(1 << 23)  # of a number of 24 bits
FORCE_SCALE, RATE_SCALE, VELOCITY_SCALE, ANGLE_SCALE = 1e-4, 1e-5, 1e-4, 1e-6

RAW, INITIALISING, LOCKING, LOCKED, INTERNAL = 1, 2, 3, 4, 11
EMPTY = (0, 5, 6, 7, 10)  # without measurements, or with status only
TRIGGERS = (20, 21, 22)
PUBLIC = (RAW, INITIALISING, LOCKING, LOCKED, *EMPTY, *TRIGGERS)  # packets of structure A, with all three checksums

SIGMA_CHANNELS = {3: 1e-3, 4: 1e-3, 5: 1e-5}  # of position (m), velocity (m/s), heading, pitch, roll (rad)
SIGMAS_OLD = 150  # age from which they do not hold
SIGMAS = struct.Struct("<3HB")
MODES_CHANNEL, UNDULATION_CHANNEL, OFFSETS_CHANNEL = 0, 48, 16
MODES = struct.Struct("<i4B")  # minute, satellites, modes of position, velocity, attitude
UNSET = 0x80
UNDULATION = struct.Struct("<h")
UNDULATION_UNSET = -(1 << 15)
UNDULATION_SCALE = 0.005
MARKS = {24: ("In1", False), 43: ("In1", True), 65: ("Out1", None)}  # channel: name, rising edge
MARK = struct.Struct("<iHbB")  # minute, millisecond, 4 µs, count
FINE_NS = 4000
MINUTE_MS = 60_000
MINUTES_OF_WEEK = 10_080
GREATEST_MINUTE = 8192 * MINUTES_OF_WEEK
GREATEST_PAUSE_NS = 30 * SECOND_NS  # after it, the minute is unknown until channel 0


def checksum(packet: Sequence[int], end: int) -> int:
    """Return the sum of the bytes from the first after the sync up to ``end``."""
    return sum(packet[1:end]) & 0xFF


def intact(packet: bytes) -> bool:
    """Return whether the last checksum is good, and the other two in packets of the public structure."""
    status = packet[STATUS_AT]
    if checksum(packet, PACKET_BYTES - 1) != packet[-1]:
        return False
    if status not in PUBLIC:
        return status == INTERNAL
    return packet[CHECKSUM_1] == checksum(packet, CHECKSUM_1) and packet[CHECKSUM_2] == checksum(packet, CHECKSUM_2)


def message_name(packet: bytes) -> str:
    """Return the name of the kind of packet by its navigation status."""
    status = packet[STATUS_AT]
    if status in TRIGGERS:
        return "trigger"
    return "internal" if status == INTERNAL else "empty" if status in EMPTY else "regular"


NCOM = FrameKind(
    "ncom", (bytes([SYNC]),), PACKET_BYTES, lambda buffer, start, final: PACKET_BYTES, intact, message_name
)


def numbers_at(packet: bytes, at: int, scale: float) -> Triple:
    """Return three numbers of 24 bits, nan where not valid."""
    found = []
    for start in (at, at + 3, at + 6):
        count = int.from_bytes(packet[start : start + 3], "little", signed=True)
        found.append(nan if count == INVALID else count * scale)
    first, second, third = found
    return first, second, third


def encode_packet(
    status: int,
    millisecond: int,
    *,
    force: Triple = (nan, nan, nan),
    rate: Triple = (nan, nan, nan),
    position: Triple = (0.0, 0.0, 0.0),
    velocity: Triple = (nan, nan, nan),
    angles: Triple = (nan, nan, nan),
    channel: int = 255,
    content: bytes = bytes(8),
) -> bytes:
    """Encode a packet; ``angles`` are heading, pitch, roll.

    Raises:
        OverflowError: a number does not fit.
        ValueError: the content of the channel is not 8 bytes.
    """
    if len(content) != 8:
        raise ValueError("a status channel has 8 bytes")

    def packed(values: Triple, scale: float) -> bytes:
        counts = (round(value / scale) if isfinite(value) else INVALID for value in values)
        return b"".join(count.to_bytes(3, "little", signed=True) for count in counts)

    packet = bytearray([SYNC]) + millisecond.to_bytes(2, "little")
    packet += packed(force, FORCE_SCALE) + packed(rate, RATE_SCALE) + bytes([status])
    packet.append(checksum(packet, CHECKSUM_1))
    packet += POSITION.pack(*position) + packed(velocity, VELOCITY_SCALE) + packed(angles, ANGLE_SCALE)
    packet.append(checksum(packet, CHECKSUM_2))
    packet += bytes([channel]) + content
    packet.append(checksum(packet, PACKET_BYTES - 1))
    return bytes(packet)


@dataclass(slots=True)
class _Latest:
    """State that the status channels bring, and the minute that is counted on between."""

    minute: int | None = None
    millisecond: int = 0
    host_time_ns: int = 0
    undulation_m: float | None = None
    leap_seconds: int | None = None
    sigmas: dict[int, Triple] = field(default_factory=dict)
    counts: dict[int, int] = field(default_factory=dict)
    state: tuple[int, ...] = ()


class NcomParser(FramedParser):
    """Decodes NCOM packets of the public structure; the maker's internal ones are framed and counted.

    Args:
        settings: of the device's table, ``altitude`` is read.
        wanted: the record types to return; None: all.
    """

    def __init__(self, settings: DeviceSettings, *, wanted: tuple[type, ...] | None = None) -> None:
        super().__init__((NCOM,), wanted)
        self._ellipsoidal = settings.config.get("altitude") == "ellipsoid"
        self._time = UnitTime(settings, self.counters, "NCOM")
        self._latest = _Latest()

    def decode_frames(self, frames: list[Frame]) -> Items:
        """Decode consecutive frames; return their records, or rows of them, in order."""
        items: Items = []
        for _, host_time_ns, packet in frames:
            if packet[STATUS_AT] in PUBLIC:
                items += self._decode(host_time_ns, packet)
        return items

    def _decode(self, host_time_ns: int, packet: bytes) -> Items:
        status = packet[STATUS_AT]
        number, content = packet[CHANNEL_AT], packet[CHANNEL]
        if status in TRIGGERS:
            return self._channel(host_time_ns, status, number, content)
        if status in (INITIALISING, LOCKING, LOCKED):
            self._count_minute(host_time_ns, int.from_bytes(packet[TIME], "little"))
            if number == MODES_CHANNEL:
                self._latest.minute = MODES.unpack(content)[0]
        items = self._channel(host_time_ns, status, number, content)
        if status in EMPTY:
            return items
        moment = self._moment() if status != RAW else None
        items += self._time.name_second(host_time_ns, moment, self._latest.leap_seconds)
        return [*items, *self._sample(host_time_ns, packet, moment), *self._solution(host_time_ns, packet, moment)]

    # --- time ---

    def _count_minute(self, host_time_ns: int, millisecond: int) -> None:
        """Count the minute on where its milliseconds begin again; a jump or a pause makes it unknown."""
        latest = self._latest
        step_ms = (millisecond - latest.millisecond) % MINUTE_MS
        if latest.minute is not None:
            paused = not 0 <= host_time_ns - latest.host_time_ns < GREATEST_PAUSE_NS
            if step_ms > MINUTE_MS // 2 or paused or millisecond >= MINUTE_MS:
                self.counters.errors["time_jump"] += 1
                latest.minute = None
            elif millisecond < latest.millisecond:
                latest.minute += 1
        latest.millisecond, latest.host_time_ns = millisecond, host_time_ns

    def _moment(self) -> Moment | None:
        """Return GPS time of the packet; None while its minute is unknown."""
        latest = self._latest
        if latest.minute is None or latest.millisecond >= MINUTE_MS:
            return None
        return self._moment_of(latest.minute, latest.millisecond * MILLISECOND_NS)

    def _moment_of(self, minute: int, of_minute_ns: int) -> Moment | None:
        if not 0 <= minute < GREATEST_MINUTE:
            return None
        week, tow_ns = divmod(minute * 60 * SECOND_NS + of_minute_ns, WEEK_NS)
        return self._time.moment(week, tow_ns, valid=True)

    # --- measurements ---

    def _sample(self, host_time_ns: int, packet: bytes, moment: Moment | None) -> Items:
        force, rate = numbers_at(packet, FORCE_AT, FORCE_SCALE), numbers_at(packet, RATE_AT, RATE_SCALE)
        if not all(map(isfinite, (*force, *rate))):
            self.counters.errors["sample_incomplete"] += 1
            return []
        tow_ns, week = (moment.tow_ns, moment.week) if moment is not None else (-1, -1)
        return [Row(ImuSamples, (host_time_ns, tow_ns, -1, force, rate, nan, packet[STATUS_AT], week))]

    def _solution(self, host_time_ns: int, packet: bytes, moment: Moment | None) -> Items:
        """Return the solution of a packet, its height above the ellipsoid; reasons for none are counted."""
        if packet[STATUS_AT] not in (LOCKING, LOCKED):
            self.counters.errors["ins_no_solution"] += 1
            return []
        position = POSITION.unpack_from(packet, POSITION_AT)
        heading, pitch, roll = numbers_at(packet, ANGLES_AT, ANGLE_SCALE)
        undulation_m = 0.0 if self._ellipsoidal else self._latest.undulation_m
        if not all(map(isfinite, (*position, heading, pitch, roll))):
            self.counters.errors["bad_value"] += 1
        elif moment is None:
            self.counters.errors["time_unknown"] += 1
        elif undulation_m is None:
            self.counters.errors["undulation_unknown"] += 1
        else:
            return [Row(InsSolution, self._row(host_time_ns, packet, moment, position, undulation_m))]
        return []

    def _row(
        self, host_time_ns: int, packet: bytes, moment: Moment, position: Triple, undulation_m: float
    ) -> tuple[object, ...]:
        heading, pitch, roll = numbers_at(packet, ANGLES_AT, ANGLE_SCALE)
        position_sigma, velocity_sigma, angles_sigma = (
            self._latest.sigmas.get(channel, (nan, nan, nan)) for channel in SIGMA_CHANNELS
        )
        return (
            host_time_ns,
            moment.gps_ns,
            *(position[0], position[1], position[2] + undulation_m),
            numbers_at(packet, VELOCITY_AT, VELOCITY_SCALE),
            *(roll, pitch, heading),
            position_sigma,
            velocity_sigma,
            angles_sigma[::-1],
            packet[STATUS_AT],
        )

    # --- status channels ---

    def _channel(self, host_time_ns: int, status: int, number: int, content: bytes) -> Items:
        """Take a status channel; return the event that it stamps or the state that it changes."""
        latest = self._latest
        if number in SIGMA_CHANNELS:
            first, second, third, age = SIGMAS.unpack_from(content)
            scale = SIGMA_CHANNELS[number]
            latest.sigmas[number] = (first * scale, second * scale, third * scale)
            if age >= SIGMAS_OLD:
                del latest.sigmas[number]
        elif number == UNDULATION_CHANNEL:
            (count,) = UNDULATION.unpack_from(content)
            latest.undulation_m = None if count == UNDULATION_UNSET else count * UNDULATION_SCALE
        elif number == OFFSETS_CHANNEL and content[7] & 1:
            offset_s = int.from_bytes(content[7:], signed=True) >> 1  # UTC minus GPS time
            latest.leap_seconds = -offset_s if offset_s < 0 else None
        elif number in MARKS:
            return self._mark(host_time_ns, status, number, content)
        elif number == MODES_CHANNEL:
            return self._state(host_time_ns, status, content)
        return []

    def _mark(self, host_time_ns: int, status: int, number: int, content: bytes) -> Items:
        """Return an event where its count has changed; the channel is repeated between events."""
        minute, millisecond, fine, count = MARK.unpack(content)
        before = self._latest.counts.get(number)
        self._latest.counts[number] = count
        if count == before or (before is None and status not in TRIGGERS):
            return []
        moment = self._moment_of(minute, millisecond * MILLISECOND_NS + fine * FINE_NS)
        if moment is None:
            self.counters.errors["time_unknown"] += 1
            return []
        name, rising = MARKS[number]
        return [EventMark(host_time_ns, moment.tag, name, rising=rising, count=count, message=f"channel {number}")]

    def _state(self, host_time_ns: int, status: int, content: bytes) -> Items:
        """Return navigation status and the receiver's modes where one has changed."""
        _, satellites, position, velocity, attitude = MODES.unpack(content)
        state = (status, position, velocity, attitude)
        if state == self._latest.state:
            return []
        self._latest.state = state
        values: dict[str, float | int | str | bool] = {"navigation_status": status}
        names = ("position_mode", "velocity_mode", "attitude_mode", "satellites")
        numbers = (position, velocity, attitude, satellites)
        values |= {name: number for name, number in zip(names, numbers, strict=True) if not number & UNSET}
        return [DeviceStatus(host_time_ns, values, message="channel 0")]


make_time_parser = times_only(NcomParser)

UNIT = Driver(
    protocol="oxts-ncom",
    kind="imu",
    transports=STREAM_TRANSPORTS,
    yields=(ImuSamples, InsSolution, TimeMessage, EventMark, DeviceStatus),
    summary="OxTS by NCOM: INS with sigmas, accelerations and rates, triggers",
    make_parser=NcomParser,
    make_time_parser=make_time_parser,
    names_edge=NamesEdge.PREVIOUS,
)
DRIVERS = (UNIT, receiver_inside(UNIT))
