"""Makes an outcome of a calibration by hand: a flight over houses, with numbers as of an adjustment.

Nothing is estimated: residuals are drawn, and sigmas are stated. Reports and records are tested on it.
"""

from __future__ import annotations

import datetime as dt
import math
from collections import Counter
from dataclasses import dataclass, replace

import numpy as np

from swath.calib.calibration_file import Header
from swath.calib.features import ControlPoint, Features, Patch, Plane, Sighting, TiePoint
from swath.calib.flight import Flight, Head, Swath, Tangent
from swath.calib.outcome import Adjusted, ControlFit, FixedParameter, GroupFit, Residuals, TrajectoryFit
from swath.calib.summary import DifferenceMap, PairDifference, Profile, ReportInput
from swath.georef.arrays import FloatArray
from swath.georef.geodesy.earth import e_from_geodetic, geodetic_from_e
from swath.georef.records import RETURN_DTYPE
from swath.georef.scanner.beams import LineGeometry
from swath.georef.scanner.calibration import INDEX, Calibration, nominal
from swath.georef.trajectory.trajectory import Trajectory

LAT, LON, HEIGHT_M, GROUND_M = math.radians(47.18), math.radians(9.0), 750.0, 450.0
START_NS = 1_447_000_000 * 10**9
LINES = (("01", 25.0, 0.0), ("02", 205.0, 40.0), ("03", 115.0, 0.0), ("04", 295.0, -60.0), ("05", 25.0, 110.0))
SPEED_MPS, HALF_LENGTH_M, RETURNS = 55.0, 240.0, 150_000
ROOFS = tuple(
    (x, y, turn)
    for x, y, turn in zip(
        np.tile(np.linspace(-150.0, 150.0, 6), 5),
        np.repeat(np.linspace(-120.0, 120.0, 5), 6),
        np.arange(30) * 37.0,
        strict=True,
    )
)
HALF_M, RISE = 8.0, math.tan(math.radians(35.0))
FOUND = {"omega_rad": 0.2513, "phi_rad": -0.4021, "kappa_rad": 0.611}
ESTIMATED = ("omega_rad", "phi_rad", "kappa_rad", "range_offset_m", "scan_angle_scale", "range_scale", "time_offset_s")
SIGMAS = (1.05e-5, 1.2e-5, 2.4e-5, 0.0041, 1.8e-5, 4.2e-6, 1.9e-4)


@dataclass(frozen=True, eq=False)
class Outcome:
    """Everything from which a report is made."""

    flight: Flight
    features: Features
    adjusted: Adjusted
    header: Header


def surface_m(place: FloatArray) -> FloatArray:
    """Return the height, m, of flat ground and gabled roofs at (n, 2) east, north."""
    x, y, turn = np.array(ROOFS).T
    column = np.clip(np.rint((place[:, 0] + 150.0) / 60.0), 0, 5).astype(np.int64)
    nearest = column + 6 * np.clip(np.rint((place[:, 1] + 120.0) / 60.0), 0, 4).astype(np.int64)
    east, north = place[:, 0] - x[nearest], place[:, 1] - y[nearest]
    cos, sin = np.cos(np.radians(turn[nearest])), np.sin(np.radians(turn[nearest]))
    u, v = np.abs(east * cos + north * sin), np.abs(north * cos - east * sin)
    roof = GROUND_M + 4.0 + RISE * (HALF_M - u)
    height: FloatArray = np.where((u < HALF_M) & (v < 1.6 * HALF_M), roof, GROUND_M)
    return height


