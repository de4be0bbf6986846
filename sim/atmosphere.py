"""The air of the virtual aircraft: the speed of light in it, how it bends beams and how it attenuates them.

The group index follows Ciddor, Applied Optics 35 (1996) 1566, appendices A and B, with the phase index differentiated
numerically. The air is the International Standard Atmosphere, or one that passes through a measured temperature,
pressure and humidity. Bending follows the ARDC model of NGA's lidar formulation paper (Eq. 4, 5), or a ray traced step
by step through the atmosphere of its Eq. 9 to 11. Heights are used as given: the plan's heights are ellipsoidal, and
both models count heights from the sea.
"""

from __future__ import annotations

import numba
import numpy as np
from scipy.interpolate import CubicSpline

from swath.georef.arrays import FloatArray
from swath.sim.plan.tables import AtmosphereTable

ZERO_CELSIUS_K = 273.15
CO2_PPM = 420.0
STANDARD_T_K, STANDARD_P_PA = 288.15, 101_325.0  # ISO 2533, at height 0; dry air
LAPSE_K_PER_M = 0.0065
TROPOPAUSE_M = 11_000.0
HYDROSTATIC_K_PER_M = 9.80665 * 0.0289644 / 8.314_32  # g M / R, constants of ISO 2533
GRID_M = np.arange(-1000.0, 20_001.0, 50.0)
WAVELENGTH_STEP_UM = 1e-4

LAYERS_RADIUS_M = 6_371_000.0
FT_PER_M = 1.0 / 0.3048
HPA_PER_PSF = 0.4788025898
RAY_STEPS = 4
FLATTEST_RAD = np.radians(80.0)  # from nadir: flatter beams bend by as much, those above the horizon do not bend

KRUSE_NM = 550.0
KOSCHMIEDER = 3.912  # −ln of a contrast of 2 %


# --------------------------------------------------------------------------------------------- refractive index


def phase_refractivity_ppm(
    wavelength_um: float,
    temperature_k: FloatArray,
    pressure_pa: FloatArray,
    vapour: FloatArray,
    co2_ppm: float = CO2_PPM,
) -> FloatArray:
    """Return the phase refractivity 1e6 (n − 1) of moist air (Ciddor 1996, Eq. 1 to 5).

    Args:
        wavelength_um: wavelength in vacuum.
        temperature_k, pressure_pa: (…) temperature and pressure of the air.
        vapour: (…) molar fraction of water vapour.
        co2_ppm: molar fraction of carbon dioxide.
    """
    wave = wavelength_um**-2
    dry = 1e-8 * (5_792_105.0 / (238.0185 - wave) + 167_917.0 / (57.362 - wave))
    dry *= 1.0 + 0.534e-6 * (co2_ppm - 450.0)
    wet = 1.022e-8 * (295.235 + 2.6422 * wave - 0.032380 * wave**2 + 0.004028 * wave**3)
    none, one = np.zeros(1), np.ones(1)
    dry_standard = _density(np.array([288.15]), np.array([101_325.0]), none, one)
    wet_standard = _density(np.array([293.15]), np.array([1333.0]), one, one)
    dry_share = _density(temperature_k, pressure_pa, vapour, 1.0 - vapour) / dry_standard
    wet_share = _density(temperature_k, pressure_pa, vapour, vapour) / wet_standard
    refractivity: FloatArray = 1e6 * (dry_share * dry + wet_share * wet)
    return refractivity


def group_refractivity_ppm(
    wavelength_um: float, temperature_k: FloatArray, pressure_pa: FloatArray, vapour: FloatArray
) -> FloatArray:
    """Return the group refractivity 1e6 (n_g − 1), n_g = n − λ dn/dλ, with a central difference as derivative.

    The arguments are those of `phase_refractivity_ppm`.
    """
    step = WAVELENGTH_STEP_UM
    above = phase_refractivity_ppm(wavelength_um + step, temperature_k, pressure_pa, vapour)
    below = phase_refractivity_ppm(wavelength_um - step, temperature_k, pressure_pa, vapour)
    phase = phase_refractivity_ppm(wavelength_um, temperature_k, pressure_pa, vapour)
    return phase - wavelength_um * (above - below) / (2.0 * step)


