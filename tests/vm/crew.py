"""Runs programs of this package in a virtual machine, from the host, and reads what they leave."""

from __future__ import annotations

import json
import os
import shlex
import sys
import threading
import time
import tty
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tests.vm.aboard_time import second_told
from tests.vm.installed import image
from tests.vm.machine import Finished, Machine, run, start

PATIENCE = 20  # how many times as long as on an idle machine, where other machines may run beside it


def command(module: str, *arguments: object, before: str = "") -> str:
    """Return a command that runs a program of this package with the Python that runs the test."""
    lines = []
    if Path(sys.prefix).is_relative_to("/tmp"):  # the machine has a /tmp of its own
        place = shlex.quote(sys.prefix)
        lines.append(f"mkdir -p {place}; mount -t 9p -o ro,cache=loose,trans=virtio,version=9p2000.L venv {place}")
    lines += [
        "export PYTHONDONTWRITEBYTECODE=1",
        before,
        shlex.join([sys.executable, "-m", f"tests.vm.{module}", *map(str, arguments)]),
    ]
    return "\n".join(lines)


def _environment() -> list[str]:
    if not Path(sys.prefix).is_relative_to("/tmp"):
        return []
    lent = f"local,id=venv,path={sys.prefix},security_model=none,readonly=on,multidevs=remap"
    return ["-fsdev", lent, "-device", "virtio-9p-pci,fsdev=venv,mount_tag=venv"]


def aboard(
    shared: Path, module: str, *arguments: object, before: str = "", qemu: Sequence[str | Path] = (), seconds: float
) -> Finished:
    """Run a program of this package in the machine, and check that it succeeds.

    Args:
        shared: folder of the host that is ``/vm`` in the machine.
        module, arguments: name and arguments of the program.
        before: shell commands that run before it.
        qemu: further devices.
        seconds: its duration on an idle machine, without booting.
    """
    return run(
        command(module, *arguments, before=before),
        shared=shared,
        layers=[image()],
        qemu=[*_environment(), *qemu],
        timeout_s=PATIENCE * (20 + seconds),
    ).check()


def embark(
    shared: Path,
    module: str,
    *arguments: object,
    before: str = "",
    qemu: Sequence[str | Path] = (),
    environment: dict[str, str] | None = None,
    seconds: float,
) -> Machine:
    """Start a program of this package in the machine and leave it running."""
    return start(
        command(module, *arguments, before=before),
        shared=shared,
        layers=[image()],
        qemu=[*_environment(), *qemu],
        environment=environment,
        timeout_s=PATIENCE * (20 + seconds),
    )


def facts(shared: Path, name: str) -> dict[str, Any]:
    """Return the facts that a program left by `tests.vm.aboard.keep`."""
    value: dict[str, Any] = json.loads((shared / f"{name}.json").read_text())
    return value


class GnssReceiver:
    """A receiver on this computer for a serial line of the machine: NMEA on a pty, PPS as a byte that sets DCD.

    Attributes:
        port: the pty, for qemu.
        pulses_utc_s: seconds of the pulses so far.
    """

    def __init__(self, dcd: Path) -> None:
        self._main, secondary = os.openpty()
        tty.setraw(self._main)
        tty.setraw(secondary)
        os.set_blocking(self._main, False)
        self.port = os.ttyname(secondary)
        self.pulses_utc_s: list[int] = []
        dcd.write_bytes(b"0")
        self._dcd = os.open(dcd, os.O_RDWR)
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def _run(self) -> None:
        while not self._stopped.wait(1 - time.time() % 1):
            os.pwrite(self._dcd, b"1", 0)
            self.pulses_utc_s.append(round(time.time()))
            time.sleep(0.15)
            try:
                os.write(self._main, second_told(self.pulses_utc_s[-1]))
            except BlockingIOError:  # nobody reads yet
                pass
            time.sleep(0.1)
            os.pwrite(self._dcd, b"0", 0)

    def __enter__(self) -> GnssReceiver:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stopped.set()
        self._thread.join()
        os.close(self._dcd)
        os.close(self._main)
