"""Tests ``swath mark`` and ``swath split`` with a real recorder, and all abuse of its socket."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import re
import shutil
import socket
import stat
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from swath.daemon.recorder.control import (
    LINE_BYTES,
    NOTE_CHARACTERS,
    NOTES_AT_ONCE,
    NOTES_PER_S,
    SPLITS_AT_ONCE,
    Control,
    listen,
)
from tests.builders import ROOT
from tests.daemon.builders import Numbers, scanner
from tests.daemon.commands import swath
from tests.daemon.log_check import read_log
from tests.daemon.rig import HANGS_S, Recorder, free_udp_port, session_table, wait_until

NOBODY = 65534
CONNECT_AS = """
import os, socket, sys
os.setgroups([]); os.setgid(int(sys.argv[2])); os.setuid(int(sys.argv[2]))
print(socket.socket(socket.AF_UNIX).connect_ex(sys.argv[1]))
"""
RUN_AS = """
import os, sys
import swath.daemon.cli.main, swath.daemon.config, swath.daemon.recorder.control_client
import swath.daemon.monitor.display, swath.daemon.exchange.offload, rich.live, rich.progress
swath.daemon.cli.main.make_app(None)
os.setgroups([]); os.setgid(int(sys.argv[1])); os.setuid(int(sys.argv[1]))
sys.exit(swath.daemon.cli.main.run_app(sys.argv[2:]))
"""


@pytest.fixture(autouse=True)
def no_unit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("RUNTIME_DIRECTORY", raising=False)


@pytest.fixture
def open_folder() -> Iterator[Path]:
    """Return a folder that every user may enter, unlike the tests' own."""
    folder = Path(tempfile.mkdtemp(prefix="swath-"))
    folder.chmod(0o755)
    yield folder
    shutil.rmtree(folder)


def connect(place: Path) -> socket.socket:
    sock = socket.socket(socket.AF_UNIX)
    sock.settimeout(10.0)
    sock.connect(str(place))
    return sock


def say(place: Path, line: bytes) -> dict[str, object]:
    """Send a line to a control socket and return its response."""
    with connect(place) as sock, sock.makefile("rb") as answer:
        sock.sendall(line)
        said = json.loads(answer.readline())
        assert isinstance(said, dict)
        return said


def test_a_note_is_logged_with_its_time(tmp_path: Path, logs: Path) -> None:
    with Recorder(tmp_path, session_table(logs)) as recorder:
        before_ns = time.time_ns()
        told = swath("mark", "line 4 start\tσ", str(recorder.config))
        answer = json.loads(swath("mark", "line 4 end", str(logs), "--json").stdout)
        after_ns = time.time_ns()
        assert recorder.stop() == 0, recorder.stderr()
    assert told.returncode == 0, told.stderr
    assert told.stdout.startswith("noted at ")
    assert told.stdout.endswith("part 0: line 4 start σ\n")
    notes = [(time_ns, event) for time_ns, event in read_log(logs).messages["/events"] if event["code"] == "mark"]
    assert [event["text"] for _, event in notes] == ["line 4 start σ", "line 4 end"]
    assert {(event["severity"], event["source"]) for _, event in notes} == {("info", "operator")}
    assert all(before_ns < time_ns == event["time_ns"] < after_ns for time_ns, event in notes)
    assert answer["time_ns"] == notes[1][0]
    assert (answer["ok"], answer["recording"], answer["part"]) == (True, True, 0)
    assert logs.joinpath(f"{answer['session_id']}_0.mcap").exists()
    assert not (logs / ".swath.control").exists()
    shown = swath("info", str(logs)).stdout
    assert re.search(r"^  \d\d:\d\d:\d\d mark: line 4 start σ\n  \d\d:\d\d:\d\d mark: line 4 end$", shown, re.MULTILINE)


