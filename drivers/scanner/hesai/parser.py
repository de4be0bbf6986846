"""Hesai spinning heads: point cloud and GPS data packets.

Wire format: the models' user manuals, 3.1.2 and Appendix II (`swath.drivers.scanner.hesai.models`), 3.2
(`swath.drivers.scanner.hesai.gps`). Device time is nanoseconds since 1970 of the UTC in the packets, without leap
seconds; until the head receives a time, it counts from a virtual date. Its microseconds restart at each edge of its
1 Hz signal, so while the head reports that this signal is locked to the PPS, the beginning of its second is the latched
edge.

Azimuths are extrapolated from the block's firing to the channel's own with the motor's speed, as in the maker's SDK.
The directions of a head with mirrors (`swath.drivers.scanner.hesai.at128`) are those of its block, as in that SDK.
"""

from __future__ import annotations

import datetime as dt
from abc import abstractmethod
from collections.abc import Callable, Mapping

import numpy as np
from fastcrc.crc32 import mpeg_2
from numpy.typing import ArrayLike, NDArray

from swath.drivers.driver import Driver
from swath.drivers.parser import DeviceSettings, DriverSettingsError, PacketParser, Parser
from swath.drivers.scanner.beams import BeamTable
from swath.drivers.scanner.hesai.at128 import (
    AT128,
    FAULT,
    FAULT_START,
    FILE,
    FINE,
    LASERS,
    REPORT_BYTES,
    MirrorAngles,
    Mirrors,
    read_mirror_angles,
)
from swath.drivers.scanner.hesai.gps import GPS_BYTES, NS, GpsReader
from swath.drivers.scanner.hesai.heads import (
    BLOCK_SOP,
    MODE_STRONGEST,
    SEQUENCE,
    SEVERAL_NAMES,
    SINGLE_FLAGS,
    SOP,
    HesaiHead,
    Layout,
    echoes_of,
    read_angle_file,
)
from swath.drivers.scanner.hesai.models import QT64, QT128, XT16, XT32, XT32M2X
from swath.drivers.scanner.hesai.pandar import OT128, PANDAR40P, PANDAR64, PANDAR128
from swath.drivers.scanner.rows.filler import filler
from swath.drivers.scanner.rows.slots import BLOCK_SLOTS, Chosen, returns_table
from swath.drivers.scanner.sequence import SampleThinner, SequenceTracker
from swath.drivers.scanner.spinning import Firings, parts_of, returns_of_packets
from swath.georef.arrays import BoolArray, ByteArray, FloatArray, Int64Array, StructArray
from swath.georef.records import (
    AIMED_RETURN_DTYPE,
    DEVICE_CLOCK_DTYPE,
    RETURN_FLAG_PPS_LOCKED,
    ByteRows,
    DeviceClockSamples,
    DeviceStatus,
    Record,
    ScannerReturns,
    TimeMessage,
)

FULL_CIRCLE = 36_000  # azimuth in 0.01°
MAX_MICROSECOND = 1_999_999  # the manuals' range ends at 1 000 000; a head may count on until a late edge
_UTC = np.dtype([(name, "u1") for name in ("year", "month", "day", "hour", "minute", "second")])
_RAD_PER_NS_AT_1_RPM = 2 * np.pi / (60 * NS)


