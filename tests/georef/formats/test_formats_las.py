"""Tests LAZ and COPC as written against laspy and the definitions of LAS 1.4."""

from __future__ import annotations

import datetime as dt
import io
import struct
import sys
import tempfile
from dataclasses import replace

import laspy
import numpy as np
import pytest
from pyproj import CRS

from swath.georef.formats.copc import NODE_POINTS, CopcWriter
from swath.georef.formats.las import BLOCK, Clipped, LasError, LasSettings, LasWriter
from swath.georef.points import Points

pytestmark = pytest.mark.xdist_group("kernels")

WKT = CRS.from_epsg(25832).to_wkt("WKT1_GDAL")
SETTINGS = LasSettings(
    WKT,
    (500_000.0, 5_400_000.0, 0.0),
    creation_date=dt.date(2026, 11, 21),
    software="swath 1.2",
    system_identifier="srep",
    provenance='{"calibration": "ä"}',
)
GPS_NS = 1_479_297_618 * 10**9  # 2026-11-21T12:00:00Z with 18 leap seconds (FORMULAS 12)


def made(n: int, *, sigmas: bool = True) -> Points:
    """Return n deterministic points over two kilometres, with different values in every field that can vary."""
    rng = np.random.default_rng(5)
    xyz = np.array([500_000.0, 5_400_000.0, 450.0]) + rng.uniform(-1, 1, (n, 3)) * [900.0, 1200.0, 30.0]
    of = rng.integers(1, 6, n).astype(np.uint8)
    return Points(
        time_ns=GPS_NS + np.arange(n, dtype=np.int64) * 9_973,
        points_map=xyz,
        sigma_map=rng.uniform(0.001, 0.2, (n, 3)).astype(np.float32) if sigmas else None,
        scan_angle_rad=rng.uniform(-0.7, 0.7, n).astype(np.float32),
        range_m=np.full(n, 700.0, np.float32),
        intensity=rng.uniform(0, 65_000, n).astype(np.float32),
        return_number=np.minimum(of, 1 + np.arange(n) % 3).astype(np.uint8),
        number_of_returns=of,
        channel=(np.arange(n) % 128).astype(np.uint16),
        mta_zone=np.zeros(n, np.uint8),
    )


def written(points: Points, settings: LasSettings = SETTINGS, *, cuts: tuple[int, ...] = ()) -> tuple[bytes, Clipped]:
    """Return the bytes of a LAS file whose points were written in pieces, and the count of clipped values."""
    stream = io.BytesIO()
    writer = LasWriter(stream, settings, 7)
    for first, last in zip((0, *cuts), (*cuts, len(points)), strict=True):
        writer.write(points.take(slice(first, last)), scanner=2)
    writer.close()
    return stream.getvalue(), writer.clipped


def read(data: bytes) -> laspy.LasData:
    """Read the file with laspy."""
    return laspy.read(io.BytesIO(data))


def test_every_field_is_read_back() -> None:
    points = made(70_000)  # more than two blocks and a chunk
    las = read(written(points)[0])
    assert (las.header.point_format.id, str(las.header.version)) == (6, "1.4")
    assert np.abs(las.xyz - points.points_map).max() <= 0.0005 + 1e-9
    assert np.abs(np.asarray(las.gps_time) - (points.time_ns - 10**18) / 1e9).max() <= 6e-8  # resolution of LAS doubles
    assert np.array_equal(las.return_number, points.return_number)
    assert np.array_equal(las.number_of_returns, points.number_of_returns)
    assert np.array_equal(las.intensity, np.rint(points.intensity))
    assert np.array_equal(las.user_data, points.channel)
    angles = np.asarray(las.scan_angle) * 0.006
    assert np.abs(angles - np.degrees(points.scan_angle_rad.astype(np.float64))).max() <= 0.003 + 1e-6
    assert set(np.asarray(las.point_source_id)) == {7}
    assert set(np.asarray(las.scanner_channel)) == {2}
    assert not np.asarray(las.classification).any()
    assert not np.asarray(las.withheld).any()
    assert points.sigma_map is not None
    for axis, name in enumerate(("sigma_easting", "sigma_northing", "sigma_height")):
        assert np.abs(las[name] - points.sigma_map[:, axis]).max() <= 0.00005 + 1e-8


def test_the_header_describes_the_points() -> None:
    points = made(5_000)
    header = read(written(points)[0]).header
    assert header.global_encoding.gps_time_type == laspy.header.GpsTimeType.STANDARD
    assert header.global_encoding.wkt
    assert header.parse_crs() == CRS.from_epsg(25832)
    assert (header.generating_software, header.system_identifier) == ("swath 1.2", "srep")
    assert (header.creation_date, header.file_source_id) == (dt.date(2026, 11, 21), 7)
    low, high = np.round(points.points_map, 3).min(axis=0), np.round(points.points_map, 3).max(axis=0)
    assert np.allclose(header.mins, low, atol=1e-6)
    assert np.allclose(header.maxs, high, atol=1e-6)
    assert header.point_count == 5_000
    expected = np.bincount(points.return_number, minlength=16)[1:]
    assert np.array_equal(header.number_of_points_by_return, expected)
    ours = next(vlr for vlr in header.vlrs if vlr.user_id == "swath")
    assert ours.record_data.decode() == '{"calibration": "ä"}'


