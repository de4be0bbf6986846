"""NMEA 2000: attitude, rate of turn, heading, heave, position and time of the devices on a vessel's bus.

The 29-bit identifier contains priority, PGN and source address (SAE J1939-21); data are little-endian, and the largest
values of a field mean that it is not available. Layouts: canboat, docs/canboat.json (Apache-2.0), facts only. Several
devices send the same PGN: one source is used for each, `source_address` or else the first that sends it.

Rates and angles come at 10 to 20 Hz and without a device time: they become status records, not inertial samples.
Positions of 129025 and 129026 have no time and become status too, as do the DOPs of 129539; 129029, which has a time,
becomes a `GnssFix`. Its altitude is "referenced to WGS-84" (canboat, also gpsd), but receivers on the recorded bus send
heights above the sea in it: the setting ``altitude`` says which it is, and without it fixes have no height.

Fast packets: messages of up to 223 bytes in up to 32 frames of one identifier. The first data byte of each frame is
``sequence << 5 | frame``: the sequence number (0 … 7) identifies the message by source and PGN, so that messages of
many sources may be interleaved. Frame 0 continues with the length in bytes and six bytes of the message, each other
frame with seven; the last one is padded (canboat, docs: "fast packet").
"""

from __future__ import annotations

import datetime as dt
import struct
from dataclasses import dataclass
from math import pi, radians
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swath.drivers.can_frames import CAN_EFF_FLAG, CAN_ERR_FLAG, CAN_RTR_FLAG, decode_can_frames
from swath.drivers.driver import Driver, receiver_inside
from swath.drivers.parser import DeviceSettings, DriverSettingsError, PacketParser
from swath.georef.arrays import Int64Array, StructArray
from swath.georef.records import (
    ByteRows,
    DeviceStatus,
    FixType,
    GnssFix,
    GnssHeading,
    NamesEdge,
    Record,
    TimeMessage,
    TimeScale,
    TimeTag,
)

LARGEST_MESSAGE_BYTES = 223
FIRST_BYTES = 6  # bytes of the message in frame 0
TIMEOUT_NS = 750_000_000  # the longest pause between frames of one message

LARGEST_SOURCE = 253  # 254 is "no address", 255 the broadcast address
SPECIAL_VALUES = 3  # largest values of a field: not available, out of range, reserved
SYSTEM_TIME, HEADING, GNSS_POSITION = 126992, 127250, 129029
TIME_UNIT_NS = 100_000  # 1e-4 s
DAY_UNITS = 864_010_000  # a day with a leap second, in 1e-4 s
UNIX_EPOCH = dt.date(1970, 1, 1)
SATELLITE_TIME_SOURCES = (0, 1)  # in 126992: GPS, GLONASS; the others are radio and local clocks
TRUE_NORTH, MAGNETIC_NORTH = 0, 1
ALTITUDES = ("ellipsoid", "geoid")  # what the altitude of 129029 may count from


class Field(NamedTuple):
    """A number in a single frame: key with its unit, offset in bytes, type, value of one count."""

    name: str
    offset: int
    dtype: str
    scale: float


class Bits(NamedTuple):
    """A small code in a single frame: key, byte, number of low bits."""

    name: str
    offset: int
    length: int


class Layout(NamedTuple):
    """A single-frame message: minimum number of bytes, numbers, codes."""

    needs_bytes: int
    fields: tuple[Field, ...]
    codes: tuple[Bits, ...] = ()