@pytest.mark.slow
def test_split_begins_a_part_and_loses_no_data(tmp_path: Path, logs: Path) -> None:
    with (
        contextlib.closing(Numbers(free_udp_port())) as numbers,
        Recorder(tmp_path, session_table(logs) + scanner(numbers.port)) as recorder,
    ):
        recorder.wait_said("device_opened")
        numbers.send(100, 0.001)
        told = swath("split", str(recorder.config))
        numbers.send(100, 0.001)
        answer = json.loads(swath("split", str(logs), "--json").stdout)
        numbers.send(100, 0.001)
        time.sleep(0.5)
        assert recorder.stop() == 0, recorder.stderr()
    paths = sorted(logs.glob("*.mcap"))
    assert [path.stem.rsplit("_", 1)[1] for path in paths] == ["0", "1", "2"]
    assert told.stdout == f"recording continues in {paths[1].name}\n"
    assert answer["new_part"] == paths[2].name
    content = read_log(*paths)
    assert [int.from_bytes(data[:8], "little") for _, data in content.units["scanner/left"]] == list(range(300))
    assert [event["text"] for event in content.events("part_closed")] == [path.name for path in paths[1:]]


@pytest.mark.slow
@pytest.mark.parametrize("command", [("mark", "x"), ("split",)])
def test_without_a_recorder_the_error_is_one_line(tmp_path: Path, logs: Path, command: tuple[str, ...]) -> None:
    logs.mkdir()
    run = swath(*command, str(logs))
    assert (run.returncode, run.stdout) == (3, "")
    assert run.stderr == f"swath: {logs}: no recorder is running there\n"
    (logs / ".swath.control").symlink_to(tmp_path / "gone")
    assert swath(*command, str(logs)).stderr == run.stderr
    run = swath(*command, str(tmp_path / "absent"))
    assert run.returncode == 2
    config = tmp_path / "swath.toml"
    config.write_text(session_table(tmp_path / "absent"))
    run = swath(*command, str(config))
    assert run.returncode == 3
    assert run.stderr.count("\n") == 1


@pytest.mark.parametrize("text", ["", "  ", "x" * (NOTE_CHARACTERS + 1)])
def test_an_invalid_note_is_refused_before_it_is_sent(logs: Path, text: str) -> None:
    logs.mkdir()
    run = swath("mark", text, str(logs))
    assert run.returncode == 2
    assert run.stderr == f"swath: TEXT has {len(text)} characters; want 1 to {NOTE_CHARACTERS}, not only spaces\n"


def test_only_the_owner_of_the_recorder_can_connect(tmp_path: Path, open_folder: Path) -> None:
    """Root connects for the recorder's own user; another user is refused by the kernel."""
    if os.geteuid() != 0:
        pytest.fail("this test becomes another user: run it as root")

    def connect_as(user: int) -> int:
        command = [sys.executable, "-c", CONNECT_AS, str(place), str(user)]
        return int(subprocess.run(command, capture_output=True, text=True, check=True).stdout)

    logs = open_folder / "logs"
    logs.mkdir(mode=0o755)
    place = logs / ".swath.control"
    with Recorder(tmp_path, session_table(logs)) as recorder:
        assert stat.S_IMODE(os.lstat(place).st_mode) == 0o600
        assert stat.S_ISSOCK(os.lstat(place).st_mode)
        assert connect_as(0) == 0
        assert os.strerror(connect_as(NOBODY)) == "Permission denied"
        place.chmod(0o666)
        assert connect_as(NOBODY) == 0  # this shows that the mode caused the refusal
        assert recorder.stop() == 0


def test_the_service_s_group_may_connect(open_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In a service the socket belongs to the unit's group; its members may connect, other users may not."""
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(open_folder))
    with listen(open_folder / "control"):
        assert stat.S_IMODE(os.lstat(open_folder / "control").st_mode) == 0o660
        code = (
            "import os, socket, sys\nos.setgroups([]), os.setgid(int(sys.argv[2])), os.setuid(int(sys.argv[3]))\n"
            "try:\n    socket.socket(socket.AF_UNIX).connect(sys.argv[1])\n"
            "except OSError as error:\n    print(error.errno)\nelse:\n    print(0)\n"
        )
        for group, refused in ((os.lstat(open_folder / "control").st_gid, 0), (NOBODY, errno.EACCES)):
            command = [sys.executable, "-c", code, str(open_folder / "control"), str(group), str(NOBODY)]
            done = subprocess.run(command, capture_output=True, text=True, check=True)
            assert int(done.stdout) == refused


