"""Tests that decoding, export, repair, georeferencing and navigation give the same on two processors.

Everything up to the points in e is equal to the last bit on a host that has FMA: numba fuses no product and sum, and
glibc's sine and cosine then consist of the same operations. Later steps differ: PROJ's compiler fuses a · b + c on
ARM64 but not on x86-64, glibc's hypot differs between the two, and so does the order of BLAS's sums.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest

HERE = Path(__file__).resolve().parent
TREE = HERE.parent.parent
ARM64 = HERE / ".cache/venv/bin/python"
FLOWN_S = "24"
HANGS_S = 3000.0
DATA_LOST = 4

MAP_M = 1e-9  # the last digit of a northing of 5 259 km, and of the earth's radius in PROJ's heights
FINE_SCALE_M = 1e-6
EARTH_M = 6.4e6
OF_A_SIGMA = 1e-5  # allows for rounding in a filter and smoother of thousands of epochs


@dataclass(frozen=True)
class Both:
    """Folders of the products of one command on both processors."""

    host: Path
    arm64: Path


def run(python: str | Path, *words: str | Path, status: int = 0) -> None:
    """Run a module of the project in the tree; it must end with the given status."""
    line = [str(word) for word in (python, "-m", *words)]
    done = subprocess.run(line, cwd=TREE, capture_output=True, text=True, timeout=HANGS_S, check=False)
    assert done.returncode == status, f"{line}\n{done.stdout[-4000:]}{done.stderr[-4000:]}"


def on_both(folder: Path, *words: str | Path, status: int = 0) -> Both:
    """Run a module with either Python; ``{}`` in an argument stands for that run's own folder, which may exist."""
    both = Both(folder / "host", folder / "arm64")
    for python, own in ((sys.executable, both.host), (ARM64, both.arm64)):
        own.mkdir(parents=True, exist_ok=True)
        run(python, *(str(word).replace("{}", str(own)) for word in words), status=status)
    return both


