"""Tests ``swath offload`` of real logs, checked by coreutils: interruptions, falsified copies, full disks."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from swath.daemon.cli.offload import _print as show
from swath.daemon.exchange.offload import BLOCK_BYTES, ChecksumList, OffloadReport, offload
from tests.builders import ROOT
from tests.daemon.builders import INFO, write_part
from tests.daemon.commands import swath
from tests.daemon.rig import HANGS_S, Recorder, disk_of, session_table, wait_until

BIG_BYTES = 24 * BLOCK_BYTES + 12345


@pytest.fixture
def logs(tmp_path: Path) -> Path:
    folder = tmp_path / "logs"
    folder.mkdir()
    return folder


@pytest.fixture
def disk(tmp_path: Path) -> Path:
    folder = tmp_path / "disk"
    folder.mkdir()
    return folder


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def state(folder: Path) -> dict[str, tuple[int, str]]:
    """Return the content and modification time of every file."""
    files = [path for path in folder.iterdir() if path.is_file()]
    return {path.name: (path.stat().st_mtime_ns, hashlib.sha256(path.read_bytes()).hexdigest()) for path in files}


def coreutils_agree(folder: Path) -> int:
    """Return how many files sha256sum(1) finds correct; it is strict about the list's form."""
    command = ["sha256sum", "--check", "--strict", "SHA256SUMS"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout.count(": OK\n")


def offload_json(logs: Path, disk: Path, *options: str) -> tuple[int, dict[str, Any], str]:
    run = swath("offload", str(logs), str(disk), "--same-disk", "--json", *options)
    return run.returncode, json.loads(run.stdout), run.stderr


def run_all(logs: Path, disk: Path, **options: Any) -> OffloadReport:
    *_, report = offload(logs, disk, same_disk=True, **options)
    return report


def big_log(logs: Path) -> Path:
    """Write a log that takes time to copy; its content does not matter."""
    path = logs / "big_0.mcap"
    block = os.urandom(BLOCK_BYTES)
    with path.open("wb") as file:
        left = BIG_BYTES
        while left:
            left -= file.write(block[:left])
    return path


@pytest.mark.slow
def test_finished_parts_are_copied_and_the_growing_one_is_not(tmp_path: Path, logs: Path, disk: Path) -> None:
    with Recorder(tmp_path, session_table(logs)) as recorder:
        for part in range(2):
            recorder.process.send_signal(signal.SIGHUP)
            wait_until(lambda part=part: len(list(logs.glob("*.mcap"))) == part + 2, "part")  # type: ignore[misc]
        time.sleep(0.5)
        finished = sorted(logs.glob("*.mcap"))[:2]
        before = state(logs)
        run = swath("offload", str(recorder.config), str(disk), "--same-disk")
        assert run.returncode == 0, run.stderr
        assert {name: before[name] for name in before if not name.endswith("_2.mcap")} == {
            name: value for name, value in state(logs).items() if not name.endswith("_2.mcap")
        }
        assert recorder.stop() == 0
    growing = sorted(logs.glob("*.mcap"))[2]
    assert names(disk) == sorted(["SHA256SUMS", *(path.name for path in finished)])
    assert all((disk / path.name).read_bytes() == path.read_bytes() for path in finished)
    assert all((disk / path.name).stat().st_mtime_ns == path.stat().st_mtime_ns for path in finished)
    assert coreutils_agree(disk) == 2
    assert f"{growing.name}: is being recorded; not copied\n" in run.stdout
    assert [f"  rm {path}" in run.stdout for path in [*finished, growing]] == [True, True, False]
    code, report, _ = offload_json(logs, disk)
    assert code == 0
    assert [one["name"] for one in report["copied"]] == [growing.name]
    assert report["copied"][0]["sha256"] == hashlib.sha256(growing.read_bytes()).hexdigest()
    assert report["there"] == [path.name for path in finished]
    assert report["may_be_deleted"] == [str(path) for path in [*finished, growing]]
    assert coreutils_agree(disk) == 3
    assert swath("info", str(disk)).returncode == 0


def test_a_killed_run_is_resumed(logs: Path, disk: Path) -> None:
    path = big_log(logs)
    partial = disk / (path.name + ".partial")
    command = [sys.executable, "-m", "swath.daemon.cli.main", "offload", "--same-disk", str(logs), str(disk)]
    process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL)
    wait_until(lambda: partial.exists() and partial.stat().st_size > BLOCK_BYTES, "a part of the copy")
    process.kill()
    process.wait()
    had = partial.stat().st_size
    assert names(disk) == [partial.name], "it was killed too late to prove anything"
    code, report, _ = offload_json(logs, disk)
    assert code == 0
    assert report["copied"][0]["resumed_bytes"] == had > BLOCK_BYTES
    assert names(disk) == ["SHA256SUMS", path.name]
    assert coreutils_agree(disk) == 1


