"""Unicore N4 receivers (UM980, UM982 and others): logs with the N4 header, in binary and in ASCII.

Unicore reference commands manual for N4 high precision products, V2 R1.4: binary and ASCII headers, BESTNAV, BESTNAVH,
RECTIME, UNIHEADING, UNIHEADING2. A log is ``AA 44 B5`` with 24 bytes of header, or ``#BESTNAVA,97,GPS,FINE,week,ms,…``;
their bodies are those of NovAtel's BESTPOS, TIME and HEADING (`swath.drivers.gnss.novatel.layouts`). Logs with
NovAtel's own headers, which Unicore's older receivers send, belong to the protocol ``novatel``.

Records by log:

- RECTIME: the second of the previous edge, and leap seconds when its UTC status is VALID. BESTNAV and UNIHEADING on the
  whole second give it too. All of them only while the header's time status is FINE, in GPS time. The clock's offset in
  RECTIME is not the pulse's: this receiver does not steer its clock, but its PPS.
- BESTNAV: `GnssFix` with velocity; BESTNAVH: that of the second antenna. UNIHEADING, UNIHEADING2: `GnssHeading`.
- NMEA in the stream gives the fixes of a receiver that sends no BESTNAV.
"""

from __future__ import annotations

import re
import struct
from dataclasses import replace
from typing import NamedTuple, TypeAlias

import numpy as np

from swath.drivers.driver import STREAM_TRANSPORTS, Driver, times_only
from swath.drivers.framing.checksums import crc32_novatel
from swath.drivers.framing.framer import Frame
from swath.drivers.framing.kinds import NMEA, NOVATEL_ASCII, RTCM3, UNICORE, UNICORE_HEADER_BYTES
from swath.drivers.framing.parser import FramedParser
from swath.drivers.gnss.date_floor import WEEK_MS, ReceiverDates
from swath.drivers.gnss.nmea.beside import NmeaFixes
from swath.drivers.gnss.novatel import ascii as text
from swath.drivers.gnss.novatel import layouts as nov
from swath.drivers.gnss.novatel import tables
from swath.drivers.gnss.novatel.records import Header, State, baseline_heading, position_fix, velocity_fix
from swath.drivers.parser import DeviceSettings, ParserCounters
from swath.drivers.startup import PhraseListener, StartupMessage, StartupOptions, read_setup
from swath.georef.records import GnssFix, GnssHeading, NamesEdge, Record, TimeMessage

# --- layouts ---


class N4Header(NamedTuple):
    """Binary header, without sync."""

    idle: int
    message_id: int
    message_bytes: int
    time_reference: int  # 0: GPS, 1: BDS
    time_status: int  # as NovAtel's
    week: int
    milliseconds: int
    version: int
    reserved: int
    leap_seconds: int
    delay_ms: int


HEADER = struct.Struct("<3xBHHBBHIIBBH")
SYNC = b"\xaa\x44\xb5"
CRC_BYTES = 4
REFERENCES = {"GPS": 0, "BDS": 1}
REFERENCE_GPS = 0


class BestNavVelocity(NamedTuple):
    """The part of BESTNAV behind the position: as BESTVEL, with sigmas of vertical and horizontal speed."""

    solution_status: int
    velocity_type: int
    latency_s: float
    differential_age_s: float
    horizontal_mps: float
    track_deg: float
    up_mps: float
    up_sigma_mps: float
    horizontal_sigma_mps: float


POSITION_WIRE = nov.LAYOUTS[nov.IDS["BESTPOS"]].wire
VELOCITY_WIRE = struct.Struct("<IIffdddff")
TIME_WIRE = nov.LAYOUTS[nov.IDS["TIME"]].wire
HEADING_WIRE = nov.LAYOUTS[nov.IDS["HEADING"]].wire
HEADING2_WIRE = nov.LAYOUTS[nov.IDS["HEADING2"]].wire

Body: TypeAlias = nov.BestPos | nov.Time | nov.Heading | nov.Heading2
Parts: TypeAlias = tuple[tuple[type, struct.Struct], ...]