def encode_point_packet(
    time: dt.datetime,
    azimuth_0p01deg: ArrayLike,
    range_raw: ArrayLike,
    reflectivity: ArrayLike,
    mode: int = MODE_STRONGEST,
    *,
    head: HesaiHead = XT32,
    sequence: int | None = 1,
    motor_rpm: int = 600,
    tail: Mapping[str, int] | None = None,
) -> bytes:
    """Encode one point cloud packet.

    Args:
        time: the packet's own time, UTC.
        azimuth_0p01deg: (blocks,), equal ones for the blocks of a round; with fractions where the head sends them.
        range_raw: (blocks, channels) in the head's first unit, 0 = no return.
        reflectivity: (blocks, channels) or one value for all.
        mode: ``MODE_…``.
        head: the model.
        sequence: UDP sequence number; None where the head sends none.
        motor_rpm: speed of rotation.
        tail: other fields of the tail, by name.
    """
    flags = head.flags & ~SEQUENCE | (0 if sequence is None else SEQUENCE)
    packet = np.zeros(1, dtype=head.packet_dtype(flags))
    utc = bytes((time.year - head.year_base, time.month, time.day, time.hour, time.minute, time.second))
    fields: dict[str, object] = {
        "sop": SOP,
        "protocol_major": head.protocol_major,
        "protocol_minor": head.protocol_minor,
        "laser_num": head.channels,
        "block_num": head.blocks,
        "distance_unit_mm": head.units_mm[0],
        "return_num": echoes_of(mode),
        "flags": flags,
        "mode": mode,
        "motor_rpm": motor_rpm,
        "motor_0p1rpm": 10 * motor_rpm,
        "utc": np.void(utc),
        "microsecond": time.microsecond,
        "factory": 0x42,
        **(tail or {}),
    }
    for name, value in fields.items():
        if name in (packet.dtype.names or ()):
            packet[name] = value
    if ("sop", "<u2") in head.block:
        packet["blocks"]["sop"] = BLOCK_SOP
    parts = FINE if ("fine", "u1") in head.block else 1
    azimuth = np.rint(np.asarray(azimuth_0p01deg, dtype=np.float64) * parts).astype(np.int64)
    packet["blocks"]["azimuth"] = azimuth // parts
    if parts > 1:
        packet["blocks"]["fine"] = azimuth % parts
    packet["blocks"]["returns"]["range"], packet["blocks"]["returns"]["reflectivity"] = range_raw, reflectivity
    if sequence is not None:
        packet["sequence"] = sequence
    return with_checksums(packet.tobytes(), packet.dtype)


def with_checksums(packet: bytes, dtype: np.dtype[np.void]) -> bytes:
    """Return a packet with the CRCs, if it has any, that belong to its content."""
    made = bytearray(packet)
    for start, at in checked_parts(dtype):
        made[at : at + 4] = mpeg_2(packet[start:at]).to_bytes(4, "little")
    return bytes(made)


def checked_parts(dtype: np.dtype[np.void]) -> list[tuple[int, int]]:
    """Return the first byte of each part of a packet that a CRC follows, and the CRC's own.

    CRC-32/MPEG-2 of the blocks, and of the tail from behind the functional safety (as seen in the recording of a
    QT128C2X; the manuals do not say which CRC it is).
    """
    fields = dtype.fields
    assert fields is not None
    if "body_crc" not in fields:
        return []
    starts = (("blocks", "body_crc"), ("tail_reserved", "tail_crc"))
    return [(int(fields[start][1]), int(fields[crc][1])) for start, crc in starts]


