"""Tests that navigation, georeferencing and calibration from Python give what the commands give."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import swath
from tests.daemon.builders import digests
from tests.daemon.commands import swath as command
from tests.daemon.short_flight import ARM_B, Flown, errors
from tests.library.builders import examples, fly

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Flown:
    return fly(tmp_path_factory.mktemp("library"))


@pytest.fixture(scope="module")
def log(flown: Flown) -> swath.Log:
    return swath.open(flown.folder / "logs")


@pytest.fixture(scope="module")
def track(log: swath.Log) -> swath.Track:
    return swath.navigate(log)


def test_a_track_has_the_bytes_of_the_command(flown: Flown, track: swath.Track, tmp_path: Path) -> None:
    files = track.write(tmp_path / "ours.sbet")
    command("trajectory", str(flown.folder / "logs"), "-o", str(tmp_path / "theirs.sbet"), "--no-page")
    assert [file.name for file in files] == ["ours.sbet", "ours.smrmsg"]
    for ending in (".sbet", ".smrmsg"):
        assert (tmp_path / f"ours{ending}").read_bytes() == (tmp_path / f"theirs{ending}").read_bytes()
    with pytest.raises(swath.SwathError, match="already exists; choose another name or use overwrite=True"):
        track.write(tmp_path / "ours.sbet")
    with pytest.raises(swath.SwathError, match=r"must end in \.sbet, \.out or \.csv"):
        track.write(tmp_path / "ours.txt")


def test_a_track_lies_on_the_truth_within_its_sigmas(flown: Flown, track: swath.Track) -> None:
    position_m, attitude_rad = errors(track.trajectory, flown.truth())
    assert np.median(np.abs(position_m)) < 0.03
    assert np.sqrt(np.mean((attitude_rad / track.attitude_sigma_rad[: len(attitude_rad)]) ** 2)) < 2.0


def test_arrays_are_navigated_like_the_log(flown: Flown, log: swath.Log, track: swath.Track) -> None:
    imu, gnss = log["imu/main"].samples(), log["gnss/rover"].fixes()
    own = swath.navigate(imu=imu, gnss=gnss, lever_arm_b=ARM_B.tolist())
    position_m, _ = errors(own.trajectory, flown.truth())
    assert np.median(np.abs(position_m)) < 0.03
    common = np.intersect1d(own.gps_ns, track.gps_ns)
    assert len(common) > 0.9 * len(track)
    apart_m = np.linalg.norm(own.at(common).position_e - track.at(common).position_e, axis=1)
    assert np.median(apart_m) < 0.02
    assert any("without sigmas" in line for line in own.warnings)


def bare(gnss: Any) -> Any:
    """Return positions with their type alone."""
    placed = gnss[np.isfinite(gnss["lat_rad"])]
    fields = [("gps_ns", "i8"), ("lat_rad", "f8"), ("lon_rad", "f8"), ("height_m", "f8"), ("fix_type", "u1")]
    rows = np.zeros(len(placed), fields)
    for name in rows.dtype.names or ():
        rows[name] = placed[name]
    return rows


def test_bare_arrays_are_navigated_with_an_estimated_lever_arm(flown: Flown, log: swath.Log) -> None:
    own = swath.navigate(imu=log["imu/main"].samples(), gnss=bare(log["gnss/rover"].fixes()))
    arm_m, sigma_m = own.solutions[0].lever_arm_b[-1], own.solutions[0].lever_arm_sigma[-1]
    assert (np.abs(arm_m - ARM_B) < 4.0 * sigma_m).all()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({}, "give a log, or arrays of both"),
        ({"imu": np.zeros(3, [("gps_ns", "i8")]), "gnss": np.zeros(3)}, "imu: has no field specific_force_b"),
    ],
)
def test_wrong_arrays_are_answered_in_a_sentence(arguments: dict[str, Any], words: str) -> None:
    with pytest.raises(swath.SwathError, match=words):
        swath.navigate(**arguments)


def test_points_have_the_bytes_of_the_command(flown: Flown, log: swath.Log, tmp_path: Path) -> None:
    points = swath.georeference(log, crs="EPSG:32632", min_strip_s=5.0)
    files = points.write(tmp_path / "ours")
    logs, theirs = str(flown.folder / "logs"), str(tmp_path / "theirs")
    command(
        "georef", logs, "-o", theirs, "--crs", "EPSG:32632", "--min-strip", "5", "--accept-verdict", "--workers", "1"
    )
    ours, other = digests(tmp_path / "ours"), digests(tmp_path / "theirs")
    assert {name: digest for name, digest in ours.items() if not name.endswith(".json")} == {
        name: digest for name, digest in other.items() if not name.endswith(".json")
    }
    assert sorted(file.name for file in files) == sorted(ours)
    assert sum(name.endswith(".laz") for name in ours) == len(points.strips) == 2


def test_points_are_computed_when_asked_for(log: swath.Log, track: swath.Track) -> None:
    points = swath.georeference(log, track, crs="EPSG:32632", min_strip_s=5.0)
    table = points.read()
    assert points.fates == {"georeferenced": len(table)}
    assert set(table["strip"].tolist()) == {1, 2}
    assert np.isfinite(table["sigma"]).all()
    assert (np.diff(table["gps_ns"].astype(np.int64)) > -1_000_000_000).all()
    assert sum(len(piece) for piece in points) == len(table)
    again = swath.georeference(log, track, crs="EPSG:32632", min_strip_s=5.0, sigmas=False).read()
    np.testing.assert_array_equal(again["xyz"], table["xyz"])
    assert np.isnan(again["sigma"]).all()


def test_a_track_of_arrays_is_checked_against_the_log(flown: Flown, log: swath.Log) -> None:
    imu, gnss = log["imu/main"].samples(), log["gnss/rover"].fixes()
    own = swath.navigate(imu=imu, gnss=gnss, lever_arm_b=ARM_B.tolist())
    points = swath.georeference(log, own, crs="EPSG:32632", min_strip_s=5.0)
    assert len(points.read()) > 1000
    shifted = replace(own.trajectory, position_e=own.trajectory.position_e + 30.0)
    away = swath.Track(shifted, own.solutions, [])
    with pytest.raises(swath.SwathError, match="fixes"):
        swath.georeference(log, away, crs="EPSG:32632", min_strip_s=5.0)


@pytest.mark.parametrize("page", ["README.md", "docs/library/logs.md", "docs/library/processing.md"])
def test_the_examples_of_the_documentation_run(
    flown: Flown, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, page: str
) -> None:
    root = Path(__file__).resolve().parents[2]
    monkeypatch.chdir(tmp_path)
    os.symlink(flown.folder / "logs", "flight")
    os.symlink(flown.folder / "left.true.toml", "left.toml")
    os.symlink(root / "fixtures/hesai/nebula_xt16.pcap.gz", "xt16.pcap")
    blocks = examples(page)
    assert blocks
    names: dict[str, Any] = {}
    for code, runs in blocks:
        compiled = compile(code, page, "exec")
        if runs:
            exec(compiled, names)
