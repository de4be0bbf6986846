"""Tests truth files of any length."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from swath.sim.truth import POSE_TRUTH_DTYPE, RETURN_TRUTH_DTYPE, TruthWriter


def test_pieces_are_read_back_as_whole_columns(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    rows = np.zeros(1000, RETURN_TRUTH_DTYPE)
    rows["point_e"], rows["pulse"], rows["surface"] = rng.normal(size=(1000, 3)), np.arange(1000), 4
    writer = TruthWriter(tmp_path / "truth.npz", {"left": RETURN_TRUTH_DTYPE, "trajectory": POSE_TRUTH_DTYPE})
    for start in (0, 7, 600):
        stop = {0: 7, 7: 600, 600: 1000}[start]
        writer.add("left", rows[start:stop])
    writer.finish({"lines": np.array(["a", "b"])})
    assert [path.name for path in tmp_path.iterdir()] == ["truth.npz"]
    with np.load(tmp_path / "truth.npz") as truth:
        for name in RETURN_TRUTH_DTYPE.names or ():
            np.testing.assert_array_equal(truth[f"left.{name}"], rows[name])
        assert truth["trajectory.velocity_l"].shape == (0, 3)
        assert truth["lines"].tolist() == ["a", "b"]


def test_the_same_rows_give_the_same_file(tmp_path: Path) -> None:
    contents = []
    for name in ("one", "two"):
        folder = tmp_path / name
        folder.mkdir()
        writer = TruthWriter(folder / "truth.npz", {"trajectory": POSE_TRUTH_DTYPE})
        writer.add("trajectory", np.ones(5, POSE_TRUTH_DTYPE))
        writer.finish({"control_e": np.ones((2, 3))})
        contents.append((folder / "truth.npz").read_bytes())
    assert contents[0] == contents[1]


def test_an_abandoned_truth_file_is_removed(tmp_path: Path) -> None:
    writer = TruthWriter(tmp_path / "truth.npz", {"trajectory": POSE_TRUTH_DTYPE})
    writer.add("trajectory", np.ones(5, POSE_TRUTH_DTYPE))
    writer.abandon()
    assert list(tmp_path.iterdir()) == []