class _HesaiParser(PacketParser):
    """Decodes point cloud and GPS data packets of one head, distinguished by their length.

    Counts ``bad_length``, ``bad_header``, ``wrong_product`` (another model answers), ``bad_return_mode``,
    ``bad_azimuth``, ``bad_time``, ``bad_gps``, ``date_before_floor``, and of the UDP sequence ``sequence_gap``,
    ``out_of_order``, ``duplicate`` and ``restart`` (the head's time went back); packets whose CRC is wrong are
    ``bad_checksums``.

    Args:
        settings: of the device.
        head: the model.
        clock_only: return no returns, and clock samples of one data packet in 50 ms of host time.
    """

    def __init__(self, settings: DeviceSettings, head: HesaiHead, *, clock_only: bool = False) -> None:
        super().__init__()
        self._layouts = head.layouts()
        self._gps = GpsReader(self.counters, settings)
        self._tracker = SequenceTracker(self.counters.errors)
        self._thinner = SampleThinner() if clock_only else None
        self._fill = filler(compiled=settings.compiled and not clock_only)
        self._unnumbered = 0

    def parse_units(self, host_time_ns: Int64Array, units: ByteRows) -> list[Record]:
        """Decode packets of equal length; see `PacketParser.parse_units`."""
        self.counters.bytes += units.size
        length = units.shape[1]
        if length == GPS_BYTES:
            return self._gps.read(host_time_ns, units)
        if length not in self._layouts:
            self.counters.count_bad("bad_length", len(units), length)
            return []
        layout = self._layouts[length]
        packets = units.view(layout.dtype)[:, 0]
        second_ns = NS * _utc_seconds(packets, layout.head)
        good = self._check(packets, self._checksums_hold(units, layout), layout)
        self.counters.messages["points"] += int(good.sum())
        self.counters.bytes_framed += int(good.sum()) * length
        if not good.all():
            host_time_ns, packets, second_ns = host_time_ns[good], packets[good], second_ns[good]
        if not len(packets):
            return []
        number, fresh = self._follow(host_time_ns, packets, second_ns)
        if not fresh.all():
            host_time_ns, packets = host_time_ns[fresh], packets[fresh]
            second_ns, number = second_ns[fresh], number[fresh]
        return self._decode(layout.head, host_time_ns, packets, second_ns, number) if len(packets) else []

    def remarks(self) -> list[str]:
        """Return remarks on the dates that the head received."""
        return self._gps.dates.remarks()

    def _checksums_hold(self, units: ByteRows, layout: Layout) -> BoolArray:
        """Return (n,) False for packets of this head whose CRCs are wrong; they are counted."""
        holds = np.ones(len(units), dtype=np.bool_)
        for start, at in checked_parts(layout.dtype) if layout.head.checks_crc else []:
            stated = np.ascontiguousarray(units[:, at : at + 4]).view("<u4")[:, 0].tolist()
            for row in np.flatnonzero(holds).tolist():
                holds[row] = mpeg_2(units[row, start:at].data) == stated[row]
        wrong = len(holds) - int(holds.sum())
        self.counters.bad_checksums += wrong
        self.counters.bytes_skipped += wrong * units.shape[1]
        return holds

    def _check(self, packets: StructArray, good: BoolArray, layout: Layout) -> BoolArray:
        """Return (n,) True for good packets of this model that can be decoded; the others are counted by error."""
        head, utc = layout.head, packets["utc"].copy().view(_UTC)
        counts_seconds = (utc["year"] == 0) & (head.year_base == 1900)
        for code, passes in (
            ("bad_header", self._starts(packets)),
            (
                "wrong_product",
                (_stated(packets, "protocol_major", head.protocol_major) == head.protocol_major)
                & (np.True_ if len(head.beams) else _stated(packets, "protocol_minor", 0) == head.protocol_minor),
            ),
            (
                "bad_header",
                (_stated(packets, "laser_num", head.channels) == head.channels)
                & (_stated(packets, "block_num", head.blocks) == head.blocks)
                & np.isin(_stated(packets, "distance_unit_mm", head.units_mm[0]), head.units_mm)
                & (layout.fits[packets["flags"]] if "flags" in (packets.dtype.names or ()) else np.True_),
            ),
            ("bad_return_mode", np.isin(packets["mode"], head.modes)),
            ("bad_azimuth", (packets["blocks"]["azimuth"] < FULL_CIRCLE).all(axis=1)),
            (
                "bad_time",
                (packets["microsecond"] <= MAX_MICROSECOND)
                & (counts_seconds | (_within(utc["month"], 1, 12) & _within(utc["day"], 1, 31)))
                & (counts_seconds | ((utc["hour"] < 24) & (utc["minute"] < 60) & (utc["second"] <= 60))),
            ),
        ):
            self.counters.count_bad(code, int((good & ~passes).sum()), packets.dtype.itemsize)
            good &= passes
        return good

    def _starts(self, packets: StructArray) -> BoolArray:
        """Return (n,) True for packets that begin, or whose blocks all begin, with their mark."""
        if "sop" in (packets.dtype.names or ()):
            header: BoolArray = packets["sop"] == SOP
            return header
        blocks: BoolArray = (packets["blocks"]["sop"] == BLOCK_SOP).all(axis=1)
        return blocks

    def _follow(
        self, host_time_ns: Int64Array, packets: StructArray, second_ns: Int64Array
    ) -> tuple[Int64Array, BoolArray]:
        """Return the running number of each packet, and False where it repeats the one before."""
        if "sequence" in (packets.dtype.names or ()):
            stamp_ns = second_ns + packets["microsecond"].astype(np.int64) * 1000
            none = np.zeros(len(packets), dtype=np.uint32)
            return self._tracker.follow(packets["sequence"], stamp_ns, none, host_time_ns)
        number = self._unnumbered + np.arange(len(packets), dtype=np.int64)
        self._unnumbered += len(packets)
        return number, np.ones(len(packets), dtype=np.bool_)

    def _decode(
        self,
        head: HesaiHead,
        host_time_ns: Int64Array,
        packets: StructArray,
        second_ns: Int64Array,
        number: Int64Array,
    ) -> list[Record]:
        stamp_ns = second_ns + packets["microsecond"].astype(np.int64) * 1000
        chosen = slice(None) if self._thinner is None else self._thinner.choose(host_time_ns)
        clock = self._clock_samples(
            head, host_time_ns[chosen], stamp_ns[chosen], second_ns[chosen], packets["mode"][chosen]
        )
        records: list[Record] = [DeviceClockSamples(clock)] if len(clock) else []
        if self._thinner is None:
            rows = self._returns(head, host_time_ns, packets, stamp_ns, number)
            if len(rows):
                records.append(ScannerReturns(rows))
        return records

    @abstractmethod
    def _returns(
        self, head: HesaiHead, host_time_ns: Int64Array, packets: StructArray, stamp_ns: Int64Array, number: Int64Array
    ) -> StructArray:
        """Return the returns of packets."""

    def _clock_samples(
        self, head: HesaiHead, host_time_ns: Int64Array, stamp_ns: Int64Array, second_ns: Int64Array, mode: ByteArray
    ) -> StructArray:
        """Return one `DEVICE_CLOCK_DTYPE` row a packet: device time of its last firing, and the edge that began its
        second.
        """
        last_ns = np.zeros(256, dtype=np.int64)
        last_ns[list(head.modes)] = [head.last_ns(one) for one in head.modes]
        rows = np.empty(len(stamp_ns), dtype=DEVICE_CLOCK_DTYPE)
        rows["host_time_ns"] = host_time_ns
        rows["device_time_ns"] = stamp_ns + last_ns[mode]
        rows["pps_time_ns"] = second_ns if self._gps.locked == 1 else -1
        rows["pps_count"] = -1
        rows["locked"] = self._gps.locked
        return rows

    def _firings(
        self,
        head: HesaiHead,
        host_time_ns: Int64Array,
        packets: StructArray,
        stamp_ns: Int64Array,
        number: Int64Array,
        azimuth_rad: FloatArray | None = None,
    ) -> Firings:
        """Return the firings of packets of one return mode and one unit of distance.

        The azimuths (n · rounds, lasers) of a head with mirrors are given.
        """
        mode = int(packets["mode"][0])
        echoes = echoes_of(mode)
        azimuth = packets["blocks"]["azimuth"][:, ::echoes]
        rounds = azimuth.shape[1]
        round_ns = (stamp_ns[:, np.newaxis] + head.rounds_ns(packets, rounds)).reshape(-1, 1)
        firing_ns = head.firing_ns(packets, rounds)
        returns = packets["blocks"]["returns"]
        if head.least_range > 1:
            returns = returns.copy()
            returns["range"] *= returns["range"] >= head.least_range
        return Firings(
            returns=returns,
            range_unit_m=int(_stated(packets, "distance_unit_mm", head.units_mm[0])[0]) * 1e-3,
            host_time_ns=host_time_ns,
            number=number,
            most=head.blocks * head.channels,
            device_time_ns=lambda at: at(round_ns) + at(firing_ns),
            azimuth_rad=(
                _azimuths(azimuth, packets["motor_rpm"], firing_ns)
                if azimuth_rad is None
                else lambda at: at(azimuth_rad)
            ),
            channel=np.arange(head.channels, dtype=np.uint16),
            flags=SINGLE_FLAGS.get(mode, 0) | (RETURN_FLAG_PPS_LOCKED if self._gps.locked == 1 else 0),
            echoes=echoes,
            names=SEVERAL_NAMES.get(mode, (False, False)),
        )


