"""NovAtel OEM7 (and OEM4 to OEM6) binary and ASCII logs, long and short headers, with or without SPAN.

`swath.drivers.framing.framer` does framing and checksum; layouts and tables are in `swath.drivers.gnss.novatel`.
Prompts (``[COM1]``), abbreviated ASCII logs (``<BESTPOS``), NMEA and RTCM3 between the logs are framed or skipped, and
counted. A log is decoded alike in ASCII and in binary, so a stream with both forms of one log gives its records twice.

Records by log:

- TIME: the second of the previous edge, and leap seconds when its UTC status is VALID. BESTPOS and INSPVAX on the whole
  second give it too. All of them only while the receiver's time status is FINE, FINESTEERING or FINEBACKUPSTEERING.
- BESTPOS, PPPPOS, BESTVEL: `GnssFix`. INSPVA(S), INSPVAX, INSATT(S), INSATTX: `InsSolution`, with the receiver's INS
  status: the receiver sends rows before alignment too, see `tables.INS_NAVIGATING`.
- RAWIMU(S), RAWIMUX(S): `ImuSamples` in the axes marked on the IMU. Scaling the counts needs the IMU's type, which
  RAWIMUX and INSCONFIG give, or the setting ``imu_type``; without it they are counted as ``imu_scale_unknown``.
- CORRIMU…: motion of the vehicle with gravity and earth rotation removed, so `DeviceStatus`, not `ImuSamples`.
- HEADING2, HEADING, DUALANTENNAHEADING: `GnssHeading`. MARKxTIME: `EventMark`.
"""

from __future__ import annotations

from dataclasses import replace

from swath.drivers.driver import STREAM_TRANSPORTS, Driver, times_only
from swath.drivers.framing.framer import Frame
from swath.drivers.framing.kinds import NMEA, NOVATEL, NOVATEL_ASCII, NOVATEL_SHORT, RTCM3
from swath.drivers.framing.parser import FramedParser
from swath.drivers.gnss.date_floor import ReceiverDates
from swath.drivers.gnss.novatel import ascii as text
from swath.drivers.gnss.novatel import layouts as nov
from swath.drivers.gnss.novatel import tables
from swath.drivers.gnss.novatel.records import DECODERS, Header, State
from swath.drivers.gnss.novatel.startup import startup_messages
from swath.drivers.parser import DeviceSettings, DriverSettingsError
from swath.drivers.record_rows import Row
from swath.georef.records import (
    DeviceStatus,
    EventMark,
    GnssFix,
    GnssHeading,
    ImuSamples,
    InsSolution,
    NamesEdge,
    Record,
    TimeMessage,
)

TIME_NAMING = frozenset(("BESTPOS", "INSPVAX"))  # logs besides TIME that are computed at the epoch in their header
RAW_RANGES = {43: "RANGE", 140: "RANGECMP", 1273: "RANGECMP2", 2050: "RANGECMP4"}  # measured at their header's epoch


GIVES: dict[type[nov.Body], tuple[type, ...]] = {  # record types of a body; a body without a wanted type is not decoded
    nov.Time: (TimeMessage,),
    nov.BestPos: (TimeMessage, GnssFix),
    nov.BestVel: (GnssFix,),
    nov.InsPva: (InsSolution,),
    nov.InsPvax: (TimeMessage, InsSolution),
    nov.InsAtt: (InsSolution,),
    nov.InsAttx: (InsSolution,),
    nov.RawImu: (ImuSamples,),
    nov.RawImux: (ImuSamples,),
    nov.CorrImu: (DeviceStatus,),
    nov.CorrImuData: (DeviceStatus,),
    nov.MarkTime: (EventMark,),
    nov.Heading2: (GnssHeading,),
    nov.Heading: (GnssHeading,),
    nov.InsConfig: (ImuSamples,),
}


def message_name(frame: bytes) -> str:
    """Return a name such as ``BESTPOS``, or ``NOVATEL-1234`` without one here; answers to commands end in
    ``-response``.
    """
    number = int.from_bytes(frame[4:6], "little")
    layout = nov.LAYOUTS.get(number)
    name = layout.name if layout else nov.OTHER_NAMES.get(number, f"NOVATEL-{number}")
    is_long = frame[:3] == nov.SYNC_LONG
    return f"{name}-response" if is_long and frame[6] & nov.RESPONSE_BIT else name


FRAME_KINDS = (
    replace(NOVATEL, message_name=message_name),
    replace(NOVATEL_SHORT, message_name=message_name),
    NOVATEL_ASCII,
    NMEA,
    RTCM3,
)


