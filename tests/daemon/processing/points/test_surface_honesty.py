"""Tests that the sigmas of `swath georef` contain what the surface does to a range, with virtual flights as the judge.

The virtual aircraft takes the range of one place in the footprint that it draws anew for each pulse, and casts a ray
there: the error comes from the scene, not from a formula. All returns saturate, so that the receiver's own noise is the
2 cm that the configuration states; trajectory and calibration are the true ones, so that the error along the beam is
that of the range.
"""

from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest
from pyproj import Transformer

from swath.daemon.cli.main import run_app
from swath.georef.arrays import FloatArray
from swath.georef.surface.planes import LEVEL_GROUND, PLANE, ROUGH
from tests.builders import SIDEWAYS
from tests.daemon.one_line import Flown, fly

pytestmark = [pytest.mark.xdist_group("kernels"), pytest.mark.slow]

PLAN = """
[flight]
name = "wide"
origin_deg = [47.482, 8.905]
speed_mps = 50.0
lead_s = 3.0

[[line]]
name = "east"
from_m = [-200.0, 0.0]
to_m = [200.0, 0.0]
height_m = 600.0

[terrain]
height_m = 470.0
slope_percent = 5.0
relief_m = 12.0
wavelength_m = 600.0

[[terrain.village]]
center_m = [0.0, 60.0]
size_m = [240.0, 160.0]
houses = 40

[imu.main]
rate_hz = 100

[scanner.left]
kind = "{kind}"
prf_hz = 60_000.0
scan_hz = 20.0
half_angle_deg = 74.0
divergence_mrad = 1.5
return_slots = 3
range_max_m = 900.0
reference_range_m = 30000.0
range_noise = {{ sigma_m = 0.256, drawn = true }}
"""
CLASSES_DEG = (0.0, 20.0, 40.0, 60.0, 80.0)


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Flown:
    return fly(tmp_path_factory.mktemp("wide"), PLAN.format(kind="oscillating"))


def georeferenced(flown: Flown, output: Path, *options: str) -> tuple[Any, dict[str, Any]]:
    """Return the points, sorted by time and return number, and the sidecar."""
    assert run_app(flown.arguments(output, *options)) == 0
    las = laspy.read(next(output.glob("*_strip01.laz")))
    return las[np.lexsort((np.asarray(las.return_number), np.asarray(las.gps_time)))], json.loads(
        next(output.glob("*.json")).read_text()
    )


def errors_along_beams(flown: Flown, las: Any) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return errors along the beams (n,), true ranges (n,), and the beams' directions (n, 3) on the map."""
    truth = flown.truth
    to_map = Transformer.from_crs("EPSG:4978", "EPSG:32632", always_xy=True)
    order = np.lexsort((truth["left.return_number"], truth["left.gps_ns"]))
    points = np.stack(to_map.transform(*truth["left.point_e"][order].T), axis=1)
    trajectory = flown.trajectory()
    bodies = np.stack(to_map.transform(*trajectory.poses(truth["left.gps_ns"][order]).position_e.T), axis=1)
    beams = points - bodies
    beams /= np.linalg.norm(beams, axis=1, keepdims=True)
    return ((las.xyz - points) * beams).sum(axis=1), truth["left.range_m"][order], beams


def mean_squares(flown: Flown, output: Path, *options: str) -> tuple[list[float], list[float], Any]:
    """Return mean normalised squares of errors along the beams by classes of true incidence below 80°, and by quarters
    of range; and the points.
    """
    las, _ = georeferenced(flown, output, "--incidence", "--range-sigma", "--covariances", *options)
    error_m, range_m, beams = errors_along_beams(flown, las)
    east, north, up = beams.T
    variance = sum(
        factor * np.asarray(las[f"covariance_{axes}"], np.float64)
        for axes, factor in {
            "ee": east**2, "nn": north**2, "hh": up**2,
            "en": 2 * east * north, "eh": 2 * east * up, "nh": 2 * north * up,
        }.items()
    )  # fmt: skip
    # the sbet's 2 cm of position are no error here: take them out
    square = error_m**2 / (variance - 0.02**2)
    assert np.median(np.abs(np.sqrt(variance - 0.02**2) / las["sigma_range"] - 1.0)) < 0.02
    truth = flown.truth
    order = np.lexsort((truth["left.return_number"], truth["left.gps_ns"]))
    true_deg = np.degrees(truth["left.incidence_rad"][order])
    by_incidence = [float(square[(true_deg >= low) & (true_deg < high)].mean()) for low, high in pairwise(CLASSES_DEG)]
    below = true_deg < CLASSES_DEG[-1]
    quarters = np.searchsorted(np.quantile(range_m, [0.25, 0.5, 0.75]), range_m)
    return by_incidence, [float(square[below & (quarters == k)].mean()) for k in range(4)], las


def test_squares_are_one_in_classes_of_incidence_and_range(flown: Flown, tmp_path: Path) -> None:
    """Points beyond 80° of true incidence are walls that beams graze; the formula ends there."""
    by_incidence, by_range, las = mean_squares(flown, tmp_path)
    np.testing.assert_array_less(0.8, [*by_incidence, *by_range])
    np.testing.assert_array_less([*by_incidence, *by_range], 1.25)
    kinds = np.bincount(las["surface"], minlength=4)
    assert kinds[PLANE] > 0.98 * len(las)
    assert kinds[0] == 0
    assert kinds[LEVEL_GROUND] < 0.001 * len(las)
    assert kinds[ROUGH] < 0.015 * len(las)


def test_without_the_surface_sigmas_are_too_small(flown: Flown, tmp_path: Path) -> None:
    """The check above can fail: without the footprint the squares are far above one."""
    assert run_app(flown.arguments(tmp_path, "--surface", "none", "--covariances", "--range-sigma")) == 0
    las = laspy.read(next(tmp_path.glob("*_strip01.laz")))
    las = las[np.lexsort((np.asarray(las.return_number), np.asarray(las.gps_time)))]
    error_m, range_m, _ = errors_along_beams(flown, las)
    assert set(np.unique(las["sigma_range"])) == {0.02}
    assert np.mean((error_m[range_m > 300.0] / 0.02) ** 2) > 50.0


HEADS = {
    "nutating": {"half_angle_deg = 74.0": "half_angle_deg = 30.0"},
    "polygon": {"half_angle_deg = 74.0": "half_angle_deg = 35.0"},
    "vlp16": {
        "height_m = 600.0": "height_m = 530.0",
        "scan_hz = 20.0": f"scan_hz = 10.0\ninstallation = {SIDEWAYS}",
        "range_max_m = 900.0": "range_min_m = 1.0\nrange_max_m = 130.0",
        "sigma_m = 0.256": "sigma_m = 0.101",
    },
}


@pytest.mark.parametrize("kind", HEADS)
def test_squares_of_points_on_planes_are_one_for_other_heads(kind: str, tmp_path: Path) -> None:
    """Some walls are taken for the ground before them; their squares, beyond 25, are counted instead."""
    text = PLAN.format(kind=kind)
    for before, after in HEADS[kind].items():
        text = text.replace(before, after)
    flown = fly(tmp_path, text)
    las, _ = georeferenced(flown, tmp_path / "out", "--incidence", "--range-sigma")
    error_m, _, _ = errors_along_beams(flown, las)
    planes = np.asarray(las["surface"]) == PLANE
    square = (error_m / las["sigma_range"])[planes] ** 2
    assert 0.8 < np.mean(square[square < 25.0]) < 1.25
    assert np.mean(square > 25.0) < 0.002
    assert planes.mean() > 0.9
