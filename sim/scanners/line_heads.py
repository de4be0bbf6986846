"""Line scanners: emission times of pulses, directions of the light, and readings of the encoder.

The light follows the mirrors (`swath.sim.scanners.mirrors`), the mirrors their motion (`swath.sim.scanners.motions`).
The encoder's reading is the one that fulfils CONVENTIONS' equation with the plan's true parameters:

    θ = (1 + scan_angle_scale) · (θ_encoder − scan_angle_offset) + encoder_latency · dθ/dt + torsion · d²θ/dt²

dθ/dt and d²θ/dt² are the beam's own here. Derivatives taken from readings instead are wrong by the errors' own
derivatives, of second order: latency² · d²θ/dt² (1 µs, 40 Hz, ±30°: 3e-8 rad) and torsion² · d⁴θ/dt⁴ (2e-9 s²: 1e-8
rad), less than a count.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np

from swath.georef.arrays import FloatArray, Int64Array
from swath.sim.clocks import Oscillator
from swath.sim.plan.errors import PlanError
from swath.sim.plan.tables import ScannerTable
from swath.sim.scanners import mirrors, motions
from swath.sim.scanners.motions import Motion, Swing
from swath.sim.shots import Pulses

TICKS_PER_PULSE = 2  # with fewer, rounding to ticks would double or halve the time between two pulses
LARGEST_ERROR_DEG = 10.0
LARGEST_SCALE_PPM = 100_000.0
READING_COUNTS = 1.6 * 2**31  # share of the 2³² counts of a 32-bit reading; the rest is for errors
SHAFT_ANGLE_DEG = 45.0  # nutating: between the mirror's shaft and the laser's beam

Direction = Callable[[Swing], FloatArray]


@dataclass(frozen=True, slots=True)
class Deflection:
    """Deflection of the beam in one kind of line scanner.

    Attributes:
        motion: motion of its mirror or prisms.
        direction: function that gives (n, 3) unit vectors in s for a position of the deflector.
        shaft_factor: beam angle per shaft angle.
        half_angle_rad: pulses beyond this angle leave no light; inf: all pulses do.
    """

    motion: Motion
    direction: Direction
    shaft_factor: float
    half_angle_rad: float


class LineHead:
    """A scanner of kind oscillating, polygon, monogon, nutating or risley.

    Pulse k leaves at tick round(k · tick_hz / prf_hz) of the device's counter, counted from the plan's start. A pulse's
    true time is that of its tick plus the true ``time_offset``, because the stamps are early by that offset.

    Args:
        table: of the plan.
        name: of the scanner.

    Raises:
        PlanError: such a scanner is impossible.
    """

    def __init__(self, table: ScannerTable, name: str) -> None:
        self._table, true = table, table.true
        if table.prf_hz * TICKS_PER_PULSE > table.tick_hz:
            most = table.tick_hz / TICKS_PER_PULSE
            raise PlanError(f"scanner.{name}.prf_hz", f"got {table.prf_hz:g}, want at most {most:g}: tick_hz / 2")
        self._oscillator = Oscillator(table.tick_hz, table.oscillator)
        self._time_offset_s = 1e-6 * true.time_offset_us
        self._latency_s, self._torsion_s2 = 1e-6 * true.encoder_latency_us, 1e-12 * true.torsion_us2
        self._scale, self._offset_rad = 1.0 + 1e-6 * true.scan_angle_scale_ppm, math.radians(true.scan_angle_offset_deg)
        if abs(true.scan_angle_scale_ppm) > LARGEST_SCALE_PPM:
            text = f"got {true.scan_angle_scale_ppm:g}, want {-LARGEST_SCALE_PPM:g} to {LARGEST_SCALE_PPM:g}"
            raise PlanError(f"scanner.{name}.true.scan_angle_scale_ppm", text)
        self._deflection = _DEFLECTIONS[table.kind](table, name)
        self._check_errors(f"scanner.{name}")

    def pulses(self, start_s: float, stop_s: float) -> Pulses:
        """Return every pulse with start_s <= time_s < stop_s."""
        number, time_s = self._fired(start_s, stop_s)
        swing = self._deflection.motion(time_s)
        lit = np.abs(swing.angle_rad) <= self._deflection.half_angle_rad
        if not lit.all():
            number, time_s, swing = number[lit], time_s[lit], swing.chosen(lit)
        return Pulses(
            number=number,
            time_s=time_s,
            encoder=self._encoder(swing),
            channel=swing.facet,
            origin_s=np.zeros((len(number), 3)),
            direction_s=self._deflection.direction(swing),
            phi_extra_rad=1e-6 * self._table.true.pitch_slope_ppm * swing.angle_rad,
        )

    def _fired(self, start_s: float, stop_s: float) -> tuple[Int64Array, FloatArray]:
        """Return numbers and times of the pulses in this time, including those that leave no light."""
        edges = self._oscillator.phase(np.array([start_s, stop_s]) - self._time_offset_s)
        first, last = np.floor(edges * (self._table.prf_hz / self._table.tick_hz)).astype(np.int64)
        number = np.arange(max(first - 1, 0), max(last + 3, 0))
        time_s = self._oscillator.time_of(emission_ticks(self._table, number).astype(np.float64)) + self._time_offset_s
        there = (time_s >= start_s) & (time_s < stop_s)
        return number[there], time_s[there]

    def _encoder(self, swing: Swing) -> Int64Array:
        """Return (n,) readings: whole counts, signed, 0 at the encoder's index."""
        return np.rint(self._shaft_rad(swing) * (self._table.encoder_counts / (2 * np.pi))).astype(np.int64)

    def _shaft_rad(self, swing: Swing) -> FloatArray:
        """Return (n,) readings before rounding: CONVENTIONS' equation solved for θ_encoder, on the shaft."""
        beam = swing.angle_rad - self._latency_s * swing.rate_rps - self._torsion_s2 * swing.acceleration_rps2
        shaft: FloatArray = swing.centre_rad + (beam / self._scale + self._offset_rad) / self._deflection.shaft_factor
        return shaft

    def _check_errors(self, key: str) -> None:
        swing = self._deflection.motion(np.linspace(0.0, 1.0 / self._table.scan_hz, 4097))
        for parameter, turned_rad in (
            ("scan_angle_offset_deg", self._offset_rad),
            ("encoder_latency_us", self._latency_s * float(np.abs(swing.rate_rps).max())),
            ("torsion_us2", self._torsion_s2 * float(np.abs(swing.acceleration_rps2).max())),
        ):
            turned_deg = abs(math.degrees(turned_rad))
            if turned_deg > LARGEST_ERROR_DEG:
                text = f"turns the beam by {turned_deg:.4g}°, want at most {LARGEST_ERROR_DEG:g}°"
                raise PlanError(f"{key}.true.{parameter}", text)
        if self._table.kind == "polygon":
            self._check_facet(key, swing)

    def _check_facet(self, key: str, swing: Swing) -> None:
        """Refuse a scan with readings beyond their facet, which would count as readings of the next one."""
        ends = np.array([-1.0, 1.0]) * self._deflection.half_angle_rad
        nothing = np.zeros(2)
        shaft = self._shaft_rad(Swing(ends, swing.rate_rps[:2], nothing, nothing, np.zeros(2, np.uint16)))
        most = math.pi / self._table.facets - 2 * math.pi / self._table.encoder_counts
        excess_deg = math.degrees(2.0 * (float(np.abs(shaft).max()) - most))
        if excess_deg > 0.0:
            half_deg = self._table.half_angle_deg
            limit = f"want at most {half_deg - excess_deg - 5e-4:.3f}"
            text = f"got {half_deg:g}, {limit}: {self._table.facets} facets of ±{360 / self._table.facets:g}° each"
            raise PlanError(f"{key}.half_angle_deg", text)


