"""Tests that a finished log grows again at its pace, and is then the same file."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from swath.daemon.console.replaying import GrowingCopy
from swath.daemon.log.claim import is_being_written
from swath.daemon.log.parts import read_sign
from swath.daemon.log.reader import open_logs
from tests.daemon.builders import INFO, write_part
from tests.daemon.commands import swath
from tests.daemon.rig import wait_until


@pytest.mark.slow
def test_a_log_grows_at_its_pace_and_is_the_same_in_the_end(tmp_path: Path) -> None:
    """The part spans 0.24 s; at a tenth of its pace that takes two seconds at least."""
    logs, folder = tmp_path / "logs", tmp_path / "grown"
    logs.mkdir()
    folder.mkdir()
    source = logs / f"{INFO.session_id}_0.mcap"
    write_part(source)
    (session,) = open_logs([logs])
    ready: list[bool] = []
    growing = GrowingCopy(session, folder, 0.1, lambda: bool(ready))
    growing.start()
    copy = folder / source.name
    wait_until(lambda: copy.exists() and is_being_written(copy), "a writer")
    wait_until(lambda: read_sign(folder) is not None, "the sign of a recording")
    time.sleep(0.5)
    held = copy.stat().st_size
    time.sleep(0.5)
    assert copy.stat().st_size == held < source.stat().st_size / 2  # one chunk only, until live is ready
    ready.append(True)
    began_s = time.monotonic()
    wait_until(lambda: not growing.is_alive(), "the end")
    assert time.monotonic() - began_s > 1.0
    assert copy.read_bytes() == source.read_bytes()
    assert read_sign(folder) is None
    assert not is_being_written(copy)


def test_a_copy_that_is_closed_ends_at_once(tmp_path: Path) -> None:
    logs, folder = tmp_path / "logs", tmp_path / "grown"
    logs.mkdir()
    folder.mkdir()
    write_part(logs / f"{INFO.session_id}_0.mcap")
    (session,) = open_logs([logs])
    growing = GrowingCopy(session, folder, 0.01, lambda: True)
    growing.start()
    wait_until(lambda: read_sign(folder) is not None, "the sign of a recording")
    growing.close()
    assert not growing.is_alive()


@pytest.mark.parametrize(("name", "words"), [("nothing.mcap", "no such file"), ("text.mcap", "is not an MCAP file")])
def test_a_log_that_is_none_is_refused_in_one_line(tmp_path: Path, name: str, words: str) -> None:
    (tmp_path / "text.mcap").write_text("no log")
    run = swath("console", "--replay", str(tmp_path / name))
    assert run.returncode == 3
    assert words in run.stderr
    assert run.stderr.count("\n") == 1
