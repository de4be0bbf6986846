"""Tests the whole way from returns to the map: the steps in order, in blocks, and the fate of every row."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pyproj import Transformer

from swath.georef import georeference
from swath.georef.air.atmosphere import Air
from swath.georef.arrays import FloatArray, Int64Array, StructArray
from swath.georef.geodesy.vectors import angle_of
from swath.georef.georeference import Georeferencer
from swath.georef.mapping.frame import Mapping, MappingError
from swath.georef.points import Fate, Points
from swath.georef.scanner.beams import Geometry, LineGeometry, SpinningGeometry
from swath.georef.scanner.calibration import nominal
from swath.georef.scanner.sensor_model import SensorModel
from swath.georef.scanner.uncertainty import Noise, Uncertainty
from swath.georef.trajectory.trajectory import Trajectory
from tests.georef.scanner_cases import rows_of

pytestmark = pytest.mark.xdist_group("kernels")

MS = 1_000_000
COUNT = 500


def flight() -> Trajectory:
    """Return two seconds of a flight over the Alps with sigmas; the second half lacks a quarter of a second."""
    seconds = np.concatenate([np.arange(0, 1.25, 0.01), np.arange(1.5, 2.0, 0.01)])
    same = np.ones_like(seconds)
    return Trajectory.from_geodetic(
        np.rint(1e9 * seconds).astype(np.int64),
        0.82 + 1e-5 * seconds,
        0.15 + 2e-6 * seconds,
        1500.0 + seconds,
        np.outer(same, [60.0, 10.0, 0.0]),
        0.02 * np.sin(seconds),
        0.03 * same,
        0.4 + 0.1 * seconds,
        position_sigma_l=np.outer(same, [0.02, 0.02, 0.04]),
        attitude_sigma_rad=np.outer(same, [5e-5, 5e-5, 1e-4]),
    )


def returns() -> tuple[StructArray, Int64Array]:
    """Return returns all over the flight, a few beyond its ends, some too near."""
    rng = np.random.default_rng(1)
    rows = rows_of(rng.uniform(-0.5, 0.5, COUNT), rng.uniform(900.0, 1500.0, COUNT), intensity=np.arange(COUNT))
    rows["range_m"][::50] = 3.0
    rows["number_of_returns"], rows["mta_zone"], rows["channel"] = 3, 1, 2
    return rows, np.sort(rng.integers(-10 * MS, 2000 * MS, COUNT))


def model(air: Air | None = None, **errors: float) -> SensorModel:
    """Return the model of an oscillating mirror."""
    calibration = nominal("left", [0.1, 0.2, 0.3], np.eye(3)).changed(omega_rad=0.01, **errors)
    return SensorModel(calibration, LineGeometry(), (10.0, 5000.0), air=air)


def same_points(a: Points, b: Points) -> None:
    """Assert that points are equal bit by bit."""
    for name in Points.__slots__:
        one, other = getattr(a, name), getattr(b, name)
        assert (one is None) == (other is None)
        assert one is None or np.array_equal(one, other), name


def test_every_row_has_its_fate_and_every_good_one_its_point() -> None:
    rows, time_ns = returns()
    points, fates = Georeferencer(model(time_offset_s=1e-3)).georeference(rows, time_ns, flight())
    good = fates == Fate.GEOREFERENCED
    assert set(fates.tolist()) == {
        Fate.GEOREFERENCED,
        Fate.NO_TIME,
        Fate.OUTSIDE_TRAJECTORY,
        Fate.TRAJECTORY_GAP,
        Fate.BELOW_RANGE_GATE,
    }
    assert len(points) == good.sum() > 300
    assert np.array_equal(points.time_ns, time_ns[good] + MS)
    for name in ("intensity", "return_number", "number_of_returns", "mta_zone", "channel"):
        assert np.array_equal(getattr(points, name), rows[name][good]), name
    assert np.array_equal(points.range_m, rows["range_m"][good].astype(np.float32))
    rays = model(time_offset_s=1e-3).rays(rows, time_ns, flight())
    assert np.array_equal(points.points_map, rays.points_e[good])
    assert points.sigma_map is None


LINE, TURNED = LineGeometry(), np.diag([-1.0, -1.0, 1.0])  # cables to the rear
SPINNING = SpinningGeometry(*np.zeros((6, 2)))
SIDEWAYS = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])  # it spins about the way, azimuth 0 is down


def scan_angles(geometry: Geometry, installation: FloatArray, roll_rad: float, readings_rad: list[float]) -> FloatArray:
    """Return scan angles of points, degrees, of an aircraft that flies south-east with its nose up."""
    n = len(readings_rad)
    time_ns = 10 * MS * np.arange(3, dtype=np.int64)
    lat_rad, same = 0.82 - 1e-7 * np.arange(3), np.ones(3)
    trajectory = Trajectory.from_geodetic(
        time_ns, lat_rad, 0.15 * same, 1500.0 * same, np.zeros((3, 3)), roll_rad * same, 0.06 * same, 2.4 * same
    )
    rows = rows_of(np.array(readings_rad), np.full(n, 500.0))
    head = SensorModel(nominal("left", [0.1, 0.2, 0.3], installation), geometry)
    points, _ = Georeferencer(head).georeference(rows, np.full(n, 12 * MS), trajectory)
    assert len(points) == n
    return np.degrees(points.scan_angle_rad.astype(np.float64))


def test_scan_angles_are_positive_to_the_right_however_the_head_is_mounted() -> None:
    readings = [-0.5, 0.0, 0.3]
    degrees = np.degrees(readings)
    np.testing.assert_allclose(scan_angles(LINE, np.eye(3), 0.0, readings), degrees, atol=0.06)  # with a pitch of 3.4°
    np.testing.assert_allclose(scan_angles(LINE, TURNED, 0.0, readings), -degrees, atol=0.06)


def test_scan_angles_include_the_roll_of_the_aircraft() -> None:
    """With the right wing down, the scanner's own nadir points left. LAS 1.4 measures from the vertical."""
    level = np.degrees(np.arctan2(-np.sin(0.2), np.cos(0.2) * np.cos(0.06)))
    np.testing.assert_allclose(scan_angles(LINE, np.eye(3), 0.2, [0.0]), level, atol=1e-4)


