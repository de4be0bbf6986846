"""Compare the space that a command needs with the space on its folder's disk, before its work begins."""

from __future__ import annotations

import shutil
import sys
import tempfile
from pathlib import Path

from swath.daemon.errors import ExitCode, UserError, one_line
from swath.daemon.log.directory import nearest_there
from swath.daemon.written import note_needed

UNITS = ((1e9, "GB"), (1e6, "MB"), (1e3, "kB"))


def check_space(folder: Path, what: str, *, least_bytes: float, most_bytes: float | None = None) -> None:
    """Refuse a folder whose disk has too little space; warn of one that may have too little.

    Args:
        folder: where files will be written; it need not exist yet.
        what: the files, for people, in the plural.
        least_bytes: what they need at least.
        most_bytes: what they may need, where that is estimated; None: the same.

    Raises:
        UserError: the disk has less than ``least_bytes``.
    """
    note_needed(least_bytes if most_bytes is None else most_bytes)  # for the line of a disk that gets full after all
    there, _ = nearest_there(folder.absolute())
    try:
        free_bytes = shutil.disk_usage(there).free
    except OSError:
        return  # the folder's own errors are reported where it is written
    way = "set TMPDIR to" if there == Path(tempfile.gettempdir()) else "choose"
    remedy = f"make room, or {way} a folder on another disk"
    if free_bytes < least_bytes:
        raise UserError(
            f"{folder}: {what} need {_size(least_bytes)} at least, and {_size(free_bytes)} are free; {remedy}",
            ExitCode.IO,
        )
    if most_bytes is not None and free_bytes < most_bytes:
        line = f"{folder}: {what} may need {_size(most_bytes)}, and {_size(free_bytes)} are free; {remedy}"
        sys.stderr.write(f"swath: {one_line(line)}\n")


def _size(size: float) -> str:
    for unit, name in UNITS:
        if size >= unit:
            return f"{size / unit:,.1f} {name}"
    return f"{size:.0f} bytes"
