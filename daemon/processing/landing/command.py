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
FLOWN, PREDICTED = "flown.npz", "calibration.json"
PAGE, PRINTED = "landing.html", "landing.pdf"
MARK = "landing:"  # begins the text of the mark with which the operator writes the verdict into the log
GOOD, REMARK, AGAIN, UNKNOWN, OPEN = "good", "remark", "again", "unknown", "open"  # states of a check
HOME, FLY_AGAIN, WAIT = "home", "again", "wait"  # of the verdict
PRINT_S = 120.0  # after which printing has failed


def page_command(live: Path, page: Path, *, predict: bool = False) -> list[str]:
    """Return the command that writes the page of a folder of live's files, and its PDF beside it.

    With ``predict`` the calibration is predicted anew, which takes half a minute; otherwise the last prediction counts.
    """
    program = [sys.executable, "-m", "swath.daemon.cli.main", "landing"]
    options = ["--output", str(page), "--overwrite", *([] if predict else ["--no-predict"])]
    return [*program, str(live), *options]


class PagePrinter:
    """Writes the page and its PDF beside live's files, in a process of its own, one at a time.

    Args:
        live: folder of live's files.
    """

    def __init__(self, live: Path) -> None:
        self._live = live
        self._process: subprocess.Popen[bytes] | None = None
        self._waits = self._predicts = False
        self.has_printed = False

    def ask(self, *, predict: bool = True) -> None:
        """Have the page written, as soon as the process before has ended; predict the calibration before, or not."""
        self._waits, self._predicts = True, predict
        self.look()

    def look(self) -> None:
        """Begin what waits, if nothing is being written; call now and then."""
        if not self._waits or (self._process is not None and self._process.poll() is None):
            return
        self._waits = False
        with contextlib.suppress(OSError):  # no memory, no processes: the verdict itself is written
            null = subprocess.DEVNULL
            command = page_command(self._live, self._live / PAGE, predict=self._predicts)
            self._process = subprocess.Popen(command, stdin=null, stdout=null, stderr=null)
            self.has_printed = True

    def finish(self, wait_s: float) -> bool:
        """Wait for what is being written, and for what waits; end it after ``wait_s`` for each.

        Returns:
            True if the last page was written wholly.
        """
        done = True
        for _ in range(2):
            if self._process is not None:
                try:
                    done = self._process.wait(wait_s) in (0, 1)  # 1: something is to be flown again
                except subprocess.TimeoutExpired:
                    self._process.kill()
                    self._process.wait()
                    done = False
            self.look()
        return done
