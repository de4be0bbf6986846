"""Tests the readers of flight plans against files that GDAL writes, and against what users do to such files."""

from __future__ import annotations

import io
import json
import struct
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyogrio.raw
import pytest
import shapefile
from pyproj import Transformer

from swath.daemon.config.config import plan_attachment
from swath.daemon.config.load import load_config
from swath.daemon.config.tables import PlanConfig
from swath.daemon.processing.flightplan.plan import FlightPlan, PlanError
from swath.daemon.processing.flightplan.read import plan_of, read_plan
from swath.daemon.processing.vector_layers import LayerError, geometry_of_wkb
from swath.georef.arrays import FloatArray
from swath.sim.plan.plan import load_plan
from swath.sim.site import Site, geodetic_from_e

LINES_DEG = [  # lat, lon, height
    np.array([[47.5, 8.9, 1500.0], [47.52, 8.95, 1510.0]]),
    np.array([[47.51, 8.9, 1500.0], [47.52, 8.93, 1500.0], [47.53, 8.95, 1520.0]]),
]
AREA_DEG = [
    np.array([[47.49, 8.88], [47.49, 8.97], [47.54, 8.97], [47.54, 8.88], [47.49, 8.88]]),
    np.array([[47.50, 8.90], [47.52, 8.90], [47.52, 8.92], [47.50, 8.92], [47.50, 8.90]]),
]
NAMES = ["4", "ost 7"]


def wkb_line(rows: FloatArray, *, multi: bool = False) -> bytes:
    """Return well-known binary of ISO's types, little-endian."""
    three = 1000 if rows.shape[1] == 3 else 0
    line = struct.pack("<BII", 1, 2 + three, len(rows)) + rows.astype("<f8").tobytes()
    return struct.pack("<BII", 1, 5 + three, 1) + line if multi else line


def wkb_polygon(rings: Sequence[FloatArray]) -> bytes:
    return struct.pack("<BII", 1, 3, len(rings)) + b"".join(
        struct.pack("<I", len(ring)) + ring.astype("<f8").tobytes() for ring in rings
    )


def projected(crs: str, lat_lon: FloatArray) -> FloatArray:
    """Return x, y and possibly z by PROJ alone."""
    x, y = Transformer.from_crs("EPSG:4326", crs, always_xy=True).transform(lat_lon[:, 1], lat_lon[:, 0])
    return np.column_stack([x, y, *lat_lon.T[2:]])


def by_gdal(path: Path, driver: str, crs: str, geometries: list[bytes], kind: str, **options: Any) -> None:
    """Write a layer with GDAL."""
    names = np.array(NAMES[: len(geometries)], dtype=object)
    number = np.arange(len(geometries), dtype=np.int32) + 1
    pyogrio.raw.write(
        path,
        geometry=np.array(geometries, dtype=object),
        field_data=[names, number],
        fields=np.array(["Name", "number"]),
        geometry_type=kind,
        crs=crs,
        driver=driver,
        **options,
    )


def read(path: Path, **settings: Any) -> FlightPlan:
    """Read a plan as a configuration names it."""
    files = {one.name: one.read_bytes() for one in path.parent.iterdir()}
    plan = read_plan(PlanConfig(file=path.name, **settings), files)
    assert plan is not None
    return plan


def check_lines(plan: FlightPlan, names: Sequence[str] = NAMES, *, height: bool = True) -> None:
    assert [line.name for line in plan.lines] == list(names)
    for line, wanted in zip(plan.lines, LINES_DEG, strict=True):
        np.testing.assert_allclose(np.column_stack([line.lat_deg, line.lon_deg]), wanted[:, :2], atol=2e-9)
        if height:
            np.testing.assert_allclose(line.height_m, wanted[:, 2], atol=1e-6)
        else:
            assert np.isnan(line.height_m).all()


WRITTEN = [
    ("plan.gpkg", "GPKG", "EPSG:25832", "LineString Z"),
    ("plan.gpkg", "GPKG", "EPSG:4326", "MultiLineString Z"),
    ("plan.shp", "ESRI Shapefile", "EPSG:32632", "LineString Z"),
    ("plan.shp", "ESRI Shapefile", "EPSG:2056", "LineString Z"),
    ("plan.geojson", "GeoJSON", "EPSG:4326", "LineString Z"),
    ("plan.json", "GeoJSON", "EPSG:25832", "LineString Z"),
    ("plan.kml", "KML", "EPSG:4326", "LineString Z"),
    ("plan.kml", "LIBKML", "EPSG:4326", "LineString Z"),
    ("plan.kmz", "LIBKML", "EPSG:4326", "LineString Z"),
]


