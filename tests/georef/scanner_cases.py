"""Provides scanners of every type, with beams computed independently: half turns, SciPy, drivers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from swath.drivers.scanner.beams import BeamTable, beam_table
from swath.drivers.scanner.beams import beam_points as velodyne_points
from swath.georef.arrays import FloatArray, StructArray
from swath.georef.records import AIMED_RETURN_DTYPE, RETURN_DTYPE
from swath.georef.scanner.beams import (
    AimedGeometry,
    FibreGeometry,
    Geometry,
    LineGeometry,
    NutatingGeometry,
    OusterGeometry,
    RisleyGeometry,
    SpinningGeometry,
)
from swath.georef.scanner.calibration import BeamCorrection, Calibration, RangeOffset, nominal
from swath.georef.trajectory.trajectory import Trajectory

PointsS = Callable[[Calibration, StructArray, FloatArray, FloatArray], FloatArray]  # rows, θ, ρ → (n, 3) in s

TURNED = np.diag([-1.0, -1.0, 1.0])  # cables to the rear, FORMULAS 1.5
EVERYTHING = {
    "omega_rad": 0.021,
    "phi_rad": -0.034,
    "kappa_rad": 0.052,
    "range_offset_m": 0.35,
    "range_scale": 2.5e-4,
    "scan_angle_offset_rad": 0.0021,
    "scan_angle_scale": 7e-4,
    "scan_plane_tilt_rad": 0.013,
    "time_offset_s": 1.3e-3,
    "imu_latency_s": -2.1e-3,
    "encoder_latency_s": 3e-6,
    "torsion_s2": 2e-8,
    "pitch_slope": 6e-4,
}
IBRC = (np.array([0.0, 40.0, 55.0, 300.0, 2000.0]), np.array([0.03, 0.02, -0.01, -0.015, -0.04]))


def rows_of(encoder_rad: object, range_m: object, **others: object) -> StructArray:
    """Return rows with these columns."""
    encoder, measured = np.broadcast_arrays(
        np.asarray(encoder_rad, dtype=np.float64), np.asarray(range_m, dtype=np.float64)
    )
    rows = np.zeros(encoder.size, AIMED_RETURN_DTYPE if "elevation_rad" in others else RETURN_DTYPE)
    rows["encoder_rad"], rows["range_m"] = encoder.ravel(), measured.ravel()
    rows["return_number"] = rows["number_of_returns"] = 1
    for name, column in others.items():
        rows[name] = column
    return rows


def still_trajectory() -> Trajectory:
    """Return one second of a body whose origin and axes are those of e."""
    quaternions = np.tile([1.0, 0.0, 0.0, 0.0], (2, 1))
    unsaid = np.full((2, 3), np.nan)
    time_ns = np.array([0, 1_000_000_000])
    return Trajectory(time_ns, np.zeros((2, 3)), quaternions, np.zeros((2, 3)), unsaid, unsaid, 2_000_000_000, "still")


def calibration_of(geometry: Geometry, **changes: float) -> Calibration:
    """Return a calibration with every error that such a scanner has, and the tables."""
    values = {name: 0.0 if name in geometry.without else value for name, value in EVERYTHING.items()}
    offsets = (RangeOffset(0.012, return_slot=1), RangeOffset(-0.03, mta_zone=2), RangeOffset(0.5, prf_hz=1e5))
    calibration = replace(nominal("left", (0.15, -0.08, 0.42), TURNED), ibrc=IBRC, range_offsets=offsets)
    return calibration.changed(**(values | changes))


def mirrored(ray: FloatArray, normal: FloatArray) -> FloatArray:
    """Return rays (n, 3) behind flat mirrors: turned by 180° about the normal, and reversed."""
    behind: FloatArray = -Rotation.from_rotvec(np.pi * normal).apply(ray)
    return behind


def bent(ray: FloatArray, normal: FloatArray, ratio: float) -> FloatArray:
    """Return refracted rays (n, 3), with Snell's law as a rotation in the plane of incidence."""
    across = np.cross(normal, ray)
    sine = np.linalg.norm(across, axis=1)
    turn = np.arcsin(ratio * sine) - np.arcsin(sine)
    axis = across / np.where(sine > 0, sine, 1.0)[:, np.newaxis]
    refracted: FloatArray = Rotation.from_rotvec(turn[:, np.newaxis] * axis).apply(ray)
    return refracted


def scaled(direction: FloatArray, rho: FloatArray) -> FloatArray:
    """Multiply unit vectors by ranges."""
    points: FloatArray = direction * rho[:, np.newaxis]
    return points


