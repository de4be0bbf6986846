"""Velodyne spinning heads: data packets (1206 bytes) and position packets (512 bytes), told apart by their length.

Wire format: VLP-16 User Manual 63-9243 rev. D, sections 9.3 to 9.5. Device time is the packet's microseconds past
the hour plus the laser's firing offset, nanoseconds, modulo one hour: *which* hour is for georef.timescales to find.
It is UTC's hour only while the PPS status is locked; otherwise the head counts from power-on.

Dual returns (9.3.2): even blocks hold the last return, odd blocks the strongest, or the second-strongest where the
strongest is the last. Equal ranges are one return. Of two returns the nearer is number 1, the farther is the last,
and the one of greater reflectivity is the strongest (the odd block's where they are equal), since the packet does
not say which case it is.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drivers.core.parser import DeviceSettings, Driver, PacketParser
from drivers.scanner.beams import FloatArray
from drivers.scanner.sequence import BoolArray, SampleThinner
from drivers.scanner.slots import BLOCK_SLOTS, ReturnSlots, pair_slots, returns_table
from drivers.scanner.velodyne_heads import VLP16, SpinningHead
from drivers.scanner.velodyne_position import HOUR_US, POSITION_BYTES, PositionReader
from georef.records import (
    DEVICE_CLOCK_DTYPE,
    RETURN_FLAG_LAST,
    RETURN_FLAG_PPS_LOCKED,
    RETURN_FLAG_STRONGEST,
    ByteRows,
    DeviceClockSamples,
    DeviceStatus,
    Int64Array,
    Record,
    ScannerReturns,
    StructArray,
    TimeMessage,
)

DATA_BYTES = 1206
BLOCKS = 12
PLACES = 32
BLOCK_FLAG = 0xEEFF  # FF EE on the wire, 9.3.1.5
MODE_STRONGEST, MODE_LAST, MODE_DUAL = 0x37, 0x38, 0x39  # first factory byte, table 9-2
RETURN_MODES = (MODE_STRONGEST, MODE_LAST, MODE_DUAL)
FULL_CIRCLE = 36_000  # azimuth in 0.01°, 9.3.1.4
MAX_GAP = 200  # 0.01° between blocks: 20 rev/s make 79.6; more is a step of the field of view, not rotation
HOUR_NS = 3_600_000_000_000
MAX_SILENCE_US = 10_000_000  # a longer step of the stamps is a clock that was set, not packets that were lost

_RETURN = np.dtype([("range", "<u2"), ("reflectivity", "u1")])
_BLOCK = np.dtype([("flag", "<u2"), ("azimuth", "<u2"), ("returns", _RETURN, (PLACES,))])
PACKET_DTYPE = np.dtype([("blocks", _BLOCK, (BLOCKS,)), ("stamp_us", "<u4"), ("mode", "u1"), ("product", "u1")])


def encode_data_packet(
    stamp_us: int,
    azimuth_0p01deg: ArrayLike,
    range_raw: ArrayLike,
    reflectivity: ArrayLike,
    mode: int = MODE_STRONGEST,
    product_id: int = VLP16.product_id,
) -> bytes:
    """One data packet (9.3.2).

    Args:
        stamp_us: time of the first firing, microseconds past the hour.
        azimuth_0p01deg: (12,) at the first firing of each block; in dual return pairs of equal ones.
        range_raw: (12, 32) in the head's unit, 0 = no return.
        reflectivity: (12, 32) or one value for all.
        mode: `MODE_STRONGEST`, `MODE_LAST` or `MODE_DUAL`.
        product_id: the model's factory byte.
    """
    packet = np.zeros(1, dtype=PACKET_DTYPE)
    blocks = packet["blocks"][0]
    blocks["flag"], blocks["azimuth"] = BLOCK_FLAG, azimuth_0p01deg
    blocks["returns"]["range"], blocks["returns"]["reflectivity"] = range_raw, reflectivity
    packet["stamp_us"], packet["mode"], packet["product"] = stamp_us, mode, product_id
    return packet.tobytes()


class VelodyneParser(PacketParser):
    """Decodes data and position packets of one head.

    Counts ``bad_length``, ``bad_block_flag``, ``bad_azimuth``, ``bad_return_mode``, ``wrong_product`` (another model
    answers), ``cadence_gap`` (packets missing by the stamps), ``stamp_jump`` (the head's clock was set),
    ``duplicate``, and the position packets' ``bad_nmea`` and ``nmea_second_mismatch``.

    Args:
        settings: no key is needed.
        head: the model.
        clock_only: no returns, and the clock of one data packet in 50 ms of host time.
    """

    def __init__(self, settings: DeviceSettings, head: SpinningHead = VLP16, *, clock_only: bool = False) -> None:
        super().__init__()
        self._head = head
        self._position = PositionReader(self.counters)
        self._thinner = SampleThinner() if clock_only else None
        self._last_stamp_us: int | None = None
        self._packets = 0

    def parse_units(self, host_time_ns: Int64Array, units: ByteRows) -> list[Record]:
        """Decode packets of equal length; see `PacketParser.parse_units`."""
        self.counters.bytes += units.size
        if units.shape[1] == POSITION_BYTES:
            return self._position.read(host_time_ns, units)
        if units.shape[1] != DATA_BYTES:
            self._refuse("bad_length", len(units), units.shape[1])
            return []
        packets = np.ascontiguousarray(units).view(PACKET_DTYPE).reshape(-1)
        good = self._check(packets)
        self.counters.messages["data"] += int(good.sum())
        self.counters.bytes_framed += int(good.sum()) * DATA_BYTES
        if not good.all():
            host_time_ns, packets = host_time_ns[good], packets[good]
        fresh = self._follow(packets)
        if not fresh.all():
            host_time_ns, packets = host_time_ns[fresh], packets[fresh]
        return self._decode(host_time_ns, packets) if len(packets) else []

    def _decode(self, host_time_ns: Int64Array, packets: StructArray) -> list[Record]:
        clock = _clock_samples(host_time_ns, packets["stamp_us"], packets["mode"], self._head)
        clock["locked"] = self._position.locked
        if self._thinner is not None:
            clock = clock[self._thinner.choose(host_time_ns)]
        records: list[Record] = [DeviceClockSamples(clock)] if len(clock) else []
        if self._thinner is None:
            rows = self._returns(host_time_ns, packets)
            if len(rows):
                records.append(ScannerReturns(rows))
        self._packets += len(packets)
        return records

    def _check(self, packets: StructArray) -> BoolArray:
        """(n,) True for packets of this model that can be decoded; the others are counted by what is wrong."""
        blocks = packets["blocks"]
        good = np.ones(len(packets), dtype=np.bool_)
        for code, passes in (
            ("bad_block_flag", (blocks["flag"] == BLOCK_FLAG).all(axis=1)),
            ("wrong_product", packets["product"] == self._head.product_id),
            ("bad_return_mode", np.isin(packets["mode"], RETURN_MODES)),
            ("bad_azimuth", (blocks["azimuth"] < FULL_CIRCLE).all(axis=1)),
        ):
            self._refuse(code, int((good & ~passes).sum()), DATA_BYTES)
            good &= passes
        return good

    def _refuse(self, code: str, count: int, length: int) -> None:
        if count:
            self.counters.errors[code] += count
            self.counters.bad_messages += count
            self.counters.bytes_skipped += count * length

    def _follow(self, packets: StructArray) -> BoolArray:
        """Look for missing packets between the stamps; (n,) False for a packet that repeats the one before."""
        stamps = packets["stamp_us"].astype(np.int64)
        if not len(stamps):
            return np.zeros(0, dtype=np.bool_)
        before = np.concatenate([[stamps[0] - 1 if self._last_stamp_us is None else self._last_stamp_us], stamps[:-1]])
        first = self._last_stamp_us is None
        self._last_stamp_us = int(stamps[-1])
        step_us = (stamps - before) % HOUR_US
        nominal_us = np.where(packets["mode"] == MODE_DUAL, BLOCKS // 2, BLOCKS) * self._head.block_ns / 1000
        missing = np.rint(step_us / nominal_us).astype(np.int64) - 1
        jumped = step_us > MAX_SILENCE_US
        lost = (missing > 0) & ~jumped
        if first:
            jumped[0] = lost[0] = False
        for code, count in (
            ("stamp_jump", int(jumped.sum())),
            ("cadence_gap", int(missing[lost].sum())),
            ("duplicate", int((step_us == 0).sum())),
        ):
            if count:
                self.counters.errors[code] += count
        fresh: BoolArray = step_us != 0
        return fresh

    def _returns(self, host_time_ns: Int64Array, packets: StructArray) -> StructArray:
        """Returns of all packets in order, in blocks of one return mode."""
        mode = packets["mode"]
        edges = [0, *(np.flatnonzero(mode[1:] != mode[:-1]) + 1).tolist(), len(packets)]
        step = BLOCK_SLOTS // (BLOCKS * PLACES)
        table = returns_table(len(packets) * BLOCKS * PLACES)
        filled = 0
        for start, stop in pairwise(edges):
            for at in range(start, stop, step):
                part = slice(at, min(at + step, stop))
                block = self._block(host_time_ns[part], packets[part], self._packets + at)
                filled += block.fill(table[filled:])
        return table[:filled]

    def _block(self, host_time_ns: Int64Array, packets: StructArray, number: int) -> ReturnSlots:
        """The slots of packets of one return mode, the first of which is the parser's ``number``-th."""
        head, mode = self._head, int(packets["mode"][0])
        locked = RETURN_FLAG_PPS_LOCKED if self._position.locked == 1 else 0
        per_slot: dict[str, NDArray[Any]] = {}
        flags: dict[str, NDArray[Any] | int] = {}
        azimuth = packets["blocks"]["azimuth"]
        if mode == MODE_DUAL:
            azimuth = azimuth[:, ::2]
            returns = packets["blocks"]["returns"]
            range_raw, reflectivity, of_pair = pair_slots(
                (returns["range"][:, ::2].reshape(-1), returns["range"][:, 1::2].reshape(-1)),
                (returns["reflectivity"][:, ::2].reshape(-1), returns["reflectivity"][:, 1::2].reshape(-1)),
            )
            per_slot["flags"] = of_pair | np.uint8(locked)
        else:
            returns = packets["blocks"]["returns"]
            range_raw, reflectivity = returns["range"].reshape(-1, 1), returns["reflectivity"].reshape(-1, 1)
            flags["flags"] = locked | (RETURN_FLAG_STRONGEST if mode == MODE_STRONGEST else RETURN_FLAG_LAST)
        firings = azimuth.shape[1] * PLACES
        shape = (len(packets), firings)
        serial = (number + np.arange(len(packets)))[:, np.newaxis] * (BLOCKS * PLACES) + np.arange(firings)
        return ReturnSlots(
            range_raw=range_raw,
            range_unit_m=head.range_unit_m,
            intensity=reflectivity,
            per_slot=per_slot,
            per_pulse={
                "host_time_ns": np.broadcast_to(host_time_ns[:, np.newaxis], shape).reshape(-1),
                "device_time_ns": _firing_times(packets["stamp_us"], head, azimuth.shape[1]).reshape(-1),
                "encoder_rad": _firing_azimuths(azimuth, head).reshape(-1),
                "pulse_id": serial.reshape(-1),
                "channel": np.broadcast_to(head.channel, (len(packets) * azimuth.shape[1], PLACES)).reshape(-1),
                "pulse_width_ns": 0,
                "mta_zone": 0,
                **flags,
            },
        )


def _firing_times(stamp_us: NDArray[np.uint32], head: SpinningHead, blocks: int) -> Int64Array:
    """Device times (n, blocks · 32) of firings (9.4)."""
    offset = (np.arange(blocks)[:, np.newaxis] * head.block_ns + head.offset_ns).reshape(-1)
    times: Int64Array = (stamp_us.astype(np.int64) * 1000)[:, np.newaxis] + offset
    if len(times) and times.max() >= HOUR_NS:
        times %= HOUR_NS
    return times


def _firing_azimuths(azimuth: NDArray[np.uint16], head: SpinningHead) -> FloatArray:
    """Azimuths (n, blocks, 32) in radians, 0 … 2π, turned on from the blocks' own (n, blocks) (9.5)."""
    start = azimuth.astype(np.int32)
    gap = np.empty_like(start)
    gap[:, :-1] = (start[:, 1:] - start[:, :-1]) % FULL_CIRCLE
    gap[:, -1] = gap[:, -2]
    odd = gap > MAX_GAP
    if odd.any():
        usual = np.where(odd, 0, gap).sum(axis=1) // np.maximum(1, (~odd).sum(axis=1))
        gap = np.where(odd, usual[:, np.newaxis], gap)
    turn = gap[:, :, np.newaxis] * (head.offset_ns / head.block_ns) + start[:, :, np.newaxis]
    turn -= FULL_CIRCLE * (turn >= FULL_CIRCLE)
    turn *= 2 * np.pi / FULL_CIRCLE
    return turn


def _clock_samples(
    host_time_ns: Int64Array, stamp_us: NDArray[np.uint32], mode: NDArray[np.uint8], head: SpinningHead
) -> StructArray:
    """One `DEVICE_CLOCK_DTYPE` row a packet: device time of its last firing; it has no latch to tell of."""
    blocks = np.where(mode == MODE_DUAL, BLOCKS // 2, BLOCKS)
    last_ns = (blocks - 1) * head.block_ns + int(head.offset_ns.max())
    rows = np.empty(len(stamp_us), dtype=DEVICE_CLOCK_DTYPE)
    rows["host_time_ns"] = host_time_ns
    rows["device_time_ns"] = (stamp_us.astype(np.int64) * 1000 + last_ns) % HOUR_NS
    rows["pps_time_ns"] = rows["pps_count"] = -1
    return rows


def _clock_parser(settings: DeviceSettings) -> VelodyneParser:
    return VelodyneParser(settings, clock_only=True)


DRIVERS = (
    Driver(
        protocol="velodyne-vlp16",
        kind="scanner",
        transports=("udp",),
        yields=(ScannerReturns, DeviceClockSamples, TimeMessage, DeviceStatus),
        summary="Velodyne VLP-16: single and dual return, position packets with NMEA and PPS status",
        make_parser=VelodyneParser,
        make_time_parser=_clock_parser,
        needs=("installation",),
    ),
)
