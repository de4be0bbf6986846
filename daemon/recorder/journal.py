"""Writes the recorder's messages to stderr in a separate thread, so that no recording thread waits for a
slow reader.
"""

from __future__ import annotations

import contextlib
import faulthandler
import logging
import os
import queue
import threading

from swath.daemon.system import name_thread

MAX_LINES = 10_000  # in the queue; further lines are only counted, since the log has their events too
END_S = 1.0  # time limit for the last lines

_PRIORITY = {logging.CRITICAL: 2, logging.ERROR: 3, logging.WARNING: 4, logging.INFO: 6, logging.DEBUG: 7}


class JournalFormatter(logging.Formatter):
    """Formats lines with the priority prefix that systemd-journald understands (sd-daemon(3))."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the prefix and the message."""
        return f"<{_PRIORITY[record.levelno]}>{super().format(record)}"


class JournalHandler(logging.Handler):
    """Never blocks the caller: a full pipe, a stopped journal or a busy disk behind stderr delays only its own thread.

    Args:
        fd: descriptor for the lines, not a Python stream: at exit the interpreter would wait for a stuck stream.
    """

    def __init__(self, fd: int) -> None:
        super().__init__()
        self._fd = fd
        self._lines: queue.Queue[str | None] = queue.Queue(MAX_LINES)
        self._left_out = 0
        self._thread = threading.Thread(target=self._write, daemon=True)
        self._thread.start()

    def emit(self, record: logging.LogRecord) -> None:
        """Queue a message; handlers are called one at a time (`logging.Handler.acquire`)."""
        try:
            if self._left_out:
                self._lines.put_nowait(f"{self._left_out} lines left out, because no reader took them")
                self._left_out = 0
            self._lines.put_nowait(self.format(record))
        except queue.Full:
            self._left_out += 1

    def _write(self) -> None:
        name_thread("journal")
        while (line := self._lines.get()) is not None:
            rest = f"{line}\n".encode(errors="replace")
            with contextlib.suppress(OSError):  # the reader is gone; the recording continues
                while rest:
                    rest = rest[os.write(self._fd, rest) :]

    def close(self) -> None:
        """Write the queued lines, but take no longer than `END_S`."""
        with contextlib.suppress(queue.Full):
            self._lines.put_nowait(None)
            self._thread.join(END_S)
        super().close()


def threads_text() -> str:
    """Return the stack of every thread of this process, or the reason why it cannot be read."""
    try:
        with os.fdopen(os.memfd_create("threads"), "w+b") as file:
            faulthandler.dump_traceback(file)
            file.seek(0)
            return file.read().decode(errors="replace")
    except OSError as error:
        return f"the state of the threads is unavailable: {error}"