def test_the_header_layout_matches_the_standard() -> None:
    """The offsets of the fields are those of LAS 1.4-R15, table 3."""
    data = written(made(100))[0]
    assert data[:4] == b"LASF"
    assert struct.unpack_from("<H", data, 6) == (0b10001,)
    assert data[24:26] == bytes([1, 4])
    assert struct.unpack_from("<HHH", data, 90) == (325, 2026, 375)  # 21 November is day 325
    assert (data[104], struct.unpack_from("<H", data, 105)) == (6 | 128, (36,))
    assert struct.unpack_from("<6I", data, 107) == (0,) * 6
    assert struct.unpack_from("<Q", data, 247) == (100,)


def test_adjusted_time_matches_the_formula_sheet() -> None:
    """By FORMULAS 12, 2026-11-21T12:00:00Z is 479297618 in a LAS file."""
    assert read(written(made(1))[0]).gps_time[0] == 479_297_618.0


def test_bytes_do_not_depend_on_how_points_are_divided() -> None:
    points = made(2 * BLOCK + 500)
    whole = written(points)[0]
    assert written(points, cuts=(1, 17, BLOCK, BLOCK + 40_000))[0] == whole
    assert written(points)[0] == whole


def test_columns_that_are_asked_for_are_read_back() -> None:
    points, rng = made(70_000), np.random.default_rng(6)
    points.incidence_rad = rng.uniform(0.0, np.pi / 2, len(points)).astype(np.float32)
    points.surface = rng.integers(1, 4, len(points)).astype(np.uint8)
    points.range_sigma_m = rng.uniform(0.01, 7.0, len(points)).astype(np.float32)
    points.covariance_map = rng.normal(0.0, 1e-3, (len(points), 6)).astype(np.float32)
    settings = replace(SETTINGS, incidence=True, range_sigma=True, covariances=True)
    las = read(written(points, settings, cuts=(40_000,))[0])
    names = ["covariance_ee", "covariance_en", "covariance_eh", "covariance_nn", "covariance_nh", "covariance_hh"]
    assert list(las.point_format.extra_dimension_names) == [
        "sigma_easting", "sigma_northing", "sigma_height", "incidence_angle", "surface", "sigma_range", *names,
    ]  # fmt: skip
    assert np.abs(las["incidence_angle"] - np.degrees(points.incidence_rad.astype(np.float64))).max() <= 0.0051
    assert np.array_equal(las["surface"], points.surface)
    assert np.abs(las["sigma_range"] - np.minimum(points.range_sigma_m, 6.5535)).max() <= 5.1e-5
    assert np.array_equal(np.stack([las[name] for name in names], axis=1), points.covariance_map)
    assert points.sigma_map is not None
    assert np.abs(las["sigma_height"] - points.sigma_map[:, 2]).max() <= 5.1e-5
    asked = {
        "incidence": replace(SETTINGS, incidence=True),
        "range sigma": replace(SETTINGS, range_sigma=True),
        "covariances": replace(SETTINGS, covariances=True),
    }
    for wanted, settings in asked.items():
        with pytest.raises(LasError, match=f"have no {wanted}"):
            written(made(10), settings)


def test_a_file_without_sigmas_has_no_extra_bytes() -> None:
    las = read(written(made(100, sigmas=False), replace(SETTINGS, sigmas=False))[0])
    assert list(las.point_format.extra_dimension_names) == []
    with pytest.raises(LasError, match="have no sigmas"):
        written(made(10, sigmas=False))


def test_values_that_do_not_fit_are_clipped_and_counted() -> None:
    points = made(6)
    points.sigma_map = np.full((6, 3), 0.01, np.float32)
    points.sigma_map[1, 0], points.sigma_map[2, 2], points.sigma_map[3] = 6.6, 1e9, np.nan
    points.sigma_map[4, 1] = 6.5534
    points.intensity[:3] = [65_536.0, -3.0, 65_535.0]
    data, clipped = written(points)
    las = read(data)
    assert clipped == Clipped(sigma=2, sigma_unknown=1, intensity=1)
    assert las["sigma_easting"].array.tolist() == [100, 65535, 100, 65535, 100, 100]
    assert las["sigma_height"].array.tolist() == [100, 100, 65535, 65535, 100, 100]
    assert las["sigma_northing"].array.tolist()[4] == 65_534
    assert np.asarray(las.intensity)[:3].tolist() == [65_535, 0, 65_535]


def test_azimuths_are_written_as_angles_relative_to_the_first() -> None:
    points = made(4)
    points.scan_angle_rad = np.radians([0.0, 90.0, 270.0, 359.0]).astype(np.float32)
    assert np.asarray(read(written(points)[0]).scan_angle).tolist() == [0, 15_000, -15_000, -167]


