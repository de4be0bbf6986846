"""Hesai GPS data packets: the head's date and time at each edge, its PPS lock and the receiver's status.

PandarXT-32 User Manual 3.2 (PandarQT the same): 512 bytes. FF EE, then year, month, day, second, minute, hour, two
ASCII digits each, the lower first; u32 microseconds; 84 bytes NMEA; reserved; at 506 the positioning status (A or V
of GPRMC, 0 to 9 of GPGGA as the receiver sends it, NUL: none), at 507 the PPS lock flag (1 locked).

Each rising edge of the head's internal 1 Hz signal, which is the PPS while locked, triggers a packet, and the date
and time in it are that edge's: those of the previous NMEA message plus one second (3.2, Appendix II). A packet
therefore refers to the edge before its arrival, while the sentence in it still belongs to the edge before that, and is
not used.
"""

from __future__ import annotations

import datetime as dt
import struct

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

GPS_BYTES = 512
NS = 1_000_000_000
EPOCH = dt.datetime(1970, 1, 1, tzinfo=dt.UTC)
_TIME = struct.Struct("<2s12sI")
_SENTENCE = slice(18, 102)
_STATUS = struct.Struct("<cB")
_STATUS_AT = 506
_FILL = 0xDF
_STATUS_NAMES = {b"\0": "none", b"A": "valid", b"V": "invalid", b"0": "invalid", b"6": "estimated"}
# 0 to 9 "as defined by the GPS device manufacturer", 4 and 5 for RTK (Pandar64 User Manual 3.2.2); 9 is NovAtel's SBAS
_STATUS_NAMES |= dict.fromkeys((b"1", b"2", b"3", b"4", b"5", b"9"), "valid") | {b"7": "manual", b"8": "simulated"}


def encode_gps_packet(time: dt.datetime, sentence: str = "", status: bytes = b"A", *, locked: bool = True) -> bytes:
    """Encode one GPS data packet; ``time`` is in UTC."""
    packet = bytearray([_FILL] * GPS_BYTES)
    digits = f"{time:%y%m%d%S%M%H}"
    swapped = "".join(digits[at + 1] + digits[at] for at in range(0, len(digits), 2))
    _TIME.pack_into(packet, 0, b"\xff\xee", swapped.encode("ascii"), time.microsecond)
    text = sentence.encode("ascii")
    packet[_SENTENCE] = (text + b"\r\n" if text else b"").ljust(84, b"\0")[:84]
    _STATUS.pack_into(packet, _STATUS_AT, status, int(locked))
    packet[_STATUS_AT + _STATUS.size :] = bytes(GPS_BYTES - _STATUS_AT - _STATUS.size)
    return bytes(packet)


class GpsReader:
    """Reads the GPS data packets of one head, in order; counts ``bad_gps`` and ``date_before_floor``.

    The date is that of the receiver at the head: a date one roll-over behind is moved in the time message, a date
    before the floor is not valid. Device times stay as the head counts them.

    Args:
        counters: the parser's counters.
        settings: the head's settings, with the source that remarks on dates name.

    Attributes:
        dates: interpretation of the head's dates.
        locked: lock flag of the latest packet: 1 PPS locked, 0 not, −1 before the first packet (and with PTP, where
            the head sends none).
    """

    def __init__(self, counters: ParserCounters, settings: DeviceSettings) -> None:
        self._counters = counters
        self.dates = ReceiverDates(settings)
        self._status: tuple[bytes, bool] | None = None
        self.locked = -1

    def read(self, host_time_ns: Int64Array, units: ByteRows) -> list[Record]:
        """Decode packets (n, 512): return a time message and a clock sample of each, and the status where it
        changed.
        """
        records: list[Record] = []
        clock: list[tuple[int, int, int, int, int]] = []
        for at, host_ns in enumerate(host_time_ns.tolist()):
            packet = units[at].tobytes()
            magic, digits, microsecond = _TIME.unpack_from(packet)
            status, flag = _STATUS.unpack_from(packet, _STATUS_AT)
            time = _time(digits) if magic == b"\xff\xee" and flag <= 1 and status in _STATUS_NAMES else None
            if time is None:
                self._counters.errors["bad_gps"] += 1
                self._counters.bad_messages += 1
                continue
            self.locked = flag
            second_ns = int((time - EPOCH).total_seconds()) * NS
            clock.append((host_ns, second_ns + microsecond * 1000, second_ns if flag else -1, -1, flag))
            records += self._events(host_ns, time, status, locked=bool(flag))
        good, bad = len(clock), len(units) - len(clock)
        self._counters.bytes_framed += good * GPS_BYTES
        self._counters.bytes_skipped += bad * GPS_BYTES
        if not good:
            return []
        self._counters.messages["gps"] += good
        return [*records, DeviceClockSamples(np.array(clock, dtype=DEVICE_CLOCK_DTYPE))]

    def _events(self, host_ns: int, time: dt.datetime, status: bytes, *, locked: bool) -> list[Record]:
        of_day_ns = (time.hour * 3600 + time.minute * 60 + time.second) * NS
        valid = locked and _STATUS_NAMES[status] == "valid"
        date = time.date()
        if valid:  # otherwise the date is the head's own virtual one
            date = self.dates.date(date, host_ns)
            if date < self.dates.floor:
                self._counters.errors["date_before_floor"] += 1
                valid = False
        tag = TimeTag(TimeScale.UTC, of_day_ns, date=date)
        events: list[Record] = [TimeMessage(host_ns, tag, NamesEdge.PREVIOUS, valid=valid, message="GPS data packet")]
        if (status, locked) != self._status:
            self._status = (status, locked)
            values: dict[str, float | int | str | bool] = {"pps_locked": locked, "gps_status": _STATUS_NAMES[status]}
            events.append(DeviceStatus(host_ns, values, message="gps"))
        return events


def _time(digits: bytes) -> dt.datetime | None:
    """Return date and time of twelve digits, each pair's lower first; None if they are invalid. Years are 2000 to
    2099.
    """
    if not digits.isdigit():
        return None
    year, month, day, second, minute, hour = (int(digits[at + 1 :: -1][:2]) for at in range(0, 12, 2))
    try:
        return dt.datetime(2000 + year, month, day, hour, minute, second, tzinfo=dt.UTC)
    except ValueError:
        return None
