"""Tests that a log directory below a forbidden folder is reported by ``swath check`` and ``swath doctor``."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from swath.daemon.log.directory import nearest_there
from tests.builders import ROOT
from tests.daemon.rig import HANGS_S, session_table

# Everything is loaded before root becomes a user who may not read the program's folder.
AS_NOBODY = """
import json, os, sys
from pathlib import Path
from swath.daemon.devices.check import check_directory
from swath.daemon.config import parse_config
from swath.daemon.doctor import Tree, disk, examine
from swath.daemon.doctor.devices import User

config = parse_config(sys.argv[1], Path("/etc/swath/swath.toml"))
if os.geteuid() == 0:
    os.setgroups([])
    os.setegid(65534)
    os.seteuid(65534)
directory = Path(config.session.directory)
found = [one for one in examine(config, write=False) if one.check in ("file system", "log directory", "disk space")]
found += disk.writable(Tree(), directory, User("another", 0, frozenset()))
print(json.dumps({
    "check": check_directory(directory, 1.0).plain(),
    "doctor": [(one.check, one.verdict, one.text, one.mend) for one in found],
}))
"""


@pytest.fixture
def closed() -> Iterator[Path]:
    """Return a folder that only root may enter, with a log directory, in a place that others can reach."""
    with tempfile.TemporaryDirectory(dir="/tmp") as folder:
        Path(folder).chmod(0o755)
        closed = Path(folder) / "closed"
        (closed / "logs").mkdir(parents=True)
        closed.chmod(0)
        try:
            yield closed
        finally:
            closed.chmod(0o700)


@pytest.mark.parametrize("directory", ["logs", "logs/absent", "absent"])
def test_check_and_doctor_name_the_inaccessible_folder(closed: Path, directory: str) -> None:
    words = [sys.executable, "-c", AS_NOBODY, session_table(closed / directory)]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, timeout=HANGS_S, check=False)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    (problem,) = found["check"]["problems"]
    uid = os.geteuid() or 65534
    assert problem.startswith(
        f"session.directory {closed / directory}: user {uid} may not enter {closed}; run this as root"
    )
    (check, verdict, text, mend), of_another = found["doctor"]
    assert (check, verdict) == ("log directory", "wrong")
    assert text.endswith(f" may not enter {closed}, which holds {closed / directory}")
    assert mend == f"sudo chmod o+x {closed}  # or set another session.directory"
    assert of_another[1:] == [
        "note",
        f"not checked: this user may not enter {closed}, which holds {closed / directory}; another may",
        "sudo swath doctor",
    ]


def test_the_nearest_existing_folder_is_found(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    assert nearest_there(tmp_path) == (tmp_path, True)
    assert nearest_there(tmp_path / "a/b") == (tmp_path, True)
    assert nearest_there(tmp_path / "file/b") == (tmp_path / "file", True)
