"""Tests pulses in air with ``swath georef``: a log of apparent ranges (SREP's byte 15 = 255), cut into strips."""

from __future__ import annotations

import json
from pathlib import Path

import laspy
import numpy as np
import pytest
from pyproj import Transformer

from swath.daemon.cli.main import run_app
from swath.georef.formats.sbet import sbet_bytes
from tests.daemon.one_line import PLAN, Flown

pytestmark = [pytest.mark.xdist_group("kernels"), pytest.mark.slow]

ABOVE_M = 1200.0  # above ground; a zone of 150 kHz is 1 km
ENCODER_COUNTS = 4_194_304  # the default of a plan


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Flown:
    folder = tmp_path_factory.mktemp("apparent")
    plan = folder / "line.toml"
    changes = {
        "[-1000.0, -80.0]": "[-30.0, -80.0]",
        "[1000.0, -80.0]": "[30.0, -80.0]",
        "height_m = 780.0": f"height_m = {470.0 + ABOVE_M}",
        "prf_hz = 1500.0": 'prf_hz = 150000.0\nzone = "apparent"',
        "scan_hz = 10.0": "scan_hz = 40.0",
    }
    text = PLAN
    for old, new in changes.items():
        assert old in text
        text = text.replace(old, new)
    plan.write_text(text)
    assert run_app(["sim", "fly", str(plan), "-o", str(folder / "flight")]) == 0
    made = Flown(folder / "flight")
    made.sbet.write_bytes(sbet_bytes(made.trajectory()))
    config = made.folder / "swath.toml"
    config.write_text(config.read_text() + f"\n[mta]\nheight_above_ground_m = {ABOVE_M}\n")
    return made


def test_points_match_the_truth_with_apparent_ranges(flown: Flown, tmp_path: Path) -> None:
    truth = flown.truth
    first, last = (int(truth["left.gps_ns"][at]) for at in (0, -1))
    middle = (first + last) // 2
    (tmp_path / "halves.csv").write_text(f"start_gps_ns,end_gps_ns\n{first},{middle}\n{middle},{last + 10**9}\n")
    more = ("--config", str(flown.folder / "swath.toml"), "--strips", str(tmp_path / "halves.csv"), "--no-sigma")
    assert run_app(flown.arguments(tmp_path / "out", *more)) == 0
    counts = json.loads(next((tmp_path / "out").glob("*.json")).read_text())["counts"]["left"]
    assert counts["read"] == len(truth["left.gps_ns"]) > 150_000
    assert set(counts["dropped"]) <= {"mta_gap", "mta_ambiguous"}
    assert counts["written"] > 0.999 * counts["read"]

    files = [laspy.read(path) for path in sorted((tmp_path / "out").glob("*.laz"))]
    assert len(files) == 2
    points = np.concatenate([las.xyz for las in files])
    gps_ns = np.concatenate([np.rint((np.asarray(las.gps_time) + 1e9) * 1e9) for las in files])
    to_map = Transformer.from_crs("EPSG:4978", "EPSG:32632", always_xy=True)
    expected = np.stack(to_map.transform(*truth["left.point_e"].T), axis=1)
    order = np.argsort(truth["left.gps_ns"], kind="stable")
    true_ns = truth["left.gps_ns"][order]
    of_pulse = np.searchsorted(true_ns, gps_ns - 1000)  # pulses are 6.7 µs apart
    missed = np.full(len(points), np.inf)
    for other in range(3):
        at = np.minimum(of_pulse + other, len(order) - 1)
        same = np.abs(true_ns[at] - gps_ns) < 1000
        apart = np.linalg.norm(points - expected[order[at]], axis=1)
        missed = np.where(same, np.minimum(missed, apart), missed)
    # half a count of the encoder, which a flat mirror doubles, half of the file's millimetre along each axis, and 1 mm
    count_m = 2.0 * np.pi / ENCODER_COUNTS * truth["left.range_m"].max()
    assert missed.max() < count_m + 0.0005 * np.sqrt(3.0) + 0.001
