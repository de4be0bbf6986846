"""Tests rows of the design against georef's own columns and differences of the model."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from swath.calib.equations.rows import Rows
from swath.calib.equations.trajectory_prior import TrajectoryPrior
from swath.calib.features import Patch, Plane
from swath.calib.flight import Flight, Head, Swath
from swath.calib.parameters import ParameterOptions, Unknowns, unknowns
from swath.georef.arrays import FloatArray
from swath.georef.records import RETURN_DTYPE
from swath.georef.scanner.beams import Geometry, OusterGeometry, SpinningGeometry
from swath.georef.scanner.calibration import INDEX, Calibration, nominal
from swath.georef.scanner.jacobian import observation_columns_e, parameter_columns_e
from swath.georef.scanner.uncertainty import Noise
from tests.calib.builders import design, shifted
from tests.calib.roofs import LINES, START_NS, frame, made, trajectory

pytestmark = pytest.mark.xdist_group("kernels")

VALUES = {
    "omega_rad": 0.0044,
    "phi_rad": -0.007,
    "kappa_rad": 0.0106,
    "range_offset_m": 0.35,
    "range_scale": 4e-5,
    "scan_angle_offset_rad": 9e-4,
    "scan_angle_scale": 3e-4,
    "scan_plane_tilt_rad": 3.5e-4,
    "lever_arm_x_m": 0.15,
    "lever_arm_y_m": -0.08,
    "lever_arm_z_m": 0.42,
    "time_offset_s": 1.5e-4,
    "imu_latency_s": 2e-4,
    "encoder_latency_s": 1e-6,
    "torsion_s2": 2e-9,
    "pitch_slope": 2e-4,
}
SURE = Noise(1e-9, 1e-12, 0.0, 0.0)  # observations as adjusted are those as measured
RANGES_ONLY = Noise(0.4, 0.0, 0.0, 0.0)
EVERYTHING = ParameterOptions("full", free=frozenset(["scan_angle_offset_rad"]))


def line_flight() -> tuple[Flight, tuple[Plane, ...], Calibration]:
    """Return two lines over five planes, with every parameter set."""
    built = made(lines=LINES[:2], points=3, truth={}, noise=0.0)
    start = built.truth.changed(**VALUES)
    g = np.random.default_rng(1)
    head = replace(built.flight.heads[0], start=start, noise=Noise(0.02, 2e-5, 1e-4, 5e-4))
    swaths = tuple(
        replace(one, encoder_rate=g.normal(size=len(one)) * 70.0, encoder_acceleration=g.normal(size=len(one)) * 4e3)
        for one in built.flight.swaths
    )
    return replace(built.flight, heads=(head,), swaths=swaths), built.features.planes[:5], start


def test_columns_match_georef() -> None:
    flight, planes, start = line_flight()
    flight = replace(flight, heads=(replace(flight.heads[0], noise=SURE),))
    asked = unknowns(flight, EVERYTHING)
    rows = Rows(flight, planes, asked, None)
    found, misclosures, _, _ = design(rows, rows.start())
    wanted, wanted_f = [], []
    for batch in rows.batches:
        for run in batch.runs:
            swath = flight.swaths[run.swath]
            rays = flight.rays(swath, start, run.at)
            normal_e = planes[run.plane].normal_t @ flight.frame.rot_t_from_e
            columns = parameter_columns_e(rays, flight.heads[0].model(start), flight.trajectories[0])
            wanted.append(columns @ normal_e)
            away = flight.frame.t_from_e(rays.points_e) - planes[run.plane].centre_t
            wanted_f.append(away @ planes[run.plane].normal_t)
    order = [INDEX[name.removeprefix("left.")] for name in asked.names]
    expected = np.concatenate(wanted)[:, order]
    assert len(asked) == 16
    np.testing.assert_allclose(found / np.abs(expected).max(axis=0), expected / np.abs(expected).max(axis=0), atol=1e-9)
    np.testing.assert_allclose(misclosures, np.concatenate(wanted_f), atol=2e-8)


def test_variance_combines_the_eight_observations() -> None:
    flight, planes, start = line_flight()
    told = flight.trajectories[0]
    told = replace(told, position_sigma_l=np.full((len(told), 3), 0.03))
    flight = replace(flight, trajectories=(told,))
    rows = Rows(flight, planes, unknowns(flight, ParameterOptions()), None)
    _, _, found, _ = design(rows, rows.start())
    wanted, noise = [], flight.heads[0].noise
    for batch in rows.batches:
        for run in batch.runs:
            rays = flight.rays(flight.swaths[run.swath], start, run.at)
            normal_e = planes[run.plane].normal_t @ flight.frame.rot_t_from_e
            by = observation_columns_e(rays, flight.heads[0].model(start), told) @ normal_e
            poses = told.poses(rays.time_ns)
            beam = rays.points_e - rays.origin_e
            cosine = (beam @ normal_e) / np.linalg.norm(beam, axis=1)
            foot = noise.divergence_rad * rays.range_m * np.tan(np.arccos(np.abs(cosine))) / 4.0
            assert rays.epoch is not None
            way = told.position_e[rays.epoch + 1] - told.position_e[rays.epoch]
            speed = way @ normal_e / 0.01
            flown = (by[:, :3] ** 2).sum(axis=1) * 0.03**2 + ((by[:, 3:6] * poses.attitude_sigma_rad) ** 2).sum(axis=1)
            ranging = by[:, 6] ** 2 * noise.range_m**2 + cosine**2 * foot**2
            wanted.append(flown + ranging + (by[:, 7] * noise.angle_rad) ** 2 + (speed * noise.time_s) ** 2)
    np.testing.assert_allclose(found, np.concatenate(wanted), rtol=2e-6)


def spinning() -> SpinningGeometry:
    """Return a scanner with four beams in the manufacturer's frame."""
    table = np.array([[-15, -5, 5, 14], [1, -1, 2, -2], [0.01, 0.02, 0.0, 0.0], [0.02] * 4, [0.04] * 4, [0.01] * 4])
    return SpinningGeometry(*table)