def trajectory() -> Trajectory:
    """Return straight and level lines one after the other, a minute apart, at 20 Hz."""
    frame = Tangent.at(np.asarray(e_from_geodetic(LAT, LON, HEIGHT_M), np.float64))
    parts: list[list[FloatArray]] = []
    for k, (_, heading, offset_m) in enumerate(LINES):
        t = np.arange(-2.0, 2.0 * HALF_LENGTH_M / SPEED_MPS + 2.0, 0.05)
        course = math.radians(heading)
        forward = np.array([math.sin(course), math.cos(course), 0.0])
        side = np.array([math.cos(course), -math.sin(course), 0.0])
        place = np.outer(SPEED_MPS * t - HALF_LENGTH_M, forward) + offset_m * side + [0.0, 0.0, HEIGHT_M]
        lat, lon, height = geodetic_from_e(frame.e_from_t(place))
        velocity = np.tile([SPEED_MPS * math.cos(course), SPEED_MPS * math.sin(course), 0.0], (len(t), 1))
        wave = np.radians(0.6) * np.sin(2.0 * np.pi * t / 9.0)
        rows = [START_NS + np.round((t + 80.0 * k) * 1e9), lat, lon, height, *velocity.T, wave, 0.4 * wave]
        parts.append([*rows, np.full(len(t), course)])
    columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
    count = len(columns[0])
    return Trajectory.from_geodetic(
        columns[0].astype(np.int64),
        columns[1],
        columns[2],
        columns[3],
        np.column_stack(columns[4:7]),
        columns[7],
        columns[8],
        columns[9],
        position_sigma_l=np.full((count, 3), 0.02),
        attitude_sigma_rad=np.radians(np.tile([0.003, 0.003, 0.006], (count, 1))),
        max_gap_ns=10**9,
        name="made",
    )


def made_flight(returns: int = RETURNS, *, true: Calibration | None = None) -> tuple[Flight, Calibration]:
    """Return strips of a line scanner over the surface, placed with the nominal calibration, and the true one."""
    random = np.random.default_rng(11)
    start = nominal("left", [0.12, -0.03, 0.28], np.eye(3))
    start = replace(start, id="nominal", ranges="corrected", refraction="none", mirror_factor=1.0)
    values = {name: math.radians(value) for name, value in FOUND.items()}
    found = true or start.changed(**values, range_offset_m=0.352)
    path = trajectory()
    frame = Tangent.at(np.asarray(e_from_geodetic(LAT, LON, 0.0), np.float64))
    flight = Flight(frame, (Head("left", start, LineGeometry()),), (path,), ())
    swaths = []
    for k, (name, _, _) in enumerate(LINES):
        first_ns = START_NS + 80 * 10**9 * k
        time_ns = first_ns + (np.arange(returns) * (2.0 * HALF_LENGTH_M / SPEED_MPS / returns) * 1e9).astype(np.int64)
        rows = np.zeros(returns, RETURN_DTYPE)
        rows["encoder_rad"] = np.radians(30.0) * (2.0 * ((np.arange(returns) * 0.0025) % 1.0) - 1.0)
        rows["intensity"] = np.clip(random.normal(400.0, 120.0, returns), 5.0, None)
        rows["return_number"] = rows["number_of_returns"] = 1
        rows["range_m"] = 300.0
        swath = Swath(name, 0, k + 1, 0, rows, time_ns, np.zeros((returns, 3)))
        rows["range_m"] = _ranges(flight, swath, found) + random.normal(0.0, 0.02, returns)
        swaths.append(replace(swath, points_t=flight.place(swath, start)))
    return replace(flight, swaths=tuple(swaths)), found


def _ranges(flight: Flight, swath: Swath, found: Calibration) -> FloatArray:
    """Return the ranges measured to the surface, found by halving along each beam."""
    rays = flight.rays(swath, found, with_axes=False)
    origin = flight.frame.t_from_e(rays.origin_e)
    beam = flight.frame.t_from_e(rays.points_e) - origin
    unit = beam / np.linalg.norm(beam, axis=1, keepdims=True)
    low, high = ((level_m - origin[:, 2]) / unit[:, 2] for level_m in (GROUND_M + 12.0, GROUND_M - 1.0))
    for _ in range(16):
        middle = 0.5 * (low + high)
        place = origin + unit * middle[:, None]
        above = place[:, 2] > surface_m(place[:, :2])
        low, high = np.where(above, middle, low), np.where(above, high, middle)
    measured: FloatArray = low  # origin_e is where the measured range counts from
    return measured


