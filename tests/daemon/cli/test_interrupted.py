"""Tests that Ctrl-C and a full disk end every command in one line and leave nothing unfinished."""

from __future__ import annotations

import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from swath.daemon import written
from swath.daemon.cli.main import INTERRUPTED, run_app
from swath.daemon.cli.progress import COMPILING
from swath.daemon.errors import ExitCode
from swath.daemon.processing.files import write_whole
from swath.daemon.system import ended_in_order, held_interrupts
from swath.daemon.written import make_folder, note_written, remove_empty_folders, written_words
from tests.daemon.builders import SREP
from tests.daemon.commands import swath
from tests.daemon.one_line import Flown, fly
from tests.daemon.rig import HANGS_S, disk_of, free_udp_port, session_table, wait_until

pytestmark = pytest.mark.xdist_group("kernels")
ROOT = Path(__file__).resolve().parents[3]
NOTHING = "swath: interrupted; nothing written\n"


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Flown:
    """Return a flight of one line."""
    return fly(tmp_path_factory.mktemp("flown"))


@pytest.fixture(scope="module")
def products(flown: Flown, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of the flight's points."""
    folder = tmp_path_factory.mktemp("products") / "out"
    assert run_app(flown.arguments(folder)) == 0
    return folder


@pytest.fixture
def place(tmp_path: Path) -> Iterator[Path]:
    """Return a folder that has to be empty in the end, besides an empty one for temporary files."""
    (tmp_path / "temporary").mkdir()
    (tmp_path / "place").mkdir()
    yield tmp_path / "place"
    assert list((tmp_path / "temporary").iterdir()) == []


def interrupted(at: str, *arguments: object, place: Path) -> tuple[int, str]:
    """Run a command that gets a SIGINT when it reaches a phase, and return its exit code and its stderr."""
    temporary = str(place.parent / "temporary")
    done = swath(*map(str, arguments), INTERRUPTED_AT=at, TMPDIR=temporary)
    return done.returncode, without_compiling(done.stderr)


def without_compiling(said: str) -> str:
    """Leave out lines about loops that this installation has not compiled yet."""
    return "".join(line for line in said.splitlines(keepends=True) if not line.startswith("compiling "))


@pytest.mark.slow
@pytest.mark.parametrize("phase", ["clocks", "points", "trajectory and sidecar"])
def test_georef_leaves_nothing_in_any_phase(flown: Flown, place: Path, phase: str) -> None:
    arguments = flown.arguments(place / "new/out")
    assert interrupted(phase, *arguments, "--workers", "1", place=place) == (INTERRUPTED, NOTHING)
    assert list(place.iterdir()) == []


@pytest.mark.slow
def test_georef_over_earlier_products_leaves_them_whole(flown: Flown, products: Path, place: Path) -> None:
    copy = Path(shutil.copytree(products, place / "out"))
    before = {path.name: path.read_bytes() for path in copy.iterdir()}
    arguments = [*flown.arguments(copy), "--overwrite", "--workers", "1"]
    assert interrupted("points", *arguments, place=place) == (INTERRUPTED, NOTHING)
    assert {path.name: path.read_bytes() for path in copy.iterdir()} == before


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "phase"),
    [
        ("strips", "returns"),
        ("strips --adjust", "returns"),
        ("calibrate", "returns"),
        ("validate", "returns"),
        ("trajectory", "IMU and GNSS"),
        ("view", "reading points"),
        ("view", "pictures"),
        ("plan-calibration", "sigmas"),
        ("sim plan", "drawing"),
        ("sim fly", "flying"),
        ("export", "exporting"),
        ("import", "reading captures"),
    ],
)
def test_every_command_leaves_nothing(
    command: str, phase: str, flown: Flown, products: Path, place: Path, tmp_path: Path
) -> None:
    true, out, plan = flown.folder / "left.true.toml", place / "out", flown.folder.parent / "line.toml"
    given = ["--trajectory", flown.sbet, "--trajectory-datum", "same", "--workers", "1"]
    arguments: dict[str, list[object]] = {
        "strips": [flown.log, "-o", out, *given],
        "strips --adjust": [out, flown.log, "--calibration", true, *given],
        "calibrate": [flown.log, "-o", place / "left.toml", *given],
        "validate": [true, flown.log, "-o", out, *given],
        "trajectory": [flown.log, "-o", out],
        "view": [products, "-o", out],
        "plan-calibration": ["small", "-o", out / "plan.png"],
        "sim plan": ["small", "-o", out / "plan.png"],
        "sim fly": [plan, "-o", out],
        "export": [flown.log, out],
        "import": [],
    }
    if command == "import":
        assert swath("export", str(flown.log), str(tmp_path / "exported")).returncode == 0
        arguments["import"] = [flown.folder / "swath.toml", tmp_path / "exported" / flown.name, "-o", out]
    assert interrupted(phase, *command.split(), *arguments[command], place=place) == (INTERRUPTED, NOTHING)
    assert list(place.iterdir()) == []