def ouster() -> OusterGeometry:
    """Return an Ouster head with four beams."""
    turn = np.eye(4)
    turn[:3, :3], turn[:3, 3] = Rotation.from_euler("z", 180, degrees=True).as_matrix(), (0.0, 0.0, 0.036)
    return OusterGeometry(np.radians([-15.0, -5, 5, 14]), np.radians([3.0, -3, 3, -3]), (0.0158, 0.001), turn)


def head_flight(geometry: Geometry) -> Flight:
    """Return a flight of a spinning head low over planes."""
    g = np.random.default_rng(7)
    rows = np.zeros(160, RETURN_DTYPE)
    rows["range_m"], rows["encoder_rad"] = g.uniform(60, 90, 160), g.uniform(0, 2 * np.pi, 160)
    rows["channel"], rows["return_number"] = np.tile(np.arange(4), 40), np.repeat([1, 2], 80)
    rows["mta_zone"], rows["intensity"] = np.tile([0, 1], 80), g.uniform(-10, 120, 160)
    start = nominal("left", (0.3, 0.1, 0.2), Rotation.from_euler("x", 180, degrees=True).as_matrix())
    start = start.changed(omega_rad=0.01, phi_rad=-0.02, kappa_rad=0.015, range_offset_m=0.1)
    times = START_NS + 3_000_000_000 + np.sort(g.integers(0, 5_000_000_000, 160))
    swath = Swath("a", 0, 1, 0, rows, times, np.zeros((160, 3)))
    return Flight(frame(), (Head("left", start, geometry, SURE),), (trajectory(LINES[:1]),), (swath,))


