"""Predicts from a virtual flight's plan what its calibration would determine: terrain, trajectory,
scanners, control.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from swath.calib.equations.normals import NormalError
from swath.calib.equations.observability import RULES_OF_ALL
from swath.calib.equations.trajectory_prior import gauss_markov
from swath.calib.features import ControlPoint, Features
from swath.calib.flight import Flight, FlightError, Head, Tangent
from swath.calib.labels import decimals_of, unknown
from swath.calib.outcome import FixedParameter
from swath.calib.parameters import ParameterError, ParameterOptions
from swath.calib.plan import Line, Predicted, Scan, Surface, planned, predict
from swath.daemon.errors import ExitCode, UserError, one_line
from swath.daemon.processing.calibration.model import of_parameters, tables_in_words
from swath.daemon.processing.calibration.plan.navigation import navigated
from swath.daemon.processing.calibration.run import EVERY, PLANES
from swath.georef.arrays import ByteArray, FloatArray
from swath.georef.geodesy.rotations import quaternion_from_rot
from swath.georef.navigation.inputs import NavigationError
from swath.georef.progress import Tell, silent
from swath.georef.scanner.beams import LineGeometry
from swath.georef.scanner.calibration import PARAMETERS, read_calibration
from swath.georef.scanner.uncertainty import Noise
from swath.georef.timescales import SECOND_NS
from swath.georef.trajectory.trajectory import Trajectory
from swath.sim.plan.plan import Plan
from swath.sim.preview.coverage import Survey, control_points, fan_of
from swath.sim.scanners.calibration_files import calibration_text
from swath.sim.shots import GROUND, MARKING, ROAD, ROOF

BEGIN_NS = 1_400_000_000 * SECOND_NS  # a plan's own date does not matter
STEP_S = 0.02
LINE_SCANNERS = ("oscillating", "polygon", "monogon")
ANGLE_SIGMA_RAD = 2e-5
SAMPLES, ASIDE_M, ABOVE_M = 12, 0.05, 500.0  # rays along a side of a roof; offset of rays beside each; height of fall
LEAST_SAMPLES, MOST_SAMPLES, LEAST_AREA_M2 = 8, 36, 6.0
GROUND_SIDE_M, GROUND_PLACES, FLAT_M = 8.0, 14, 0.02
BASIC = {
    "omega_deg": "roll (ω)",
    "phi_deg": "pitch (φ)",
    "kappa_deg": "heading (κ)",
    "range_offset_m": "range offset",
}
# Expected after smoothing with carrier-phase GNSS, for a plan that cannot be navigated because it lacks an IMU or a
# receiver: position (m, each coordinate), roll and pitch, heading (degrees)
EXPECTED = {
    "perfect": (0.001, 0.0001, 0.0002),
    "navigation": (0.02, 0.0025, 0.005),
    "tactical": (0.02, 0.004, 0.01),
    "mems": (0.03, 0.015, 0.06),
    "consumer": (0.05, 0.05, 0.3),
}


@dataclass(frozen=True)
class PlanOptions:
    """The options of a prediction.

    Attributes:
        model: parameters to estimate. Tables are not predicted: pulses on paper return once, without intensity.
        sigmas: expected sigmas of the trajectory: position (m), roll and pitch, heading (degrees); None: those of
            navigation with the plan's IMU and receiver.
        control: True to use the plan's control points.
        control_sigma_m: sigma of these points.
    """

    model: ParameterOptions = field(default_factory=lambda: ParameterOptions("scanner"))
    sigmas: tuple[float, float, float] | None = None
    control: bool = True
    control_sigma_m: float = 0.01


# One sigma, in files' units, at which a parameter is still useful for points of a usual flight; a parameter with a
# larger sigma is not determined.
USEFUL = {
    "omega_deg": 0.005,
    "phi_deg": 0.005,
    "kappa_deg": 0.01,
    "range_offset_m": 0.04,
    "range_scale_ppm": 25.0,
    "scan_angle_offset_deg": 0.005,
    "scan_angle_scale_ppm": 120.0,
    "scan_plane_tilt_deg": 0.005,
    "lever_arm_x_m": 0.025,
    "lever_arm_y_m": 0.025,
    "lever_arm_z_m": 0.025,
    "time_offset_us": 250.0,
    "imu_latency_us": 250.0,
    "encoder_latency_us": 0.5,
    "torsion_us2": 500.0,
    "pitch_slope_ppm": 125.0,
}


@dataclass(frozen=True, eq=False)
class PlannedCalibration:
    """A predicted calibration, and the data of its picture.

    Attributes:
        survey: the plan as flown.
        flight, features: as they would be read from logs.
        predicted: sigmas and held parameters.
        rows: one per parameter, for tables and JSON.
        sigmas: sigmas assumed for the trajectory.
        control: number of control points on planes.
        unplanned: requested entries that are not predicted, in words.
    """

    survey: Survey
    flight: Flight
    features: Features
    predicted: Predicted
    rows: list[dict[str, Any]]
    sigmas: tuple[float, float, float]
    control: int
    unplanned: tuple[str, ...] = ()

    @property
    def fixed(self) -> list[str]:
        """The boresight angles and range offsets that the user holds, as ``left phi_deg``."""
        keys = {parameter.name: parameter.key for parameter in PARAMETERS if parameter.key in BASIC}
        return [f"{one.scanner} {keys[one.name]}" for one in self.predicted.held if not one.remedy and one.name in keys]

    @property
    def notes(self) -> list[str]:
        """Limits of the prediction: what it leaves out, one line each."""
        return [
            f"not predicted: {words}; planned pulses have one return, without intensity" for words in self.unplanned
        ]

    @property
    def lacking(self) -> list[str]:
        """The boresight angles and range offsets that would not be determined, in words."""
        several = len({row["scanner"] for row in self.rows}) > 1
        missing = [row for row in self.rows if row["basic"] and not row["determined"]]
        return [f"{BASIC[row['name']]}{' of ' + row['scanner'] if several else ''}" for row in missing]

    @property
    def sentence(self) -> str:
        """The verdict in one sentence."""
        basic = [row for row in self.rows if row["basic"]]
        more = sum(row["determined"] for row in self.rows) - (len(basic) - len(self.lacking))
        if not self.lacking:
            rest = len(self.rows) - len(basic)
            extra = f", and {more} of {rest} others" if rest else ""
            extra += f"; {', '.join(self.fixed)} held by your choice" if self.fixed else ""
            return f"This flight determines boresight and range offset{extra}."
        words = " and ".join(part for part in (", ".join(self.lacking[:-1]), self.lacking[-1]) if part)
        return f"This flight does not determine {words}."


def plan_calibration(plan: Plan, request: PlanOptions, tell: Tell = silent) -> PlannedCalibration:
    """Predict a plan's calibration; ``tell`` is called with the progress.

    Raises:
        PlanError: the plan cannot be flown; UserError: its scanners cannot be calibrated, or an option cannot be met.
    """
    survey = Survey(plan)
    frame = Tangent.at(survey.site.origin_e)
    tell("trajectory's errors", 0, 0)
    try:
        navigation = navigated(survey, BEGIN_NS) if request.sigmas is None else None
    except NavigationError as error:
        raise UserError(one_line(str(error)), ExitCode.USAGE) from error
    sigmas = request.sigmas or (_by_the_grade(plan) if navigation is None else navigation.sigmas)
    heads, scans = _heads(plan)
    lines = [
        Line(strip.name, 0, number + 1, _gps(strip.start_s), _gps(strip.end_s))
        for number, strip in enumerate(survey.strips)
    ]
    tell("roofs and ground", 0, 0)
    surfaces = [*_roofs(survey, frame), *_ground(survey, frame)]
    control = _control(survey, frame, request.control_sigma_m) if request.control else []
    tell("flight lines over them", 0, 0)
    try:
        most = (PLANES if navigation is None else EVERY).most_points
        trajectories = [_trajectory(survey, sigmas)]
        flight, features = planned(frame, heads, scans, trajectories, lines, [*surfaces, *control], most)
        prior = gauss_markov(flight) if navigation is None else navigation.prior(flight)
        tell("sigmas", 0, 0)
        predicted = predict(flight, features, of_parameters(request.model), prior)
    except (FlightError, ParameterError, NormalError) as error:
        raise UserError(one_line(str(error)), ExitCode.USAGE) from error
    used = sum(len(plane.control) for plane in features.planes)
    unplanned = tuple(tables_in_words(request.model))
    return PlannedCalibration(survey, flight, features, predicted, rows_of(predicted), sigmas, used, unplanned)


def _by_the_grade(plan: Plan) -> tuple[float, float, float]:
    return EXPECTED[next((table.grade for table in plan.tables.imu.values()), "tactical")]


def _gps(time_s: float) -> int:
    return BEGIN_NS + round(time_s * SECOND_NS)


def rows_of(predicted: Predicted) -> list[dict[str, Any]]:
    """Return one row per parameter, in files' units, in the order of the model."""
    by_name = {parameter.name: (index, parameter) for index, parameter in enumerate(PARAMETERS)}
    found: list[tuple[str, float, FixedParameter | None]] = [
        (name, sigma, None) for name, sigma in zip(predicted.names, predicted.sigmas.tolist(), strict=True)
    ]
    found += [(f"{held.scanner}.{held.name}", held.sigma, held) for held in predicted.held if held.remedy]
    rows: list[dict[str, Any]] = []
    order = sorted(found, key=lambda one: (one[0].split(".")[0], by_name[one[0].split(".", 1)[1]][0]))
    for name, sigma, held in order:
        scanner, short = name.split(".", 1)
        parameter = by_name[short][1]
        wanted = USEFUL[parameter.key]
        useful = held is None and sigma <= wanted * parameter.factor
        unit, reached = unknown(name).unit, sigma / parameter.factor
        gap = "" if unit == "°" else " "
        predicted_words, need = f"{reached:.{decimals_of(reached)}f}{gap}{unit}", f"{wanted:g}{gap}{unit}"
        poor = f"would be known to {predicted_words}; {need} or better is useful"
        rows.append(
            {
                "scanner": scanner,
                "name": parameter.key,
                "unit": unit,
                "sigma": sigma / parameter.factor if math.isfinite(sigma) else None,
                "wanted": wanted,
                "determined": useful,
                "basic": parameter.key in BASIC,
                "why": held.why if held is not None else "" if useful else poor,
                "remedy": held.remedy if held is not None else "" if useful else RULES_OF_ALL.of(name).remedy,
            }
        )
    return rows


