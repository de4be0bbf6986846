"""Tests ``swath georef`` with a gimbal whose angles a receiver's INS logs, against SciPy."""

from __future__ import annotations

import json
from pathlib import Path

import laspy
import numpy as np
import pytest
from pyproj import Transformer
from scipy.spatial.transform import Rotation, Slerp

from swath.daemon.cli.main import run_app
from swath.georef.formats.sbet import sbet_bytes
from tests.daemon.one_line import PLAN, Flown

pytestmark = [pytest.mark.xdist_group("kernels"), pytest.mark.slow]

ARM_M = [0.3, -0.2, 0.5]  # from the gimbal's centre to the scanner
STAGE = '[scanner.left.gimbal]\nstages = [{{ source = "{source}", lever_arm_m = {arm} }}]\n\n[scanner.left.geometry]'


def fly(folder: Path, *, ins: bool) -> Flown:
    """Fly twelve seconds of one line, and write a gimbal into the configuration beside the log."""
    plan = folder / "line.toml"
    text = PLAN.replace("[-1000.0, -80.0]", "[-300.0, -80.0]").replace("[1000.0, -80.0]", "[300.0, -80.0]")
    plan.write_text(text + ("\n[gnss.rover]\nins = true\n" if ins else ""))
    assert run_app(["sim", "fly", str(plan), "-o", str(folder / "flight")]) == 0
    made = Flown(folder / "flight")
    made.sbet.write_bytes(sbet_bytes(made.trajectory()))
    config = made.folder / "swath.toml"
    stage = STAGE.format(source="gnss/rover", arm=ARM_M)
    config.write_text(config.read_text().replace("[scanner.left.geometry]", stage))
    return made


def through_the_gimbal(flown: Flown) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    """Return (n, 3), m, in e: where the beams would meet if the gimbal turned them by the aircraft's attitude again."""
    truth = flown.truth
    at_s = (truth["trajectory.gps_ns"] - truth["left.gps_ns"][0]) / 1e9
    of_s = (truth["left.gps_ns"] - truth["left.gps_ns"][0]) / 1e9
    lat, lon = truth["trajectory.lat_rad"], truth["trajectory.lon_rad"]
    to_e = Transformer.from_crs(4979, 4978, always_xy=True)
    places_e = np.stack(to_e.transform(np.degrees(lon), np.degrees(lat), truth["trajectory.height_m"]), axis=1)
    body_e = np.stack([np.interp(of_s, at_s, column) for column in places_e.T], axis=1)
    angles = [np.unwrap(truth[f"trajectory.{name}_rad"]) for name in ("heading", "pitch", "roll")]
    level = Rotation.from_euler("ZY", np.stack([lon, -np.pi / 2 - lat], axis=1))
    attitude = Slerp(at_s, level * Rotation.from_euler("ZYX", np.stack(angles, axis=1)))(of_s)
    gimbal = Rotation.from_euler("ZYX", np.stack([np.interp(of_s, at_s, angle) for angle in angles], axis=1))
    boresight = Rotation.from_euler("XYZ", np.radians([0.2513, -0.4021, 0.6110]))
    arm_b = np.array([0.12, -0.03, 0.28])
    beam = boresight.inv().apply(attitude.inv().apply(truth["left.point_e"] - body_e) - arm_b)
    pointed: np.ndarray[tuple[int, int], np.dtype[np.float64]] = body_e + attitude.apply(
        arm_b + boresight.apply(gimbal.apply(beam + ARM_M))
    )
    return pointed


def test_points_lie_where_the_gimbal_points(tmp_path: Path) -> None:
    flown = fly(tmp_path, ins=True)
    more = ["--config", str(flown.folder / "swath.toml"), "--strips", "whole", "--no-sigma"]
    assert run_app(flown.arguments(tmp_path / "out", *more)) == 0
    told = json.loads(next((tmp_path / "out").glob("*.json")).read_text())
    assert told["counts"]["left"]["dropped"] == {}
    las = laspy.read(next((tmp_path / "out").glob("*.laz")))
    truth = flown.truth
    to_map = Transformer.from_crs("EPSG:4978", "EPSG:32632", always_xy=True)
    of_time = np.lexsort((truth["left.return_number"], truth["left.gps_ns"]))
    mine = np.lexsort((np.asarray(las.return_number), np.asarray(las.gps_time)))
    expected, rigid = (
        np.stack(to_map.transform(*points_e[of_time].T), axis=1)
        for points_e in (through_the_gimbal(flown), truth["left.point_e"])
    )
    assert np.abs(las.xyz[mine] - expected).max() < 0.003
    assert np.linalg.norm(las.xyz[mine] - rigid, axis=1).min() > 0.5


def test_a_source_without_gimbal_angles_is_refused_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flown = fly(tmp_path, ins=False)
    capsys.readouterr()
    assert run_app(flown.arguments(tmp_path / "out", "--config", str(flown.folder / "swath.toml"))) == 1
    line = capsys.readouterr().err
    assert line == f'swath: {flown.log}: scanner.left: gimbal.stages[0].source: "gnss/rover" sent no angles\n'
    assert not (tmp_path / "out").exists()
