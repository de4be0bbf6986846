"""Velodyne spinning heads: data packets (1206 bytes) and position packets (512 bytes), distinguished by their length.

Wire format: VLP-16 User Manual 63-9243 rev. D, sections 9.3 to 9.5. Device time is the packet's microseconds past
the hour plus the laser's firing offset, nanoseconds, modulo one hour; swath.georef.timescales finds *which* hour. It is
UTC's hour only while the PPS status is locked; otherwise the head counts from power-on.

Dual returns (9.3.2): even blocks contain the last return, odd blocks the strongest, or the second-strongest where the
strongest is the last. Equal ranges are one return. Of two returns the nearer is number 1, the farther is the last,
and the one of greater reflectivity is the strongest (the odd block's where they are equal), since the packet does
not show which case applies.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from swath.drivers.driver import Driver
from swath.drivers.parser import DeviceSettings, PacketParser, Parser
from swath.drivers.scanner.beams import BeamTable
from swath.drivers.scanner.rows.filler import filler
from swath.drivers.scanner.rows.slots import Chosen
from swath.drivers.scanner.sequence import SampleThinner, StampTracker
from swath.drivers.scanner.spinning import Firings, returns_of_packets
from swath.drivers.scanner.velodyne.calibration import read_calibration
from swath.drivers.scanner.velodyne.heads import (
    BLOCKS,
    HDL32E,
    PACKET_BYTES,
    PLACES,
    VLP16,
    VLP16_HIRES,
    VLP32C,
    VLS128,
    SpinningHead,
)
from swath.drivers.scanner.velodyne.position import HOUR_US, POSITION_BYTES, PositionReader
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

MODE_STRONGEST, MODE_LAST, MODE_DUAL = 0x37, 0x38, 0x39  # first factory byte, table 9-2
RETURN_MODES = (MODE_STRONGEST, MODE_LAST, MODE_DUAL)
SINGLE_FLAGS = {MODE_STRONGEST: RETURN_FLAG_STRONGEST, MODE_LAST: RETURN_FLAG_LAST}
FULL_CIRCLE = 36_000  # azimuth in 0.01°, 9.3.1.4
MAX_GAP = 200  # 0.01° between groups: 20 rev/s give 79.6; more is a step across the field of view, not rotation
HOUR_NS = 3_600_000_000_000
MAX_TURN_US = 5_000  # a longer step of the stamps may hide an edge of the field of view
MAX_SILENCE_US = 10_000_000  # a longer step of the stamps means that the clock was set, not that packets were lost

_RETURN = np.dtype([("range", "<u2"), ("reflectivity", "u1")])
_BLOCK = np.dtype([("flag", "<u2"), ("azimuth", "<u2"), ("returns", _RETURN, (PLACES,))])
PACKET_DTYPE = np.dtype([("blocks", _BLOCK, (BLOCKS,)), ("stamp_us", "<u4"), ("mode", "u1"), ("product", "u1")])


def encode_data_packet(
    stamp_us: int,
    azimuth_0p01deg: ArrayLike,
    range_raw: ArrayLike,
    reflectivity: ArrayLike,
    mode: int = MODE_STRONGEST,
    head: SpinningHead = VLP16,
) -> bytes:
    """Encode one data packet (9.3.2).

    Args:
        stamp_us: time of the first firing, microseconds past the hour.
        azimuth_0p01deg: (12,) at the first firing of each block's group; in dual return pairs of equal ones.
        range_raw: (12, 32) in the head's unit, 0 = no return.
        reflectivity: (12, 32) or one value for all.
        mode: `MODE_STRONGEST`, `MODE_LAST` or `MODE_DUAL`.
        head: the model.
    """
    packet = np.zeros(1, dtype=PACKET_DTYPE)
    blocks = packet["blocks"][0]
    flags = head.used_block_flags(dual=mode == MODE_DUAL)
    blocks["flag"][: len(flags)], blocks["azimuth"] = flags, azimuth_0p01deg
    blocks["returns"]["range"], blocks["returns"]["reflectivity"] = range_raw, reflectivity
    packet["stamp_us"], packet["mode"], packet["product"] = stamp_us, mode, head.product_ids[0]
    return packet.tobytes()


class VelodyneParser(PacketParser):
    """Decodes data and position packets of one head.

    Counts ``bad_length``, ``bad_block_flag``, ``bad_azimuth``, ``bad_return_mode``, ``wrong_product`` (another model
    answers), ``cadence_gap`` (packets missing by the stamps), ``out_of_order`` (late, counted as missing before),
    ``stamp_jump`` (the head's clock was set), ``duplicate``, and the position packets' ``bad_nmea``,
    ``nmea_second_mismatch`` and ``date_before_floor``.

    Args:
        settings: ``geometry.file`` is the head's own calibration, db.xml or YAML.
        head: the model.
        clock_only: return no returns, and clock samples of one data packet in 50 ms of host time.

    Attributes:
        beams: the head's own beams where its calibration is given, else the design values.
    """

    def __init__(self, settings: DeviceSettings, head: SpinningHead = VLP16, *, clock_only: bool = False) -> None:
        super().__init__()
        self._head = head
        self.beams: BeamTable = head.beams
        if "geometry" in settings.files:
            self.beams = read_calibration(settings.files["geometry"], head)
        self._flags = [head.used_block_flags(dual=dual) for dual in (False, True)]
        self._position = PositionReader(self.counters, settings)
        self._thinner = SampleThinner() if clock_only else None
        self._fill = filler(compiled=settings.compiled and not clock_only)
        self._stamps = StampTracker(self.counters.errors, HOUR_US, MAX_SILENCE_US)
        self._last_stamp_us: int | None = None
        self._last_azimuth = 0
        self._last_turn = 0.0
        self._packets = 0

    def parse_units(self, host_time_ns: Int64Array, units: ByteRows) -> list[Record]:
        """Decode packets of equal length; see `PacketParser.parse_units`."""
        self.counters.bytes += units.size
        if units.shape[1] == POSITION_BYTES:
            return self._position.read(host_time_ns, units)
        if units.shape[1] != PACKET_BYTES:
            self.counters.count_bad("bad_length", len(units), units.shape[1])
            return []
        packets = units.view(PACKET_DTYPE)[:, 0]
        good = self._check(packets)
        self.counters.messages["data"] += int(good.sum())
        self.counters.bytes_framed += int(good.sum()) * PACKET_BYTES
        if not good.all():
            host_time_ns, packets = host_time_ns[good], packets[good]
        fresh, turn = self._follow(packets)
        if not fresh.all():
            host_time_ns, packets, turn = host_time_ns[fresh], packets[fresh], turn[fresh]
        return self._decode(host_time_ns, packets, turn) if len(packets) else []

    def remarks(self) -> list[str]:
        """Return remarks on the dates that the head received."""
        return self._position.dates.remarks()

    def _decode(self, host_time_ns: Int64Array, packets: StructArray, turn: FloatArray) -> list[Record]:
        clock = _clock_samples(host_time_ns, packets["stamp_us"], packets["mode"], self._head)
        clock["locked"] = self._position.locked
        if self._thinner is not None:
            clock = clock[self._thinner.choose(host_time_ns)]
        records: list[Record] = [DeviceClockSamples(clock)] if len(clock) else []
        if self._thinner is None:
            number = self._packets + np.arange(len(packets), dtype=np.int64)
            rows = returns_of_packets(
                packets["mode"],
                BLOCKS * PLACES,
                lambda part: self._firings(host_time_ns[part], packets[part], turn[part], number[part]),
                self._fill,
            )
            if len(rows):
                records.append(ScannerReturns(rows))
        self._packets += len(packets)
        return records

    def _check(self, packets: StructArray) -> BoolArray:
        """Return (n,) True for packets of this model that can be decoded; the others are counted by error."""
        flag, azimuth = packets["blocks"]["flag"], packets["blocks"]["azimuth"]
        dual, mode = packets["mode"] == MODE_DUAL, packets["mode"]
        flags_right, azimuths_right = np.empty((2, len(packets)), dtype=np.bool_)
        for rows, flags in ((~dual, self._flags[0]), (dual, self._flags[1])):
            used = slice(0, len(flags))
            flags_right[rows] = (flag[rows, used] == flags).all(axis=1)
            # an HDL may send 36 000 for 0 (PointCloudLibrary/pcl #20)
            azimuths_right[rows] = (azimuth[rows, used] <= FULL_CIRCLE).all(axis=1)
        good = np.ones(len(packets), dtype=np.bool_)
        for code, passes in (
            ("bad_block_flag", flags_right),
            ("wrong_product", np.isin(packets["product"], self._head.product_ids)),
            ("bad_return_mode", np.isin(mode, RETURN_MODES)),
            ("bad_azimuth", azimuths_right),
        ):
            self.counters.count_bad(code, int((good & ~passes).sum()), PACKET_BYTES)
            good &= passes
        return good

    def _follow(self, packets: StructArray) -> tuple[BoolArray, FloatArray]:
        """Find missing packets between the stamps; follow the rotation from packet to packet.

        Returns:
            fresh: (n,) False for a packet that has come before.
            turn: (n,) rotation from group to group in 0.01°, as far as it is known.
        """
        stamps = packets["stamp_us"].astype(np.int64)
        if not len(stamps):
            return np.zeros(0, dtype=np.bool_), np.zeros(0)
        first = self._last_stamp_us is None
        before = np.concatenate([[stamps[0] - 1 if self._last_stamp_us is None else self._last_stamp_us], stamps[:-1]])
        self._last_stamp_us = int(stamps[-1])
        step_us = (stamps - before) % HOUR_US
        groups = np.where(packets["mode"] == MODE_DUAL, self._head.groups(dual=True), self._head.groups(dual=False))
        nominal_us = groups * self._head.group_ns / 1000
        fresh = self._stamps.follow(stamps, nominal_us)
        steps = np.rint(step_us / nominal_us).astype(np.int64)
        return fresh, self._turn(packets["blocks"]["azimuth"][:, 0], steps * groups, step_us, known=not first)

    def _turn(self, azimuth: NDArray[np.uint16], groups: Int64Array, step_us: Int64Array, *, known: bool) -> FloatArray:
        """Return rotation a group (n,) from each packet's predecessor, or the last known one where that does not show
        it.
        """
        before = np.concatenate([[self._last_azimuth], azimuth[:-1]])
        gap = (azimuth - before) % FULL_CIRCLE / np.maximum(groups, 1)
        tells = (groups > 0) & (step_us < MAX_TURN_US) & (gap <= MAX_GAP)
        tells[0] &= known
        place = np.maximum.accumulate(np.where(tells, np.arange(len(gap)), -1))
        turn: FloatArray = np.where(place < 0, self._last_turn, gap[place])
        self._last_azimuth, self._last_turn = int(azimuth[-1]), float(turn[-1])
        return turn

    def _firings(self, host_time_ns: Int64Array, packets: StructArray, turn: FloatArray, number: Int64Array) -> Firings:
        """Return the firings of packets of one return mode."""
        head, mode = self._head, int(packets["mode"][0])
        dual = mode == MODE_DUAL
        used, groups = len(self._flags[dual]), head.groups(dual=dual)
        azimuth = packets["blocks"]["azimuth"][:, : used : used // groups]
        return Firings(
            returns=packets["blocks"]["returns"][:, :used],
            range_unit_m=head.range_unit_m,
            host_time_ns=host_time_ns,
            number=number,
            most=BLOCKS * PLACES,
            device_time_ns=_firing_times(packets["stamp_us"], head, groups),
            azimuth_rad=_firing_azimuths(azimuth, turn, head),
            channel=head.channel,
            flags=SINGLE_FLAGS.get(mode, 0) | (RETURN_FLAG_PPS_LOCKED if self._position.locked == 1 else 0),
            echoes=2 if dual else 1,
            names=(True, True),
        )


def _firing_times(stamp_us: NDArray[np.uint32], head: SpinningHead, groups: int) -> Callable[[Chosen], Int64Array]:
    """Return a function for device times of firings (9.4), from those of groups (n · groups, 1) and lasers (1,
    places).
    """
    first = stamp_us.astype(np.int64)[:, np.newaxis] * 1000 + (np.arange(groups) * head.group_ns + head.stamp_ns)
    group_ns, offset_ns = first.reshape(-1, 1), head.offset_ns[np.newaxis]
    if first.max() + offset_ns.max() >= HOUR_NS or first.min() < 0:
        return lambda at: (at(group_ns) + at(offset_ns)) % HOUR_NS
    return lambda at: at(group_ns) + at(offset_ns)


def _firing_azimuths(
    azimuth: NDArray[np.uint16], turn: FloatArray, head: SpinningHead
) -> Callable[[Chosen], FloatArray]:
    """Return a function for azimuths of firings in radians, 0 … 2π, extrapolated from the groups' own (n, groups)
    (9.5).

    The rotation is taken to the packet's next group; the last group uses the rotation to itself, and a packet's only
    group uses ``turn`` (n,).
    """
    start = azimuth.astype(np.float64)
    gap = np.empty(start.shape)
    if start.shape[1] == 1:
        gap[:, 0] = turn
    else:
        gap[:, :-1] = (start[:, 1:] - start[:, :-1]) % FULL_CIRCLE
        gap[:, -1] = gap[:, -2]
    odd = gap > MAX_GAP
    if odd.any():
        usual = np.where(odd, 0, gap).sum(axis=1) // np.maximum(1, (~odd).sum(axis=1))
        gap = np.where(odd, usual[:, np.newaxis], gap)
    passed = (head.offset_ns / head.group_ns)[np.newaxis]

    def made_of(at: Chosen) -> FloatArray:
        firing = at(gap.reshape(-1, 1)) * at(passed)
        firing += at(start.reshape(-1, 1))
        firing -= (firing >= FULL_CIRCLE) * np.float64(FULL_CIRCLE)
        firing *= 2 * np.pi / FULL_CIRCLE
        return firing

    return made_of


def _clock_samples(
    host_time_ns: Int64Array, stamp_us: NDArray[np.uint32], mode: ByteArray, head: SpinningHead
) -> StructArray:
    """Return one `DEVICE_CLOCK_DTYPE` row a packet: device time of its last firing; the packet has no latched edge."""
    groups = np.where(mode == MODE_DUAL, head.groups(dual=True), head.groups(dual=False))
    last_ns = (groups - 1) * head.group_ns + int(head.offset_ns.max()) + head.stamp_ns
    rows = np.empty(len(stamp_us), dtype=DEVICE_CLOCK_DTYPE)
    rows["host_time_ns"] = host_time_ns
    rows["device_time_ns"] = (stamp_us.astype(np.int64) * 1000 + last_ns) % HOUR_NS
    rows["pps_time_ns"] = rows["pps_count"] = -1
    return rows


def _maker(head: SpinningHead, *, clock_only: bool) -> Callable[[DeviceSettings], Parser]:
    return lambda settings: VelodyneParser(settings, head, clock_only=clock_only)


def _driver(protocol: str, head: SpinningHead) -> Driver:
    return Driver(
        protocol=protocol,
        kind="scanner",
        transports=("udp",),
        yields=(ScannerReturns, DeviceClockSamples, TimeMessage, DeviceStatus),
        summary=f"Velodyne {head.name}: single and dual return, position packets with NMEA and PPS status",
        make_parser=_maker(head, clock_only=False),
        make_time_parser=_maker(head, clock_only=True),
        needs=("installation",),
        wavelength_nm=903.0,
        eight_bit_intensity=True,
        past_hour=True,
        bytes_per_s=1e9 * head.packet_bytes_per_ns,
    )


DRIVERS = (
    _driver("velodyne-hdl32e", HDL32E),
    _driver("velodyne-vlp16", VLP16),
    _driver("velodyne-vlp16-hires", VLP16_HIRES),
    _driver("velodyne-vlp32c", VLP32C),
    _driver("velodyne-vls128", VLS128),
)