def _heads(plan: Plan) -> tuple[list[Head], list[Scan]]:
    heads, scans = [], []
    for name, table in plan.tables.scanner.items():
        if table.kind not in LINE_SCANNERS:
            text = (
                f"scanner.{name}: a {table.kind} scanner cannot be planned for; want one of {', '.join(LINE_SCANNERS)}"
            )
            raise UserError(text, ExitCode.USAGE)
        start = read_calibration(calibration_text(plan, name, true=False), name)
        noise = Noise(table.range_noise.sigma_m, ANGLE_SIGMA_RAD, divergence_rad=1e-3 * table.divergence_mrad)
        heads.append(Head(name, start, LineGeometry(), noise, (table.range_min_m, table.range_max_m)))
        fan = fan_of(table)
        motion = table.motion if table.kind == "oscillating" else "turning"
        facets = table.facets if table.kind == "polygon" else 1
        scans.append(Scan(fan.half_angle_rad, fan.rate_hz, table.scan_hz, motion, facets))
    return heads, scans


def _trajectory(survey: Survey, sigmas: tuple[float, float, float]) -> Trajectory:
    """Return the planned trajectory with its expected sigmas."""
    time_s = np.arange(0.0, survey.trajectory.end_s, STEP_S)
    motion = survey.trajectory.motion(time_s)
    position_m, tilt_deg, heading_deg = sigmas
    return Trajectory(
        BEGIN_NS + np.rint(time_s * SECOND_NS).astype(np.int64),
        np.ascontiguousarray(motion.position_e),
        np.ascontiguousarray(quaternion_from_rot(motion.rot_e_from_b)),
        np.ascontiguousarray(motion.velocity_e),
        np.full((len(time_s), 3), position_m),
        np.radians(np.tile([tilt_deg, tilt_deg, heading_deg], (len(time_s), 1))),
        name="plan",
    )


