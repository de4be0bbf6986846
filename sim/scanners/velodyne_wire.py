"""The output of a VLP-16: data packets, single (strongest) or dual return, and position packets.

Position packets carry PPS status and RMC sentences.

Wire format: VLP-16 User Manual 63-9243 rev. D, 9.3. Its clock shows microseconds past the UTC hour while PPS is locked
(`swath.sim.scanners.spinning_wire.HeadClock`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np

from swath.drivers.gnss.nmea.sentences import encode_rmc
from swath.drivers.scanner.velodyne.heads import BLOCKS, PLACES
from swath.drivers.scanner.velodyne.parser import MODE_DUAL, MODE_STRONGEST, encode_data_packet
from swath.drivers.scanner.velodyne.position import HOUR_US, encode_position_packet
from swath.georef.arrays import FloatArray, Int64Array, StructArray
from swath.georef.timescales import SECOND_NS, utc_from_gps
from swath.sim.clocks import PulsePerSecond
from swath.sim.plan.plan import Plan
from swath.sim.plan.tables import ScannerTable
from swath.sim.scanners.spinning_wire import (
    Arrivals,
    HeadClock,
    PacketCutter,
    Windows,
    best_slot,
    counts,
    head_config,
    in_slot,
)
from swath.sim.shots import Measured, Pulses, WireUnit
from swath.sim.truth import RETURN_TRUTH_DTYPE

MICROSECOND_HZ = 1_000_000
RANGE_UNIT_M = 0.002
RANGE_MAX_RAW = 65_535
POSITIONS_HZ = 20
RMC_DELAY_S = 0.15  # delay from an edge to the sentence that names it, at a slow port's speed


class Track(Protocol):
    """The aircraft's motion, for the RMC sentences that a head receives.

    `swath.sim.flight.trajectory.Trajectory` is one.
    """

    def geodetic(self, time_s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return latitude, longitude and height at (n,) times."""

    def velocity_l(self, time_s: FloatArray) -> FloatArray:
        """Return (n, 3) velocities north, east, down."""


class _Sent(NamedTuple):
    """A packet with the true time of its last firing, or of its making."""

    time_s: float
    source: str
    data: bytes


class VelodyneWire:
    """Makes the packets of one head.

    Args:
        plan: of the flight.
        name: of the scanner.
        pps: pulse wired to the head, with the NMEA of its receiver; None: neither is wired.
        track: motion that the receiver's RMC sentences describe.
        lost_pps: (from, to) in which the head gets no pulse.
    """

    def __init__(self, plan: Plan, name: str, pps: PulsePerSecond | None, track: Track, lost_pps: Windows = ()) -> None:
        table = plan.tables.scanner[name]
        self._source, self._dual = f"scanner/{name}", table.dual_return
        _, utc_ns = utc_from_gps(plan.start_gps_ns, plan.leap_seconds)
        self._clock = HeadClock(
            MICROSECOND_HZ,
            table.oscillator,
            pps,
            lost_pps,
            1e-6 * table.true.time_offset_us,
            utc_ns // SECOND_NS % 3600,
        )
        self._groups = BLOCKS // 2 if self._dual else BLOCKS
        self._cutter = PacketCutter(self._groups * PLACES)
        self._arrivals = Arrivals(plan, self._source)
        self._positions = _Positions(plan, f"{self._source}/aux", self._clock, track if pps is not None else None)

    def units(self, pulses: Pulses, measured: Measured, truth: StructArray) -> tuple[list[WireUnit], StructArray]:
        """Return the packets that are complete, in order of time, and the truth of their returns.

        The order of the truth is that of `VelodyneParser`.

        Args:
            pulses: of `Vlp16Head`, consecutive.
            measured: of the pulses, (n, R).
            truth: `RETURN_TRUTH_DTYPE` (n, R), same slots.
        """
        raw, light = counts(measured, RANGE_UNIT_M, RANGE_MAX_RAW)
        positions = self._positions.until(float(pulses.time_s[-1])) if len(pulses) else []
        columns = [pulses.number, pulses.time_s, pulses.encoder, raw, light, truth]
        _, time_s, encoder, raw, light, truth = self._cutter.take(columns)
        if len(time_s) == 0:
            return self._arriving(positions), np.empty(0, RETURN_TRUTH_DTYPE)
        content, rows = (_pairs if self._dual else _strongest)(raw, light, truth)
        return self._arriving(positions + self._packets(time_s, encoder, content)), rows

    def idle(self, start_s: float, stop_s: float) -> list[WireUnit]:
        """Return the position packets, which continue while the laser is off."""
        return self._arriving(self._positions.until(stop_s))

    def close(self) -> tuple[list[WireUnit], StructArray]:
        """Return no packets; a packet that is not full is not sent."""
        return [], np.empty(0, RETURN_TRUTH_DTYPE)

    def _arriving(self, sent: list[_Sent]) -> list[WireUnit]:
        """Return the packets of both ports as the host receives them, in the order of their sending."""
        sent = sorted(sent, key=lambda packet: packet.time_s)
        times_s = self._arrivals.times(np.array([packet.time_s for packet in sent]))
        return [WireUnit(at_s, packet.source, packet.data) for at_s, packet in zip(times_s, sent, strict=True)]

    def _packets(self, time_s: FloatArray, encoder: Int64Array, content: Int64Array) -> list[_Sent]:
        """Return the data packets of pulses (n,), whose content is (returns, n, range and light)."""
        mode, returns = (MODE_DUAL, 2) if self._dual else (MODE_STRONGEST, 1)
        packets = len(time_s) // (self._groups * PLACES)
        # a group's returns are in neighbouring blocks
        blocks = content.reshape(returns, packets, self._groups, PLACES, 2).transpose(1, 2, 0, 3, 4)
        blocks = blocks.reshape(packets, BLOCKS, PLACES, 2)
        azimuth = np.repeat(encoder.reshape(packets, self._groups, PLACES)[:, :, 0], returns, axis=1)
        fired_s = time_s.reshape(packets, -1)
        stamps = (self._clock.ticks(fired_s[:, 0]) % HOUR_US).tolist()
        rows = zip(fired_s[:, -1].tolist(), stamps, azimuth, blocks, strict=True)
        return [
            _Sent(last_s, self._source, encode_data_packet(stamp, angles, block[:, :, 0], block[:, :, 1], mode))
            for last_s, stamp, angles, block in rows
        ]


