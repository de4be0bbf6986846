"""Tests beams of every type of scanner: the numbers of FORMULAS 2.2, and impossible calibrations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from swath.drivers.scanner.beams import beam_points
from swath.drivers.scanner.velodyne.heads import VLP16
from swath.georef.arrays import FloatArray
from swath.georef.scanner.beams import (
    FibreGeometry,
    Geometry,
    GeometryError,
    LineGeometry,
    NutatingGeometry,
    OusterGeometry,
    RisleyGeometry,
    SpinningGeometry,
    line_scanner,
    read_fibres,
)
from swath.georef.scanner.calibration import BeamCorrection, Calibration, nominal
from swath.georef.scanner.sensor_model import SensorModel
from tests.georef.scanner_cases import rows_of, still_trajectory

pytestmark = pytest.mark.xdist_group("kernels")

NOMINAL = nominal("left", [0.0, 0.0, 0.0], np.eye(3))


def points_s(
    geometry: Geometry, angle_rad: object, range_m: object = 1.0, calibration: Calibration = NOMINAL, **columns: object
) -> FloatArray:
    """Return points (n, 3), m, in s, of a scanner whose axes are those of e."""
    rows = rows_of(angle_rad, range_m, **columns)
    rays = SensorModel(calibration, geometry).rays(rows, np.full(len(rows), 5), still_trajectory())
    assert not rays.fate.any()
    return rays.points_e


def spinning(**columns: object) -> SpinningGeometry:
    """Return the geometry of a head with one beam; omitted values are zero."""
    names = ("elevation_deg", "azimuth_deg", "range_m", "right_m", "forward_m", "up_m")
    return SpinningGeometry(*(np.atleast_1d(np.asarray(columns.get(name, 0.0), np.float64)) for name in names))


def tilted(geometry: Geometry, theta: float, tilt: float) -> float:
    """Return ∂u_x / ∂tilt, the change of the beam's x component per radian of facet tilt."""
    calibration = replace(NOMINAL, facet_tilt_rad={0: tilt})
    return float(points_s(geometry, theta, calibration=calibration)[0, 0] / tilt)


def test_line_beam_follows_its_cone() -> None:
    theta, eta = np.radians(15.0), np.radians(0.5)
    flat = points_s(LineGeometry(), theta)[0]
    assert np.degrees(np.arctan2(flat[1], flat[2])) == pytest.approx(15.0, abs=1e-12)  # galvo at 7.5°
    cone = points_s(LineGeometry(), theta, calibration=NOMINAL.changed(scan_plane_tilt_rad=eta))[0]
    assert cone[0] == pytest.approx(-0.00872653549837, abs=1e-14)
    assert cone == pytest.approx([-np.sin(eta), np.sin(theta) * np.cos(eta), np.cos(theta) * np.cos(eta)], abs=1e-15)


@pytest.mark.parametrize(("shaft_deg", "printed"), [(0.0, 1.4142136), (7.5, 1.5867067), (-15.0, 0.99999999)])
def test_facet_tilt_turns_the_beam_by_twice_the_cosine_of_incidence(shaft_deg: float, printed: float) -> None:
    assert tilted(LineGeometry(4), 2 * np.radians(shaft_deg), 1e-4) == pytest.approx(printed, abs=1e-7)


def test_mirror_tilt_is_a_pitch_and_a_pitch_slope() -> None:
    polygon, step = LineGeometry(4), 1e-4
    assert tilted(polygon, 0.0, 1e-6) == pytest.approx(1.41421356, abs=1e-8)
    slope = (tilted(polygon, step, 1e-6) - tilted(polygon, -step, 1e-6)) / (2 * step)
    assert slope == pytest.approx(0.707106781, abs=1e-8)


def test_each_facet_has_its_own_tilt() -> None:
    tilts = {0: 0.001, 2: -0.002}
    points = points_s(
        LineGeometry(3), np.zeros(3), calibration=replace(NOMINAL, facet_tilt_rad=tilts), channel=[0, 1, 2]
    )
    assert points[:, 0] == pytest.approx(np.sqrt(2) * np.array([0.001, 0.0, -0.002]), rel=1e-5, abs=1e-12)


def test_palmer_scan_follows_its_formula() -> None:
    points = points_s(NutatingGeometry(np.radians(3.5)), np.radians([0.0, 90.0, 180.0, 270.0]))
    x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
    assert x[[0, 2]] == pytest.approx([0.1227845609, -0.1227845609], abs=1e-10)  # tan 2ψ, forward first
    assert y[[1, 3]] == pytest.approx([0.08649700693, -0.08649700693], abs=1e-11)  # right at a quarter turn
    assert x[1] == pytest.approx(0.003740866104, abs=1e-12)