class HesaiParser(_HesaiParser):
    """Decodes the packets of a spinning head; see `_HesaiParser` for what it counts.

    Args:
        settings: ``geometry.file`` is the head's own angle correction file.
        head: the model.
        clock_only: return no returns, and clock samples of one data packet in 50 ms of host time.

    Attributes:
        beams: the head's own beams where its file is given, else the design values.
    """

    def __init__(self, settings: DeviceSettings, head: HesaiHead, *, clock_only: bool = False) -> None:
        super().__init__(settings, head, clock_only=clock_only)
        self.beams: BeamTable = head.beams
        if "geometry" in settings.files:
            self.beams = read_angle_file(settings.files["geometry"], head)

    def _returns(
        self, head: HesaiHead, host_time_ns: Int64Array, packets: StructArray, stamp_ns: Int64Array, number: Int64Array
    ) -> StructArray:
        return returns_of_packets(
            _modes_and_units(packets, head),
            head.blocks * head.channels,
            lambda part: self._firings(head, host_time_ns[part], packets[part], stamp_ns[part], number[part]),
            self._fill,
        )


class MirrorParser(_HesaiParser):
    """Decodes the packets of a head with mirrors, whose returns have an azimuth and an elevation.

    It sends packets about its faults to the same port. They are counted; of those of 99 bytes a status is returned
    where it changes, reports of 273 bytes are not read (udp_protocol_v4_3.h, FaultMessageVersion4_3; input.h).

    Counts ``outside_mirrors`` beside what `_HesaiParser` counts: blocks whose angle belongs to no mirror; their returns
    have no direction and are left out.

    Args:
        settings: ``geometry.file`` is the head's own angle correction file.
        head: the model.
        clock_only: return no returns, and clock samples of one data packet in 50 ms of host time.
        probe: do without the file, to recognise the head.

    Raises:
        DriverSettingsError: the file is missing or unusable.
    """

    def __init__(
        self, settings: DeviceSettings, head: HesaiHead, *, clock_only: bool = False, probe: bool = False
    ) -> None:
        super().__init__(settings, head, clock_only=clock_only)
        if "geometry" in settings.files:
            self._mirrors = Mirrors(read_mirror_angles(settings.files["geometry"]))
        elif probe:
            self._mirrors = Mirrors(_NO_ANGLES)
        else:
            raise DriverSettingsError(f"{FILE}: missing; give the angle correction file of the head")
        self._plain = returns_table(0 if clock_only else BLOCK_SLOTS)
        self._state: dict[str, float | int | str | bool] = {}

    def parse_units(self, host_time_ns: Int64Array, units: ByteRows) -> list[Record]:
        """Decode packets of equal length; see `PacketParser.parse_units`."""
        length = units.shape[1]
        if length not in (FAULT.size, REPORT_BYTES):
            return super().parse_units(host_time_ns, units)
        self.counters.bytes += units.size
        good = np.ones(len(units), dtype=np.bool_)
        if length == FAULT.size:
            good = (units[:, :2] == np.frombuffer(FAULT_START, dtype=np.uint8)).all(axis=1)
            self.counters.count_bad("bad_header", int((~good).sum()), length)
        self.counters.messages["fault" if length == FAULT.size else "report"] += int(good.sum())
        self.counters.bytes_framed += int(good.sum()) * length
        records: list[Record] = []
        for row in np.flatnonzero(good).tolist() if length == FAULT.size else []:
            _, operating, fault, count = FAULT.unpack(units[row].tobytes())
            state: dict[str, float | int | str | bool] = {
                "operating_state": operating,
                "fault_state": fault,
                "faults": count,
            }
            if state != self._state:
                self._state = state
                records.append(DeviceStatus(int(host_time_ns[row]), dict(state), "fault"))
        return records

    def _returns(
        self, head: HesaiHead, host_time_ns: Int64Array, packets: StructArray, stamp_ns: Int64Array, number: Int64Array
    ) -> StructArray:
        most = head.blocks * head.channels
        table = np.empty(len(packets) * most, dtype=AIMED_RETURN_DTYPE)
        words, filled = table.view(np.uint64).reshape(len(table), -1), 0
        for part in parts_of(_modes_and_units(packets, head), most):
            azimuth, elevation, seen = self._directions(packets[part])
            firings = self._firings(head, host_time_ns[part], seen, stamp_ns[part], number[part], azimuth)
            slots = firings.slots()
            end = filled + self._fill(slots, self._plain)
            # which firing each return is of, in the order of the rows
            firing = np.flatnonzero(slots.content["range"]) // slots.content.shape[1]
            words[filled:end, :-1] = self._plain[: end - filled].view(np.uint64).reshape(end - filled, -1)
            words[filled:end, -1] = elevation.reshape(-1).take(firing).view(np.uint64)
            filled = end
        return table[:filled]

    def _directions(self, packets: StructArray) -> tuple[FloatArray, FloatArray, StructArray]:
        """Return azimuths and elevations (rounds, lasers) of packets of one mode; and the packets without returns of no
        mirror.
        """
        blocks = packets["blocks"][:, :: echoes_of(int(packets["mode"][0]))]
        shaft = blocks["azimuth"].astype(np.int64) * FINE
        if "fine" in (blocks.dtype.names or ()):
            shaft += blocks["fine"]
        azimuth, elevation, inside = self._mirrors.directions(shaft.reshape(-1))
        if not inside.all():
            self.counters.errors["outside_mirrors"] += int((~inside).sum())
            echoes = packets["blocks"].shape[1] // blocks.shape[1]
            packets = packets.copy()
            outside = np.repeat(~inside.reshape(blocks.shape), echoes, axis=1)
            packets["blocks"]["returns"]["range"][outside] = 0
        return azimuth, elevation, packets