def vapour_fraction(temperature_k: FloatArray, pressure_pa: FloatArray, humidity: float) -> FloatArray:
    """Return the molar fraction of water vapour at a relative humidity of 0 … 1 (Ciddor 1996, appendix A)."""
    t_c = temperature_k - ZERO_CELSIUS_K
    exponent = 1.2378847e-5 * temperature_k**2 - 1.9121316e-2 * temperature_k + 33.93711047
    saturated_pa = np.exp(exponent - 6.3431645e3 / temperature_k)
    enhancement = 1.00062 + 3.14e-8 * pressure_pa + 5.6e-7 * t_c**2
    fraction: FloatArray = humidity * enhancement * saturated_pa / pressure_pa
    return fraction


def _density(temperature_k: FloatArray, pressure_pa: FloatArray, vapour: FloatArray, share: FloatArray) -> FloatArray:
    """Return the moles in a volume of moist air of the component with this molar share (Ciddor 1996, Eq. 4 and 12).

    The factor 1/R is left out: R and the molar masses of Eq. 4 cancel where densities are divided.
    """
    t_c = temperature_k - ZERO_CELSIUS_K
    ratio = pressure_pa / temperature_k
    first = 1.58123e-6 - 2.9331e-8 * t_c + 1.1043e-10 * t_c**2
    first = first + (5.707e-6 - 2.051e-8 * t_c) * vapour + (1.9898e-4 - 2.376e-6 * t_c) * vapour**2
    compressibility = 1.0 - ratio * first + ratio**2 * (1.83e-11 - 0.765e-8 * vapour**2)
    density: FloatArray = share * ratio / compressibility
    return density


# ------------------------------------------------------------------------------------------------------- bending


@numba.njit(cache=True)
def _refractivity_and_gradient(height_m: float, constant: float) -> tuple[float, float]:
    """Return n − 1 and dn/dh of NGA Eq. 9 to 11; ``constant`` is C of Eq. 9, ppm K / hPa."""
    slope = -0.00356 * FT_PER_M
    fahrenheit = 59.0 + slope * height_m
    pressure_hpa = HPA_PER_PSF * 2116.0 * ((fahrenheit + 459.7) / 518.6) ** 5.256
    refractivity = 1e-6 * constant * pressure_hpa / ((fahrenheit + 459.67) * 5.0 / 9.0)
    return refractivity, refractivity * slope * (5.256 / (fahrenheit + 459.7) - 1.0 / (fahrenheit + 459.67))


@numba.njit(cache=True)
def _rates(height_m: float, constant: float) -> tuple[float, float]:
    """Return the factors of tan ψ for the change per metre of descent of ψ and of the angle at the earth's centre.

    ψ is the ray's angle from the local vertical. The ray equation d(n t)/ds = ∇n, where n changes with the radius only,
    is dψ/dr = −tan ψ (1/r + n'/n).
    """
    refractivity, gradient = _refractivity_and_gradient(height_m, constant)
    curvature = 1.0 / (LAYERS_RADIUS_M + height_m)
    return curvature + gradient / (1.0 + refractivity), curvature


@numba.njit(cache=True)
def _trace(nadir_rad: float, sensor_m: float, ground_m: float, constant: float) -> float:
    """Return the beam's nadir angle at the sensor minus that of the straight line to the point where the beam lands.

    The ray is integrated by Runge-Kutta steps.
    """
    step_m = (sensor_m - ground_m) / RAY_STEPS
    angle, centre = nadir_rad, 0.0
    upper, upper_c = _rates(sensor_m, constant)
    for step in range(RAY_STEPS):
        height_m = sensor_m - step * step_m
        middle, middle_c = _rates(height_m - 0.5 * step_m, constant)
        lower, lower_c = _rates(height_m - step_m, constant)
        t1 = np.tan(angle)
        t2 = np.tan(angle + 0.5 * step_m * upper * t1)
        t3 = np.tan(angle + 0.5 * step_m * middle * t2)
        t4 = np.tan(angle + step_m * middle * t3)
        angle += step_m * (upper * t1 + 2.0 * middle * (t2 + t3) + lower * t4) / 6.0
        centre += step_m * (upper_c * t1 + 2.0 * middle_c * (t2 + t3) + lower_c * t4) / 6.0
        upper, upper_c = lower, lower_c
    ground_radius_m = LAYERS_RADIUS_M + ground_m
    across_m = ground_radius_m * np.sin(centre)
    down_m = (sensor_m - ground_m) + 2.0 * ground_radius_m * np.sin(0.5 * centre) ** 2
    return float(nadir_rad - np.arctan2(across_m, down_m))


