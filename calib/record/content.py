"""Collect the attributes of a calibration record that follow from the calibration itself.

They include the matrices of a calibration's computation (ISO/TS 19159-2, CA_LidarCalComputation), as at the solution.

Rows are the observations on planes in the order of the residuals; planes are in the order of the features.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from swath.calib.calibration_file import Header
from swath.calib.features import ControlPoint, Features
from swath.calib.flight import Flight
from swath.calib.labels import unknown
from swath.calib.outcome import Adjusted, Residuals, TrajectoryFit
from swath.calib.record.values import Matrix, Value, utc_text
from swath.georef.arrays import FloatArray, Int64Array
from swath.georef.geodesy.earth import geodetic_from_e, prime_vertical_radius_m, rot_e_from_l
from swath.georef.geodesy.rotations import attitude_of, boresight, rot_from_quaternion
from swath.georef.scanner.calibration import INDEX, Calibration
from swath.georef.scanner.jacobian import observation_columns_e, parameter_columns_e

MOST_ROWS = 200_000  # observations whose rows are kept; with more, every k-th is kept
BLOCK = 1 << 15
COLUMNS = {  # of each return: name → number of columns
    "designMatrix1": 16,
    "designMatrix2": 4,
    "designMatrixObservations": 8,
    "residuals": 8,
    "misclosure": 1,
    "lidarObjectPoint": 3,
    "thetaTarget": 1,
    "rhoTarget": 1,
    "attitudeBodyLocal": 3,
    "phiLocal": 1,
    "lambdaLocal": 1,
    "ellipsoidalHeight": 1,
    "nRadius": 1,
}

Found = dict[str, Value]

BORESIGHT = ("omega_rad", "phi_rad", "kappa_rad")
LEVER_ARM = ("lever_arm_x_m", "lever_arm_y_m", "lever_arm_z_m")
MOST_POINTS = 200_000  # greatest number of points that give heights of the ground
_NOTES = {
    "designMatrix1": "nᵀ ∂x/∂parameter, the sixteen of the model in the order of the calibration file, SI units",
    "designMatrix2": "((x − c)ᵀ, 1) of the point's own plane, c its centre, axes of e; zero for all other planes",
    "designMatrixObservations": "nᵀ ∂x/∂observable: body's x, y, z in e, roll, pitch, heading, range, scan angle",
    "residuals": "v = Σ Bᵀ e / M of range (m) and scan angle (rad); those of the trajectory are not among them",
    "misclosure": "w at the solution, along the plane's normal",
    "designMatrixUnitLength": "(2 s1, 2 s2, 2 s3, 0) of each plane; the condition is held exactly",
    "lidarObjectPoint": "x, y, z in e of the observations on planes",
    "lidarPlaneParameters": "s1 … s4: unit normal in e, and minus its distance from the origin; before the adjustment",
    "thetaTarget": "positive toward +y of the sensor's frame: anticlockwise as one looks along its x",
    "rhoTarget": "as corrected",
    "attitudeBodyLocal": "roll, pitch, heading of the body, R_b^l = R3 R2 R1",
}
_UNITS = {
    "misclosure": "m",
    "lidarObjectPoint": "m",
    "thetaTarget": "rad",
    "rhoTarget": "m",
    "attitudeBodyLocal": "rad",
    "phiLocal": "rad",
    "lambdaLocal": "rad",
    "ellipsoidalHeight": "m",
    "nRadius": "m",
}
_OWNERS = {
    "lidarObjectPoint": "CA_LidarCalibrationTestfield",
    "lidarPlaneParameters": "CA_LidarCalibrationTestfield",
    "thetaTarget": "CA_SFrame",
    "rhoTarget": "CA_SFrame",
    "attitudeBodyLocal": "CA_LFrame",
    "phiLocal": "CA_LFrame",
    "lambdaLocal": "CA_LFrame",
    "ellipsoidalHeight": "CA_LFrame",
    "nRadius": "CA_LFrame",
}


def content_of(
    flight: Flight, features: Features, adjusted: Adjusted, scanner: str, header: Header, settings: Mapping[str, str]
) -> Found:
    """Collect a calibration's values by ``CLASS.attribute``."""
    calibration = adjusted.calibrations[scanner]
    return {
        "CA_CalibrationValidation.calibrationType": Value("inFlight", note="onboard, in flight: code 004"),
        **_computation(flight, features, adjusted, scanner),
        **_frames(flight, calibration),
        **_errors(calibration, adjusted.trajectory),
        **_flown(flight),
        **_instruments(flight, calibration),
        **_control(features, adjusted),
        **_papers(calibration, adjusted, header, settings),
    }


