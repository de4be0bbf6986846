"""Tests which parameters are determined, by the table of FORMULAS 5.5 and normal matrices made by hand."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest

from swath.calib.equations.observability import RULES, Rules, decide, kind_of, spectrum
from swath.calib.outcome import FixedParameter
from swath.georef.arrays import FloatArray, Int64Array
from swath.georef.geodesy.earth import e_from_geodetic, rot_e_from_l
from swath.georef.geodesy.rotations import quaternion_from_rot, rot_l_from_b
from swath.georef.records import RETURN_DTYPE
from swath.georef.scanner.beams import LineGeometry
from swath.georef.scanner.calibration import INDEX, PARAMETERS, nominal
from swath.georef.scanner.jacobian import observation_columns_e, parameter_columns_e
from swath.georef.scanner.sensor_model import SensorModel
from swath.georef.trajectory.trajectory import Trajectory

pytestmark = pytest.mark.xdist_group("kernels")

SECOND, BEGIN = 10**9, 1_400_000_000 * 10**9
LEVER_ARM = np.array([0.15, -0.08, 0.42])
SPEED_MPS, HALF_ANGLE = 60.0, np.radians(30.0)
POSITION_SIGMA = np.array([0.03, 0.03, 0.05])
OTHER_SIGMA = np.array([*np.radians([0.003, 0.003, 0.007]), 0.02, np.radians(0.001)])  # roll, pitch, heading, ρ, θ

# heading, height, offset to the right of the middle
OPPOSITE = [(0.0, 800.0, 0.0), (np.pi, 800.0, 0.0)]
PARALLEL = [*OPPOSITE, (0.0, 800.0, 250.0), (0.0, 800.0, -250.0)]
ONE_HEIGHT = [*PARALLEL, (np.pi / 2, 800.0, 0.0), (3 * np.pi / 2, 800.0, 0.0)]
TWO_HEIGHTS = [*ONE_HEIGHT, (0.0, 1500.0, 0.0), (np.pi / 2, 1500.0, 0.0)]
DESIGNS = {
    "one line": OPPOSITE[:1],
    "opposite": OPPOSITE,
    "one height": ONE_HEIGHT,
    "two heights": TWO_HEIGHTS,
}
BASIC = ("omega_rad", "phi_rad", "kappa_rad", "range_offset_m")
ARC = float(np.radians(1 / 3600))
ANGLES = dict.fromkeys(("omega_rad", "phi_rad", "kappa_rad"), ARC)


def planes(roofs: bool) -> list[tuple[FloatArray, FloatArray]]:
    """Return 25 planes, 125 m apart: centre and normal, north, east, down; of roofs every fifth is flat."""
    made = []
    for index, (north, east) in enumerate((n, e) for n in np.linspace(-250, 250, 5) for e in np.linspace(-250, 250, 5)):
        azimuth, slope = index % 4 * np.pi / 2 + 0.3, np.radians(35.0 if roofs and index % 5 else 0.0)
        level = np.sin(slope) * np.array([np.cos(azimuth), np.sin(azimuth)])
        made.append((np.array([north, east, 0.0]), np.array([*level, -np.cos(slope)])))
    return made


@cache
def design(name: str, roofs: bool) -> tuple[FloatArray, FloatArray, Int64Array, FloatArray]:
    """Return rows of all returns that hit: normal · columns (n, 16), variance (n,), plane (n,), place on it (n, 3)."""
    rng = np.random.default_rng(3)
    targets, poses, normals, plane_of, places = [], [], [], [], []
    for index, (centre, normal) in enumerate(planes(roofs)):
        first = np.cross(normal, [1.0, 0.0, 0.0])
        first /= np.linalg.norm(first)
        second = np.cross(normal, first)
        for heading, height, offset in DESIGNS[name]:
            for _ in range(12):
                a, b = rng.uniform(-6, 6), rng.uniform(-6, 6)
                targets.append(centre + a * first + b * second)
                poses.append([heading, height, offset, *rng.normal(0.0, np.radians(1.0), 2)])
                normals.append(normal)
                plane_of.append(index)
                places.append([a, b, 1.0])
    position, rot, range_m, angle = aimed(np.array(targets), np.array(poses))
    hit = np.abs(angle) <= HALF_ANGLE
    columns, variance = rows(position[hit], rot[hit], range_m[hit], angle[hit], np.array(normals)[hit])
    return columns, variance, np.array(plane_of)[hit], np.array(places)[hit]


def aimed(targets: FloatArray, poses: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return position and rotation of the body when its beam met the target, range and angle, (n, …) each.

    Newton's method solves the three equations.
    """
    heading, height, offset, roll, pitch = poses.T
    rot = rot_l_from_b(roll, pitch, heading)
    along = np.stack([np.cos(heading), np.sin(heading), 0 * heading], axis=1)
    across = np.stack([-np.sin(heading), np.cos(heading), 0 * heading], axis=1)
    at, angle, range_m = np.sum(targets * along, axis=1), 0.0 * height, height.copy()
    for _ in range(20):
        position = along * at[:, None] + across * offset[:, None]
        position[:, 2] = -height
        beam, turned = np.zeros((2, len(at), 3))
        beam[:, 1], beam[:, 2] = np.sin(angle), np.cos(angle)
        turned[:, 1], turned[:, 2] = np.cos(angle), -np.sin(angle)
        met = position + np.einsum("nij,nj->ni", rot, LEVER_ARM + range_m[:, None] * beam)
        sides = [along, np.einsum("nij,nj->ni", rot, range_m[:, None] * turned), np.einsum("nij,nj->ni", rot, beam)]
        step = np.linalg.solve(np.stack(sides, axis=2), (targets - met)[..., None])[..., 0]
        at, angle, range_m = at + step[:, 0], angle + step[:, 1], range_m + step[:, 2]
    assert np.abs(step).max() < 1e-9
    return position, rot, range_m, angle


