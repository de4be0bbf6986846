"""``swath recover`` by hand: what it saves, what it says, what it leaves alone, and its exit codes."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import pytest

from tests.daemon.commands import swath
from tests.daemon.log_check import official_counts
from tests.daemon.test_log import INFO, write_part

WHOLE, CUT = f"{INFO.session_id}_0.mcap", f"{INFO.session_id}_1.mcap"


@pytest.fixture
def logs(tmp_path: Path) -> Path:
    folder = tmp_path / "logs"
    folder.mkdir()
    write_part(folder / WHOLE)
    write_part(folder / CUT, part=1, finish=False)
    return folder


def digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def test_a_whole_log_needs_nothing(logs: Path) -> None:
    result = swath("recover", str(logs / WHOLE))
    assert (result.returncode, result.stderr) == (0, "")
    assert "whole" in result.stdout
    assert not list(logs.glob("*.recovered.mcap"))


def test_a_directory_is_repaired_and_the_originals_stay(logs: Path) -> None:
    before = {path.name: digest(path) for path in logs.iterdir()}
    result = swath("recover", "--json", "--background", str(logs))
    assert result.returncode == 4, result.stderr
    whole, cut = json.loads(result.stdout)["logs"]
    assert (whole["whole"], whole["recovered"]) == (True, None)
    assert cut["whole"] is False
    copy = Path(cut["recovered"])
    assert copy == logs / CUT.replace(".mcap", ".recovered.mcap")
    assert official_counts(copy) == cut["messages"]
    assert cut["messages"]["/scanner/left/raw"] == 1200
    assert {name: digest(logs / name) for name in before} == before


def test_a_flipped_bit_costs_its_chunk_only(logs: Path) -> None:
    data = bytearray((logs / WHOLE).read_bytes())
    data[len(data) // 2] ^= 1
    (logs / WHOLE).write_bytes(data)
    result = swath("recover", str(logs / WHOLE))
    assert result.returncode == 4
    assert "at byte" in result.stdout
    saved = official_counts(logs / WHOLE.replace(".mcap", ".recovered.mcap"))
    assert 0 < saved["/scanner/left/raw"] < 1200
    assert saved["/gnss/rover/raw"] == 60


def test_output_folder(logs: Path, tmp_path: Path) -> None:
    other = tmp_path / "other"
    other.mkdir()
    assert swath("recover", "--output", str(other), str(logs / CUT)).returncode == 4
    assert [path.name for path in other.iterdir()] == [CUT.replace(".mcap", ".recovered.mcap")]
    assert sorted(path.name for path in logs.iterdir()) == [WHOLE, CUT]


def test_what_cannot_be_done_is_one_line(logs: Path, tmp_path: Path) -> None:
    (tmp_path / "text.mcap").write_text("no log")
    (tmp_path / "empty").mkdir()
    cases = [
        ([str(tmp_path / "nothing.mcap")], "no such file"),
        ([str(tmp_path / "empty")], "no logs"),
        ([str(tmp_path / "text.mcap")], "text.mcap"),
        (["--keep-free-mb", "1e9", str(logs / CUT)], "needed to recover"),
        (["--output", str(tmp_path / "absent"), str(logs / CUT)], "No such file"),
    ]
    for arguments, words in cases:
        result = swath("recover", *arguments)
        assert result.returncode == 3, (arguments, result)
        assert words in result.stderr
        assert result.stderr.count("\n") == 1
    assert not list(logs.glob("*.recovered.mcap*"))


def test_a_second_repair_does_not_overwrite_the_first(logs: Path) -> None:
    assert swath("recover", str(logs / CUT)).returncode == 4
    copy = logs / CUT.replace(".mcap", ".recovered.mcap")
    before = digest(copy)
    result = swath("recover", str(logs / CUT))
    assert result.returncode == 3
    assert "is there already" in result.stderr
    assert digest(copy) == before