@pytest.mark.parametrize(("name", "driver", "crs", "kind"), WRITTEN)
def test_lines_that_gdal_writes_are_read(name: str, driver: str, crs: str, kind: str, tmp_path: Path) -> None:
    """Places by PROJ. GDAL writes KML without an altitude mode: such heights are not used."""
    if driver == "LIBKML" and "w" not in pyogrio.list_drivers().get(driver, ""):
        pytest.skip("this GDAL writes no LIBKML")
    multi = kind.startswith("Multi")
    options = {"layer_options": {"RFC7946": "NO", "COORDINATE_PRECISION": "12"}} if driver == "GeoJSON" else {}
    by_gdal(tmp_path / name, driver, crs, [wkb_line(projected(crs, line), multi=multi) for line in LINES_DEG], kind,
            **options)  # fmt: skip
    check_lines(read(tmp_path / name), height="KML" not in driver)
    if "KML" in driver:  # the same heights as sea level's, with the geoid given
        check_lines(read(tmp_path / name, heights="geoid", undulation_m=0.0))


@pytest.mark.parametrize(("name", "driver", "crs"), [WRITTEN[place][:3] for place in (0, 2, 4, 6, 8)])
def test_polygons_with_holes_are_the_area(name: str, driver: str, crs: str, tmp_path: Path) -> None:
    if driver == "LIBKML" and "w" not in pyogrio.list_drivers().get(driver, ""):
        pytest.skip("this GDAL writes no LIBKML")
    by_gdal(tmp_path / name, driver, crs, [wkb_polygon([projected(crs, ring) for ring in AREA_DEG])], "Polygon")
    lines = {"type": "Feature", "properties": {}, "geometry": {"type": "LineString", "coordinates": [[8, 47], [9, 47]]}}
    (tmp_path / "lines.geojson").write_text(json.dumps(lines))
    plan = read(tmp_path / "lines.geojson", area=name)
    ((outer, hole),) = plan.area
    for ring, wanted in ((outer, AREA_DEG[0]), (hole, AREA_DEG[1])):
        box = (*ring.min(axis=0), *ring.max(axis=0))
        np.testing.assert_allclose(box, (*wanted.min(axis=0), *wanted.max(axis=0)), atol=2e-7)
        assert len(ring) == 5


def test_lines_and_area_stand_in_layers_of_one_geopackage(tmp_path: Path) -> None:
    path = tmp_path / "plan.gpkg"
    for layer, crs in (("lines", "EPSG:25832"), ("old", "EPSG:4326")):
        rows = [wkb_line(projected(crs, line)) for line in LINES_DEG]
        by_gdal(path, "GPKG", crs, rows, "LineString Z", layer=layer, append=path.exists())
    by_gdal(path, "GPKG", "EPSG:4326", [wkb_polygon([AREA_DEG[0][:, ::-1]])], "Polygon", layer="area", append=True)
    check_lines(read(path, layer="lines"))
    plan = read(path)
    assert [line.name for line in plan.lines] == ["4", "ost 7", "4 (2)", "ost 7 (2)"]
    assert len(plan.area) == 1
    assert plan.notes[0] == 'plan.gpkg: the name "4" occurs more than once; one of its lines is called "4 (2)"'
    assert [line.name for line in read(path, layer="old", names="number").lines] == ["1", "2"]
    with pytest.raises(PlanError, match=r'^plan.gpkg: has no layer "x"; it has: lines, old, area$'):
        read(path, layer="x")
    with pytest.raises(PlanError, match=r'no attribute "zeile"; set plan.names to one of: fid, Name, number$'):
        read(path, names="zeile")


def test_a_sim_plans_lines_lie_where_the_virtual_aircraft_flies(tmp_path: Path) -> None:
    """The tangent plane is compared with that of the virtual aircraft, which is PROJ's."""
    tables = load_plan("block").tables
    (tmp_path / "plan.toml").write_text(load_plan("block").text)
    plan = read(tmp_path / "plan.toml")
    assert [line.name for line in plan.lines] == [line.name for line in tables.line]
    site = Site.at(*tables.flight.origin_deg)
    for line, wanted in zip(plan.lines, tables.line, strict=True):
        ends = np.array([wanted.from_m, wanted.to_m])
        e = site.e_from_site(site.site_from_ground(ends[:, 0], ends[:, 1], np.full(2, wanted.height_m)))
        lat, lon, _ = geodetic_from_e(e)
        np.testing.assert_allclose(np.radians(line.lat_deg), lat, atol=1e-11)
        np.testing.assert_allclose(np.radians(line.lon_deg), lon, atol=1e-11)
        assert line.height_m.tolist() == [wanted.height_m] * 2
        assert line.speed_mps == 65.0