@pytest.mark.parametrize("words", [("mark", "x"), ("split",), ("monitor", "--once"), ("offload",)])
def test_status_without_permission_is_refused(tmp_path: Path, open_folder: Path, words: tuple[str, ...]) -> None:
    """The user must not read that nothing is being recorded there."""
    logs = open_folder / "logs"
    logs.mkdir(mode=0o750)
    arguments = [*words, str(logs), *([str(open_folder)] if words[0] == "offload" else [])]
    command = [sys.executable, "-c", RUN_AS, str(NOBODY), *arguments]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (3, "")
    assert done.stderr.startswith(f"swath: {logs}: not permitted; ")
    assert done.stderr.count("\n") == 1


def test_the_socket_is_in_the_runtime_directory_and_linked_from_the_log_directory(
    tmp_path: Path, logs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    runtime = tmp_path / "run"
    runtime.mkdir()
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(runtime))
    with Recorder(tmp_path, session_table(logs)) as recorder:
        assert stat.S_ISSOCK((runtime / "control").stat().st_mode)
        assert (logs / ".swath.control").readlink() == runtime / "control"
        assert swath("mark", "x", str(logs)).returncode == 0
        assert recorder.stop() == 0
    assert list(runtime.iterdir()) == []
    assert not (logs / ".swath.control").is_symlink()
    assert "RuntimeDirectory=swath" in (ROOT / "systemd/swathd.service").read_text().splitlines()


@pytest.mark.slow
def test_a_stale_socket_is_replaced(tmp_path: Path, logs: Path) -> None:
    with Recorder(tmp_path, session_table(logs)) as recorder:
        recorder.kill()
    assert stat.S_ISSOCK(os.lstat(logs / ".swath.control").st_mode)
    assert "no recorder is running" in swath("mark", "x", str(logs)).stderr
    with Recorder(tmp_path / "again", session_table(logs)) as recorder:
        assert swath("mark", "x", str(logs)).returncode == 0
        assert recorder.stop() == 0


@pytest.mark.slow
def test_a_socket_in_use_is_left_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    runtime = tmp_path / "run"
    runtime.mkdir()
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(runtime))
    first, second = tmp_path / "first", tmp_path / "second"
    with Recorder(tmp_path / "a", session_table(first)) as one, Recorder(tmp_path / "b", session_table(second)) as two:
        two.wait_said("another recorder uses it")
        assert swath("mark", "for one", str(first)).returncode == 0
        assert "no recorder" in swath("mark", "for two", str(second)).stderr
        assert two.stop() == 0
        assert swath("mark", "still", str(first)).returncode == 0
        assert one.stop() == 0
    assert [event["text"] for event in read_log(first).events("mark")] == ["for one", "still"]
    assert read_log(second).events("control_absent")


def test_a_file_that_is_not_a_socket_is_not_touched(tmp_path: Path, logs: Path) -> None:
    logs.mkdir()
    (logs / ".swath.control").write_text("a file of somebody's")
    with Recorder(tmp_path, session_table(logs)) as recorder:
        recorder.wait_said("control_absent")
        assert recorder.stop() == 0
    assert (logs / ".swath.control").read_text() == "a file of somebody's"