def emission_ticks(table: ScannerTable, number: Int64Array) -> Int64Array:
    """Return (n,) ticks from the plan's start at which the pulses with these numbers (n,) leave."""
    return np.rint(number * table.tick_hz / table.prf_hz).astype(np.int64)


def config_geometry(table: ScannerTable) -> dict[str, Any]:
    """Return ``[scanner.<name>.geometry]`` of the configuration for a line scanner."""
    geometry: dict[str, Any] = {"type": table.kind}
    if table.kind == "polygon":
        geometry["facets"] = table.facets
    elif table.kind == "nutating":
        geometry |= {"nutation_deg": table.nutation_deg, "shaft_angle_deg": SHAFT_ANGLE_DEG}
    elif table.kind == "risley":
        geometry |= {name: getattr(table, name) for name in ("wedge_deg", "refractive_index", "prism_ratio")}
    return geometry


def _oscillating(table: ScannerTable, name: str) -> Deflection:
    half_angle = math.radians(table.half_angle_deg)
    plane_tilt = math.radians(table.true.scan_plane_tilt_deg)
    motion = {"sine": motions.sine, "triangle": motions.triangle}[table.motion](half_angle, table.scan_hz)
    return Deflection(motion, lambda swing: mirrors.swung_mirror(swing.angle_rad, 0.0, plane_tilt), 2.0, math.inf)