def test_palmer_scan_with_another_shaft_angle_follows_its_formula() -> None:
    """In the middle of the scan, the laser's beam is turned by π − 2β."""
    points = points_s(NutatingGeometry(1e-12, np.radians(40.0)), 0.0)
    assert points[0] == pytest.approx([-np.cos(np.radians(80.0)), 0.0, np.sin(np.radians(80.0))], abs=1e-11)


def test_risley_pair_follows_its_formula() -> None:
    wedge = np.radians(10.0)
    single = points_s(RisleyGeometry((wedge, 1e-12), 1.51), 0.0)[0]
    assert np.degrees(np.arctan2(-single[0], single[2])) == pytest.approx(5.201161908, abs=1e-8)  # toward the thick end
    pair = points_s(RisleyGeometry((wedge, wedge), 1.51, prism_ratio=2.5), np.radians(30.0))[0]
    assert pair[:2] / pair[2] == pytest.approx([-0.1038005615, -0.1361184971], abs=1e-10)
    assert np.linalg.norm(pair) == pytest.approx(1.0, abs=1e-14)


def test_risley_counts_whole_turns() -> None:
    geometry = RisleyGeometry((0.2, 0.2), 1.51)
    turns = 2 * np.pi * np.array([0.0, 1.0, 128.0])
    points = points_s(geometry, 0.4 + turns)
    assert points[2] == pytest.approx(points[0], abs=1e-11)
    assert np.linalg.norm(points[1] - points[0]) > 0.05


def test_risley_wedges_with_total_reflection_are_refused() -> None:
    with pytest.raises(GeometryError, match=r"geometry.wedge_deg: got \[30, 30\], want smaller angles"):
        RisleyGeometry((np.radians(30.0), np.radians(30.0)), 1.51)
    RisleyGeometry((np.radians(20.0), np.radians(20.0)), 1.51)


def test_velodyne_beams_follow_the_formulas() -> None:
    azimuth = np.radians(123.0)
    plain = points_s(spinning(elevation_deg=-9.0), azimuth, 50.0)[0]
    assert plain == pytest.approx([41.417257078, -26.8966812359, -7.82172325201], abs=1e-9)
    elevation, up = np.radians(-9.0), 0.2
    table = spinning(
        elevation_deg=-9.0,
        azimuth_deg=-1.2,
        range_m=0.05,
        right_m=-0.026,
        forward_m=-up * np.sin(elevation),
        up_m=up * np.cos(elevation),
    )
    assert points_s(table, azimuth, 50.0)[0] == pytest.approx([42.053718, -26.043818, -7.632007], abs=1e-6)


def test_beams_of_a_driver_are_used() -> None:
    table, rng = VLP16.beams, np.random.default_rng(2)
    geometry = SpinningGeometry(**vars(table))
    angle, ranges, channel = rng.uniform(0, 2 * np.pi, 200), rng.uniform(1, 100, 200), rng.integers(0, 16, 200)
    rows = rows_of(angle, ranges, channel=channel)
    assert points_s(geometry, angle, ranges, channel=channel) == pytest.approx(beam_points(rows, table), abs=1e-12)


def test_ouster_beams_follow_the_formula() -> None:
    geometry = OusterGeometry(np.radians([-9.0]), np.radians([3.2]), (0.015806, 0.0), np.eye(4))
    encoder = 2 * np.pi * (1 - 22528 / 90112)
    printed = [-2.75584102986, -49.3076340178, -7.81925064886]
    assert points_s(geometry, encoder, 50.0)[0] == pytest.approx(printed, abs=1e-9)
    lidar_to_sensor = np.eye(4)
    lidar_to_sensor[:3, :3], lidar_to_sensor[2, 3] = np.diag([-1.0, -1.0, 1.0]), 0.03618
    turned = replace(geometry, sensor_from_lidar=lidar_to_sensor)
    want = [-printed[0], -printed[1], printed[2] + 0.03618]
    assert points_s(turned, encoder, 50.0)[0] == pytest.approx(want, abs=1e-9)