def contents(folder: Path) -> dict[str, bytes]:
    """Return the contents of all files below a folder by their relative paths."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture(scope="module", autouse=True)
def other_processor() -> None:
    """Fail unless the emulated processor is available and of another kind than the host's."""
    if not ARM64.exists():
        pytest.fail("there is no Python for ARM64: make test-arm64 installs it (tests/arm64/setup.sh)")
    said = subprocess.run([ARM64, "-c", "import os; print(os.uname().machine)"], capture_output=True, text=True)
    assert (os.uname().machine, said.stdout) == ("x86_64", "aarch64\n"), said.stderr


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the log of a virtual flight and its files, made on the host."""
    folder = tmp_path_factory.mktemp("flight")
    run(
        sys.executable, "swath.daemon.cli.main", "sim", "fly", "small", "--seconds", FLOWN_S, "--no-truth", "-o", folder
    )
    return folder


@pytest.fixture(scope="module")
def outcomes(flight: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Mapping[str, Any], Mapping[str, Any]]:
    """Return the outcome of `tests.arm64.outcome` on both processors."""
    both = on_both(tmp_path_factory.mktemp("outcomes"), "tests.arm64.outcome", flight, "{}/outcome.npz")
    return np.load(both.host / "outcome.npz"), np.load(both.arm64 / "outcome.npz")


def test_every_record_of_every_decoder_is_the_same(outcomes: tuple[Mapping[str, Any], Mapping[str, Any]]) -> None:
    host, arm64 = ({name: str(found[name]) for name in found if name.startswith("digest ")} for found in outcomes)
    assert set(host) == {"digest gnss/rover", "digest imu/main", "digest scanner/left"}
    assert host == arm64


@pytest.mark.parametrize("what", ["trajectory", "e"])
def test_trajectory_and_earth_centred_points_are_the_same_bit_for_bit(
    outcomes: tuple[Mapping[str, Any], Mapping[str, Any]], what: str
) -> None:
    host, arm64 = outcomes
    names = [name for name in host if name.startswith(f"{what} ")]
    assert len(host[names[0]]) > 1000
    assert {name for name in names if host[name].tobytes() != arm64[name].tobytes()} == set()


def test_map_points_differ_only_by_the_last_digits_of_proj(
    outcomes: tuple[Mapping[str, Any], Mapping[str, Any]],
) -> None:
    host, arm64 = outcomes
    names = [name for name in host if name.startswith("map ") and name != "map points_map"]
    assert {name for name in names if host[name].tobytes() != arm64[name].tobytes()} == set()
    assert len(host["map points_map"]) > 800_000
    assert np.abs(host["map points_map"] - arm64["map points_map"]).max() <= MAP_M


@pytest.mark.parametrize("scale_m", [1e-3, FINE_SCALE_M])
def test_point_files_differ_by_at_most_a_unit_of_their_scale(flight: Path, tmp_path: Path, scale_m: float) -> None:
    words = (
        "swath.daemon.cli.main",
        "georef",
        flight,
        "--accept-verdict",
        "-o",
        "{}",
        "--scale",
        f"{scale_m:f}",
        "--workers",
        "1",
    )
    both = on_both(tmp_path, *words)
    (path,) = both.host.glob("*.laz")
    host, arm64 = laspy.read(path), laspy.read(both.arm64 / path.name)
    assert len(host.points) == len(arm64.points) > 800_000
    for name in host.point_format.dimension_names:
        apart = np.asarray(host[name]).astype(np.int64) - np.asarray(arm64[name]).astype(np.int64)
        assert np.abs(apart).max() <= (1 if name in ("X", "Y", "Z") else 0), name
    moved = sum(np.count_nonzero(np.asarray(host[name]) != np.asarray(arm64[name])) for name in ("X", "Y", "Z"))
    # a value rounds differently if a border between units is within MAP_M; expected at most so many, plus their scatter
    expected = 2 * 3 * len(host.points) * MAP_M / scale_m
    assert moved <= expected + 5 * np.sqrt(expected)


def test_exported_captures_are_the_same(flight: Path, tmp_path: Path) -> None:
    both = on_both(tmp_path, "swath.daemon.cli.main", "export", flight, "{}/exported")
    host = contents(both.host)
    assert sum(map(len, host.values())) > 20_000_000
    assert host == contents(both.arm64)


def test_a_recovered_log_is_the_same(flight: Path, tmp_path: Path) -> None:
    """The log has lost its end and has one wrong byte, so chunks are read, checked, written and summed."""
    (log,) = flight.glob("*.mcap")
    damaged = bytearray(log.read_bytes()[: -(2 << 20)])
    damaged[len(damaged) // 2] ^= 0x10
    for own in ("host", "arm64"):
        (tmp_path / own).mkdir()
        (tmp_path / own / log.name).write_bytes(damaged)
    both = on_both(tmp_path, "swath.daemon.cli.main", "recover", "{}", status=DATA_LOST)
    host = contents(both.host)
    assert len(host) == 2
    assert host == contents(both.arm64)


def test_navigated_trajectories_differ_by_far_less_than_their_sigma(flight: Path, tmp_path: Path) -> None:
    """BLAS chooses the order of sums; columns of SBET and smrmsg are those that Applanix lists."""
    both = on_both(tmp_path, "swath.daemon.cli.main", "trajectory", flight, "-o", "{}")
    ((host, sigma), (arm64, _)) = (
        (np.fromfile(next(own.glob("*.sbet"))).reshape(-1, 17), np.fromfile(next(own.glob("*.smrmsg"))).reshape(-1, 10))
        for own in (both.host, both.arm64)
    )
    assert len(host) == len(arm64) == len(sigma) > 4000
    assert np.array_equal(host[:, 0], arm64[:, 0])
    apart = np.abs(host - arm64) * [1.0, EARTH_M, EARTH_M, *[1.0] * 14]
    attitude_rad = np.radians(sigma[:, 7:10] / 60.0)
    for columns, sigmas in ((slice(1, 4), sigma[:, 1:4]), (slice(4, 7), sigma[:, 4:7]), (slice(7, 10), attitude_rad)):
        assert (apart[:, columns].max() / sigmas.min()) <= OF_A_SIGMA