_NO_ANGLES = MirrorAngles(
    start=np.zeros(1, dtype=np.int64),
    end=np.full(1, -1, dtype=np.int64),
    azimuth_deg=np.zeros(LASERS),
    elevation_deg=np.zeros(LASERS),
    more_azimuth_deg=np.zeros((1, 1)),
    more_elevation_deg=np.zeros((1, 1)),
)


def _modes_and_units(packets: StructArray, head: HesaiHead) -> NDArray[np.integer]:
    """Return a number (n,) for each packet's return mode and unit of distance."""
    key: NDArray[np.integer] = packets["mode"].astype(np.uint16) << 8
    return key | _stated(packets, "distance_unit_mm", head.units_mm[0])


def _azimuths(
    azimuth: NDArray[np.uint16], motor_rpm: NDArray[np.uint16], firing_ns: Int64Array
) -> Callable[[Chosen], FloatArray]:
    """Return a function for the azimuths at each firing, radians, 0 … 2π, from those of rounds (n, rounds) and times of
    firings.
    """
    start = (azimuth * (2 * np.pi / FULL_CIRCLE)).reshape(-1, 1)
    speed = np.repeat(motor_rpm * _RAD_PER_NS_AT_1_RPM, azimuth.shape[1])[:, np.newaxis]
    offset_ns = firing_ns.astype(np.float64)

    def made_of(at: Chosen) -> FloatArray:
        angle = at(speed) * at(offset_ns)
        angle += at(start)
        angle -= (angle >= 2 * np.pi) * (2 * np.pi)
        return angle

    return made_of


