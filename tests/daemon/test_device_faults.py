"""What devices do wrong while recording: every unit is in the log as it came, and the trouble is told."""

from __future__ import annotations

import json
import os
import socket
import struct
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from drivers.core.can_frames import encode_can_frame
from tests.daemon import faulty_can
from tests.daemon.log_check import read_log
from tests.daemon.rig import Recorder, session_table

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def logs(tmp_path: Path) -> Path:
    return tmp_path / "logs"


def info(logs: Path) -> dict[str, Any]:
    """What ``swath info`` says of the one session in a directory; nothing unaccounted, nothing damaged."""
    command = [sys.executable, "-m", "daemon.cli.main", "info", "--json", str(logs)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=60, check=True)
    (session,) = json.loads(done.stdout)["sessions"]
    sources: dict[str, Any] = session["sources"]
    return sources


# --- CAN: error frames, bus-off, an adapter that fails -----


class FaultyCan:
    """The other end of a faulty bus."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.off = Path(f"{path}.off")
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.sent: list[bytes] = []

    def frames(self, count: int) -> None:
        for _ in range(count):
            self.frame(encode_can_frame(0x121, len(self.sent).to_bytes(8, "little")))

    def error_frame(self, error_class: int) -> None:
        self.frame(struct.pack("<IB3x8x", 0x2000_0000 | error_class, 8))

    def frame(self, frame: bytes) -> None:
        self._socket.sendto(frame, str(self.path))
        self.sent.append(frame)

    def fail(self, text: str) -> None:
        self._socket.sendto(text.encode(), str(self.path))

    def close(self) -> None:
        self._socket.close()


@pytest.fixture
def faulty(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[FaultyCan]:
    paths = [faulty_can.install(tmp_path), str(ROOT), os.environ.get("PYTHONPATH", "")]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, paths)))
    bus = FaultyCan(tmp_path / "bus")
    yield bus
    bus.close()


def test_bus_off_and_error_frames_are_told_and_the_bus_comes_back(
    tmp_path: Path, logs: Path, faulty: FaultyCan
) -> None:
    """Error frames of 3 classes, bus-off with restart, then an adapter that fails and cannot be opened for a while."""
    config = f'[imu.main]\ntransport = "can:faulty:{faulty.path}"\nprotocol = "canmod-gps"\n'
    with Recorder(tmp_path / "rig", session_table(logs) + config) as recorder:
        recorder.wait_said("imu/main device_opened")
        faulty.frames(100)
        for error_class in (0x04, 0x08, 0x80):  # controller problem, protocol violation, bus error
            faulty.error_frame(error_class)
            faulty.frames(10)
        faulty.error_frame(0x40)
        faulty.error_frame(0x100)  # and restarted
        faulty.frames(50)
        recorder.wait_said("imu/main can_bus_off")
        recorder.wait_said("imu/main can_errors")
        faulty.off.touch()
        faulty.frames(50)
        faulty.fail("bus-off: the adapter has given up")
        recorder.wait_said("imu/main device_lost")
        recorder.wait_said("the controller is bus-off")
        faulty.off.unlink()
        recorder.wait_said("imu/main device_opened", times=2)
        faulty.frames(100)
        faulty.error_frame(0x40)
        assert recorder.stop() == 0, recorder.stderr()
    content = read_log(logs)
    assert [data for _, data in content.units["imu/main"]] == faulty.sent
    status = content.messages["/status/imu/main"][-1][1]
    assert (status["units"], status["written"]) == (len(faulty.sent), len(faulty.sent))
    assert (status["error_frames"], status["bus_off"]) == (6, 2)
    assert content.events("can_bus_off")[0]["severity"] == "error"
    assert "the adapter has given up" in content.events("device_lost")[0]["text"]
    numbers = info(logs)["imu/main"]
    assert numbers["trouble"] == {"error_frames": 6, "bus_off": 2}
