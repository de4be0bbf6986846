"""Correct for the air between scanner and ground: range corrections and beam bending.

Ranges of devices that count with the speed of light in vacuum are too long in air, and beams bend (FORMULAS 3.2, 4;
``[atmosphere]`` of the configuration).

Group refractivity is the closed form of IAG 1999, in the International Standard Atmosphere (dry) or in one that goes
through a measured temperature, pressure and humidity. Bending models bring their own air. Heights are ellipsoidal where
the models count from the sea: with a geoid 50 m away ranges change by 1.3 ppm.

Bending of beams by air: ARDC's K or spherical layers (FORMULAS 4; NGA Eq. 4 to 11).

A beam bends towards the vertical as the air gets denser: the point lies nearer to nadir, by Δd, than the beam's first
direction. Heights are used as given, ellipsoidal, although the models count them from the sea. With a geoid 50 m from
the ellipsoid Δd changes by half a percent.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from swath.georef.air.kernels import ARDC, CELLS, FLOOR_M, SPHERICAL, STEP_M, STRAIGHT, apply_air, means
from swath.georef.arrays import FloatArray

SPHERE_M = 6_371_000.0
FT_PER_M = 1.0 / 0.3048
HPA_PER_PSF = 0.4788025898
GAUSS_NODES, GAUSS_WEIGHTS = np.polynomial.legendre.leggauss(20)


ZERO_CELSIUS_K = 273.15
STANDARD_K, STANDARD_HPA = 288.15, 1013.25  # ISO 2533, at height 0
LAPSE_K_PER_M = 0.0065
TROPOPAUSE_M = 11_000.0
HYDROSTATIC_K_PER_M = 9.80665 * 0.0289644 / 8.31432  # g M / R, constants of ISO 2533
WORTH_SAYING_M = 0.002
FLATTEST_RAD = math.radians(80.0)
MODELS = {"none": STRAIGHT, "ardc": ARDC, "spherical": SPHERICAL}


class AtmosphereError(ValueError):
    """Raised for an impossible description of the air."""


def saturated_hpa(temperature_c: ArrayLike) -> FloatArray:
    """Return the pressure of saturated water vapour in hPa (FORMULAS 3.2, Magnus) at (…,) °C."""
    temperature = np.asarray(temperature_c, dtype=np.float64)
    pressure: FloatArray = 6.112 * np.exp(17.62 * temperature / (243.12 + temperature))
    return pressure


def group_refractivity_ppm(
    wavelength_nm: float, temperature_k: ArrayLike, pressure_hpa: ArrayLike, vapour_hpa: ArrayLike
) -> FloatArray:
    """Return 1e6 (n_g − 1) of air (IAG 1999, closed form), (…,): within 0.1 ppm of Ciddor from 530 to 1550 nm.

    Args:
        wavelength_nm: in vacuum.
        pressure_hpa: total pressure.
        vapour_hpa: partial pressure of water vapour.
    """
    wave = (1e-3 * wavelength_nm) ** -2
    standard = 287.6155 + 4.88660 * wave + 0.06800 * wave * wave
    temperature = np.asarray(temperature_k, dtype=np.float64)
    dry = ZERO_CELSIUS_K / STANDARD_HPA * standard * np.asarray(pressure_hpa) / temperature
    refractivity: FloatArray = dry - 11.27 * np.asarray(vapour_hpa) / temperature
    return refractivity


def standard_air(
    height_m: ArrayLike, known_height_m: float = 0.0, known_k: float = STANDARD_K, known_hpa: float = STANDARD_HPA
) -> tuple[FloatArray, FloatArray]:
    """Return temperature in K and pressure in hPa at heights (…,) of the standard atmosphere through a known point.

    The temperature falls by 6.5 K a km up to 11 km, the pressure is hydrostatic (ISO 2533).
    """
    height = np.asarray(height_m, dtype=np.float64)
    lower = min(known_height_m, TROPOPAUSE_M)

    def temperature_at(at_m: ArrayLike) -> FloatArray:
        temperature: FloatArray = known_k - LAPSE_K_PER_M * (np.minimum(at_m, TROPOPAUSE_M) - lower)
        return temperature

    def weight(at_m: ArrayLike) -> FloatArray:
        isothermal = np.maximum(np.asarray(at_m) - TROPOPAUSE_M, 0.0) / temperature_at(TROPOPAUSE_M)
        load: FloatArray = HYDROSTATIC_K_PER_M * (isothermal - np.log(temperature_at(at_m)) / LAPSE_K_PER_M)
        return load

    pressure: FloatArray = known_hpa * np.exp(weight(known_height_m) - weight(height))
    return temperature_at(height), pressure


@dataclass(frozen=True, slots=True)
class EdgeEffect:
    """The effect of air on a beam at the swath's edge, corrected or not; metres.

    Attributes:
        range_m: excess of a range that is counted with the speed of light in vacuum (or with the instrument's index).
        bending_m: distance by which the point lies nearer to nadir than the beam's first direction; by spherical layers
            where no model is chosen.
    """

    range_m: float
    bending_m: float


class Air:
    """The air for light of one wavelength; its arguments are the keys of ``[atmosphere]``.

    Args:
        ranges: "corrected": the device has corrected them; "vacuum": they are corrected here.
        model: "standard", or "measured": temperature, pressure and relative humidity at ``height_m``, and from there
            the standard lapse rate, hydrostatic pressure and the same relative humidity.
        refraction: "none", "ardc" or "spherical".
        wavelength_nm: in vacuum.
        reference_index: group index by which the instrument has already divided; 1 if it has not.

    Attributes:
        corrects_range, bends: the corrections that `apply` makes.

    Raises:
        AtmosphereError: an unknown word, or a number that is impossible for air.
    """

    def __init__(
        self,
        ranges: str = "corrected",
        model: str = "standard",
        temperature_c: float = 15.0,
        pressure_hpa: float = 1013.25,
        humidity_percent: float = 50.0,
        height_m: float = 0.0,
        refraction: str = "none",
        wavelength_nm: float = 1064.0,
        reference_index: float = 1.0,
    ) -> None:
        _check("ranges", ranges, ("corrected", "vacuum"))
        _check("model", model, ("standard", "measured"))
        _check("refraction", refraction, tuple(MODELS))
        if not 300.0 <= wavelength_nm <= 2500.0:
            raise AtmosphereError(f"wavelength_nm: got {wavelength_nm:g}, want the laser's, 300 to 2500 nm")
        if not 1.0 <= reference_index <= 1.001:
            raise AtmosphereError(f"reference_index: got {reference_index:g}, want a group index of air, 1 to 1.001")
        self.corrects_range = ranges == "vacuum"
        self.bends = refraction != "none"
        self.refraction = refraction
        self._index = float(reference_index)
        self._constant_ppm = layer_constant_ppm(wavelength_nm)
        measured = (temperature_c, pressure_hpa, humidity_percent, height_m) if model == "measured" else None

        def group(heights_m: FloatArray) -> FloatArray:
            return _refractivity(heights_m, wavelength_nm, measured)

        self._group = _table(group)
        self._phase = _table(lambda heights_m: layer_refractivity(heights_m, self._constant_ppm))

    def mean_refractivity(self, from_height_m: ArrayLike, to_height_m: ArrayLike) -> FloatArray:
        """Return (n,) mean n_g − 1 on straight paths between ellipsoidal heights, exact over height (FORMULAS 3.2)."""
        start, end = np.broadcast_arrays(*(np.atleast_1d(np.asarray(h, float)) for h in (from_height_m, to_height_m)))
        out = np.empty(len(start))
        means(self._group, np.ascontiguousarray(start), np.ascontiguousarray(end), out)
        return out

    def apply(self, origin_e: FloatArray, points_e: FloatArray, travelled_m: FloatArray | None = None) -> None:
        """Correct points in place, as far as this air corrects anything; each result depends on its own point alone.

        Args:
            origin_e: (n, 3) position of the scanner at the pulse.
            points_e: (n, 3) points by the device's ranges along the first directions; rows without a point may hold any
                values.
            travelled_m: (n,) the part of each range that came from time of flight, (1 + range_scale) · ρ_measured;
                None: the whole distance, which errs by 0.3 mm per metre of range offset.
        """
        if not (self.corrects_range or self.bends):
            return
        travelled = np.empty(0) if travelled_m is None else travelled_m
        tables = self._group, self._phase
        bends = MODELS[self.refraction]
        apply_air(origin_e, points_e, travelled, *tables, self._index, self.corrects_range, bends)

    def at_edge(self, height_above_ground_m: float, half_angle_rad: float, ground_height_m: float = 0.0) -> EdgeEffect:
        """Return the models' effect on a beam at this angle from nadir over flat ground (ellipsoidal height).

        Beams flatter than 80° are treated as if they were at 80°.
        """
        angle_rad = min(abs(half_angle_rad), FLATTEST_RAD)
        sensor_m = ground_height_m + height_above_ground_m
        length_m = height_above_ground_m / math.cos(angle_rad)
        index = 1.0 + float(self.mean_refractivity(sensor_m, ground_height_m)[0])
        if self.refraction == "ardc":
            lower_m = max(ground_height_m, 0.0)
            bent = float(ardc_k(sensor_m, lower_m)) * math.tan(angle_rad) if sensor_m > lower_m else 0.0
        else:
            bent = float(spherical_bending(angle_rad, sensor_m, ground_height_m, self._constant_ppm))
        return EdgeEffect(length_m * (index / self._index - 1.0), length_m * bent)

    def warning(self, height_above_ground_m: float, half_angle_rad: float, ground_height_m: float = 0.0) -> str | None:
        """Return a warning if beams bend by more than 2 mm at the swath's edge and the bending is not corrected."""
        bent_m = self.at_edge(height_above_ground_m, half_angle_rad, ground_height_m).bending_m
        if self.bends or bent_m <= WORTH_SAYING_M:
            return None
        return (
            f'atmosphere.refraction is "none": beams bend by {1e3 * bent_m:.1f} mm at the swath\'s edge '
            f"({math.degrees(half_angle_rad):.0f}° from nadir, {height_above_ground_m:.0f} m above ground); set "
            '"spherical" to correct it'
        )


def _check(key: str, got: str, words: tuple[str, ...]) -> None:
    if got not in words:
        raise AtmosphereError(f"{key}: got {got!r}, want one of {', '.join(words)}")


def _refractivity(
    height_m: FloatArray, wavelength_nm: float, measured: tuple[float, float, float, float] | None
) -> FloatArray:
    """Return n_g − 1 at heights (…,); measured: °C, hPa, percent, at height."""
    if measured is None:
        return 1e-6 * group_refractivity_ppm(wavelength_nm, *standard_air(height_m), 0.0)
    temperature_c, pressure_hpa, humidity_percent, known_m = measured
    temperature_k, pressure = standard_air(height_m, known_m, temperature_c + ZERO_CELSIUS_K, pressure_hpa)
    vapour_hpa = 0.01 * humidity_percent * saturated_hpa(temperature_k - ZERO_CELSIUS_K)
    return 1e-6 * group_refractivity_ppm(wavelength_nm, temperature_k, pressure, vapour_hpa)


def _table(refractivity: Callable[[FloatArray], FloatArray]) -> FloatArray:
    """Return the table (CELLS, 5) for `swath.georef.air.kernels`: a cubic and an integral for each cell.

    The cubic goes through four heights of its cell; the integral is that of the cells below. Air is so smooth over a
    cell that this is exact to 1e-13.
    """
    share = np.array([0.0, 0.25, 0.75, 1.0])  # Chebyshev's extrema
    floors = FLOOR_M + STEP_M * np.arange(CELLS)[:, np.newaxis]
    values = refractivity(floors + STEP_M * share)
    table = np.empty((CELLS, 5))
    table[:, :4] = np.linalg.solve(np.vander(share, 4, increasing=True), values.T).T
    within = STEP_M * (table[:, :4] @ (1.0 / np.arange(1, 5)))
    table[:, 4] = np.concatenate([[0.0], np.cumsum(within)[:-1]])
    return table


def layer_constant_ppm(wavelength_nm: float) -> float:
    """Return C of NGA Eq. 9 in ppm K/hPa, re-derived from the closed form of IAG 1999 (FORMULAS 4.3).

    It is 0.27315/1.01325 · N_p.
    """
    wave = (1e-3 * wavelength_nm) ** -2
    return 273.15 / 1013.25 * (287.6155 + 1.62887 * wave + 0.01360 * wave * wave)


def layer_air(height_m: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Return temperature in K and pressure in hPa at heights (…,) in metres (NGA Eq. 10, 11), for the troposphere."""
    fahrenheit = 59.0 - 0.00356 * FT_PER_M * np.asarray(height_m, dtype=np.float64)
    pressure: FloatArray = HPA_PER_PSF * 2116.0 * ((fahrenheit + 459.7) / 518.6) ** 5.256
    return (fahrenheit + 459.67) * 5.0 / 9.0, pressure


def layer_refractivity(height_m: ArrayLike, constant_ppm: float) -> FloatArray:
    """Return n − 1 of dry air at heights (…,) in metres (NGA Eq. 9)."""
    temperature_k, pressure_hpa = layer_air(height_m)
    refractivity: FloatArray = 1e-6 * constant_ppm * pressure_hpa / temperature_k
    return refractivity


def ardc_k(sensor_m: ArrayLike, ground_m: ArrayLike) -> FloatArray:
    """Return K of the ARDC model in radians (NGA Eq. 5, restored), Δd = K tan α (Eq. 4).

    Heights (…,) are in metres, above 0.
    """
    upper, lower = 1e-3 * np.asarray(sensor_m, dtype=np.float64), 1e-3 * np.asarray(ground_m, dtype=np.float64)

    def term(height_km: FloatArray) -> FloatArray:
        return 2410.0 * height_km / (height_km**2 - 6.0 * height_km + 250.0)

    k: FloatArray = 1e-6 * (term(upper) - term(lower) * lower / upper)
    return k


def spherical_bending(nadir_rad: ArrayLike, sensor_m: ArrayLike, ground_m: ArrayLike, constant_ppm: float) -> Any:
    """Return δd in radians of rays through spherical layers (NGA Eq. 6 to 8, restored), for downward beams.

    Args:
        nadir_rad: (…,) angle of the beam from nadir at the sensor.
        sensor_m, ground_m: (…,) heights above a sphere of 6371 km.
        constant_ppm: `layer_constant_ppm`.
    """
    nadir, sensor, ground = (np.asarray(given, dtype=np.float64) for given in (nadir_rad, sensor_m, ground_m))
    invariant = (1.0 + layer_refractivity(sensor, constant_ppm)) * (SPHERE_M + sensor) * np.sin(nadir)
    heights = ground[..., np.newaxis] + (sensor - ground)[..., np.newaxis] * 0.5 * (1.0 + GAUSS_NODES)
    radius = SPHERE_M + heights
    optical = (1.0 + layer_refractivity(heights, constant_ppm)) * radius
    k = invariant[..., np.newaxis]
    central = 0.5 * (sensor - ground) * ((k / (radius * np.sqrt(optical**2 - k**2))) @ GAUSS_WEIGHTS)
    across = (SPHERE_M + ground) * np.sin(central)
    descent = (sensor - ground) + 2.0 * (SPHERE_M + ground) * np.sin(0.5 * central) ** 2
    return nadir - np.arctan2(across, descent)
