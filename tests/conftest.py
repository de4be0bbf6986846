"""What all processes of a test run share, workers and those that tests start: set before the first of them begins."""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path
from typing import Any

LEAN = Path(__file__).parent / "lean"


def prepare_processes() -> None:
    """Let what a test starts be on its feet quickly, as an installed one is."""
    paths = os.environ.get("PYTHONPATH", "").split(os.pathsep)
    if str(LEAN) not in paths:
        os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [str(LEAN), *paths]))
    loaded: dict[str, Any] = sys.modules
    loaded.setdefault("asammdf", None)  # this process has begun: its path is settled
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # else each reads all modules as text
    sys.dont_write_bytecode = False


def heed_interrupts() -> None:
    """A job that a shell runs in the background begins deaf to SIGINT, and so would all it starts."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


prepare_processes()
heed_interrupts()
