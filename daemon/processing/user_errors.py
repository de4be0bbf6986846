"""Turns errors of an office job into one line for its user, in the same way for every command."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from swath.daemon.errors import ExitCode, UserError
from swath.daemon.log.format import LogError
from swath.daemon.written import error_words


@contextmanager
def as_user_error(place: Path, *refused: type[Exception]) -> Iterator[None]:
    """Turn every expected error raised in the block into a `UserError`.

    Args:
        place: named in a system error that names no file.
        refused: errors whose text can be shown to the user unchanged.

    Raises:
        UserError: the job cannot be done; if a log or a file cannot be read or written, with its own exit code.
    """
    try:
        yield
    except refused as error:
        raise UserError(str(error)) from error
    except LogError as error:
        raise UserError(str(error), ExitCode.IO) from error
    except OSError as error:
        raise UserError(error_words(error, place), ExitCode.IO) from error


def finite(value: Any) -> Any:
    """Return the value with None in place of every float that is not finite, in lists and tables too."""
    if isinstance(value, dict):
        return {key: finite(one) for key, one in value.items()}
    if isinstance(value, list):
        return [finite(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
