"""RoboSense spinning heads: data packets (MSOP) and device information packets (DIFOP).

Wire format: the maker's SDK rs_driver (`swath.drivers.scanner.robosense.heads`). Device time is nanoseconds since 1970
of the time in the packets, without leap seconds; the packet's time is that of its first firing.

Azimuths of blocks are extrapolated to each firing with the rotation to the next block, as in the SDK. A head that fires
in a part of the circle only jumps over the rest between two blocks; the time of that jump follows from its angle.
"""

from __future__ import annotations

import datetime as dt
from collections.abc import Callable
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from swath.drivers.driver import Driver, SentFile
from swath.drivers.parser import DeviceSettings, PacketParser, Parser
from swath.drivers.scanner.beams import BeamTable
from swath.drivers.scanner.robosense.heads import (
    BLOCK_ID,
    BLOCKS,
    BPEARL,
    BPEARL_V4,
    DIFOP_DTYPE,
    DIFOP_ID,
    FILE,
    HELIOS16P,
    HELIOS32,
    MODE_DUAL,
    MSOP_DTYPE,
    OLD_ID,
    PACKET_BYTES,
    PLACES,
    RS16,
    RS32,
    UTC_DTYPE,
    YMD_DTYPE,
    RobosenseHead,
    read_angles,
)
from swath.drivers.scanner.rows.filler import filler
from swath.drivers.scanner.rows.slots import Chosen
from swath.drivers.scanner.sequence import SampleThinner
from swath.drivers.scanner.spinning import Firings, returns_of_packets
from swath.georef.arrays import BoolArray, FloatArray, Int64Array, StructArray
from swath.georef.records import (
    DEVICE_CLOCK_DTYPE,
    RETURN_FLAG_LAST,
    RETURN_FLAG_STRONGEST,
    ByteRows,
    DeviceClockSamples,
    DeviceStatus,
    Record,
    ScannerReturns,
)

NS = 1_000_000_000
FULL_CIRCLE = 36_000  # azimuth in 0.01°
MAX_GAP = 100  # a larger turn between two blocks leads over a part of the circle where the head does not fire
USUAL_REV_PER_S = 10
SAME_ANGLE_DEG = 0.011
_DIFOP_START, _OLD_START = (np.frombuffer(start, dtype=np.uint8) for start in (DIFOP_ID, OLD_ID))


def encode_msop(
    time: dt.datetime, azimuth_0p01deg: ArrayLike, range_raw: ArrayLike, reflectivity: ArrayLike, head: RobosenseHead
) -> bytes:
    """Encode one data packet.

    Args:
        time: time of the first firing, UTC.
        azimuth_0p01deg: (12,) azimuths of the blocks.
        range_raw: (12, 32) in the head's unit, 0 = no return.
        reflectivity: (12, 32) or one value for all.
        head: the model.
    """
    packet = np.zeros(1, dtype=MSOP_DTYPE)
    whole = int(time.replace(microsecond=0).timestamp())
    if head.counts_seconds:
        stamp = np.array([(0, whole, time.microsecond)], dtype=UTC_DTYPE)
    else:
        ms, us = divmod(time.microsecond, 1000)
        fields = (time.year - 2000, time.month, time.day, time.hour, time.minute, time.second, ms, us)
        stamp = np.array([fields], dtype=YMD_DTYPE)
    packet["stamp"] = np.void(stamp.tobytes())
    packet["id"] = np.void(head.identity.ljust(8, b"\0"))
    packet["type"], packet["model"] = (3, 4) if head.is_v4 else (0, 0)
    packet["blocks"]["id"], packet["blocks"]["azimuth"] = BLOCK_ID, azimuth_0p01deg
    packet["blocks"]["returns"]["range"], packet["blocks"]["returns"]["reflectivity"] = range_raw, reflectivity
    return packet.tobytes()


