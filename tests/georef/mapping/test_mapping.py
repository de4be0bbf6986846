"""Tests coordinates of the mapping frame: FORMULAS 1.9, PROJ's pipelines written by hand, grids made here."""

from __future__ import annotations

import json
import os
import pickle
import struct
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import pytest
from pyproj import CRS

from swath.georef.arrays import FloatArray, SingleArray
from swath.georef.geodesy.earth import e_from_geodetic, meridian_radius_m
from swath.georef.mapping import frame as module
from swath.georef.mapping.frame import Mapping, MappingError

pytestmark = pytest.mark.xdist_group("kernels")

WGS84 = "+inv +proj=cart +ellps=WGS84"
GRS80 = "+inv +proj=cart +ellps=GRS80"
BESSEL = "+inv +proj=cart +ellps=bessel"
TO_CH1903 = "+proj=helmert +x=-674.374 +y=-15.056 +z=-405.346"
LV95 = "+proj=somerc +lat_0=46.9524055555556 +lon_0=7.43958333333333 +x_0=2600000 +y_0=1200000 +ellps=bessel"
KEEP_HEIGHT = "+proj=push +v_3 +step +proj=cart +ellps=GRS80"
NZTM = "+proj=tmerc +lon_0=173 +k=0.9996 +x_0=1600000 +y_0=10000000 +ellps=GRS80"
LAEA = "+proj=laea +lat_0=52 +lon_0=10 +x_0=4321000 +y_0=3210000 +ellps=GRS80"
L93 = "+proj=lcc +lat_0=46.5 +lon_0=3 +lat_1=49 +lat_2=44 +x_0=700000 +y_0=6600000 +ellps=GRS80"
UPS = "+proj=stere +lat_0=90 +lat_ts=81.11451786859362 +x_0=2000000 +y_0=2000000 +ellps=WGS84"
# crs, datum, PROJ's steps from ECEF, box (west, south, east, north)
FRAMES: list[tuple[str, str | None, tuple[str, ...], tuple[float, float, float, float]]] = [
    ("EPSG:32632", None, (WGS84, "+proj=utm +zone=32 +ellps=WGS84"), (6, 40, 12, 60)),
    ("EPSG:2056", "EPSG:4932", (GRS80, KEEP_HEIGHT, TO_CH1903, BESSEL, "+proj=pop +v_3", LV95), (6, 46, 10.4, 47.7)),
    ("EPSG:2193", "EPSG:4959", (GRS80, NZTM), (167, -46, 178, -35)),
    ("EPSG:3035", "same", (GRS80, LAEA), (-9, 36, 30, 69)),
    ("EPSG:2154", "EPSG:4964", (GRS80, L93), (-4, 42, 8, 51)),
    ("EPSG:32661", None, (WGS84, UPS), (-180, 89.5, 180, 90)),
    ("EPSG:32601", None, (WGS84, "+proj=utm +zone=1 +ellps=WGS84"), (-184, 60, -173, 72)),
    ("EPSG:32733", None, (WGS84, "+proj=utm +zone=33 +south +ellps=WGS84"), (12, -79, 18, -0.1)),
]


def pipeline(*steps: str) -> pyproj.Transformer:
    """Return PROJ's transformer with every step stated."""
    return pyproj.Transformer.from_pipeline("+proj=pipeline " + " ".join(f"+step {step}" for step in steps))


def places(n: int, box: tuple[float, float, float, float], seed: int = 2) -> FloatArray:
    """Return n positions (n, 3) in e inside a box, from below sea level to the height of the highest mountain."""
    random = np.random.default_rng(seed)
    lat, lon = random.uniform(box[1], box[3], n), random.uniform(box[0], box[2], n)
    return e_from_geodetic(np.radians(lat), np.radians(lon), random.uniform(-400.0, 8900.0, n))


def at(lat_deg: float, lon_deg: float, height_m: float = 0.0) -> FloatArray:
    """Return one position (1, 3) in e."""
    return np.atleast_2d(e_from_geodetic(np.radians(lat_deg), np.radians(lon_deg), height_m))


def sigmas_of(frame: Mapping, points_e: FloatArray, covariance_e: FloatArray) -> SingleArray:
    """Return sigmas (n, 3)."""
    _, sigmas = frame.map_with_sigmas(points_e, covariance_e)
    assert sigmas is not None
    return sigmas


