"""Tests the files that a user gives ``swath calibrate``: polygons and picked points, and mistakes in one line."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from swath.calib.ties.picked import PickedError
from swath.daemon.errors import UserError
from swath.daemon.processing.calibration.inputs import PolygonError, read_polygons, rings_of, ties_of
from swath.daemon.processing.calibration.returns import refuse_without_noise
from swath.georef.mapping.frame import Mapping
from swath.georef.scanner.uncertainty import Noise
from tests.calib.analytic_scene import Line, Scanner, fly, gables

pytestmark = pytest.mark.xdist_group("kernels")

GOOD = 'WKT,name\n"POLYGON ((10 0, 20 0, 20 8, 10 8, 10 0))",roof 1\n"Polygon Z ((0 0 5, 4 0 5, 2 3 6))",roof 2\n'


def kept() -> Any:
    """Return a flight over houses whose points are given in UTM."""
    lines = (Line(-60, 0, 90, 120, 300), Line(60, 10, 270, 120, 300))
    flight = fly(lines, gables(), scanner=Scanner(prf_hz=3_000.0))
    mapping = Mapping("EPSG:32632", datum="same")
    mapping.settle(flight.frame.origin_e[np.newaxis])
    return SimpleNamespace(flight=flight, logged=[SimpleNamespace(setup=SimpleNamespace(mapping=mapping))])


@pytest.fixture(scope="module")
def read() -> Any:
    return kept()


def on_map(read: Any, points_t: Any) -> Any:
    return read.logged[0].setup.mapping.map_from_e(read.flight.frame.e_from_t(np.asarray(points_t, np.float64)))


def test_a_scanner_without_noise_is_refused() -> None:
    def kept_with(noise: Noise) -> Any:
        return SimpleNamespace(
            flight=SimpleNamespace(heads=[SimpleNamespace(name="left", noise=noise)]),
            logged=[SimpleNamespace(log="a.mcap")],
        )

    for noise in (Noise(0.02, 0.0, 0.0, 0.0), Noise(0.0, 2e-5, 0.0, 0.0), Noise(0.0, 0.0, 0.0, 3e-4)):
        refuse_without_noise(kept_with(noise))
    with pytest.raises(UserError, match=r"a\.mcap: scanner\.left: range_sigma_m, .* are all 0; set") as raised:
        refuse_without_noise(kept_with(Noise(0.0, 0.0, divergence_rad=0.0)))
    assert "\n" not in str(raised.value)


def test_polygons_are_read() -> None:
    found = read_polygons(GOOD, "p.csv")
    np.testing.assert_array_equal(found["roof 1"], [[10, 0], [20, 0], [20, 8], [10, 8]])
    np.testing.assert_array_equal(found["roof 2"], [[0, 0], [4, 0], [2, 3]])


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "line 1: column WKT is missing"),
        ("WKT,id\n", "line 1: column name is missing"),
        ("WKT,name\n", "has no polygons"),
        ('WKT,name\n"POINT (1 2)",a\n', "line 2: WKT: got 'POINT (1 2)'"),
        ('WKT,name\n"POLYGON ((0 0, 1 0))",a\n', "has 2 corners"),
        ('WKT,name\n"POLYGON ((0 0, 1 nan, 2 2))",a\n', "the corner is '1 nan'"),
        ('WKT,name\n"POLYGON ((0 0, 1, 2 2))",a\n', "the corner is '1'"),
        ('WKT,name\n"POLYGON ((0 0, 1 0, 1 1), (0 0, 1 0, 1 1))",a\n', "without holes"),
        ('WKT,name\n"POLYGON ((0 0, 1 0, 1 1))",\n', "name: is missing"),
        (GOOD + '"POLYGON ((0 0, 1 0, 1 1))",roof 2\n', "line 4: name: roof 2 is given twice"),
    ],
)
def test_invalid_polygons_are_refused(text: str, said: str) -> None:
    with pytest.raises(PolygonError) as raised:
        read_polygons(text, "p.csv")
    assert said in str(raised.value)
    assert str(raised.value).startswith("p.csv: ")
    assert "\n" not in str(raised.value)


def test_polygons_are_in_the_coordinates_of_the_points(read: Any, tmp_path: Path) -> None:
    corners_t = np.array([[-20.0, -30.0, 0.0], [15.0, -30.0, 0.0], [15.0, 25.0, 0.0]])
    words = ", ".join(f"{x:.4f} {y:.4f}" for x, y, _ in on_map(read, corners_t))
    path = tmp_path / "p.csv"
    path.write_text(f'WKT,name\n"POLYGON (({words}))",a\n')
    np.testing.assert_allclose(rings_of(path, read)["a"], corners_t[:, :2], atol=2e-3)


def test_picked_points_become_ties(read: Any, tmp_path: Path) -> None:
    first, second = read.flight.swaths
    at = len(first) // 2
    place_t = first.points_t[at]
    other = int(np.argmin(np.linalg.norm(second.points_t - place_t, axis=1)))
    picks = on_map(read, [place_t, second.points_t[other]])
    rows = [f"corner,{name},{x:.4f},{y:.4f},{z:.4f},0.03" for name, (x, y, z) in zip(("01", "02"), picks, strict=True)]
    path = tmp_path / "ties.csv"
    path.write_text("name,strip,x,y,z,sigma_m\n" + "\n".join(rows) + "\n")
    (tie,) = ties_of(path, read).ties
    assert [sighting.swath for sighting in tie.sightings] == [0, 1]
    path.write_text("name,strip,x,y,z,sigma_m\n" + rows[0] + "\n" + "corner,02,1,2,3,0.03\n")
    with pytest.raises(UserError, match=r"no tie point remains .* give positions in output\.crs"):
        ties_of(path, read)
    path.write_text("name,x,y\n")
    with pytest.raises(PickedError, match="line 1: has name, x, y; the columns must be"):
        ties_of(path, read)
    with pytest.raises(UserError, match=r"nowhere\.csv: cannot be read: No such file"):
        ties_of(tmp_path / "nowhere.csv", read)
