"""Spinning multi-beam heads: emission time, starting point and direction of each beam, in the maker's own frame.

The formulas are the makers': Velodyne, VLP-16 User Manual 63-9243 rev. D, 9.2 (x right at azimuth 90°, y at azimuth 0,
z up); Ouster, Firmware User Manual, "Sensor Data" (the sensor frame). The head's azimuth is CONVENTIONS' scan angle, in
the sense in which its packets count it:

    θ = θ_encoder − scan_angle_offset + encoder_latency · dθ/dt

`Pulses.origin_s` is the point on the beam's axis from which the head counts its ranges: for an Ouster as far behind the
beam's start as that lies off the spin axis. `swath.sim.scanners.ranging` applies the range corrections of ``[[beam]]``.
"""

from __future__ import annotations

import math

import numpy as np

from swath.drivers.scanner.ouster.head import read_head
from swath.drivers.scanner.velodyne.heads import PLACES, VLP16
from swath.georef.arrays import FloatArray, Int64Array
from swath.sim.clocks import Oscillator
from swath.sim.plan.errors import PlanError
from swath.sim.plan.tables import ScannerTable
from swath.sim.scanners.ouster_wire import COLUMNS, os1_metadata
from swath.sim.shots import Pulses

HEAD_HZ = 1_000_000_000  # a head's firings are timed in nanoseconds of its own oscillator
SEQUENCE_NS = 55_296  # from one firing of all sixteen lasers to the next, 9.4
LASER_NS = 2_304  # from laser to laser
LASERS = 16
CENTIDEGREES = 36_000
ENCODER_TICKS = 90_112  # encoder ticks in a turn of an Ouster
VLP16_HZ = (5.0, 20.0)
OS1_HZ = (10.0, 20.0)
ROTATION_TOLERANCE = 1e-6
NOT_OF_HEADS = ("scan_angle_scale_ppm", "scan_plane_tilt_deg", "torsion_us2", "pitch_slope_ppm")