def test_coordinates_match_the_formula_sheet() -> None:
    """FORMULAS 1.9 has UTM 32 of lat 47.1234567°, lon 8.7°, with meridian convergence and scale at the ellipsoid."""
    utm = Mapping("EPSG:32632")
    coordinates = utm.map_from_e(at(47.1234567, 8.7, 512.3))[0]
    np.testing.assert_allclose(coordinates, [477244.9241968, 5218927.210357, 512.3], atol=2e-5)
    assert utm.exact(at(47.1234567, 8.7, 512.3))[0] == pytest.approx([477244.9241968, 5218927.210357, 512.3], abs=1e-6)
    step = np.degrees(1e-5)
    south, north = (utm.map_from_e(at(47.1234567 + sign * step, 8.7))[0] for sign in (-1, 1))
    d_east, d_north, _ = north - south
    assert -np.degrees(np.arctan2(d_east, d_north)) == pytest.approx(-0.219847395541, abs=2e-5)
    arc_m = 2e-5 * float(meridian_radius_m(np.radians(47.1234567)))
    assert np.hypot(d_east, d_north) / arc_m == pytest.approx(0.999606363586, abs=2e-7)


@pytest.mark.parametrize(("crs", "datum", "steps", "box"), FRAMES)
def test_coordinates_match_proj_within_a_tenth_of_a_millimetre(
    crs: str, datum: str | None, steps: tuple[str, ...], box: tuple[float, float, float, float]
) -> None:
    """1e5 points in some 1500 cubes differ by at most 0.007 mm; easting is first, whatever the CRS lists first."""
    frame = Mapping(crs, datum=datum, accuracy_m=0.1)
    spread = np.random.default_rng(4).uniform(-300.0, 300.0, (100_000, 3))
    points = np.repeat(places(400, box), 250, axis=0) + spread
    expected = np.stack(pipeline(*steps).transform(*points.T), axis=-1)
    assert np.abs(frame.exact(points) - expected).max() < 1e-6
    assert np.abs(frame.map_from_e(points) - expected).max() < 2e-5


def test_coordinates_are_continuous_across_the_antimeridian_and_the_pole() -> None:
    utm, ups = Mapping("EPSG:32601"), Mapping("EPSG:32661")
    west, east = utm.map_from_e(np.vstack([at(65.0, 179.9999), at(65.0, -179.9999)]))
    assert 0.0 < east[0] - west[0] < 20.0
    here, there = ups.map_from_e(np.vstack([at(89.9999, 0.0), at(89.9999, 180.0)]))
    np.testing.assert_allclose(here + there, [4e6, 4e6, 0.0], atol=1e-4)
    assert here[1] < 2e6 < there[1]  # UPS north: grid north is along 180°


@pytest.mark.slow
def test_a_point_maps_the_same_alone_and_among_others() -> None:
    """Results are equal bit for bit, also in a copy pickled as for another process."""
    frame = Mapping("EPSG:25832", datum="EPSG:7912", epoch=2026.47)
    points = places(20_000, (8.0, 47.0, 8.3, 47.2))
    whole = frame.map_from_e(points)
    shuffled = np.random.default_rng(1).permutation(len(points))
    copy = pickle.loads(pickle.dumps(frame))
    assert (copy.map_from_e(points[shuffled]) == whole[shuffled]).all()
    assert copy.description() == frame.description()
    unsettled = pickle.loads(pickle.dumps(Mapping("EPSG:25832", datum="EPSG:7912", epoch=2026.47)))
    assert (unsettled.map_from_e(points[:100]) == whole[:100]).all()
    assert (unsettled.map_from_e(points[::2][::-1]) == whole[::2][::-1]).all()


def test_map_coordinates_are_converted_back_to_earth_centred_ones() -> None:
    """PROJ makes a single step of Bowring's method, whose remaining error is 1 µm at a height of 8 km."""
    frame = Mapping("EPSG:32733")
    points = places(1000, (12, -60, 18, -1))
    assert np.abs(frame.e_from_map(frame.exact(points)) - points).max() < 2e-6
    moving = Mapping("EPSG:25832", datum="EPSG:7912", epoch=2026.47, area=(8, 47, 9, 48))
    points = places(1000, (8, 47, 9, 48))
    assert np.abs(moving.e_from_map(moving.exact(points)) - points).max() < 2e-6
    with pytest.raises(MappingError, match="is not a place in WGS 84 / UTM zone 33S"):
        frame.e_from_map(np.array([[np.inf, 0.0, 0.0]]))


