"""Tests control as text: layouts of Trimble, Leica and plain files, and the refusal of others."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from swath.calib.control.points import ControlError
from swath.daemon.errors import ExitCode, UserError
from swath.daemon.processing.control.columns import Role, column_of, given_columns
from swath.daemon.processing.control.files import read_control_file
from swath.daemon.processing.control.table import HEADER, degrees_of
from swath.daemon.processing.control.text import read_text
from swath.georef.arrays import FloatArray
from tests.daemon.processing.control.builders import EXPORTS, NAMES, rows, utm32

ROW = "GCP1,47.4001,8.9001,512.34,0.02"
FILE = Path("control.csv")


def read(text: str, columns: str | None = None) -> FloatArray:
    """Return easting, northing, height of the points."""
    table = read_text(text, FILE, None if columns is None else given_columns(columns))
    assert table.names == NAMES
    (height,) = table.heights.values()
    return np.column_stack([table.plane, height])


@pytest.mark.parametrize("export", EXPORTS)
def test_exports_of_programs_are_read(export: str) -> None:
    np.testing.assert_allclose(read(EXPORTS[export]), utm32(), atol=6e-5)


def test_commas_may_group_digits_before_a_decimal_point() -> None:
    """Spreadsheets write coordinates so, in quotes."""
    table = read_text('Point,Easting,Northing,Height\nA,"492,798.776","5,258,682.024",469.932\n', FILE)
    np.testing.assert_array_equal(table.plane, [[492798.776, 5258682.024]])


def test_sigmas_are_the_largest_of_a_point_and_optional() -> None:
    table = read_text(EXPORTS["trimble-with-precisions"], FILE)
    assert table.sigma_m.tolist() == [0.015] * 3
    text = "name,E,N,H,CQ 3D\nA,1,2,3,0.01\nB,1,3,3,\nC,1,4,3,0\n"
    assert read_text(text, FILE).sigma_m == pytest.approx([0.01, np.nan, np.nan], nan_ok=True)
    assert np.isnan(read_text(EXPORTS["plain"], FILE).sigma_m).all()


def test_columns_without_a_meaning_are_told() -> None:
    assert read_text(EXPORTS["leica-infinity"], FILE).notes == ("columns that are not used: Point Class, Code",)


def test_a_file_without_header_is_read_as_name_two_coordinates_and_height() -> None:
    table = read_text(rows("{name} {n} {e} {h}"), FILE)
    assert (table.pair, table.is_named) == ((Role.X, Role.Y), False)
    np.testing.assert_allclose(table.plane[:, ::-1], utm32()[:, :2], atol=6e-5)
    with_code = read_text(rows("{name},GCP,{e},{n},{h},TREE"), FILE)
    np.testing.assert_allclose(with_code.plane, utm32()[:, :2], atol=6e-5)
    numbered = read_text("101 492000.5 5260000.5 470.1\n102 492100.5 5260000.5 471.1\n", FILE)
    assert numbered.names == ("101", "102")
    nameless = read_text("492000.5 5260000.5 470.1\n492100.5 5260000.5 471.1\n", FILE)
    assert nameless.names == ("1", "2")


def test_the_user_says_the_columns_of_a_file() -> None:
    np.testing.assert_allclose(read(rows("{h},{e},x,{n},{name}"), "h,E,-,N,name"), utm32(), atol=6e-5)
    np.testing.assert_allclose(read("a b c d\n" + rows("{name} {n} {e} {h}"), "name N E H"), utm32(), atol=6e-5)


@pytest.mark.parametrize(
    ("columns", "said"),
    [("name,E,foo,H", 'got "foo", want name, E, N'), ("name,E,H", "no column of coordinates"), ("E,N", "of heights")],
)
def test_columns_that_mean_nothing_are_refused(columns: str, said: str) -> None:
    with pytest.raises(UserError, match=f"--control-columns: .*{said}") as refused:
        given_columns(columns)
    assert refused.value.exit_code == ExitCode.USAGE


@pytest.mark.parametrize(
    ("label", "role"),
    [
        ("Rechtswert", Role.EAST),
        ("Hochwert [m]", Role.NORTH),
        ("Local Easting", Role.EAST),
        ("Grid Northing (US survey foot)", Role.NORTH),
        ("X", Role.X),
        ("y_m", Role.Y),
        ("Z", Role.HEIGHT),
        ("Elevation", Role.HEIGHT),
        ("Höhe (NHN)", Role.ORTHOMETRIC),
        ("Ortho. Height", Role.ORTHOMETRIC),
        ("WGS84 Ellip. Height", Role.ELLIPSOIDAL),
        ("Height (Global)", Role.ELLIPSOIDAL),
        ("h_ellipsoidal_m", Role.ELLIPSOIDAL),
        ("Latitude (Global)", Role.LAT),
        ("lon_deg", Role.LON),
        ("Antenna Height", Role.IGNORED),
        ("Geoid Separation", Role.IGNORED),
        ("Feature Code", Role.IGNORED),
        ("Point Class", Role.IGNORED),
        ("3D CQ", Role.SIGMA),
        ("sigma_m", Role.SIGMA),
        ("Vt Prec", Role.SIGMA),
        ("Punkt-Nr.", Role.NAME),
        ("PointID", Role.NAME),
        ("Name", Role.NAME),
    ],
)
def test_labels_have_their_makers_meaning(label: str, role: Role) -> None:
    column = column_of(3, label)
    assert (column.role, column.at) == (role, 3)
    assert column.is_feet == ("foot" in label)


@pytest.mark.parametrize(
    ("text", "degrees"),
    [
        ("47.5", 47.5),
        ("-8.25", -8.25),
        ("47°30'00\"N", 47.5),
        ("N47°30'36.0\"", 47.51),
        ("8°15'00\" W", -8.25),
        ("47 30 00 S", -47.5),
        ("47:30:00", 47.5),
        ("47.5°", 47.5),
        ("47°61'00\"", np.nan),
        ("north", np.nan),
    ],
)
def test_angles_are_read_in_degrees_minutes_and_seconds(text: str, degrees: float) -> None:
    assert degrees_of(text) == pytest.approx(degrees, nan_ok=True)


def test_a_file_is_read_with_comments_blanks_and_a_byte_order_mark() -> None:
    text = f"\ufeff# survey of June\n\n{HEADER}\n{ROW}\n GCP2 , -47.5 , 8.95 , 510.0 , 0.01 \n"
    table = read_text(text, FILE)
    assert (table.names, table.is_native) == (("GCP1", "GCP2"), True)
    assert table.plane.tolist() == [[8.9001, 47.4001], [8.95, -47.5]]
    assert table.heights[Role.ELLIPSOIDAL].tolist() == [512.34, 510.0]
    assert table.sigma_m.tolist() == [0.02, 0.01]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "control.csv: the file is empty; it needs one line for each point"),
        (f"{HEADER}\n", "no points follow the header"),
        ("foo,bar\nA,B\n", 'line 1: no column of coordinates among "foo", "bar"; name the columns name, E, N, H'),
        ("name,E,N,code\nA,1,2,x\n", "line 1: no column of heights among"),
        (f"{HEADER}\n{ROW}\nG2,47.4,8.9,500", "line 3: 4 fields instead of 5"),
        (f"{HEADER}\nG1,47,4,8,9,500,0.01", "line 2: 7 fields instead of 5"),
        ("name,E,N,H\nA,492000,5,5260000,5,470,1\n", "commas are both separators and decimal signs"),
        (f"{HEADER}\n,47.4,8.9,500,0.01", "line 2: the point has no name"),
        (f"{HEADER}\nG1,abc,8.9,500,0.01", 'line 2: lat_deg: got "abc", want degrees from -90 to 90'),
        (f"{HEADER}\nG1,5250000.0,8.9,500,0.01", "line 2: lat_deg: .*map coordinates in metres.*--control-crs"),
        (f"{HEADER}\nG1,47.4,8.9,nan,0.01", 'line 2: h_ellipsoidal_m: got "nan", want metres from -9000'),
        ("name,E,N,H\nA,1,2,12000\n", 'H: got "12000", want metres from -9000 to 9000; are these feet'),
        ("name,E,N,H\nA,east,2,120\n", 'E: got "east", want a map coordinate, a number'),
        (f"{HEADER}\nG1,47.4,8.9,500,0", 'line 2: sigma_m: got "0", want metres above 0, at most 10'),
        (f"{HEADER}\nG1,47.4,8.9,500,-1", "line 2: sigma_m"),
        (f"{HEADER}\n{ROW}\n\n{ROW}", "line 4: GCP1 already stands in line 2"),
        ("P1 47.4 8.9 500\nP2 47.5 8.9 500\n", "line 1: no header tells which column is the latitude"),
    ],
)
def test_each_mistake_is_one_line_that_names_its_place(text: str, said: str) -> None:
    with pytest.raises(ControlError, match=said) as caught:
        read_text(text, FILE)
    assert all(line.startswith("control.csv: ") for line in str(caught.value).splitlines())


def test_all_mistakes_are_reported_at_once_in_one_line_each() -> None:
    text = f"{HEADER}\nG1,abc,8.9,500,0.01\nG2,47.4,nine,500,0.01\n{ROW}"
    with pytest.raises(ControlError) as caught:
        read_text(text, Path("c"))
    assert [line.split(": ")[1] for line in str(caught.value).splitlines()] == ["line 2", "line 3"]


def test_options_of_control_need_a_file(tmp_path: Path) -> None:
    assert read_control_file(None) is None
    with pytest.raises(UserError, match="--control-crs needs --control FILE"):
        read_control_file(None, "EPSG:25832")
    with pytest.raises(UserError, match="cannot be read: No such file"):
        read_control_file(tmp_path / "no.gpkg")
