"""NovAtel OEM7 (and OEM4 to OEM6) binary logs, long and short headers, with or without SPAN.

Framing and checksum are `swath.drivers.framing.framer`'s; layouts and tables `swath.drivers.gnss.novatel.layouts`'.
Prompts (``[COM1]``), ASCII logs, NMEA and RTCM3 between the logs are framed or skipped, and counted.

What each log gives:

- TIME: the second of the previous edge, and leap seconds when its UTC status is VALID. BESTPOS and INSPVAX on the whole
  second name it too. All only while the receiver vouches for its time (FINE, FINESTEERING, FINEBACKUPSTEERING).
- BESTPOS, PPPPOS, BESTVEL: `GnssFix`. INSPVA(S), INSPVAX, INSATT(S), INSATTX: `InsSolution`, with the receiver's INS
  status: before alignment it sends rows too, see `novatel_tables.INS_NAVIGATING`.
- RAWIMU(S), RAWIMUX(S): `ImuSamples` in the axes marked on the IMU. Counts mean nothing without the IMU's type, which
  RAWIMUX and INSCONFIG say, or the setting ``imu_type``; without it they are counted as ``imu_scale_unknown``.
- CORRIMU…: motion of the vehicle with gravity and earth rotation taken out, so no `ImuSamples` but `DeviceStatus`.
- HEADING2: `GnssHeading`. MARKxTIME: `EventMark`.
"""

from __future__ import annotations

from dataclasses import replace

