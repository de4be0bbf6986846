"""Tests a disk that fills up: reported at once, counted to the unit, and resumed with space."""

from __future__ import annotations

import contextlib
import os
import shutil
import socket
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.daemon.log_check import official_counts, read_log
from tests.daemon.rig import HANGS_S, Recorder, disk_of, free_udp_port, one_processor, session_table, wait_until

SIZE_MB = 24


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """Return a separate file system of 24 MB."""
    with disk_of(tmp_path / "disk", SIZE_MB) as folder:
        yield folder


def config_of(logs: Path, port: int, reserve_mb: float) -> str:
    table = session_table(logs, reserve_mb=reserve_mb)
    return table + f'[scanner.left]\ntransport = "udp:127.0.0.1:{port}"\nprotocol = "srep"\nmirror_factor = 1.0\n'


class Flood:
    """A sender of numbered datagrams of 1206 bytes, `burst` of them every 5 ms."""

    def __init__(self, port: int, burst: int) -> None:
        self.burst = burst
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._port = port
        self.sent = 0

    def send(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        with one_processor():
            while time.monotonic() < end:
                for _ in range(self.burst):
                    data = self.sent.to_bytes(8, "little") + b"x" * 1198
                    self._socket.sendto(data, ("127.0.0.1", self._port))
                    self.sent += 1
                time.sleep(0.005)

    def send_until(self, condition: Callable[[], object], timeout_s: float = HANGS_S) -> None:
        end = time.monotonic() + timeout_s
        while not condition():
            assert time.monotonic() < end, "not within time"
            self.send(0.1)

    def close(self) -> None:
        self._socket.close()


@pytest.mark.slow
@pytest.mark.parametrize(("reserve_mb", "said"), [(8, "disk_reserve"), (1, "write_failed")])
def test_recording_stops_when_the_disk_is_full_and_resumes_with_space(
    small_disk: Path, reserve_mb: int, said: str
) -> None:
    """The reserve, checked once a second, stops 5 MB/s in time; 20 MB/s exceed 1 MB and meet the disk's own error."""
    port = free_udp_port()
    filler = small_disk / "filler"
    filler.write_bytes(bytes(10 << 20))
    logs = small_disk / "logs"
    config = config_of(logs, port, reserve_mb)
    with (
        contextlib.closing(Flood(port, 20 if said == "disk_reserve" else 250)) as flood,
        Recorder(small_disk.parent / "rig", config) as recorder,
    ):
        recorder.wait_said("device_opened")
        flood.send_until(lambda: f"disk {said}" in recorder.stderr())
        wait_until(lambda: "NOT RECORDING" in recorder.notify.last("STATUS"), "said in STATUS")
        flood.send(0.5)
        assert recorder.process.poll() is None
        filler.unlink()
        flood.burst = 10  # 2.4 MB/s: the 10 MB that are free now last to the end
        flood.send_until(lambda: "disk recording_resumed" in recorder.stderr())
        flood.send(0.3)
        time.sleep(1.5)
        assert recorder.stop() == 0, recorder.stderr()
    content = read_log(logs)
    status = content.messages["/status/scanner/left"][-1][1]
    found = [int.from_bytes(data[:8], "little") for _, data in content.units["scanner/left"]]
    assert status["units"] == flood.sent
    assert status["lost_write"] > 0
    assert status["written"] == len(found) == flood.sent - status["lost_write"] - status["lost_kernel"]
    assert found == sorted(set(found))
    assert found[-1] == flood.sent - 1
    assert content.damage == 0
    for path in logs.glob("*.mcap"):
        if path.stat().st_size and path.read_bytes().endswith(b"\x89MCAP0\r\n"):
            assert official_counts(path)["/scanner/left/raw"] > 0
    if said == "disk_reserve":
        assert content.events("disk_reserve")
        assert all(path.read_bytes().endswith(b"\x89MCAP0\r\n") for path in logs.glob("*.mcap"))


@pytest.fixture
def failing_disk(tmp_path: Path) -> Iterator[tuple[Path, Path]]:
    """Return a separate ext4, and the file that declares it broken, after which it is read-only at once."""
    if os.geteuid() != 0:
        pytest.fail("this test mounts a file system: run it as root")
    image, folder = tmp_path / "image", tmp_path / "disk"
    folder.mkdir()
    with image.open("wb") as file:
        file.truncate(64 << 20)
    subprocess.run(["mkfs.ext4", "-q", "-F", str(image)], check=True)
    mounted = ["mount", "-o", "loop,errors=remount-ro", str(image), str(folder)]
    if subprocess.run(mounted, check=False).returncode != 0:
        pytest.fail("this test needs loop devices (modprobe loop): no other disk can be told to fail")
    number = os.stat(folder).st_dev
    device = Path(f"/sys/dev/block/{os.major(number)}:{os.minor(number)}").resolve().name
    try:
        yield folder, Path(f"/sys/fs/ext4/{device}/trigger_fs_error")
    finally:
        while subprocess.run(["umount", "--lazy", str(folder)], check=False, stderr=subprocess.DEVNULL).returncode == 0:
            pass


def keep_parts(logs: Path, kept: Path) -> None:
    """Copy the parts that there are."""
    kept.mkdir(exist_ok=True)
    for path in logs.glob("*.mcap"):
        shutil.copy(path, kept)


@pytest.mark.slow
@pytest.mark.alone  # it asserts a short time
def test_a_read_only_file_system_is_reported_at_once_and_replaced_by_another(
    failing_disk: tuple[Path, Path], tmp_path: Path
) -> None:
    """The kernel does this to a broken disk; remounting by hand is refused while the log is open (EBUSY)."""
    folder, trigger = failing_disk
    port = free_udp_port()
    logs, kept = folder / "logs", tmp_path / "kept"
    with contextlib.closing(Flood(port, 2)) as flood, Recorder(tmp_path / "rig", config_of(logs, port, 1)) as recorder:
        recorder.wait_said("device_opened")
        flood.send(1.5)
        failed_ns = time.time_ns()
        trigger.write_text("broken")
        flood.send_until(lambda: "disk write_failed" in recorder.stderr())
        wait_until(lambda: "NOT RECORDING: Read-only file system" in recorder.notify.last("STATUS"), "said in STATUS")
        flood.send(1.0)
        assert recorder.process.poll() is None
        keep_parts(logs, kept)  # what reached the kernel; the disk itself may hold less
        subprocess.run(["umount", "--lazy", str(folder)], check=True)
        subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={SIZE_MB}m", "swath-test", str(folder)], check=True)
        flood.send_until(lambda: "disk recording_resumed" in recorder.stderr())
        flood.send(0.3)
        time.sleep(1.2)
        assert recorder.stop() == 0, recorder.stderr()
    keep_parts(logs, kept)
    content = read_log(kept)
    status = content.messages["/status/scanner/left"][-1][1]
    found = [int.from_bytes(data[:8], "little") for _, data in content.units["scanner/left"]]
    assert status["units"] == flood.sent
    assert status["lost_write"] > 0
    assert status["written"] == len(found) == flood.sent - status["lost_write"] - status["lost_kernel"]
    assert found == sorted(set(found))
    assert found[-1] == flood.sent - 1
    (told,) = content.events("write_failed")
    assert (told["severity"], told["source"]) == ("critical", "disk")
    assert 0 <= (told["time_ns"] - failed_ns) * 1e-9 < 3.0  # 1 s is required; a busy machine may take longer
    assert content.events("recording_resumed")


@pytest.mark.slow
def test_a_recorder_on_a_full_disk_is_ready_and_waits(small_disk: Path) -> None:
    (small_disk / "filler").write_bytes(bytes(20 << 20))
    port = free_udp_port()
    logs = small_disk / "logs"
    with Recorder(small_disk.parent / "rig", config_of(logs, port, 8), watchdog_s=1.0) as recorder:
        assert "NOT RECORDING" in recorder.notify.last("STATUS")
        recorder.wait_said("disk disk_reserve")
        fed = recorder.notify.count("WATCHDOG")
        time.sleep(4)
        assert recorder.notify.count("WATCHDOG") > fed + 5
        (small_disk / "filler").unlink()
        recorder.wait_said("disk recording_resumed")
        assert recorder.stop() == 0
    assert len(read_log(logs).events("disk_reserve")) == 1


def test_an_unwritable_directory_is_refused(tmp_path: Path) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("")
    recorder = Recorder(tmp_path / "rig", config_of(blocked / "logs", free_udp_port(), 1))
    assert recorder.process.wait(HANGS_S) == 3
    recorder.notify.close()
    (line,) = recorder.stderr().splitlines()
    assert "session.directory" in line
    assert str(blocked) in line