def test_more_returns_or_channels_than_a_field_holds_are_clipped() -> None:
    points = made(2)
    points.return_number[:], points.number_of_returns[:], points.channel[:] = 16, 20, 300
    las = read(written(points)[0])
    assert (las.return_number[0], las.number_of_returns[0], las.user_data[0]) == (15, 15, 255)


@pytest.mark.parametrize(
    ("axis", "value", "name"), [(0, 3_000_000.0, "easting"), (2, -2.2e6, "height"), (1, np.nan, "")]
)
def test_coordinates_beyond_the_scale_are_refused(axis: int, value: float, name: str) -> None:
    points = made(20)
    points.points_map[13, axis] = value
    with pytest.raises(LasError, match=f"{name}.*exceeds the range of a LAS file of scale 0.001"):
        written(points)


def test_the_largest_coordinate_that_fits_is_written() -> None:
    points = made(2)
    points.points_map[1, 0] = 500_000.0 + 2_147_483.647
    assert read(written(points)[0]).X[1] == 2_147_483_647
    finer = replace(SETTINGS, scale=(0.0001, 0.0001, 0.0001))
    points.points_map[1, 0] = 500_000.0 + 200_000.12345
    assert abs(read(written(points, finer)[0]).x[1] - 700_000.12345) <= 0.00005 + 1e-9


def test_unusable_points_are_withheld_and_intensities_are_scaled() -> None:
    stream = io.BytesIO()
    writer = LasWriter(stream, SETTINGS, 1)
    points = made(10)
    points.intensity[:] = 100.0
    writer.write(points, withheld=True, intensity_factor=257.0, scanner=9)
    writer.close()
    las = read(stream.getvalue())
    assert np.asarray(las.withheld).all()
    assert set(np.asarray(las.intensity)) == {25_700}
    assert set(np.asarray(las.scanner_channel)) == {3}


def test_a_file_without_points_is_valid() -> None:
    las = read(written(made(0))[0])
    assert len(las) == 0
    assert las.header.mins.tolist() == [0.0, 0.0, 0.0]


# ---------------------------------------------------------------------- COPC


def copc(points: Points) -> bytes:
    """Return the bytes of a COPC file of points."""
    stream = io.BytesIO()
    with tempfile.TemporaryFile() as spool, tempfile.TemporaryFile() as ordered:
        writer = CopcWriter(stream, (spool, ordered), SETTINGS, 7)
        for first in range(0, len(points), 100_000):
            writer.write(points.take(slice(first, first + 100_000)))
        writer.close()
    return stream.getvalue()


@pytest.fixture(scope="module")
def tree() -> tuple[Points, bytes]:
    """Return enough points for three levels of a COPC file, and that file."""
    points = made(6 * NODE_POINTS)
    return points, copc(points)


@pytest.mark.slow
def test_copc_holds_the_same_points(tree: tuple[Points, bytes]) -> None:
    points, data = tree
    with laspy.CopcReader(io.BytesIO(data)) as reader:
        found = reader.query()
    order = np.argsort(np.asarray(found.gps_time))
    plain = read(written(points)[0])
    for name in ("X", "Y", "Z", "intensity", "return_number", "sigma_northing", "point_source_id", "scan_angle"):
        assert np.array_equal(np.asarray(found[name])[order], np.asarray(plain[name])), name


def test_a_part_of_a_copc_file_can_be_read_alone(tree: tuple[Points, bytes]) -> None:
    points, data = tree
    with laspy.CopcReader(io.BytesIO(data)) as reader:
        coarse = reader.query(level=0)
        low, high = np.array([500_100.0, 5_399_900.0]), np.array([500_300.0, 5_400_200.0])
        within = reader.query(laspy.Bounds(low, high))
        info = reader.copc_info
    assert 0.95 * NODE_POINTS < len(coarse) < 1.05 * NODE_POINTS
    quarters = np.histogram2d(coarse.x, coarse.y, bins=4)[0]  # the overview covers everything evenly
    assert quarters.min() > 0.9 * quarters.mean()
    rounded = np.round(points.points_map[:, :2], 3)
    assert len(within) == int(((rounded >= low) & (rounded <= high)).all(axis=1).sum())
    assert (info.gps_min, info.gps_max) == (479_297_618.0, (points.time_ns[-1] - 10**18) / 1e9)


@pytest.mark.skipif(sys.version_info >= (3, 14), reason="copclib has no wheel for this Python")
def test_a_copc_file_is_read_by_other_software_and_is_reproducible(
    tree: tuple[Points, bytes], tmp_path: object
) -> None:
    import copclib

    points, data = tree
    path = f"{tmp_path}/a.copc.laz"
    with open(path, "wb") as file:
        file.write(data)
    reader = copclib.FileReader(path)
    nodes = reader.GetAllNodes()
    assert sum(node.point_count for node in nodes) == len(points)
    header = reader.copc_config.las_header
    for node in nodes[:3]:
        assert reader.GetPoints(node).Within(copclib.Box(node.key, header))
    assert copc(points) == data


def test_a_copc_file_of_few_or_no_points_is_valid() -> None:
    with laspy.CopcReader(io.BytesIO(copc(made(10)))) as reader:
        assert len(reader.query()) == 10
    assert len(read(copc(made(0)))) == 0