def encode_difop(
    head: RobosenseHead, elevation_deg: ArrayLike, azimuth_deg: ArrayLike = 0.0, *, mode: int = 1, rpm: int = 600
) -> bytes:
    """Encode one device information packet with the angles of the lasers (lasers,) and a return mode."""
    packet = np.zeros(1, dtype=DIFOP_DTYPE)
    packet["id"], packet["rpm"], packet["mode"] = np.void(DIFOP_ID), rpm, mode
    if head.lasers == 16 and head.identity == OLD_ID:
        pitch = np.rint(np.abs(np.asarray(elevation_deg)) / 1e-4).astype(np.int64)
        packet["pitch"][0] = pitch[:, np.newaxis] >> np.array([16, 8, 0]) & 0xFF
    else:
        for name, angles in (("elevation", elevation_deg), ("azimuth", azimuth_deg)):
            degrees = np.broadcast_to(np.asarray(angles, dtype=np.float64), (head.lasers,))
            packet[name]["negative"][0, : head.lasers] = degrees < 0
            packet[name]["value"][0, : head.lasers] = np.rint(np.abs(degrees) / head.angle_unit_deg)
    return packet.tobytes()


class RobosenseParser(PacketParser):
    """Decodes data and device information packets of one head, distinguished by their first bytes.

    Counts ``bad_length``, ``bad_header``, ``wrong_product`` (another model answers), ``bad_block``, ``bad_azimuth``,
    ``bad_time``, ``angles_differ`` (a device information packet states other angles than those in use), ``no_angles``,
    and, without a file, ``before_difop`` (data packets before the first device information packet with angles).

    Args:
        settings: file ``geometry`` is a DIFOP packet or a table of angles; without it, the first DIFOP packet counts.
        head: the model.
        clock_only: return no returns, and clock samples of one data packet in 50 ms of host time.

    Attributes:
        beams: the head's beams; None until they are known. Returns do not depend on them.

    Raises:
        DriverSettingsError: the file is unusable.
    """

    def __init__(self, settings: DeviceSettings, head: RobosenseHead, *, clock_only: bool = False) -> None:
        super().__init__()
        self._head, self._source = head, settings.source
        self._angles: tuple[FloatArray, FloatArray] | None = None
        self._mode = -1
        if "geometry" in settings.files:
            *angles, self._mode = read_angles(settings.files["geometry"], head)
            self._angles = angles[0], angles[1]
        self._thinner = SampleThinner() if clock_only else None
        self._fill = filler(compiled=settings.compiled and not clock_only)
        self._packets = 0
        self._status: tuple[int, int] | None = None

    def parse_units(self, host_time_ns: Int64Array, units: ByteRows) -> list[Record]:
        """Decode packets of equal length; see `PacketParser.parse_units`."""
        self.counters.bytes += units.size
        if units.shape[1] != PACKET_BYTES:
            self.counters.count_bad("bad_length", len(units))
            self.counters.bytes_skipped += units.size
            return []
        difop = (units[:, : len(_DIFOP_START)] == _DIFOP_START).all(axis=1)
        if not difop.any():
            return self._data(host_time_ns, units)
        records: list[Record] = []
        ends = [0, *(np.flatnonzero(np.diff(difop)) + 1).tolist(), len(units)]
        for start, stop in pairwise(ends):
            read = self._information if difop[start] else self._data
            records += read(host_time_ns[start:stop], units[start:stop])
        return records

    @property
    def beams(self) -> BeamTable | None:
        """The head's beams; None until they are known."""
        return None if self._angles is None else self._head.beams(*self._angles)

    def remarks(self) -> list[str]:
        """Return what to do where the head states other angles than those in use."""
        if not self.counters.errors["angles_differ"]:
            return []
        return [
            f"{self._source}: its DIFOP packets state other angles than {FILE}, or without it than the first of them; "
            "give one of them as the file"
        ]

    @property
    def warnings(self) -> tuple[str, ...]:
        """A line if the angles of the beams are unknown."""
        if self._angles is not None or not self.counters.messages["data"]:
            return ()
        return (f"no DIFOP packet (port 7788) stated the angles of its beams; set auxiliary, or give {FILE}",)

    def _information(self, host_time_ns: Int64Array, units: ByteRows) -> list[Record]:
        packets = units.view(DIFOP_DTYPE)[:, 0]
        self.counters.messages["difop"] += len(units)
        self.counters.bytes_framed += units.size
        records: list[Record] = []
        for host_ns, packet in zip(host_time_ns.tolist(), packets, strict=True):
            angles = self._head.angles(packet)
            if angles is None:
                self.counters.errors["no_angles"] += 1
            elif self._angles is None:
                self._angles = angles
            elif not all(map(self._is_same, angles, self._angles)):
                self.counters.errors["angles_differ"] += 1
            self._mode = int(packet["mode"])
            status = (self._mode, int(packet["rpm"]))
            if status != self._status:
                self._status = status
                records.append(
                    DeviceStatus(host_ns, {"return_mode": status[0], "motor_rpm": status[1]}, message="difop")
                )
        return records

    def _is_same(self, angles: FloatArray, ours: FloatArray) -> bool:
        return bool((np.abs(angles - ours) < SAME_ANGLE_DEG).all())

    def _data(self, host_time_ns: Int64Array, units: ByteRows) -> list[Record]:
        packets = units.view(MSOP_DTYPE)[:, 0]
        stamp_ns, times_good = self._stamps(packets)
        good = self._check(units, packets, times_good)
        self.counters.messages["data"] += int(good.sum())
        self.counters.bytes_framed += int(good.sum()) * PACKET_BYTES
        self.counters.bytes_skipped += int((~good).sum()) * PACKET_BYTES
        if not good.any():
            return []
        if self._angles is None:
            self.counters.errors["before_difop"] += int(good.sum())
        host_time_ns, packets, stamp_ns = host_time_ns[good], packets[good], stamp_ns[good]
        chosen = slice(None) if self._thinner is None else self._thinner.choose(host_time_ns)
        dual = self._duals(packets)
        clock = self._clock_samples(host_time_ns[chosen], stamp_ns[chosen], dual[chosen])
        records: list[Record] = [DeviceClockSamples(clock)] if len(clock) else []
        if self._thinner is None:
            number = self._packets + np.arange(len(packets), dtype=np.int64)
            rows = returns_of_packets(
                dual,
                BLOCKS * PLACES,
                lambda part: self._firings(host_time_ns[part], packets[part], stamp_ns[part], number[part]),
                self._fill,
            )
            if len(rows):
                records.append(ScannerReturns(rows))
        self._packets += len(packets)
        return records

    def _check(self, units: ByteRows, packets: StructArray, times_good: BoolArray) -> BoolArray:
        """Return (n,) True for packets of this model that can be decoded; the others are counted by error."""
        head = self._head
        identity = np.frombuffer(head.identity, dtype=np.uint8)
        starts = (units[:, : len(identity)] == identity).all(axis=1)
        known = starts | (units[:, :3] == _OLD_START[:3]).all(axis=1)
        is_v4 = (packets["type"] == 3) & (packets["model"] == 4)
        good = np.ones(len(packets), dtype=np.bool_)
        for code, passes in (
            ("bad_header", known),
            ("wrong_product", starts & ((is_v4 == head.is_v4) | (head.identity != OLD_ID))),
            ("bad_block", (packets["blocks"]["id"] == BLOCK_ID).all(axis=1)),
            ("bad_azimuth", (packets["blocks"]["azimuth"] < FULL_CIRCLE).all(axis=1)),
            ("bad_time", times_good),
        ):
            self.counters.count_bad(code, int((good & ~passes).sum()))
            good &= passes
        return good

    def _stamps(self, packets: StructArray) -> tuple[Int64Array, BoolArray]:
        """Return (n,) times in nanoseconds since 1970, and whether they are possible."""
        raw = packets["stamp"].copy()
        if self._head.counts_seconds:
            utc = raw.view(UTC_DTYPE)
            seconds, us = utc["seconds"].astype(np.int64), utc["us"].astype(np.int64)
            return seconds * NS + us * 1000, (utc["high"] == 0) & (us < 1_000_000)
        ymd = raw.view(YMD_DTYPE)
        good = (ymd["month"] >= 1) & (ymd["month"] <= 12) & (ymd["day"] >= 1) & (ymd["day"] <= 31)
        good &= (
            (ymd["hour"] < 24) & (ymd["minute"] < 60) & (ymd["second"] <= 60) & (ymd["ms"] < 1000) & (ymd["us"] < 1000)
        )
        month = (ymd["year"].astype(np.int64) + 30).astype("M8[Y]").astype("M8[M]") + (
            ymd["month"].astype(np.int64) - 1
        )
        days = (month.astype("M8[D]") + (ymd["day"].astype(np.int64) - 1)).astype(np.int64)
        of_day = (ymd["hour"].astype(np.int64) * 60 + ymd["minute"]) * 60 + ymd["second"]
        us = ymd["ms"].astype(np.int64) * 1000 + ymd["us"]
        return (days * 86_400 + of_day) * NS + us * 1000, good

    def _duals(self, packets: StructArray) -> Int64Array:
        """Return (n,) 1 for packets in dual return, else 0.

        A packet of 32 lasers shows it by the equal azimuths of its pairs of blocks; of 16 lasers only the device
        information packets tell.
        """
        if self._head.lasers == 16:
            return np.full(len(packets), int(self._mode == MODE_DUAL), dtype=np.int64)
        azimuth = packets["blocks"]["azimuth"]
        duals: Int64Array = (azimuth[:, 0::2] == azimuth[:, 1::2]).all(axis=1).astype(np.int64)
        return duals

    def _round(self, dual: bool) -> tuple[int, int, Int64Array]:
        """Return blocks of a round's packet, time from round to round, and firing times of its places."""
        head = self._head
        if head.lasers == PLACES:
            return (2 if dual else 1), head.round_ns, head.offset_ns
        if dual:
            return 1, head.round_ns, head.offset_ns
        return 1, 2 * head.round_ns, self._twice()

    def _twice(self) -> Int64Array:
        """Return firing times of two rounds of 16 lasers in a block.

        The second round begins with the time of a round, in a Helios 16P with its sixteenth step.
        """
        head = self._head
        second_ns = head.round_ns if head.identity == OLD_ID else PLACES // 2 * int(head.offset_ns[1])
        return np.concatenate([head.offset_ns, head.offset_ns + second_ns])

    def _firings(
        self, host_time_ns: Int64Array, packets: StructArray, stamp_ns: Int64Array, number: Int64Array
    ) -> Firings:
        """Return the firings of packets of one return mode."""
        head, dual = self._head, bool(self._duals(packets[:1])[0])
        step, round_ns, offset_ns = self._round(dual)
        azimuth = packets["blocks"]["azimuth"][:, ::step].astype(np.float64)
        returns = packets["blocks"]["returns"]
        if dual and head.lasers == 16:  # first and second returns lie in the halves of a block
            returns = np.ascontiguousarray(returns).reshape(len(packets), 2 * BLOCKS, 16)
        gap = _gaps(azimuth, round_ns)
        starts_ns = (stamp_ns[:, np.newaxis] + _times_of_rounds(azimuth, gap, round_ns)).reshape(-1, 1)
        flags = {head.strongest_mode: RETURN_FLAG_STRONGEST, head.last_mode: RETURN_FLAG_LAST}.get(self._mode, 0)
        return Firings(
            returns=returns,
            range_unit_m=head.range_unit_m,
            host_time_ns=host_time_ns,
            number=number,
            most=BLOCKS * PLACES,
            device_time_ns=lambda at: at(starts_ns) + at(offset_ns[np.newaxis]),
            azimuth_rad=_azimuths(azimuth, gap, offset_ns / round_ns),
            channel=(np.arange(len(offset_ns)) % head.lasers).astype(np.uint16),
            flags=0 if dual else flags,
            echoes=2 if dual else 1,
            names=(True, True),
        )

    def _last_ns(self, *, dual: bool) -> int:
        step, round_ns, offset_ns = self._round(dual)
        return (BLOCKS // step - 1) * round_ns + int(offset_ns.max())

    def _clock_samples(self, host_time_ns: Int64Array, stamp_ns: Int64Array, dual: Int64Array) -> StructArray:
        """Return one `DEVICE_CLOCK_DTYPE` row a packet: device time near its last firing; it has no latched edge."""
        last_ns = np.array([self._last_ns(dual=False), self._last_ns(dual=True)])
        rows = np.empty(len(stamp_ns), dtype=DEVICE_CLOCK_DTYPE)
        rows["host_time_ns"] = host_time_ns
        rows["device_time_ns"] = stamp_ns + last_ns[dual]
        rows["pps_time_ns"] = rows["pps_count"] = rows["locked"] = -1
        return rows


def _gaps(azimuth: FloatArray, round_ns: int) -> FloatArray:
    """Return the turn (n, rounds) from each round to the next, in 0.01°; jumps and the last round get the usual one."""
    gap = np.empty(azimuth.shape)
    gap[:, :-1] = (azimuth[:, 1:] - azimuth[:, :-1]) % FULL_CIRCLE
    gap[:, -1] = MAX_GAP + 1
    odd = gap > MAX_GAP
    count = (~odd).sum(axis=1)
    nominal = FULL_CIRCLE * USUAL_REV_PER_S * round_ns / NS
    usual = np.where(count > 0, np.where(odd, 0, gap).sum(axis=1) / np.maximum(count, 1), nominal)
    turns: FloatArray = np.where(odd, usual[:, np.newaxis], gap)
    return turns


def _times_of_rounds(azimuth: FloatArray, gap: FloatArray, round_ns: int) -> Int64Array:
    """Return times (n, rounds) after the first round; a jump takes as long as the head needs for its angle."""
    turn = (azimuth[:, 1:] - azimuth[:, :-1]) % FULL_CIRCLE
    steps = np.where(turn > MAX_GAP, turn / np.maximum(gap[:, :-1], 1), 1.0)
    times = np.zeros(azimuth.shape)
    times[:, 1:] = np.cumsum(steps, axis=1) * round_ns
    whole: Int64Array = np.rint(times).astype(np.int64)
    return whole


def _azimuths(azimuth: FloatArray, gap: FloatArray, passed: FloatArray) -> Callable[[Chosen], FloatArray]:
    """Return a function for azimuths of firings, radians, 0 … 2π, from those of rounds (n, rounds) and the part
    (places,) of a round that has passed.
    """
    start, turn, part = azimuth.reshape(-1, 1), gap.reshape(-1, 1), passed[np.newaxis]

    def made_of(at: Chosen) -> FloatArray:
        firing = at(turn) * at(part)
        firing += at(start)
        firing -= (firing >= FULL_CIRCLE) * np.float64(FULL_CIRCLE)
        firing *= 2 * np.pi / FULL_CIRCLE
        return firing

    return made_of


def _maker(head: RobosenseHead, *, clock_only: bool = False) -> Callable[[DeviceSettings], Parser]:
    return lambda settings: RobosenseParser(settings, head, clock_only=clock_only)


def _finder(head: RobosenseHead) -> Callable[[ByteRows], bytes | None]:
    """Return a function for the first device information packet with angles of a head among units."""

    def find(units: ByteRows) -> bytes | None:
        if units.shape[1] != PACKET_BYTES:
            return None
        for row in np.flatnonzero((units[:, : len(_DIFOP_START)] == _DIFOP_START).all(axis=1)).tolist():
            unit: bytes = units[row].tobytes()
            if head.angles(np.frombuffer(unit, dtype=DIFOP_DTYPE)[0]) is not None:
                return unit
        return None

    return find


def _driver(protocol: str, head: RobosenseHead) -> Driver:
    return Driver(
        protocol=protocol,
        kind="scanner",
        transports=("udp",),
        yields=(ScannerReturns, DeviceClockSamples, DeviceStatus),
        summary=f"RoboSense {head.name}: single and dual return, angles of its DIFOP packets",
        make_parser=_maker(head),
        make_time_parser=_maker(head, clock_only=True),
        tells_pps=False,
        needs=("installation",),
        wavelength_nm=905.0,
        eight_bit_intensity=True,
        bytes_per_s=head.bytes_per_s,
        sent_file=SentFile(
            "DIFOP packet", _finder(head), lambda: encode_difop(head, np.linspace(-15, 15, head.lasers))
        ),
    )


DRIVERS = (
    _driver("robosense-rs16", RS16),
    _driver("robosense-rs32", RS32),
    _driver("robosense-helios32", HELIOS32),
    _driver("robosense-helios16p", HELIOS16P),
    _driver("robosense-bpearl", BPEARL),
    _driver("robosense-bpearl-v4", BPEARL_V4),
)
