"""Tests control on the earth: its CRS, its heights, and its distance from the flight."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from pyproj import Transformer

from swath.calib.control.points import ControlError
from swath.daemon.errors import UserError
from swath.daemon.processing.control.place import DEFAULT_SIGMA_M, Placed, place_control
from swath.daemon.processing.control.text import read_text
from swath.georef.arrays import FloatArray
from swath.georef.mapping.frame import Mapping
from tests.daemon.processing.control.builders import EXPORTS, FLIGHT, LAT_LON_H, NAMES, rows, utm32

NOWHERE = np.empty((0, 2))


def placed(text: str, crs: str | None = None, *, flight: FloatArray = FLIGHT, project: Mapping | None = None) -> Placed:
    """Place a text's points for a project in UTM 32."""
    return place_control(
        read_text(text, Path("control.csv")), crs, project or Mapping("EPSG:32632", datum="same"), flight
    )


def lat_lon_h(found: Placed) -> FloatArray:
    """Return latitude, longitude, degrees, and height (n, 3) of points."""
    return np.array([[np.degrees(one.lat_rad), np.degrees(one.lon_rad), one.height_m] for one in found.points])


def is_right(found: Placed, within_m: float = 2e-4) -> bool:
    """Return whether the points lie where they were surveyed."""
    apart = np.abs(lat_lon_h(found) - LAT_LON_H) * [111_000.0, 75_000.0, 1.0]
    return bool(apart.max() < within_m)


@pytest.mark.parametrize("export", EXPORTS)
def test_exports_in_the_projects_crs_lie_where_they_were_surveyed(export: str) -> None:
    found = placed(EXPORTS[export])
    assert is_right(found)
    assert "control.csv: 3 points in EPSG:32632 (WGS 84 / UTM zone 32N), heights above the ellipsoid" in found.notes[0]


def test_swaths_own_columns_are_read_bit_for_bit_and_without_a_word() -> None:
    header = "name,lat_deg,lon_deg,h_ellipsoidal_m,sigma_m"
    found = placed(header + "\nGCP1,47.4801,8.9002,470.123,0.01\n")
    (point,) = found.points
    assert (point.lat_rad, point.lon_rad) == (np.radians(47.4801), np.radians(8.9002))
    assert (point.height_m, point.sigma_m, found.notes) == (470.123, 0.01, ())


def test_assumed_heights_and_sigmas_are_told() -> None:
    found = placed("name,E,N,H\n" + rows("{name},{e},{n},{h}"))
    assert {one.sigma_m for one in found.points} == {DEFAULT_SIGMA_M}
    assert found.notes == (
        "control.csv: 3 points in EPSG:32632 (WGS 84 / UTM zone 32N), heights above the ellipsoid, because this CRS "
        "has no vertical part",
        "control.csv: no point has a sigma: 0.02 m is used for them",
    )


def test_another_crs_and_another_datum_than_the_projects() -> None:
    project = Mapping("EPSG:25832", datum="EPSG:7912", epoch=2026.5)
    lat, lon, height = LAT_LON_H.T
    to_map = Transformer.from_crs("EPSG:4258", "EPSG:3035", always_xy=True)
    found = placed(
        "name,E,N,H\n" + rows("{name},{e},{n},{h}", np.column_stack([*to_map.transform(lon, lat), height])),
        "EPSG:3035",
        project=project,
    )
    north_m, east_m, _ = ((lat_lon_h(found) - LAT_LON_H) * [111_200.0, 75_200.0, 1.0]).T
    # in the middle of Europe, ITRF lies some 0.8 m north-east of ETRS89 in 2026
    assert np.hypot(north_m, east_m) == pytest.approx(np.full(3, 0.85), abs=0.15)
    assert (north_m > 0.4).all()
    assert (east_m > 0.4).all()