def rows(
    position: FloatArray, rot: FloatArray, range_m: FloatArray, angle: FloatArray, normals: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return georef's columns of shots in a flat local frame, each between two epochs of its own."""
    count, rot_e_l = len(angle), rot_e_from_l(np.radians(47.0), np.radians(9.0))
    origin = e_from_geodetic(np.radians(47.0), np.radians(9.0), 0.0)
    shot_ns = BEGIN + np.arange(count) * SECOND
    way = rot[:, :, 0] * SPEED_MPS * 1e-3
    way[:, 2] = 0.0
    way *= SPEED_MPS * 1e-3 / np.linalg.norm(way, axis=1, keepdims=True)
    ends = np.stack([position - way, position + way], axis=1).reshape(-1, 3)
    unsaid = np.full((2 * count, 3), np.nan)
    path = Trajectory(
        np.stack([shot_ns - 10**6, shot_ns + 10**6], axis=1).ravel(),
        origin + ends @ rot_e_l.T,
        quaternion_from_rot(rot_e_l @ np.repeat(rot, 2, axis=0)),
        unsaid,
        unsaid,
        unsaid,
        max_gap_ns=3 * 10**6,
    )
    model = SensorModel(nominal("left", LEVER_ARM, np.eye(3)), LineGeometry())
    returns = np.zeros(count, RETURN_DTYPE)
    returns["range_m"], returns["encoder_rad"] = range_m, angle
    rays = model.rays(returns, shot_ns, path, with_axes=True)
    normals_e = normals @ rot_e_l.T
    by_parameter = np.einsum("nka,na->nk", parameter_columns_e(rays, model, path), normals_e)
    by_observation = np.einsum("nka,na->nk", observation_columns_e(rays, model, path)[:, 3:], normals_e)
    variance = (normals * POSITION_SIGMA) ** 2 @ np.ones(3) + (by_observation * OTHER_SIGMA) ** 2 @ np.ones(5)
    return by_parameter, variance


def reduced(name: str, roofs: bool, names: tuple[str, ...]) -> FloatArray:
    """Return the normal matrix of some parameters with all planes eliminated (FORMULAS 6.4)."""
    columns, variance, plane_of, places = design(name, roofs)
    chosen = columns[:, [INDEX[parameter] for parameter in names]] / np.sqrt(variance)[:, None]
    places = places / np.sqrt(variance)[:, None]
    normal = np.zeros((len(names), len(names)))
    for plane in np.unique(plane_of):
        mine = plane_of == plane
        own, a = places[mine], chosen[mine]
        normal += a.T @ (a - own @ np.linalg.lstsq(own, a, rcond=None)[0])
    return normal


def held_by(*given: Any) -> tuple[FixedParameter, ...]:
    """Return the parameters that `decide` holds."""
    return decide(*given)[0]


TABLE = [  # row, lines, roofs, what is added, printed sigmas (unit, print's last digit), printed correlations, held
    ("A", "one line", True, (), {"omega_rad": (811, 1), "phi_rad": (63, 1), "kappa_rad": (139, 1),
     "range_offset_m": (0.61, 0.01)}, {}, {"range_offset_m"}),
    ("B", "opposite", False, (), {"omega_rad": (2.8, 0.1), "phi_rad": (35, 1), "kappa_rad": (162, 1),
     "range_offset_m": (12.6, 0.1)}, {}, {"range_offset_m"}),
    ("C", "opposite", True, (), {"omega_rad": (1.5, 0.1), "phi_rad": (1.7, 0.1), "kappa_rad": (89, 1),
     "range_offset_m": (0.42, 0.01)}, {}, set()),
    ("D", "one height", True, (), {"omega_rad": (0.9, 0.1), "phi_rad": (1.0, 0.1), "kappa_rad": (4.6, 0.1),
     "range_offset_m": (0.018, 0.001)}, {}, set()),
    ("E", "one height", True, ("lever_arm_x_m", "lever_arm_y_m"), {},
     {("phi_rad", "lever_arm_x_m"): -1.000, ("omega_rad", "lever_arm_y_m"): 0.85}, {"lever_arm_x_m"}),
    ("F", "two heights", True, ("lever_arm_x_m", "lever_arm_y_m"), {"lever_arm_x_m": (0.012, 0.001)},
     {("phi_rad", "lever_arm_x_m"): -0.955, ("omega_rad", "lever_arm_y_m"): 0.85}, set()),
    ("G", "two heights", True, ("scan_angle_scale", "scan_plane_tilt_rad"), {},
     {("phi_rad", "scan_plane_tilt_rad"): 1.000, ("range_offset_m", "scan_angle_scale"): -0.93},
     set()),
    ("H", "two heights", True, ("lever_arm_z_m",), {"lever_arm_z_m": (0.13, 0.01)}, {}, set()),
    ("I", "two heights", True, ("range_scale",), {"range_scale": (5e-6, 1e-6)},
     {("range_offset_m", "range_scale"): -0.29}, set()),
    ("J", "two heights", True, ("scan_angle_offset_rad",), {}, {}, {"scan_angle_offset_rad"}),
    ("K", "one height", True, ("time_offset_s",), {}, {("phi_rad", "time_offset_s"): -0.999}, set()),
    ("L", "two heights", True, ("time_offset_s",), {"time_offset_s": (2e-4, 1e-4)},
     {("phi_rad", "time_offset_s"): -0.954}, set()),
    ("M", "two heights", True, ("pitch_slope",), {}, {("kappa_rad", "pitch_slope"): 1.000}, set()),
    ("N", "two heights", True, ("lever_arm_x_m", "time_offset_s"), {},
     {("lever_arm_x_m", "time_offset_s"): -0.989}, set()),
]  # fmt: skip


@pytest.mark.parametrize(
    ("lines", "roofs", "added", "sigmas", "correlations", "held"),
    [row[1:] for row in TABLE],
    ids=[row[0] for row in TABLE],
)
def test_printed_table_of_designs_is_reproduced(
    lines: str,
    roofs: bool,
    added: tuple[str, ...],
    sigmas: dict[str, tuple[float, float]],
    correlations: dict[tuple[str, str], float],
    held: set[str],
) -> None:
    """The sigmas and correlations agree to their last printed digit, with georef's Jacobian."""
    names = (*BASIC, *added)
    normal = reduced(lines, roofs, names)
    told = held_by(normal, [f"left.{name}" for name in names])
    assert {one.name for one in told} == held
    if "scan_angle_offset_rad" in added:
        assert spectrum(normal)[0] < 1e-12
        return
    covariance = np.linalg.inv(normal)
    found = dict(zip(names, np.sqrt(np.diag(covariance)), strict=True))
    for name, (printed, digit) in sigmas.items():
        assert found[name] / ANGLES.get(name, 1.0) == pytest.approx(printed, abs=0.51 * digit), name
    for (one, other), printed in correlations.items():
        rho = covariance[names.index(one), names.index(other)] / (found[one] * found[other])
        digits = 3 if abs(printed) > 0.94 else 2
        assert abs(rho - printed) <= 0.51 * 10.0**-digits, (one, other, rho)


def held_of(lines: str, roofs: bool, *added: str) -> dict[str, FixedParameter]:
    names = [f"left.{name}" for name in (*BASIC, *added)]
    return {held.name: held for held in held_by(reduced(lines, roofs, (*BASIC, *added)), names)}


def test_opposite_lines_over_flat_ground_do_not_determine_the_range_offset() -> None:
    """The reason is given in plain words with the control that would help; an angle's poor sigma does not hold it."""
    held = held_of("opposite", False)
    assert set(held) == {"range_offset_m"}
    assert held["range_offset_m"].why.startswith(
        "this flight would estimate it to 12.54\u00a0m, and its initial value is plausible to 20.0\u00a0cm: "
        "it lowers all points"
    )
    assert "at least 8 points at 1 cm" in held["range_offset_m"].remedy
    assert held["range_offset_m"].sigma == pytest.approx(12.6, rel=0.03)


def test_inseparable_parameters_are_reported_with_their_remedy() -> None:
    one = held_of("one height", True, "lever_arm_x_m")["lever_arm_x_m"]
    assert one.scanner == "left"
    assert one.with_others[0][0] == "left.phi_rad"
    assert one.with_others[0][1] == pytest.approx(-1.0, abs=1e-3)
    assert one.why.startswith("this flight cannot separate it from left.phi_rad (correlation -1.000)")
    assert "second height, at least 1.7 times" in one.remedy
    angle = held_of("two heights", True, "scan_angle_offset_rad")["scan_angle_offset_rad"]
    assert "the same rotation" in angle.remedy
    assert angle.with_others[0][0] == "left.omega_rad"
    assert angle.with_others[0][1] == pytest.approx(-1.0, abs=1e-6)


def test_the_whole_model_determines_the_boresight() -> None:
    """All sixteen parameters are judged at once, over two heights.

    Rank defects are held, and parameters that look alike share the plausible error.
    """
    names = tuple(parameter.name for parameter in PARAMETERS)
    normal = reduced("two heights", True, names)
    found, weak = decide(normal, [f"a.{name}" for name in names])
    held = {one.name for one in found}
    assert held == {"scan_angle_offset_rad", "imu_latency_s", "encoder_latency_s", "torsion_s2"}  # nothing turned
    assert {"a.pitch_slope", "a.lever_arm_z_m", "a.lever_arm_x_m"} <= weak.keys()
    assert not weak.keys() & {f"a.{name}" for name in BASIC[:3]}
    free = [index for index, name in enumerate(names) if name not in held]
    prior = np.array([weak.get(f"a.{names[index]}", np.inf) for index in free]) ** -2.0
    sigma = np.sqrt(np.diag(np.linalg.inv(normal[np.ix_(free, free)] + np.diag(prior))))
    assert (sigma <= [RULES[names[index]].plausible for index in free]).all()


# ---------------------------------------------------------------------- by hand


def information(covariance: FloatArray, names: list[str]) -> FloatArray:
    """Return the normal matrix of a covariance given in units of plausible sigmas."""
    plausible = np.array([RULES[kind_of(name)].plausible for name in names])
    return np.asarray(np.linalg.inv(covariance * np.outer(plausible, plausible)), dtype=np.float64)


def test_a_parameter_with_a_prior_is_not_held() -> None:
    """The flight does not determine the lever arm: with a prior it is estimated, without one it is held."""
    names = ["left.phi_rad", "left.lever_arm_x_m"]
    normal = information(np.diag([1e-4, 1e4]), names)
    assert [held.name for held in held_by(normal, names)] == ["lever_arm_x_m"]
    assert held_by(normal, names, np.array([np.inf, 0.001])) == ()
    assert decide(np.zeros((1, 1)), names[1:], np.array([1.0])) == ((), {})


def test_a_held_parameter_is_reported_with_its_plausible_error() -> None:
    names = ["left.kappa_rad", "left.pitch_slope"]
    (heading,) = held_by(information(np.diag([17.0**2, 0.1**2]), names), names)
    assert heading.sigma == pytest.approx(17.0 * RULES["kappa_rad"].plausible, rel=1e-3)
    assert heading.why.startswith("this flight would estimate it to 17°, and its initial value is plausible to 1.0°")


def test_an_eigenvalue_made_negative_by_rounding_is_not_information() -> None:
    names = ["left.omega_rad", "left.scan_angle_offset_rad"]
    normal = 1e6 * np.array([[1.0, 1.0 + 1e-9], [1.0 + 1e-9, 1.0]]) / RULES["scan_angle_offset_rad"].plausible ** 2
    held = held_by(normal, names)
    assert [one.name for one in held] == ["scan_angle_offset_rad"]
    assert np.isinf(held[0].sigma) or held[0].sigma > 30 * RULES["scan_angle_offset_rad"].plausible


def test_parameters_without_any_information_are_reported() -> None:
    names = ["left.omega_rad", "left.torsion_s2", "left.beam.12.azimuth_rad"]
    normal = np.diag([1e14, 0.0, 0.0])
    held = held_by(normal, names)
    assert [(one.scanner, one.name) for one in held] == [("left", "torsion_s2"), ("left", "beam.12.azimuth_rad")]
    assert all(one.why.startswith("nothing in this flight shows it") for one in held)
    assert all(np.isinf(one.sigma) for one in held)
    assert decide(np.zeros((0, 0)), []) == ((), {})


def test_limits_of_plausibility_are_given_by_the_caller() -> None:
    """The same matrix is decided differently if the plausible error of the start is halved."""
    names = ["left.omega_rad", "left.phi_rad"]
    normal = information(np.array([[4.0, 0.0], [0.0, 0.1]]), names)
    assert held_by(normal, names) == ()
    table = {**RULES, "omega_rad": type(RULES["omega_rad"])(0.5 * RULES["omega_rad"].plausible, "", "")}
    assert [held.name for held in held_by(normal, names, None, Rules(table))] == ["omega_rad"]


def test_partly_determined_parameters_are_estimated_with_their_start_as_observation() -> None:
    """Held, one of them would transfer its plausible error to the other."""
    names = ["left.range_offset_m", "left.scan_angle_scale"]
    alike = np.array([[1.0, 0.999], [0.999, 1.0]])
    held, weak = decide(information(25.0 * alike, names), names)
    assert held == ()
    assert weak == {name: RULES[kind_of(name)].plausible for name in names}
    assert decide(information(1e-4 * alike, names), names) == ((), {})


def test_heads_with_a_common_trajectory_keep_their_own_parameters() -> None:
    """The two offsets are known to 1 mm relative to each other and to 1 cm absolutely (correlation 0.995)."""
    names = ("left.range_offset_m", "right.range_offset_m")
    normal: FloatArray = np.linalg.inv(1e-4 * np.array([[1.0, 0.995], [0.995, 1.0]])).astype(np.float64)
    assert held_by(normal, names) == ()
    (held,) = held_by(1e-6 * normal[:1, :1], names[:1])
    assert held.with_others == ()
