"""Velodyne position packets: the head's clock, its PPS status and the NMEA sentence that it received.

VLP-16 User Manual 63-9243 rev. D, 9.3.3, table 9-3: 198 unused bytes, u32 microseconds past the hour when the packet
was assembled, u8 PPS status (table 9-4), 3 unused bytes, then the GPRMC sentence, CR LF, padded with NUL to 512.
"""

from __future__ import annotations

import datetime as dt
import struct
from dataclasses import replace

import numpy as np

from swath.drivers.gnss.date_floor import ReceiverDates
from swath.drivers.parser import DeviceSettings, ParserCounters
from swath.georef.arrays import Int64Array
from swath.georef.records import (
    DEVICE_CLOCK_DTYPE,
    ByteRows,
    DeviceClockSamples,
    DeviceStatus,
    NamesEdge,
    Record,
    TimeMessage,
    TimeScale,
    TimeTag,
)
from swath.georef.timescales.gps_time import SECOND_NS

POSITION_BYTES = 512
PPS_ABSENT, PPS_SYNCHRONIZING, PPS_LOCKED, PPS_ERROR = range(4)
PPS_NAMES = ("absent", "synchronizing", "locked", "error")
HOUR_US = 3_600_000_000
_STAMP_AT = 198
_STATUS = struct.Struct("<IB")
_SENTENCE_AT = 206
_SECOND_US = 1_000_000


def encode_position_packet(stamp_us: int, pps_status: int, sentence: str) -> bytes:
    """Encode one position packet; ``sentence`` runs from ``$`` to its checksum, without CR LF; empty before the first
    one.
    """
    packet = bytearray(POSITION_BYTES)
    _STATUS.pack_into(packet, _STAMP_AT, stamp_us, pps_status)
    text = f"{sentence}\r\n".encode("ascii") if sentence else b""
    packet[_SENTENCE_AT : _SENTENCE_AT + len(text)] = text
    return bytes(packet[:POSITION_BYTES])