def test_sigmas_are_those_of_the_map_coordinates() -> None:
    """Sampled differences of PROJ are the reference; UTM's scale (0.9996 on the central meridian) is not removed."""
    frame = Mapping("EPSG:32632")
    point = at(47.5, 10.5, 400.0)
    root = np.array([[0.02, 0.0, 0.0], [-0.01, 0.03, 0.0], [0.015, 0.02, 0.05]])
    draws = np.random.default_rng(8).normal(size=(400_000, 3)) @ root.T
    full = root @ root.T
    packed = full[[0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]][None]
    sampled = frame.exact(point + draws).std(axis=0)
    np.testing.assert_allclose(sigmas_of(frame, point, packed)[0], sampled, rtol=0.005)
    round_ = np.array([[1e-4, 0.0, 0.0, 1e-4, 0.0, 1e-4]])
    on_the_meridian = sigmas_of(frame, at(47.5, 9.0), round_)[0]
    np.testing.assert_allclose(on_the_meridian, [0.009996, 0.009996, 0.01], rtol=2e-4)
    assert sigmas_of(frame, point, packed).dtype == np.float32


def test_coordinates_in_feet_match_proj_and_are_declared() -> None:
    """EPSG:2263 is in US survey feet; heights of a two-dimensional CRS are in metres, and so are sigmas."""
    frame = Mapping("EPSG:2263", datum="same")
    point = at(40.7, -74.0, 100.0)
    metres = pipeline(
        GRS80,
        "+proj=lcc +lat_0=40.1666666666667 +lon_0=-74 +lat_1=41.0333333333333 +lat_2=40.6666666666667 "
        "+x_0=300000 +ellps=GRS80",
    ).transform(*point.T)
    feet = frame.map_from_e(point)[0]
    np.testing.assert_allclose(feet[:2], np.ravel(metres[:2]) * 3937.0 / 1200.0, atol=1e-4)
    assert feet[2] == pytest.approx(100.0, abs=1e-3)
    np.testing.assert_allclose(frame.unit_m, [1200 / 3937, 1200 / 3937, 1.0])
    assert frame.description()["units"]["names"] == ["US survey foot", "US survey foot", "metre"]
    sigmas = sigmas_of(frame, point, np.array([[1e-4, 0.0, 0.0, 1e-4, 0.0, 1e-4]]))[0]
    np.testing.assert_allclose(sigmas, 0.01, rtol=1e-3)


def test_earth_centred_output_is_supported() -> None:
    frame = Mapping("EPSG:4978")
    points = places(1000, (0, 0, 10, 50))
    assert np.abs(frame.map_from_e(points) - points).max() < 1e-8
    assert frame.description()["heights"] == "none: earth-centred coordinates"


@pytest.mark.parametrize(
    ("crs", "datum", "begins"),
    [("EPSG:32632", "same", "PROJCS["), ("EPSG:2056", "EPSG:4932", "PROJCS["), ("EPSG:4978", "same", "GEOCCS[")],
)
def test_wkt_for_files_is_given(crs: str, datum: str, begins: str) -> None:
    frame = Mapping(crs, datum=datum, accuracy_m=0.1)
    assert frame.wkt.startswith(begins)
    assert CRS.from_wkt(frame.wkt) == CRS(crs)


def test_a_three_dimensional_frame_may_be_given_as_text() -> None:
    """Its heights are on its own ellipsoid; the WKT written is that of the horizontal CRS."""
    frame = Mapping(CRS("EPSG:2056").to_3d().to_wkt(), datum="EPSG:4932", accuracy_m=0.1)
    expected = pipeline(TO_CH1903, BESSEL, LV95).transform(*at(47.1, 8.5, 480.0).T)
    np.testing.assert_allclose(frame.exact(at(47.1, 8.5, 480.0))[0], np.ravel(expected), atol=1e-6)
    assert frame.description()["heights"] == "ellipsoidal (Bessel 1841)"
    assert CRS.from_wkt(frame.wkt) == CRS("EPSG:2056")