@numba.njit(cache=True)
def bending_by_layers(nadir_rad: FloatArray, sensor_m: FloatArray, ground_m: FloatArray, constant: float) -> FloatArray:
    """Return (n,) Δd of rays through spherical layers, radians.

    Args:
        nadir_rad, sensor_m, ground_m: (n,) nadir angles of the beams and heights of their two ends.
        constant: C of NGA Eq. 9.
    """
    bent = np.zeros(len(nadir_rad))
    for i in range(len(nadir_rad)):
        if ground_m[i] < sensor_m[i]:
            bent[i] = _trace(nadir_rad[i], sensor_m[i], ground_m[i], constant)
    return bent


def bending_ardc(nadir_rad: FloatArray, sensor_m: FloatArray, ground_m: FloatArray) -> FloatArray:
    """Return (n,) Δd of the ARDC model, radians (NGA Eq. 4, 5)."""

    def term(height_km: FloatArray) -> FloatArray:
        return 2410.0 * height_km / (height_km**2 - 6.0 * height_km + 250.0)

    upper_km = np.maximum(1e-3 * sensor_m, 1e-6)  # the model is undefined for a sensor below the sea
    lower_km = np.minimum(1e-3 * ground_m, upper_km)
    bent: FloatArray = 1e-6 * (term(upper_km) - term(lower_km) * lower_km / upper_km) * np.tan(nadir_rad)
    return bent


# ----------------------------------------------------------------------------------------------------------- air