# ---------------------------------------------------------------------- terrain


def _fallen(survey: Survey, places: FloatArray) -> tuple[FloatArray, ByteArray]:
    """Return where rays that fall at places (…, 2) hit: site coordinates (…, 3) and the kind of surface (…)."""
    flat = places.reshape(-1, 2)
    top = survey.scene.site_z(flat[:, 0], flat[:, 1]) + ABOVE_M
    origin = np.column_stack([flat, top])
    down = np.tile([0.0, 0.0, -1.0], (len(flat), 1))
    echoes = survey.scene.cast(origin, down, np.zeros(len(flat)), np.arange(len(flat)), 0.0, 0.1, 1)
    points = origin + echoes.range_m[:, :1] * down
    return points.reshape(*places.shape[:-1], 3), echoes.surface[:, 0].reshape(places.shape[:-1])


def _roofs(survey: Survey, frame: Tangent) -> Iterator[Surface]:
    """Yield the flat parts of every roof: where neighbouring rays find the same slope and height."""
    corners = survey.scene.buildings
    if not len(corners):
        return
    share = np.linspace(0.04, 0.96, SAMPLES)
    u, v = (axis.ravel()[:, np.newaxis] for axis in np.meshgrid(share, share))
    weights = [(1 - u) * (1 - v), u * (1 - v), u * v, (1 - u) * v]
    for number, four in enumerate(corners):
        places = sum(weight * corner for weight, corner in zip(weights, four, strict=True))
        size_m2 = abs(float(np.linalg.det(np.stack([four[1] - four[0], four[3] - four[0]]))))
        yield from _facets(survey, frame, np.asarray(places), size_m2 / SAMPLES**2, f"roof {number + 1}")


