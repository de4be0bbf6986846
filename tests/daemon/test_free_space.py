"""Tests the space that a command needs against the space on the disk."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path
from types import SimpleNamespace

import pytest

from swath.daemon.errors import ExitCode, UserError
from swath.daemon.free_space import check_space


def with_free(monkeypatch: pytest.MonkeyPatch, free_bytes: int) -> None:
    """Let every disk have a given free space, bytes."""
    monkeypatch.setattr(shutil, "disk_usage", lambda path: SimpleNamespace(free=free_bytes))


def test_too_little_space_is_refused_with_needed_there_and_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with_free(monkeypatch, 1_234_000_000)
    folder = tmp_path / "not" / "yet"
    with pytest.raises(UserError) as refused:
        check_space(folder, "points", least_bytes=5.5e9, most_bytes=2e10)
    assert refused.value.message == (
        f"{folder}: points need 5.5 GB at least, and 1.2 GB are free; make room, or choose a folder on another disk"
    )
    assert refused.value.exit_code == ExitCode.IO
    with pytest.raises(UserError, match="set TMPDIR to a folder on another disk"):
        check_space(Path(tempfile.gettempdir()), "points", least_bytes=5.5e9)


def test_space_that_may_be_too_little_is_a_warning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with_free(monkeypatch, 900_000)
    check_space(tmp_path, "points", least_bytes=800_000, most_bytes=1.5e6)
    assert capsys.readouterr().err == (
        f"swath: {tmp_path}: points may need 1.5 MB, and 900.0 kB are free; make room, or choose a folder on another "
        "disk\n"
    )
    check_space(tmp_path, "points", least_bytes=800, most_bytes=899_999)
    check_space(tmp_path, "points", least_bytes=900_000)
    assert capsys.readouterr().err == ""