@pytest.mark.parametrize("geometry", [spinning(), ouster()])
def test_columns_of_beams_slots_zones_and_intensities_match_differences_of_the_model(geometry: Geometry) -> None:
    flight = head_flight(geometry)
    options = ParameterOptions(
        ibrc_knots=(0.0, 20.0, 50.0, 100.0),
        beams=frozenset(["azimuth_rad", "elevation_rad", "range_m"]),
        range_offset_slots=(2,),
        range_offset_zones=(1,),
    )
    asked = unknowns(flight, options)
    g = np.random.default_rng(3)
    planes = tuple(
        Plane(f"{index}", np.array([0.0, 0.0, 1150.0]), normal / np.linalg.norm(normal), (Patch(0, at),))
        for index, normal in enumerate(g.normal(size=(2, 3)))
        for at in [np.arange(index, 160, 2)]
    )
    rows = Rows(flight, planes, asked, None)
    values = asked.start + g.normal(size=len(asked)) * 1e-3
    for knot, correction_m in ((0, -45.0), (1, -14.0), (3, 22.0)):  # so large that a step stays small beside them
        values[asked.names.index(f"left.ibrc.{knot}")] = correction_m
    state = replace(rows.start(), values=values)
    found, _, _, plane = design(rows, state)
    at = np.concatenate([run.at for batch in rows.batches for run in batch.runs])
    normals = np.array([planes[one].normal_t for one in plane])
    for column, name in enumerate(asked.names):
        step = 1e-4 if name.endswith("_rad") else 5e-3
        expected = (placed(flight, asked, state.values, column, step)[at] * normals).sum(axis=1)
        size = max(1.0, np.abs(expected).max())
        np.testing.assert_allclose(found[:, column] / size, expected / size, atol=1e-6, err_msg=name)
    assert {"left.beam.3.elevation_rad", "left.ibrc.0", "left.range_offset_slot.2"} <= set(asked.names)
    assert (np.abs(found).max(axis=0) > 0.0).all()


def placed(flight: Flight, asked: Unknowns, values: FloatArray, column: int, step: float) -> FloatArray:
    """Return (n, 3) ∂point/∂unknown by central differences."""
    moved = []
    for sign in (-1.0, 1.0):
        there = values.copy()
        there[column] += sign * step
        moved.append(flight.place(flight.swaths[0], asked.calibrations(there)["left"]))
    difference: FloatArray = (moved[1] - moved[0]) / (2.0 * step)
    return difference


def test_columns_of_the_trajectory_match_differences_of_the_model() -> None:
    flight, planes, start = line_flight()
    flight = replace(flight, heads=(replace(flight.heads[0], noise=SURE),), swaths=flight.swaths[:1])
    planes = tuple(replace(plane, patches=plane.patches[:1]) for plane in planes)
    times = START_NS + np.array([2, 5, 7, 12]) * 1_000_000_000
    prior = TrajectoryPrior(np.zeros(4, np.int64), times, np.ones(4, np.int64), np.eye(24))
    rows = Rows(flight, planes, unknowns(flight, ParameterOptions()), prior)
    g = np.random.default_rng(2)
    knots = g.normal(size=(4, 6)) * np.array([0.05, 0.05, 0.05, 1e-5, 1e-5, 1e-5])
    state = replace(rows.start(), knots=knots)
    found, misclosures, _, plane = design(rows, state)
    at = np.concatenate([run.at for batch in rows.batches for run in batch.runs])
    normals = np.array([planes[one].normal_t for one in plane])
    centres = np.array([planes[one].centre_t for one in plane])

    def f(errors_e: FloatArray) -> FloatArray:
        moved = replace(flight, trajectories=(shifted(flight.trajectories[0], prior, errors_e),))
        away: FloatArray = ((moved.place(moved.swaths[0], start, at) - centres) * normals).sum(axis=1)
        return away

    np.testing.assert_allclose(misclosures, f(knots), atol=2e-6)
    for knot in range(4):
        for axis, step in enumerate([1e-2] * 3 + [1e-6] * 3):
            error = np.zeros((4, 6))
            error[knot, axis] = step
            expected = (f(error) - f(-error)) / (2 * step)
            column = found[:, len(rows.unknowns) + 6 * knot + axis]
            np.testing.assert_allclose(column, expected, atol=1e-4 * max(1.0, np.abs(expected).max()))


