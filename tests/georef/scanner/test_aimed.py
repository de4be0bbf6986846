"""Tests heads that give a direction by two angles: points by hand, sigmas by draws, rows divided for kernels."""

from __future__ import annotations

from collections import deque

import numpy as np
import pytest

from swath.georef.arrays import FloatArray
from swath.georef.points import Fate
from swath.georef.records import AIMED_RETURN_DTYPE, RETURN_DTYPE
from swath.georef.return_rows import WaitingReturns, any_has, concatenate, elevations, plain, split_at, take
from swath.georef.scanner.beams import AimedGeometry, GeometryError
from swath.georef.scanner.calibration import nominal
from swath.georef.scanner.encoder_motion import NoMotion
from swath.georef.scanner.sensor_model import SensorModel
from swath.georef.scanner.uncertainty import Noise, Uncertainty
from tests.georef.scanner_cases import rows_of, still_trajectory

pytestmark = pytest.mark.xdist_group("kernels")

MIDDLE_NS = 500_000_000


def model(installation: object = None) -> SensorModel:
    """Return the model of a head in the body's origin."""
    turned = np.eye(3) if installation is None else np.array(installation, dtype=np.float64)
    return SensorModel(nominal("front", [0, 0, 0], turned), AimedGeometry())


def test_points_lie_where_azimuth_and_elevation_put_them() -> None:
    """The points of 100 m are computed by hand; 90° to the left is +y, not −y.

    cos 20° = 0.9396926, sin 20° = 0.3420201, cos 30° = 0.8660254.
    """
    rows = rows_of(
        np.radians([0.0, 90.0, 0.0, 30.0, 330.0]), 100.0, elevation_rad=np.radians([0.0, 0.0, 90.0, 20.0, -20.0])
    )
    want = [[100, 0, 0], [0, 100, 0], [0, 0, 100], [81.37977, 46.98463, 34.20201], [81.37977, -46.98463, -34.20201]]
    time_ns = np.full(5, MIDDLE_NS)
    np.testing.assert_allclose(model().rays(rows, time_ns, still_trajectory()).points_e, np.array(want), atol=1e-5)
    # its x down and its z forward: the beam at 30°, 20° is 34.2 m ahead, 47.0 m to the left, 81.4 m below
    down = model([[0, 0, 1], [0, -1, 0], [1, 0, 0]]).rays(rows, time_ns, still_trajectory())
    np.testing.assert_allclose(down.points_e[3], [34.20201, -46.98463, 81.37977], atol=1e-5)


def test_channels_need_no_table_and_wrong_elevations_give_no_point() -> None:
    rows = rows_of([0.1, 0.2, 0.3], 50.0, elevation_rad=[0.0, np.nan, 0.2], channel=[0, 3, 5000])
    fate = model().rays(rows, np.full(3, MIDDLE_NS), still_trajectory()).fate
    assert fate.tolist() == [Fate.GEOREFERENCED, Fate.NOT_FINITE, Fate.GEOREFERENCED]
    with pytest.raises(ValueError, match="its returns need an elevation"):
        model().rays(rows_of([0.1], 50.0), np.array([MIDDLE_NS]), still_trajectory())
    wrong = nominal("front", [0, 0, 0], np.eye(3)).changed(scan_angle_offset_rad=0.01)
    with pytest.raises(GeometryError, match=r"scan_angle_offset_rad is 0\.01, want 0"):
        SensorModel(wrong, AimedGeometry())


def covariance_of(points: FloatArray) -> FloatArray:
    """Return xx xy xz yy yz zz."""
    return np.cov(points.T)[np.triu_indices(3)]


@pytest.mark.slow
def test_sigmas_hold_both_angles() -> None:
    """Range, azimuth and elevation are drawn through the formula itself; the sample variance scatters by 1 %."""
    azimuth, elevation, range_m, draws = 0.7, -0.9, 80.0, 40_000
    noise, rng = Noise(range_m=0.02, angle_rad=1e-3, time_s=0.0, divergence_rad=0.0), np.random.default_rng(4)
    rho = range_m + noise.range_m * rng.standard_normal(draws)
    alpha, epsilon = np.array([[azimuth], [elevation]]) + noise.angle_rad * rng.standard_normal((2, draws))
    flat = rho * np.cos(epsilon)
    drawn = np.stack([flat * np.cos(alpha), flat * np.sin(alpha), rho * np.sin(epsilon)], axis=1)
    head, trajectory = model(), still_trajectory()
    trajectory.position_sigma_l[:], trajectory.attitude_sigma_rad[:] = 0.0, 0.0
    rows, time_ns = rows_of(azimuth, range_m, elevation_rad=elevation), np.array([MIDDLE_NS])
    want = covariance_of(drawn)
    for with_axes in (False, True):
        sigmas = Uncertainty(head.calibration, noise, aimed=True)
        got = head.rays(rows, time_ns, trajectory, uncertainty=sigmas, with_axes=with_axes).covariance_e
        assert got is not None
        np.testing.assert_allclose(got[0], want, atol=0.04 * np.abs(want).max())


def test_rows_with_elevations_wait_are_divided_and_joined_like_others() -> None:
    rows = np.zeros(6, AIMED_RETURN_DTYPE)
    rows["elevation_rad"], rows["range_m"], rows["mta_zone"] = np.arange(6) / 8, np.arange(6), [0, 0, 0, 255, 0, 0]
    narrow = plain(rows)
    assert narrow.dtype == RETURN_DTYPE
    assert all((narrow[name] == rows[name]).all() for name in RETURN_DTYPE.names or ())
    np.testing.assert_array_equal(elevations(rows), rows["elevation_rad"])
    assert plain(narrow) is narrow
    assert not len(elevations(narrow))
    assert any_has(rows, "mta_zone", 255)
    assert not any_has(rows[:3], "mta_zone", 255)
    good = np.array([True, False, True, True, False, False])
    one, other = split_at(WaitingReturns(rows, 0, np.arange(6)), good)
    joined = concatenate([part.rows for part in deque([*one, *other])], rows)
    np.testing.assert_array_equal(joined, rows[[0, 2, 3, 1, 4, 5]])
    np.testing.assert_array_equal(take(rows, good), rows[good])
    same, time_ns, rate, acceleration = NoMotion().feed(rows, np.arange(6))
    assert same is rows
    assert len(time_ns) == 6
    assert not rate.any()
    assert not acceleration.any()
