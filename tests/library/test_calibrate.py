"""Tests that calibration from Python gives the file of the command."""

from __future__ import annotations

from pathlib import Path

import pytest

import swath
from swath.daemon.cli.main import run_app
from tests.calib.village import village

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("kernels")]
OF_A_RUN = ("id = ", "created = ")


def lines(text: str) -> list[str]:
    """Return the lines of a calibration file that every run writes alike."""
    found = text.splitlines()
    kept = [line for line in found if not line.startswith(OF_A_RUN)]
    assert len(kept) == len(found) - len(OF_A_RUN)
    return kept


def test_a_calibration_has_the_file_of_the_command(tmp_path: Path) -> None:
    made = village(tmp_path, prf_hz=5_000.0)
    track, control, log = (tmp_path / name for name in ("true_trajectory.csv", "control.csv", "logs"))
    result = swath.calibrate(swath.open(log), model="basic", track=track, control=control, datum="same")
    options = ("--trajectory", str(track), "--control", str(control), "--trajectory-datum", "same", "--workers", "1")
    theirs = tmp_path / "theirs.toml"
    assert run_app(["calibrate", str(log), "-o", str(theirs), "--model", "basic", *options]) in (0, 1)  # by the verdict
    [ours] = result.write(tmp_path / "ours.toml")
    assert lines(ours.read_text()) == lines(theirs.read_text())
    omega = result.parameters["left.omega_rad"]
    assert abs(omega.value - made.truth.parameters[0]) < 4.0 * omega.sigma
    with pytest.raises(swath.SwathError, match="already exists; choose another name or use overwrite=True"):
        result.write(ours)
    assert result.report(tmp_path / "report").read_text().startswith("<!doctype html>")
