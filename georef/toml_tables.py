"""Read TOML as tables, refusing in one line also the errors that the standard library's reader lets pass."""

from __future__ import annotations

import json
import re
import tomllib
from typing import Any

DEEPEST = 32  # tables within tables; the project's files have at most 5
LEAST, MOST = -(1 << 63), (1 << 63) - 1  # TOML 1.0.0, Integer: 64 bits are expected, and a loss is an error
_BARE = re.compile(r"[A-Za-z0-9_-]+")
# JSON leaves these as they are, but TOML forbids the first ones, and the others break a line
_NOT_SHOWN = re.compile(r"[\x7f-\x9f\u2028\u2029]")


class TomlError(ValueError):
    """Raised for text that is not TOML, or is beyond the limits; one line without the file's name."""


def toml_tables(text: str) -> dict[str, Any]:
    """Return the tables of a TOML text: numbers of 64 bits, at most `DEEPEST` deep.

    Raises:
        TomlError: names the fault in one line.
    """
    try:
        document = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise TomlError(f"not TOML: {' '.join(str(error).split())}") from error
    except RecursionError as error:
        raise TomlError(f"not readable: nested too deeply; nest tables at most {DEEPEST} deep") from error
    except ValueError as error:  # more digits than Python converts to a number
        raise TomlError("a whole number of thousands of digits; use numbers of 64 bits") from error
    waiting: list[tuple[Any, str, int]] = [(document, "", 0)]
    while waiting:
        value, where, depth = waiting.pop()
        if depth > DEEPEST:
            raise TomlError(f"{where[:40]}…: nested too deeply; nest tables at most {DEEPEST} deep")
        if isinstance(value, dict):
            waiting += [
                (one, f"{where}.{key_text(key)}" if where else key_text(key), depth + 1) for key, one in value.items()
            ]
        elif isinstance(value, list):
            waiting += [(one, where, depth + 1) for one in value]
        elif isinstance(value, int) and not LEAST <= value <= MOST:
            raise TomlError(f"{where}: a whole number of {value.bit_length()} bits; use numbers of 64 bits")
    return document


def key_text(key: str) -> str:
    """Return a key as TOML writes it: bare, or in quotes on one line."""
    if _BARE.fullmatch(key):
        return key
    return _NOT_SHOWN.sub(lambda found: f"\\u{ord(found[0]):04x}", json.dumps(key, ensure_ascii=False))