def swung_points(calibration: Calibration, rows: StructArray, theta: FloatArray, rho: FloatArray) -> FloatArray:
    """Return points (n, 3), m, in s, of a flat mirror turned about x, whose normal leans by the facet's tilt.

    The laser leaves the scan plane by Δη.
    """
    tilts = np.array([calibration.facet_tilt_rad.get(facet, 0.0) for facet in range(256)])[rows["channel"]]
    laser = Rotation.from_euler("z", -calibration.value("scan_plane_tilt_rad")).apply([0.0, -1.0, 0.0])
    at_rest = Rotation.from_euler("x", -np.pi / 4).apply([0.0, 0.0, 1.0])
    towards_x = np.cos(tilts)[:, np.newaxis] * at_rest + np.sin(tilts)[:, np.newaxis] * np.array([1.0, 0.0, 0.0])
    normal = Rotation.from_euler("x", -theta[:, np.newaxis] / 2).apply(towards_x)
    return scaled(mirrored(np.tile(laser, (len(rows), 1)), normal), rho)


def monogon_points(calibration: Calibration, rows: StructArray, theta: FloatArray, rho: FloatArray) -> FloatArray:
    """Return points (n, 3), m, in s, of a mirror that turns about the laser's beam and is Δη / 2 off its 45°."""
    slope = np.pi / 4 - 0.5 * calibration.value("scan_plane_tilt_rad")
    at_rest = np.tile([-np.cos(slope), 0.0, np.sin(slope)], (len(rows), 1))
    normal = Rotation.from_euler("x", -theta[:, np.newaxis]).apply(at_rest)
    return scaled(mirrored(np.tile([1.0, 0.0, 0.0], (len(rows), 1)), normal), rho)


def palmer_points(shaft_rad: float, nutation_rad: float) -> PointsS:
    """Return the function for a mirror that nutates about a shaft in the plane x, z."""

    def points(calibration: Calibration, rows: StructArray, theta: FloatArray, rho: FloatArray) -> FloatArray:
        shaft = Rotation.from_euler("y", shaft_rad).apply([-1.0, 0.0, 0.0])
        at_rest = Rotation.from_euler("y", shaft_rad + nutation_rad).apply([-1.0, 0.0, 0.0])
        normal = Rotation.from_rotvec(theta[:, np.newaxis] * shaft).apply(np.tile(at_rest, (len(rows), 1)))
        return scaled(mirrored(np.tile([1.0, 0.0, 0.0], (len(rows), 1)), normal), rho)

    return points


def risley_points(wedge_rad: tuple[float, float], index: float, ratio: float) -> PointsS:
    """Return the function for two prisms, that is four refracting surfaces."""

    def points(calibration: Calibration, rows: StructArray, theta: FloatArray, rho: FloatArray) -> FloatArray:
        flat = np.tile([0.0, 0.0, 1.0], (len(rows), 1))
        ray = flat
        for turned, wedge in ((theta, wedge_rad[0]), (ratio * theta, wedge_rad[1])):
            exit_face = Rotation.from_euler("ZY", np.stack([turned, np.full_like(turned, wedge)], axis=1)).apply(flat)
            ray = bent(bent(ray, flat, 1 / index), exit_face, index)
        return scaled(ray, rho)

    return points


def fibre_points(across_rad: FloatArray, along_rad: FloatArray) -> PointsS:
    """Return the function for a ring of fibres, where the mirror's shaft only selects the fibre."""

    def points(calibration: Calibration, rows: StructArray, theta: FloatArray, rho: FloatArray) -> FloatArray:
        fibre = np.rint(rows["encoder_rad"] / (2 * np.pi) * len(across_rad)).astype(int) % len(across_rad)
        offset, scale = calibration.value("scan_angle_offset_rad"), calibration.value("scan_angle_scale")
        angles = np.stack(
            [-(1 + scale) * (across_rad[fibre] - offset), along_rad[fibre] - calibration.value("scan_plane_tilt_rad")],
            axis=1,
        )
        down = np.tile([0.0, 0.0, 1.0], (len(rows), 1))
        return scaled(Rotation.from_euler("XY", angles).apply(down), rho)

    return points


def spinning_points(table: BeamTable) -> PointsS:
    """Return the function for a spinning head, by the driver's own formula."""

    def points(calibration: Calibration, rows: StructArray, theta: FloatArray, rho: FloatArray) -> FloatArray:
        rows = rows.copy()
        corrected = replace(table, elevation_deg=table.elevation_deg.copy(), azimuth_deg=table.azimuth_deg.copy())
        for channel, beam in calibration.beams.items():
            corrected.elevation_deg[channel] += np.degrees(beam.elevation_rad)
            corrected.azimuth_deg[channel] += np.degrees(beam.azimuth_rad)
        rows["encoder_rad"], rows["range_m"] = theta, rho - table.range_m[rows["channel"]]
        return velodyne_points(rows, corrected)

    return points


