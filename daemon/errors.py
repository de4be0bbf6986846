"""Defines the errors that a user can mend, one line each, and the exit codes of every command."""

from __future__ import annotations

import re
from enum import IntEnum

_CONTROL = re.compile(r"[\x00-\x1f\x7f-\x9f\u2028\u2029]+")


class ExitCode(IntEnum):
    """Exit status of a command."""

    OK = 0
    PROBLEM = 1  # the job ran and found a problem
    USAGE = 2  # wrong configuration or wrong use
    IO = 3  # cannot read or write: no such file, log directory not writable
    DAMAGE = 4  # data is damaged


class SwathError(Exception):
    """The base of every error that Swath raises for its user; the text is what a command prints."""


class UserError(SwathError):
    """An error that the user can mend; it is printed as ``swath: <message>``, each line of the message separately."""

    def __init__(self, message: str, exit_code: ExitCode = ExitCode.PROBLEM) -> None:
        super().__init__(message)
        self.message = message
        self.exit_code = exit_code


class ConfigError(UserError):
    """An error in the configuration; each line names the file, the key, the value found and a correct value."""

    def __init__(self, lines: str | list[str]) -> None:
        self.lines = [one_line(line) for line in ([lines] if isinstance(lines, str) else lines)]
        super().__init__("\n".join(self.lines), ExitCode.USAGE)


def one_line(text: str) -> str:
    """Return a text of any origin as one line without control characters, so that every terminal and file
    accepts it.
    """
    return _CONTROL.sub(" ", text).encode("utf-8", "backslashreplace").decode()  # half a surrogate pair has no bytes
