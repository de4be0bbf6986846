"""Tests ``swath recover`` by hand: what it saves, prints and leaves alone, and its exit codes."""

from __future__ import annotations

import asyncio
import hashlib
import json
import os
import signal
import subprocess
import sys
import threading
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest

from swath.daemon.log.claim import claim
from swath.daemon.log.events import Event, Events, Severity
from swath.daemon.log.format import LogError
from swath.daemon.log.recover import recover
from swath.daemon.recorder import repair
from tests.daemon.builders import INFO, write_part
from tests.daemon.commands import ROOT, swath
from tests.daemon.log_check import official_counts
from tests.daemon.rig import HANGS_S, wait_until

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


def test_a_complete_log_needs_no_recovery(logs: Path) -> None:
    result = swath("recover", str(logs / WHOLE))
    assert (result.returncode, result.stderr) == (0, "")
    assert "intact" in result.stdout
    assert not list(logs.glob("*.recovered.mcap"))


def test_a_directory_is_recovered_and_the_originals_are_kept(logs: Path) -> None:
    before = {path.name: digest(path) for path in logs.iterdir()}
    result = swath("recover", "--json", "--background", str(logs))
    assert result.returncode == 0, "only the index was missing"
    whole, cut = json.loads(result.stdout)["logs"]
    assert (whole["whole"], whole["recovered"], whole["index_only"]) == (True, None, False)
    assert (cut["whole"], cut["index_only"]) == (False, True)
    copy = Path(cut["recovered"])
    assert copy == logs / CUT.replace(".mcap", ".recovered.mcap")
    assert official_counts(copy) == cut["messages"]
    assert cut["messages"]["/scanner/left/raw"] == 1200
    assert {name: digest(logs / name) for name in before} == before


def test_a_log_without_its_index_is_read_and_recovered_without_a_fault(logs: Path) -> None:
    (logs / WHOLE).unlink()
    told = swath("info", str(logs))
    assert told.returncode == 1, "part 0 is missing"
    assert f"{CUT}: only its index is missing, as after a kill" in told.stdout
    assert "damage: " not in told.stdout
    result = swath("recover", str(logs))
    assert result.returncode == 0
    assert f"{CUT}: only its index was missing; " in result.stdout
    cut = logs / CUT.replace("_1", "_2")
    write_part(cut, part=2, finish=False)
    cut.write_bytes(cut.read_bytes()[:-5])
    assert swath("recover", str(cut)).returncode == 4, "a cut chunk is damage"


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


def test_recovered_copies_are_written_to_the_output_folder(logs: Path, tmp_path: Path) -> None:
    other = tmp_path / "other"
    other.mkdir()
    assert swath("recover", "--output", str(other), str(logs / CUT)).returncode == 0
    assert [path.name for path in other.iterdir()] == [CUT.replace(".mcap", ".recovered.mcap")]
    assert sorted(path.name for path in logs.iterdir()) == [WHOLE, CUT]


def test_impossible_requests_are_refused_in_one_line(logs: Path, tmp_path: Path) -> None:
    (tmp_path / "text.mcap").write_text("no log")
    (tmp_path / "empty").mkdir()
    cases = [
        ([str(tmp_path / "nothing.mcap")], "no such file"),
        ([str(tmp_path / "empty")], "no logs"),
        ([str(tmp_path / "text.mcap")], "text.mcap"),
        (["--keep-free-mb", "1e9", str(logs / CUT)], "needed to recover"),
        (["--output", str(tmp_path / "absent"), str(logs / CUT)], f"{tmp_path / 'absent'}: No such file"),
    ]
    for arguments, words in cases:
        result = swath("recover", *arguments)
        assert result.returncode == 3, (arguments, result)
        assert words in result.stderr
        assert result.stderr.count("\n") == 1
    assert not list(logs.glob("*.recovered.mcap*"))


def test_a_second_repair_does_not_overwrite_the_first(logs: Path) -> None:
    assert swath("recover", str(logs / CUT)).returncode == 0
    copy = logs / CUT.replace(".mcap", ".recovered.mcap")
    before = digest(copy)
    result = swath("recover", str(logs / CUT))
    assert result.returncode == 3
    assert "already exists" in result.stderr
    assert digest(copy) == before


LARGE = f"{INFO.session_id}_2.mcap"


