"""Finds, locks and describes log directories, for commands that talk to a recorder or look at its files."""

from __future__ import annotations

import contextlib
import fcntl
import os
import stat
from pathlib import Path

from swath.daemon.errors import ConfigError, ExitCode, UserError

DEFAULT_CONFIG = Path("/etc/swath/swath.toml")
LOCK = ".swath.lock"  # in the log directory: held while a recorder is at work there
CONTROL_LINK = ".swath.control"  # in the log directory: the control socket, or a link to it

_WHO_MAY = "run this as root or in the group of the log directory (swath, as installed)"
_WANTED = "give the log directory or a configuration file"


def log_directory(where: Path) -> Path:
    """Return the log directory that a command's CONFIG or DIR argument means.

    Raises:
        ConfigError: the configuration is wrong.
        UserError: it cannot be read, there is no such log directory, or this user may not look into it.
    """
    from swath.daemon.config import load_config

    try:
        if not where.exists():
            raise UserError(f"{where}: no such file or directory; {_WANTED}", ExitCode.USAGE)
        directory = where if where.is_dir() else Path(load_config(where).session.directory)
        if not directory.is_dir():
            raise UserError(f"{directory}: no such directory; check the path, or start the recorder first", ExitCode.IO)
    except PermissionError as error:
        raise UserError(f"{error.filename}: not permitted; {_WHO_MAY}", ExitCode.IO) from error
    except OSError as error:  # a sentence given instead of a path can be longer than a file name may be
        raise UserError(f"{where}: {error.strerror}; {_WANTED}", ExitCode.USAGE) from error
    except ConfigError as error:
        if where.suffix == ".toml":
            raise
        raise ConfigError([*error.lines[:-1], f"{error.lines[-1]}; {_WANTED}"]) from error
    if not os.access(directory, os.R_OK | os.X_OK):
        raise UserError(f"{directory}: not permitted; {_WHO_MAY}", ExitCode.IO)
    return directory.absolute()


def nearest_there(directory: Path) -> tuple[Path, bool]:
    """Return the nearest existing folder among a directory and its parents, and whether this user may look into it."""
    permitted = True
    for path in (directory, *directory.parents):
        try:
            path.stat()
        except PermissionError:
            permitted = False
        except OSError:
            continue
        else:
            return path, permitted
    return Path("/"), permitted


def take_directory(directory: Path, key: str = "session.directory") -> int:
    """Create the log directory if necessary and lock it; return the lock's descriptor, which must stay open.

    Args:
        directory: of logs.
        key: the configuration key or option that names the directory, for messages.

    Raises:
        UserError: it cannot be written, or another recorder is at work in it.
    """
    try:
        directory.mkdir(parents=True, exist_ok=True)
        return _lock(directory)
    except BlockingIOError as error:
        text = f"{key} {directory}: another recorder is running there; stop it or choose another directory"
        raise UserError(text, exit_code=ExitCode.IO) from error
    except OSError as error:
        text = f"{key} {directory}: {error.strerror}; choose a directory that user {os.getuid()} may write"
        if os.path.lexists(directory / LOCK) and os.access(directory, os.W_OK | os.X_OK):
            held = "a recording of another user left it; remove it when that recording has ended"
            text = f"{key} {directory}: {directory / LOCK}: {error.strerror}; {held}"
        raise UserError(text, exit_code=ExitCode.IO) from error


def keep_directory(directory: Path, lock: int) -> None:
    """Lock a directory again that was removed and recreated; the descriptor stays the same.

    Raises:
        BlockingIOError: another recorder has locked it first.
        OSError: it cannot be locked.
    """
    with contextlib.suppress(FileNotFoundError):
        if os.path.samestat(os.stat(directory / LOCK), os.fstat(lock)):
            return
    anew = _lock(directory)
    os.dup2(anew, lock, inheritable=False)
    os.close(anew)


def _give_to_owner_of(directory: Path, fd: int) -> None:
    """Give root's lock file to the owner of the directory; the service could otherwise never record there again."""
    own, there = os.fstat(fd), directory.stat()
    if os.geteuid() == 0 and stat.S_ISREG(own.st_mode) and own.st_nlink == 1:  # a hard link may name another file
        with contextlib.suppress(PermissionError):  # some file systems have no owners
            os.fchown(fd, there.st_uid, there.st_gid)


def _lock(directory: Path) -> int:
    lock = os.open(directory / LOCK, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o640)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        _give_to_owner_of(directory, lock)
    except OSError:
        os.close(lock)
        raise
    return lock