class Air:
    """The air of a flight for light of one wavelength.

    Args:
        table: ``[atmosphere]`` of the plan. "standard" is dry ISO 2533. "measured" takes the measured temperature,
            pressure and relative humidity at the height of the measurement; from there temperature has the same lapse,
            pressure is hydrostatic and relative humidity is constant. Bending follows the models' own atmosphere in
            both cases.
        wavelength_nm: wavelength in vacuum.

    Attributes:
        bends: True if beams are refracted.
    """

    def __init__(self, table: AtmosphereTable, wavelength_nm: float) -> None:
        self._table = table
        self._wavelength_um = 1e-3 * wavelength_nm
        self.bends = table.refraction != "none"
        refractivity = CubicSpline(GRID_M, self._refractivity_over(GRID_M))
        self._refractivity, self._integral = refractivity, refractivity.antiderivative()
        reference = np.array([ZERO_CELSIUS_K]), np.array([STANDARD_P_PA]), np.zeros(1)
        at_zero_ppm = float(phase_refractivity_ppm(self._wavelength_um, *reference)[0])
        self._layers_constant = at_zero_ppm * ZERO_CELSIUS_K / (1e-2 * STANDARD_P_PA)

    def _refractivity_over(self, height_m: FloatArray) -> FloatArray:
        """Return (k,) group refractivity in ppm over a grid of heights (k,)."""
        table = self._table
        if table.model == "standard":
            known_m, known_k, known_pa, humidity = 0.0, STANDARD_T_K, STANDARD_P_PA, 0.0
        else:
            known_m, known_k = table.height_m, table.temperature_c + ZERO_CELSIUS_K
            known_pa, humidity = 100.0 * table.pressure_hpa, 0.01 * table.humidity_percent
        top_m = np.minimum(height_m, TROPOPAUSE_M)
        temperature_k = known_k - LAPSE_K_PER_M * (top_m - min(known_m, TROPOPAUSE_M))
        weight = CubicSpline(height_m, HYDROSTATIC_K_PER_M / temperature_k).antiderivative()
        pressure_pa = known_pa * np.exp(weight(known_m) - weight(height_m))
        vapour = vapour_fraction(temperature_k, pressure_pa, humidity)
        return group_refractivity_ppm(self._wavelength_um, temperature_k, pressure_pa, vapour)

    def group_refractivity_ppm(self, from_height_m: FloatArray, to_height_m: FloatArray) -> FloatArray:
        """Return the mean of 1e6 (n_g − 1) along straight paths between heights.

        The result has the shape of the heights and is nan where one of them is nan.
        """
        low, high = np.broadcast_arrays(np.asarray(from_height_m, np.float64), np.asarray(to_height_m, np.float64))
        apart_m = high - low
        level = np.abs(apart_m) < 1.0
        through: FloatArray = np.where(
            level,
            self._refractivity(0.5 * (low + high)),
            (self._integral(high) - self._integral(low)) / np.where(level, 1.0, apart_m),
        )
        return through

    def device_range(self, range_m: FloatArray, from_height_m: FloatArray, to_height_m: FloatArray) -> FloatArray:
        """Return the ranges that a device reports for geometric ranges.

        The device either corrects its ranges itself or counts them with the speed of light in vacuum.

        Args:
            range_m: (n, R) or (n,); 0 and nan stay as they are.
            from_height_m: (n,) heights of the scanner.
            to_height_m: heights of the echoes, of the shape of ``range_m``; used only where there is an echo.

        Returns:
            ranges of the shape of ``range_m``.
        """
        range_m = np.asarray(range_m, np.float64)
        if self._table.ranges == "corrected":
            return range_m
        start_m = np.asarray(from_height_m, np.float64)
        start_m = start_m.reshape(start_m.shape + (1,) * (range_m.ndim - start_m.ndim))
        there = np.isfinite(range_m) & (range_m != 0.0)
        refractivity = self.group_refractivity_ppm(
            np.broadcast_to(start_m, range_m.shape)[there], np.broadcast_to(to_height_m, range_m.shape)[there]
        )
        said = range_m.copy()
        said[there] *= 1.0 + 1e-6 * refractivity
        return said

    def bending(
        self, nadir_angle_rad: FloatArray, sensor_height_m: FloatArray, ground_height_m: FloatArray
    ) -> FloatArray:
        """Return (n,) Δd, radians: the nadir angle of the beam as it leaves minus that of the ground point.

        Args:
            nadir_angle_rad: (n,) nadir angles of the beams as they leave.
            sensor_height_m, ground_height_m: (n,) heights, or one for all.
        """
        nadir = np.asarray(nadir_angle_rad, np.float64)
        if not self.bends:
            return np.zeros(nadir.shape)
        sensor_m, ground_m = (np.broadcast_to(height, nadir.shape) for height in (sensor_height_m, ground_height_m))
        nadir_in = np.minimum(nadir, FLATTEST_RAD)
        if self._table.refraction == "ardc":
            bent = bending_ardc(nadir_in, sensor_m, ground_m)
        else:
            bent = bending_by_layers(
                nadir_in, sensor_m.astype(np.float64), ground_m.astype(np.float64), self._layers_constant
            )
        return np.where(nadir < 0.5 * np.pi, bent, 0.0)

    def bend(
        self, direction: FloatArray, down: FloatArray, sensor_height_m: FloatArray, ground_height_m: FloatArray
    ) -> FloatArray:
        """Return (n, 3) unit vectors towards the points where beams land, given the directions in which they leave.

        Args:
            direction: (n, 3) unit vectors of the beams as they leave, any Cartesian frame.
            down: (3,) or (n, 3) the vertical at the sensor, downward, the same frame.
            sensor_height_m, ground_height_m: (n,) heights, or one for all.
        """
        if not self.bends:
            return direction
        down = np.broadcast_to(down, direction.shape)
        cos = np.einsum("ni,ni->n", direction, down)
        sin = np.linalg.norm(direction - cos[:, np.newaxis] * down, axis=1)
        nadir = np.arctan2(sin, cos)
        bent = self.bending(nadir, sensor_height_m, ground_height_m)
        turns = (sin > 1e-9) & (bent != 0.0)  # a vertical beam does not bend
        safe = np.where(turns, sin, 1.0)
        along, towards = np.sin(nadir - bent) / safe, np.sin(bent) / safe
        turned = along[:, np.newaxis] * direction + towards[:, np.newaxis] * down
        return np.where(turns[:, np.newaxis], turned, direction)

    def transmission(self, range_m: FloatArray) -> FloatArray:
        """Return the share of the light left after the path to a target and back, 0 … 1; shape of ``range_m``.

        The extinction follows from the visibility by Koschmieder's formula and is carried to the wavelength by Kruse's
        exponent.
        """
        sight_km = self._table.visibility_km
        exponent = 1.6 if sight_km > 50.0 else 1.3 if sight_km > 6.0 else 0.585 * sight_km ** (1.0 / 3.0)
        extinction_per_m = 1e-3 * KOSCHMIEDER / sight_km * (1e3 * self._wavelength_um / KRUSE_NM) ** -exponent
        left: FloatArray = np.exp(-2.0 * extinction_per_m * np.asarray(range_m, np.float64))
        return left
