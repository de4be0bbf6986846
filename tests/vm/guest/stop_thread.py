"""Stops one thread of a process, by its name, while all its others run on; until the process is gone.   PID NAME"""

from __future__ import annotations

import ctypes
import os
import sys
from pathlib import Path

PTRACE_SEIZE, PTRACE_INTERRUPT, WAIT_ALL = 0x4206, 0x4207, 0x40000000  # <linux/ptrace.h>, __WALL of wait(2)


def main() -> None:
    """Stop one thread with ptrace(2); SIGSTOP would stop them all."""
    tasks = Path(f"/proc/{sys.argv[1]}/task")
    thread = next(int(task.name) for task in tasks.iterdir() if (task / "comm").read_text().strip() == sys.argv[2])
    libc = ctypes.CDLL(None, use_errno=True)
    for request in (PTRACE_SEIZE, PTRACE_INTERRUPT):
        if libc.ptrace(request, thread, None, None) != 0:
            raise OSError(ctypes.get_errno(), "ptrace")
    # a tracer that does not wait for the end of its tracee would keep the process from ending
    while os.WIFSTOPPED(os.waitpid(thread, WAIT_ALL)[1]):
        pass


if __name__ == "__main__":
    main()