SINGLE_FRAMES = {
    SYSTEM_TIME: Layout(8, (Field("date", 2, "<u2", 1), Field("time", 4, "<u4", 1)), (Bits("source", 1, 4),)),
    HEADING: Layout(
        8,
        (
            Field("heading_rad", 1, "<u2", 1e-4),
            Field("deviation_rad", 3, "<i2", 1e-4),
            Field("variation_rad", 5, "<i2", 1e-4),
        ),
        (Bits("reference", 7, 2),),
    ),
    127251: Layout(5, (Field("rate_of_turn_radps", 1, "<i4", 3.125e-8),)),
    127252: Layout(3, (Field("heave_m", 1, "<i2", 0.01),)),
    127257: Layout(
        7, (Field("yaw_rad", 1, "<i2", 1e-4), Field("pitch_rad", 3, "<i2", 1e-4), Field("roll_rad", 5, "<i2", 1e-4))
    ),
    129025: Layout(8, (Field("lat_deg", 0, "<i4", 1e-7), Field("lon_deg", 4, "<i4", 1e-7))),
    129026: Layout(
        6, (Field("course_rad", 2, "<u2", 1e-4), Field("speed_mps", 4, "<u2", 0.01)), (Bits("reference", 1, 2),)
    ),
    129539: Layout(8, (Field("hdop", 2, "<i2", 0.01), Field("vdop", 4, "<i2", 0.01), Field("tdop", 6, "<i2", 0.01))),
}
# 129029: SID, date (days), time (1e-4 s), latitude, longitude (1e-16 deg), altitude (1e-6 m), type and method,
# integrity, satellites, HDOP, PDOP (0.01), geoidal separation (0.01 m), number of reference stations; stations follow
GNSS_STRUCT = struct.Struct("<BHIqqqBBBhhiB")
METHODS = {
    0: FixType.NONE,
    1: FixType.SINGLE,
    2: FixType.DIFFERENTIAL,
    3: FixType.SINGLE,
    4: FixType.RTK_FIXED,
    5: FixType.RTK_FLOAT,
    6: FixType.DEAD_RECKONING,
    7: FixType.MANUAL,
    8: FixType.SIMULATED,
}

Values = dict[str, float]


