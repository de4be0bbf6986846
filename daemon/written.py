"""Keeps account of what this command has written, for the line with which an interrupt or a full disk ends it.

A command is a process that runs once. A program that runs several in one process calls `begin` between them.
"""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

NO_ROOM = (errno.ENOSPC, errno.EDQUOT)
ASIDE = ".swath-"  # beginning of the name of a hidden folder of unfinished files
PARTIAL = ".partial"  # end of the name of an unfinished file
LEAST_SHARE = 0.02  # from which the whole is estimated
FLYING = ".flying"  # end of the name of the folder of an unfinished flight
NAMED = 3  # files that are named; of more, only one and their number

_files: list[Path] = []
_folders: list[Path] = []
_rests: list[str] = []
_needed: list[int] = []
_done: list[str] = []


def begin() -> None:
    """Forget everything: another command begins."""
    for noted in (_files, _folders, _rests, _needed, _done):
        noted.clear()


def note_written(*paths: Path) -> None:
    """Note files or folders that are complete under their final names."""
    _files.extend(path for path in paths if path not in _files)


def note_rest(words: str) -> None:
    """Note in words something incomplete that stays on purpose; an empty text: it no longer does."""
    _rests[:] = [words] if words else []


def note_done(words: str) -> None:
    """Note in words what a command has done whose work is not a file."""
    _done[:] = [words]


def note_needed(size: float) -> None:
    """Note how many bytes the work needs on the disk that is full."""
    _needed[:] = [round(size)]


def make_folder(path: Path) -> None:
    """Make a folder with its parents if it does not exist; it is removed again if the command leaves it empty.

    Raises:
        OSError: it cannot be made.
    """
    missing = [one for one in (path, *path.parents) if not one.exists()]
    try:
        path.mkdir(parents=True, exist_ok=True)
    finally:
        _folders.extend(one for one in reversed(missing) if one.exists())


def remove_empty_folders() -> None:
    """Remove the folders that `make_folder` made, as far as they are empty."""
    while _folders:
        with contextlib.suppress(OSError):  # there is something in it
            _folders.pop().rmdir()


def written_words() -> str:
    """Return in words which files are complete, or what else was done, and what else stays."""
    names = [str(path) for path in _files if path.exists()]
    if len(names) > NAMED:
        names = [names[-1], f"{len(names) - 1} more files"]
    complete = f"complete: {' and '.join(filter(None, (', '.join(names[:-1]), names[-1])))}" if names else ""
    return "; ".join(filter(None, (complete or "".join(_done) or "nothing written", *_rests)))


class Reached:
    """Passes on how much of some work is done, and remembers it for `room_noted`."""

    def __init__(self, progress: Callable[[int, int], None]) -> None:
        self._progress, self._done, self._total = progress, 0, 0

    def __call__(self, done: int, total: int) -> None:
        """Take the amount done and that in all."""
        self._done, self._total = done, total
        self._progress(done, total)

    def share(self) -> float:
        """Return the share done, 0 to 1."""
        return self._done / self._total if self._total else 0.0


@contextlib.contextmanager
def room_noted(folder: Path, share: Callable[[], float]) -> Iterator[None]:
    """Note how much room the block's work needs if the disk gets full: by what it has written and its share done.

    Args:
        folder: where the block writes.
        share: returns the share done, 0 to 1.
    """
    try:
        yield
    except OSError as error:
        if error.errno in NO_ROOM and (done := share()) > LEAST_SHARE:
            note_needed(sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) / done)
        raise


def error_words(error: OSError, place: Path | str) -> str:
    """Return a system error as one line; that of a full disk says what was needed and what stays.

    Args:
        error: the error.
        place: named if the error names no file.
    """
    path = Path(os.fsdecode(error.filename) if isinstance(error.filename, (str, bytes)) else place)
    path = Path(*(part for part in path.parts[:-1] if not _is_aside(part)), path.name.removesuffix(PARTIAL))
    if error.errno not in NO_ROOM:
        return f"{path}: {error.strerror or error}"
    there = next(one for one in (path.absolute(), *path.absolute().parents) if one.exists())
    room = shutil.disk_usage(there)
    needed = f"; about {_mb(_needed[0])} are needed" if _needed else ""
    remedy = "free some space, or choose a folder on another disk"
    if any(one.name.startswith("swath-") and one.parent == Path(tempfile.gettempdir()) for one in path.parents):
        remedy = "free some space, or set TMPDIR to a folder on another disk"
    return (
        f"{path}: no space left on the disk ({_mb(room.free)} free of {_mb(room.total)}){needed}; {written_words()}; "
        f"{remedy}"
    )


def _is_aside(folder: str) -> bool:
    """Return whether a folder holds unfinished files; their final place, which a user knows, is the one around it."""
    return folder.startswith(ASIDE) or folder.endswith((PARTIAL, FLYING))


def _mb(size: int) -> str:
    return f"{size / 1e6:,.0f} MB" if size >= 1e7 or not size else f"{size / 1e6:,.1f} MB"