def test_scan_angles_of_spinning_heads_follow_the_beam_direction() -> None:
    """The head's axis lies along the flight, so the scan angle is where a beam looks, all the way round."""
    readings = np.radians([0.0, 90.0, 179.0, 181.0, 270.0]).tolist()
    found = scan_angles(SPINNING, SIDEWAYS, 0.0, readings)
    assert found[[0, 1, 4]] == pytest.approx([0.0, 90.0, -90.0], abs=0.3)
    assert np.abs(found[2:4]) == pytest.approx([179.0, 179.0], abs=0.3)
    assert found[2] > 0.0 > found[3]


def test_angles_match_arctangents_all_round() -> None:
    angle = np.concatenate([np.linspace(-np.pi, np.pi, 4001)[1:], np.radians([-90.0, -45.0, 0.0, 45.0, 90.0])])
    found = [angle_of(1e3 * np.sin(one), 1e3 * np.cos(one)) for one in angle.tolist()]
    np.testing.assert_allclose(found, angle, rtol=0, atol=2e-8)


def test_points_are_converted_to_map_coordinates() -> None:
    rows, time_ns = returns()
    in_e, _ = Georeferencer(model()).georeference(rows, time_ns, flight())
    mapped, _ = Georeferencer(model(), Mapping("EPSG:32632", datum=None, epoch=None)).georeference(
        rows, time_ns, flight()
    )
    to_map = Transformer.from_crs("EPSG:4978", "EPSG:32632", always_xy=True)
    to_geodetic = Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True)
    x, y, z = in_e.points_map.T
    east, north, _ = to_map.transform(x, y, z)
    _, _, height = to_geodetic.transform(x, y, z)
    assert np.abs(mapped.points_map - np.stack([east, north, height], axis=1)).max() < 1e-4


def test_results_do_not_depend_on_the_block_size(monkeypatch: pytest.MonkeyPatch) -> None:
    rows, time_ns = returns()
    calibration = replace(model().calibration, sigmas=np.full(16, 1e-4))
    mapping, air = Mapping("EPSG:32632", datum=None, epoch=None), Air("vacuum", refraction="ardc")
    maker = Georeferencer(model(air), mapping, Uncertainty(calibration, Noise()))
    whole, fates = maker.georeference(rows, time_ns, flight())
    monkeypatch.setattr(georeference, "BLOCK_ROWS", 37)
    cut, cut_fates = maker.georeference(rows, time_ns, flight())
    assert np.array_equal(fates, cut_fates)
    same_points(whole, cut)
    assert whole.sigma_map is not None
    assert (whole.sigma_map > 0.02).all()


