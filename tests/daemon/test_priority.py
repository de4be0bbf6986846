"""Tests that commands lower their priority on every processor; the numbers of system calls differ."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from tests.daemon.rig import HANGS_S

IOPRIO_GET = {"x86_64": 252, "aarch64": 31}  # asm/unistd_64.h, asm-generic/unistd.h
IDLE = 3 << 13  # linux/ioprio.h
ASK = "import ctypes; print(ctypes.CDLL(None).syscall({number}, 1, 0))"


@pytest.mark.parametrize("way", ["swath.daemon.system:give_way", "swath.daemon.system:lower_priority"])
def test_disk_access_runs_at_idle_priority(way: str) -> None:
    number = IOPRIO_GET.get(os.uname().machine)
    assert number is not None, "what is ioprio_get's number on this processor?"
    module, name = way.split(":")
    code = f"from {module} import {name}; {name}(); {ASK.format(number=number)}"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=HANGS_S, check=True)
    assert int(done.stdout) & ~0x1FFF == IDLE
