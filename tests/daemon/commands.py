"""Runs `swath COMMAND` as a process forked from one that has loaded everything, ten times faster than a start.

It serves tests of what a command does. Other tests start commands normally, and show that they start and what they
load.
"""

from __future__ import annotations

import atexit
import contextlib
import functools
import importlib
import json
import math
import os
import select
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import patch

from swath.daemon.cli import progress
from swath.daemon.cli.main import COMMANDS, main
from swath.daemon.cli.progress import Display
from swath.drivers.driver import KINDS, all_drivers
from tests.daemon.rig import HANGS_S

ROOT = Path(__file__).parents[2]
LOADED = (
    *(command.module for command in COMMANDS),
    "cantools.database",
    "swath.daemon.exchange.capture_files",
    "swath.daemon.devices.check",
    "swath.daemon.recorder.control_client",
    "swath.daemon.devices.setup",
    "swath.daemon.exchange.export",
    "swath.daemon.exchange.import_",
    "swath.daemon.log.recover",
    "swath.daemon.monitor.display",
    "swath.daemon.exchange.offload",
    "swath.daemon.recorder.run",
    "swath.daemon.log.statistics",
    "pynmea2",
    "rich.progress",
)
PROCESSING = {"calibrate", "georef", "plan-calibration", "sim", "strips", "trajectory", "validate", "view"}
ALSO_LOADED = (  # before the first of these commands; two seconds, which each would take for itself
    "swath.daemon.processing.calibration.plan.document",
    "swath.daemon.processing.calibration.products",
    "swath.daemon.processing.georeferencing.console",
    "swath.daemon.processing.georeferencing.run",
    "swath.daemon.processing.quicklook.gis",
    "swath.daemon.processing.quicklook.page",
    "swath.daemon.processing.strips.adjust_products",
    "swath.daemon.processing.strips.compare",
    "swath.daemon.processing.trajectory.run",
    "swath.daemon.processing.validation.run",
    "swath.daemon.simulate.into_log",
    "swath.sim.fly",
)


def swath(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run the command line with this process's environment and some more."""
    return _starter().run(list(arguments), os.environ | {"COLUMNS": "100", "NO_COLOR": "1"} | environment)


@functools.cache
def _starter() -> Starter:
    starter = Starter()
    atexit.register(starter.close)
    return starter


class Starter:
    """The process that forks, and the pipe to it."""

    def __init__(self) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-m", "tests.daemon.commands"],
            cwd=ROOT,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            start_new_session=True,  # the whole group can be ended if a command hangs
        )

    def run(self, arguments: list[str], environment: dict[str, str]) -> subprocess.CompletedProcess[str]:
        """Run a command; return its exit code and output."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        with tempfile.TemporaryDirectory() as folder:
            output, errors = Path(folder) / "stdout", Path(folder) / "stderr"
            request = {"arguments": arguments, "environment": environment, "says_to": [str(output), str(errors)]}
            self._process.stdin.write(json.dumps(request) + "\n")
            self._process.stdin.flush()
            if not select.select([self._process.stdout], [], [], HANGS_S)[0]:
                self.close()
                _starter.cache_clear()
                raise AssertionError(f"swath {arguments} hangs: {errors.read_text()}")
            code = int(self._process.stdout.readline())
            return subprocess.CompletedProcess(arguments, code, output.read_text(), errors.read_text())

    def close(self) -> None:
        """End the process and its children."""
        if self._process.poll() is None:
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.communicate()


def serve() -> None:
    """Run a command for every line on standard input; write its exit code back."""
    for name in LOADED:
        importlib.import_module(name)
    for kind in KINDS:
        all_drivers(kind)
    for line in sys.stdin:
        request = json.loads(line)
        if PROCESSING & set(request["arguments"][:1]):
            for name in ALSO_LOADED:
                importlib.import_module(name)
        pid = os.fork()
        if pid == 0:
            become(**request)
            main()
        _, status = os.waitpid(pid, 0)
        sys.stdout.write(f"{os.waitstatus_to_exitcode(status)}\n")
        sys.stdout.flush()


def become(arguments: list[str], environment: dict[str, str], says_to: list[str]) -> None:
    """Adopt the arguments, environment and outputs of a separately started process; no line of progress is due."""
    progress.AFTER_S = math.inf
    at_phase(environment.pop("INTERRUPTED_AT", ""), lambda: os.kill(os.getpid(), signal.SIGINT))
    folder = environment.pop("FILLED_FOLDER", "")
    at_phase(environment.pop("FILLED_AT", ""), lambda: fill(Path(folder)))
    sys.argv[1:] = arguments
    os.environ.clear()
    os.environ.update(environment)
    opened = [os.open(os.devnull, os.O_RDONLY), *(os.open(path, os.O_WRONLY | os.O_CREAT) for path in says_to)]
    for number, descriptor in enumerate(opened):
        os.dup2(descriptor, number)
        os.close(descriptor)


def at_phase(phase: str, act: Callable[[], None]) -> None:
    """Act each time that the work reports a phase that begins with `phase`; never if it is empty."""
    tell = Display.tell

    def acting(display: Display, what: str, *state: Any) -> None:
        tell(display, what, *state)
        if what.startswith(phase):
            act()

    if phase:
        patch.object(Display, "tell", acting).start()


def fill(folder: Path) -> None:
    """Fill the disk of a folder."""
    with (folder / "others.bin").open("ab", buffering=0) as file, contextlib.suppress(OSError):
        while True:
            file.write(bytes(4096))


if __name__ == "__main__":
    serve()