class PositionReader:
    """Reads the position packets of one head, in order.

    A packet repeats the head's last sentence until the next one comes, also beyond the next edge. A `TimeMessage` is
    therefore made only from the first packet with a new sentence and, while the head is locked, only if the sentence's
    second agrees with the head's own clock (else ``nmea_second_mismatch`` is counted). Its date is treated like a
    receiver's own: one roll-over behind it is moved, before the floor it is not valid (``date_before_floor``).

    Args:
        counters: the parser's counters.
        settings: the head's settings, with the source that remarks on dates name.

    Attributes:
        dates: interpretation of the sentences' dates.
        locked: PPS status of the latest packet: 1 locked, 0 not, −1 before the first packet.
    """

    def __init__(self, counters: ParserCounters, settings: DeviceSettings) -> None:
        self._counters = counters
        self.dates = ReceiverDates(settings)
        self._sentence: bytes | None = None
        self._status: tuple[int, bool] | None = None
        self.locked = -1

    def read(self, host_time_ns: Int64Array, units: ByteRows) -> list[Record]:
        """Decode packets (n, 512): return clock samples of all, and events for changes."""
        events: list[Record] = []
        rows = np.empty(len(units), dtype=DEVICE_CLOCK_DTYPE)
        keep = np.ones(len(units), dtype=np.bool_)
        for at, host_ns in enumerate(host_time_ns.tolist()):
            packet = units[at].tobytes()
            stamp_us, pps_status = _STATUS.unpack_from(packet, _STAMP_AT)
            stamp_us %= HOUR_US  # a head whose pulse does not wrap its hour counts beyond it
            if pps_status > PPS_ERROR:
                keep[at] = False
                continue
            self.locked = int(pps_status == PPS_LOCKED)
            rows[at] = (host_ns, stamp_us * 1000, -1, -1, self.locked)
            events += self._events(host_ns, stamp_us, pps_status, packet[_SENTENCE_AT:].split(b"\0", 1)[0])
        self._count(int(keep.sum()), int((~keep).sum()))
        return [*events, DeviceClockSamples(rows[keep])] if keep.any() else []

    def _count(self, good: int, bad: int) -> None:
        self._counters.bytes_framed += good * POSITION_BYTES
        self._counters.bytes_skipped += bad * POSITION_BYTES
        if good:
            self._counters.messages["position"] += good
        if bad:
            self._counters.errors["bad_position"] += bad
            self._counters.bad_messages += bad

    def _events(self, host_ns: int, stamp_us: int, pps_status: int, sentence: bytes) -> list[Record]:
        """Return the time message of a new sentence, and the status where it changed."""
        events: list[Record] = []
        valid = self._status[1] if self._status else False
        if sentence != self._sentence:
            named = rmc_time(sentence) if sentence else None
            valid = named is not None and named[1]
            if named is None and sentence:
                self._counters.errors["bad_nmea"] += 1
            elif named is not None and self._is_of_this_second(named[0], stamp_us, pps_status):
                events.append(self._time_message(host_ns, named[0], valid=valid))
            self._sentence = sentence
        if (pps_status, valid) != self._status:
            self._status = (pps_status, valid)
            locked = pps_status == PPS_LOCKED
            values: dict[str, float | int | str | bool] = {
                "pps_status": PPS_NAMES[pps_status],
                "pps_locked": locked,
                "nmea_valid": valid,
            }
            events.append(DeviceStatus(host_ns, values, message="position"))
        return events

    def _time_message(self, host_ns: int, tag: TimeTag, *, valid: bool) -> TimeMessage:
        """Return the message of a sentence, with its date moved by roll-overs."""
        if valid and tag.date is not None:  # without a fix many receivers send an arbitrary date
            tag = replace(tag, date=(date := self.dates.date(tag.date, host_ns)))
            if date < self.dates.floor:
                self._counters.errors["date_before_floor"] += 1
                valid = False
        return TimeMessage(host_ns, tag, NamesEdge.PREVIOUS, valid=valid, message="position RMC")

    def _is_of_this_second(self, time: TimeTag, stamp_us: int, pps_status: int) -> bool:
        """Return whether the sentence belongs to the edge just past: by the locked clock, or without a lock by being
        new.
        """
        if pps_status != PPS_LOCKED:
            return self._sentence is not None
        if time.time_ns // SECOND_NS % 3600 == stamp_us // _SECOND_US:
            return True
        self._counters.errors["nmea_second_mismatch"] += 1
        return False


def rmc_time(sentence: bytes) -> tuple[TimeTag, bool] | None:
    """Return UTC of an RMC sentence and whether the receiver marks it as valid; None if it is another sentence or
    damaged.

    NMEA 0183: ``$--RMC,hhmmss.sss,status,…,ddmmyy,…*hh``, checksum the XOR between ``$`` and ``*``. Years are 1980
    to 2079. Second 60 is a leap second: 86 400 s of the day and above.
    """
    body, star, checksum = sentence.rstrip(b"\r\n").partition(b"*")
    xor = 0
    for byte in body[1:]:
        xor ^= byte
    fields = body.decode("ascii", "replace").split(",")
    if body[:1] != b"$" or not star or checksum.upper() != b"%02X" % xor or fields[0][3:] != "RMC" or len(fields) < 10:
        return None
    clock, date = fields[1], fields[9]
    if not (clock[:6].isdecimal() and len(clock) >= 6 and date.isdecimal() and len(date) == 6):
        return None
    fraction = clock[7:16]
    if clock[6:] and (clock[6] != "." or (fraction and not fraction.isdecimal())):
        return None
    hour, minute, second = int(clock[:2]), int(clock[2:4]), int(clock[4:6])
    year = int(date[4:])
    try:
        day = dt.date(year + (1900 if year >= 80 else 2000), int(date[2:4]), int(date[:2]))
    except ValueError:
        return None
    if hour > 23 or minute > 59 or second > 60:
        return None
    time_ns = ((hour * 60 + minute) * 60 + second) * SECOND_NS + int(fraction.ljust(9, "0"))
    return TimeTag(TimeScale.UTC, time_ns, date=day), fields[2] == "A"