def made_planes(flight: Flight, found: Calibration) -> tuple[Plane, ...]:
    """Return both sides of each roof, and ground between roofs, with the returns that lie on them."""
    points = [flight.place(swath, found) for swath in flight.swaths]
    planes = []
    for i, (x, y, turn) in enumerate(ROOFS):
        along = np.array([math.cos(math.radians(turn)), math.sin(math.radians(turn))])
        for side, word in ((1.0, "a"), (-1.0, "b")):
            centre = np.array([x, y]) + side * along * HALF_M / 2
            normal = np.array([*(side * along * RISE), 1.0]) / math.hypot(RISE, 1.0)
            height = GROUND_M + 4.0 + RISE * HALF_M / 2
            planes.append(_plane(f"roof {i + 1}{word}", np.array([*centre, height]), normal, 3.0, points, "roof"))
        if i % 3 == 0:
            ground = np.array([x + 30.0, y + 22.0, GROUND_M])
            planes.append(_plane(f"ground {i + 1}", ground, np.array([0.0, 0.0, 1.0]), 3.0, points, "ground"))
    return tuple(plane for plane in planes if len(plane.patches) > 1)


def _plane(
    name: str, centre_t: FloatArray, normal_t: FloatArray, half_m: float, points: list[FloatArray], kind: str
) -> Plane:
    patches = []
    for index, place in enumerate(points):
        off = place - centre_t
        at = np.flatnonzero((np.abs(off[:, :2]) < half_m).all(axis=1) & (np.abs(off @ normal_t) < 0.15))
        if len(at) >= 6:
            patches.append(Patch(index, at))
    return Plane(name, centre_t, normal_t, tuple(patches), 0.02, kind=kind)


def made_outcome(returns: int = RETURNS) -> Outcome:
    """Return an outcome with control, a few outliers, a bad control point and trajectory corrections."""
    flight, found = made_flight(returns)
    random = np.random.default_rng(5)
    planes = list(made_planes(flight, found))
    ground = [i for i, plane in enumerate(planes) if plane.kind == "ground"]
    for i in ground:
        point = ControlPoint(f"K{i:02d}", planes[i].centre_t + np.array([0.4, -0.3, 0.0]), 0.01)
        planes[i] = replace(planes[i], control=(point,))
    ties = tuple(_tie(i, x, y, random) for i, (x, y, _) in enumerate(ROOFS[::4]))
    refused = Counter({"curved or rough": 41, "fewer than two strips": 28, "vegetation": 113, "too steep": 4})
    features = Features(tuple(planes), ties, refused)
    header = Header(
        "2026-11-21T10:15:00Z-ab12",
        dt.datetime(2026, 11, 21, 10, 15, tzinfo=dt.UTC),
        "combined",
        "VQ-780",
        "S2221234",
        "LN200-7",
        "HB-ABC/left/2026-03",
        (("flight-0412.mcap", "9f" * 32),),
        1.018,
        21540.0,
    )
    return Outcome(flight, features, _adjusted(flight, features, found, random), header)


def _tie(i: int, x: float, y: float, random: np.random.Generator) -> TiePoint:
    place = np.array([x, y, GROUND_M + 4.0 + RISE * HALF_M])
    sightings = tuple(
        Sighting(k, 100 * i, place + random.normal(0.0, 0.03, 3), np.diag([9e-4, 9e-4, 4e-4])) for k in (0, 2)
    )
    return TiePoint(f"ridge {i}", sightings, kind="ridge")


