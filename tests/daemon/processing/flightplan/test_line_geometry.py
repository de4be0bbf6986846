"""Tests places relative to lines against Karney's geodesics, as PROJ computes them."""

from __future__ import annotations

import numpy as np
import pytest
from pyproj import Geod

from swath.daemon.processing.flightplan.geometry import LineGeometry
from swath.daemon.processing.flightplan.plan import PlannedLine

GEOD = Geod(ellps="WGS84")
NONE = np.full(2, np.nan)


def line(*lat_lon: tuple[float, float], height_m: tuple[float, ...] = ()) -> PlannedLine:
    lat, lon = np.array(lat_lon).T
    heights = np.array(height_m) if height_m else np.full(len(lat), np.nan)
    return PlannedLine("a", lat, lon, heights, np.full(len(lat), np.nan))


@pytest.mark.parametrize("longest_m", [50e3, 200e3])
def test_places_agree_with_geodesics_to_a_millimetre(longest_m: float) -> None:
    """The issue asks for less than a decimetre over 50 km."""
    rng = np.random.default_rng(3)
    for _ in range(60):
        lat, lon, azimuth = rng.uniform(-80, 80), rng.uniform(-180, 180), rng.uniform(0, 360)
        length_m, along_m, across_m = rng.uniform(2e3, longest_m), rng.uniform(), rng.uniform(-5e3, 5e3)
        along_m *= length_m
        end_lon, end_lat, _ = GEOD.fwd(lon, lat, azimuth, length_m)
        foot_lon, foot_lat, back = GEOD.fwd(lon, lat, azimuth, along_m)
        place_lon, place_lat, _ = GEOD.fwd(foot_lon, foot_lat, back + 270.0, across_m)
        geometry = LineGeometry([line((lat, lon), (end_lat, end_lon))])
        found = geometry.places(np.radians([place_lat]), np.radians([place_lon]))
        assert geometry.length_m[0] == pytest.approx(length_m, abs=1e-3)
        assert found.along_m[0, 0] == pytest.approx(along_m, abs=1e-3)
        assert found.across_m[0, 0] == pytest.approx(across_m, abs=1e-3)
        assert found.distance_m[0, 0] == pytest.approx(abs(across_m), abs=1e-3)
        beside = geometry.places(np.radians([foot_lat]), np.radians([foot_lon]))
        off_deg = (np.degrees(beside.azimuth_rad[0, 0]) - back - 180.0 + 180.0) % 360.0 - 180.0
        assert off_deg == pytest.approx(0.0, abs=1e-3)


def test_before_the_begin_and_after_the_end_a_line_goes_on_straight() -> None:
    end_lon, end_lat, _ = GEOD.fwd(8.0, 47.0, 70.0, 10_000.0)
    geometry = LineGeometry([line((47.0, 8.0), (end_lat, end_lon), height_m=(1000.0, 1200.0))])
    for along_m, distance_m, height_m in ((-800.0, 800.0, 1000.0), (10_500.0, 500.0, 1200.0), (2500.0, 0.0, 1050.0)):
        lon, lat, _ = GEOD.fwd(8.0, 47.0, 70.0, along_m)
        found = geometry.places(np.radians([lat]), np.radians([lon]))
        assert found.along_m[0, 0] == pytest.approx(along_m, abs=1e-3)
        assert found.across_m[0, 0] == pytest.approx(0.0, abs=1e-3)
        assert found.distance_m[0, 0] == pytest.approx(distance_m, abs=2e-3)
        assert found.height_m[0, 0] == pytest.approx(height_m, abs=1e-3)
        assert np.isnan(found.above_ground_m[0, 0])


def test_along_a_bent_line_the_nearest_section_counts() -> None:
    """3 km north, then 4 km east; a second line lies elsewhere."""
    corner_lon, corner_lat, _ = GEOD.fwd(8.0, 47.0, 0.0, 3000.0)
    end_lon, end_lat, _ = GEOD.fwd(corner_lon, corner_lat, 90.0, 4000.0)
    bent = line((47.0, 8.0), (corner_lat, corner_lon), (end_lat, end_lon))
    geometry = LineGeometry([bent, line((47.1, 8.0), (47.1, 8.1))])
    assert geometry.length_m[0] == pytest.approx(7000.0, abs=1e-3)
    for along_m, azimuth, across_m in ((1000.0, 0.0, 50.0), (5000.0, 90.0, -80.0)):
        foot = (
            GEOD.fwd(8.0, 47.0, 0.0, along_m)
            if azimuth == 0
            else GEOD.fwd(corner_lon, corner_lat, 90.0, along_m - 3000)
        )
        lon, lat, _ = GEOD.fwd(foot[0], foot[1], foot[2] + 270.0, across_m)
        found = geometry.places(np.radians([lat, 47.1]), np.radians([lon, 8.05]))
        assert found.along_m[0, 0] == pytest.approx(along_m, abs=1e-3)
        assert found.across_m[0, 0] == pytest.approx(across_m, abs=1e-3)
        assert abs(found.across_m[1, 1]) < 5.0
        assert found.azimuth_rad[0, 0] == pytest.approx(np.radians(azimuth), abs=1e-3)


def test_far_places_and_no_lines_are_no_trouble() -> None:
    lat, lon = np.radians([-47.0, 47.0, 90.0]), np.radians([-172.0, 8.0, 0.0])
    assert LineGeometry([]).places(lat, lon).along_m.shape == (3, 0)
    found = LineGeometry([line((47.0, 8.0), (47.0, 8.1))]).places(lat, lon)
    assert np.isfinite(found.distance_m).all()
    assert found.distance_m[0, 0] > 1e6