def test_after_a_defect_no_request_waits_for_a_response(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[str] = []
    events: Any = SimpleNamespace(post=lambda severity, source, code, text: said.append(code))
    recording: Any = SimpleNamespace(parts=SimpleNamespace(directory=tmp_path))
    monkeypatch.setattr(Control, "_turn", lambda self: 1 / 0)
    control = Control(recording, events)
    control.open()
    control.join(HANGS_S)
    assert "no recorder is running there" in swath("mark", "x", str(tmp_path)).stderr
    assert said == ["control_failed"]
    control.close()
    assert not list(tmp_path.iterdir())


def test_a_path_longer_than_a_socket_address_works(tmp_path: Path) -> None:
    logs = tmp_path / ("d" * 100) / ("e" * 100)
    with Recorder(tmp_path, session_table(logs)) as recorder:
        assert swath("mark", "far", str(logs)).returncode == 0
        assert recorder.stop() == 0
    assert read_log(logs).events("mark")


@pytest.mark.parametrize(
    ("line", "error"),
    [
        (b"mark\n", "one JSON object"),
        (b"[]\n", "one JSON object"),
        (b"\xff\xfe\n", "one JSON object"),
        (b"[" * 3000 + b"\n", "one JSON object"),
        (b'{"command": "stop"}\n', "mark and split"),
        (b'{"command": ["mark"]}\n', "mark and split"),
        (b'{"command": "mark"}\n', "1 to 500 characters"),
        (b'{"command": "mark", "text": "\\u0000\\n"}\n', "1 to 500 characters"),
        (b'{"command": "mark", "text": 7}\n', "1 to 500 characters"),
    ],
)
def test_an_invalid_request_is_refused_in_one_line(running: Path, line: bytes, error: str) -> None:
    answer = say(running / ".swath.control", line)
    assert answer["ok"] is False
    assert error in str(answer["error"])
    assert say(running / ".swath.control", b'{"command": "mark", "text": "after"}\n')["ok"] is True


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Return the log directory of a running recorder."""
    folder = tmp_path_factory.mktemp("running")
    with Recorder(folder, session_table(folder / "logs")) as recorder:
        yield folder / "logs"
        assert recorder.stop() == 0


def test_endless_part_requests_are_refused(running: Path) -> None:
    answers = [say(running / ".swath.control", b'{"command": "split"}\n') for _ in range(SPLITS_AT_ONCE + 2)]
    assert [answer["ok"] for answer in answers[:SPLITS_AT_ONCE]] == [True] * SPLITS_AT_ONCE
    assert answers[-1] == {"ok": False, "error": "too many new parts; at most 1 per second is begun"}


class Nuisance:
    """Everything that should not be done to a control socket, done by many at once until stopped."""

    def __init__(self, place: Path) -> None:
        self._place = place
        self._stop = threading.Event()
        self.done = 0
        jobs = [self._note, self._note, self._garbage, self._endless, self._hang, self._hang, self._come_and_go]
        self._threads = [threading.Thread(target=self._repeat, args=(job,)) for job in jobs]

    def __enter__(self) -> Nuisance:
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *unused: object) -> None:
        self._stop.set()
        for thread in self._threads:
            thread.join()

    def _repeat(self, job: Callable[[socket.socket], object]) -> None:
        while not self._stop.is_set():
            try:
                with socket.socket(socket.AF_UNIX) as sock:
                    sock.settimeout(0.3)
                    sock.connect(str(self._place))
                    job(sock)
                self.done += 1
            except OSError:
                pass

    def _note(self, sock: socket.socket) -> None:
        sock.sendall(b'{"command": "mark", "text": "flood"}\n')
        sock.recv(4096)

    def _garbage(self, sock: socket.socket) -> None:
        sock.sendall(os.urandom(2 * LINE_BYTES))

    def _endless(self, sock: socket.socket) -> None:
        for _ in range(100):
            sock.sendall(b"x" * LINE_BYTES)

    def _hang(self, sock: socket.socket) -> None:
        self._stop.wait(5.0)

    def _come_and_go(self, sock: socket.socket) -> None:
        pass


@pytest.mark.slow
def test_floods_and_hanging_peers_cost_no_data(tmp_path: Path, logs: Path) -> None:
    with (
        contextlib.closing(Numbers(free_udp_port())) as numbers,
        Recorder(tmp_path, session_table(logs) + scanner(numbers.port)) as recorder,
    ):
        recorder.wait_said("device_opened")
        place = logs / ".swath.control"
        with Nuisance(place) as nuisance:
            began_s = time.monotonic()
            while time.monotonic() < began_s + 6.0:
                numbers.send(50)
                time.sleep(0.01)
        seconds = time.monotonic() - began_s
        assert nuisance.done > 50
        wait_until(lambda: swath("mark", "after all that", str(logs)).returncode == 0, "a note after the flood's last")
        time.sleep(0.5)
        assert recorder.stop() == 0, recorder.stderr()
    content = read_log(logs)
    found = [int.from_bytes(data[:8], "little") for _, data in content.units["scanner/left"]]
    assert found == list(range(numbers.sent))
    status = content.messages["/status/scanner/left"][-1][1]
    assert (status["lost_kernel"], status["lost_queue"], status["lost_write"]) == (0, 0, 0)
    notes = [event["text"] for event in content.events("mark")]
    assert notes[-1] == "after all that"
    assert 0 < len(notes) - 1 <= NOTES_AT_ONCE + NOTES_PER_S * (seconds + 2.0)
    assert content.events("control_ignored")
    assert not content.events("control_failed")