class Vlp16Head:
    """A Velodyne VLP-16, whose lasers fire in groups of two sequences of sixteen.

    The azimuth of a group's first firing goes into the packet.

    Pulse k is laser k mod 16 of sequence k // 16; sequences follow each other by the head's oscillator, which also
    turns it.

    Args:
        table: of the plan.
        name: of the scanner.

    Raises:
        PlanError: the plan asks for turns or errors that such a head does not have.
    """

    def __init__(self, table: ScannerTable, name: str) -> None:
        if not VLP16_HZ[0] <= table.scan_hz <= VLP16_HZ[1]:
            raise PlanError(f"scanner.{name}.scan_hz", f"got {table.scan_hz:g}, want 5 to 20 turns a second of a vlp16")
        azimuth_rad, elevation_rad = _checked(table, name, LASERS)
        self._oscillator = Oscillator(HEAD_HZ, table.oscillator)
        self._turns_per_ns = table.scan_hz / HEAD_HZ
        self._ahead_rad = _ahead_rad(table)
        self._elevation_rad = np.radians(VLP16.beams.elevation_deg) + elevation_rad
        self._azimuth_rad = np.radians(VLP16.beams.azimuth_deg) + azimuth_rad
        self._up_m = VLP16.beams.up_m

    def pulses(self, start_s: float, stop_s: float) -> Pulses:
        """Return every pulse with start_s <= time_s < stop_s, in order of firing, as in the packets."""
        number = _numbers(self._oscillator, SEQUENCE_NS, LASERS, start_s, stop_s)
        sequence, laser = np.divmod(number, LASERS)
        sequences = np.unique(sequence)
        began_s = self._oscillator.time_of(SEQUENCE_NS * sequences.astype(np.float64))
        time_s = began_s[sequence - sequences[0]] + 1e-9 * LASER_NS * laser if len(number) else np.zeros(0)
        there = (time_s >= start_s) & (time_s < stop_s)
        number, time_s, laser = number[there], time_s[there], laser[there]
        group_ns = (2 * SEQUENCE_NS) * (number // PLACES)
        fired_ns = SEQUENCE_NS * (number // LASERS) + LASER_NS * laser
        origin = np.zeros((len(number), 3))
        origin[:, 2] = self._up_m[laser]
        return Pulses(
            number=number,
            time_s=time_s,
            encoder=np.rint(CENTIDEGREES * self._turn(group_ns)).astype(np.int64) % CENTIDEGREES,
            channel=laser.astype(np.uint16),
            origin_s=origin,
            direction_s=self._directions(fired_ns, laser),
            phi_extra_rad=np.zeros(len(number)),
        )

    def _turn(self, head_ns: Int64Array) -> FloatArray:
        """Return the encoder's position, turns 0 … 1, at times of the head's oscillator."""
        turned: FloatArray = np.mod(self._turns_per_ns * head_ns, 1.0)
        return turned

    def _directions(self, fired_ns: Int64Array, laser: Int64Array) -> FloatArray:
        """Return (n, 3) directions x = cos ω sin α, y = cos ω cos α, z = sin ω (VLP-16 manual, 9.2)."""
        azimuth = 2 * np.pi * self._turn(fired_ns) + self._ahead_rad + self._azimuth_rad[laser]
        flat = np.cos(self._elevation_rad)[laser]
        up = np.sin(self._elevation_rad)[laser]
        return np.stack([flat * np.sin(azimuth), flat * np.cos(azimuth), up], axis=1)


class Os1Head:
    """An Ouster OS1 with 64 beams and 1024 columns a turn; all beams of a column fire at its encoder angle, at once.

    Pulse k is beam k mod 64 of column k // 64; the head's oscillator turns it.

    Args:
        table: of the plan.
        name: of the scanner.

    Raises:
        PlanError: the plan asks for turns or errors that such a head does not have.
    """

    def __init__(self, table: ScannerTable, name: str) -> None:
        if table.scan_hz not in OS1_HZ:
            raise PlanError(f"scanner.{name}.scan_hz", f"got {table.scan_hz:g}, want 10 or 20 turns a second of an os1")
        self._head = read_head(os1_metadata(table))
        azimuth_rad, elevation_rad = _checked(table, name, self._head.beams)
        self._oscillator = Oscillator(HEAD_HZ, table.oscillator)
        self._column_ns = HEAD_HZ / (table.scan_hz * COLUMNS)
        self._ahead_rad = _ahead_rad(table, turning=-1.0)
        self._altitude_rad = self._head.altitude_rad + elevation_rad
        self._azimuth_rad = self._head.azimuth_rad + azimuth_rad

    def pulses(self, start_s: float, stop_s: float) -> Pulses:
        """Return every pulse with start_s <= time_s < stop_s, columns in order, beams from the top row down."""
        beams = self._head.beams
        column = _numbers(self._oscillator, self._column_ns, 1, start_s, stop_s)
        time_s = self._oscillator.time_of(self._column_ns * column.astype(np.float64))
        there = (time_s >= start_s) & (time_s < stop_s)
        column, time_s = column[there], time_s[there]
        place = column % COLUMNS
        origin, direction = self._beams(2 * np.pi * (1.0 - place / COLUMNS) + self._ahead_rad)
        return Pulses(
            number=(column[:, np.newaxis] * beams + np.arange(beams)).reshape(-1),
            time_s=np.repeat(time_s, beams),
            encoder=np.repeat(place * (ENCODER_TICKS // COLUMNS), beams),
            channel=np.tile(np.arange(beams, dtype=np.uint16), len(column)),
            origin_s=origin,
            direction_s=direction,
            phi_extra_rad=np.zeros(len(column) * beams),
        )

    def _beams(self, encoder_rad: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return origins and directions (columns · beams, 3) in the sensor frame ("Lidar Range to XYZ")."""
        heading = encoder_rad[:, np.newaxis] - self._azimuth_rad
        flat, up = np.cos(self._altitude_rad), np.sin(self._altitude_rad)
        direction = np.stack([flat * np.cos(heading), flat * np.sin(heading), np.broadcast_to(up, heading.shape)], 2)
        off_axis_m, above_m = self._head.beam_origin_m
        start = np.zeros((len(encoder_rad), 1, 3))
        start[:, 0, 0], start[:, 0, 1] = off_axis_m * np.cos(encoder_rad), off_axis_m * np.sin(encoder_rad)
        start[:, 0, 2] = above_m
        origin = start - math.hypot(off_axis_m, above_m) * direction
        rotation, shift = self._head.sensor_from_lidar[:3, :3], self._head.sensor_from_lidar[:3, 3]
        return origin.reshape(-1, 3) @ rotation.T + shift, direction.reshape(-1, 3) @ rotation.T


def _numbers(oscillator: Oscillator, spacing_ns: float, each: int, start_s: float, stop_s: float) -> Int64Array:
    """Return the numbers of all pulses that may leave in this time; ``each`` pulses leave together, a spacing apart."""
    first, last = np.floor(oscillator.phase(np.array([start_s, stop_s])) / spacing_ns).astype(np.int64)
    return np.arange(max(first - 1, 0) * each, max(last + 2, 0) * each)


def _ahead_rad(table: ScannerTable, turning: float = 1.0) -> float:
    """Return the true azimuth minus the encoder's reading.

    Args:
        table: of the plan.
        turning: 1 for a head whose azimuth grows as it turns, −1 if it falls.
    """
    rate_rps = turning * 2 * np.pi * table.scan_hz
    return float(1e-6 * table.true.encoder_latency_us * rate_rps - np.radians(table.true.scan_angle_offset_deg))


def _checked(table: ScannerTable, name: str, beams: int) -> tuple[FloatArray, FloatArray]:
    """Return the amounts that ``[[beam]]`` adds to azimuths and elevations, (beams,) each.

    Errors that a spinning head cannot have are refused with `PlanError`.
    """
    for key in NOT_OF_HEADS:
        if getattr(table.true, key) != 0.0:
            text = f"got {getattr(table.true, key):g}, want 0: a head that turns full circles has no such error"
            raise PlanError(f"scanner.{name}.true.{key}", text)
    matrix = np.array(table.installation)
    if np.abs(matrix @ matrix.T - np.eye(3)).max() > ROTATION_TOLERANCE or np.linalg.det(matrix) < 0.0:
        text = "is no rotation; want perpendicular rows of length 1, right-handed: b from the maker's axes"
        raise PlanError(f"scanner.{name}.installation", text)
    azimuth_deg, elevation_deg = np.zeros((2, beams))
    for number, beam in enumerate(table.beam):
        if beam.channel >= beams:
            key = f"scanner.{name}.beam[{number}].channel"
            raise PlanError(key, f"got {beam.channel}, want 0 to {beams - 1} of this head's beams")
        azimuth_deg[beam.channel] += beam.azimuth_deg
        elevation_deg[beam.channel] += beam.elevation_deg
    return np.radians(azimuth_deg), np.radians(elevation_deg)