def test_places_without_coordinates_are_refused() -> None:
    frame = Mapping("EPSG:32632")
    with pytest.raises(MappingError, match="positions that are not numbers"):
        frame.map_from_e(np.array([at(47.5, 9.0)[0], [np.nan, 0.0, 0.0]]))
    with pytest.raises(
        MappingError, match=r"6° to 12° E, 0° to 84° N.* more than 1000 km outside, at 47\.5° N, 40\.0° W"
    ):
        frame.map_from_e(at(47.5, -40.0))
    with pytest.raises(MappingError, match="more than 1000 km outside"):
        frame.map_from_e(at(-30.0, 9.0))
    assert frame.map_from_e(at(47.5, 15.0))[0, 0] > 900_000.0  # the neighbouring zone would be usual here
    assert len(frame.map_from_e(np.empty((0, 3)))) == 0


def test_the_area_of_positions_is_found_across_the_antimeridian_and_the_pole() -> None:
    """Across the antimeridian the area takes the shorter way; around the pole it has all longitudes."""
    west, south, east, north = module._area_of(np.vstack([at(65.0, 179.0), at(66.0, -179.0)]))
    assert (round(south, 3), round(north, 3)) == (64.5, 66.5)
    assert 177.0 < west < 179.0
    assert -179.0 < east < -177.0
    assert module._area_of(np.vstack([at(89.9, lon) for lon in range(-180, 180, 10)]))[::2] == (-180.0, 180.0)


def undulation(lat_deg: Any, lon_deg: Any) -> FloatArray:
    """Return an undulation as rough as below the highest mountains."""
    x, y = 75.0 * (lon_deg - 8.0), 111.0 * (lat_deg - 47.0)
    value: FloatArray = 48.0 + 0.05 * y + np.sin(x / 7.0) * np.cos(y / 9.0) + 0.05 * np.sin(x / 1.7 + y / 2.1)
    return value


def write_gtx(path: Path, south: float, west: float, step: float, shape: tuple[int, int]) -> SingleArray:
    """Write a grid in NOAA's GTX format (big-endian, rows from south to north) and return its nodes, m."""
    lat, lon = south + step * np.arange(shape[0])[:, None], west + step * np.arange(shape[1])[None]
    nodes = undulation(lat, lon).astype(np.float32)
    path.write_bytes(struct.pack(">4d2i", south, west, step, step, *shape) + nodes.astype(">f4").tobytes())
    return nodes


def bilinear(nodes: SingleArray, south: float, west: float, step: float, lat: Any, lon: Any) -> FloatArray:
    """Interpolate bilinearly, as geoid grids prescribe."""
    row, column = (lat - south) / step, (lon - west) / step
    i, j = np.floor(row).astype(int), np.floor(column).astype(int)
    v, u, grid = row - i, column - j, nodes.astype(np.float64)
    low, high = (grid[i + k, j] * (1 - u) + grid[i + k, j + 1] * u for k in (0, 1))
    value: FloatArray = low * (1 - v) + high * v
    return value


def test_heights_above_a_grid_follow_its_bilinear_values(tmp_path: Path) -> None:
    """The grid has a spacing of 1′; points fill a small area with its creases, and lines along and across creases."""
    step = 1.0 / 60.0
    nodes = write_gtx(tmp_path / "made.gtx", 46.5, 8.0, step, (61, 61))
    frame = Mapping(f"+proj=utm +zone=32 +datum=WGS84 +geoidgrids={tmp_path}/made.gtx +type=crs")
    random = np.random.default_rng(6)
    lat = np.concatenate(
        [random.uniform(47.0, 47.02, 20_000), np.full(5_000, 47.0 + step), 47.0 + np.linspace(0, step)]
    )
    lon = np.concatenate([random.uniform(8.5, 8.52, 20_000), np.linspace(8.5, 8.52, 5_000), np.full(50, 8.5 + step)])
    height = random.uniform(400.0, 500.0, len(lat))
    points = e_from_geodetic(np.radians(lat), np.radians(lon), height)
    expected = height - bilinear(nodes, 46.5, 8.0, step, lat, lon)
    assert np.abs(frame.exact(points)[:, 2] - expected).max() < 1e-6
    assert np.abs(frame.map_from_e(points)[:, 2] - expected).max() < 1e-4
    assert np.abs(frame.map_from_e(points)[:, :2] - Mapping("EPSG:32632").exact(points)[:, :2]).max() < 1e-4
    assert frame.description()["grids"] == [f"{tmp_path}/made.gtx"]
    assert frame.wkt.startswith("COMPD_CS[")
    with pytest.raises(MappingError, match="or of its grids"):
        frame.map_from_e(at(45.0, 8.5))