def _stated(packets: StructArray, name: str, usual: int) -> ByteArray:
    """Return a field (n,) of the header, or the value of a head that does not state it."""
    if name in (packets.dtype.names or ()):
        stated: ByteArray = packets[name]
        return stated
    return np.full(len(packets), usual, dtype=np.uint8)


def _within(value: ByteArray, least: int, most: int) -> BoolArray:
    inside: BoolArray = (value >= least) & (value <= most)
    return inside


def _utc_seconds(packets: StructArray, head: HesaiHead) -> Int64Array:
    """Return seconds since 1970 (n,) of the packets' date and time.

    The bytes are year minus 1900 and five more; or, as the maker's SDK reads a first byte of 0, seconds since 1970 in
    the last four, the highest first (udp_protocol_v6_1.h, GetMicroLidarTimeU64). Bytes that are not a date give an
    arbitrary time. The SDK counts a PandarQT's year from 2000 or from 1900 (udp_protocol_v3_1.h; the manual does not
    say), and subtracts a century from an XT's year from 200 on: so only its last two digits count, as 1970 to 2069. A
    Pandar40P and Pandar64 count it from 2000, so that 0 is a year (udp_protocol_p40.h).
    """
    raw = packets["utc"].copy()
    utc = raw.view(_UTC)
    year = (utc["year"].astype(np.int64) - 70) % 100
    month = year.astype("M8[Y]").astype("M8[M]") + (utc["month"].astype(np.int64) - 1)
    days = (month.astype("M8[D]") + (utc["day"].astype(np.int64) - 1)).astype(np.int64)
    of_day = (utc["hour"].astype(np.int64) * 60 + utc["minute"]) * 60 + utc["second"]
    counted = raw.view(np.dtype([("zero", "V2"), ("seconds", ">u4")]))["seconds"].astype(np.int64)
    return np.where((utc["year"] == 0) & (head.year_base == 1900), counted, days * 86_400 + of_day)