def _facets(survey: Survey, frame: Tangent, places: FloatArray, cell_m2: float, name: str) -> Iterator[Surface]:
    beside = places[:, np.newaxis] + np.array([[0.0, 0.0], [ASIDE_M, 0.0], [0.0, ASIDE_M]])
    points, surface = _fallen(survey, beside)
    slope = np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0]) / ASIDE_M**2
    normal = slope / np.linalg.norm(slope, axis=1, keepdims=True)
    away = np.sum(normal * (points[:, 0] - points[0, 0]), axis=1)
    kinds = np.round(np.column_stack([normal[:, :2] / 0.04, away / 0.3]))
    kinds[~(surface == ROOF).all(axis=1)] = np.nan
    _, which, count = np.unique(kinds, axis=0, return_inverse=True, return_counts=True, equal_nan=False)
    for index in np.flatnonzero(count >= max(LEAST_SAMPLES, LEAST_AREA_M2 / cell_m2)).tolist():
        mine = np.flatnonzero(np.ravel(which) == index)
        up, few = (
            normal[mine].mean(axis=0),
            mine[np.linspace(0, len(mine) - 1, min(len(mine), MOST_SAMPLES)).astype(int)],
        )
        points_t = frame.t_from_e(survey.site.e_from_site(points[few, 0]))
        yield Surface(f"{name}.{index}", _unit(survey, frame, up), points_t, len(mine) * cell_m2)


def _unit(survey: Survey, frame: Tangent, normal: FloatArray) -> FloatArray:
    turned: FloatArray = frame.rot_t_from_e @ survey.site.rot_site_from_e.T @ normal
    return turned / np.linalg.norm(turned)


def _ground(survey: Survey, frame: Tangent) -> Iterator[Surface]:
    """Yield squares of bare ground spread over the swaths."""
    outline = np.concatenate([survey.edges(strip) for strip in survey.strips])
    low, high = outline.min(axis=0), outline.max(axis=0)
    east, north = (np.linspace(low[axis], high[axis], GROUND_PLACES) for axis in (0, 1))
    for number, centre in enumerate(np.stack(np.meshgrid(east, north), axis=-1).reshape(-1, 2)):
        surface = _square(survey, frame, centre, f"ground {number + 1}")
        if surface is not None:
            yield surface


def _control(survey: Survey, frame: Tangent, sigma_m: float) -> Iterator[Surface]:
    """Yield a square of ground around every control point, with the point."""
    for number, point in enumerate(control_points(survey.plan, survey.scene)):
        control = ControlPoint(f"{number + 1}", frame.t_from_e(survey.site.e_from_site(point[np.newaxis]))[0], sigma_m)
        surface = _square(survey, frame, point[:2], f"control {number + 1}", (control,))
        if surface is not None:
            yield surface


def _square(
    survey: Survey, frame: Tangent, centre: FloatArray, name: str, control: tuple[ControlPoint, ...] = ()
) -> Surface | None:
    """Return a square of flat ground; None if the place is not flat or not bare."""
    side = np.linspace(-0.5, 0.5, 6) * GROUND_SIDE_M
    points, surface = _fallen(survey, centre + np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2))
    if not np.isin(surface, [GROUND, ROAD, MARKING]).all():
        return None
    middle = points.mean(axis=0)
    _, _, axes = np.linalg.svd(points - middle)
    normal = axes[2] * np.sign(axes[2, 2])
    if np.abs((points - middle) @ normal).max() > FLAT_M:
        return None
    points_t = frame.t_from_e(survey.site.e_from_site(points))
    kind = "control" if control else "ground"
    return Surface(name, _unit(survey, frame, normal), points_t, GROUND_SIDE_M**2, kind, control)
