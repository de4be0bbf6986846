"""A list of SHA-256 sums beside the files it speaks of, as sha256sum(1) of coreutils writes and checks it."""

from __future__ import annotations

import contextlib
import os
import re
from pathlib import Path

from swath.daemon.log.durable import sync_directory

NAME = "SHA256SUMS"
_LINE = re.compile(r"(\\?)([0-9a-f]{64}) [ *](.+)")
_ESCAPES = {"\\\\": "\\", "\\n": "\n", "\\r": "\r"}


class ChecksumList:
    """The sums of a folder; lines of others that it holds are kept as they are.

    Attributes:
        sums: hexadecimal SHA-256 by name of the file.
    """

    def __init__(self, folder: Path) -> None:
        """Read it, if it is there; raises OSError."""
        self.path = folder / NAME
        self.sums: dict[str, str] = {}
        self._lines: list[str] = []
        with contextlib.suppress(FileNotFoundError):
            self._lines = self.path.read_text(errors="surrogateescape").splitlines()
        for line in self._lines:
            if (found := _LINE.fullmatch(line)) is not None:
                escaped, digest, name = found.groups()
                self.sums[_plain(name) if escaped else name] = digest

    def add(self, name: str, digest: str) -> None:
        """Add a file's sum and make the list durable; the list on disk is always whole. Raises OSError."""
        line = _line(name, digest)
        self._lines = [old for old in self._lines if not _speaks_of(old, name)] + [line]
        self.sums[name] = digest
        new = self.path.with_name(f"{NAME}.new")
        with new.open("w", errors="surrogateescape") as file:
            file.write("".join(f"{line}\n" for line in self._lines))
            file.flush()
            os.fsync(file.fileno())
        new.replace(self.path)
        with contextlib.suppress(OSError):  # not every file system syncs directories
            sync_directory(self.path.parent)


def _line(name: str, digest: str) -> str:
    """coreutils: a name with a backslash or an end of line is escaped, and the line begins with a backslash."""
    escaped = name.replace("\\", "\\\\").replace("\n", "\\n").replace("\r", "\\r")
    return f"{'' if escaped == name else chr(92)}{digest}  {escaped}"


def _plain(escaped: str) -> str:
    return re.sub(r"\\[\\nr]", lambda found: _ESCAPES[found.group()], escaped)


def _speaks_of(line: str, name: str) -> bool:
    found = _LINE.fullmatch(line)
    return found is not None and (_plain(found.group(3)) if found.group(1) else found.group(3)) == name