def _maker(head: HesaiHead, *, clock_only: bool = False, probe: bool = False) -> Callable[[DeviceSettings], Parser]:
    if not len(head.beams):
        return lambda settings: MirrorParser(settings, head, clock_only=clock_only, probe=probe)
    return lambda settings: HesaiParser(settings, head, clock_only=clock_only)


def _driver(protocol: str, head: HesaiHead) -> Driver:
    most = {2: "two", 3: "three"}[max(map(echoes_of, head.modes))]
    mirrors = not len(head.beams)
    return Driver(
        protocol=protocol,
        kind="scanner",
        transports=("udp",),
        yields=(ScannerReturns, DeviceClockSamples, TimeMessage, DeviceStatus),
        summary=f"Hesai {head.name}: one to {most} returns, GPS data packets with time and PPS lock",
        make_parser=_maker(head),
        make_time_parser=_maker(head, clock_only=True),
        make_probe=_maker(head, probe=True) if mirrors else None,
        needs=("installation", "geometry.file") if mirrors else ("installation",),
        aimed=mirrors,
        wavelength_nm=905.0,
        eight_bit_intensity=True,
        bytes_per_s=head.bytes_per_s,
    )


DRIVERS = (
    _driver("hesai-xt32", XT32),
    _driver("hesai-xt16", XT16),
    _driver("hesai-xt32m2x", XT32M2X),
    _driver("hesai-qt64", QT64),
    _driver("hesai-qt128", QT128),
    _driver("hesai-pandar40p", PANDAR40P),
    _driver("hesai-pandar64", PANDAR64),
    _driver("hesai-pandar128", PANDAR128),
    _driver("hesai-ot128", OT128),
    _driver("hesai-at128", AT128),
)
