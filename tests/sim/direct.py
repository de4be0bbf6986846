"""Computes ISO/TS 19159-2 Eq. 10 with the model of the conventions directly, by pyproj and SciPy only.

It takes a scanner's packets, the true calibration from its file and the true trajectory at the IMU's rate, and gives
ground points. This checks that the virtual aircraft follows the conventions; it shares no line with `sim`.
"""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from pyproj import Transformer
from scipy.interpolate import CubicSpline
from scipy.signal import savgol_filter
from scipy.spatial.transform import Rotation, RotationSpline

from swath.georef.arrays import BoolArray, FloatArray

TO_ECEF = Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
TO_GEODETIC = Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True)
Bending = Callable[[FloatArray, FloatArray], FloatArray]  # heights of sensor and ground, m → Δd / tan α
PIECE_S = 8.0  # length of a piece, because RotationSpline solves for all its knots at once


@dataclass(frozen=True)
class Calibration:
    """A calibration file, read without the program's own reader."""

    parameters: dict[str, float]
    installation: FloatArray
    facets: dict[int, float] = field(default_factory=dict)
    ibrc: tuple[list[float], list[float]] | None = None

    @classmethod
    def read(cls, text: str) -> Calibration:
        """Read the calibration from the text of its file."""
        document: dict[str, Any] = tomllib.loads(text)
        facets = {row["index"]: float(np.radians(row["tilt_deg"])) for row in document.get("facet", [])}
        table = document.get("ibrc")
        return cls(
            document["parameters"],
            np.array(document["calibration"]["installation_matrix"], dtype=np.float64),
            facets,
            (table["intensity"], table["correction_m"]) if table else None,
        )

    def value(self, key: str) -> float:
        """Return a parameter in SI units by its key."""
        factor = {"deg": np.pi / 180, "ppm": 1e-6, "us": 1e-6, "us2": 1e-12, "m": 1.0}[key.rsplit("_", 1)[1]]
        return float(self.parameters[key] * factor)


@dataclass(frozen=True)
class Track:
    """Body poses at the IMU's rate: GPS seconds since some whole second, geodetic position, attitude."""

    time_s: FloatArray
    lat_rad: FloatArray
    lon_rad: FloatArray
    height_m: FloatArray
    attitude_rad: FloatArray  # (n, 3) roll, pitch, heading

    def poses(self, time_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return position (n, 3), m, in e and rot_e_from_b (n, 3, 3) at times (n,), s, in order."""
        position = np.empty((len(time_s), 3))
        rotation = np.empty((len(time_s), 3, 3))
        for start_s in np.arange(np.floor(time_s[0]), time_s[-1] + PIECE_S, PIECE_S):
            at = (time_s >= start_s) & (time_s < start_s + PIECE_S)
            knots = (self.time_s > start_s - 0.5) & (self.time_s < start_s + PIECE_S + 0.5)
            if at.any():
                position[at], rotation[at] = self._piece(knots, time_s[at])
        return position, rotation

    def _piece(self, knots: BoolArray, time_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        t, lat, lon = self.time_s[knots], self.lat_rad[knots], self.lon_rad[knots]
        xyz = np.stack(TO_ECEF.transform(np.degrees(lon), np.degrees(lat), self.height_m[knots]), axis=1)
        ned = Rotation.from_euler("ZY", np.stack([lon, -lat - np.pi / 2], axis=1))
        roll, pitch, heading = self.attitude_rad[knots].T
        body = ned * Rotation.from_euler("ZYX", np.stack([heading, pitch, roll], axis=1))
        return CubicSpline(t, xyz)(time_s), RotationSpline(t, body)(time_s).as_matrix()


def beam_angle(calibration: Calibration, time_s: FloatArray, encoder_rad: FloatArray) -> FloatArray:
    """Return θ of the conventions, rad; its derivatives come from readings at a steady rate, one for each pulse."""
    theta = (1 + calibration.value("scan_angle_scale_ppm")) * (encoder_rad - calibration.value("scan_angle_offset_deg"))
    step_s = float(np.median(np.diff(time_s)))
    first = savgol_filter(encoder_rad, 61, 4, deriv=1, delta=step_s)
    second = savgol_filter(encoder_rad, 61, 4, deriv=2, delta=step_s)
    turned: FloatArray = (
        theta + calibration.value("encoder_latency_us") * first + calibration.value("torsion_us2") * second
    )
    return turned


def line_direction(calibration: Calibration, theta: FloatArray) -> FloatArray:
    """Return the beam (n, 3) in s with the scan plane's tilt (ISO Eq. 14)."""
    eta = calibration.value("scan_plane_tilt_deg")
    return np.stack(
        [np.full_like(theta, -np.sin(eta)), np.sin(theta) * np.cos(eta), np.cos(theta) * np.cos(eta)], axis=1
    )


def corrected_range(calibration: Calibration, range_m: FloatArray, intensity: FloatArray) -> FloatArray:
    """Return the corrected range ρ of CONVENTIONS."""
    rho = (1 + calibration.value("range_scale_ppm")) * range_m + calibration.value("range_offset_m")
    if calibration.ibrc is not None:
        rho = rho - np.interp(intensity, *calibration.ibrc)
    return rho


def ground_points(
    calibration: Calibration,
    track: Track,
    time_s: FloatArray,
    points_s: FloatArray,
    theta: FloatArray,
    bending: Bending | None = None,
) -> FloatArray:
    """Return (n, 3), m, in e of points in s at their pulses' times (ISO Eq. 10); each θ tilts φ by the pitch slope."""
    lever_arm_b = np.array([calibration.value(f"lever_arm_{axis}_m") for axis in "xyz"])
    phi = calibration.value("phi_deg") + calibration.value("pitch_slope_ppm") * theta
    omega, kappa = (np.full_like(theta, calibration.value(f"{name}_deg")) for name in ("omega", "kappa"))
    boresight = Rotation.from_euler("XYZ", np.stack([omega, phi, kappa], axis=1))
    position, rotation = track.poses(time_s)
    origin = position + rotation @ lever_arm_b
    along = np.einsum("nij,nj->ni", rotation, boresight.apply(points_s @ calibration.installation.T))
    points: FloatArray = origin + (along if bending is None else bent_towards_nadir(origin, along, bending))
    return points


def bent_towards_nadir(origin_e: FloatArray, along_e: FloatArray, bending: Bending) -> FloatArray:
    """Return beams (n, 3) in e, with their lengths, turned about the horizontal by Δd (NGA Eq. 4, 5)."""
    x, y, z = origin_e.T
    lon, lat, height_m = TO_GEODETIC.transform(x, y, z)
    lat, lon = np.radians(lat), np.radians(lon)
    down = -np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], axis=1)
    length = np.linalg.norm(along_e, axis=1)
    cos = (along_e * down).sum(axis=1) / length
    axis = np.cross(along_e, down)
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    turn = bending(height_m, height_m - length * cos) * np.tan(np.arccos(cos))
    turned: FloatArray = Rotation.from_rotvec(turn[:, np.newaxis] * axis).apply(along_e)
    return turned


