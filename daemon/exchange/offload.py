"""Copies finished logs to another disk and proves each copy by reading it back; it deletes and overwrites nothing."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import hashlib
import os
import re
import shutil
import time
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from swath.daemon.errors import ExitCode, UserError
from swath.daemon.log.claim import is_being_written
from swath.daemon.log.durable import sync_directory, try_sync_directory
from swath.daemon.log.format import MAGIC
from swath.daemon.log.parts import read_sign
from swath.daemon.log.reader import RECOVERED
from swath.daemon.system import held_interrupts
from swath.daemon.written import note_rest, note_written

NAME = "SHA256SUMS"
_LINE = re.compile(r"(\\?)([0-9a-f]{64}) [ *](.+)")
_ESCAPES = {"\\\\": "\\", "\\n": "\n", "\\r": "\r"}

PARTIAL = ".partial"
BLOCK_BYTES = 4 << 20
SYNC_BYTES = 64 << 20  # written between two syncs
SAME_TIME_S = 2.0  # a copy keeps its log's time as exactly as its file system can: FAT to two seconds
SIGN_BELIEVED_S = 60.0  # without file locks, a log named as growing counts as growing for so long after its last change
_NO_ROOM = (errno.ENOSPC, errno.EDQUOT)

Progress = Callable[[str, int, int], None]  # name, bytes done, bytes in all, copying and reading back


class CopyDiffersError(Exception):
    """A copy that was read back, or that existed already, differs from the log; the message is one line."""


class NoRoomError(Exception):
    """The destination is full; the message is one line."""


@dataclass(slots=True)
class Copied:
    """A log whose copy has been read back.

    Attributes:
        resumed_bytes: number that an earlier, interrupted run had copied.
    """

    name: str
    bytes: int
    sha256: str
    resumed_bytes: int


@dataclass(slots=True)
class OffloadReport:
    """The results of an offload, log by log.

    Attributes:
        there: names of logs whose checked copy existed already.
        recording: names of logs that are being recorded.
        left_open: names of copied logs that a crash left open and that have not been repaired.
        deletable: logs whose copies were read back and agreed.
        differ, failed: lines, one for each log.
        stopped: the reason why the remaining logs were skipped; "" if none were.
    """

    directory: Path
    destination: Path
    copied: list[Copied] = field(default_factory=list)
    there: list[str] = field(default_factory=list)
    recording: list[str] = field(default_factory=list)
    left_open: list[str] = field(default_factory=list)
    deletable: list[Path] = field(default_factory=list)
    differ: list[str] = field(default_factory=list)
    failed: list[str] = field(default_factory=list)
    stopped: str = ""

    def plain(self) -> dict[str, Any]:
        """Return the report as plain values for ``--json``."""
        return {
            "directory": str(self.directory),
            "destination": str(self.destination),
            "copied": [
                {"name": one.name, "bytes": one.bytes, "sha256": one.sha256, "resumed_bytes": one.resumed_bytes}
                for one in self.copied
            ],
            "there": self.there,
            "recording": self.recording,
            "left_open": self.left_open,
            "may_be_deleted": [str(path) for path in self.deletable],
            "differ": self.differ,
            "failed": self.failed,
            "stopped": self.stopped or None,
        }


def offload(
    directory: Path,
    destination: Path,
    *,
    verify: bool = False,
    same_disk: bool = False,
    progress: Progress | None = None,
) -> Generator[OffloadReport, None, None]:
    """Copy log after log; yield the growing report after each.

    Args:
        directory: of the logs.
        destination: an existing folder, on another disk.
        verify: read existing copies again.
        same_disk: allow a destination on the logs' own disk.
        progress: called with the progress of each log.

    Raises:
        UserError: the destination cannot be used, or another run is at work there.
    """
    report = OffloadReport(directory, destination)
    with _taken(directory, destination, same_disk):
        sums = _sums_of(destination)
        for path in sorted(directory.glob("*.mcap")):
            if is_growing(path):
                report.recording.append(path.name)
            else:
                _offload_one(path, report, sums, verify, progress or _nothing)
            yield report
            if report.stopped:
                return


def _sums_of(destination: Path) -> ChecksumList:
    try:
        return ChecksumList(destination)
    except OSError as error:
        text = f"{destination / NAME}: {error.strerror}; choose another folder, or run this as its owner"
        raise UserError(text, ExitCode.IO) from error


def _nothing(name: str, done: int, total: int) -> None:
    """Ignore the progress."""


@contextlib.contextmanager
def _taken(directory: Path, destination: Path, same_disk: bool) -> Iterator[None]:
    """Check the destination and lock it against other runs for the duration of the block."""
    if not destination.is_dir():
        raise UserError(f"{destination}: no such directory; check that the disk is mounted", ExitCode.IO)
    if destination.samefile(directory):
        raise UserError(f"{destination}: is the log directory itself; choose a folder on another disk", ExitCode.USAGE)
    if not same_disk and destination.stat().st_dev == directory.stat().st_dev:
        # if the other disk is not mounted, its empty mount point looks like the disk
        text = f"{destination}: is on the same disk as {directory}; check that the other disk is mounted"
        raise UserError(f"{text}, or use --same-disk", ExitCode.IO)
    if not os.access(destination, os.R_OK | os.W_OK | os.X_OK):
        raise UserError(
            f"{destination}: cannot be written; check its permissions and that it is not mounted read-only", ExitCode.IO
        )
    folder = os.open(destination, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        with contextlib.suppress(OSError):  # some file systems have no locks
            try:
                fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise UserError(
                    f"{destination}: another swath offload is running there; wait until it ends", ExitCode.IO
                ) from None
        yield
    finally:
        os.close(folder)


def is_growing(path: Path) -> bool:
    """Return whether a log is being recorded."""
    if is_being_written(path):
        return True
    sign = read_sign(path.parent)
    if sign is None or sign.path != path:
        return False
    with contextlib.suppress(FileNotFoundError):
        return time.time() - path.stat().st_mtime < SIGN_BELIEVED_S
    return False


def _offload_one(path: Path, report: OffloadReport, sums: ChecksumList, verify: bool, progress: Progress) -> None:
    try:
        if (report.destination / path.name).exists():
            _check_there(path, report, sums, verify, progress)
        else:
            _copy_new(path, report, sums, progress)
        left_open = _is_left_open(path)
    except CopyDiffersError as error:
        report.differ.append(str(error))
    except NoRoomError as error:
        report.stopped = str(error)
    except OSError as error:
        report.failed.append(f"{error.filename or path}: {error.strerror or error}")
    else:
        report.deletable.append(path)
        if left_open:
            report.left_open.append(path.name)


def _is_left_open(path: Path) -> bool:
    with path.open("rb") as file:
        file.seek(max(0, path.stat().st_size - len(MAGIC)))
        repaired = path.with_name(path.name.removesuffix(".mcap") + RECOVERED).exists()
        return file.read() != MAGIC and not repaired


def _check_there(path: Path, report: OffloadReport, sums: ChecksumList, verify: bool, progress: Progress) -> None:
    """Accept an existing copy: it was read back when it was made, or is compared now.

    A copy with another time may be a copy of an older log of this name, for example of a repeated import.
    """
    copy, size = report.destination / path.name, path.stat().st_size
    known = sums.sums.get(path.name)
    differs = CopyDiffersError(f"{copy}: already exists and differs from {path}; it was not overwritten")
    if copy.stat().st_size != size:
        raise differs
    if known is None or verify or abs(copy.stat().st_mtime - path.stat().st_mtime) > SAME_TIME_S:
        digest = digest_of(path, lambda done: progress(path.name, done, 2 * size))
        if digest_of(copy, lambda done: progress(path.name, size + done, 2 * size)) != digest:
            raise differs
        if known != digest:
            sums.add(path.name, digest)
    report.there.append(path.name)


def _copy_new(path: Path, report: OffloadReport, sums: ChecksumList, progress: Progress) -> None:
    copy, size = report.destination / path.name, path.stat().st_size
    partial = copy.with_name(copy.name + PARTIAL)
    note_rest(f"{partial} stays, and the same command continues from there")
    had = partial.stat().st_size if partial.exists() else 0
    free = shutil.disk_usage(report.destination).free
    if free < size - had:
        raise NoRoomError(_no_room(report, path, size - had, free))
    try:
        digest, resumed = _copy_and_read_back(path, partial, progress)
    except OSError as error:
        if error.errno not in _NO_ROOM:
            raise
        raise NoRoomError(_no_room(report, path, size, shutil.disk_usage(report.destination).free)) from error
    times = path.stat()
    os.utime(partial, ns=(times.st_atime_ns, times.st_mtime_ns))
    with held_interrupts():
        partial.rename(copy)
        note_rest("")
        note_written(copy)
        try_sync_directory(report.destination)
        sums.add(path.name, digest)
    report.copied.append(Copied(path.name, size, digest, resumed))


def _no_room(report: OffloadReport, path: Path, needed: int, free: int) -> str:
    room = f"{path.name} needs {needed / 1e6:,.0f} MB, {free / 1e6:,.0f} MB are free"
    return (
        f"{report.destination}: no space left: {room}; "
        "free some space or use another disk; the same command continues from here"
    )


def _copy_and_read_back(path: Path, partial: Path, progress: Progress) -> tuple[str, int]:
    """Copy a log and read it back; wrong bytes left by an interruption are copied again.

    Returns:
        SHA-256 of the log, and the number of bytes that an earlier run had copied.
    """
    digest, resumed = _copy(path, partial, progress)
    size = path.stat().st_size
    for had in (resumed, 0):
        if digest_of(partial, lambda done: progress(path.name, size + done, 2 * size)) == digest:
            return digest, had
        partial.unlink()
        if not had:
            break
        digest, _ = _copy(path, partial, progress)
    raise CopyDiffersError(f"{partial}: the data read back differ from the data written; do not trust this disk")


def _copy(path: Path, partial: Path, progress: Progress) -> tuple[str, int]:
    """Copy the bytes that the partial copy lacks; the checksum covers the whole log."""
    target = os.open(partial, os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC, 0o640)
    try:
        with path.open("rb", buffering=0) as source:
            size = os.fstat(source.fileno()).st_size
            had = min(os.fstat(target).st_size, size)
            os.ftruncate(target, had)
            digest, at = hashlib.sha256(), 0
            for block in _blocks(source.fileno()):
                digest.update(block)
                if at + len(block) > had:
                    _write(target, block[max(0, had - at) :], max(at, had))
                at += len(block)
                progress(path.name, at, 2 * size)
                if at % SYNC_BYTES == 0:
                    _let_go(target)
            _let_go(target)
            os.fsync(target)
    finally:
        os.close(target)
    if at != size:
        raise OSError(errno.EIO, f"{at} bytes were read instead of {size}", str(path))
    return digest.hexdigest(), had


def _write(fd: int, data: bytes, at: int) -> None:
    while data:
        written = os.pwrite(fd, data, at)
        data, at = data[written:], at + written


def _let_go(fd: int) -> None:
    """Sync the written data and release its memory, so that it does not push the recorder's data out of the
    page cache.
    """
    os.fdatasync(fd)
    os.posix_fadvise(fd, 0, 0, os.POSIX_FADV_DONTNEED)


def _blocks(fd: int) -> Iterator[bytes]:
    """Yield a file in blocks and release the memory of each block after its use."""
    at = 0
    while block := os.pread(fd, BLOCK_BYTES, at):
        yield block
        os.posix_fadvise(fd, at, len(block), os.POSIX_FADV_DONTNEED)
        at += len(block)


def digest_of(path: Path, progress: Callable[[int], None]) -> str:
    """Return the SHA-256 of a file as stored on the disk; cached pages of it are dropped first. Raises OSError."""
    digest, done = hashlib.sha256(), 0
    with path.open("rb", buffering=0) as file:
        os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)
        for block in _blocks(file.fileno()):
            digest.update(block)
            done += len(block)
            progress(done)
    return digest.hexdigest()


class ChecksumList:
    """The checksum file of a folder; lines that belong to other files are kept unchanged.

    Attributes:
        sums: hexadecimal SHA-256 by file name.
    """

    def __init__(self, folder: Path) -> None:
        """Read the list if it exists; raises OSError."""
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
        """Add a file's sum and make the list durable; the list on disk is whole at every moment. Raises OSError."""
        line = _line(name, digest)
        self._lines = [old for old in self._lines if not _speaks_of(old, name)] + [line]
        self.sums[name] = digest
        new = self.path.with_name(f"{NAME}.new")
        with new.open("w", errors="surrogateescape") as file:
            file.write("".join(f"{line}\n" for line in self._lines))
            file.flush()
            os.fsync(file.fileno())
        new.replace(self.path)
        with contextlib.suppress(OSError):  # some file systems do not sync directories
            sync_directory(self.path.parent)


def _line(name: str, digest: str) -> str:
    """Format a line as coreutils does: a name with a backslash or an end of line is escaped, and the line begins with a
    backslash.
    """
    escaped = name.replace("\\", "\\\\").replace("\n", "\\n").replace("\r", "\\r")
    return f"{'' if escaped == name else chr(92)}{digest}  {escaped}"


def _plain(escaped: str) -> str:
    return re.sub(r"\\[\\nr]", lambda found: _ESCAPES[found.group()], escaped)


def _speaks_of(line: str, name: str) -> bool:
    found = _LINE.fullmatch(line)
    return found is not None and (_plain(found.group(3)) if found.group(1) else found.group(3)) == name
