"""Tests that files are replaced at once, with and without the kernel's exchange of names."""

from __future__ import annotations

import ctypes
import errno
from collections.abc import Callable
from pathlib import Path

import pytest

from swath.daemon.processing.live import files
from swath.daemon.processing.live.files import exchange_file


def _refused(number: int) -> Callable[..., int]:
    def rename(*_: object) -> int:
        ctypes.set_errno(number)
        return -1

    return rename


@pytest.mark.parametrize("kind", ["exchange", "not in this C library", "not on this file system"])
def test_a_reader_keeps_the_old_content_whole_and_the_next_one_gets_the_new(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    if kind != "exchange":
        monkeypatch.setattr(files, "_renameat2", None if "library" in kind else _refused(errno.EINVAL))
    exchange_file(tmp_path, "steering.json", b"old" * 1000)
    with (tmp_path / "steering.json").open("rb") as file:
        begun = file.read(3)
        exchange_file(tmp_path, "steering.json", b"new")
        exchange_file(tmp_path, "steering.json", b"newer")
        assert begun + file.read() == b"old" * 1000
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == {"steering.json": b"newer"}


def test_a_file_that_cannot_be_replaced_raises(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(FileNotFoundError):
        exchange_file(tmp_path / "missing", "steering.json", b"")
    monkeypatch.setattr(files, "_renameat2", _refused(errno.EIO))
    with pytest.raises(OSError, match=r"steering\.json"):
        exchange_file(tmp_path, "steering.json", b"")