def _computation(flight: Flight, features: Features, adjusted: Adjusted, scanner: str) -> Found:
    matrices = matrices_of(flight, features, adjusted, scanner)
    found = {
        f"{_OWNERS.get(name, 'CA_LidarCalComputation')}.{name}": Value(
            matrix, _UNITS.get(name, ""), _NOTES.get(name, "")
        )
        for name, matrix in matrices.items()
    }
    points = matrices["lidarObjectPoint"].rows if "lidarObjectPoint" in matrices else 0
    field = "CA_LidarCalibrationTestfield"
    found[f"{field}.lidarNObjectPoints"] = Value(points)
    found[f"{field}.lidarJPlane"] = Value(len(features.planes))
    if len(adjusted.planes_e) and "lidarPlaneParameters" in matrices:
        change = Matrix.of(adjusted.planes_e - matrices["lidarPlaneParameters"].array)
        note = "δ2 of s1 … s4, a row a plane: as adjusted less before"
        found["CA_LidarCalComputation.corrections2"] = Value(change, "", note)
    at = [i for i, name in enumerate(adjusted.names) if unknown(name).scanner == scanner]
    if at:
        names = ", ".join(unknown(adjusted.names[i]).name for i in at)
        change = Matrix.of((adjusted.values - adjusted.start)[at])
        note = f"δ1 of all iterations together, SI units, of {names}"
        found["CA_LidarCalComputation.corrections1"] = Value(change, "", note)
    return found


def _frames(flight: Flight, calibration: Calibration) -> Found:
    angles = tuple(calibration.value(name) for name in BORESIGHT)
    found = {
        "CA_BFrame.attitudeSensor": Value(
            Matrix.of(boresight(*angles) @ calibration.installation_matrix), "", "R_s^b = R1(ω) R2(φ) R3(κ) T"
        ),
        "CA_BFrame.leverArm": Value(tuple(calibration.lever_arm_b.tolist()), "m", "x_s^b: forward, right, down"),
    }
    times = [one for swath in flight.swaths if len(swath) for one in (swath.time_ns[0], swath.time_ns[-1])]
    if times:
        note = f"of the first return used; of the last: {utc_text(int(max(times)))}"
        found["CA_Frames.timeRecording"] = Value(utc_text(int(min(times))), "", note)
    if calibration.ibrc is not None:
        table = Matrix.of(np.column_stack(calibration.ibrc))
        note = "intensity, and metres subtracted from the range"
        found["CA_Intensity.intensityCorrection"] = Value(table, "", note)
    return found


def _errors(calibration: Calibration, trajectory: TrajectoryFit | None) -> Found:
    """Return the errors of clause 6.5: value and sigma of each; the trajectory's as root mean square over its knots."""
    found: Found = {}
    for key, names, unit in (
        ("boresight", BORESIGHT, "rad"),
        ("range", ("range_offset_m",), "m"),
        ("scanAngle", ("scan_angle_offset_rad",), "rad"),
        ("scannerAssembly", ("scan_plane_tilt_rad",), "rad"),
    ):
        at = [INDEX[name] for name in names]
        pairs = Matrix.of(np.column_stack([calibration.parameters[at], calibration.sigmas[at]]))
        note = f"value and sigma of {', '.join(names)}; sigma 0: held"
        found[f"CA_ErrorModel.{key}"] = Value(pairs, unit, note)
    if trajectory is not None and len(trajectory.time_ns):
        for key, value, unit, axes in (
            ("positionBody", trajectory.position_l, "m", "north, east, down"),
            ("attitudeBody", trajectory.attitude_rad, "rad", "turns about north, east, down"),
        ):
            note = f"corrections at knots, root mean square: {axes}"
            found[f"CA_ErrorModel.{key}"] = Value(tuple(_rms(value).tolist()), unit, note)
    return found


