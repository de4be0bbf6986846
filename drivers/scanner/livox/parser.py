"""Livox scanners: point and IMU packets of SDK 1 and SDK 2 (`swath.drivers.scanner.livox.layout`).

Device time is nanoseconds: from power-on (time type 0); of the PTP master since its epoch (1); of UTC since 1970 where
pulse and GPRMC set the head (3 of SDK 1, 2 of SDK 2), so that its whole second is the pulse; or since the last pulse (4
of SDK 1, without GPRMC), to which the seconds are added that the host counted meanwhile. In the last two the packet
itself tells that the head is locked, and the beginning of its second is the latched edge.

The packets of SDK 1 do not contain the pulse rate: it is the model's. Those of SDK 2 contain the time from the first
point to the last.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
from fastcrc.crc32 import iso_hdlc as crc32
from numpy.typing import NDArray

from swath.drivers.driver import Driver
from swath.drivers.parser import DeviceSettings, PacketParser, Parser
from swath.drivers.scanner.livox.layout import (
    AVIA,
    GPS_2,
    HAP,
    HEADER_1,
    HEADER_2,
    IMU_1,
    IMU_2,
    MID40,
    MID360,
    NO_SYNC,
    POINTS_1,
    POINTS_2,
    PPS_1,
    PPS_GPS_1,
    PTP,
    VERSION_1,
    VERSION_2,
    LivoxHead,
    PointType,
    utc_of,
)
from swath.drivers.scanner.livox.layout import IMU_DTYPE as SENT_IMU_DTYPE
from swath.drivers.scanner.livox.points import CONFIDENCE, CONFIDENCE_1, Pulses, fill_rows
from swath.drivers.scanner.rows.slots import BLOCK_SLOTS
from swath.drivers.scanner.sequence import SampleThinner, StampTracker
from swath.georef.arrays import BoolArray, Int64Array, StructArray
from swath.georef.records import (
    AIMED_RETURN_DTYPE,
    DEVICE_CLOCK_DTYPE,
    IMU_DTYPE,
    RETURN_FLAG_PPS_LOCKED,
    ByteRows,
    DeviceClockSamples,
    DeviceStatus,
    ImuSamples,
    Record,
    ScannerReturns,
)
from swath.georef.timescales.gps_time import SECOND_NS

STANDARD_GRAVITY = 9.80665  # m/s², CGPM 1901
MOST_PULSES = 128  # step between the pulse ids of packets
STAMPS_WRAP = 1 << 62
MAX_SILENCE_NS = 10 * SECOND_NS
LATCHED = {1: (PPS_GPS_1, PPS_1), 2: (GPS_2,)}  # time types in which the whole second is the pulse
TIME_TYPES = {1: (NO_SYNC, PTP, PPS_GPS_1, PPS_1), 2: (NO_SYNC, PTP, GPS_2)}
TIME_NAMES = {
    1: {NO_SYNC: "none", PTP: "ptp", PPS_GPS_1: "pps+gprmc", PPS_1: "pps"},
    2: {NO_SYNC: "none", PTP: "ptp", GPS_2: "pps+gprmc"},
}


class LivoxParser(PacketParser):
    """Decodes point and IMU packets of one head.

    Counts ``bad_version``, ``bad_length``, ``bad_data_type``, ``bad_time_type``, ``bad_time``, ``other_head`` (another
    slot of a hub), ``bad_point`` (angles beyond a circle; these returns are left out), ``bad_sample`` (of the IMU), and
    by the stamps of point packets ``cadence_gap``, ``out_of_order``, ``duplicate`` and ``stamp_jump``; packets of SDK 2
    with a wrong CRC are ``bad_checksums``.

    Args:
        settings: no key is needed.
        head: the models.
        clock_only: return no returns and no IMU samples, and clock samples of one point packet in 50 ms of host time.
        imu_only: return IMU samples and their clock samples; point packets are counted only, without their CRC.
    """

    def __init__(
        self, settings: DeviceSettings, head: LivoxHead, *, clock_only: bool = False, imu_only: bool = False
    ) -> None:
        super().__init__()
        self._imu_only = imu_only
        self._head = head
        self._kinds: dict[int, PointType] = POINTS_1 if head.sdk == 1 else POINTS_2
        self._imu_type = IMU_1 if head.sdk == 1 else IMU_2
        self._header = HEADER_1 if head.sdk == 1 else HEADER_2
        self._thinner = SampleThinner() if clock_only else None
        self._stamps = StampTracker(self.counters.errors, STAMPS_WRAP, MAX_SILENCE_NS)
        self._since_pulse = _SincePulse()
        self._place: tuple[int, int] | None = None  # slot and id of the head that is read
        self._packets, self._period_ns = 0, 0.0
        self._table, self._filled = np.empty(0, dtype=AIMED_RETURN_DTYPE), 0
        self._told: dict[str, float | int | str | bool] = {}

    def parse_units(self, host_time_ns: Int64Array, units: ByteRows) -> list[Record]:
        """Decode packets of equal length; see `PacketParser.parse_units`."""
        self.counters.bytes += units.size
        length = units.shape[1]
        if length <= self._header.itemsize:
            self.counters.count_bad("bad_length", len(units), length)
            return []
        if not len(units):
            return []
        headers = np.ascontiguousarray(units[:, : self._header.itemsize]).view(self._header)[:, 0]
        good = self._check(headers, units)
        if not good.all():
            host_time_ns, headers, units = host_time_ns[good], headers[good], units[good]
        if not len(headers):
            return []
        if self._imu_only:
            others = headers["data_type"] != self._imu_type
            self._count(headers[others], length)
            host_time_ns, headers, units = host_time_ns[~others], headers[~others], units[~others]
            if not len(headers):
                return []
        time_ns, right = self._times(host_time_ns, headers)
        self.counters.count_bad("bad_time", int((~right).sum()), length)
        if not right.all():
            host_time_ns, headers, units, time_ns = host_time_ns[right], headers[right], units[right], time_ns[right]
        self._count(headers, length)
        records: list[Record] = []
        self._begin(len(headers), length)
        keys = headers["data_type"].astype(np.int64) << 8 | headers["time_type"]
        edges = [0, *(np.flatnonzero(keys[1:] != keys[:-1]) + 1).tolist(), len(keys)] if len(keys) else []
        for start, stop in pairwise(edges):
            for at in range(start, stop, BLOCK_SLOTS // MOST_PULSES):
                part = slice(at, min(at + BLOCK_SLOTS // MOST_PULSES, stop))
                records += self._same(host_time_ns[part], headers[part], units[part], time_ns[part])
        if self._filled:
            records.append(ScannerReturns(self._table[: self._filled]))
            self._table, self._filled = self._table[:0], 0
        return _joined(records)

    def _begin(self, packets: int, length: int) -> None:
        """Allocate rows for all returns that packets can have; rows that are never written take no memory."""
        content = length - self._header.itemsize
        slots = [content // kind.dtype.itemsize * kind.echoes for kind in self._kinds.values()]
        self._table = np.empty(0 if self._thinner is not None else packets * max(slots), dtype=AIMED_RETURN_DTYPE)
        self._filled = 0

    # -- headers

    def _check(self, headers: StructArray, units: ByteRows) -> BoolArray:
        """Return (n,) which packets can be decoded; the others are counted by error."""
        length, kinds = units.shape[1], headers["data_type"]
        version = VERSION_1 if self._head.sdk == 1 else VERSION_2
        good = np.ones(len(headers), dtype=np.bool_)
        criteria: list[tuple[str, Callable[[], BoolArray]]] = [
            ("bad_version", lambda: headers["version"] == version),
            ("bad_data_type", lambda: np.isin(kinds, [self._imu_type, *self._kinds])),
            ("bad_length", lambda: self._fits(headers, length)),
            ("bad_time_type", lambda: np.isin(headers["time_type"], TIME_TYPES[self._head.sdk])),
        ]
        for code, passes in criteria:
            found = passes()
            self.counters.count_bad(code, int((good & ~found).sum()), length)
            good &= found
        if self._head.sdk == 2:
            checked = good & (headers["data_type"] == self._imu_type) if self._imu_only else good
            bad = checked & ~_crc_holds(headers, units, checked)
            self.counters.bad_checksums += int(bad.sum())
            self.counters.bytes_skipped += int(bad.sum()) * length
            return good & ~bad
        own = self._of_own_place(headers, good)
        self.counters.count_bad("other_head", int((good & ~own).sum()), length)
        return good & own

    def _fits(self, headers: StructArray, length: int) -> BoolArray:
        """Return (n,) whether the length is that of the type and number of points."""
        content = length - self._header.itemsize
        size = np.zeros(256, dtype=np.int64)
        pulses = np.zeros(256, dtype=np.int64)
        size[self._imu_type], pulses[self._imu_type] = SENT_IMU_DTYPE.itemsize, 1
        for key, kind in self._kinds.items():
            size[key], pulses[key] = kind.dtype.itemsize, kind.pulses
        kinds = headers["data_type"]
        if self._head.sdk == 1:
            fits: BoolArray = size[kinds] * pulses[kinds] == content
            return fits
        sent = headers["points"].astype(np.int64)
        # a sample of the IMU may come with a number of points of 0 or 1
        count = np.where(kinds == self._imu_type, 1, sent)
        whole: BoolArray = (headers["length"] == length) & (size[kinds] * count == content) & (count <= MOST_PULSES)
        return whole

    def _of_own_place(self, headers: StructArray, good: BoolArray) -> BoolArray:
        """Return (n,) whether packets are of the slot and id that came first: a hub sends several heads to one port."""
        places = headers["slot"].astype(np.int64) << 8 | headers["id"]
        if self._place is None and good.any():
            first = int(places[int(good.argmax())])
            self._place = first >> 8, first & 0xFF
        own = -1 if self._place is None else self._place[0] << 8 | self._place[1]
        same: BoolArray = places == own
        return same

    def _times(self, host_time_ns: Int64Array, headers: StructArray) -> tuple[Int64Array, BoolArray]:
        """Return device time (n,) of each packet's first point, and whether it is one."""
        raw = np.ascontiguousarray(headers["time"])
        time_ns = raw.view("<i8")[:, 0].astype(np.int64)
        right: BoolArray = time_ns >= 0
        kinds = headers["time_type"]
        if self._head.sdk == 1:
            utc = kinds == PPS_GPS_1
            if utc.any():
                time_ns[utc], right[utc] = utc_of(raw[utc])
            since = kinds == PPS_1
            right &= ~since | (time_ns < 2 * SECOND_NS)
            chosen = since & right
            if chosen.any():
                time_ns[chosen] = self._since_pulse.add(time_ns[chosen], host_time_ns[chosen])
                right &= time_ns >= 0
        return time_ns, right

    def _count(self, headers: StructArray, length: int) -> None:
        self.counters.bytes_framed += len(headers) * length
        for kind, count in zip(*np.unique(headers["data_type"], return_counts=True), strict=True):
            name = "imu" if int(kind) == self._imu_type else self._kinds[int(kind)].name
            self.counters.messages[name] += int(count)

    # -- packets of one type of data and of time

    def _same(
        self, host_time_ns: Int64Array, headers: StructArray, units: ByteRows, time_ns: Int64Array
    ) -> list[Record]:
        content = np.ascontiguousarray(units[:, self._header.itemsize :])
        latched = int(headers["time_type"][0]) in LATCHED[self._head.sdk]
        if int(headers["data_type"][0]) == self._imu_type:
            return self._imu(host_time_ns, content, time_ns, latched=latched)
        kind = self._kinds[int(headers["data_type"][0])]
        table = content.view(kind.dtype)
        passed_ns, period_ns = self._passed(headers, table.shape[1])
        # a step lasts as long as the packet before it
        earlier_ns = np.concatenate([[self._period_ns or period_ns[0]], period_ns[:-1]])
        self._period_ns = float(period_ns[-1])
        fresh = self._stamps.follow(time_ns, earlier_ns)
        if not fresh.all():
            host_time_ns, headers, table = host_time_ns[fresh], headers[fresh], table[fresh]
            time_ns, passed_ns = time_ns[fresh], passed_ns[fresh] if len(passed_ns) > 1 else passed_ns
        if not len(headers):
            return []
        records = self._status(host_time_ns, headers)
        fired_ns = time_ns[:, np.newaxis] + passed_ns
        clock = _clock_rows(host_time_ns, time_ns, fired_ns[:, -1], latched=latched)
        if self._thinner is not None:
            clock = clock[self._thinner.choose(host_time_ns)]
            return [*records, DeviceClockSamples(clock)] if len(clock) else records
        records.append(DeviceClockSamples(clock))
        number = self._packets + np.arange(len(headers), dtype=np.int64)
        self._packets += len(headers)
        filled, bad = fill_rows(
            Pulses(
                kind,
                table,
                host_time_ns,
                fired_ns,
                number * MOST_PULSES,
                self._head.lines,
                RETURN_FLAG_PPS_LOCKED if latched else 0,
                CONFIDENCE_1 if self._head.sdk == 1 else CONFIDENCE,
            ),
            self._table[self._filled :],
        )
        self._filled += filled
        if bad:
            self.counters.errors["bad_point"] += bad
        return records

    def _passed(self, headers: StructArray, pulses: int) -> tuple[Int64Array, NDArray[np.float64]]:
        """Return times since the packet's first pulse, (1, pulses) or (n, pulses), and the time (n,) to the next
        packet.
        """
        place = np.arange(pulses, dtype=np.int64)[np.newaxis]
        if self._head.sdk == 1:
            hz = self._head.pulses_hz
            return place * SECOND_NS // hz, np.full(len(headers), pulses * SECOND_NS / hz)
        span_ns = headers["span_100ns"].astype(np.int64)[:, np.newaxis] * 100
        steps = max(pulses - 1, 1)
        period_ns = np.maximum(span_ns[:, 0] * (pulses / steps), 1.0)
        if (span_ns == span_ns[0]).all():
            span_ns = span_ns[:1]
        return span_ns * place // steps, period_ns

    def _status(self, host_time_ns: Int64Array, headers: StructArray) -> list[Record]:
        """Return a status where the type of time or the head's status code changes."""
        code = headers["status"] if self._head.sdk == 1 else np.zeros(len(headers), dtype=np.uint32)
        places = [0, *(np.flatnonzero(code[1:] != code[:-1]) + 1).tolist()]
        records: list[Record] = []
        for place in places:
            values: dict[str, float | int | str | bool] = {
                "time": TIME_NAMES[self._head.sdk][int(headers["time_type"][place])]
            }
            if self._head.sdk == 1:
                values["status_code"] = int(code[place])
            if values != self._told:
                self._told = values
                records.append(DeviceStatus(int(host_time_ns[place]), dict(values), "status"))
        return records

    def _imu(self, host_time_ns: Int64Array, content: ByteRows, time_ns: Int64Array, *, latched: bool) -> list[Record]:
        """Return inertial samples along the axes of the points, in m/s² and rad/s."""
        sent = content.view(SENT_IMU_DTYPE)[:, 0]
        with np.errstate(invalid="ignore"):  # a signalling NaN on the wire is a NaN like any other
            rate, force = sent["rate"].astype(np.float64), sent["force_g"].astype(np.float64) * STANDARD_GRAVITY
        good = np.isfinite(rate).all(axis=1) & np.isfinite(force).all(axis=1)
        if not good.all():
            self.counters.errors["bad_sample"] += int((~good).sum())
        if self._thinner is not None or not good.any():
            return []
        rows = np.zeros(int(good.sum()), dtype=IMU_DTYPE)
        rows["host_time_ns"], rows["device_time_ns"] = host_time_ns[good], time_ns[good]
        rows["pps_time_ns"] = time_ns[good] // SECOND_NS * SECOND_NS if latched else -1
        rows["specific_force_b"], rows["angular_rate_b"] = force[good], rate[good]
        rows["temperature_c"], rows["gps_week"] = np.nan, -1
        if not self._imu_only:
            return [ImuSamples(rows)]
        clock = _clock_rows(rows["host_time_ns"], rows["device_time_ns"], rows["device_time_ns"], latched=latched)
        return [ImuSamples(rows), DeviceClockSamples(clock)]