def test_fibres_follow_the_mirror_that_lights_them() -> None:
    geometry = read_fibres("across_deg,along_deg\n-10, 0\n0, 0.5\n\n10, 0\n20, -1\n", "fibres.csv")
    assert isinstance(geometry, FibreGeometry)
    points = points_s(geometry, 2 * np.pi / 4 * np.array([0.1, 1.0, 1.9, 2.9, 4.4, -1.0]))
    across = np.degrees(np.arctan2(points[:, 1], points[:, 2]))
    assert across == pytest.approx([-10, 0, 10, 20, -10, 20], abs=1e-12)
    assert np.degrees(np.arcsin(points[:, 0])) == pytest.approx([0, 0.5, 0, -1, 0, -1], abs=1e-12)
    by_channel = replace(geometry, by_encoder=False)
    assert points_s(by_channel, 0.0, channel=2)[0, 1] == pytest.approx(np.sin(np.radians(10.0)), abs=1e-14)


@pytest.mark.parametrize(
    ("text", "wrong"),
    [
        ("10,0\n", "fibres.csv: line 1: the header must be across_deg,along_deg"),
        ("across_deg,along_deg\n1,2\n3\n", "fibres.csv: line 3: got '3', want two numbers"),
        ("across_deg,along_deg\n", "fibres.csv: needs the two angles of at least one fibre"),
        ("across_deg,along_deg\n1,nan\n", "fibres.csv: needs the two angles of at least one fibre, all finite"),
    ],
)
def test_impossible_fibre_tables_are_refused(text: str, wrong: str) -> None:
    with pytest.raises(GeometryError, match=wrong):
        read_fibres(text, "fibres.csv")


ONE_BEAM = spinning()


@pytest.mark.parametrize(
    ("geometry", "changes", "wrong"),
    [
        (LineGeometry(), {"facet_tilt_rad": {0: 0.1}}, "facet.index: got 0, but the scanner has 0 facets"),
        (LineGeometry(4), {"facet_tilt_rad": {4: 0.1}}, "facet.index: got 4, but the scanner has 4 facets"),
        (LineGeometry(4), {"beams": {0: BeamCorrection()}}, "beam.channel: got 0, but the scanner has 0 beams"),
        (ONE_BEAM, {"beams": {1: BeamCorrection()}}, "beam.channel: got 1, but the scanner has 1 beams"),
        (LineGeometry(), {"installation_matrix": 2.0 * np.eye(3)}, "installation matrix: is not a rotation"),
    ],
)
def test_tables_of_another_scanner_are_refused(geometry: Geometry, changes: dict[str, object], wrong: str) -> None:
    with pytest.raises(GeometryError, match=f"calibration of left: {wrong}"):
        SensorModel(replace(NOMINAL, **changes), geometry)  # type: ignore[arg-type]


ROUND = ("scan_plane_tilt_rad", "pitch_slope")


@pytest.mark.parametrize(
    ("geometry", "refused"),
    [
        (NutatingGeometry(0.1), ROUND),
        (RisleyGeometry((0.1, 0.1), 1.5), ROUND),
        (ONE_BEAM, (*ROUND, "scan_angle_scale", "torsion_s2")),
        (read_fibres("across_deg,along_deg\n1,2\n", ""), ("encoder_latency_s", "torsion_s2")),
    ],
)
def test_error_parameters_that_a_scanner_lacks_are_refused(geometry: Geometry, refused: tuple[str, ...]) -> None:
    assert set(geometry.without) == set(refused)
    for name in refused:
        with pytest.raises(GeometryError, match=f"calibration of left: {name} is 1e-05, want 0"):
            SensorModel(NOMINAL.changed(**{name: 1e-5}), geometry)


def test_scanner_geometries_are_made_from_configurations() -> None:
    assert line_scanner("monogon") == line_scanner("oscillating") == line_scanner(None) == LineGeometry()
    assert line_scanner("polygon", facets=8) == LineGeometry(8)
    nutating = line_scanner("nutating", nutation_deg=7.0, shaft_angle_deg=45.0)
    assert nutating == NutatingGeometry(np.radians(7.0), np.radians(45.0))
    risley = line_scanner("risley", wedge_deg=[10.0, 12.0], refractive_index=1.51, prism_ratio=-0.75)
    assert risley == RisleyGeometry((np.radians(10.0), np.radians(12.0)), 1.51, -0.75)
    default = line_scanner("risley", wedge_deg=[10.0, 12.0], refractive_index=1.51)
    assert isinstance(default, RisleyGeometry)
    assert default.prism_ratio == -0.7265625
    for kind, needs in (
        ("polygon", "facets"),
        ("nutating", "nutation_deg"),
        ("risley", "wedge_deg"),
        ("fibre", "file"),
    ):
        with pytest.raises(GeometryError, match=f'type = "{kind}" needs {needs}'):
            line_scanner(kind)
    with pytest.raises(GeometryError, match=r"geometry.type: got 'rotor', want oscillating"):
        line_scanner("rotor")