BESTNAV_PARTS: Parts = ((nov.BestPos, POSITION_WIRE), (BestNavVelocity, VELOCITY_WIRE))
LAYOUTS: dict[str, tuple[int, Parts]] = {  # name: message id, parts in wire order
    "BESTNAV": (2118, BESTNAV_PARTS),
    "BESTNAVH": (2119, BESTNAV_PARTS),
    "RECTIME": (102, ((nov.Time, TIME_WIRE),)),
    "UNIHEADING": (972, ((nov.Heading, HEADING_WIRE),)),
    "UNIHEADING2": (1331, ((nov.Heading2, HEADING2_WIRE),)),
}
OTHER_NAMES = {  # framed, counted and kept, not decoded
    **{12: "OBSVM", 13: "OBSVH", 138: "OBSVMCMP", 139: "OBSVHCMP", 284: "OBSVBASE", 37: "VERSION", 106: "GPSEPH"},
    **{107: "GLOEPH", 108: "BDSEPH", 109: "GALEPH", 2999: "BD3EPH", 142: "ADRNAV", 46: "SPPNAV", 1026: "PPPNAV"},
    **{240: "BESTNAVXYZ", 1021: "PVTSLN", 11276: "AGRIC", 954: "STADOP", 509: "RTKSTATUS", 511: "JAMSTATUS"},
    **{521: "HEADINGSTATUS", 218: "HWSTATUS", 220: "AGC", 1041: "BESTSAT", 2124: "SATSINFO", 49: "BASEPOS"},
}
NAMES = OTHER_NAMES | {number: name for name, (number, _) in LAYOUTS.items()}
SECONDARY_NAMES = frozenset({"BESTNAVH"})
TIME_NAMING = frozenset(("BESTNAV", "UNIHEADING"))  # logs besides RECTIME that are computed at their header's epoch


def message_name(frame: bytes) -> str:
    """Return a name such as ``BESTNAV``, or ``UNICORE-1234`` without one here."""
    number = int.from_bytes(frame[4:6], "little")
    return NAMES.get(number, f"UNICORE-{number}")


FRAME_KINDS = (replace(UNICORE, message_name=message_name), NOVATEL_ASCII, NMEA, RTCM3)


# --- parser ---


