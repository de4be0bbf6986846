"""Tests the surface of ``swath georef`` from the command line: columns, sidecar, workers, refusals."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest

from swath.daemon.cli.main import run_app
from tests.daemon.one_line import Flown, fly

pytestmark = [pytest.mark.xdist_group("kernels"), pytest.mark.slow]


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Flown:
    return fly(tmp_path_factory.mktemp("line"))


def record(output: Path) -> dict[str, Any]:
    """Return the sidecar."""
    read: dict[str, Any] = json.loads(next(output.glob("*.json")).read_text())
    return read


def test_the_surface_is_the_same_whatever_the_workers_and_the_sidecar_names_it(
    flown: Flown, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    columns = ["--incidence", "--range-sigma", "--covariances"]
    files = []
    for workers in ("1", "2"):
        assert run_app(flown.arguments(tmp_path / workers, *columns, "--workers", workers)) == 0
        files.append(next((tmp_path / workers).glob("*_strip01.laz")).read_bytes())
    assert files[0] == files[1]
    assert re.search(r"surface for the sigmas: planes under (9[.\d]+|100) % of the points", capsys.readouterr().out)
    told = record(tmp_path / "1")
    assert told["surface"]["kind"] == "planes"
    assert told["surface"]["assumed"].startswith("planes in the points around each point")
    points = told["surface"]["points"]
    assert points["planes"] + points["level_ground"] + points["rough"] == told["totals"]["points"]
    assert points["planes"] > 0.95 * told["totals"]["points"]
    (strip,) = told["strips"]
    assert strip["surface"]["left"] == points | {"cube_m": 8.0}
    assert [told["options"][key] for key in ("surface", "incidence", "range_sigma", "covariances")] == [
        "planes", True, True, True,
    ]  # fmt: skip

    las = laspy.read(next((tmp_path / "1").glob("*_strip01.laz")))
    for axis, axes in {"easting": "ee", "northing": "nn", "height": "hh"}.items():
        roots = np.sqrt(las[f"covariance_{axes}"])
        assert np.abs(np.minimum(roots, 6.5535) - las[f"sigma_{axis}"]).max() < 6e-5
    truth = flown.truth
    order = np.lexsort((truth["left.return_number"], truth["left.gps_ns"]))
    mine = np.lexsort((np.asarray(las.return_number), np.asarray(las.gps_time)))
    off_deg = las["incidence_angle"][mine] - np.degrees(truth["left.incidence_rad"][order])
    assert np.quantile(np.abs(off_deg[las["surface"][mine] == 2]), 0.9) < 2.0  # hills in cubes of 8 m and more
    added_m = 0.25 * 0.5e-3 * truth["left.range_m"][order] * np.tan(np.radians(las["incidence_angle"][mine]))
    assert np.median(np.abs(np.hypot(0.02, added_m) - las["sigma_range"][mine])) < 2e-4


def test_level_ground_and_no_surface_are_kept_apart(flown: Flown, tmp_path: Path) -> None:
    sigmas = {}
    for kind in ("none", "level", "planes"):
        assert run_app(flown.arguments(tmp_path / kind, "--surface", kind)) == 0
        told = record(tmp_path / kind)["surface"]
        assert told["kind"] == kind
        sigmas[kind] = np.asarray(laspy.read(next((tmp_path / kind).glob("*.laz")))["sigma_northing"])
        all_level = len(sigmas[kind]) if kind == "level" else 0
        assert told["points"]["level_ground"] == pytest.approx(all_level, abs=20 if kind == "planes" else 0)
    assert (sigmas["level"] >= sigmas["none"]).all()
    assert (sigmas["planes"] >= sigmas["none"]).all()
    assert np.median(sigmas["planes"] / sigmas["level"]) == pytest.approx(1.0, abs=0.01)
    assert np.median(sigmas["level"] / sigmas["none"]) > 1.01
    assert record(tmp_path / "none")["surface"]["assumed"].startswith("none: ")


@pytest.mark.parametrize(
    ("options", "line"),
    [
        (["--surface", "flat"], "'flat' is not one of 'planes', 'level', 'none'"),
        (["--no-sigma", "--incidence"], "--incidence needs the sigmas: leave out --no-sigma"),
        (["--no-sigma", "--covariances"], "--covariances needs the sigmas: leave out --no-sigma"),
        (["--surface", "none", "--incidence"], "--incidence needs a surface: use --surface planes or level"),
    ],
)
def test_options_without_a_meaning_are_refused_in_a_line(
    flown: Flown, tmp_path: Path, options: list[str], line: str, capsys: pytest.CaptureFixture[str]
) -> None:
    capsys.readouterr()
    assert run_app(flown.arguments(tmp_path, *options)) == 2
    told = capsys.readouterr().err
    assert line in told
    assert told.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_withheld_points_keep_their_place_and_get_sigmas(flown: Flown, tmp_path: Path) -> None:
    config = tmp_path / "near.toml"
    text = (flown.folder / "swath.toml").read_text()
    config.write_text(re.sub(r"range_max_m = .*", "range_max_m = 310.0", text))
    for name in ("main.dbc", "left.nominal.toml", "plan.toml"):
        (tmp_path / name).write_bytes((flown.folder / name).read_bytes())
    assert run_app(flown.arguments(tmp_path / "out", "--config", str(config), "--write-dropped", "--incidence")) == 0
    las = laspy.read(next((tmp_path / "out").glob("*_strip01.laz")))
    withheld = np.asarray(las["withheld"]) != 0
    assert 100 < withheld.sum() < len(las) - 100
    assert np.diff(las.gps_time).max() < 1.0
    assert np.diff(las.gps_time).min() > -0.5  # the withheld ones of a tick come before its others
    assert (las["incidence_angle"][withheld] > 0.0).all()
