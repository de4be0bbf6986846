"""Where a recorder's things lie, for the commands that talk to one or look at what it writes."""

from __future__ import annotations

import os
from pathlib import Path

from daemon.errors import ExitCode, UserError

DEFAULT_CONFIG = Path("/etc/swath/swath.toml")
CONTROL_LINK = ".swath.control"  # in the log directory: the control socket, or a link to it

_WHO_MAY = "the group of the log directory may (swath, as installed), and root"


def log_directory(where: Path) -> Path:
    """The log directory that a command's CONFIG or DIR means.

    Raises:
        ConfigError: the configuration is wrong.
        UserError: it cannot be read, there is no such log directory, or this user may not look into it.
    """
    from daemon.config import load_config

    try:
        directory = where if where.is_dir() else Path(load_config(where).session.directory)
        if not directory.is_dir():
            raise UserError(f"{directory}: no such directory, so no recorder has written there", ExitCode.IO)
    except PermissionError as error:
        raise UserError(f"{error.filename}: not permitted; {_WHO_MAY}", ExitCode.IO) from error
    if not os.access(directory, os.R_OK | os.X_OK):
        raise UserError(f"{directory}: not permitted; {_WHO_MAY}", ExitCode.IO)
    return directory.absolute()