class Nmea2000Parser(PacketParser):
    """Decodes the frames of a bus; one source is used for each PGN, and all are counted in ``counters.messages``."""

    def __init__(self, settings: DeviceSettings, *, time_only: bool = False) -> None:
        """Prepare a parser for one bus.

        Args:
            settings: the device's table.
            time_only: return time messages only, for the recorder.

        Raises:
            DriverSettingsError: source_address is not the address of a device, or altitude no reference.
        """
        super().__init__()
        wanted = settings.config.get("source_address")
        if wanted is not None and (type(wanted) is not int or not 0 <= wanted <= LARGEST_SOURCE):
            raise DriverSettingsError(f"source_address: got {wanted!r}, want 0 to {LARGEST_SOURCE}")
        altitude = settings.config.get("altitude")
        if altitude not in (None, *ALTITUDES):
            raise DriverSettingsError(f"altitude: got {altitude!r}, want {' or '.join(ALTITUDES)}")
        self._altitude: str | None = altitude
        self._source = settings.source
        self._without_height: tuple[float, float | None] | None = None  # first altitude that no setting explains
        self._wanted: int | None = wanted
        self._used: dict[int, int] = {}  # PGN -> the source used
        self._packets = FastPackets()
        self._single = {SYSTEM_TIME: SINGLE_FRAMES[SYSTEM_TIME]} if time_only else SINGLE_FRAMES
        self._time_only = time_only

    def parse_units(self, host_time_ns: Int64Array, units: ByteRows) -> list[Record]:
        """Decode CAN frames, (n, 16) or (n, 72)."""
        self.counters.bytes += units.size
        table = decode_can_frames(units)
        if table is None:
            self.counters.count_bad("bad_length", len(units))
            return []
        pgn, source = self._addresses(table["can_id"])
        found: list[tuple[int, list[Record]]] = []
        for number, layout in self._single.items():
            where = np.flatnonzero(pgn == number)
            if len(where):
                found += self._single_frames(number, layout, where, source, table, host_time_ns)
        if not self._time_only:
            found += self._fast_frames(np.flatnonzero(pgn == GNSS_POSITION), source, table, host_time_ns)
        return [record for _, records in sorted(found, key=lambda item: item[0]) for record in records]

    def close(self) -> list[Record]:
        """Count the messages that the end of the stream leaves unfinished."""
        self._packets.close()
        self._take_packet_counts()
        return []

    def remarks(self) -> list[str]:
        """Return a line where fixes lack a height because no setting says what their altitude counts from."""
        if self._without_height is None:
            return []
        altitude_m, separation_m = self._without_height
        geoid = "no geoidal separation" if separation_m is None else f"geoidal separation {separation_m:.1f} m"
        return [
            f"{self._source}: fixes have no height, because receivers disagree about what their altitude counts from "
            f"(here {altitude_m:.1f} m, {geoid}); in the [imu.…] table of the bus set "
            'altitude = "ellipsoid", as the standard says, or "geoid", if it is above the sea'
        ]

    # -- frames

    def _addresses(self, can_id: NDArray[np.uint32]) -> tuple[Int64Array, Int64Array]:
        """Return PGN (−1 unless it is a data frame with 29 bits) and source address of each frame."""
        flagged = can_id & np.uint32(CAN_ERR_FLAG | CAN_RTR_FLAG)
        errors = int(np.count_nonzero(flagged & np.uint32(CAN_ERR_FLAG)))
        remote = int(np.count_nonzero(flagged)) - errors
        for code, count in (("error_frame", errors), ("rtr_frame", remote)):
            if count:
                self.counters.errors[code] += count
        pgn, source = pgn_and_source(can_id)
        return np.where((can_id & np.uint32(CAN_EFF_FLAG) != 0) & (flagged == 0), pgn, -1), source

    def _source_of(self, pgn: int, first: int) -> int:
        """Return the source used for a PGN; ``first`` is the source of its first message."""
        return self._wanted if self._wanted is not None else self._used.setdefault(pgn, first)

    def _single_frames(
        self,
        pgn: int,
        layout: Layout,
        where: NDArray[np.intp],
        source: Int64Array,
        table: StructArray,
        host_time_ns: Int64Array,
    ) -> list[tuple[int, list[Record]]]:
        """Return row and records of each frame of a single-frame PGN."""
        whole = where[table["length"][where] >= layout.needs_bytes]
        if len(whole) < len(where):
            self.counters.count_bad("bad_length", len(where) - len(whole))
        if not len(whole):
            return []
        self.counters.messages[str(pgn)] += len(whole)
        used = whole[source[whole] == self._source_of(pgn, int(source[whole[0]]))]
        if len(used) < len(whole):
            self.counters.errors["other_source"] += len(whole) - len(used)
        columns = decode_columns(layout, table["data"][used])
        host = host_time_ns[used].tolist()
        found: list[tuple[int, list[Record]]] = []
        for n, row in enumerate(used.tolist()):
            values = {name: value for name, column in columns.items() if (value := column[n]) is not None}
            found.append((row, self._records_of(pgn, host[n], values)))
        return found

    def _fast_frames(
        self, where: NDArray[np.intp], source: Int64Array, table: StructArray, host_time_ns: Int64Array
    ) -> list[tuple[int, list[Record]]]:
        """Return row and records of each completed 129029, which make up few of a bus's frames."""
        found: list[tuple[int, list[Record]]] = []
        lengths = np.minimum(table["length"][where], 8).tolist()
        data = np.ascontiguousarray(table["data"][where][:, :8])
        for n, row in enumerate(where.tolist()):
            sender = int(source[row])
            message = self._packets.take(sender, int(host_time_ns[row]), data[n, : lengths[n]].tobytes())
            if message is None:
                continue
            if len(message) < GNSS_STRUCT.size:
                self.counters.count_bad("bad_length")
                continue
            self.counters.messages[str(GNSS_POSITION)] += 1
            if sender != self._source_of(GNSS_POSITION, sender):
                self.counters.errors["other_source"] += 1
                continue
            found.append((row, self._position_records(int(host_time_ns[row]), message)))
        self._take_packet_counts()
        return found

    def _take_packet_counts(self) -> None:
        """Move the counts of the reassembly into the parser's counters."""
        if self._packets.incomplete:
            self.counters.errors["fast_packet_incomplete"] += self._packets.incomplete
        if self._packets.bad_length:
            self.counters.count_bad("bad_length", self._packets.bad_length)
        self._packets.incomplete = self._packets.bad_length = 0

    # -- records

    def _records_of(self, pgn: int, host_time_ns: int, values: Values) -> list[Record]:
        """Return the records of one single-frame message."""
        if pgn == SYSTEM_TIME:
            return self._time_records(host_time_ns, values)
        records: list[Record] = [DeviceStatus(host_time_ns, {**values}, message=str(pgn))]
        heading_rad = true_heading_rad(values) if pgn == HEADING else None
        if heading_rad is not None:
            records.append(GnssHeading(host_time_ns, None, heading_rad, message=str(pgn)))
        return records

    def _tag(self, days: int, time: int) -> TimeTag | None:
        """Return UTC of a date and time of day; where they are invalid, count them and return None."""
        if time > DAY_UNITS:
            self.counters.count_bad("bad_value")
            return None
        return TimeTag(TimeScale.UTC, time * TIME_UNIT_NS, date=UNIX_EPOCH + dt.timedelta(days=days))

    def _time_records(self, host_time_ns: int, values: Values) -> list[Record]:
        """Return the time message of 126992, valid where the time comes from satellites."""
        if "date" not in values or "time" not in values:
            self.counters.errors["time_not_available"] += 1
            return []
        tag = self._tag(int(values["date"]), int(values["time"]))
        if tag is None:
            return []
        valid = values["source"] in SATELLITE_TIME_SOURCES
        return [TimeMessage(host_time_ns, tag, NamesEdge.PREVIOUS, valid=valid, message=str(SYSTEM_TIME))]

    def _position_records(self, host_time_ns: int, message: bytes) -> list[Record]:
        """Return the fix of 129029 and a status with its other values."""
        _, days, time, lat, lon, altitude, kinds, integrity, satellites, hdop, pdop, separation, _ = (
            GNSS_STRUCT.unpack_from(message)
        )
        method = kinds >> 4
        numbers = {
            "altitude_m": (altitude, 63, 1e-6),
            "geoidal_separation_m": (separation, 31, 0.01),
            "hdop": (hdop, 15, 0.01),
            "pdop": (pdop, 15, 0.01),
        }
        values = {name: raw * scale for name, (raw, bits, scale) in numbers.items() if is_available(raw, bits)}
        status: dict[str, float | int | str | bool] = {**values, "method": method, "integrity": integrity & 3}
        records: list[Record] = [DeviceStatus(host_time_ns, status, message=str(GNSS_POSITION))]
        if not (is_available(days, 16) and is_available(time, 32)):
            self.counters.errors["time_not_available"] += 1
            return records
        tag = self._tag(days, time)
        if tag is None:
            return records
        lat_deg, lon_deg = lat * 1e-16, lon * 1e-16
        has_position = is_available(lat, 63) and is_available(lon, 63)
        if has_position and (abs(lat_deg) > 90.0 or abs(lon_deg) > 180.0):
            self.counters.count_bad("bad_value")
            return records
        fix_type = METHODS.get(method, FixType.NONE) if has_position else FixType.NONE
        height_m, undulation_m = self._height(values) if has_position else (None, None)
        fix = GnssFix(
            host_time_ns=host_time_ns,
            time=tag,
            lat_rad=radians(lat_deg) if has_position else None,
            lon_rad=radians(lon_deg) if has_position else None,
            height_m=height_m,
            fix_type=fix_type,
            satellites=satellites if is_available(satellites, 8) else None,
            valid=fix_type is not FixType.NONE,
            message=str(GNSS_POSITION),
            undulation_m=undulation_m,
        )
        return [*records, fix]

    def _height(self, values: Values) -> tuple[float | None, float | None]:
        """Return ellipsoidal height and undulation of a position; no height where its altitude cannot be placed."""
        altitude_m, separation_m = values.get("altitude_m"), values.get("geoidal_separation_m")
        if altitude_m is None or self._altitude == "ellipsoid":
            return altitude_m, separation_m if altitude_m is not None else None
        if self._altitude is None:
            self._without_height = self._without_height or (altitude_m, separation_m)
            return None, None
        if separation_m is None:
            self.counters.errors["separation_not_available"] += 1
            return None, None
        return altitude_m + separation_m, separation_m