def _rms(values: FloatArray) -> FloatArray:
    rms: FloatArray = np.sqrt(np.mean(np.square(values), axis=0))
    return rms


def _flown(flight: Flight) -> Found:
    found: Found = {
        "CA_PhotoFlight.numberOfPhotoFlights": Value(len(flight.trajectories), "", "sessions of recording"),
        "CA_PhotoFlight.numberOfStrips": Value(len({(swath.trajectory_index, swath.strip) for swath in flight.swaths})),
    }
    ground_m, above_m, flying_m = _heights(flight)
    if math.isfinite(ground_m):
        found["CA_PhotoFlight.terrainHeight"] = Value(ground_m, "m", "ellipsoidal, median of the points")
        found["CA_PhotoFlight.flyingHeight"] = Value(flying_m, "m", "ellipsoidal, median while returns were recorded")
        found["CA_PhotoFlight.flyingAltitudeAboveGround"] = Value(above_m, "m", "flying height less terrain height")
    return found


def _heights(flight: Flight) -> tuple[float, float, float]:
    """Return the heights of the ground, above ground, and of flying; metres."""
    ground, flying = [np.zeros(0)], [np.zeros(0)]
    share = max(1, sum(len(swath) for swath in flight.swaths) // MOST_POINTS)
    for swath in flight.swaths:
        points = np.asarray(swath.points_t[::share], np.float64)
        points = points[np.isfinite(points).all(axis=1)]
        trajectory = flight.trajectories[swath.trajectory_index]
        at = np.searchsorted(trajectory.time_ns, swath.time_ns[::share])
        at = np.unique(np.clip(at, 0, len(trajectory.time_ns) - 1))
        if len(points) and len(at):
            ground.append(geodetic_from_e(flight.frame.e_from_t(points))[2])
            flying.append(geodetic_from_e(trajectory.position_e[at])[2])
    if len(ground) == 1:
        return math.nan, math.nan, math.nan
    low_m, high_m = float(np.median(np.concatenate(ground))), float(np.median(np.concatenate(flying)))
    return low_m, high_m - low_m, high_m


def _instruments(flight: Flight, calibration: Calibration) -> Found:
    angles = tuple(calibration.value(name) for name in BORESIGHT)
    found = {
        "CA_SensorSystem.relativePosition": Value(
            tuple(calibration.lever_arm_b.tolist()), "m", "scanner's origin from the IMU's: forward, right, down"
        ),
        "CA_SensorSystem.relativeAttitude": Value(angles, "rad", "ω, φ, κ beyond the installation matrix"),
        "CA_IMU.boresightAngle": Value(angles, "rad", "ω, φ, κ"),
    }
    sigmas = np.concatenate([trajectory.attitude_sigma_rad for trajectory in flight.trajectories] or [np.zeros((0, 3))])
    sigmas = sigmas[np.isfinite(sigmas).all(axis=1)]
    if len(sigmas):
        note = "sigma of roll, pitch, heading as the trajectory has it, root mean square"
        found["CA_IMU.attitudeAccuracy"] = Value(tuple(_rms(sigmas).tolist()), "rad", note)
    return found


def _control(features: Features, adjusted: Adjusted) -> Found:
    given = [point for plane in features.planes for point in plane.control]
    given += [tie.control for tie in features.ties if tie.control is not None]
    points: dict[str, ControlPoint] = {point.name: point for point in given}
    found = {"CA_TestRange.numberControlPoints": Value(len(points))}
    if points:
        table = Matrix.of(np.array([point.position_t for point in points.values()]))
        note = f"east, north, up of the flight's middle, of {', '.join(points)}"
        found["CA_TestRange.controlPoint"] = Value(table, "m", note)
    if adjusted.control:
        misclosure_m = np.array([point.misclosure_m for point in adjusted.control])
        note = f"surveyed − laser at {len(misclosure_m)} control points that were used"
        found["CA_PositionalError.errorZ"] = Value(float(np.sqrt(np.mean(misclosure_m**2))), "m", note)
        found["CA_PositionalError.errorType"] = Value("rootMeanSquareError")
        found["CA_PositionalError.quantityType"] = Value("mean")
    return found


def _papers(calibration: Calibration, adjusted: Adjusted, header: Header, settings: Mapping[str, str]) -> Found:
    made = header.created.isoformat()
    method = header.method or calibration.method
    estimated = [name for name in INDEX if calibration.sigmas[INDEX[name]] > 0.0]
    found = {
        "CA_OpticsSensorGeometry.geometryCalibrationDate": Value(made),
        "CA_OpticsSensorGeometry.geometryCalibrationType": Value(f"self-calibration in flight: {method}"),
        "CA_Distortion.selfCalibrationModel": Value(
            "other", "", f"the lidar model of 6.5; estimated: {', '.join(estimated)}"
        ),
        "CA_Distortion.sigmaNaught": Value(math.sqrt(adjusted.variance_factor), "", "no length: of unit weight"),
        "CA_Distortion.propertiesAlgorithm": Value(
            f"Gauss–Helmert, {adjusted.iterations} iterations, redundancy {adjusted.redundancy:.0f}"
        ),
        "CA_Documentation.certificateIdentification": Value(header.id, "", "of the calibration file"),
        "SD_Calibration.calibrationDate": Value(header.created.date().isoformat()),
    }
    if adjusted.control:
        found["CA_Documentation.geometricQuality"] = Value("CA_PositionalError", "", "as there")
    software = settings.get("Swath") or settings.get("software")
    if software:
        found["CA_Distortion.software"] = Value(f"Swath {software}")
    return found


@dataclass(frozen=True, eq=False)
class Observed:
    """Observations of one scanner on planes (n,): plane, swath, return, residual, sigma."""

    plane: Int64Array
    swath: Int64Array
    at: Int64Array
    misclosure_m: FloatArray
    sigma_m: FloatArray
    every: int
    count: int


def observed_of(flight: Flight, adjusted: Adjusted, scanner: str) -> Observed | None:
    """Return the accepted observations of a scanner on planes; None if there are none."""
    tables: list[Residuals] = [group for group in adjusted.residuals if group.group == "planes"]
    heads = [flight.heads[swath.head].name == scanner for swath in flight.swaths]
    if not tables:
        return None
    table = tables[0]
    mine = np.flatnonzero((table.weight > 0.0) & (table.swath >= 0) & np.array([*heads, False])[table.swath])
    if not len(mine):
        return None
    every = -(-len(mine) // MOST_ROWS)
    kept = mine[::every]
    columns = (table.feature[kept], table.swath[kept], table.at[kept], table.misclosure_m[kept], table.sigma_m[kept])
    return Observed(*columns, every=every, count=len(mine))


def matrices_of(flight: Flight, features: Features, adjusted: Adjusted, scanner: str) -> dict[str, Matrix]:
    """Compute the matrices by attribute; those of observations are missing if there are none on planes.

    - designMatrix1 (n, 16): nᵀ ∂x/∂parameter in the order of `swath.georef.scanner.calibration.PARAMETERS`, SI.
    - designMatrix2 (n, 4): ((x − c)ᵀ, 1), c the plane's centre, in e.
    - designMatrixObservations (n, 8): nᵀ ∂x/∂observable in the order of `swath.georef.scanner.jacobian.OBSERVATIONS`.
      With (n, 9) the last is the elevation of a head that gives two angles; so it is with the residuals.
    - residuals (n, 8): v = Σ Bᵀ e / M (FORMULAS 6.3) of range and scan angle; those of the trajectory are zero here,
      because its errors are unknowns of their own.
    - designMatrixUnitLength (planes, 4): (2 s1, 2 s2, 2 s3, 0).
    - lidarPlaneParameters (planes, 4): unit normal in e, s4 = −n · c.
    """
    found: dict[str, Matrix] = {}
    if features.planes:
        normals_e = np.array([plane.normal_t for plane in features.planes]) @ flight.frame.rot_t_from_e
        centres_e = flight.frame.e_from_t(np.array([plane.centre_t for plane in features.planes]))
        distance = -np.einsum("ij,ij->i", normals_e, centres_e)
        found["lidarPlaneParameters"] = Matrix.of(np.column_stack([normals_e, distance]))
        found["designMatrixUnitLength"] = Matrix.of(np.column_stack([2.0 * normals_e, np.zeros(len(distance))]))
    observed = observed_of(flight, adjusted, scanner)
    if observed is None:
        return found
    (head,) = (head for head in flight.heads if head.name == scanner)
    more = dict.fromkeys(("designMatrixObservations", "residuals"), int(head.model(head.start).aimed))
    columns = {name: np.full((len(observed.at), width + more.get(name, 0)), np.nan) for name, width in COLUMNS.items()}
    for swath in np.unique(observed.swath).tolist():
        rows = np.flatnonzero(observed.swath == swath)
        for first in range(0, len(rows), BLOCK):
            block = rows[first : first + BLOCK]
            for name, values in _block(flight, features, adjusted, observed, swath, block).items():
                columns[name][block] = values.reshape(len(block), -1)
    return found | {name: Matrix(table, observed.count, observed.every) for name, table in columns.items()}


def _block(
    flight: Flight, features: Features, adjusted: Adjusted, observed: Observed, index: int, block: Int64Array
) -> Mapping[str, FloatArray]:
    swath = flight.swaths[index]
    head, trajectory = flight.heads[swath.head], flight.trajectories[swath.trajectory_index]
    calibration = adjusted.calibrations[head.name]
    model = head.model(calibration)
    rays = flight.rays(swath, calibration, observed.at[block])
    planes = [features.planes[plane] for plane in observed.plane[block].tolist()]
    normals_e = np.array([plane.normal_t for plane in planes]) @ flight.frame.rot_t_from_e
    centres_e = flight.frame.e_from_t(np.array([plane.centre_t for plane in planes]))
    by_observation = np.einsum("nkc,nc->nk", observation_columns_e(rays, model, trajectory), normals_e)
    residual_m, variance = observed.misclosure_m[block], observed.sigma_m[block] ** 2
    sigma2 = np.array([0.0] * 6 + [head.noise.range_m**2] + [head.noise.angle_rad**2] * (1 + model.aimed))
    rot_e_b = rot_from_quaternion(_there(rays.q_e_from_b))
    lat, lon, height = geodetic_from_e(rays.points_e - np.einsum("nij,nj->ni", rot_e_b, _there(rays.arm_b)))
    attitude = attitude_of(np.swapaxes(rot_e_from_l(lat, lon), 1, 2) @ rot_e_b)
    return {
        "designMatrix1": np.einsum("nkc,nc->nk", parameter_columns_e(rays, model, trajectory), normals_e),
        "designMatrix2": np.column_stack([rays.points_e - centres_e, np.ones(len(block))]),
        "designMatrixObservations": by_observation,
        "residuals": sigma2 * by_observation * (residual_m / variance)[:, np.newaxis],
        "misclosure": -residual_m,
        "lidarObjectPoint": rays.points_e,
        "thetaTarget": rays.angle_rad,
        "rhoTarget": rays.range_m,
        "attitudeBodyLocal": np.column_stack(attitude),
        "phiLocal": lat,
        "lambdaLocal": lon,
        "ellipsoidalHeight": height,
        "nRadius": prime_vertical_radius_m(lat),
    }


def _there(column: FloatArray | None) -> FloatArray:
    """Return a column that rays with axes always have."""
    assert column is not None
    return column
