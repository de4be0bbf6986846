"""Tests ``swath validate --anew``: newly measured parameters confirm a true calibration and expose a wrong one."""

from __future__ import annotations

import datetime as dt
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from swath.calib.calibration_file import Header, calibration_text
from swath.daemon.cli.main import run_app
from swath.georef.scanner.calibration import INDEX
from tests.calib.village import Made, village

pytestmark = [pytest.mark.xdist_group("kernels"), pytest.mark.slow]

SIGMAS = {"omega_rad": np.radians(0.003), "range_offset_m": 0.015}
METHOD = "measurementActualParameters"


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Made:
    return village(tmp_path_factory.mktemp("village"), lines=(0, 1, 2, 3))


def validated(made: Made, folder: Path, omega_deg: float, *, sigmas: bool = True) -> tuple[int, Any]:
    """Return exit code and entry of the method for a calibration whose roll is wrong by a given amount."""
    off = made.truth.changed(omega_rad=made.truth.value("omega_rad") + float(np.radians(omega_deg)))
    spread = np.zeros(len(INDEX))
    if sigmas:
        spread[[INDEX[name] for name in SIGMAS]] = list(SIGMAS.values())
    file = folder / "left.toml"
    header = Header("made", dt.datetime(2026, 1, 1, tzinfo=dt.UTC), method="planes")
    file.write_text(calibration_text(replace(off, sigmas=spread), header))
    trajectory = ("--trajectory", str(made.flown.folder / "true_trajectory.csv"), "--trajectory-datum", "same")
    control = ("--control", str(made.flown.folder / "control.csv"), "--workers", "1")
    code = run_app(
        ["validate", str(file), str(made.flown.log), *trajectory, *control, "--anew", "-o", str(folder / "out")]
    )
    methods = json.loads((folder / "out" / "validation.json").read_text())["validation"]["methods"]
    return code, next(one for one in methods if one["method"] == METHOD)


def test_a_true_calibration_is_confirmed_by_a_new_measurement(made: Made, tmp_path: Path) -> None:
    code, method = validated(made, tmp_path, 0.0)
    assert code == 1  # strips see control twice, which is too little for the requested test field
    told = json.loads((tmp_path / "out" / "validation.json").read_text())["validation"]
    assert told["undone"] == ["control: strips see control 2 times only; 5 or more are needed"]
    assert method["passed"] is True
    assert "2 independently measured parameters agree with the calibration" in method["sentence"]
    found = {row["parameter"]: row for row in method["parameters"]}
    assert set(found) == {"omega_deg", "range_offset_m"}
    for row in found.values():
        assert abs(row["difference"]) < 3.0 * row["sigma"]
    assert found["omega_deg"]["sigma"] < 0.006


def test_the_error_of_a_wrong_calibration_is_reported(made: Made, tmp_path: Path) -> None:
    code, method = validated(made, tmp_path, 0.05)
    assert code == 1
    assert method["passed"] is False
    assert "do not agree with the calibration" in method["sentence"]
    (omega,) = [row for row in method["parameters"] if row["parameter"] == "omega_deg"]
    assert abs(omega["difference"] + 0.05) < 3.0 * omega["sigma"]


def test_a_file_without_sigmas_is_not_compared(made: Made, tmp_path: Path) -> None:
    _, method = validated(made, tmp_path, 0.0, sigmas=False)
    assert method["passed"] is None
    assert "both calibrations estimated no common parameter; give a calibration file with sigmas" in method["sentence"]