def pgn_and_source(can_id: NDArray[np.uint32]) -> tuple[Int64Array, Int64Array]:
    """Return PGN and source address of (n,) 29-bit identifiers (SAE J1939-21).

    PDU format below 240 means that the next byte is a destination and no part of the PGN.
    """
    identifier = can_id.astype(np.int64)
    pgn = identifier >> 8 & 0x3FFFF
    return np.where((pgn >> 8 & 0xFF) < 240, pgn & 0x3FF00, pgn), identifier & 0xFF


def is_available(raw: int, bits: int) -> bool:
    """Return whether a field has a value; ``bits`` are those of its largest value (15 for a signed field of 16)."""
    return raw <= (1 << bits) - 1 - SPECIAL_VALUES


def decode_columns(layout: Layout, data: ByteRows) -> dict[str, list[float | None]]:
    """Return numbers and codes of (n, 8 or more) data bytes by name; None where not available."""
    columns: dict[str, list[float | None]] = {}
    for field in layout.fields:
        dtype = np.dtype(field.dtype)
        raw = np.ascontiguousarray(data[:, field.offset : field.offset + dtype.itemsize]).view(dtype).reshape(-1)
        known = raw <= np.iinfo(dtype).max - SPECIAL_VALUES
        values = raw * field.scale if field.scale != 1 else raw
        columns[field.name] = [
            value if good else None for value, good in zip(values.tolist(), known.tolist(), strict=True)
        ]
    for code in layout.codes:
        columns[code.name] = (data[:, code.offset] & ((1 << code.length) - 1)).tolist()
    return columns


