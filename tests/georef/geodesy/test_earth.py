"""Tests geodesy against the formula sheet and PROJ."""

from __future__ import annotations

import numpy as np
import pytest
from pyproj import Geod, Transformer

from swath.georef.geodesy.earth import (
    A_M,
    B_M,
    e_from_geodetic,
    geodetic_from_e,
    meridian_radius_m,
    prime_vertical_radius_m,
    rot_e_from_l,
)

pytestmark = pytest.mark.xdist_group("kernels")

LAT, LON, HEIGHT = np.radians(47.1234567), np.radians(8.7), 512.3
TO_ECEF = Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)


def test_positions_match_the_formula_sheet() -> None:
    expected = (4297959.983892308, 657680.2964883694, 4651489.774063125)  # FORMULAS 1.2
    np.testing.assert_allclose(e_from_geodetic(LAT, LON, HEIGHT), expected, atol=1e-8)
    assert float(prime_vertical_radius_m(LAT)) == pytest.approx(6389632.9154552, abs=1e-6)
    assert float(meridian_radius_m(LAT)) == pytest.approx(6369757.9810539, abs=1e-6)
    expected_rotation = [
        [-0.7243895948, -0.1512608202, -0.6725919113],
        [-0.1108471845, 0.9884938868, -0.1029210252],
        [0.6804209113, 0.0, -0.7328215222],
    ]  # FORMULAS 1.3
    np.testing.assert_allclose(rot_e_from_l(LAT, LON), expected_rotation, atol=1e-10)


def test_positions_agree_with_proj_everywhere() -> None:
    rng = np.random.default_rng(1)
    lat_deg = np.concatenate([rng.uniform(-90, 90, 5000), [90, -90, 0, 0, 89.9999999, -89.9999999]])
    lon_deg = np.concatenate([rng.uniform(-180, 180, 5000), [0, 0, 180, -180, 179.9999999, 12]])
    height = np.concatenate([rng.uniform(-400, 12_000, 5000), [6000, 6000, 0, 100, 3000, -10]])
    expected = np.stack(TO_ECEF.transform(lon_deg, lat_deg, height), axis=1)
    position = e_from_geodetic(np.radians(lat_deg), np.radians(lon_deg), height)
    np.testing.assert_allclose(position, expected, atol=3e-9)
    lat, lon, back = geodetic_from_e(expected)
    np.testing.assert_allclose(back, height, atol=5e-9)
    np.testing.assert_allclose(lat * A_M, np.radians(lat_deg) * A_M, atol=5e-9)
    apart = np.angle(np.exp(1j * (lon - np.radians(lon_deg)))) * np.cos(lat) * A_M
    assert np.abs(apart[:5000]).max() < 5e-9


def test_local_axes_match_steps_along_the_ellipsoid() -> None:
    here = e_from_geodetic(LAT, LON, HEIGHT)
    geod = Geod(a=A_M, b=B_M)
    rotation = rot_e_from_l(LAT, LON)
    for azimuth_deg, axis in ((0.0, 0), (90.0, 1)):
        lon, lat, _ = geod.fwd(np.degrees(LON), np.degrees(LAT), azimuth_deg, 0.1)
        step = np.array(TO_ECEF.transform(lon, lat, HEIGHT)) - here
        np.testing.assert_allclose(step / np.linalg.norm(step), rotation[:, axis], atol=3e-7)
    down = np.array(TO_ECEF.transform(np.degrees(LON), np.degrees(LAT), HEIGHT - 1000.0)) - here
    np.testing.assert_allclose(down / 1000.0, rotation[:, 2], atol=1e-11)


def test_array_shapes_are_preserved() -> None:
    position = e_from_geodetic(np.zeros((2, 3)), 0.5, 100.0)
    assert position.shape == (2, 3, 3)
    lat, lon, height = geodetic_from_e(position)
    assert lat.shape == lon.shape == height.shape == (2, 3)
    assert geodetic_from_e(position[0, 0])[2].shape == ()
