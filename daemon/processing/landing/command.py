"""Names the files of the verdict before landing, and the command that makes its page; imports nothing slow.

The console and `swath live` run that command as a process of its own, so that printing delays neither.
"""

from __future__ import annotations

import contextlib
import subprocess
import sys
from pathlib import Path

VERDICT = "verdict.json"
VERSION = 1
PAGE, PRINTED = "landing.html", "landing.pdf"
LIVE = "live"  # folder of live's files in the log directory
MARK = "landing:"  # begins the text of the mark with which the operator writes the verdict into the log
GOOD, REMARK, AGAIN, UNKNOWN, OPEN = "good", "remark", "again", "unknown", "open"  # states of a check
HOME, FLY_AGAIN, WAIT = "home", "again", "wait"  # of the verdict
PRINT_S = 120.0  # after which printing has failed


def page_command(live: Path, page: Path) -> list[str]:
    """Return the command that writes the page of a folder of live's files, and its PDF beside it."""
    program = [sys.executable, "-m", "swath.daemon.cli.main", "landing"]
    return [*program, str(live), "--output", str(page), "--overwrite"]


class PagePrinter:
    """Writes the page and its PDF beside live's files, in a process of its own, one at a time.

    Args:
        live: folder of live's files.
    """

    def __init__(self, live: Path) -> None:
        self._live = live
        self._process: subprocess.Popen[bytes] | None = None
        self._waits = False
        self.has_printed = False

    def ask(self) -> None:
        """Have the page written, as soon as the process before has ended."""
        self._waits = True
        self.look()

    def look(self) -> None:
        """Begin what waits, if nothing is being written; call now and then."""
        if not self._waits or (self._process is not None and self._process.poll() is None):
            return
        self._waits = False
        with contextlib.suppress(OSError):  # no memory, no processes: the verdict itself is written
            null = subprocess.DEVNULL
            self._process = subprocess.Popen(
                page_command(self._live, self._live / PAGE), stdin=null, stdout=null, stderr=null
            )
            self.has_printed = True

    def finish(self, wait_s: float) -> None:
        """Wait for what is being written, and for what waits; end it after ``wait_s`` for each."""
        for _ in range(2):
            if self._process is not None:
                try:
                    self._process.wait(wait_s)
                except subprocess.TimeoutExpired:
                    self._process.kill()
                    self._process.wait()
            self.look()
