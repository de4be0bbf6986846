"""Writes result files completely or not at all, and describes them."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import IO

from swath.daemon.errors import UserError, one_line
from swath.daemon.log.durable import sync_file, try_sync_directory
from swath.daemon.system import held_interrupts
from swath.daemon.written import ASIDE, PARTIAL, make_folder, note_needed, note_written

LONGEST_NAME = 200  # bytes of a session's name at most; its products' names are longer

_HASH_BLOCK = 1 << 20


def write_aside(path: Path, write: Callable[[IO[bytes]], None]) -> Path:
    """Write a file beside its final place and return the path of this temporary file.

    Raises:
        OSError: the file cannot be written; no temporary file is left.
    """
    make_folder(path.parent)
    aside = path.with_name(path.name + PARTIAL)
    try:
        with aside.open("wb") as stream:
            write(stream)
            stream.flush()
            os.fsync(stream.fileno())
    except BaseException:  # an interrupt too
        aside.unlink(missing_ok=True)
        raise
    return aside


def put_in_place(written: list[tuple[Path, Path]], gone: Iterable[Path] = ()) -> None:
    """Rename temporary files to their final names, in the order given, and sync the folders to disk.

    An interrupt waits until all are renamed, and files of an earlier run that are ``gone`` now are removed.

    Raises:
        OSError: a file cannot be renamed; no temporary file is left.
    """
    with gone_on_failure(written), held_interrupts():
        for aside, path in written:
            aside.replace(path)
            note_written(path)
        for path in set(gone) - {path for _, path in written}:
            path.unlink(missing_ok=True)
    for folder in dict.fromkeys(path.parent for _, path in written):
        try_sync_directory(folder)


def write_whole(files: Mapping[Path, bytes]) -> None:
    """Write files, each to a temporary file first; rename them only when all are written.

    Raises:
        OSError: a file cannot be written or renamed; no temporary file is left.
    """
    written: list[tuple[Path, Path]] = []
    note_needed(sum(map(len, files.values())))
    with gone_on_failure(written):
        for path, data in files.items():
            written.append((write_aside(path, partial(_put, data)), path))
    put_in_place(written)


@contextmanager
def aside_folder(folder: Path, gone: Iterable[Path] = ()) -> Iterator[Path]:
    """Give a hidden folder for files; when the block ends, all of them get their places in ``folder`` at once.

    If the block fails or is interrupted, nothing of it is left. Files of an earlier run that are ``gone`` and not made
    anew are removed.

    Raises:
        OSError: the folder cannot be written to.
    """
    make_folder(folder)
    with TemporaryDirectory(prefix=ASIDE, dir=folder) as name:
        yield Path(name)
        made = sorted(path for path in Path(name).iterdir() if path.is_file())
        for path in made:
            sync_file(path)
        put_in_place([(path, folder / path.name) for path in made], gone)


def _put(data: bytes, stream: IO[bytes]) -> None:
    stream.write(data)


@contextmanager
def gone_on_failure(written: list[tuple[Path, Path]]) -> Iterator[None]:
    """Remove the temporary files if the block fails or is interrupted."""
    try:
        yield
    except BaseException:
        remove(written)
        raise


def remove(written: list[tuple[Path, Path]]) -> None:
    """Remove temporary files whose job failed."""
    for aside, _ in written:
        with suppress(OSError):
            aside.unlink(missing_ok=True)


def sha256_of(path: Path, given_up: Callable[[], bool] = lambda: False) -> str:
    """Return the SHA-256 of a file; if ``given_up`` returns True meanwhile, of the part read so far.

    Raises:
        OSError: the file cannot be read.
    """
    with path.open("rb") as file:
        digest = hashlib.sha256()
        while (block := file.read(_HASH_BLOCK)) and not given_up():
            digest.update(block)
    return digest.hexdigest()


def utc_text(time_ns: int) -> str:
    """Return a host time as text in UTC."""
    return datetime.fromtimestamp(time_ns / 1e9, tz=UTC).strftime("%Y-%m-%dT%H:%M:%SZ")


def refuse_no_name(session_id: str, log: Path) -> None:
    """Refuse a session name that is not a plain file name.

    Products are named after the session; a log from elsewhere must not lead out of their folder.

    Raises:
        UserError: the name is not a file name.
    """
    leads = session_id != Path(session_id).name or session_id in ("", ".", "..")
    if leads or not session_id.isprintable() or len(session_id.encode()) > LONGEST_NAME:
        shown = one_line(session_id[:80])
        raise UserError(f'{log}: its session_id "{shown}" is not a valid file name; give a log that Swath recorded')
