"""Starts recorders by fork after all imports: reads a configuration per line, and prints the child's pid."""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path

from swath.daemon.config import load_config
from swath.daemon.recorder.run import record


def main() -> None:
    """Fork for every configuration named on standard input; children record until they are killed."""
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)
    for line in sys.stdin:
        pid = os.fork()
        if pid == 0:
            os._exit(int(record(load_config(Path(line.strip())))))
        sys.stdout.write(f"{pid}\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
