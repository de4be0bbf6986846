"""Tests control in layers of GIS programs: GeoPackage and shapefile."""

from __future__ import annotations

import sqlite3
import struct
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
import shapefile
from pyproj import CRS

from swath.daemon.errors import ExitCode, UserError
from swath.daemon.processing.control.columns import Role
from swath.daemon.processing.control.files import ControlFile, read_control_file
from swath.daemon.processing.control.place import place_control
from swath.georef.mapping.frame import Mapping
from tests.daemon.processing.control.builders import FLIGHT, LAT_LON_H, NAMES, utm32

ENVELOPE = 0b0010  # bits of the flags: an envelope x, y


def blob(place: list[float], *, order: str = "<", envelope: bool = False, srs: int = 32632) -> bytes:
    """Return a point as a GeoPackage holds it (OGC 12-128r19, 2.1.3), with z if it has three ordinates."""
    flags = (1 if order == "<" else 0) | (ENVELOPE if envelope else 0)
    box = struct.pack(f"{order}4d", place[0], place[0], place[1], place[1]) if envelope else b""
    head = b"GP" + bytes([0, flags]) + struct.pack(f"{order}i", srs)
    kind = 1001 if len(place) == 3 else 1
    return head + box + bytes([order == "<"]) + struct.pack(f"{order}I{len(place)}d", kind, *place)


def geopackage(path: Path, points: list[bytes | None], columns: dict[str, list[object]], srs: int = 32632) -> Path:
    """Write a GeoPackage with the tables that a reader needs."""
    with closing(sqlite3.connect(path)) as database:
        database.executescript(
            "CREATE TABLE gpkg_spatial_ref_sys (srs_name TEXT, srs_id INTEGER PRIMARY KEY, organization TEXT, "
            "organization_coordsys_id INTEGER, definition TEXT);"
            "CREATE TABLE gpkg_geometry_columns (table_name TEXT, column_name TEXT, geometry_type_name TEXT, "
            "srs_id INTEGER, z TINYINT, m TINYINT);"
        )
        database.execute(
            "INSERT INTO gpkg_spatial_ref_sys VALUES ('', ?, ?, ?, ?)",
            (srs, "EPSG" if srs < 100_000 else "NONE", srs, CRS.from_epsg(32632).to_wkt()),
        )
        database.execute(
            "INSERT INTO gpkg_geometry_columns VALUES ('control points', 'geom', 'POINT', ?, 1, 0)", (srs,)
        )
        names = "".join(f', "{name}"' for name in columns)
        database.execute(f'CREATE TABLE "control points" (fid INTEGER PRIMARY KEY, geom BLOB{names})')
        for number, point in enumerate(points):
            row = (number + 1, point, *(values[number] for values in columns.values()))
            database.execute(f'INSERT INTO "control points" VALUES ({", ".join("?" * len(row))})', row)
        database.commit()
    return path


def shape(path: Path, *, kind: int = shapefile.POINTZ, prj: str | None = "ESRI") -> Path:
    """Write a shapefile of the points."""
    with shapefile.Writer(str(path), shapeType=kind) as writer:
        writer.field("PointID", "C", size=20)
        writer.field("Elevation", "N", size=12, decimal=3)
        writer.field("StdDev", "N", size=8, decimal=3)
        for name, (east, north, height) in zip(NAMES, utm32(), strict=True):
            writer.pointz(east, north, height) if kind == shapefile.POINTZ else writer.point(east, north)
            writer.record(name, height, 0.015)
    if prj is not None:
        path.with_suffix(".prj").write_text(CRS.from_epsg(32632).to_wkt("WKT1_ESRI"))
    return path


def read(path: Path) -> ControlFile:
    """Read a file that the command line names."""
    found = read_control_file(path)
    assert found is not None
    return found


def is_right(control: ControlFile) -> bool:
    """Return whether the points lie where they were surveyed, for a project in another CRS."""
    found = place_control(control.table, control.crs, Mapping("EPSG:32633", datum="same"), FLIGHT)
    places = [[np.degrees(one.lat_rad), np.degrees(one.lon_rad), one.height_m] for one in found.points]
    apart = np.abs(np.array(places) - LAT_LON_H) * [111_000.0, 75_000.0, 1.0]
    return [one.name for one in found.points] == list(NAMES) and bool(apart.max() < 1e-3)