class NovatelParser(FramedParser):
    """Decodes the logs listed above; all others are framed and counted."""

    def __init__(self, settings: DeviceSettings, *, wanted: tuple[type, ...] | None = None) -> None:
        """Prepare a parser for one receiver.

        Args:
            settings: of the device's table, ``imu_type``, ``date_floor`` and ``add_weeks`` are read.
            wanted: the record types to return; None: all.

        Raises:
            DriverSettingsError: the IMU type is not in the table, or ``date_floor`` or ``add_weeks`` is invalid.
        """
        super().__init__(FRAME_KINDS, wanted)
        self._bodies = {body for body, gives in GIVES.items() if wanted is None or not set(wanted).isdisjoint(gives)}
        self._state = State(self.counters, ReceiverDates(settings), imu_scale(settings))
        self._last_named: tuple[int, int] = (-1, -1)
        self._has_solutions = False  # solutions give the second, so raw measurements, which come later, are not used

    def remarks(self) -> list[str]:
        """Return remarks on the receiver's weeks."""
        return self._state.dates.remarks()

    def decode_frames(self, frames: list[Frame]) -> list[Record | Row]:
        """Decode consecutive frames; return their records, or rows of them, in order."""
        logs = (frame for frame in frames if frame.kind.startswith("novatel"))
        return [item for log in logs for item in self._decode(log)]

    def _decode(self, frame: Frame) -> list[Record | Row]:
        """Decode one frame; a body that is too short or cannot be read is counted."""
        if frame.kind == NOVATEL_ASCII.name:
            return self._decode_ascii(frame)
        number = int.from_bytes(frame.data[4:6], "little")
        if number in RAW_RANGES:
            return self._second_of_raw(_split(frame, RAW_RANGES[number], self._state.dates)[0])
        layout = nov.LAYOUTS.get(number)
        if layout is None or layout.body not in self._bodies:
            return []
        header, body = _split(frame, layout.name, self._state.dates)
        if header is None:
            return []
        if len(body) < layout.wire.size:
            self.counters.count_bad("bad_length")
            return []
        return self._records(header, layout.body._make(layout.wire.unpack_from(body)))

    def _decode_ascii(self, frame: Frame) -> list[Record | Row]:
        name = NOVATEL_ASCII.message_name(frame.data)
        layout = nov.LAYOUTS.get(nov.IDS.get(name, -1))
        is_raw = name in RAW_RANGES.values()
        if not is_raw and (layout is None or layout.body not in self._bodies):
            return []
        try:
            head, texts = text.split_log(frame.data)
            fields = text.read_header(frame.data, head)
            week = self._state.dates.week(fields.week, frame.host_time_ns)
            floor_week = self._state.floor_week
            header = Header(
                name, frame.host_time_ns, week, fields.milliseconds, fields.time_status, fields.source, floor_week
            )
            if is_raw or layout is None:
                return self._second_of_raw(header)
            return self._records(header, text.read_body(layout.body, layout.wire, texts))
        except text.FieldError:
            self.counters.count_bad("bad_field")
            return []

    def _records(self, header: Header, message: nov.Body) -> list[Record | Row]:
        return [*self._named_second(header), *DECODERS[type(message)](self._state, header, message)]

    def _named_second(self, header: Header) -> list[TimeMessage]:
        """Return the whole second of a synchronous solution, once for all logs of an epoch."""
        epoch = (header.week, header.milliseconds)
        if header.name not in TIME_NAMING or header.milliseconds % 1000 or epoch == self._last_named:
            return []
        if not header.time_valid or header.time_status is None:
            return []
        self._last_named, self._has_solutions = epoch, True
        return [TimeMessage(header.host_time_ns, header.tag(), NamesEdge.PREVIOUS, message=header.name)]

    def _second_of_raw(self, header: Header | None) -> list[Record | Row]:
        """Return the whole second of raw measurements, in a log for post-processing that contains no solution."""
        wanted = self._wanted is None or TimeMessage in self._wanted
        if header is None or self._has_solutions or not wanted:
            return []
        epoch = (header.week, header.milliseconds)
        if header.milliseconds % 1000 or epoch == self._last_named or not header.time_valid:
            return []
        if header.time_status is None:
            return []
        self._last_named = epoch
        return [TimeMessage(header.host_time_ns, header.tag(), NamesEdge.PREVIOUS, message=header.name)]


def _split(frame: Frame, name: str, dates: ReceiverDates) -> tuple[Header | None, bytes]:
    """Split a frame into header and body; the header is None for answers to commands and for other formats."""
    data = frame.data
    if data[:3] == nov.SYNC_SHORT:
        short = nov.ShortHeader._make(nov.SHORT_HEADER.unpack_from(data))
        week = dates.week(short.week, frame.host_time_ns)
        header = Header(name, frame.host_time_ns, week, short.milliseconds, None, 0, dates.floor_week)
        return header, data[nov.SHORT_HEADER.size : -nov.CRC_BYTES]
    long = nov.LongHeader._make(nov.LONG_HEADER.unpack_from(data))
    if long.message_type & (nov.RESPONSE_BIT | nov.FORMAT_BITS):
        return None, b""
    source = long.message_type & nov.SOURCE_BITS
    week = dates.week(long.week, frame.host_time_ns)
    header = Header(name, frame.host_time_ns, week, long.milliseconds, long.time_status, source, dates.floor_week)
    return header, data[long.header_bytes : -nov.CRC_BYTES]


def imu_scale(settings: DeviceSettings) -> tables.ImuScale | None:
    """Return the scale of the configured ``imu_type``, a name of INSCONFIG's table or its number; None without it.

    Raises:
        DriverSettingsError: the type is unknown; the text lists the known ones.
    """
    wanted = settings.config.get("imu_type")
    if wanted in (None, ""):
        return None
    number = tables.IMU_TYPES.get(str(wanted).upper().replace("-", "_"), wanted)
    if number not in tables.IMU_SCALES:
        raise DriverSettingsError(f"imu_type: got {wanted!r}, want one of: {', '.join(sorted(tables.IMU_TYPES))}")
    return tables.IMU_SCALES[number]


make_time_parser = times_only(NovatelParser)

DRIVERS = (
    Driver(
        protocol="novatel",
        kind="gnss",
        transports=STREAM_TRANSPORTS,
        yields=(TimeMessage, GnssFix, InsSolution, ImuSamples, GnssHeading, EventMark, DeviceStatus),
        summary="NovAtel OEM7 binary and ASCII logs, long and short headers, with SPAN",
        make_parser=NovatelParser,
        make_time_parser=make_time_parser,
        names_edge=NamesEdge.PREVIOUS,
        startup=startup_messages,
    ),
)