def _residuals(features: Features, random: np.random.Generator) -> tuple[Residuals, ...]:
    feature, swath, at = [], [], []
    for i, plane in enumerate(features.planes):
        for patch in plane.patches:
            feature.append(np.full(len(patch.at), i))
            swath.append(np.full(len(patch.at), patch.swath))
            at.append(patch.at)
    columns = [np.concatenate(parts) for parts in (feature, swath, at)]
    count = len(columns[0])
    sigma = np.full(count, 0.021)
    redundancy = np.clip(random.normal(0.97, 0.01, count), 0.6, 1.0)
    misclosure = random.normal(0.0, 1.0, count) * sigma * np.sqrt(redundancy)
    misclosure += 0.006 * (columns[1] == 3)
    weight = np.ones(count)
    wild = (columns[0] == 7) & (columns[1] == 2)
    misclosure[wild] += random.uniform(0.12, 0.5, int(wild.sum()))
    weight[wild] = 0.0
    normalised = misclosure / (sigma * np.sqrt(redundancy))
    planes = Residuals("planes", columns[0], columns[1], columns[2], misclosure, sigma, redundancy, normalised, weight)
    n = 3 * sum(len(tie.sightings) for tie in features.ties)
    of = np.repeat(np.arange(len(features.ties)), 6)
    seen = np.tile(np.repeat([0, 2], 3), len(features.ties))
    w = random.normal(0.0, 1.0, n)
    ties = Residuals(
        "ties", of, seen, np.zeros(n, np.int64), 0.03 * w, np.full(n, 0.03), np.full(n, 0.5), w, np.ones(n)
    )
    on = np.array([i for i, plane in enumerate(features.planes) if plane.control])
    w = random.normal(0.0, 1.0, len(on))
    w[-1] = 3.9
    minus, full = np.full(len(on), -1), np.full(len(on), 0.012)
    control = Residuals("control", on, minus, minus, 0.012 * w, full, np.full(len(on), 0.9), w, np.ones(len(on)))
    return planes, ties, control


def _adjusted(flight: Flight, features: Features, found: Calibration, random: np.random.Generator) -> Adjusted:
    residuals = _residuals(features, random)
    sigmas = np.array(SIGMAS)
    count = len(sigmas)
    correlation = np.eye(count)
    for (i, j), value in {
        (0, 3): 0.12,
        (1, 6): -0.954,
        (3, 4): -0.71,
        (3, 5): -0.29,
        (4, 5): 0.34,
        (0, 2): -0.04,
    }.items():
        correlation[i, j] = correlation[j, i] = value
    values = np.array([found.value(name) for name in ESTIMATED]) + 0.4 * sigmas
    full, corr = np.zeros(16), np.eye(16)
    at = [INDEX[name] for name in ESTIMATED]
    full[at] = sigmas
    corr[np.ix_(at, at)] = correlation
    calibration = replace(
        found.changed(**dict(zip(ESTIMATED, values, strict=True))), sigmas=full, correlation=corr, method="combined"
    )
    names = tuple(f"left.{name}" for name in ESTIMATED)
    held = (
        FixedParameter("left", "lever_arm_z_m",
             "raising the scanner and lowering the range offset look alike over flat ground",
             "control points seen at nadir and at the edges of two flying heights", 0.13, (("range_offset_m", -0.97),)),
        FixedParameter("left", "scan_plane_tilt_rad", "the tilt moves points along track, as pitch does",
             "a line at a second height, at least 1.7 times as high", math.inf, (("phi_rad", 0.999),)),
        FixedParameter("left", "lever_arm_x_m", "fixed at the user's word"),
        FixedParameter("left", "lever_arm_y_m", "fixed at the user's word"),
    )  # fmt: skip
    groups = tuple(
        GroupFit(
            one.group, len(one.weight), float(one.redundancy.sum()), 1.0 + 0.02 * i,
            float(np.sqrt(np.mean(one.misclosure_m[one.weight > 0.0] ** 2))), int((one.weight <= 0.0).sum()),
        )
        for i, one in enumerate(residuals)
    )  # fmt: skip
    fits = tuple(
        ControlFit(
            features.planes[i].name.replace("ground ", "K"),
            m,
            0.012,
            w,
            {"left.range_offset_m": 0.35 * w, "left.omega_rad": 0.1},
        )
        for i, m, w in zip(
            residuals[2].feature.tolist(),
            residuals[2].misclosure_m.tolist(),
            residuals[2].normalised.tolist(),
            strict=True,
        )
    )
    return Adjusted(
        {"left": calibration}, names, np.zeros(count), values, sigmas, np.full(count, np.inf), correlation, held,
        _trajectory_fit(flight, random), residuals, groups, fits, 1.018, 21540.0, 0.034, 5, 3, True,
        {"range_m": 0.087, "control": 0.04}, np.array([3e-4, 0.02, 0.4, 0.9, 1.2, 1.9, 2.6]),
        planes_e=_planes_e(flight, features, random),
    )  # fmt: skip