def ouster_points(geometry: OusterGeometry) -> PointsS:
    """Return the function of the maker's formula (FORMULAS 2.2), a chain of SciPy's rotations for each beam."""

    def points(calibration: Calibration, rows: StructArray, theta: FloatArray, rho: FloatArray) -> FloatArray:
        channel = rows["channel"]
        none = BeamCorrection()
        more = [calibration.beams.get(one, none) for one in range(len(geometry.altitude_rad))]
        altitude = (geometry.altitude_rad + [beam.elevation_rad for beam in more])[channel]
        azimuth = (geometry.azimuth_rad + [beam.azimuth_rad for beam in more])[channel]
        start = np.array([geometry.beam_origin_m[0], 0.0, geometry.beam_origin_m[1]])
        beam = (rho - np.linalg.norm(start))[:, np.newaxis] * np.array([1.0, 0.0, 0.0])
        beam = Rotation.from_euler("ZY", np.stack([-azimuth, -altitude], axis=1)).apply(beam)
        lidar = Rotation.from_euler("Z", theta[:, np.newaxis]).apply(start + beam)
        lidar_h = np.concatenate([lidar, np.ones((len(rows), 1))], axis=1)
        points_s: FloatArray = (lidar_h @ geometry.sensor_from_lidar.T)[:, :3]
        return points_s

    return points


def aimed_points(calibration: Calibration, rows: StructArray, theta: FloatArray, rho: FloatArray) -> FloatArray:
    """Return points of a beam along x that is raised towards z about −y, then turned about z."""
    angles = np.stack([theta, -rows["elevation_rad"]], axis=1)
    ahead = np.tile([1.0, 0.0, 0.0], (len(rows), 1))
    return scaled(Rotation.from_euler("ZY", angles).apply(ahead), rho)


@dataclass(frozen=True)
class Case:
    """A scanner, and its points in s computed independently.

    Attributes:
        geometry, points_s: the scanner's geometry, and the function that computes its points.
        reading_rad: encoder readings go from −this to this.
        channels: the number of channels; a return's channel is less.
        tables: tables that belong to its calibration.
        raised_rad: elevations go from −this to this; 0: returns have none.
    """

    geometry: Geometry
    points_s: PointsS
    reading_rad: float = 1.05
    channels: int = 1
    facet_tilt_rad: tuple[tuple[int, float], ...] = ()
    beams: tuple[tuple[int, BeamCorrection], ...] = ()
    beam_range_m: FloatArray | None = None
    raised_rad: float = 0.0

    def elevations(self, rng: np.random.Generator, count: int) -> dict[str, FloatArray]:
        """Return the column of elevations (n,) for `rows_of`, if returns have one."""
        return {"elevation_rad": rng.uniform(-1.0, 1.0, count) * self.raised_rad} if self.raised_rad else {}

    def calibration(self, **changes: float) -> Calibration:
        """Return a calibration in which every error that the scanner can have is set."""
        return replace(
            calibration_of(self.geometry, **changes),
            facet_tilt_rad=dict(self.facet_tilt_rad),
            beams=dict(self.beams),
        )


_ACROSS, _ALONG = np.radians(np.linspace(-14.0, 14.0, 127)), np.radians(0.3 * np.cos(np.arange(127.0)))
_HDL = beam_table(
    np.linspace(-24.0, 3.0, 32),
    azimuth_deg=np.linspace(-5.0, 5.0, 32),
    range_m=np.linspace(-0.2, 0.9, 32),
    right_m=np.tile([-0.026, 0.026], 16),
    forward_m=np.linspace(0.01, 0.07, 32),
    up_m=np.linspace(0.2, 0.1, 32),
)
_LIDAR = np.eye(4)
_LIDAR[:3, :3], _LIDAR[:3, 3] = np.diag([-1.0, -1.0, 1.0]), (0.001, -0.002, 0.036180)
_OUSTER = OusterGeometry(
    np.radians(np.linspace(21.0, -21.0, 64)), np.radians(np.tile([4.2, 1.4, -1.4, -4.2], 16)), (0.015806, 0.003), _LIDAR
)
_WRONG_BEAMS = ((3, BeamCorrection(0.01, -0.02, 0.05)), (11, BeamCorrection(-0.004, 0.001, -0.3)))
CASES = {
    "oscillating": Case(LineGeometry(), swung_points),
    "polygon": Case(LineGeometry(4), swung_points, channels=4, facet_tilt_rad=((0, 0.003), (1, -0.002), (3, 0.05))),
    "monogon": Case(LineGeometry(), monogon_points),
    "nutating": Case(NutatingGeometry(0.17, 0.7), palmer_points(0.7, 0.17), reading_rad=7.0),
    "risley": Case(RisleyGeometry((0.3, 0.2), 1.51), risley_points((0.3, 0.2), 1.51, -93 / 128), reading_rad=500.0),
    "fibre": Case(FibreGeometry(_ACROSS, _ALONG), fibre_points(_ACROSS, _ALONG), reading_rad=20.0),
    "spinning": Case(
        SpinningGeometry(_HDL.elevation_deg, _HDL.azimuth_deg, _HDL.range_m, _HDL.right_m, _HDL.forward_m, _HDL.up_m),
        spinning_points(_HDL),
        reading_rad=7.0,
        channels=32,
        beams=_WRONG_BEAMS,
        beam_range_m=_HDL.range_m,
    ),
    "aimed": Case(AimedGeometry(), aimed_points, reading_rad=7.0, raised_rad=1.5),
    "ouster": Case(_OUSTER, ouster_points(_OUSTER), reading_rad=7.0, channels=64, beams=_WRONG_BEAMS),
}
