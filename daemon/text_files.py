"""Text files that users name: read alike everywhere, in UTF-8 or what their byte order mark says."""

from __future__ import annotations

from pathlib import Path

from swath.daemon.errors import ExitCode, UserError
from swath.georef.text_encoding import encoding_of


def text_of(path: Path, want: str = "a CSV file") -> str:
    """Return the text of a file that is to be such a one.

    Raises:
        UserError: it cannot be read, or is no text.
    """
    try:
        with path.open("rb") as stream:
            encoding = encoding_of(stream.read(4))
        return path.read_text(encoding=encoding)
    except (OSError, UnicodeError) as error:
        why = (error.strerror if isinstance(error, OSError) else None) or f"no text; want {want}"
        raise UserError(f"{path}: cannot be read: {why}", ExitCode.IO) from error