KML = """<?xml version="1.0" encoding="UTF-8"?><kml xmlns="http://www.opengis.net/kml/2.2"><Document><Folder>
<Placemark><name>L1</name><ExtendedData><Data name="run"><value>17</value></Data></ExtendedData><LineString>
<altitudeMode>{mode}</altitudeMode><coordinates> 8.9,47.5,1452 8.95, 47.52, 1462
</coordinates></LineString></Placemark><Placemark><name>home</name><Point><coordinates>8,47</coordinates></Point>
</Placemark></Folder></Document></kml>"""


def test_altitude_modes_of_kml_say_what_heights_count_from(tmp_path: Path) -> None:
    path = tmp_path / "plan.kml"
    path.write_text(KML.format(mode="absolute"))
    assert read(path, undulation_m=48.0).lines[0].height_m.tolist() == [1500.0, 1510.0]
    assert read(path, heights="ellipsoid", names="run").lines[0].name == "17"
    with pytest.raises(PlanError, match=r"^plan.kml: line L1 \(placemark 1\): its heights count from sea level"):
        read(path)
    path.write_text(KML.format(mode="relativeToGround"))
    line = read(path).lines[0]
    assert line.above_ground_m.tolist() == [1452.0, 1462.0]
    assert np.isnan(line.height_m).all()
    path.write_text(KML.format(mode="clampToGround"))
    assert np.isnan(read(path).lines[0].above_ground_m).all()


def feature(kind: str, coordinates: Any, **properties: Any) -> dict[str, Any]:
    return {"type": "Feature", "properties": properties, "geometry": {"type": kind, "coordinates": coordinates}}


def test_names_and_parts_of_lines_are_made_unique_and_told(tmp_path: Path) -> None:
    path = tmp_path / "plan.geojson"
    one, two, far = [[8.0, 47.0], [8.1, 47.0]], [[8.1, 47.0], [8.1, 47.0], [8.2, 47.1]], [[9.0, 47.0], [9.1, 47.0]]
    features = [feature("LineString", one), feature("MultiLineString", [one, two, far])]
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    plan = read(path)
    assert [(line.name, len(line.lat_deg)) for line in plan.lines] == [("1", 2), ("2-1", 3), ("2-2", 2)]
    assert plan.notes == (
        "plan.geojson: its lines have no names; they are numbered in the order of the file",
        "plan.geojson: line 2 has 2 parts, which are lines of their own: 2-1, 2-2, …",
    )


@pytest.mark.parametrize(
    ("name", "data", "line"),
    [
        ("a.kml", b"<kml><Placemark>", "a.kml: is not KML: no element found: line 1, column 16; export it anew"),
        ("a.kml", b'<!DOCTYPE k [<!ENTITY a "b">]><kml>&a;</kml>', "a.kml: has a document type declaration, which"),
        ("a.kml", b"<kml><Placemark><LineString><coordinates>1,x 2,3</coordinates></LineString></Placemark></kml>",
         "a.kml: placemark 1: its coordinates are not numbers"),
        ("a.kml", b"<kml/>", "a.kml: has no lines; give the file of the flight lines"),
        ("a.kmz", b"PK\x05\x06", "a.kmz: is not a KMZ archive"),
        ("a.geojson", b"[" * 100_000, "a.geojson: is not JSON: "),
        ("a.geojson", b'{"type": "Feature", "geometry": {"type": "LineString", "coordinates": [[1, "2"], [3, 4]]}}',
         "a.geojson: feature 1: has a position that is not two or three numbers"),
        ("a.geojson", b'{"type": "LineString", "coordinates": [[500000, 5200000], [500000, 5200001]]}',
         "a.geojson: line 1 (feature 1): latitude "),
        ("a.geojson", b'{"type": "LineString", "coordinates": [[8, 47], [8, 47]]}',
         "a.geojson: line 1 (feature 1): has no two different vertices; remove it or draw it anew"),
        ("a.geojson", b'{"type": "Polygon", "coordinates": [[[8, 47], [8, 48], [8, 47]]]}', "a.geojson: has no lines"),
        ("a.toml", b"[flight]\nname = 1", "a.toml: is not a plan of swath sim; want the tables [flight] and [[line]]"),
        ("a.gpkg", b"SQLite format 3\0" + bytes(200), "a.gpkg: cannot be read as a GeoPackage: "),
        ("a.shp", bytes(120), "a.shp: cannot be read as a shapefile: "),
    ],
    ids=range(13),
)  # fmt: skip
def test_broken_files_are_refused_in_one_line(name: str, data: bytes, line: str) -> None:
    with pytest.raises(PlanError) as error:
        read_plan(PlanConfig(file=name), {name: data})
    assert str(error.value).startswith(line)
    assert len(str(error.value).splitlines()) == 1


