"""Hesai spinning heads of protocols 3.1 (PandarQT) and 6.1 (PandarXT-32): point cloud and GPS data packets.

Wire format: the models' user manuals, 3.1.2 and Appendix II (`swath.drivers.scanner.hesai.heads`), 3.2
(`swath.drivers.scanner.hesai.gps`). Device time is nanoseconds since 1970 of the UTC in the packets, without leap
seconds; until the head receives a time, it counts from a virtual date. Its microseconds restart at each edge of its
1 Hz signal, so while the head reports that this signal is locked to the PPS, the beginning of its second is the latched
edge.

Azimuths are extrapolated from the block's firing to the channel's own with the motor's speed, as in the maker's SDK.
"""

from __future__ import annotations

import datetime as dt
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from swath.drivers.driver import Driver
from swath.drivers.parser import DeviceSettings, PacketParser, Parser
from swath.drivers.scanner.beams import BeamTable
from swath.drivers.scanner.hesai.gps import GPS_BYTES, NS, GpsReader
from swath.drivers.scanner.hesai.heads import QT64, XT32, HesaiHead, read_angle_file
from swath.drivers.scanner.rows.filler import filler
from swath.drivers.scanner.rows.slots import Chosen
from swath.drivers.scanner.sequence import SampleThinner, SequenceTracker
from swath.drivers.scanner.spinning import Firings, returns_of_packets
from swath.georef.arrays import BoolArray, ByteArray, FloatArray, Int64Array, StructArray
from swath.georef.records import (
    DEVICE_CLOCK_DTYPE,
    RETURN_FLAG_LAST,
    RETURN_FLAG_PPS_LOCKED,
    RETURN_FLAG_STRONGEST,
    ByteRows,
    DeviceClockSamples,
    DeviceStatus,
    Record,
    ScannerReturns,
    TimeMessage,
)

SOP = 0xFFEE
DISTANCE_UNIT_MM = 4
FULL_CIRCLE = 36_000  # azimuth in 0.01°
MAX_MICROSECOND = 1_999_999  # the manuals' range ends at 1 000 000; a head may count on until a late edge
MODE_FIRST, MODE_STRONGEST, MODE_LAST = 0x33, 0x37, 0x38
MODE_LAST_STRONGEST, MODE_LAST_FIRST, MODE_FIRST_STRONGEST = 0x39, 0x3B, 0x3C
SINGLE_FLAGS = {MODE_FIRST: 0, MODE_STRONGEST: RETURN_FLAG_STRONGEST, MODE_LAST: RETURN_FLAG_LAST}
DUAL_NAMES = {  # by mode: includes the strongest, includes the last
    MODE_LAST_STRONGEST: (True, True),
    MODE_LAST_FIRST: (False, True),
    MODE_FIRST_STRONGEST: (True, False),
}
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
) -> bytes:
    """Encode one point cloud packet.

    Args:
        time: the packet's own time, UTC.
        azimuth_0p01deg: (blocks,), in dual return pairs of equal ones.
        range_raw: (blocks, channels) in 4 mm, 0 = no return.
        reflectivity: (blocks, channels) or one value for all.
        mode: ``MODE_…``.
        head: the model.
        sequence: UDP sequence number; None where the head sends none.
        motor_rpm: speed of rotation.
    """
    packet = np.zeros(1, dtype=head.packet_dtype(sequence=sequence is not None))
    packet["sop"], packet["protocol_major"], packet["protocol_minor"] = SOP, head.protocol_major, 1
    packet["laser_num"], packet["block_num"], packet["distance_unit_mm"] = head.channels, head.blocks, DISTANCE_UNIT_MM
    packet["return_num"], packet["flags"] = 2 if mode in DUAL_NAMES else 1, sequence is not None
    packet["blocks"]["azimuth"] = azimuth_0p01deg
    packet["blocks"]["returns"]["range"], packet["blocks"]["returns"]["reflectivity"] = range_raw, reflectivity
    utc = bytes((time.year - 1900, time.month, time.day, time.hour, time.minute, time.second))
    packet["mode"], packet["motor_rpm"], packet["utc"] = mode, motor_rpm, np.void(utc)
    packet["microsecond"], packet["factory"] = time.microsecond, 0x42
    if sequence is not None:
        packet["sequence"] = sequence
    return packet.tobytes()


