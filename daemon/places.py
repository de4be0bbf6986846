"""Where a recorder's things lie, for the commands that talk to one or look at what it writes."""

from __future__ import annotations

from pathlib import Path

from daemon.errors import ExitCode, UserError

DEFAULT_CONFIG = Path("/etc/swath/swath.toml")
CONTROL_LINK = ".swath.control"  # in the log directory: the control socket, or a link to it


def log_directory(where: Path) -> Path:
    """The log directory that a command's CONFIG or DIR means.

    Raises:
        ConfigError: the configuration is wrong.
        UserError: it cannot be read, or there is no such log directory.
    """
    from daemon.config import load_config

    directory = where if where.is_dir() else Path(load_config(where).session.directory)
    if not directory.is_dir():
        raise UserError(f"{directory}: no such directory, so no recorder has written there", ExitCode.IO)
    return directory.absolute()