def _polygon(table: ScannerTable, name: str) -> Deflection:
    plane_tilt = math.radians(table.true.scan_plane_tilt_deg)
    tilts = np.zeros(table.facets)
    given = set()
    for place, facet in enumerate(table.facet):
        key = f"scanner.{name}.facet[{place}].index"
        if facet.index >= table.facets:
            raise PlanError(key, f"got {facet.index}, want 0 to {table.facets - 1}: facets = {table.facets}")
        if facet.index in given:
            raise PlanError(key, f"facet {facet.index} is given twice, want one tilt for each facet")
        given.add(facet.index)
        tilts[facet.index] = math.radians(facet.tilt_deg)
    return Deflection(
        motions.polygon(table.scan_hz, table.facets),
        lambda swing: mirrors.swung_mirror(swing.angle_rad, tilts[swing.facet], plane_tilt),
        2.0,
        math.radians(table.half_angle_deg),
    )


def _monogon(table: ScannerTable, name: str) -> Deflection:
    plane_tilt = math.radians(table.true.scan_plane_tilt_deg)
    return Deflection(
        motions.turning(table.scan_hz),
        lambda swing: mirrors.monogon(swing.angle_rad, plane_tilt),
        1.0,
        math.radians(table.half_angle_deg),
    )


def _nutating(table: ScannerTable, name: str) -> Deflection:
    _refuse_plane_errors(table, name)
    nutation = math.radians(table.nutation_deg)
    return Deflection(
        motions.turning(table.scan_hz), lambda swing: mirrors.nutating(swing.angle_rad, nutation), 1.0, math.inf
    )


def _risley(table: ScannerTable, name: str) -> Deflection:
    _refuse_plane_errors(table, name)
    turns = _turns_until_both_are_back(table, name)
    ratio = table.prism_ratio
    wedges = (math.radians(table.wedge_deg[0]), math.radians(table.wedge_deg[1]))

    def direction(swing: Swing) -> FloatArray:
        return mirrors.risley(swing.angle_rad, ratio * swing.angle_rad, wedges, table.refractive_index)

    around = np.linspace(-np.pi, np.pi, 361)
    down = mirrors.risley(np.zeros_like(around), around, wedges, table.refractive_index)[:, 2]
    if max(map(abs, table.wedge_deg)) >= 90.0 or not (down > 0.0).all():
        text = (
            f"got {table.wedge_deg}, want smaller angles: at this refractive_index the prism reflects the light totally"
        )
        raise PlanError(f"scanner.{name}.wedge_deg", text)
    return Deflection(motions.turning(table.scan_hz, turns), direction, 1.0, math.inf)


def _turns_until_both_are_back(table: ScannerTable, name: str) -> int:
    """Return the turns of the first prism, counted by its encoder, after which the second is as at the beginning."""
    most = int(READING_COUNTS / table.encoder_counts)
    turns = Fraction(table.prism_ratio).limit_denominator(most)
    if abs(float(turns) - table.prism_ratio) > 1e-12:
        text = (
            f"got {table.prism_ratio!r}, want a fraction whose denominator is at most {most}, as {float(turns)!r} = "
            f"{turns}: the readings of encoder_counts = {table.encoder_counts} allow no larger denominator in 32 bits"
        )
        raise PlanError(f"scanner.{name}.prism_ratio", text)
    return turns.denominator


def _refuse_plane_errors(table: ScannerTable, name: str) -> None:
    for key in ("scan_plane_tilt_deg", "pitch_slope_ppm"):
        if getattr(table.true, key) != 0.0:
            text = f"got {getattr(table.true, key):g}, want 0: kind {table.kind} has no plane of scan"
            raise PlanError(f"scanner.{name}.true.{key}", text)


_DEFLECTIONS: dict[str, Callable[[ScannerTable, str], Deflection]] = {
    "oscillating": _oscillating,
    "polygon": _polygon,
    "monogon": _monogon,
    "nutating": _nutating,
    "risley": _risley,
}