class _Positions:
    """Makes the position packets of one head."""

    def __init__(self, plan: Plan, source: str, clock: HeadClock, track: Track | None) -> None:
        self._plan, self._source, self._clock, self._track = plan, source, clock, track
        self._count = 0
        self._second, self._sentence = -1, ""

    def until(self, time_s: float) -> list[_Sent]:
        """Return the packets made since the last call and up to this time."""
        last = max(self._count, int(np.floor(time_s * POSITIONS_HZ + 0.5)))
        made_s = (np.arange(self._count, last) + 0.5) / POSITIONS_HZ
        self._count = last
        stamps, status = self._clock.ticks(made_s) % HOUR_US, self._clock.status(made_s)
        rows = zip(made_s.tolist(), stamps.tolist(), status.tolist(), strict=True)
        return [
            _Sent(at_s, self._source, encode_position_packet(stamp, state, self._rmc(at_s)))
            for at_s, stamp, state in rows
        ]

    def _rmc(self, time_s: float) -> str:
        """Return the latest sentence that the head received; empty before the first."""
        second = int(np.floor(time_s - RMC_DELAY_S))
        if self._track is not None and second > self._second:
            self._second, self._sentence = second, self._rmc_of(self._track, second)
        return self._sentence

    def _rmc_of(self, track: Track, second: int) -> str:
        at = np.array([float(second)])
        lat_rad, lon_rad, _ = track.geodetic(at)
        north, east, _ = track.velocity_l(at)[0].tolist()
        gps_ns = self._plan.start_gps_ns + second * SECOND_NS
        date, utc_ns = utc_from_gps(gps_ns, self._plan.leap_seconds)
        speed_mps, course_rad = float(np.hypot(north, east)), float(np.arctan2(east, north))
        sentence = encode_rmc(utc_ns, date, float(lat_rad[0]), float(lon_rad[0]), speed_mps, course_rad, talker="GP")
        return sentence.decode("ascii").strip()


def _strongest(raw: Int64Array, light: Int64Array, truth: StructArray) -> tuple[Int64Array, StructArray]:
    """Return the content (1, n, 2) of single returns (range and reflectivity of the strongest) and their truth."""
    slot = best_slot(np.where(raw > 0, light, -1))
    there = slot >= 0
    rows = truth[there, slot[there]]
    rows["return_number"] = 1
    return _content(raw, light, [slot]), rows


def _pairs(raw: Int64Array, light: Int64Array, truth: StructArray) -> tuple[Int64Array, StructArray]:
    """Return the content (2, n, 2) of dual returns, and their truth, of which the nearer is first.

    The content has the last return first, then the strongest, or the second-strongest where the strongest is the last;
    a single return is in both places. Echoes of equal range are one, as bright as the brightest (9.3.2).
    """
    last = best_slot(np.where(raw > 0, (raw << 8) + light, -1))
    nearer = (raw > 0) & (raw < in_slot(raw, last)[:, np.newaxis])
    other = best_slot(np.where(nearer, light, -1))
    two = other >= 0
    other = np.where(two, other, last)
    pulse = np.arange(len(raw))
    rows = np.stack([truth[pulse, other], truth[pulse, last]], axis=1)
    rows["return_number"][:, 0], rows["return_number"][:, 1] = 1, np.where(two, 2, 1)
    return _content(raw, light, [last, other]), rows[np.stack([two, last >= 0], axis=1)]


def _content(raw: Int64Array, light: Int64Array, slots: Sequence[Int64Array]) -> Int64Array:
    """Return (returns, n, 2) range and reflectivity in these slots (n,)."""
    return np.stack([np.stack([in_slot(raw, slot), in_slot(light, slot)], axis=1) for slot in slots])


def config_table(table: ScannerTable, name: str, transport: str, auxiliary: str) -> dict[str, Any]:
    """Return ``[scanner.<name>]`` of the configuration that records this head.

    Args:
        table: of the plan.
        name: of the scanner.
        transport, auxiliary: URIs at which its data and position packets arrive.
    """
    return head_config(table, transport, "velodyne-vlp16") | {"auxiliary": auxiliary}
