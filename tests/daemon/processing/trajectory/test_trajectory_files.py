"""Tests the files of a trajectory: their contents and places, and that a failure leaves nothing."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from swath.daemon.errors import UserError
from swath.daemon.processing.files import put_in_place
from swath.daemon.processing.trajectory import files as trajectory_files
from swath.daemon.processing.trajectory.files import TrajectoryFiles, smrmsg_beside, write_trajectory
from swath.daemon.written import PARTIAL
from swath.georef.formats.sbet import sbet_bytes
from swath.georef.formats.trajectory.csv import csv_text
from swath.georef.formats.trajectory.file import read_trajectory
from swath.georef.trajectory.trajectory import Trajectory

pytestmark = pytest.mark.xdist_group("kernels")

S = 1_000_000_000
WEEK_NS = 604_800 * S


@pytest.fixture
def trajectory() -> Trajectory:
    """Return a climbing turn across the end of the week."""
    n = 50
    time_ns = 2423 * WEEK_NS - 2 * S + np.arange(n) * S // 10
    since = (time_ns - time_ns[0]) / S
    heading = 0.3 + 0.2 * since
    velocity = np.stack([30 * np.cos(heading), 30 * np.sin(heading), np.full(n, -1.0)], axis=1)
    north, east = 150 * (np.sin(heading) - np.sin(0.3)), -150 * (np.cos(heading) - np.cos(0.3))
    return Trajectory.from_geodetic(
        time_ns,
        0.82 + north / 6.37e6,
        0.15 + east / (6.39e6 * np.cos(0.82)),
        500.0 + since,
        velocity,
        np.full(n, 0.1),
        np.full(n, 0.02),
        heading,
        position_sigma_l=np.stack([0.01 + 0.001 * since, 0.02 + 0 * since, 0.03 + 0 * since], axis=1),
        attitude_sigma_rad=np.full((n, 3), 1e-4),
        name="turn",
    )


def written(files: TrajectoryFiles, trajectory: Trajectory) -> None:
    sigma = np.full((len(trajectory), 3), 0.005) + np.arange(3) * 0.001
    put_in_place(write_trajectory(files, trajectory, sigma))


@pytest.mark.parametrize("name", ["f1.sbet", "F1.SBET", "f1.out", "sbet_f1.out", "sbet_f1.OUT", "sbet_f1.sbet"])
def test_the_sigmas_of_an_sbet_are_found_beside_it(trajectory: Trajectory, tmp_path: Path, name: str) -> None:
    files = TrajectoryFiles.of_output(tmp_path / name, "x", csv=False)
    assert files.sbet is not None
    assert smrmsg_beside(files.sbet) is None
    written(files, trajectory)
    assert smrmsg_beside(files.sbet) == files.smrmsg


def test_sigmas_named_as_by_applanix_are_found(tmp_path: Path) -> None:
    (tmp_path / "smrmsg_f1.sbet").touch()
    assert smrmsg_beside(tmp_path / "sbet_f1.sbet") == tmp_path / "smrmsg_f1.sbet"
    assert smrmsg_beside(tmp_path / "f1.csv") is None


@pytest.mark.parametrize("block", [7, 49, 50, 1000])
def test_files_do_not_depend_on_the_block_size(
    trajectory: Trajectory, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, block: int
) -> None:
    monkeypatch.setattr(trajectory_files, "BLOCK", block)
    files = TrajectoryFiles.of_output(tmp_path / "a.sbet", "x", csv=True)
    written(files, trajectory)
    assert files.sbet is not None
    assert files.csv is not None
    mine, whole = (
        np.frombuffer(data, "<f8").reshape(-1, 17) for data in (files.sbet.read_bytes(), sbet_bytes(trajectory))
    )
    assert np.array_equal(mine, whole)
    assert files.csv.read_text() == csv_text(trajectory)


def test_a_written_trajectory_is_read_back(trajectory: Trajectory, tmp_path: Path) -> None:
    files = TrajectoryFiles.of_output(tmp_path / "a.sbet", "x", csv=False)
    written(files, trajectory)
    assert files.sbet is not None
    assert files.smrmsg is not None
    span = int(trajectory.time_ns[3]), int(trajectory.time_ns[-3])
    again = read_trajectory(files.sbet.read_bytes(), "a.sbet", span_ns=span, smrmsg=files.smrmsg.read_bytes())
    assert np.abs(again.time_ns - trajectory.time_ns).max() <= 100
    assert np.abs(again.position_e - trajectory.position_e).max() < 1e-6
    assert np.abs(again.position_sigma_l - trajectory.position_sigma_l).max() < 1e-12
    table = np.frombuffer(files.smrmsg.read_bytes(), "<f8").reshape(-1, 10)
    assert table[:, 0].max() > 604_800.0  # seconds of the first one's week
    assert table[9, 4:7] == pytest.approx([0.005, 0.006, 0.007])
    assert table[9, 7:10] == pytest.approx(np.degrees(1e-4) * 60)  # arc minutes


class TestNames:
    def test_a_folder_holds_files_with_the_name_of_the_session(self, tmp_path: Path) -> None:
        files = TrajectoryFiles.of_output(tmp_path, "flight-1", csv=True)
        names = {path.name for path in files.all()}
        assert names == {f"flight-1_trajectory{end}" for end in (".sbet", ".smrmsg", ".csv", ".json", ".html", ".pdf")}

    def test_sigmas_are_written_where_georeferencing_looks_for_them(self, tmp_path: Path) -> None:
        applanix = TrajectoryFiles.of_output(tmp_path / "sbet_f1.out", "x", csv=False)
        assert applanix.smrmsg == tmp_path / "smrmsg_f1.out"
        plain = TrajectoryFiles.of_output(tmp_path / "f1.sbet", "x", csv=False)
        assert plain.smrmsg == tmp_path / "f1.smrmsg"
        assert plain.csv is None

    def test_a_csv_output_is_written_alone(self, tmp_path: Path) -> None:
        files = TrajectoryFiles.of_output(tmp_path / "f1.csv", "x", csv=False)
        assert (files.sbet, files.smrmsg, files.csv) == (None, None, tmp_path / "f1.csv")

    def test_another_file_extension_is_refused(self, tmp_path: Path) -> None:
        with pytest.raises(UserError, match=r"the name must end in \.sbet, \.out or \.csv, or be a folder"):
            TrajectoryFiles.of_output(tmp_path / "f1.txt", "x", csv=False)

    def test_existing_files_are_named(self, tmp_path: Path) -> None:
        files = TrajectoryFiles.of_output(tmp_path / "f1.sbet", "x", csv=False)
        files.refuse_existing(tmp_path / "events.csv")
        (tmp_path / "events.csv").touch()
        with pytest.raises(UserError, match=r"events\.csv: already exists; .* --overwrite"):
            files.refuse_existing(tmp_path / "events.csv")


def test_a_write_error_leaves_no_files(trajectory: Trajectory, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    files = TrajectoryFiles.of_output(tmp_path / "a.sbet", "x", csv=False)

    def full(descriptor: int) -> None:
        if (tmp_path / f"a.smrmsg{PARTIAL}").exists():
            raise OSError(28, "No space left on device")

    monkeypatch.setattr("swath.daemon.processing.files.os.fsync", full)
    with pytest.raises(OSError, match="No space"):
        write_trajectory(files, trajectory, None)
    assert not list(tmp_path.iterdir())
