"""Reads text files that the user names, in UTF-8 or the encoding that their byte order mark declares."""

from __future__ import annotations

from pathlib import Path

from swath.daemon.errors import ExitCode, UserError
from swath.georef.text_encoding import encoding_of


def text_of(path: Path, want: str = "a CSV file") -> str:
    """Return the text of a file; ``want`` names the expected kind of file in the error message.

    Raises:
        UserError: the file cannot be read, or is not text.
    """
    try:
        with path.open("rb") as stream:
            encoding = encoding_of(stream.read(4))
        return path.read_text(encoding=encoding)
    except (OSError, UnicodeError) as error:
        why = (error.strerror if isinstance(error, OSError) else None) or f"not text; want {want}"
        raise UserError(f"{path}: cannot be read: {why}", ExitCode.IO) from error
