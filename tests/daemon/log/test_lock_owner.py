"""Tests that the service, another user, can record in a log directory in which root has recorded."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from swath.daemon.errors import UserError
from swath.daemon.log.directory import LOCK, take_directory
from tests.builders import ROOT
from tests.daemon.rig import HANGS_S

NOBODY = 65534
AS_NOBODY = """
import os, sys
from pathlib import Path
from swath.daemon.errors import UserError
from swath.daemon.log.directory import take_directory

os.chdir(sys.argv[1])  # what lies above may be closed to others
os.setgroups([]); os.setgid(65534); os.setuid(65534)
try:
    take_directory(Path("."))
except UserError as error:
    print(error.message)
"""


@pytest.fixture
def logs(tmp_path: Path) -> Path:
    if os.geteuid() != 0:
        pytest.fail("this test makes another user's directory: run it as root")
    folder = tmp_path / "logs"
    folder.mkdir()
    os.chown(folder, NOBODY, NOBODY)
    return folder


def said_to_nobody(folder: Path) -> str:
    command = [sys.executable, "-c", AS_NOBODY, str(folder)]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=HANGS_S, check=True).stdout


def test_the_owner_of_a_directory_records_after_root_did(logs: Path) -> None:
    os.close(take_directory(logs))
    assert said_to_nobody(logs) == ""


def test_a_lock_of_another_user_is_named(logs: Path) -> None:
    (logs / LOCK).touch(0o600)
    assert said_to_nobody(logs) == (
        f"session.directory .: {LOCK}: Permission denied; a recording of another user left it; "
        "remove it when that recording has ended\n"
    )


@pytest.mark.parametrize("symbolic", [True, False])
def test_no_other_file_changes_its_owner(logs: Path, tmp_path: Path, symbolic: bool) -> None:
    other = tmp_path / "roots"
    other.touch(0o600)
    if symbolic:
        (logs / LOCK).symlink_to(other)
        with pytest.raises(UserError):
            take_directory(logs)
    else:
        (logs / LOCK).hardlink_to(other)
        os.close(take_directory(logs))
    assert other.stat().st_uid == 0