def test_ctrl_c_ends_the_run_in_one_line_and_leaves_the_partial_copy(logs: Path, disk: Path) -> None:
    path = big_log(logs)
    partial = disk / (path.name + ".partial")
    command = [sys.executable, "-m", "swath.daemon.cli.main", "offload", "--same-disk", str(logs), str(disk)]
    process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    wait_until(lambda: partial.exists() and partial.stat().st_size > BLOCK_BYTES, "a part of the copy")
    process.send_signal(signal.SIGINT)
    _, stderr = process.communicate(timeout=HANGS_S)
    assert (process.returncode, stderr.splitlines()) == (
        130,
        [f"swath: interrupted; nothing written; {partial} stays, and the same command continues from there"],
    )
    assert names(disk) == [partial.name]


def test_a_corrupt_partial_copy_is_copied_again(logs: Path, disk: Path) -> None:
    """A power cut of the disk leaves a partial copy of sufficient length with wrong content."""
    path = big_log(logs)
    partial = disk / (path.name + ".partial")
    partial.write_bytes(bytes(10 * BLOCK_BYTES + 1))
    report = run_all(logs, disk)
    assert [(one.name, one.resumed_bytes) for one in report.copied] == [(path.name, 0)]
    assert (disk / path.name).read_bytes() == path.read_bytes()
    assert not partial.exists()


def test_a_partial_copy_longer_than_the_log_is_truncated(logs: Path, disk: Path) -> None:
    path = logs / "flight_0.mcap"
    write_part(path)
    (disk / (path.name + ".partial")).write_bytes(path.read_bytes() + b"more")
    assert run_all(logs, disk).copied[0].resumed_bytes == path.stat().st_size
    assert coreutils_agree(disk) == 1


