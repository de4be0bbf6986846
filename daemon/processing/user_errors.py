"""What a job of the office could not do, as one line for its user: the same way for every command."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from swath.daemon.errors import ExitCode, UserError
from swath.daemon.log.format import LogError


@contextmanager
def as_user_error(place: Path, *refused: type[Exception]) -> Iterator[None]:
    """Whatever is raised within becomes a UserError.

    Args:
        place: what an error of the system is about, where it names no file.
        refused: errors whose text is for the user as it stands.

    Raises:
        UserError: the job cannot be done; a log or a file that cannot be read or written has an exit code of its own.
    """
    try:
        yield
    except refused as error:
        raise UserError(str(error)) from error
    except LogError as error:
        raise UserError(str(error), ExitCode.IO) from error
    except OSError as error:
        raise UserError(f"{error.filename or place}: {error.strerror or error}", ExitCode.IO) from error


def finite(value: Any) -> Any:
    """Return the value with null for every number that is none, in lists and tables too."""
    if isinstance(value, dict):
        return {key: finite(one) for key, one in value.items()}
    if isinstance(value, list):
        return [finite(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