def test_attitude_error_between_knots_is_common_to_a_run() -> None:
    """The rows of a run count like their mean, with the variance M / n + c.

    c is the variance of a bridge between the run's knots; n is the number of rows that the selected rows stand for:
    some are left out, and the others stand for four each.
    """
    flight, planes, _ = line_flight()
    flight = replace(flight, swaths=flight.swaths[:1])
    planes = tuple(replace(plane, patches=plane.patches[:1]) for plane in planes)
    times, walk = START_NS + np.array([16, 21, 70, 120]) * 100_000_000, (2e-4) ** 2
    prior = TrajectoryPrior(np.zeros(4, np.int64), times, np.ones(4, np.int64), np.eye(24))
    seen = Rows(flight, planes, unknowns(flight, ParameterOptions()), replace(prior, walk_rad2=np.full(4, walk)))
    found = seen.summed(seen.start(), np.ones(seen.count, np.float32), 0.0)
    weight = np.where(np.arange(seen.count) % 3 > 0, 4.0, 0.0).astype(np.float32)
    expected, rest, grown = np.zeros((4, 4)), np.zeros((4, 4)), []
    for batch, looks in seen.looks(seen.start()):
        begin = 0
        for run in batch.runs:
            mine = slice(begin, begin + len(run.at))
            begin = mine.stop
            columns, kept = looks.design[mine, :4], weight[batch.begin + mine.start : batch.begin + mine.stop]
            states = looks.design[mine, 4:12]
            lever = states[:, 2:5] + states[:, 5:8]  # metres per radian about each axis, divided between both knots
            share = states[:, 1]
            common = share * (1.0 - share) * walk * (lever**2).sum(axis=1)
            variance = looks.variance[mine] + len(run.at) * common
            expected += columns.T @ (columns / variance[:, np.newaxis])
            rest += columns.T @ (columns * (kept / (looks.variance[mine] + kept.sum() * common))[:, np.newaxis])
            grown.append(variance.mean() / looks.variance[mine].mean())
    np.testing.assert_allclose(found.normal[:4, :4], expected, rtol=1e-9)
    assert max(grown) > 2.0
    np.testing.assert_allclose(seen.summed(seen.start(), weight, 0.0).normal[:4, :4], rest, rtol=1e-9)
    free = Rows(flight, planes, unknowns(flight, ParameterOptions()), prior).summed(
        seen.start(), np.ones(seen.count, np.float32), 0.0
    )
    assert np.diag(free.normal)[3] > 1.2 * np.diag(found.normal)[3]


def looks_of(flight: Flight, planes: tuple[Plane, ...], options: ParameterOptions) -> tuple[FloatArray, FloatArray]:
    """Return columns (n, u) of the parameters and the plane's turns, and f (n,), of a swath's returns on one plane."""
    seen = Rows(flight, planes, unknowns(flight, options), None)
    ((batch, looks),) = seen.looks(seen.start())
    (run,) = batch.runs
    assert run.channel == -1
    return looks.design[:, : len(seen.unknowns) + 2], looks.misclosure


@pytest.mark.parametrize(
    ("name", "noise", "errors", "tolerance"),
    [("range_m", RANGES_ONLY, 1.2, 2e-6), ("encoder_rad", Noise(1e-9, 4e-4, 0.0, 0.0), 1e-3, 2e-4)],
)
def test_rows_use_the_adjusted_observations(name: str, noise: Noise, errors: float, tolerance: float) -> None:
    """If only ranges or only angles err, the adjusted observations and all coefficients are the true ones."""
    normal = np.array([0.5, -0.3, 0.81])
    planes = [(np.array([150.0, 0.0, 400.0]), normal / np.linalg.norm(normal))]
    still = trajectory(LINES[:1])
    still = replace(still, position_sigma_l=np.zeros((len(still), 3)), attitude_sigma_rad=np.zeros((len(still), 3)))
    built = made(lines=LINES[:1], planes=planes, points=500, noise=0.0)
    count = len(built.flight.swaths[0])
    turning = np.full(count, 70.0)
    swath = replace(built.flight.swaths[0], encoder_rate=turning, encoder_acceleration=50.0 * turning)
    head = replace(built.flight.heads[0], noise=noise, start=built.truth.changed(scan_angle_scale=3e-4))
    found = []
    for size in (0.0, errors):
        rows = swath.rows.copy()
        rows[name] += size * np.random.default_rng(1).uniform(-1.0, 1.0, count)
        flight = replace(built.flight, heads=(head,), trajectories=(still,), swaths=(replace(swath, rows=rows),))
        found.append(looks_of(flight, built.features.planes, EVERYTHING))
    (true, flat), (adjusted, misclosure) = found
    assert np.abs(misclosure - flat).max() > 0.1
    size_of = np.abs(true).max(axis=0)
    np.testing.assert_allclose(adjusted / size_of, true / size_of, atol=tolerance)