@pytest.mark.parametrize(("order", "envelope", "srs"), [("<", False, 32632), (">", True, 32632), ("<", True, 123_456)])
def test_points_of_a_geopackage_are_read_with_their_crs(order: str, envelope: bool, srs: int, tmp_path: Path) -> None:
    points: list[bytes | None] = [blob(place, order=order, envelope=envelope, srs=srs) for place in utm32().tolist()]
    path = geopackage(
        tmp_path / "c.gpkg", points, {"name": list(NAMES), "code": [None] * 3, "sigma": [0.01, None, 0.03]}, srs
    )
    control = read(path)
    assert control.table.crs == "EPSG:32632"
    assert control.table.notes == ("heights are those of the geometry",)
    assert control.table.sigma_m == pytest.approx([0.01, np.nan, 0.03], nan_ok=True)
    assert is_right(control)


def test_heights_may_be_in_a_column_and_names_be_missing(tmp_path: Path) -> None:
    flat: list[bytes | None] = [blob(place[:2]) for place in utm32().tolist()]
    control = read(geopackage(tmp_path / "a.gpkg", flat, {"Höhe": utm32()[:, 2].tolist()}))
    assert control.table.names == ("1", "2", "3")
    assert control.table.heights[Role.HEIGHT] == pytest.approx(utm32()[:, 2])
    drawn: list[bytes | None] = [blob([*place[:2], 0.0]) for place in utm32().tolist()]
    control = read(geopackage(tmp_path / "b.gpkg", drawn, {"name": list(NAMES), "Elevation": utm32()[:, 2].tolist()}))
    assert control.table.notes == ("heights are Elevation",)
    assert is_right(control)


@pytest.mark.parametrize("kind", [shapefile.POINTZ, shapefile.POINT])
def test_points_of_a_shapefile_are_read_with_their_crs(kind: int, tmp_path: Path) -> None:
    control = read(shape(tmp_path / "c.shp", kind=kind))
    assert control.table.crs == "EPSG:32632"
    assert control.table.sigma_m.tolist() == [0.015] * 3
    assert is_right(control)
    assert read(shape(tmp_path / "d.shp", prj=None)).table.crs == ""


def test_layers_that_are_no_control_are_refused_in_one_line(tmp_path: Path) -> None:
    def refused(path: Path, columns: str | None = None) -> str:
        with pytest.raises(UserError) as error:
            read_control_file(path, None, columns)
        assert "\n" not in error.value.message
        assert error.value.message.startswith(f"{path}: ")
        return error.value.message

    flat: list[bytes | None] = [blob(place[:2]) for place in utm32().tolist()]
    assert "the points have no heights" in refused(geopackage(tmp_path / "a.gpkg", flat, {"name": list(NAMES)}))
    line = struct.pack("<BI", 1, 2)
    assert "feature 2: has no point" in refused(
        geopackage(tmp_path / "b.gpkg", [flat[0], b"GP\0\1" + bytes(4) + line, None], {"h": [1, 2, 3]})
    )
    assert "has no points" in refused(geopackage(tmp_path / "e.gpkg", [], {"h": []}))
    assert "--control-columns is for text files" in refused(tmp_path / "e.gpkg", "name,E,N,H")
    (tmp_path / "c.gpkg").write_text("name,E,N,H\n")
    assert "cannot be read as a GeoPackage: file is not a database" in refused(tmp_path / "c.gpkg")
    (tmp_path / "c.shp").write_bytes(b"no shapefile")
    assert "cannot be read as a shapefile" in refused(tmp_path / "c.shp")
    with shapefile.Writer(str(tmp_path / "d.shp"), shapeType=shapefile.POLYLINE) as writer:
        writer.field("name", "C")
        writer.line([[[0.0, 0.0], [1.0, 1.0]]])
        writer.record("road")
    assert "holds polyline instead of points" in refused(tmp_path / "d.shp")
    with pytest.raises(UserError) as error:
        read_control_file(tmp_path / "nowhere.shp")
    assert error.value.exit_code == ExitCode.IO