def test_geographic_crs_of_latitudes_and_longitudes() -> None:
    text = "id;lon;lat;h\n" + "".join(
        f"{name};{lon};{lat};{h}\n" for name, (lat, lon, h) in zip(NAMES, LAT_LON_H, strict=True)
    )
    assert is_right(placed(text, "EPSG:4979"))
    assert is_right(placed(text))
    assert is_right(placed(text.replace(".", ","), "EPSG: 4326"))


def test_x_and_y_are_read_in_the_order_that_lies_at_the_flight() -> None:
    assert is_right(placed("name X Y Z\n" + rows("{name} {e} {n} {h}")))
    turned = placed("Pkt;Y;X;Z\n" + rows("{name};{e};{n};{h}"))
    assert is_right(turned)
    assert turned.notes[0].endswith("Y as easting and X as northing")
    assert is_right(placed("Pkt;Y;X;Z\n" + rows("{name};{e};{n};{h}"), flight=NOWHERE))  # by the CRS's area of use


def test_a_file_without_header_is_read_in_the_order_that_lies_at_the_flight() -> None:
    for template in ("{name} {e} {n} {h}", "{name} {n} {e} {h}"):
        found = placed(rows(template))
        assert is_right(found)
        assert "because the other order lies elsewhere" in found.notes[0]
    europe = Mapping("EPSG:3035", datum="same")
    middle = np.array([[4321000.0, 4321100.0 + 60 * at, 400.0] for at in range(3)])
    with pytest.raises(ControlError, match=r"has no header, and both orders .* say the columns, as --control-columns"):
        placed(rows("{name} {e} {n} {h}", middle), project=europe, flight=np.array([[62.4, 10.0]]))


def mistaken(text: str, crs: str | None = None, flight: FloatArray = FLIGHT) -> str:
    """Return the error of a text's points."""
    with pytest.raises((ControlError, UserError)) as refused:
        placed(text, crs, flight=flight)
    line = str(refused.value)
    assert line.startswith("control.csv: ")
    assert "\n" not in line
    return line


def test_mistakes_are_recognised_by_the_place_of_the_flight() -> None:
    head, line = "name,E,N,H\n", "{name},{e},{n},{h}"
    swapped = mistaken(head + rows("{name},{n},{e},{h}"))
    assert "no control point lies near the flight: read as easting and northing in EPSG:32632" in swapped
    assert "easting and northing look swapped: exchange the names of the two columns" in swapped
    assert "look swapped" in mistaken(head + rows("{name},{n},{e},{h}"), flight=NOWHERE)
    assert "the coordinates look like feet" in mistaken(head + rows(line, utm32() / 0.3048))
    assert "the easting begins with the zone, 32: " in mistaken(head + rows("{name},32{e},{n},{h}"))
    assert "the coordinates look like degrees: name the columns lat and lon" in mistaken(
        head + rows(line, LAT_LON_H[:, [1, 0, 2]])
    )
    elsewhere = mistaken(head + rows(line, utm32() + np.array([0.0, 300_000.0, 0.0])))
    assert "the nearest, GCP1, is 300 km from it, at 47.4" in elsewhere
    assert elsewhere.endswith("give the CRS of the file with --control-crs, or the control of this flight")
    lat_lon = "name,lat,lon,h\n"
    assert "latitude and longitude look swapped" in mistaken(
        lat_lon + rows("{name},{e},{n},{h}", LAT_LON_H[:, [1, 0, 2]])
    )


def test_heights_must_be_those_of_the_crs() -> None:
    ortho = "Point ID,Easting,Northing,Ortho. Height\n" + rows("{name},{e},{n},{h}")
    assert 'heights of column "Ortho. Height" are above the geoid, but output.crs = "EPSG:32632"' in mistaken(ortho)
    assert "--control-crs EPSG:32632+CODE" in mistaken(ortho, "EPSG:32632")
    ellipsoidal = ortho.replace("Ortho.", "Ellip.")
    line = mistaken(ellipsoidal, "EPSG:25832+7837")
    assert 'column "Ellip. Height" are above the ellipsoid' in line
    assert "give --control-crs without its vertical part, or export heights in DHHN2016 height" in line
    both = "Point ID,Easting,Northing,Ortho. Height,Ellip. Height\n" + rows("{name},{e},{n},,{h}")
    assert is_right(placed(both))