class HesaiParser(PacketParser):
    """Decodes point cloud and GPS data packets of one head, distinguished by their length.

    Counts ``bad_length``, ``bad_header``, ``wrong_product`` (another model answers), ``bad_return_mode``,
    ``bad_azimuth``, ``bad_time``, ``bad_gps``, ``date_before_floor``, and of the UDP sequence ``sequence_gap``,
    ``out_of_order``, ``duplicate`` and ``restart`` (the head's time went back).

    Args:
        settings: ``geometry.file`` is the head's own angle correction file.
        head: the model.
        clock_only: return no returns, and clock samples of one data packet in 50 ms of host time.

    Attributes:
        beams: the head's own beams where its file is given, else the design values.
    """

    def __init__(self, settings: DeviceSettings, head: HesaiHead, *, clock_only: bool = False) -> None:
        super().__init__()
        self._head = head
        self.beams: BeamTable = head.beams
        if "geometry" in settings.files:
            self.beams = read_angle_file(settings.files["geometry"], head)
        whole, short = head.packet_dtype(), head.packet_dtype(sequence=False)
        self._dtypes = {whole.itemsize: whole} | ({short.itemsize: short} if head.without_sequence else {})
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
        if length not in self._dtypes:
            self._refuse("bad_length", len(units), length)
            return []
        packets = units.view(self._dtypes[length])[:, 0]
        second_ns = NS * _utc_seconds(packets)
        good = self._check(packets)
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
        return self._decode(host_time_ns, packets, second_ns, number) if len(packets) else []

    def remarks(self) -> list[str]:
        """Return remarks on the dates that the head received."""
        return self._gps.dates.remarks()

    def _check(self, packets: StructArray) -> BoolArray:
        """Return (n,) True for packets of this model that can be decoded; the others are counted by error."""
        head, utc = self._head, packets["utc"].copy().view(_UTC)
        good = np.ones(len(packets), dtype=np.bool_)
        numbered = "sequence" in (packets.dtype.names or ())
        for code, passes in (
            ("bad_header", packets["sop"] == SOP),
            ("wrong_product", packets["protocol_major"] == head.protocol_major),
            (
                "bad_header",
                (packets["laser_num"] == head.channels)
                & (packets["block_num"] == head.blocks)
                & (packets["distance_unit_mm"] == DISTANCE_UNIT_MM)
                & (packets["flags"] & 1 == numbered),
            ),
            ("bad_return_mode", np.isin(packets["mode"], [*SINGLE_FLAGS, *DUAL_NAMES])),
            ("bad_azimuth", (packets["blocks"]["azimuth"] < FULL_CIRCLE).all(axis=1)),
            (
                "bad_time",
                (packets["microsecond"] <= MAX_MICROSECOND)
                & ((utc["year"] == 0) | (_within(utc["month"], 1, 12) & _within(utc["day"], 1, 31)))
                & ((utc["year"] == 0) | ((utc["hour"] < 24) & (utc["minute"] < 60) & (utc["second"] <= 60))),
            ),
        ):
            self._refuse(code, int((good & ~passes).sum()), packets.dtype.itemsize)
            good &= passes
        return good

    def _refuse(self, code: str, count: int, length: int) -> None:
        if count:
            self.counters.errors[code] += count
            self.counters.bad_messages += count
            self.counters.bytes_skipped += count * length

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
        self, host_time_ns: Int64Array, packets: StructArray, second_ns: Int64Array, number: Int64Array
    ) -> list[Record]:
        stamp_ns = second_ns + packets["microsecond"].astype(np.int64) * 1000
        chosen = slice(None) if self._thinner is None else self._thinner.choose(host_time_ns)
        clock = self._clock_samples(host_time_ns[chosen], stamp_ns[chosen], second_ns[chosen], packets["mode"][chosen])
        records: list[Record] = [DeviceClockSamples(clock)] if len(clock) else []
        if self._thinner is None:
            rows = returns_of_packets(
                packets["mode"],
                self._head.blocks * self._head.channels,
                lambda part: self._firings(host_time_ns[part], packets[part], stamp_ns[part], number[part]),
                self._fill,
            )
            if len(rows):
                records.append(ScannerReturns(rows))
        return records

    def _clock_samples(
        self, host_time_ns: Int64Array, stamp_ns: Int64Array, second_ns: Int64Array, mode: ByteArray
    ) -> StructArray:
        """Return one `DEVICE_CLOCK_DTYPE` row a packet: device time of its last firing, and the edge that began its
        second.
        """
        head = self._head
        last_ns = [
            int(head.round_start_ns(rounds)[-1] + head.offset_ns.max()) for rounds in (head.blocks, head.blocks // 2)
        ]
        dual = np.isin(mode, list(DUAL_NAMES))
        rows = np.empty(len(stamp_ns), dtype=DEVICE_CLOCK_DTYPE)
        rows["host_time_ns"] = host_time_ns
        rows["device_time_ns"] = stamp_ns + np.where(dual, last_ns[1], last_ns[0])
        rows["pps_time_ns"] = second_ns if self._gps.locked == 1 else -1
        rows["pps_count"] = -1
        rows["locked"] = self._gps.locked
        return rows

    def _firings(
        self, host_time_ns: Int64Array, packets: StructArray, stamp_ns: Int64Array, number: Int64Array
    ) -> Firings:
        """Return the firings of packets of one return mode."""
        head, mode = self._head, int(packets["mode"][0])
        azimuth = packets["blocks"]["azimuth"][:, :: 2 if mode in DUAL_NAMES else 1]
        round_ns = (stamp_ns[:, np.newaxis] + head.round_start_ns(azimuth.shape[1])).reshape(-1, 1)
        return Firings(
            returns=packets["blocks"]["returns"],
            range_unit_m=DISTANCE_UNIT_MM * 1e-3,
            host_time_ns=host_time_ns,
            number=number,
            most=head.blocks * head.channels,
            device_time_ns=lambda at: at(round_ns) + at(head.offset_ns[np.newaxis]),
            azimuth_rad=_azimuths(azimuth, packets["motor_rpm"], head),
            channel=np.arange(head.channels, dtype=np.uint16),
            flags=SINGLE_FLAGS.get(mode, 0) | (RETURN_FLAG_PPS_LOCKED if self._gps.locked == 1 else 0),
            pair=DUAL_NAMES.get(mode),
        )


def _azimuths(
    azimuth: NDArray[np.uint16], motor_rpm: NDArray[np.uint16], head: HesaiHead
) -> Callable[[Chosen], FloatArray]:
    """Return a function for the azimuths at each firing, radians, 0 … 2π, from those of rounds (n, rounds) and channel
    times.
    """
    start = (azimuth * (2 * np.pi / FULL_CIRCLE)).reshape(-1, 1)
    speed = np.repeat(motor_rpm * _RAD_PER_NS_AT_1_RPM, azimuth.shape[1])[:, np.newaxis]
    offset_ns = head.offset_ns.astype(np.float64)[np.newaxis]

    def made_of(at: Chosen) -> FloatArray:
        angle = at(speed) * at(offset_ns)
        angle += at(start)
        angle -= (angle >= 2 * np.pi) * (2 * np.pi)
        return angle

    return made_of


def _within(value: ByteArray, least: int, most: int) -> BoolArray:
    inside: BoolArray = (value >= least) & (value <= most)
    return inside


def _utc_seconds(packets: StructArray) -> Int64Array:
    """Return seconds since 1970 (n,) of the packets' date and time.

    The bytes are year minus 1900 and five more; or, as the maker's SDK reads a first byte of 0, seconds since 1970 in
    the last four, the highest first (udp_protocol_v6_1.h, GetMicroLidarTimeU64). Bytes that are not a date give an
    arbitrary time. The SDK counts a PandarQT's year from 2000 or from 1900 (udp_protocol_v3_1.h; the manual does not
    say), and subtracts a century from an XT's year from 200 on: so only its last two digits count, as 1970 to 2069.
    """
    raw = packets["utc"].copy()
    utc = raw.view(_UTC)
    year = (utc["year"].astype(np.int64) - 70) % 100
    month = year.astype("M8[Y]").astype("M8[M]") + (utc["month"].astype(np.int64) - 1)
    days = (month.astype("M8[D]") + (utc["day"].astype(np.int64) - 1)).astype(np.int64)
    of_day = (utc["hour"].astype(np.int64) * 60 + utc["minute"]) * 60 + utc["second"]
    counted = raw.view(np.dtype([("zero", "V2"), ("seconds", ">u4")]))["seconds"].astype(np.int64)
    return np.where(utc["year"] == 0, counted, days * 86_400 + of_day)


def _maker(head: HesaiHead, *, clock_only: bool) -> Callable[[DeviceSettings], Parser]:
    return lambda settings: HesaiParser(settings, head, clock_only=clock_only)


def _driver(protocol: str, head: HesaiHead) -> Driver:
    return Driver(
        protocol=protocol,
        kind="scanner",
        transports=("udp",),
        yields=(ScannerReturns, DeviceClockSamples, TimeMessage, DeviceStatus),
        summary=f"Hesai {head.name}: single and dual return, GPS data packets with time and PPS lock",
        make_parser=_maker(head, clock_only=False),
        make_time_parser=_maker(head, clock_only=True),
        needs=("installation",),
        wavelength_nm=905.0,
        eight_bit_intensity=True,
    )


DRIVERS = (_driver("hesai-xt32", XT32), _driver("hesai-qt64", QT64))