@pytest.mark.parametrize("phase", ["checking", "repairing"])
def test_recover_leaves_nothing_but_the_log(flown: Flown, place: Path, phase: str) -> None:
    log = flown.copy_of_log(place)
    os.truncate(log, log.stat().st_size // 2)
    assert interrupted(phase, "recover", log, place=place) == (INTERRUPTED, NOTHING)
    assert list(place.iterdir()) == [log]
    assert log.stat().st_size == flown.log.stat().st_size // 2


@pytest.mark.slow
def test_replay_says_what_it_has_played(flown: Flown, tmp_path: Path) -> None:
    port = free_udp_port()
    wire = tmp_path / "wire.toml"
    wire.write_text(session_table(tmp_path) + SREP.format(port=port))
    command = [sys.executable, "-m", "swath.daemon.cli.main", "replay", "--wait", "0", "--wire", str(wire)]
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as reader,
        subprocess.Popen([*command, str(flown.log)], cwd=ROOT, stderr=subprocess.PIPE, text=True) as process,
    ):
        reader.bind(("127.0.0.1", port))
        reader.settimeout(HANGS_S)
        for _ in range(20):
            reader.recv(65536)
        process.send_signal(signal.SIGINT)
        assert process.stderr is not None
        said = process.stderr.read()
        assert process.wait(HANGS_S) == INTERRUPTED
    found = re.fullmatch(rf"swath: interrupted; played (\d+\.\d) s of {flown.name} \(([\d,]+) units\)\n", said)
    assert found, said
    assert 0.0 < float(found[1]) < 10.0
    assert int(found[2].replace(",", "")) >= 20


def test_info_ends_in_one_word(flown: Flown, place: Path) -> None:
    assert interrupted("reading", "info", flown.log, place=place) == (INTERRUPTED, "swath: interrupted\n")


@pytest.mark.slow
def test_worker_processes_and_compiling_end_at_a_real_ctrl_c(flown: Flown, tmp_path: Path) -> None:
    """The terminal sends the signal to the whole process group; on a new installation all of them compile."""
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    arguments = [*flown.arguments(tmp_path / "out"), "--workers", "2", "--strips", "whole"]
    command = [sys.executable, "-m", "swath.daemon.cli.main", *arguments]
    with subprocess.Popen(
        command, cwd=ROOT, env=environment, stderr=subprocess.PIPE, text=True, process_group=0
    ) as process:
        assert process.stderr is not None
        assert process.stderr.readline() == f"{COMPILING}\n"
        wait_until(lambda: (tmp_path / "out").exists(), "the second pass")
        time.sleep(0.2)
        os.killpg(process.pid, signal.SIGINT)
        rest = process.stderr.read()
        assert process.wait(HANGS_S) == INTERRUPTED
    assert rest == NOTHING
    assert not (tmp_path / "out").exists()
    with pytest.raises(ProcessLookupError):
        os.killpg(process.pid, 0)  # no process of the group remains


def test_an_interrupt_waits_until_files_have_their_names(tmp_path: Path) -> None:
    def place_files() -> None:
        with held_interrupts():
            signal.raise_signal(signal.SIGINT)
            (tmp_path / "a").touch()

    with pytest.raises(KeyboardInterrupt):
        place_files()
    assert (tmp_path / "a").exists()


def test_sigterm_ends_work_as_ctrl_c_does() -> None:
    def work() -> None:
        with ended_in_order():
            signal.raise_signal(signal.SIGTERM)

    with pytest.raises(KeyboardInterrupt):
        work()
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL


def test_the_line_names_what_is_complete(tmp_path: Path) -> None:
    written.begin()
    assert written_words() == "nothing written"
    write_whole({tmp_path / "new/a.laz": b"a", tmp_path / "new/b.json": b"b"})
    assert written_words() == f"complete: {tmp_path}/new/a.laz and {tmp_path}/new/b.json"
    note_written(*(tmp_path / name for name in "cde"))  # moved away meanwhile
    assert written_words() == f"complete: {tmp_path}/new/a.laz and {tmp_path}/new/b.json"
    for name in "cde":
        (tmp_path / name).touch()
    assert written_words() == f"complete: {tmp_path}/e and 4 more files"
    written.begin()
    assert written_words() == "nothing written"


def test_only_empty_folders_that_were_made_are_removed(tmp_path: Path) -> None:
    (tmp_path / "old").mkdir()
    make_folder(tmp_path / "old")
    make_folder(tmp_path / "one/two/three")
    (tmp_path / "one/file").touch()
    remove_empty_folders()
    assert sorted(str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*")) == ["old", "one", "one/file"]


# ---------------------------------------------------------------------- a full disk


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """Return a file system with enough space when a command begins."""
    with disk_of(tmp_path / "disk", 48) as folder:
        yield folder


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "phase"),
    [
        ("georef", "points"),
        ("calibrate", "returns"),
        ("trajectory", "files"),
        ("view", "pictures"),
        ("export", "exporting"),
        ("sim fly", "flying"),
    ],
)
def test_a_disk_that_gets_full_is_told_in_one_line_and_nothing_is_left(
    command: str, phase: str, flown: Flown, products: Path, small_disk: Path
) -> None:
    """Other programs fill the disk during the work, after the command has compared free and needed space."""
    out, plan = small_disk / "out", flown.folder.parent / "line.toml"
    given = ["--trajectory", flown.sbet, "--trajectory-datum", "same", "--workers", "1"]
    arguments: dict[str, list[object]] = {
        "georef": [*flown.arguments(out)[1:], "--workers", "1"],
        "calibrate": [flown.log, "-o", small_disk / "left.toml", *given],
        "trajectory": [flown.log, "-o", out],
        "view": [products, "-o", out],
        "export": [flown.log, out],
        "sim fly": [plan, "-o", out],
    }
    full = {"FILLED_AT": phase, "FILLED_FOLDER": str(small_disk)}
    done = swath(*command.split(), *map(str, arguments[command]), **full)
    said = without_compiling(done.stderr)
    assert done.returncode == ExitCode.IO, said
    assert said.startswith(f"swath: {small_disk}")
    assert "no space left on the disk (" in said
    assert "; nothing written; free some space, or choose a folder on another disk" in said
    assert said.count("\n") == 1
    assert [path.name for path in small_disk.rglob("*")] == ["others.bin"]