@pytest.fixture
def recovering(logs: Path) -> Iterator[subprocess.Popen[str]]:
    """Start a process and stop it in the middle of a recovery."""
    write_part(logs / LARGE, part=2, blocks=1200, finish=False)
    command = [sys.executable, "-m", "swath.daemon.cli.main", "recover", str(logs / LARGE)]
    process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    temporary = unfinished_copy(logs)
    wait_until(lambda: temporary.exists() and temporary.stat().st_size > 1 << 20, "a part of the copy")
    process.send_signal(signal.SIGSTOP)
    assert temporary.exists(), "it was stopped too late to prove anything"
    yield process
    process.kill()
    process.communicate()


def unfinished_copy(logs: Path) -> Path:
    return logs / LARGE.replace(".mcap", ".recovered.mcap.part")


def test_a_log_under_recovery_by_another_process_is_skipped(logs: Path, recovering: subprocess.Popen[str]) -> None:
    result = swath("recover", str(logs / LARGE))
    assert (result.returncode, result.stdout) == (3, "")
    assert result.stderr == f"swath: {logs / LARGE}: is being recovered by another process\n"
    recovering.send_signal(signal.SIGCONT)
    _, stderr = recovering.communicate(timeout=HANGS_S)
    assert (recovering.returncode, stderr) == (0, "")
    assert official_counts(logs / LARGE.replace(".mcap", ".recovered.mcap"))["/scanner/left/raw"] == 1200 * 20
    assert not unfinished_copy(logs).exists()


def test_remains_of_a_killed_recovery_are_replaced(logs: Path, recovering: subprocess.Popen[str]) -> None:
    recovering.kill()
    recovering.wait()
    assert unfinished_copy(logs).exists()
    assert swath("recover", str(logs / LARGE)).returncode == 0
    assert official_counts(logs / LARGE.replace(".mcap", ".recovered.mcap"))["/scanner/left/raw"] == 1200 * 20
    assert not unfinished_copy(logs).exists()


def test_of_many_simultaneous_recoveries_only_one_runs(logs: Path) -> None:
    """A claim belongs to an open file, so threads can stand for processes; a left-behind copy is in everybody's way."""
    copy = logs / CUT.replace(".mcap", ".recovered.mcap")
    for _ in range(20):
        copy.with_name(copy.name + ".part").write_bytes(b"left behind")
        begin, became = threading.Barrier(4), Counter[str]()

        def one(begin: threading.Barrier = begin, became: Counter[str] = became) -> None:
            begin.wait()
            try:
                recover(logs / CUT)
                became["recovered"] += 1
            except LogError as error:
                became["left" if "by another process" in str(error) or "already exists" in str(error) else "?"] += 1

        threads = [threading.Thread(target=one) for _ in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert became == {"recovered": 1, "left": 3}
        assert official_counts(copy)["/scanner/left/raw"] == 1200
        copy.unlink()
        assert sorted(path.name for path in logs.iterdir()) == [WHOLE, CUT]


@pytest.mark.parametrize("mode", [0o640, 0o600, 0o664])
def test_the_copy_has_the_owner_and_permissions_of_the_log(logs: Path, mode: int) -> None:
    """This is the case after `sudo swath recover`; only root can change owners, so other users keep their own."""
    owner = (4711, 4712) if os.geteuid() == 0 else (os.geteuid(), os.getegid())
    os.chown(logs / CUT, *owner)
    (logs / CUT).chmod(mode)
    assert swath("recover", str(logs / CUT)).returncode == 0
    copy = (logs / CUT.replace(".mcap", ".recovered.mcap")).stat()
    assert (copy.st_uid, copy.st_gid, copy.st_mode & 0o777) == (*owner, mode)


class Said(Events):
    """Events that keep the codes reported."""

    def __init__(self) -> None:
        self.codes: list[str] = []

    def post(self, severity: Severity, source: str, code: str, text: str) -> Event:
        """Record an event."""
        self.codes.append(code)
        return Event(0, severity, source, code, text)


@pytest.mark.slow
async def test_the_service_waits_for_a_manual_recovery(logs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(repair, "_LOOK_AGAIN_S", 0.05)
    temporary = logs / CUT.replace(".mcap", ".recovered.mcap.part")
    events = Said()
    with temporary.open("wb") as by_hand:
        claim(by_hand.fileno())
        task = asyncio.create_task(repair.repair_left_open(logs, 0, lambda path: False, events))
        await asyncio.sleep(1.0)
        assert events.codes == ["repair_waits"]
        assert not task.done()
    await asyncio.wait_for(task, HANGS_S)  # the wait ends, and the log is repaired as if no repair had begun
    assert events.codes == ["repair_waits", "log_repaired"]
    assert official_counts(logs / CUT.replace(".mcap", ".recovered.mcap"))["/scanner/left/raw"] == 1200