def test_air_affects_the_measured_range_and_not_the_offset() -> None:
    rows, time_ns = rows_of(0.0, [1000.0]), np.array([500 * MS])
    air = Air("vacuum")
    straight = model(range_offset_m=50.0, range_scale=1e-3)
    rays = straight.rays(rows, time_ns, flight())
    points, _ = Georeferencer(model(air, range_offset_m=50.0, range_scale=1e-3)).georeference(rows, time_ns, flight())
    shorter = np.linalg.norm(points.points_map - rays.points_e, axis=1)[0]
    kelvin = 288.15 - 0.0065 * 950.0  # half way down, in the standard atmosphere (ISO 2533)
    hpa = 1013.25 * (kelvin / 288.15) ** 5.25588
    ppm = 273.15 / 1013.25 * 291.985 * hpa / kelvin  # FORMULAS 3.2 at 1064 nm
    assert shorter == pytest.approx(1001.0 * 1e-6 * ppm, rel=2e-3)
    with_less_offset = model(air, range_offset_m=0.0, range_scale=1e-3)
    less, _ = Georeferencer(with_less_offset).georeference(rows, time_ns, flight())
    between = np.linalg.norm(points.points_map - less.points_map, axis=1)[0]
    assert between == pytest.approx(50.0, abs=3e-3)  # the path is 50 m lower and its air denser by 1.4 ppm
    assert abs(between - 50.0 * (1 - 1e-6 * ppm)) > 5e-3


def test_sigmas_are_earth_centred_without_a_map() -> None:
    rows, time_ns = returns()
    uncertainty = Uncertainty(model().calibration, Noise())
    points, fates = Georeferencer(model(), uncertainty=uncertainty).georeference(rows, time_ns, flight())
    good = fates == Fate.GEOREFERENCED
    rays = model().rays(rows[good], time_ns[good], flight(), uncertainty=uncertainty)
    assert points.sigma_map is not None
    assert rays.covariance_e is not None
    assert points.sigma_map**2 == pytest.approx(rays.covariance_e[:, [0, 3, 5]], rel=1e-6)


class Steady:
    """An encoder that turns at a constant rate."""

    def __init__(self) -> None:
        self.asked = 0

    def motion(self, rows: StructArray, time_ns: Int64Array) -> tuple[FloatArray, FloatArray]:
        self.asked += 1
        return np.full(len(rows), 40.0), np.zeros(len(rows))


def test_encoder_motion_is_used_only_with_an_encoder_latency(monkeypatch: pytest.MonkeyPatch) -> None:
    rows, time_ns = returns()
    monkeypatch.setattr(georeference, "BLOCK_ROWS", 100)
    late, motion = model(encoder_latency_s=1e-6), Steady()
    points, _ = Georeferencer(late, encoder_motion=motion).georeference(rows, time_ns, flight())
    ahead, _ = Georeferencer(model(scan_angle_offset_rad=-4e-5)).georeference(rows, time_ns, flight())
    assert np.abs(points.points_map - ahead.points_map).max() < 1e-8
    assert motion.asked == 1
    Georeferencer(model(), encoder_motion=motion).georeference(rows, time_ns, flight())
    assert motion.asked == 1  # it is not needed


def test_no_rows_give_no_points() -> None:
    rows, time_ns = returns()
    for mapping in (None, Mapping("EPSG:32632", datum=None, epoch=None)):
        points, fates = Georeferencer(model(), mapping).georeference(rows[:0], time_ns[:0], flight())
        assert len(points) == len(fates) == 0


def test_points_outside_the_projection_are_not_finite() -> None:
    rows, time_ns = returns()
    clean, fates = Georeferencer(model(), Mapping("EPSG:32632")).georeference(rows, time_ns, flight())
    wild = rows.copy()
    at = np.flatnonzero(fates == Fate.GEOREFERENCED)[[40, 41, 200]]
    wild["range_m"][at] = [2.0e6, 3.0e6, 4.0e6]
    calibration = model().calibration
    maker = Georeferencer(SensorModel(calibration, LineGeometry()), Mapping("EPSG:32632"))
    points, wild_fates = maker.georeference(wild, time_ns, flight())
    lost = wild_fates == Fate.NOT_FINITE
    assert lost[at].any()
    assert not lost[np.setdiff1d(np.arange(len(rows)), at)].any()
    assert len(points) == (wild_fates == Fate.GEOREFERENCED).sum()
    kept = np.isin(points.time_ns, np.setdiff1d(clean.time_ns, time_ns[at]))
    assert np.array_equal(points.points_map[kept], clean.points_map[np.isin(clean.time_ns, points.time_ns[kept])])


def test_a_map_whose_domain_contains_no_point_is_refused_at_once() -> None:
    rows, time_ns = returns()
    with pytest.raises(MappingError, match="outside"):
        Georeferencer(model(), Mapping("EPSG:32756")).georeference(rows, time_ns, flight())
