"""Watch the log of a soak from processes of their own, so that no sender waits for the reading.

One process reads every finished part. The other follows the growing part by the headers of its chunks and notes how old
messages are when they can be read, which is when `swath live` and the status line see them. `benchmarks.soak` runs
this; it has no command of its own.
"""

from __future__ import annotations

import multiprocessing
import os
import struct
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from benchmarks.soak.log import Found, is_finished
from swath.daemon.log.mcap.scan import OP_CHUNK
from swath.daemon.log.parts import read_sign

POLL_S = 0.005
FAR_S = 5.0  # a chunk is this old only if the clock was set
NICE = 10  # niceness of the reader, so that senders and recorder come first
_HEAD, _SPAN, _MAGIC_BYTES = struct.Struct("<BQ"), struct.Struct("<QQ"), 8


class Watcher:
    """A process that watches a directory until it is asked for what it found."""

    def __init__(self, look: Callable[[Path, bool, Connection], None], directory: Path, *, keep: bool = False) -> None:
        context = multiprocessing.get_context("spawn")
        self._ours, theirs = context.Pipe()
        self._process = context.Process(target=look, args=(directory, keep, theirs), daemon=True)
        self._process.start()

    def found(self) -> Any:
        """Stop the process and return what it found.

        Raises:
            EOFError: the process has failed.
        """
        self._ours.send(None)
        found = self._ours.recv()
        self._process.join()
        return found


def read_parts(directory: Path, keep: bool, ask: Connection) -> None:
    """Read each part once it is finished, and remove it unless parts are kept.

    When asked, reads the last part too and sends what was found.
    """
    os.nice(NICE)
    found, asked = Found(), False
    while not asked:
        asked = ask.poll(1.0)
        sign = read_sign(directory)
        paths = sorted(directory.glob("*.mcap"), key=lambda path: int(path.stem.rpartition("_")[2]))
        for path in paths[found.parts if keep else 0 :]:
            if (sign is not None and path == sign.path) or not is_finished(path):
                break
            found.read(path)
            if not keep:
                path.unlink()
    ask.send(found.without_parsers())


def note_ages(directory: Path, keep: bool, ask: Connection) -> None:
    """Record the age of each chunk's oldest message when the chunk is first seen whole.

    When asked, sends a list of times and ages: seconds since the beginning, seconds.
    """
    ages: list[tuple[float, float]] = []
    begun_s, path, file, at = time.monotonic(), Path(), -1, 0
    while not ask.poll(POLL_S):
        sign = read_sign(directory)
        if sign is not None and sign.path != path:
            if file >= 0:
                _chunks_from(file, at, begun_s, ages)
                os.close(file)
            try:
                path, file, at = sign.path, os.open(sign.path, os.O_RDONLY), _MAGIC_BYTES
            except OSError:
                continue
        if file >= 0:
            at = _chunks_from(file, at, begun_s, ages)
    if file >= 0:
        os.close(file)
    ask.send(ages)


def _chunks_from(file: int, at: int, begun_s: float, ages: list[tuple[float, float]]) -> int:
    """Record the ages of the whole chunks after a position, and return the position of the next record."""
    size = os.fstat(file).st_size
    while at + _HEAD.size <= size:
        opcode, length = _HEAD.unpack(os.pread(file, _HEAD.size, at))
        if at + _HEAD.size + length > size:
            break
        if opcode == OP_CHUNK:
            oldest_ns, _ = _SPAN.unpack(os.pread(file, _SPAN.size, at + _HEAD.size))
            ages.append((time.monotonic() - begun_s, (time.time_ns() - oldest_ns) / 1e9))
        at += _HEAD.size + length
    return at
