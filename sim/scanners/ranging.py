"""The receiver: ranges with every error of CONVENTIONS' model, intensities and pulse widths of echoes."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from swath.georef.arrays import FloatArray, Int64Array, StructArray, UInt64Array
from swath.sim.atmosphere import Air
from swath.sim.clocks import generator
from swath.sim.plan.errors import PlanError
from swath.sim.plan.tables import ScannerTable
from swath.sim.shots import Echoes, Measured, Pulses

LIGHT_MPS = 299_792_458.0
THRESHOLD = 0.005  # share of full intensity below which echoes are not detected
STEEPEST_RAD = np.radians(85.0)  # flatter incidence counts as this one, so that no footprint has infinite depth
LARGEST_SCALE_PPM = 100_000.0
_SLOTS = 16  # more slots than any scanner has


@dataclass(frozen=True, slots=True)
class IntensityScale:
    """Intensity counts of a receiver.

    Attributes:
        full: counts of a surface of reflectance 1 at the reference range, met perpendicularly, in clear air.
        most: counts at saturation.
    """

    full: float
    most: float


LINE_SCANNER = IntensityScale(4000.0, 65_535.0)
SPINNING_HEAD = IntensityScale(100.0, 255.0)  # as Velodyne: 100 is white paper, above are retroreflectors


class Ranging:
    """A scanner's receiver.

    Args:
        table: of the plan.
        air: air on the way.
        seed, name: names that its noise depends on.
        noise: False gives ranges without noise.
        intensity: its intensity counts; None: those of the scanner's kind.

    Raises:
        PlanError: the range gate has no width, or intensities of ``ibrc`` are out of order.
    """

    def __init__(
        self,
        table: ScannerTable,
        air: Air,
        seed: int,
        name: str,
        noise: bool,
        intensity: IntensityScale | None = None,
    ) -> None:
        self._table, self._air, self._noise = table, air, noise
        self._spinning = table.kind in ("vlp16", "os1", "rosette")
        self._counts = intensity or (SPINNING_HEAD if self._spinning else LINE_SCANNER)
        self._key = generator(seed, "ranging", name).integers(2**64, dtype=np.uint64)
        self._aside = generator(seed, "footprint", name).integers(2**64, dtype=np.uint64)
        self._scale = 1.0 + 1e-6 * table.true.range_scale_ppm
        self._beam_m = _beam_corrections(table) if self._spinning else np.zeros(1)
        _check(table, f"scanner.{name}")

    def aside(self, pulses: Pulses, direction: FloatArray) -> FloatArray | None:
        """Return (n, 3) unit vectors to one place of each pulse's footprint; None: the plan does not draw one.

        Places are spread evenly over the disc of the beam's divergence about directions (n, 3).
        """
        if not (self._noise and self._table.range_noise.drawn):
            return None
        one, other = gauss(self._aside, pulses.number, 0), gauss(self._aside, pulses.number, 1)
        length = np.hypot(one, other)  # of two normal numbers: exp(−length² / 2) is even from 0 to 1
        radius = 0.5e-3 * self._table.divergence_mrad * np.sqrt(np.exp(-0.5 * length**2)) / np.maximum(length, 1e-300)
        across = np.cross(direction, np.where(np.abs(direction[:, :1]) < 0.8, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]]))
        across /= np.linalg.norm(across, axis=1, keepdims=True)
        moved = direction + radius[:, None] * (one[:, None] * across + other[:, None] * np.cross(direction, across))
        drawn: FloatArray = moved / np.linalg.norm(moved, axis=1, keepdims=True)
        return drawn

    def measure(
        self,
        pulses: Pulses,
        echoes: Echoes,
        from_height_m: FloatArray,
        to_height_m: FloatArray,
        drawn_m: FloatArray | None = None,
    ) -> Measured:
        """Return the measurements that the device reports.

        Args:
            pulses: n pulses.
            echoes: of the pulses, R slots.
            from_height_m: (n,) of the scanner, to_height_m (n, R) of the echoes, for the air.
            drawn_m: (n, R) distances of the drawn places behind the echoes; None: noise by the footprint's depth.

        Returns:
            measurements in the slots of their echoes. A slot whose echo is too weak or outside the range gate has
            range, intensity and width 0, even before a slot with a return (`packed` closes such gaps).
        """
        pulse, slot = np.nonzero(np.isfinite(echoes.range_m))
        range_m, incidence = echoes.range_m[pulse, slot], echoes.incidence_rad[pulse, slot]
        intensity = self._intensity(range_m, echoes.reflectance[pulse, slot])
        depth_m = 1e-3 * self._table.divergence_mrad * range_m * np.tan(np.minimum(incidence, STEEPEST_RAD))
        said_m = self._model_range(range_m, intensity, pulses.channel[pulse])
        said_m = self._air.device_range(said_m, from_height_m[pulse], to_height_m[pulse, slot])
        if self._noise:
            sloped_m = depth_m if drawn_m is None else np.zeros(len(depth_m))
            said_m = said_m if drawn_m is None else said_m + drawn_m[pulse, slot]
            said_m = said_m + self._sigma_m(intensity, sloped_m) * gauss(self._key, pulses.number[pulse], slot)
        width_ns = self._table.pulse_ns + 2e9 / LIGHT_MPS * depth_m
        there = intensity >= max(1.0, THRESHOLD * self._counts.full)
        there &= (said_m > 0.0) & (said_m >= self._table.range_min_m) & (said_m <= self._table.range_max_m)
        placed = np.zeros((3, *echoes.range_m.shape))
        placed[:, pulse[there], slot[there]] = said_m[there], intensity[there], width_ns[there]
        return Measured(range_m=placed[0], intensity=placed[1], pulse_width_ns=placed[2])

    def _intensity(self, range_m: FloatArray, reflectance: FloatArray) -> FloatArray:
        """Return (k,) whole counts: reflectance divided by the square of the distance, attenuated by the air."""
        near = np.maximum(range_m, 1e-3)  # an echo at the scanner itself has a finite intensity
        power = reflectance * (self._table.reference_range_m / near) ** 2 * self._air.transmission(range_m)
        counts: FloatArray = np.clip(np.rint(self._counts.full * power), 0.0, self._counts.most)
        return counts

    def _model_range(self, range_m: FloatArray, intensity: FloatArray, channel: NDArray[np.uint16]) -> FloatArray:
        """Return (k,) ρ_measured of CONVENTIONS: ρ = (1 + range_scale) ρ_measured + range_offset − ibrc(intensity).

        A beam's own correction is added to the offset, like those of the calibration's other tables.
        """
        offset_m = self._table.true.range_offset_m + self._beam_m[np.minimum(channel, len(self._beam_m) - 1)]
        if self._table.ibrc is not None:
            offset_m = offset_m - np.interp(intensity, self._table.ibrc.intensity, self._table.ibrc.correction_m)
        measured_m: FloatArray = (range_m - offset_m) / self._scale
        return measured_m

    def _sigma_m(self, intensity: FloatArray, depth_m: FloatArray) -> FloatArray:
        """Return (k,) sigmas of the noise: smaller for bright echoes, larger where the footprint lies on a slope."""
        noise = self._table.range_noise
        weak = 0.1 * self._counts.full / np.maximum(intensity, 1.0)
        sigma: FloatArray = np.sqrt(noise.sigma_m**2 * weak + (noise.footprint * depth_m) ** 2)
        return sigma


def packed(measured: Measured, truth: StructArray) -> tuple[Measured, StructArray]:
    """Return the measurements, nearest first, with the slots without a return at the end.

    ``truth`` (n, R) is sorted likewise and renumbered.

    Args:
        measured: of n pulses.
        truth: `swath.sim.truth.RETURN_TRUTH_DTYPE`, same slots.
    """
    key = np.where(measured.range_m > 0.0, measured.range_m, np.inf)
    with np.errstate(invalid="ignore"):
        mixed = np.flatnonzero((np.diff(key, axis=1) < 0.0).any(axis=1))
    if not len(mixed):
        return measured, truth
    order = np.argsort(key[mixed], axis=1, kind="stable")
    columns = []
    for values in (measured.range_m, measured.intensity, measured.pulse_width_ns):
        values = values.copy()
        values[mixed] = np.take_along_axis(values[mixed], order, axis=1)
        columns.append(values)
    truth = truth.copy()
    truth[mixed] = np.take_along_axis(truth[mixed], order, axis=1)
    truth["return_number"][mixed] = np.arange(1, truth.shape[1] + 1)
    return Measured(*columns), truth


def _check(table: ScannerTable, key: str) -> None:
    if table.range_min_m >= table.range_max_m:
        text = f"got {table.range_min_m:g}, want less than range_max_m = {table.range_max_m:g}"
        raise PlanError(f"{key}.range_min_m", text)
    if abs(table.true.range_scale_ppm) > LARGEST_SCALE_PPM:
        text = f"got {table.true.range_scale_ppm:g}, want {-LARGEST_SCALE_PPM:g} to {LARGEST_SCALE_PPM:g}"
        raise PlanError(f"{key}.true.range_scale_ppm", text)
    if table.ibrc is None:
        return
    intensity, correction = table.ibrc.intensity, table.ibrc.correction_m
    if len(correction) != len(intensity):
        text = f"has {len(correction)} values, want {len(intensity)}: one for each of ibrc.intensity"
        raise PlanError(f"{key}.ibrc.correction_m", text)
    for before, after in pairwise(intensity):
        if after <= before:
            raise PlanError(f"{key}.ibrc.intensity", f"{after:g} follows {before:g}, want increasing values")


def _beam_corrections(table: ScannerTable) -> FloatArray:
    """Return (channels + 1,) ``range_m`` of every beam; the last element, for all other beams, is 0."""
    corrections = np.zeros(max((beam.channel for beam in table.beam), default=-1) + 2)
    for beam in table.beam:
        corrections[beam.channel] += beam.range_m
    return corrections


def gauss(key: np.uint64, number: Int64Array, slot: Int64Array | int) -> FloatArray:
    """Return (k,) standard normal numbers, each a function of pulse number and slot (k,) alone.

    Counters go through SplitMix64's mixer (Steele, Lea, Flood 2014), pairs through the Box-Muller transform.
    """
    counter = (number * _SLOTS + slot).astype(np.uint64)
    first = _mixed(_mixed(counter) ^ key)
    radius = np.sqrt(-2.0 * np.log(((first >> np.uint64(11)) + np.uint64(1)).astype(np.float64) * 2.0**-53))
    turn = (_mixed(first) >> np.uint64(11)).astype(np.float64) * 2.0**-53
    normal: FloatArray = radius * np.cos(2 * np.pi * turn)
    return normal


def _mixed(values: UInt64Array) -> UInt64Array:
    mixed = values + np.uint64(0x9E3779B97F4A7C15)
    mixed = (mixed ^ (mixed >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    mixed = (mixed ^ (mixed >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return mixed ^ (mixed >> np.uint64(31))
