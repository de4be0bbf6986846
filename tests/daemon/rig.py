"""Runs a recorder in its own process, with wires to send on, for every end-to-end test."""

from __future__ import annotations

import contextlib
import ctypes
import os
import select
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import pytest

HANGS_S = 900.0  # a limit for what would never end, shorter than pytest's for a test


def free_udp_port() -> int:
    """Return a UDP port that is free at the moment."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("0.0.0.0", 0))
        port: int = probe.getsockname()[1]
        return port


@contextlib.contextmanager
def one_processor() -> Iterator[None]:
    """Keep this thread on one processor: loopback keeps the order of one processor's datagrams only."""
    allowed = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(allowed)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, allowed)


def wait_until(condition: Callable[[], object], what: str, timeout_s: float = HANGS_S) -> None:
    """Wait for something to become true; fails with its name."""
    deadline = time.monotonic() + timeout_s
    while not condition():
        if time.monotonic() > deadline:
            raise AssertionError(f"not within {timeout_s:g} s: {what}")
        time.sleep(0.02)


class NotifySocket:
    """The service manager's end of sd_notify."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / "notify"
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(str(self.path))
        self.messages: list[dict[str, str]] = []

    def poll(self, timeout_s: float = 0.0) -> None:
        """Receive the pending messages."""
        while select.select([self._socket], [], [], timeout_s)[0]:
            text = self._socket.recv(4096).decode()
            self.messages.append(dict(line.split("=", 1) for line in text.splitlines() if "=" in line))
            timeout_s = 0.0

    def count(self, key: str) -> int:
        """Return the number of messages with a key."""
        self.poll()
        return sum(key in message for message in self.messages)

    def last(self, key: str) -> str:
        """Return the newest value of a key, or an empty text."""
        self.poll()
        return next((message[key] for message in reversed(self.messages) if key in message), "")

    def close(self) -> None:
        """Close and remove the socket."""
        self._socket.close()
        self.path.unlink(missing_ok=True)


class Recorder:
    """``swath run`` on a configuration, as a service manager starts it."""

    def __init__(
        self,
        folder: Path,
        config: str,
        *,
        watchdog_s: float | None = None,
        prefix: list[str] | None = None,
        module: tuple[str, ...] = ("swath.daemon.cli.main", "run"),
        says_to: int | None = None,
    ):
        folder.mkdir(parents=True, exist_ok=True)
        self.config = folder / "swath.toml"
        self.config.write_text(config)
        self.notify = NotifySocket(folder)
        environment: dict[str, str] = dict(os.environ) | {"NOTIFY_SOCKET": str(self.notify.path)}
        if watchdog_s is not None:
            environment["WATCHDOG_USEC"] = str(round(watchdog_s * 1e6))
        self.stderr_path = folder / "stderr.txt"
        with self.stderr_path.open("ab") as stderr:
            self.process = subprocess.Popen(
                [*(prefix or []), sys.executable, "-m", *module, str(self.config)],
                stderr=stderr if says_to is None else says_to,
                stdout=subprocess.DEVNULL,
                env=environment,
            )

    def __enter__(self) -> Recorder:
        try:
            self.wait_ready()
        except AssertionError:
            self.__exit__()
            raise
        return self

    def __exit__(self, *unused: object) -> None:
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()
        self.notify.close()

    def wait_ready(self) -> None:
        """Wait for READY; fail with the recorder's output."""

        def ready() -> bool:
            if self.process.poll() is not None:
                raise AssertionError(f"swath run ended with {self.process.returncode}: {self.stderr()}")
            return self.notify.count("READY") > 0

        wait_until(ready, "READY")

    def stderr(self) -> str:
        """Return the output on standard error."""
        return self.stderr_path.read_text()

    def wait_said(self, text: str, times: int = 1, timeout_s: float = HANGS_S) -> None:
        """Wait until the journal contains a text so many times."""
        wait_until(lambda: self.stderr().count(text) >= times, f"{text!r} in the journal: {self.stderr()}", timeout_s)

    def stop(self, timeout_s: float = HANGS_S) -> int:
        """Send SIGTERM; return the exit status."""
        self.process.send_signal(signal.SIGTERM)
        return self.process.wait(timeout_s)

    def thread(self, name: str) -> int:
        """Return the kernel id of a thread by its name."""
        for task in Path(f"/proc/{self.process.pid}/task").iterdir():
            if (task / "comm").read_text().strip() == name:
                return int(task.name)
        raise AssertionError(f"no thread {name}")

    @contextlib.contextmanager
    def stopped_thread(self, name: str) -> Iterator[None]:
        """Stop one thread, as a disk that does not answer would, while the others continue.

        A thread that holds the interpreter's lock would stop everything, so it goes on and is stopped again elsewhere.
        """
        libc = ctypes.CDLL(None, use_errno=True)
        attach, detach, wait_all = 16, 17, 0x40000000
        thread = self.thread(name)
        for _ in range(20):
            if libc.ptrace(attach, thread, None, None) != 0:
                raise AssertionError(f"ptrace: {os.strerror(ctypes.get_errno())}")
            os.waitpid(thread, wait_all)
            if self._others_go_on():
                break
            libc.ptrace(detach, thread, None, None)
            time.sleep(0.003)
        else:
            raise AssertionError(f"the others never went on without {name}")
        try:
            yield
        finally:
            libc.ptrace(detach, thread, None, None)

    def _others_go_on(self) -> bool:
        """Return True if the main thread still reports its status each second."""
        before = self.notify.count("STATUS")
        deadline = time.monotonic() + 2.5
        while time.monotonic() < deadline:
            if self.notify.count("STATUS") > before:
                return True
            time.sleep(0.02)
        return False

    def kill(self) -> None:
        """Send SIGKILL, which ends it as a power cut does."""
        self.process.kill()
        self.process.wait()


def session_table(directory: Path, **keys: object) -> str:
    """Return a [session] table with small defaults."""
    values: Mapping[str, object] = {"name": '"test"', "directory": f'"{directory}"', "reserve_mb": 1, **keys}
    return "[session]\n" + "".join(f"{key} = {value}\n" for key, value in values.items())


@contextlib.contextmanager
def disk_of(folder: Path, size_mb: int) -> Iterator[Path]:
    """Mount a separate file system of that size at a new folder."""
    if os.geteuid() != 0:
        pytest.fail("this test mounts a tmpfs: run it as root")
    folder.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size_mb}m", "swath-test", str(folder)], check=True)
    try:
        yield folder
    finally:
        subprocess.run(["umount", "--lazy", str(folder)], check=True)