def true_heading_rad(values: Values) -> float | None:
    """Return the heading from true north, 0 … 2π; None where 127250 does not give enough.

    A magnetic heading needs the variation (east positive); the compass's deviation is added where it is available.
    """
    heading = values.get("heading_rad")
    if heading is None:
        return None
    if values["reference"] == TRUE_NORTH:
        return heading % (2 * pi)
    if values["reference"] != MAGNETIC_NORTH or "variation_rad" not in values:
        return None
    return (heading + values.get("deviation_rad", 0.0) + values["variation_rad"]) % (2 * pi)


def make_time_parser(settings: DeviceSettings) -> Nmea2000Parser:
    """Make the recorder's parser, which returns time messages only."""
    return Nmea2000Parser(settings, time_only=True)


BUS = Driver(
    protocol="nmea2000",
    kind="imu",
    transports=("can",),
    yields=(GnssHeading, GnssFix, TimeMessage, DeviceStatus),
    summary="NMEA 2000 bus: heading, attitude, rate of turn, heave, position, time",
    make_parser=Nmea2000Parser,
    make_time_parser=make_time_parser,
    names_edge=NamesEdge.PREVIOUS,
)
DRIVERS = (BUS, receiver_inside(BUS))


@dataclass(slots=True)
class _Open:
    """A message in progress; ``data`` is None once it is lost, and its remaining frames are discarded."""

    length: int
    next_frame: int
    host_time_ns: int
    data: bytearray | None


class FastPackets:
    """Reassembles the fast packets of one PGN; keeps at most one message for each source and sequence number.

    Attributes:
        incomplete: messages lost by a missing, repeated or late frame, or by the end of the stream.
        bad_length: first frames that announce more than 223 bytes, or 0.
    """

    def __init__(self) -> None:
        self.incomplete = 0
        self.bad_length = 0
        self._open: dict[tuple[int, int], _Open] = {}  # by source and sequence number: 256 · 8 at most

    def take(self, source: int, host_time_ns: int, data: bytes) -> bytes | None:
        """Take the data bytes of a frame; return the message that it completes."""
        if not data:
            self.bad_length += 1
            return None
        key, frame = (source, data[0] >> 5), data[0] & 0x1F
        if frame == 0:
            return self._begin(key, host_time_ns, data)
        message = self._open.get(key)
        if message is None or (message.data is None and frame < message.next_frame):
            self._lose(key, frame, host_time_ns)  # its first frame never came
            return None
        if message.data is None:
            message.next_frame = frame + 1
            return None
        late = host_time_ns - message.host_time_ns > TIMEOUT_NS
        if frame != message.next_frame or late:
            self._lose(key, frame, host_time_ns)
            return None
        message.data += data[1:]
        message.next_frame, message.host_time_ns = frame + 1, host_time_ns
        if len(message.data) < message.length and len(data) < 8:  # only the last frame may be short
            self._lose(key, frame, host_time_ns)
            return None
        return self._completed(key, message)

    def close(self) -> None:
        """Count the messages that the end of the stream leaves unfinished."""
        self.incomplete += sum(message.data is not None for message in self._open.values())
        self._open.clear()

    def _begin(self, key: tuple[int, int], host_time_ns: int, data: bytes) -> bytes | None:
        """Start a message with its frame 0; an open message of the same number is lost."""
        before = self._open.pop(key, None)
        if before is not None and before.data is not None:
            self.incomplete += 1
        length = data[1] if len(data) > 1 else 0
        if not 0 < length <= LARGEST_MESSAGE_BYTES:
            self.bad_length += 1
            self._open[key] = _Open(0, 1, host_time_ns, None)
            return None
        message = _Open(length, 1, host_time_ns, bytearray(data[2 : 2 + FIRST_BYTES]))
        self._open[key] = message
        return self._completed(key, message)

    def _completed(self, key: tuple[int, int], message: _Open) -> bytes | None:
        """Return the message once all its bytes are present."""
        if message.data is None or len(message.data) < message.length:
            return None
        del self._open[key]
        return bytes(message.data[: message.length])

    def _lose(self, key: tuple[int, int], frame: int, host_time_ns: int) -> None:
        """Count a lost message and discard its remaining frames."""
        self.incomplete += 1
        self._open[key] = _Open(0, frame + 1, host_time_ns, None)
