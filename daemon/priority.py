"""Giving way to everything else on the computer, the recorder above all."""

from __future__ import annotations

import ctypes
import os

_IOPRIO_WHO_PROCESS = 1
_IOPRIO_IDLE = 3 << 13  # class idle, linux/ioprio.h
_SYS_IOPRIO_SET = {"x86_64": 251, "aarch64": 30}


def give_way() -> None:
    """Run at idle CPU and I/O priority; where it is not permitted, go on as it is."""
    try:
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        os.nice(19)
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    except OSError:
        pass
    number = _SYS_IOPRIO_SET.get(os.uname().machine)
    if number is not None:
        ctypes.CDLL(None, use_errno=True).syscall(number, _IOPRIO_WHO_PROCESS, 0, _IOPRIO_IDLE)