def test_a_disk_that_returns_other_data_is_reported(logs: Path, disk: Path) -> None:
    """A bit of the copy changes between writing and reading back: no copy, nothing to delete, nothing in the list."""
    path = logs / "flight_0.mcap"
    write_part(path)
    size = path.stat().st_size

    def change(name: str, done: int, total: int) -> None:
        if done == size:
            with (disk / f"{name}.partial").open("r+b") as file:
                file.seek(size // 2)
                byte = file.read(1)[0]
                file.seek(size // 2)
                file.write(bytes([byte ^ 4]))

    report = run_all(logs, disk, progress=change)
    assert (report.copied, report.deletable) == ([], [])
    assert "the data read back differ" in report.differ[0]
    assert names(disk) == []


def test_an_existing_file_with_other_content_is_not_overwritten(logs: Path, disk: Path) -> None:
    path, other = logs / "flight_0.mcap", logs / "flight_1.mcap"
    write_part(path)
    write_part(other, part=1)
    (disk / path.name).write_bytes(b"something of somebody's")
    code, report, stderr = offload_json(logs, disk)
    assert code == 4
    assert stderr == f"swath: {disk / path.name}: already exists and differs from {path}; it was not overwritten\n"
    assert (disk / path.name).read_bytes() == b"something of somebody's"
    assert [one["name"] for one in report["copied"]] == [other.name]
    assert report["may_be_deleted"] == [str(other)]


def test_a_copy_that_was_made_otherwise_is_compared_and_listed(logs: Path, disk: Path) -> None:
    path = logs / "flight_0.mcap"
    write_part(path)
    shutil.copy(path, disk)
    assert offload_json(logs, disk)[1]["there"] == [path.name]
    assert coreutils_agree(disk) == 1


@pytest.mark.slow
def test_verify_reads_again_and_finds_changes(logs: Path, disk: Path) -> None:
    path = logs / "flight_0.mcap"
    write_part(path)
    run_all(logs, disk)
    copied = (disk / path.name).stat()
    data = bytearray((disk / path.name).read_bytes())
    data[1000] ^= 1
    (disk / path.name).write_bytes(data)
    os.utime(disk / path.name, ns=(copied.st_atime_ns, copied.st_mtime_ns))  # a failing disk keeps the file's time
    assert offload_json(logs, disk)[0] == 0
    code, report, _ = offload_json(logs, disk, "--verify")
    assert (code, report["may_be_deleted"]) == (4, [])


def test_another_log_of_the_same_name_and_size_is_copied(logs: Path, disk: Path, tmp_path: Path) -> None:
    """A repeated import has the name of the previous one and may have its length."""
    path = logs / "flight_0.mcap"
    write_part(path)
    run_all(logs, disk)
    others = tmp_path / "others"
    others.mkdir()
    data = bytearray(path.read_bytes())
    data[1000] ^= 1
    other = others / path.name
    other.write_bytes(data)
    later_ns = path.stat().st_mtime_ns + 60_000_000_000
    os.utime(other, ns=(later_ns, later_ns))
    code, report, stderr = offload_json(others, disk)
    assert (code, report["may_be_deleted"], report["there"]) == (4, [], [])
    assert "already exists and differs from" in stderr
    os.utime(path, ns=(later_ns, later_ns))  # the log's own time was changed, so both are compared, and are equal
    assert offload_json(logs, disk)[1]["may_be_deleted"] == [str(path)]


def test_a_log_left_open_by_a_crash_is_copied_and_reported(logs: Path, disk: Path) -> None:
    path = logs / f"{INFO.session_id}_0.mcap"
    write_part(path, finish=False)
    run = swath("offload", str(logs), str(disk), "--same-disk")
    assert run.returncode == 0
    assert f"{path.name}: was left open by a crash and is copied unchanged" in run.stdout
    assert (disk / path.name).read_bytes() == path.read_bytes()


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """Return a separate file system of 8 MB."""
    with disk_of(tmp_path / "small", 8) as folder:
        yield folder


def test_after_a_full_disk_the_same_command_continues(logs: Path, small_disk: Path) -> None:
    for part in range(4):
        write_part(logs / f"flight_{part}.mcap", part=part, blocks=100)
    filler = small_disk / "filler"
    filler.write_bytes(bytes(2 << 20))
    code, report, stderr = offload_json(logs, small_disk)
    assert code == 3
    assert [one["name"] for one in report["copied"]] == ["flight_0.mcap", "flight_1.mcap"]
    assert stderr.startswith(f"swath: {small_disk}: no space left: flight_2.mcap needs ")
    assert stderr.count("\n") == 1
    assert coreutils_agree(small_disk) == 2
    (logs / "flight_3.mcap").unlink()
    filler.unlink()
    code, report, _ = offload_json(logs, small_disk)
    assert (code, report["there"]) == (0, ["flight_0.mcap", "flight_1.mcap"])
    assert coreutils_agree(small_disk) == 3


def test_a_disk_that_fills_up_during_writing_is_reported(logs: Path, small_disk: Path) -> None:
    write_part(logs / "flight_0.mcap", blocks=240)

    def fill(name: str, done: int, total: int) -> None:
        if done == BLOCK_BYTES:
            (small_disk / "filler").write_bytes(bytes((8 << 20) - BLOCK_BYTES - 65536))

    report = run_all(logs, small_disk, progress=fill)
    assert "no space left: flight_0.mcap needs" in report.stopped
    assert "flight_0.mcap.partial" in names(small_disk)
    (small_disk / "filler").unlink()
    report = run_all(logs, small_disk)
    assert report.copied[0].resumed_bytes >= BLOCK_BYTES
    assert coreutils_agree(small_disk) == 1


def test_a_source_that_is_neither_directory_nor_configuration_is_refused_in_one_line(
    disk: Path, tmp_path: Path
) -> None:
    text = tmp_path / "text.txt"
    text.write_text("line 4: start\n")
    for where, said in ((tmp_path / "nowhere", "no such file or directory"), (text, "not TOML: ")):
        done = swath("offload", str(where), str(disk))
        assert (done.returncode, done.stdout) == (2, "")
        assert done.stderr.startswith(f"swath: {where}: {said}")
        assert done.stderr.endswith("; give the log directory or a configuration file\n")
        assert done.stderr.count("\n") == 1


def test_an_impossible_destination_is_refused_in_one_line(logs: Path, disk: Path, tmp_path: Path) -> None:
    write_part(logs / "flight_0.mcap")
    for where, to, code, said in (
        (logs, tmp_path / "not mounted", 3, "no such directory; check that the disk is mounted"),
        (logs, logs, 2, "is the log directory itself"),
        (disk, tmp_path, 3, "contains no logs (*.mcap)"),
    ):
        run = swath("offload", str(where), str(to), "--same-disk")
        assert (run.returncode, run.stderr.count("\n")) == (code, 1)
        assert said in run.stderr


def test_an_unreadable_list_of_checksums_is_refused_in_one_line(logs: Path, disk: Path) -> None:
    write_part(logs / "flight_0.mcap")
    (disk / "SHA256SUMS").mkdir()
    run = swath("offload", "--same-disk", str(logs), str(disk))
    assert (run.returncode, run.stderr.count("\n")) == (3, 1)
    assert run.stderr.startswith(f"swath: {disk}/SHA256SUMS: Is a directory; choose another folder")
    assert names(disk) == ["SHA256SUMS"]


def test_the_mount_point_of_an_unmounted_disk_is_refused(logs: Path, small_disk: Path, tmp_path: Path) -> None:
    write_part(logs / "flight_0.mcap")
    usb = tmp_path / "usb"
    usb.mkdir()
    run = swath("offload", str(logs), str(usb))
    assert (run.returncode, run.stdout) == (3, "")
    assert run.stderr == (
        f"swath: {usb}: is on the same disk as {logs}; check that the other disk is mounted, or use --same-disk\n"
    )
    assert names(usb) == []
    run = swath("offload", str(logs), str(small_disk))
    assert (run.returncode, names(small_disk)) == (0, ["SHA256SUMS", "flight_0.mcap"])


def test_a_log_moved_away_during_the_run_does_not_affect_the_others(logs: Path, disk: Path) -> None:
    for part in range(2):
        write_part(logs / f"flight_{part}.mcap", part=part)
    run_all(logs, disk)

    def move(name: str, done: int, total: int) -> None:
        if done == total and name == "flight_0.mcap":
            (logs / name).rename(logs / "moved")

    report = run_all(logs, disk, verify=True, progress=move)
    assert report.failed == [f"{logs / 'flight_0.mcap'}: No such file or directory"]
    assert report.deletable == [logs / "flight_1.mcap"]


def test_a_log_moved_away_before_deletion_is_not_listed(
    logs: Path, disk: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for part in range(2):
        write_part(logs / f"flight_{part}.mcap", part=part)
    report = run_all(logs, disk)
    (logs / "flight_0.mcap").unlink()
    show(report, verify=False)
    assert [line for line in capsys.readouterr().out.splitlines() if "rm " in line] == [f"  rm {logs}/flight_1.mcap"]


def test_a_read_only_disk_is_reported_in_one_line(logs: Path, small_disk: Path) -> None:
    for part in range(2):
        write_part(logs / f"flight_{part}.mcap", part=part)
    subprocess.run(["mount", "-o", "remount,ro", str(small_disk)], check=True)
    run = swath("offload", str(logs), str(small_disk))
    assert run.returncode == 3
    assert (
        run.stderr
        == f"swath: {small_disk}: cannot be written; check its permissions and that it is not mounted read-only\n"
    )


def test_one_run_at_a_time(logs: Path, disk: Path) -> None:
    write_part(logs / "flight_0.mcap")
    first = offload(logs, disk, same_disk=True)
    next(first)
    run = swath("offload", str(logs), str(disk), "--same-disk")
    assert (run.returncode, run.stderr) == (
        3,
        f"swath: {disk}: another swath offload is running there; wait until it ends\n",
    )
    first.close()
    assert swath("offload", str(logs), str(disk), "--same-disk").returncode == 0


def test_the_list_keeps_other_lines_and_escapes_names_as_coreutils_do(disk: Path) -> None:
    odd = ["with space.mcap", "back\\slash.mcap", "new\nline.mcap", "return\r.mcap"]
    for name in odd:
        (disk / name).write_bytes(name.encode())
    other = subprocess.run(["sha256sum", *odd], cwd=disk, capture_output=True, text=True, check=True).stdout
    (disk / "SHA256SUMS").write_text("# of another program\n" + other)
    sums = ChecksumList(disk)
    digests = {name: hashlib.sha256(name.encode()).hexdigest() for name in odd}
    assert sums.sums == digests
    for name in odd:
        sums.add(name, digests[name])
    assert (disk / "SHA256SUMS").read_text() == "# of another program\n" + other
