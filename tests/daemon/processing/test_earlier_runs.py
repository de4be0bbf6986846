"""Tests that files of an earlier run are refused, replaced or removed, and foreign files stay."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from swath.daemon.cli.main import run_app
from swath.daemon.errors import ExitCode, UserError
from swath.daemon.processing.earlier_runs import listed_files, refuse_existing, relative_to, stale_pages, stale_records
from swath.daemon.processing.files import aside_folder
from tests.daemon.one_line import Flown, fly

pytestmark = pytest.mark.xdist_group("kernels")


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Flown:
    """Return a flight of one line."""
    return fly(tmp_path_factory.mktemp("flown"))


@pytest.fixture(scope="module")
def viewed(flown: Flown, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder of points with their page."""
    folder = tmp_path_factory.mktemp("products") / "out"
    assert run_app(flown.arguments(folder)) == 0
    assert run_app(["view", str(folder)]) == 0
    return folder


def test_records_of_scanners_that_are_gone_are_found_by_their_ids(tmp_path: Path) -> None:
    outcome = tmp_path / "calibration.json"
    outcome.write_text(json.dumps({"calibrations": {"left": "L-1", "right": "R-1", "../up": "U-1", "rear": "B-1"}}))
    for name, identity in (("left", "L-1"), ("right", "R-1"), ("rear", "of another run")):
        (tmp_path / f"{name}.record.json").write_text(json.dumps({"id": identity}))
        (tmp_path / f"{name}.record.npz").touch()
    found = stale_records(outcome, {"left"})
    assert sorted(path.name for path in found) == ["right.record.json", "right.record.npz"]
    assert stale_records(tmp_path / "none.json", {"left"}) == []


@pytest.mark.slow
def test_view_replaces_its_page_only_if_asked(viewed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    copy = Path(shutil.copytree(viewed, tmp_path / "out"))
    page = copy / "view/index.html"
    before = page.stat().st_mtime_ns
    assert run_app(["view", str(copy)]) == ExitCode.USAGE
    said = capsys.readouterr().err
    assert said == f"swath: {copy}/view/view.json: already exists; choose another folder or use --overwrite\n"
    assert page.stat().st_mtime_ns == before
    (copy / "view/notes.txt").touch()
    record = json.loads((copy / "view/view.json").read_text())
    (copy / "view/profile_2.png").touch()
    record["files"].append("profile_2.png")  # as if the earlier run had made one more
    (copy / "view/view.json").write_text(json.dumps(record))
    assert run_app(["view", str(copy), "--overwrite"]) == 0
    assert page.stat().st_mtime_ns > before
    names = {path.name for path in (copy / "view").iterdir()}
    assert "notes.txt" in names
    assert "profile_2.png" not in names
    assert not any(name.startswith(".") for name in names)


@pytest.mark.slow
def test_georef_removes_the_page_of_points_that_it_replaces(
    flown: Flown, viewed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    copy = Path(shutil.copytree(viewed, tmp_path / "out"))
    (copy / "mine").mkdir()
    (copy / "mine/index.html").touch()
    assert run_app(["view", str(viewed), "-o", str(copy / "other")]) == 0  # this view has points of another folder
    assert run_app(flown.arguments(copy, "--overwrite")) == 0
    assert not (copy / "view").exists()
    assert (copy / "mine/index.html").exists()
    assert (copy / "other/index.html").exists()
    [sidecar] = [path for path in copy.glob("*.json") if not path.stem.endswith("_trajectory")]
    [line] = [line for line in json.loads(sidecar.read_text())["warnings"] if "removed pages" in line]
    assert "view/index.html" in line


def test_only_files_beside_a_record_that_it_names_are_listed(tmp_path: Path) -> None:
    folder = tmp_path / "out"
    (folder / "view").mkdir(parents=True)
    for name in ("a.laz", "view/index.html", "view/mine.txt", "secret.txt"):
        (folder / name).touch()
    (folder / "view/link.png").symlink_to(folder / "secret.txt")
    record = folder / "view/view.json"
    listed = {
        "of": relative_to(record.parent, [folder / "a.laz"]),
        "files": ["index.html", "../secret.txt", "link.png"],
    }
    record.write_text(json.dumps(listed))
    assert listed_files(record) == [folder / "view/index.html"]
    assert stale_pages(folder, [folder / "a.laz"]) == [folder / "view/index.html", record]
    assert stale_pages(folder, [folder / "b.laz"]) == []
    for text in ("[]", "{", '{"of": 3, "files": {}}', '{"of": [1]}'):
        record.write_text(text)
        assert stale_pages(folder, [folder / "a.laz"]) == listed_files(record) == []


def test_files_that_exist_are_refused_with_the_remedy(tmp_path: Path) -> None:
    (tmp_path / "a").touch()
    refuse_existing([tmp_path / "b"], overwrite=False)
    refuse_existing([tmp_path / "a"], overwrite=True)
    with pytest.raises(UserError, match="a: already exists; choose another name or use --overwrite"):
        refuse_existing([tmp_path / "b", tmp_path / "a"], overwrite=False, instead="name")


def test_files_get_their_places_at_once_and_old_ones_go(tmp_path: Path) -> None:
    (tmp_path / "old.png").touch()
    (tmp_path / "same.png").write_bytes(b"old")
    with aside_folder(tmp_path, [tmp_path / "old.png", tmp_path / "same.png"]) as aside:
        (aside / "same.png").write_bytes(b"new")
        assert (tmp_path / "same.png").read_bytes() == b"old"
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == {"same.png": b"new"}