def ardc(sensor_m: FloatArray, ground_m: FloatArray) -> FloatArray:
    """Return K of the ARDC model, rad (NGA Eq. 4, 5; FORMULAS 4.1)."""
    top, base = sensor_m / 1000, ground_m / 1000
    first = 2410 * top / (top**2 - 6 * top + 250)
    second = 2410 * base / (base**2 - 6 * base + 250) * base / top
    return 1e-6 * (first - second)


def flat_layers(sensor_m: FloatArray, ground_m: FloatArray) -> FloatArray:
    """Return K = n̄ − n_s, rad, in the dry atmosphere of NGA Eq. 9 to 11 at 1064 nm (FORMULAS 4.2, 4.3)."""

    def excess(height_m: FloatArray) -> FloatArray:
        fahrenheit = 59 - 0.00356 * height_m / 0.3048
        kelvin = (fahrenheit + 459.67) * 5 / 9
        hpa = 0.4788025898 * 2116 * ((fahrenheit + 459.7) / 518.6) ** 5.256
        refractivity: FloatArray = 77.926e-6 * hpa / kelvin
        return refractivity

    mean = (excess(sensor_m) + 4 * excess((sensor_m + ground_m) / 2) + excess(ground_m)) / 6
    return mean - excess(sensor_m)


def group_index(sensor_m: FloatArray, ground_m: FloatArray) -> FloatArray:
    """Return the mean group index over the path in the dry standard atmosphere at 1064 nm.

    The equation is the closed form of IAG 1999 (FORMULAS 3.2).
    """

    def refractivity(height_m: FloatArray) -> FloatArray:
        kelvin = 288.15 - 0.0065 * height_m
        hpa = 1013.25 * (kelvin / 288.15) ** 5.25588
        dry = 287.6155 + 4.88660 / 1.064**2 + 0.06800 / 1.064**4
        ppm: FloatArray = 273.15 / 1013.25 * dry * hpa / kelvin
        return ppm

    mean = (refractivity(sensor_m) + 4 * refractivity((sensor_m + ground_m) / 2) + refractivity(ground_m)) / 6
    index: FloatArray = 1 + 1e-6 * mean
    return index
