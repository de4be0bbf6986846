"""Runs inside the machine: recorder, network interfaces, senders. The host's half is `tests.vm.crew`.

It imports little, because on an emulated processor pytest alone takes longer to load than the machine to boot.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

SHARED = Path("/vm")
WORK = Path("/run/flight")
TREE = Path(__file__).resolve().parents[2]
WAIT_S = 400.0  # measures nothing: it ends what would never end
SWATH = "/opt/swath/bin/swath"
SETTINGS = "/usr/lib/sysctl.d/90-swath.conf"
# user, priority, limits and (no) capabilities are those of swathd.service
AS_THE_SERVICE = (
    *("prlimit", "--memlock=unlimited", "--rtprio=10", "--nofile=4096", "chrt", "-f", "10"),
    *("setpriv", "--reuid=swath", "--regid=swath", "--init-groups", "--no-new-privs"),
    *("--inh-caps=-all", "--bounding-set=-all"),
)


def wait_until(condition: Callable[[], object], what: str) -> None:
    """Wait until something becomes true; fail with its name."""
    deadline_s = time.monotonic() + WAIT_S
    while not condition():
        if time.monotonic() > deadline_s:
            raise AssertionError(f"not within {WAIT_S:g} s: {what}")
        time.sleep(0.02)


def sh(command: str) -> str:
    """Run a line of shell; return its output."""
    found = subprocess.run(["sh", "-c", command], capture_output=True, text=True, check=False)
    assert found.returncode == 0, f"{command}: {found.stdout}{found.stderr}"
    return found.stdout


def say(text: str) -> None:
    """Print a line for the host's test."""
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def keep(name: str, value: dict[str, Any]) -> None:
    """Leave facts for the host."""
    (SHARED / f"{name}.json").write_text(json.dumps(value))


def lend(device: str) -> None:
    """Give a device to the recorder's user, as the rules of udev do, which is not here."""
    shutil.chown(device, group="dialout")
    os.chmod(device, 0o660)


class Recorder:
    """``swath run`` as installed, run by its own user, after it has reported READY."""

    def __init__(self, config: str) -> None:
        WORK.mkdir(parents=True, exist_ok=True)
        shutil.chown(WORK, "swath", "swath")
        (WORK / "swath.toml").write_text(config)
        self._words = WORK / "stderr.txt"
        notify = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        (WORK / "notify").unlink(missing_ok=True)
        notify.bind(str(WORK / "notify"))
        (WORK / "notify").chmod(0o666)
        notify.settimeout(WAIT_S)
        with self._words.open("wb") as words:
            self.process = subprocess.Popen(
                [*AS_THE_SERVICE, SWATH, "run", str(WORK / "swath.toml")],
                stderr=words,
                stdout=subprocess.DEVNULL,
                env={**os.environ, "NOTIFY_SOCKET": str(WORK / "notify")},
            )
        try:
            while b"READY=1" not in notify.recv(4096):
                pass
        except TimeoutError:
            raise AssertionError(f"never READY: {self.words()}") from None
        notify.settimeout(0)
        self._notify = notify  # nobody reads its further messages, and it does not wait for that

    def words(self) -> str:
        """Return its output."""
        return self._words.read_text()

    def wait_said(self, text: str, times: int = 1) -> None:
        """Wait until its output contains a text so many times."""
        wait_until(lambda: self.words().count(text) >= times, f"{times} times {text!r} in: {self.words()}")

    def stop(self) -> None:
        """End it; it must exit without error."""
        self.process.send_signal(signal.SIGTERM)
        status = self.process.wait(WAIT_S)
        assert status == 0, f"status {status}: {self.words()}"


def session(name: str = "vm") -> str:
    """Return the table [session] of a recording in `WORK`."""
    return f'[session]\nname = "{name}"\ndirectory = "{WORK}/logs"\nreserve_mb = 1\n'


@contextlib.contextmanager
def recording(config: str, keep_as: str = "logs") -> Iterator[Recorder]:
    """Run a recorder, and leave its log and its messages in `SHARED`."""
    recorder = Recorder(config)
    try:
        yield recorder
        recorder.stop()
    finally:
        if recorder.process.poll() is None:
            recorder.process.kill()
            recorder.process.wait()
        shutil.copy(WORK / "stderr.txt", SHARED)
        (SHARED / keep_as).mkdir(exist_ok=True)
        for log in (WORK / "logs").glob("*.mcap"):
            shutil.move(log, SHARED / keep_as)


def main(jobs: dict[str, Callable[..., None]]) -> None:
    """Do the job that the command line names, under the kernel settings of an installed computer."""
    sh(f"sysctl -p {SETTINGS}")
    jobs[sys.argv[1]](*sys.argv[2:])