class UnicoreParser(FramedParser):
    """Decodes the logs listed above; all others are framed and counted.

    Args:
        settings: ``date_floor`` is the oldest accepted date, ``add_weeks`` is added to all weeks.
        wanted: the record types to return; None: all.
    """

    def __init__(self, settings: DeviceSettings, *, wanted: tuple[type, ...] | None = None) -> None:
        super().__init__(FRAME_KINDS, wanted)
        self._state = State(self.counters, ReceiverDates(settings))
        self._nmea = NmeaFixes(settings, self.counters) if wanted is None or GnssFix in wanted else None
        self._last_named: tuple[int, int] = (-1, -1)

    def finish(self) -> list[Record]:
        """Return the records of the last epoch."""
        return list(self._nmea.close()) if self._nmea is not None else []

    def remarks(self) -> list[str]:
        """Return remarks on the receiver's weeks."""
        return self._state.dates.remarks()

    def decode_frames(self, frames: list[Frame]) -> list[Record]:
        """Decode consecutive frames; return their records in order."""
        records: list[Record] = []
        for frame in frames:
            if frame.kind == NMEA.name and self._nmea is not None:
                records += self._nmea.add(frame)
            elif frame.kind in (UNICORE.name, NOVATEL_ASCII.name):
                if self._nmea is not None:
                    self._nmea.own_frame()
                try:
                    records += self._log(frame)
                except text.FieldError as error:
                    self.counters.count_bad("bad_length" if str(error) == "length" else "bad_field")
        return records

    def _log(self, frame: Frame) -> list[Record]:
        binary = frame.kind == UNICORE.name
        name = message_name(frame.data) if binary else NOVATEL_ASCII.message_name(frame.data)
        if name not in LAYOUTS:
            return []
        fields, parts = read_binary(name, frame.data) if binary else read_ascii(name, frame.data)
        if fields.milliseconds >= WEEK_MS:
            raise text.FieldError("time of week")
        if fields.time_reference != REFERENCE_GPS:
            self.counters.errors["time_reference"] += 1  # weeks and seconds of BDS
            return []
        week = self._state.dates.week(fields.week, frame.host_time_ns)
        header = Header(
            *(name, frame.host_time_ns, week, fields.milliseconds, fields.time_status),
            *(1 if name in SECONDARY_NAMES else 0, self._state.floor_week),
        )
        return [*self._named_second(header), *self._records(header, parts)]

    def _named_second(self, header: Header) -> list[Record]:
        """Return the whole second of a solution, once for all logs of an epoch."""
        epoch = (header.week, header.milliseconds)
        if header.name not in TIME_NAMING or header.milliseconds % 1000 or epoch == self._last_named:
            return []
        if not header.time_valid:
            return []
        self._last_named = epoch
        return [TimeMessage(header.host_time_ns, header.tag(), NamesEdge.PREVIOUS, message=header.name)]

    def _records(self, header: Header, parts: tuple[object, ...]) -> list[Record]:
        body = parts[0]
        if isinstance(body, nov.Time):
            return self._second(header, body)
        if isinstance(body, nov.Heading | nov.Heading2):
            return [record for record in baseline_heading(self._state, header, body) if isinstance(record, GnssHeading)]
        if self._nmea is not None and header.name not in SECONDARY_NAMES:
            self._nmea.own_position()
        return self._fix(header, *parts)

    def _fix(self, header: Header, position: object, velocity: object) -> list[Record]:
        """Return a fix with its velocity; one with a latency belongs to an earlier time and is a fix of its own."""
        assert isinstance(position, nov.BestPos)
        assert isinstance(velocity, BestNavVelocity)
        as_bestvel = nov.BestVel(*velocity[:7], 0.0)
        uncounted = State(ParserCounters(), self._state.dates)  # the position counts what is wrong with the header
        (fix,), (speed,) = position_fix(self._state, header, position), velocity_fix(uncounted, header, as_bestvel)
        assert isinstance(fix, GnssFix)
        assert isinstance(speed, GnssFix)
        across, up = velocity.horizontal_sigma_mps, velocity.up_sigma_mps
        speed = replace(speed, velocity_cov_l=np.diag([across**2, across**2, up**2]) if speed.velocity_l else None)
        if not speed.valid:
            return [fix]
        if speed.time != fix.time:
            return [fix, speed]
        return [replace(fix, velocity_l=speed.velocity_l, velocity_cov_l=speed.velocity_cov_l)]

    def _second(self, header: Header, time: nov.Time) -> list[Record]:
        """Return the second in the header of a RECTIME, and leap seconds if its UTC is valid."""
        if not self._state.has_week(header.week):
            return []
        says_leap = time.utc_status == tables.UTC_VALID and abs(time.utc_offset_s) < 100
        leap = round(-time.utc_offset_s) if says_leap else None
        return [
            TimeMessage(
                header.host_time_ns,
                replace(header.tag(), leap_seconds=leap),
                NamesEdge.PREVIOUS,
                valid=header.time_valid and time.clock_status == tables.CLOCK_VALID,
                message=header.name,
            )
        ]


def read_binary(name: str, frame: bytes) -> tuple[N4Header, tuple[object, ...]]:
    """Return header and parts of a binary log.

    Raises:
        FieldError: the log is shorter than its fields.
    """
    parts, at, found = LAYOUTS[name][1], UNICORE_HEADER_BYTES, []
    for kind, wire in parts:
        if at + wire.size > len(frame) - CRC_BYTES:
            raise text.FieldError("length")
        found.append(kind(*wire.unpack_from(frame, at)))
        at += wire.size
    return N4Header(*HEADER.unpack_from(frame)), tuple(found)


def read_ascii(name: str, frame: bytes) -> tuple[N4Header, tuple[object, ...]]:
    """Return header and parts of an ASCII log.

    Raises:
        FieldError: a field is missing or cannot be read.
    """
    head, texts = text.split_log(frame)
    if len(head) < 10 or not all(map(text.INTEGER.fullmatch, (head[1], *head[4:6], head[8]))):
        raise text.FieldError("header")
    week, milliseconds, leap = int(head[4]), int(head[5]), int(head[8])
    status = tables.TIME_STATUSES.get(head[3], text.UNKNOWN_NAME)
    if not 0 <= week <= text.GREATEST_WEEK or milliseconds < 0:
        raise text.FieldError("time")
    header = N4Header(0, LAYOUTS[name][0], 0, REFERENCES.get(head[2], 255), status, week, milliseconds, 0, 0, leap, 0)
    found: list[object] = []
    for kind, wire in LAYOUTS[name][1]:
        count = len(text.wire_codes(wire))
        found.append(text.read_body(kind, wire, texts[:count]))
        texts = texts[count:]
    return header, tuple(found)