def test_an_installed_grid_gives_orthometric_heights(tmp_path: Path) -> None:
    """EPSG:32632+5773 finds a file in the user's folder under the name that Debian's proj-data gives EGM96."""
    nodes = write_gtx(tmp_path / "egm96_15.gtx", -90.0, -180.0, 0.25, (721, 1440))
    script = (
        "import json, numpy as np\n"
        "from swath.georef.mapping.frame import Mapping\n"
        "from swath.georef.geodesy.earth import e_from_geodetic\n"
        "frame = Mapping('EPSG:32632+5773')\n"
        "e = e_from_geodetic(np.radians([[47.3]]), np.radians([[8.6]]), [[500.0]])[0]\n"
        "print(json.dumps([frame.exact(e)[0, 2], frame.description(), frame.wkt[:9]]))"
    )
    environment = {**os.environ, "PROJ_USER_WRITABLE_DIRECTORY": str(tmp_path)}
    run = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True, env=environment)
    height, stated, wkt = json.loads(run.stdout)
    expected = 500.0 - bilinear(nodes, -90.0, -180.0, 0.25, np.array([47.3]), np.array([8.6]))[0]
    assert height == pytest.approx(expected, abs=1e-5)
    assert stated["heights"] == "EGM96 height"
    assert stated["grids"] == ["us_nga_egm96_15.tif"]
    assert stated["stated_accuracy_m"] == 1.0
    assert wkt == "COMPD_CS["


@pytest.mark.parametrize(
    ("crs", "lat_deg", "lon_deg", "words"),
    [
        # 12° E − 8.9° E at 47.5° N: 3.1 · 111.2 km · cos 47.5° = 233 km
        ("EPSG:32633", 47.5, 8.9, ("used from 12° to 18° E", "and 233 km away", '"EPSG:32632"')),
        ("EPSG:25833", 47.5, 8.9, ('"EPSG:25832"',)),
        ("EPSG:3857", 47.5, 8.9, ("1.48", '"EPSG:32632"')),  # 1 / cos 47.5° = 1.480
        ("EPSG:32732", 47.5, 8.9, ("is used from", '"EPSG:32632"')),
        ("EPSG:3857", -33.0, 151.0, ('"EPSG:32756"',)),
    ],
)
def test_error_for_a_frame_of_another_place_or_scale_names_the_local_zone(
    crs: str, lat_deg: float, lon_deg: float, words: tuple[str, ...]
) -> None:
    said = Mapping(crs, datum="same").misfit(at(lat_deg, lon_deg))
    assert "\n" not in said
    for word in words:
        assert word in said


@pytest.mark.parametrize(
    ("crs", "lat_deg", "lon_deg"),
    [
        ("EPSG:32632", 47.5, 8.9),
        ("EPSG:32632", 47.5, 12.4),  # 30 km beyond the zone: within the overlap of neighbours
        ("EPSG:2154", 46.5, 3.0),
        ("EPSG:3857", 2.0, 8.0),  # near the equator a metre of the map is one on the ground
        ("EPSG:4978", 47.5, 8.9),
    ],
)
def test_a_frame_that_suits_the_place_is_taken(crs: str, lat_deg: float, lon_deg: float) -> None:
    assert Mapping(crs, datum="same").misfit(at(lat_deg, lon_deg)) == ""


def test_a_single_place_beyond_the_overlap_is_refused() -> None:
    assert Mapping("EPSG:32632").misfit(np.vstack([at(47.5, 11.9), at(47.5, 12.6)]))


def test_meridian_convergence_matches_the_formula_sheet() -> None:
    """To first order the convergence of a transverse Mercator projection is Δλ sin φ."""
    (position,) = at(47.5, 11.4)
    assert Mapping("EPSG:32632").convergence_rad(position) == pytest.approx(
        np.radians(2.4) * np.sin(np.radians(47.5)), rel=2e-3
    )
