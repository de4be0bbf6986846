"""Ouster OS heads: lidar packets of the profiles in `layout`, and IMU packets, distinguished by their length.

Device time is the column's stamp in nanoseconds, as the head's timestamp_mode makes it count: from power-on
(TIME_FROM_INTERNAL_OSC, and TIME_FROM_SYNC_PULSE_IN until NMEA sets the second), or since 1970 on the PTP master's
scale (TIME_FROM_PTP_1588). Under TIME_FROM_SYNC_PULSE_IN the head counts one second for each pulse, so the pulse lies
at the whole second of device time (Firmware User Manual, "Time Synchronization"). The packets do not show whether
pulses come, so that whole second counts as latched only where the configuration says that a PPS is wired to the head.

Two returns of a block are numbered by range. The metadata's return_order determines which of them is the strongest;
where it orders by range, the return with more signal is the strongest.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from swath.drivers.driver import Driver
from swath.drivers.parser import DeviceSettings, DriverSettingsError, PacketParser
from swath.drivers.scanner.ouster.head import FILE, SYNC_PULSE, read_head
from swath.drivers.scanner.ouster.imu import imu_packet_bytes, imu_samples
from swath.drivers.scanner.ouster.layout import (
    ENCODER_COUNTS,
    FOOTER_BYTES,
    HEADER_BYTES,
    HEALTH,
    IMU_PACKET,
    LIDAR_PACKET,
    RANGE_MM,
    ZONE_BYTES,
    ZONE_PACKET,
    LidarLayout,
    crc_holds,
)
from swath.drivers.scanner.rows.filler import filler
from swath.drivers.scanner.rows.slots import BLOCK_SLOTS, FlagRule, ReturnSlots, common_words, in_order, returns_table
from swath.drivers.scanner.sequence import SampleThinner, SequenceTracker
from swath.georef.arrays import BoolArray, Int64Array, StructArray, UInt64Array
from swath.georef.records import (
    DEVICE_CLOCK_DTYPE,
    RETURN_FLAG_LAST,
    RETURN_FLAG_STRONGEST,
    ByteRows,
    DeviceClockSamples,
    DeviceStatus,
    ImuSamples,
    Record,
    ScannerReturns,
)
from swath.georef.timescales.gps_time import SECOND_NS

COLUMNS_PER_PACKET = 16  # "not user configurable", Firmware User Manual, Get the lidar data format

LEAST_BEAMS = 16

_ID_AT = 8  # in a column, all profiles


class OusterProbe(PacketParser):
    """Counts packets that look like lidar packets; decodes nothing."""

    def __init__(self, settings: DeviceSettings) -> None:
        super().__init__()

    def parse_units(self, host_time_ns: Int64Array, units: ByteRows) -> list[Record]:
        """Count packets of equal length; see `PacketParser.parse_units`."""
        found = int(looks_like_lidar(units).sum())
        self.counters.bytes += units.size
        self.counters.bytes_framed += found * units.shape[1]
        self.counters.bytes_skipped += (len(units) - found) * units.shape[1]
        if found:
            self.counters.messages["lidar"] += found
        return []


def looks_like_lidar(units: ByteRows) -> BoolArray:
    """Return (n,) whether packets of one length consist of sixteen consecutive columns.

    Args:
        units: (n, length).
    """
    length = units.shape[1]
    modern, legacy = length - HEADER_BYTES - FOOTER_BYTES, length
    found = np.zeros(len(units), dtype=np.bool_)
    if modern % COLUMNS_PER_PACKET == 0 and modern // COLUMNS_PER_PACKET >= 12 + 4 * LEAST_BEAMS:
        found |= (units[:, 0] == LIDAR_PACKET) & _counts_on(units, HEADER_BYTES, modern // COLUMNS_PER_PACKET)
    if legacy % COLUMNS_PER_PACKET == 0 and legacy // COLUMNS_PER_PACKET >= 20 + 12 * LEAST_BEAMS:
        found |= _counts_on(units, 0, legacy // COLUMNS_PER_PACKET)
    return found


def _counts_on(units: ByteRows, start: int, column_bytes: int) -> BoolArray:
    """Return (n,) whether the measurement ids of columns from byte ``start`` on are consecutive and begin at a multiple
    of 16.
    """
    at = start + _ID_AT + column_bytes * np.arange(COLUMNS_PER_PACKET)
    ids = units[:, at].astype(np.int64) + 256 * units[:, at + 1].astype(np.int64)
    steady: BoolArray = (np.diff(ids, axis=1) == 1).all(axis=1) & (ids[:, 0] % COLUMNS_PER_PACKET == 0)
    return steady


LARGEST_GAP_FRAMES = 600  # half a minute to a minute; a longer gap is a restart of the head
# A return as one 64-bit number: range, then 1 for the second of a block, then its signal or reflectivity.
_CONTENT = np.dtype([("intensity", "<u2"), ("second", "<u2"), ("range", "<u4")])
_SINGLE_FLAGS = {"STRONGEST_TO_WEAKEST": RETURN_FLAG_STRONGEST, "FARTHEST_TO_NEAREST": RETURN_FLAG_LAST}


class OusterParser(PacketParser):
    """Decodes lidar and IMU packets of one head.

    Counts ``bad_length``, ``bad_packet_type``, ``wrong_serial`` (another head than the metadata's), ``bad_column``
    (measurement ids or encoder counts that this configuration does not have), ``outside_window``, ``bad_timestamp``,
    ``bad_sample`` (of the IMU), ``sequence_gap`` (packets missing), ``out_of_order``, ``duplicate`` and ``restart``;
    packets whose CRC is wrong are ``bad_checksums``.

    Args:
        settings: file ``geometry`` (the head's metadata) is needed; key ``pps`` says that a PPS is wired to the head.
        clock_only: return no returns and no IMU samples, and clock samples of one lidar packet in 50 ms of host time.

    Raises:
        DriverSettingsError: the metadata is missing or unusable.
    """

    def __init__(self, settings: DeviceSettings, *, clock_only: bool = False) -> None:
        super().__init__()
        if "geometry" not in settings.files:
            raise DriverSettingsError(f"{FILE}: missing; want the head's metadata, a JSON file")
        self.head = read_head(settings.files["geometry"])
        serial = settings.config.get("serial") or ""
        if serial and self.head.serial is not None and serial != str(self.head.serial):
            raise DriverSettingsError(
                f"{FILE}: is of head {self.head.serial}, but serial is {serial}; use the metadata of this head"
            )
        self.layout = LidarLayout(self.head)
        self._latches = self.head.timestamp_mode == SYNC_PULSE and bool(settings.config.get("pps"))
        self._rank = self.layout.window_ranks()
        per_frame = int(self._rank.max()) + 1
        self._tracker = SequenceTracker(
            self.counters.errors, self.layout.frame_ids * per_frame, LARGEST_GAP_FRAMES * per_frame
        )
        columns = self.head.columns_per_frame
        self._encoder_rad = 2 * np.pi * (-np.arange(columns) % columns) / columns
        ordered = self.head.return_order == "STRONGEST_TO_WEAKEST"
        self._light = "SIGNAL" if "SIGNAL" in self.layout.profile.fields else "REFLECTIVITY"
        says_strongest = ordered or self._light == "SIGNAL"
        self._rule = FlagRule(_first_is_stronger if ordered else _more_light_is_stronger, says_strongest, True)
        self._thinner = SampleThinner() if clock_only else None
        self._fill = filler(compiled=settings.compiled and not clock_only)
        self._init_id: int | None = None
        self._time_ns = 0
        self._health = HealthReader(self.layout)

    def parse_units(self, host_time_ns: Int64Array, units: ByteRows) -> list[Record]:
        """Decode packets of equal length; see `PacketParser.parse_units`."""
        self.counters.bytes += units.size
        length = units.shape[1]
        if length == self.layout.packet_bytes:
            return self._lidar(host_time_ns, units)
        if length and length == imu_packet_bytes(self.head):
            return self._imu(host_time_ns, units)
        if length == ZONE_BYTES and not self.layout.legacy:
            self._keep(units, ZONE_PACKET, "zone")
            return []
        self.counters.count_bad("bad_length", len(units), length)
        return []

    def _keep(self, units: ByteRows, packet_type: int, name: str) -> BoolArray:
        """Return (n,) which packets with a header are of this type and intact; count all of them."""
        good = np.ones(len(units), dtype=np.bool_) if self.head.header == "fusa" else crc_holds(units)
        self._select(good, self._origin(self.layout.headers(units), packet_type), units.shape[1])
        self._count(name, int(good.sum()), units.shape[1])
        return good

    def _select(self, good: BoolArray, criteria: list[tuple[str, BoolArray]], length: int) -> None:
        """Clear in ``good`` the packets that fail a criterion; count these and the packets with a bad checksum."""
        self._bad_checksums(int((~good).sum()), length)
        for code, passes in criteria:
            self.counters.count_bad(code, int((good & ~passes).sum()), length)
            good &= passes

    def _origin(self, headers: StructArray, packet_type: int) -> list[tuple[str, BoolArray]]:
        """Return the criteria for a packet's header."""
        criteria: list[tuple[str, BoolArray]] = [("bad_packet_type", headers["type"] == packet_type)]
        if self.head.serial is not None:
            criteria.append(("wrong_serial", self.layout.serial(headers) == self.head.serial))
        return criteria

    def _bad_checksums(self, count: int, length: int) -> None:
        self.counters.bad_checksums += count
        self.counters.bytes_skipped += count * length

    def _count(self, name: str, count: int, length: int) -> None:
        if count:
            self.counters.messages[name] += count
            self.counters.bytes_framed += count * length

    # -- IMU packets

    def _imu(self, host_time_ns: Int64Array, units: ByteRows) -> list[Record]:
        if self.head.imu_profile == "LEGACY":
            self._count("imu", len(units), units.shape[1])
        else:
            good = self._keep(units, IMU_PACKET, "imu")
            host_time_ns, units = host_time_ns[good], units[good]
        rows, bad = imu_samples(host_time_ns, units, self.head)
        if bad:
            self.counters.errors["bad_sample"] += bad
        return [ImuSamples(rows)] if len(rows) and self._thinner is None else []

    # -- lidar packets

    def _lidar(self, host_time_ns: Int64Array, units: ByteRows) -> list[Record]:
        packets = units.view(self.layout.dtype)[:, 0]
        good = crc_holds(units) if self.layout.has_crc else np.ones(len(packets), dtype=np.bool_)
        self._select(good, self._criteria(packets), units.shape[1])
        self._count("lidar", int(good.sum()), units.shape[1])
        if not good.all():
            host_time_ns, packets = host_time_ns[good], packets[good]
        if not len(packets):
            return []
        records: list[Record] = list(self._health.read(host_time_ns, packets))
        unwrapped, fresh = self._follow(host_time_ns, packets)
        if not fresh.all():
            host_time_ns, packets, unwrapped = host_time_ns[fresh], packets[fresh], unwrapped[fresh]
        clock = self._clock(host_time_ns, packets)
        if self._thinner is not None:
            clock = clock[self._thinner.choose(clock["host_time_ns"])]
        if len(clock):
            records.append(DeviceClockSamples(clock))
        if self._thinner is None:
            rows = self._returns(host_time_ns, packets, unwrapped)
            if len(rows):
                records.append(ScannerReturns(rows))
        return records

    def _criteria(self, packets: StructArray) -> list[tuple[str, BoolArray]]:
        """Return the criteria for a lidar packet, in the order of their application."""
        criteria = [] if self.layout.legacy else self._origin(packets, LIDAR_PACKET)
        columns, per_packet = packets["columns"], self.head.columns_per_packet
        valid, first_id = self.layout.valid(columns), self.layout.first_id(columns)
        ids = first_id[:, np.newaxis] + np.arange(per_packet)
        regular = (columns["id"] == ids) | ~valid
        if self.layout.legacy:
            step = ENCODER_COUNTS // self.head.columns_per_frame
            regular &= (np.abs(columns["encoder"].astype(np.int64) - ids * step) < step) | ~valid
        whole = regular.all(axis=1) & (first_id % per_packet == 0)
        whole &= (first_id >= 0) & (first_id <= self.head.columns_per_frame - per_packet)
        criteria.append(("bad_column", whole))
        criteria.append(("outside_window", self._rank[np.where(whole, first_id, 0) // per_packet] >= 0))
        criteria.append(("bad_timestamp", np.all((columns["time_ns"] < np.uint64(1 << 63)) | ~valid, axis=1)))
        return criteria

    def _follow(self, host_time_ns: Int64Array, packets: StructArray) -> tuple[Int64Array, BoolArray]:
        """Number the packets (n,) with gaps left open; return False for one that repeats the one before."""
        place = self.layout.first_id(packets["columns"]) // self.head.columns_per_packet
        sequence = self.layout.frame_id(packets) * (int(self._rank.max()) + 1) + self._rank[place]
        time_ns = self._first_times(packets["columns"])
        init_id = self.layout.init_id(packets)
        edges = [0, *(np.flatnonzero(init_id[1:] != init_id[:-1]) + 1).tolist(), len(packets)]
        parts = []
        for start, stop in pairwise(edges):
            if self._init_id is not None and int(init_id[start]) != self._init_id:
                self._tracker.restart(int(sequence[start]), int(time_ns[start]))
            self._init_id = int(init_id[start])
            part, none = slice(start, stop), np.zeros(stop - start, dtype=np.int64)
            parts.append(self._tracker.follow(sequence[part], time_ns[part], none, host_time_ns[part]))
        return np.concatenate([at for at, _ in parts]), np.concatenate([new for _, new in parts])

    def _first_times(self, columns: StructArray) -> Int64Array:
        """Return (n,) stamp of each packet's first valid column; the previous stamp where a packet has none."""
        valid = self.layout.valid(columns)
        time_ns = columns["time_ns"][np.arange(len(columns)), valid.argmax(axis=1)].astype(np.int64)
        last = np.maximum.accumulate(np.where(valid.any(axis=1), np.arange(len(columns)), -1))
        filled: Int64Array = np.where(last >= 0, time_ns[last], self._time_ns)
        self._time_ns = int(filled[-1])
        return filled

    def _clock(self, host_time_ns: Int64Array, packets: StructArray) -> StructArray:
        """Return one `DEVICE_CLOCK_DTYPE` row for each packet with a valid column: the stamp of the last one."""
        valid = self.layout.valid(packets["columns"])
        some = np.flatnonzero(valid.any(axis=1))
        last = valid.shape[1] - 1 - valid[some, ::-1].argmax(axis=1)
        rows = np.empty(len(some), dtype=DEVICE_CLOCK_DTYPE)
        rows["host_time_ns"] = host_time_ns[some]
        rows["device_time_ns"] = packets["columns"]["time_ns"][some, last]
        rows["pps_time_ns"] = rows["pps_count"] = rows["locked"] = -1
        if self._latches:
            second = rows["device_time_ns"] // SECOND_NS * SECOND_NS
            rows["pps_time_ns"] = np.where(second > 0, second, -1)
        return rows

    # -- returns

    def _returns(self, host_time_ns: Int64Array, packets: StructArray, unwrapped: Int64Array) -> StructArray:
        """Decode the returns of all packets in order."""
        pulses = self.head.columns_per_packet * self.head.beams
        slots = pulses * (2 if self.layout.dual else 1)
        table, filled = returns_table(len(packets) * slots), 0
        step = max(1, BLOCK_SLOTS // slots)
        serial = unwrapped[:, np.newaxis] * self.head.columns_per_packet + np.arange(self.head.columns_per_packet)
        for at in range(0, len(packets), step):
            part = slice(at, at + step)
            columns, number = packets["columns"][part], serial[part]
            host = np.broadcast_to(host_time_ns[part, np.newaxis], number.shape)
            valid = self.layout.valid(columns)
            if not valid.all():
                columns, number, host = columns[valid], number[valid], host[valid]
            filled += self._fill(self._block(columns, number.reshape(-1), host.reshape(-1)), table[filled:])
        return table[:filled]

    def _block(self, columns: StructArray, number: Int64Array, host_time_ns: Int64Array) -> ReturnSlots:
        """Return the slots of valid columns; ``number`` is each column's number, counted from the first frame on."""
        beam = np.arange(self.head.beams)
        dual = self.layout.dual
        flags = 0 if dual else _SINGLE_FLAGS.get(self.head.return_order, 0)
        content = self._content(columns["pixels"])
        return ReturnSlots(
            content=content,
            range_unit_m=RANGE_MM * (1 << self.layout.profile.fields["RANGE"].dropped),
            common=common_words((1, len(beam)), channel=beam, flags=flags),
            shape=(len(number), len(beam)),
            pulse_id=number * len(beam),
            per_pulse={
                "host_time_ns": lambda at: at(host_time_ns[:, np.newaxis]),
                "device_time_ns": lambda at: at(columns["time_ns"].reshape(-1, 1)),
                "encoder_rad": lambda at: at(self._encoder_rad[columns["id"].reshape(-1, 1)]),
            },
            rule=self._rule if dual else None,
        )

    def _content(self, pixels: NDArray[np.uint32]) -> StructArray:
        """Return (pulses, slots) returns of all beams of all columns; two are in order of range, or as sent where
        equal.
        """
        first = self._as_numbers(pixels)
        if not self.layout.dual:
            return first.view(_CONTENT).reshape(-1, 1)
        return in_order(first, self._as_numbers(pixels, "2") | np.uint64(1 << 16)).view(_CONTENT)

    def _as_numbers(self, pixels: NDArray[np.uint32], which: str = "") -> UInt64Array:
        """Pack one of the returns of a block as `_CONTENT` into one number, (pulses,)."""
        number = self.layout.raw_field(pixels, f"RANGE{which}").astype(np.uint64).reshape(-1)
        number <<= np.uint64(32)
        number |= self.layout.raw_field(pixels, f"{self._light}{which}").reshape(-1)
        return number


def _first_is_stronger(returns: StructArray) -> NDArray[np.uint16]:
    """Rank the first return of a block as the stronger."""
    strength: NDArray[np.uint16] = ~returns["second"]
    return strength


def _more_light_is_stronger(returns: StructArray) -> NDArray[np.uint32]:
    """Rank the return with more light as the stronger, of equal ones the first of the block."""
    strength: NDArray[np.uint32] = (returns["intensity"].astype(np.uint32) << np.uint32(1)) + (1 - returns["second"])
    return strength


def _clock_parser(settings: DeviceSettings) -> OusterParser:
    return OusterParser(settings, clock_only=True)


DRIVERS = (
    Driver(
        protocol="ouster",
        kind="scanner",
        transports=("udp",),
        yields=(ScannerReturns, DeviceClockSamples, ImuSamples, DeviceStatus),
        summary="Ouster OS0, OS1, OS2 by the head's metadata: single, dual and low rate, windows, IMU packets",
        make_parser=OusterParser,
        make_time_parser=_clock_parser,
        make_probe=OusterProbe,
        tells_pps=False,
        needs=("installation", "geometry.file"),
        wavelength_nm=865.0,
        bytes_per_s=42.3e6,  # 128 beams, dual return: 1280 packets a second of 33 024 bytes
    ),
)


class HealthReader:
    """Reports a head's start, alerts and countdowns when they change, together with facts from its metadata."""

    def __init__(self, layout: LidarLayout) -> None:
        self._layout = layout
        self._last: tuple[int, ...] | None = None

    def read(self, host_time_ns: Int64Array, packets: StructArray) -> list[DeviceStatus]:
        """Return one record for each change in packets (n,), n at least 1, in order."""
        health = np.zeros((len(packets), 1 + len(HEALTH)), dtype=np.int64)
        health[:, 0] = self._layout.init_id(packets)
        if not self._layout.legacy:
            for place, name in enumerate(HEALTH, start=1):
                health[:, place] = packets[name]
        changes = np.flatnonzero((health[1:] != health[:-1]).any(axis=1)) + 1
        statuses = []
        for at in (0, *changes.tolist()):
            now = tuple(health[at].tolist())
            if now != self._last:
                self._last = now
                statuses.append(self._describe(int(host_time_ns[at]), now))
        return statuses

    def _describe(self, host_ns: int, health: tuple[int, ...]) -> DeviceStatus:
        head = self._layout.head
        values: dict[str, float | int | str | bool] = {
            "model": head.model,
            "profile": head.profile,
            "timestamp_mode": head.timestamp_mode or "unsaid",
        }
        if head.timestamp_mode == SYNC_PULSE:
            values["nmea_input"] = head.nmea_input
        if not self._layout.legacy:
            values["init_id"] = health[0]
            if head.init_id is not None:
                values["metadata_of_this_start"] = health[0] == head.init_id
            values |= dict(zip(HEALTH, health[1:], strict=True))
        return DeviceStatus(host_ns, values, message="lidar")