def test_a_shapefile_without_prj_needs_a_crs_and_one_without_dbf_has_no_names(tmp_path: Path) -> None:
    with shapefile.Writer(str(tmp_path / "plan"), shapeType=shapefile.POLYLINE) as writer:
        writer.field("Flüge", "C")
        for name, line in zip(["Über 1", "2"], LINES_DEG, strict=True):
            writer.line([projected("EPSG:25832", line)[:, :2].tolist()])
            writer.record(name)
    with pytest.raises(PlanError, match=r'has no coordinate system; say it with plan.crs, such as "EPSG:25832"$'):
        read(tmp_path / "plan.shp")
    check_lines(read(tmp_path / "plan.shp", crs="EPSG:25832", names="Flüge"), ["Über 1", "2"], height=False)
    (tmp_path / "plan.dbf").unlink()
    check_lines(read(tmp_path / "plan.shp", crs="EPSG:25832"), ["1", "2"], height=False)
    with pytest.raises(PlanError, match=r'^plan.shp: the coordinate system "EPSG:1" is not known to PROJ'):
        read(tmp_path / "plan.shp", crs="EPSG:1")


def test_200_lines_are_read_and_more_than_2000_refused(tmp_path: Path) -> None:
    rows = [feature("LineString", [[8.0, 47 + i / 1000], [8.1, 47 + i / 1000]], id=i) for i in range(2001)]
    path = tmp_path / "plan.geojson"
    path.write_text(json.dumps({"type": "FeatureCollection", "features": rows[:200]}))
    assert [line.name for line in read(path).lines] == [str(i) for i in range(200)]
    path.write_text(json.dumps({"type": "FeatureCollection", "features": rows}))
    with pytest.raises(PlanError, match="has 2001 lines, more than 2000"):
        read(path)


def test_logs_store_the_plan_and_the_files_beside_a_shapefile(tmp_path: Path) -> None:
    rows = [wkb_line(projected("EPSG:25832", line)) for line in LINES_DEG]
    by_gdal(tmp_path / "Plan.shp", "ESRI Shapefile", "EPSG:25832", rows, "LineString Z")
    (tmp_path / "a.toml").write_text('[session]\nname = "x"\n[plan]\nfile = "Plan.shp"\n')
    config = load_config(tmp_path / "a.toml")
    stored = {name: data for name, _, data in config.attachments()}
    assert sorted(stored) == ["config.toml", *(f"plan/Plan.{one}" for one in ("cpg", "dbf", "prj", "shp"))]
    plan = plan_of(config, stored)
    assert plan is not None
    check_lines(plan)
    del stored[plan_attachment("Plan.shp")]
    with pytest.raises(PlanError, match=r"^Plan.shp: is not stored with the log; add the file and begin"):
        plan_of(config, stored)


def test_geometries_of_other_programs_are_taken_apart() -> None:
    """Types by hand: EWKB with SRID and Z of PostGIS, big-endian ISO with measures, and collections without end."""
    ewkb = struct.pack("<BIII", 1, 0x20000000 | 0x80000000 | 2, 4326, 1) + struct.pack("<3d", 1, 2, 3)
    assert geometry_of_wkb(ewkb).lines[0].tolist() == [[1.0, 2.0, 3.0]]
    measured = struct.pack(">BII", 0, 3002, 1) + struct.pack(">4d", 1, 2, 3, 4)
    assert geometry_of_wkb(measured).lines[0].tolist() == [[1.0, 2.0, 3.0]]
    for broken in (b"", ewkb[:-1], struct.pack("<BII", 1, 7, 1) * 20, struct.pack("<BI", 1, 8)):
        with pytest.raises(LayerError):
            geometry_of_wkb(broken)


def test_a_kmz_that_unpacks_to_too_much_is_refused() -> None:
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("doc.kml", bytes(70 << 20))
    with pytest.raises(PlanError, match="more than 64 MiB"):
        read_plan(PlanConfig(file="a.kmz"), {"a.kmz": packed.getvalue()})
