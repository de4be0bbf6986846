"""Lets finished logs grow again, at their own pace, so that the console and live show them as in flight."""

from __future__ import annotations

import fcntl
import json
import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

from swath.daemon.log.parts import RECORDING_SIGN
from swath.daemon.log.reader import Session

_HEAD = struct.Struct("<BQ")
_TIMES = struct.Struct("<QQ")
_CHUNK = 0x06
MAGIC_BYTES = 8
POLL_S = 0.1
LONGEST_WAIT_S = 5.0  # of pauses in a log, such as between two sessions


class GrowingCopy(threading.Thread):
    """Copies a session's parts into a folder, each chunk when its time has come.

    Args:
        session: session from `open_logs`.
        folder: empty folder, which then looks as if a recorder of another computer wrote there.
        pace: times as fast as it was.
        is_ready: asked before the second chunk is copied, until it returns True: live may have to compile first.
    """

    def __init__(self, session: Session, folder: Path, pace: float, is_ready: Callable[[], bool]) -> None:
        super().__init__(name="growing copy", daemon=True)
        self._session, self._folder, self._pace, self._is_ready = session, folder, pace, is_ready
        self._ended = threading.Event()
        self._clock: tuple[float, int] | None = None  # monotonic time and log time of the chunk before

    def run(self) -> None:
        """Copy until the end or `close`."""
        for part in self._session.parts:
            target = self._folder / part.path.name
            with target.open("ab", buffering=0) as file:
                fcntl.flock(file, fcntl.LOCK_EX)  # as a recorder does, by which readers know that one writes
                for number, data in enumerate(self._pieces(part.path)):
                    if self._ended.is_set():
                        return
                    file.write(data)
                    if number == 0:
                        self._sign(part.number, target)
                    while not self._is_ready() and number > 0 and not self._ended.wait(POLL_S):
                        self._clock = None
        with suppress(OSError):
            (self._folder / RECORDING_SIGN).unlink()

    def close(self) -> None:
        """End the copying."""
        self._ended.set()
        if self.is_alive():
            self.join()

    def _sign(self, number: int, path: Path) -> None:
        info = self._session.info
        sign = {"session_id": info.session_id, "part": number, "path": path.name, "boot_id": info.boot_id}
        new = self._folder / (RECORDING_SIGN + ".new")
        new.write_text(json.dumps(sign))
        new.replace(self._folder / RECORDING_SIGN)

    def _pieces(self, path: Path) -> Iterator[bytes]:
        """Yield what stands before the first chunk, then each chunk with what follows it, when its time has come."""
        with path.open("rb") as file:
            data = [file.read(MAGIC_BYTES)]
            while head := file.read(_HEAD.size):
                if len(head) < _HEAD.size:
                    data.append(head)
                    break
                opcode, length = _HEAD.unpack(head)
                if opcode == _CHUNK:
                    yield b"".join(data)
                    data = []
                body = file.read(length)
                if opcode == _CHUNK and len(body) >= _TIMES.size:
                    self._wait(_TIMES.unpack_from(body)[1])
                data += [head, body]
            yield b"".join(data)

    def _wait(self, log_time_ns: int) -> None:
        """Wait as long as there was between this chunk's end and the one before."""
        if self._clock is not None:
            at_s, before_ns = self._clock
            wait_s = min(LONGEST_WAIT_S, (log_time_ns - before_ns) * 1e-9) / self._pace
            if wait_s <= 0.0:
                return
            self._ended.wait(max(0.0, at_s + wait_s - time.monotonic()))
            self._clock = max(time.monotonic() - 1.0, at_s + wait_s), log_time_ns
        else:
            self._clock = time.monotonic(), log_time_ns
