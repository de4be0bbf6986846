"""Tests that a flight goes through a bag of decoded messages and keeps its trajectory and its points."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

import swath as library
from swath.daemon.config import load_config
from swath.daemon.exchange.capture_files import ImportOptions
from tests.daemon.commands import swath
from tests.daemon.exchange.builders import run_import
from tests.daemon.short_flight import errors
from tests.library.builders import fly

POSITION_M, LEVEL_DEG = 0.02, 0.02  # the bag has neither velocities nor headings of the receiver


@pytest.mark.slow
def test_a_flight_goes_through_a_bag(tmp_path: Path) -> None:
    """The configuration is the proposed one; its offset of the samples is estimated, from 0.1 s to what is true, 0."""
    flown = fly(tmp_path, seconds=20.0)
    assert swath("export", str(flown.folder / "logs"), str(tmp_path / "out"), "--ros2").returncode == 0
    [bag] = (tmp_path / "out").iterdir()
    text = swath("import", "--list", str(bag)).stdout
    assert "gravity shows that z points down" in text
    arm = re.findall(r"(?m)^lever_arm_m = .*$", (flown.folder / "swath.toml").read_text())[0]
    text = re.sub(r"(?m)^lever_arm_m = .*$", arm, text, count=1)
    (tmp_path / "ros.toml").write_text(text)
    named = [line.strip(" #\\").removeprefix("--source ") for line in text.splitlines() if "--source" in line]
    report, _ = run_import(load_config(tmp_path / "ros.toml"), [], tmp_path / "ros", ImportOptions(named))
    assert sum(source.startswith("scanner/") for source in report.units) == 1
    before, after = library.open(flown.folder / "logs"), library.open(tmp_path / "ros")
    one, other = library.navigate(before), library.navigate(after)
    assert any("good to 100.0 ms only" in line for line in other.warnings)
    # the epochs are moved by the estimated offset, so that they lie between those of the other
    position_m, angles_rad = errors(other.trajectory, one.trajectory)
    assert len(position_m) > 0.9 * len(other)
    assert np.sqrt((position_m**2).sum(axis=1).mean()) < POSITION_M
    sigma_rad = other.trajectory.attitude_sigma_rad.max(axis=0)
    assert (np.abs(angles_rad).max(axis=0) < 3.0 * sigma_rad).all()  # a straight line without velocities: heading 0.3°
    assert np.degrees(np.abs(angles_rad).mean(axis=0))[:2].max() < LEVEL_DEG
    (source,) = (name for name in after.sources if name.startswith("scanner/"))
    ranges = [
        np.concatenate([batch["range_m"] for batch in log[name].returns()])
        for log, name in ((before, "scanner/left"), (after, source))
    ]
    assert len(ranges[0]) == len(ranges[1])
    np.testing.assert_allclose(np.sort(ranges[1]), np.sort(ranges[0]), atol=1e-3)  # the bag has single precision