class _SincePulse:
    """Adds to times since the last pulse the seconds that passed, as the host counted them."""

    def __init__(self) -> None:
        self._last: tuple[int, int, int] | None = None  # time, host time, seconds added

    def add(self, time_ns: Int64Array, host_time_ns: Int64Array) -> Int64Array:
        """Return times (n,) that go on, from times since the last pulse and host times (n,); at least 0 at first."""
        before_ns, before_host_ns, seconds = self._last or (int(time_ns[0]), int(host_time_ns[0]), 0)
        earlier = np.concatenate([[before_ns], time_ns[:-1]])
        passed_ns = host_time_ns - np.concatenate([[before_host_ns], host_time_ns[:-1]])
        steps = (earlier - time_ns + passed_ns + SECOND_NS // 2) // SECOND_NS
        added = seconds + np.cumsum(steps)
        self._last = int(time_ns[-1]), int(host_time_ns[-1]), int(added[-1])
        unwrapped: Int64Array = time_ns + added * SECOND_NS
        return unwrapped


def _crc_holds(headers: StructArray, units: ByteRows, checked: BoolArray) -> BoolArray:
    """Return (n,) whether the CRC of time and data is right, or not sent (0, as a Mid-360 may), or unchecked."""
    sent = headers["crc32"]
    good: BoolArray = (sent == 0) | ~checked
    at = HEADER_2.itemsize - 8
    for place in np.flatnonzero(~good).tolist():
        good[place] = crc32(units[place, at:].data) == int(sent[place])
    return good


def _clock_rows(host_time_ns: Int64Array, first_ns: Int64Array, last_ns: Int64Array, *, latched: bool) -> StructArray:
    """Return one `DEVICE_CLOCK_DTYPE` row a packet: the time of its last pulse, and the edge that began the second of
    its first.
    """
    rows = np.empty(len(first_ns), dtype=DEVICE_CLOCK_DTYPE)
    rows["host_time_ns"], rows["device_time_ns"] = host_time_ns, last_ns
    rows["pps_time_ns"] = first_ns // SECOND_NS * SECOND_NS if latched else -1
    rows["pps_count"], rows["locked"] = -1, 1 if latched else -1
    return rows


def _joined(records: list[Record]) -> list[Record]:
    """Return the records with the clock samples and inertial samples of several blocks joined."""
    joined: dict[type, list[Any]] = {}
    others: list[Record] = []
    for record in records:
        if isinstance(record, DeviceClockSamples | ImuSamples):
            joined.setdefault(type(record), []).append(record.rows)
        else:
            others.append(record)
    return [*(kind(np.concatenate(pieces)) for kind, pieces in joined.items()), *others]


def _maker(head: LivoxHead, *, clock_only: bool) -> Callable[[DeviceSettings], Parser]:
    return lambda settings: LivoxParser(settings, head, clock_only=clock_only)


def _driver(protocol: str, head: LivoxHead) -> Driver:
    return Driver(
        protocol=protocol,
        kind="scanner",
        transports=("udp",),
        yields=(ScannerReturns, DeviceClockSamples, ImuSamples, DeviceStatus),
        summary=f"Livox {head.name}: points as x, y, z or angles, up to three returns, the head's IMU (SDK {head.sdk})",
        make_parser=_maker(head, clock_only=False),
        make_time_parser=_maker(head, clock_only=True),
        needs=("installation",),
        aimed=True,
        wavelength_nm=905.0,
        eight_bit_intensity=True,
        bytes_per_s=head.bytes_per_s,
    )


DRIVERS = (
    _driver("livox-mid40", MID40),
    _driver("livox-avia", AVIA),
    _driver("livox-mid360", MID360),
    _driver("livox-hap", HAP),
)