@pytest.mark.parametrize("plane", ["+proj=utm +zone=32", "+proj=longlat"])
def test_heights_above_a_geoid_are_raised_by_its_grid(plane: str, tmp_path: Path) -> None:
    grid = tmp_path / "geoid.gtx"
    shape, undulation_m = (11, 11), 47.25
    head = struct.pack(">4d2i", 47.0, 8.4, 0.1, 0.1, *shape)
    grid.write_bytes(head + np.full(shape, undulation_m, ">f4").tobytes())
    crs = f"{plane} +datum=WGS84 +geoidgrids={grid} +type=crs"
    below = np.array([0.0, 0.0, undulation_m])
    if "utm" in plane:
        text = "Point ID,Easting,Northing,Ortho. Height\n" + rows("{name},{e},{n},{h}", utm32() - below)
    else:
        text = "Point ID,Latitude,Longitude,Elevation\n" + rows("{name},{e},{n},{h}", LAT_LON_H - below)
    found = placed(text, crs)
    assert is_right(found, 6e-4 if "utm" in plane else 8.0)  # degrees have four digits in the file
    assert lat_lon_h(found)[:, 2] == pytest.approx(LAT_LON_H[:, 2], abs=1e-4)
    assert ", heights in " in found.notes[0]
    assert "above the ellipsoid" not in found.notes[0]
    assert "are above the ellipsoid, but" in mistaken(
        text.replace("Ortho. Height", "Ellip. Height").replace("Elevation", "Ellip. Height"), crs
    )


def test_a_missing_grid_of_a_geoid_is_told_with_its_remedy() -> None:
    line = mistaken("name,E,N,H\n" + rows("{name},{e},{n},{h}"), "EPSG:32632+3855")
    assert (
        '--control-crs = "EPSG:32632+3855" (WGS 84 / UTM zone 32N + EGM2008 height): its heights need the grid' in line
    )
    assert "which is not installed: `projsync --file" in line


def test_unfit_crs_are_refused() -> None:
    text = "name,E,N,H\n" + rows("{name},{e},{n},{h}")
    assert "write EPSG:25832 (ETRS89 / UTM zone 32N), or EPSG:32632" in mistaken(text, "UTM32")
    assert "but the columns are easting and northing; give their projected CRS" in mistaken(text, "EPSG:4326")
    degrees = "name,lat,lon,h\n" + rows("{name},{e},{n},{h}", LAT_LON_H)
    assert "such as --control-crs EPSG:4326" in mistaken(degrees, "EPSG:32632")
    feet = "name,E (ft),N (ft),H\n" + rows("{name},{e},{n},{h}")
    assert 'column "E (ft)" is in feet, but these are metres in WGS 84 / UTM zone 32N' in mistaken(feet)


def test_a_crs_in_feet_gives_metres() -> None:
    place = np.array([[37.7, -122.4]])
    to_map = Transformer.from_crs("EPSG:6318", "EPSG:6420", always_xy=True)
    east, north = to_map.transform(-122.4, 37.7)
    text = f"name,E (ftUS),N (ftUS),H\nA,{east:.4f},{north:.4f},30.0\n"
    found = placed(text, "EPSG:6420", flight=place, project=Mapping("EPSG:6339", datum="same"))
    assert lat_lon_h(found)[0, :2] == pytest.approx([37.7, -122.4], abs=2e-9)


def test_places_that_occur_twice_are_refused() -> None:
    text = "name,E,N,H\nA,492465,5258511,470\nB,492465,5258511,470\n"
    assert "line 3: B has the position of A in line 2; list each point once" in mistaken(text)