# --- encoders ---


def encode_log(
    name: str,
    parts: tuple[tuple[float | bytes, ...], ...],
    week: int,
    milliseconds: int,
    *,
    time_status: int = tables.TIME_STATUS_FINE,
    time_reference: int = REFERENCE_GPS,
    idle: int = 97,
    leap_seconds: int = 18,
    delay_ms: int = 18,
) -> bytes:
    """Encode a binary log of its parts."""
    number, layouts = LAYOUTS[name]
    body = b"".join(wire.pack(*part) for (_, wire), part in zip(layouts, parts, strict=True))
    fields = (idle, number, len(body), time_reference, time_status, week, milliseconds, 0, 0, leap_seconds, delay_ms)
    frame = SYNC + HEADER.pack(*fields)[len(SYNC) :] + body
    return frame + crc32_novatel(frame).to_bytes(CRC_BYTES, "little")


def encode_ascii(
    name: str,
    parts: tuple[tuple[float | bytes, ...], ...],
    week: int,
    milliseconds: int,
    *,
    time_status: str = "FINE",
    time_reference: str = "GPS",
) -> bytes:
    """Encode an ASCII log of its parts."""
    texts = []
    for (kind, wire), part in zip(LAYOUTS[name][1], parts, strict=True):
        texts += text.field_texts(kind, wire, part)
    head = f"{name}A,97,{time_reference},{time_status},{week},{milliseconds},0,0,18,18"
    return text.seal(b"#", f"{head};{','.join(texts)}")


# --- start-up ---

# The manual's commands; a receiver answers ``$command,BESTNAVB 0.2,response: OK*5C`` or with the reason in place of OK.
ACCEPTED = re.compile(rb"\$command,[^\r\n]*,response: ?OK\*")
REFUSED = re.compile(rb"\$command,[^\r\n]*,response: ?(?!OK\*)([^\r\n*]*)\*")
PULSE = "CONFIG PPS ENABLE GPS POSITIVE 500000 1000 0 0"  # width in µs, period in ms
RAW_LOGS = ("OBSVMB 1", "GPSEPHB ONCHANGED", "GLOEPHB ONCHANGED", "GALEPHB ONCHANGED", "BDSEPHB ONCHANGED")


def startup_messages(settings: DeviceSettings, options: StartupOptions) -> tuple[StartupMessage, ...]:
    """Return commands for the baud rate where it changes, PPS, and logs of time, position, heading and raw data."""
    setup = read_setup(settings)
    period = f"{1 / setup.rate_hz:g}"
    logs = [PULSE, "RECTIMEB 1", f"BESTNAVB {period}"]
    if settings.config.get("secondary_lever_arm_m") is not None:
        logs.append(f"UNIHEADINGB {period}")
    messages = [_command(log) for log in (*logs, *(RAW_LOGS if setup.raw else ()))]
    if options.baud is not None:
        messages.insert(0, _command(f"CONFIG {setup.port or 'COM1'} {options.baud}", baud=options.baud))
    return (*messages, *((_command("SAVECONFIG", last=True),) if options.save else ()))


def _command(line: str, *, baud: int | None = None, last: bool = False) -> StartupMessage:
    data = line.encode("ascii") + b"\r\n"
    return StartupMessage((line,), data, lambda: PhraseListener(ACCEPTED, REFUSED), baud=baud, last=last)


make_time_parser = times_only(UnicoreParser)

DRIVERS = (
    Driver(
        protocol="unicore",
        kind="gnss",
        transports=STREAM_TRANSPORTS,
        yields=(TimeMessage, GnssFix, GnssHeading),
        summary="Unicore N4 logs in binary and ASCII (BESTNAV, RECTIME, UNIHEADING), NMEA and RTCM3 beside them",
        make_parser=UnicoreParser,
        make_time_parser=make_time_parser,
        names_edge=NamesEdge.PREVIOUS,
        startup=startup_messages,
    ),
)