from swath.drivers.driver import Driver
from swath.drivers.framing.framer import Frame, Framer
from swath.drivers.framing.kinds import NMEA, NOVATEL, NOVATEL_SHORT, RTCM3
from swath.drivers.gnss.date_floor import ReceiverDates
from swath.drivers.gnss.novatel import layouts as nov
from swath.drivers.gnss.novatel import tables
from swath.drivers.gnss.novatel.records import DECODERS, Header, State
from swath.drivers.gnss.novatel.startup import startup_messages
from swath.drivers.gnss.record_rows import Row, join_rows
from swath.drivers.parser import DeviceSettings, DriverSettingsError, StreamParser
from swath.georef.records import (
    Chunk,
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

TIME_NAMING = frozenset(("BESTPOS", "INSPVAX"))  # besides TIME: computed at the epoch in their header
RAW_RANGES = {43: "RANGE", 140: "RANGECMP", 1273: "RANGECMP2", 2050: "RANGECMP4"}  # measured at the epoch in theirs


GIVES: dict[type[nov.Body], tuple[type, ...]] = {  # what a body can become; the rest need not be decoded for it
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
    nov.InsConfig: (ImuSamples,),
}


def message_name(frame: bytes) -> str:
    """Return ``BESTPOS``; ``NOVATEL-1234`` without a name here; answers to commands end in ``-response``."""
    number = int.from_bytes(frame[4:6], "little")
    layout = nov.LAYOUTS.get(number)
    name = layout.name if layout else nov.OTHER_NAMES.get(number, f"NOVATEL-{number}")
    is_long = frame[:3] == nov.SYNC_LONG
    return f"{name}-response" if is_long and frame[6] & nov.RESPONSE_BIT else name


FRAME_KINDS = (
    replace(NOVATEL, message_name=message_name),
    replace(NOVATEL_SHORT, message_name=message_name),
    NMEA,
    RTCM3,
)


class NovatelParser(StreamParser):
    """Decodes the logs listed above; everything else is framed and counted."""

    def __init__(self, settings: DeviceSettings, *, wanted: tuple[type, ...] | None = None) -> None:
        """Args: the device's table (``imu_type`` and ``date_floor`` are read), and the record types to give; None: all.

        Raises:
            DriverSettingsError: an IMU type that is not in the table, or a floor that is no date.
        """
        super().__init__()
        self._framer = Framer(FRAME_KINDS, self.counters)
        self._wanted = wanted
        self._bodies = {body for body, gives in GIVES.items() if wanted is None or not set(wanted).isdisjoint(gives)}
        self._state = State(self.counters, ReceiverDates(settings), imu_scale(settings))
        self._last_named: tuple[int, int] = (-1, -1)
        self._has_solutions = False  # that name seconds: raw measurements come later and need not

    def feed(self, chunk: Chunk) -> list[Record]:
        """Take one read."""
        return self._decode_all(self._framer.feed(chunk.data, chunk.host_time_ns))

    def close(self) -> list[Record]:
        """Release what was held back."""
        return self._decode_all(self._framer.close())

    def remarks(self) -> list[str]:
        """Return what is to be said of the receiver's weeks."""
        return self._state.dates.remarks()

    def _decode_all(self, frames: list[Frame]) -> list[Record]:
        logs = (frame for frame in frames if frame.kind.startswith("novatel"))
        return join_rows(item for log in logs for item in self._decode(log))

    def _decode(self, frame: Frame) -> list[Record | Row]:
        """Return one frame; a short body is counted."""
        number = int.from_bytes(frame.data[4:6], "little")
        if number in RAW_RANGES:
            return self._second_of_raw(frame, RAW_RANGES[number])
        layout = nov.LAYOUTS.get(number)
        if layout is None or layout.body not in self._bodies:
            return []
        header, body = _split(frame, layout.name, self._state.dates)
        if header is None:
            return []
        if len(body) < layout.wire.size:
            self.counters.bad_messages += 1
            self.counters.errors["bad_length"] += 1
            return []
        message = layout.body._make(layout.wire.unpack_from(body))
        items = [*self._named_second(header), *DECODERS[layout.body](self._state, header, message)]
        if self._wanted is None:
            return items
        return [item for item in items if (item.record if isinstance(item, Row) else type(item)) in self._wanted]

    def _named_second(self, header: Header) -> list[TimeMessage]:
        """Return the whole second a synchronous solution names, once for all logs of an epoch."""
        epoch = (header.week, header.milliseconds)
        if header.name not in TIME_NAMING or header.milliseconds % 1000 or epoch == self._last_named:
            return []
        if not header.time_valid or header.time_status is None:
            return []
        self._last_named, self._has_solutions = epoch, True
        return [TimeMessage(header.host_time_ns, header.tag(), NamesEdge.PREVIOUS, message=header.name)]

    def _second_of_raw(self, frame: Frame, name: str) -> list[Record | Row]:
        """Name the whole second of raw measurements, in a log for post-processing that holds no solution."""
        header, _ = _split(frame, name, self._state.dates)
        wanted = self._wanted is None or TimeMessage in self._wanted
        if header is None or self._has_solutions or not wanted:
            return []
        epoch = (header.week, header.milliseconds)
        if header.milliseconds % 1000 or epoch == self._last_named or not header.time_valid:
            return []
        if header.time_status is None:
            return []
        self._last_named = epoch
        return [TimeMessage(header.host_time_ns, header.tag(), NamesEdge.PREVIOUS, message=name)]


def _split(frame: Frame, name: str, dates: ReceiverDates) -> tuple[Header | None, bytes]:
    """Return header and body of a frame; None for answers to commands and for other formats."""
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
        DriverSettingsError: naming the types there are.
    """
    wanted = settings.config.get("imu_type")
    if wanted in (None, ""):
        return None
    number = tables.IMU_TYPES.get(str(wanted).upper().replace("-", "_"), wanted)
    if number not in tables.IMU_SCALES:
        raise DriverSettingsError(f"imu_type: got {wanted!r}, want one of: {', '.join(sorted(tables.IMU_TYPES))}")
    return tables.IMU_SCALES[number]


def make_time_parser(settings: DeviceSettings) -> NovatelParser:
    """Return the recorder's parser: time messages only."""
    return NovatelParser(settings, wanted=(TimeMessage,))


DRIVERS = (
    Driver(
        protocol="novatel",
        kind="gnss",
        transports=("serial", "udp"),
        yields=(TimeMessage, GnssFix, InsSolution, ImuSamples, GnssHeading, EventMark, DeviceStatus),
        summary="NovAtel OEM7 binary logs, long and short headers, with SPAN",
        make_parser=NovatelParser,
        make_time_parser=make_time_parser,
        names_edge=NamesEdge.PREVIOUS,
        startup=startup_messages,
    ),
)