def _planes_e(flight: Flight, features: Features, random: np.random.Generator) -> FloatArray:
    """Return the adjusted planes: normals turned by a hundredth of a degree, distances changed by millimetres."""
    normals_e = np.array([plane.normal_t for plane in features.planes]) @ flight.frame.rot_t_from_e
    centres_e = flight.frame.e_from_t(np.array([plane.centre_t for plane in features.planes]))
    normals_e += random.normal(0.0, 2e-4, normals_e.shape)
    normals_e /= np.linalg.norm(normals_e, axis=1, keepdims=True)
    away = -np.einsum("ij,ij->i", normals_e, centres_e) + random.normal(0.0, 2e-3, len(normals_e))
    return np.column_stack([normals_e, away])


def _trajectory_fit(flight: Flight, random: np.random.Generator) -> TrajectoryFit:
    swaths = flight.swaths
    time_ns = np.concatenate([np.linspace(one.time_ns[0], one.time_ns[-1], 12).astype(np.int64) for one in swaths])
    strip = np.repeat([one.strip for one in swaths], 12)
    k = len(time_ns)
    walk = np.cumsum(random.normal(0.0, 0.3, (k, 6)), axis=0)
    walk -= walk.mean(axis=0)
    prior = np.tile([0.02, 0.02, 0.03, 5e-5, 5e-5, 1e-4], (k, 1))
    value, sigma = 0.5 * walk * prior, 0.45 * prior
    return TrajectoryFit(
        np.zeros(k, np.int64),
        time_ns,
        strip,
        value[:, :3],
        value[:, 3:],
        sigma[:, :3],
        sigma[:, 3:],
        prior[:, :3],
        prior[:, 3:],
    )


def made_report(outcome: Outcome) -> ReportInput:
    """Return the input of a report with everything that it may show."""
    random = np.random.default_rng(3)
    names = [swath.name for swath in outcome.flight.swaths]
    before, after = {}, {}
    for i, first in enumerate(names):
        for second in names[i + 1 :]:
            wide, narrow = random.uniform(0.4, 3.0), random.uniform(0.014, 0.026)
            before[first, second] = PairDifference(0.3 * wide, 0.954 * wide, wide, 4 * wide, 41_000)
            after[first, second] = PairDifference(0.004, math.sqrt(narrow**2 - 1.6e-5), narrow, 0.11, 41_000)
    grid = np.full((50, 60), np.nan)
    y, x = np.mgrid[0:50, 0:60]
    inside = ((x - 30) ** 2 / 900 + (y - 25) ** 2 / 500) < 1.0
    tilted = np.where(inside, 0.006 * (x - 30), grid)
    settled = np.where(inside, random.normal(0.0, 0.02, grid.shape), grid)
    wave = "M0 60 C40 10 80 110 120 60 S200 10 240 60"
    path = f"<path d='{wave}' fill='none' stroke='#0072b2'/>"
    svg = f"<svg xmlns='http://www.w3.org/2000/svg' viewBox='0 0 240 120'>{path}</svg>"
    return ReportInput(
        outcome.flight, outcome.features, outcome.adjusted, {"left": outcome.header}, before, after,
        DifferenceMap(-240.0, -200.0, 8.0, tilted, settled), None,
        [Profile("Roll from strips 01 and 02", "Separation 4.31 m over 1002 m: 0.2465°.", svg)],
        [("flight-0412.mcap", "9f" * 32), ("control.csv", "c4" * 32), ("left.nominal.toml", "07" * 32)],
        {"Swath": "0.1.0", "Model": "scanner", "Knots of the trajectory": "every 5 s", "Control": "12 points, 1 cm"},
        ["The trajectory comes from the log's own GNSS/INS, not post-processed."],
    )  # fmt: skip
