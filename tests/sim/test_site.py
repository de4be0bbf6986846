"""Tests the site frame against PROJ and the ellipsoid's formulas (FORMULAS 1.2, 1.3)."""

from __future__ import annotations

import numpy as np

from swath.sim.site import Site, e_from_geodetic, geodetic_from_e, rot_e_from_ned

LAT, LON = 47.1234567, 8.7


def test_earth_centred_coordinates_match_the_formula_sheet() -> None:
    xyz = e_from_geodetic(np.radians([LAT]), np.radians([LON]), np.array([512.3]))
    np.testing.assert_allclose(xyz[0], [4297959.983892308, 657680.2964883694, 4651489.774063125], rtol=0, atol=1e-6)
    lat, lon, height = geodetic_from_e(xyz)
    np.testing.assert_allclose([*np.degrees(lat), *np.degrees(lon)], [LAT, LON], rtol=0, atol=1e-12)
    np.testing.assert_allclose(height, 512.3, rtol=0, atol=1e-8)


def test_north_east_down_axes_match_the_formula_sheet() -> None:
    rotation = rot_e_from_ned(np.radians([LAT]), np.radians([LON]))[0]
    expected = [
        [-0.7243895948, -0.1512608202, -0.6725919113],
        [-0.1108471845, 0.9884938868, -0.1029210252],
        [0.6804209113, 0.0, -0.7328215222],
    ]
    np.testing.assert_allclose(rotation, expected, rtol=0, atol=5e-11)


def test_the_site_frame_points_east_north_and_up() -> None:
    site = Site.at(LAT, LON)
    np.testing.assert_allclose(site.rot_site_from_e @ site.rot_site_from_e.T, np.eye(3), rtol=0, atol=1e-14)
    assert np.linalg.det(site.rot_site_from_e) > 0
    ned = rot_e_from_ned(np.radians([LAT]), np.radians([LON]))[0]
    np.testing.assert_allclose(site.rot_site_from_e @ ned, [[0, 1, 0], [1, 0, 0], [0, 0, -1]], rtol=0, atol=1e-9)
    points = np.array([[10.0, 20.0, 30.0], [-4e4, 3e4, 5e3]])
    np.testing.assert_allclose(site.site_from_e(site.e_from_site(points)), points, rtol=0, atol=2e-9)


def test_ground_points_have_their_requested_height() -> None:
    site = Site.at(LAT, LON)
    east, north = np.array([0.0, 2e4, -4e4]), np.array([0.0, 3e4, 1e4])
    points = site.site_from_ground(east, north, np.array([450.0, 450.0, 1200.0]))
    np.testing.assert_allclose(site.heights(points), [450.0, 450.0, 1200.0], rtol=0, atol=1e-4)
    np.testing.assert_array_equal(points[:, :2], np.stack([east, north], axis=1))
    drop = 450.0 - points[1, 2]  # FORMULAS 1.9: d² / 2R, with R between 6.33 and 6.40 thousand kilometres
    distance = np.hypot(2e4, 3e4)
    assert distance**2 / 2 / 6.40e6 < drop < distance**2 / 2 / 6.33e6
