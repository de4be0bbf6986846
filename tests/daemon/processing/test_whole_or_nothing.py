"""Tests that a product is on the disk before it gets its name, and that interruptions leave nothing."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import IO

import pytest

from swath.daemon.cli.main import run_app
from swath.daemon.exchange.export import export_session
from swath.daemon.log.reader import open_logs
from swath.daemon.processing import files as whole_files
from swath.daemon.processing.calibration import products as calibrate_products
from swath.daemon.processing.files import put_in_place, write_aside, write_whole
from swath.daemon.processing.georeferencing.sidecar import write_sidecar
from tests.daemon.builders import INFO, write_part
from tests.daemon.one_line import fly

pytestmark = pytest.mark.xdist_group("kernels")

Synced = set[int]  # inodes


@pytest.fixture
def synced(monkeypatch: pytest.MonkeyPatch) -> Synced:
    """Return the list of paths synced to the disk."""
    found: Synced = set()
    sync = os.fsync

    def note(fd: int) -> None:
        sync(fd)
        found.add(os.fstat(fd).st_ino)

    monkeypatch.setattr(os, "fsync", note)
    return found


def missing(synced: Synced, folder: Path) -> list[str]:
    """Return files and folders that were not synchronised to the disk."""
    there = [folder, *folder.rglob("*")]
    return [str(path.relative_to(folder.parent)) for path in there if path.stat().st_ino not in synced]


def test_calibration_files_are_synced_to_the_disk(tmp_path: Path, synced: Synced) -> None:
    folder = tmp_path / "out"
    calibrate_products._write({folder / "left.toml": b"a", folder / "report" / "report.html": b"b"})
    assert missing(synced, folder) == []
    assert sorted(path.name for path in folder.rglob("*")) == ["left.toml", "report", "report.html"]


def test_a_sidecar_is_synced_to_the_disk(tmp_path: Path, synced: Synced) -> None:
    write_sidecar(tmp_path / "a.json", {"name": "Zürich"})
    assert missing(synced, tmp_path) == []
    assert (tmp_path / "a.json").read_text(encoding="utf-8") == '{\n  "name": "Zürich"\n}\n'


def test_an_export_is_synced_to_the_disk(tmp_path: Path, synced: Synced) -> None:
    log = tmp_path / f"{INFO.session_id}_0.mcap"
    write_part(log)
    synced.clear()
    export_session(open_logs([log])[0], tmp_path / "out")
    assert missing(synced, tmp_path / "out") == []
    assert len(list((tmp_path / "out").rglob("*"))) > 4


@pytest.mark.slow
def test_points_are_synced_to_the_disk(tmp_path: Path, synced: Synced) -> None:
    flown = fly(tmp_path)
    synced.clear()
    assert run_app(flown.arguments(tmp_path / "out")) == 0
    assert missing(synced, tmp_path / "out") == []
    assert len(list((tmp_path / "out").iterdir())) >= 5  # strips, three files of the trajectory, the sidecar


def test_an_interruption_during_writing_leaves_no_file(tmp_path: Path) -> None:
    def interrupted(stream: IO[bytes]) -> None:
        stream.write(b"half")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_aside(tmp_path / "a.csv", interrupted)
    assert list(tmp_path.iterdir()) == []


def test_an_interruption_between_two_files_leaves_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    aside: list[Path] = []

    def second_is_interrupted(path: Path, write: Callable[[IO[bytes]], None]) -> Path:
        if aside:
            raise KeyboardInterrupt
        aside.append(write_aside(path, write))
        return aside[0]

    monkeypatch.setattr(whole_files, "write_aside", second_is_interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_whole({tmp_path / "a": b"a", tmp_path / "b": b"b"})
    assert list(tmp_path.iterdir()) == []


def test_an_interruption_during_renaming_leaves_no_temporary_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    written = [(write_aside(tmp_path / name, lambda stream: None), tmp_path / name) for name in ("a", "b", "c")]
    replace = Path.replace

    def second_is_interrupted(aside: Path, path: Path) -> Path:
        if path.name == "b":
            raise KeyboardInterrupt
        return replace(aside, path)

    monkeypatch.setattr(Path, "replace", second_is_interrupted)
    with pytest.raises(KeyboardInterrupt):
        put_in_place(written)
    assert [path.name for path in tmp_path.iterdir()] == ["a"]
