"""Changes texts: a word is replaced by one that troubles readers, lines are doubled, removed or damaged."""

from __future__ import annotations

import random
import re
import tempfile
from collections.abc import Callable, Iterable
from pathlib import Path

from swath.daemon.errors import UserError
from tests.fuzz.engine import FindingError, Target
from tests.fuzz.mutation import damage

LARGEST_TEXT_BYTES = 64 * 1024
NUMBERS = (
    *("0", "-0", "-1", "1", "1e-320", "1e-200", "1e200", "-1e308", "1e999", "nan", "-inf", "1_0", "9" * 30),
    *("9" * 5000, "0x10", "65536", str(1 << 31), str(1 << 63), str((1 << 63) - 1), str(-(1 << 63)), "604800", "1.5e18"),
)
OF_CSV = ('"', '"a\nb"', '"a\vb"', "", "#", "\x00", "\ufeff", "é", "x" * 300, "0", "٣", "²", "\u2028")
OF_TOML = (
    *("[]", "{}", '""', '"a\\nb"', '"\\u0000"', "true", "[[[[1]]]]", "[1, 'x']", "[nan]", "[true]", "{ a = 1 }"),
    *("1979-05-27", "0001-01-01T00:00:00+14:00", "9999-12-31T23:59:59-14:00", "07:32:00", "[" * 3000, "{a=" * 500),
    *("a." * 60 + "b", "'''\n'''"),
)
OF_JSON = (
    *("[]", "{}", '""', '"a\\nb"', '"\\u0000"', "true", "null", "NaN", "Infinity", "-Infinity", "[[1]]", '{"a": 1}'),
    *("[" * 20000, '{"a":' * 400, '"\\ud800"', '"/"', '".."'),
)
_BETWEEN = re.compile(rb"([\s,;=()\[\]{}:]+)")
_VARYING = re.compile(r"\S*[0-9'\"`]\S*")


def changed_text(rng: random.Random, base: bytes, words: tuple[str, ...]) -> bytes:
    """Make one to three changes, mostly of a word."""
    if rng.random() < 0.15:
        return damage(rng, base)
    lines = base.split(b"\n")
    for _ in range(rng.randrange(1, 4)):
        at, kind = rng.randrange(len(lines)), rng.randrange(10)
        if kind < 6:
            pieces = _BETWEEN.split(lines[at])
            pieces[2 * rng.randrange((len(pieces) + 1) // 2)] = rng.choice(words).encode()
            lines[at] = b"".join(pieces)
        elif kind == 6:
            lines.insert(rng.randrange(len(lines) + 1), lines[at])
        elif kind == 7 and len(lines) > 1:
            del lines[at]
        elif kind == 8:
            lines[at] = damage(rng, lines[at])
        else:
            other = rng.randrange(len(lines))
            lines[at], lines[other] = lines[other], lines[at]
    return b"\n".join(lines)[:LARGEST_TEXT_BYTES]


def told(read: Callable[[], Iterable[str]], *refusals: type[Exception], begins: str = "") -> set[str]:
    """Return what was seen, or the beginning of a refusal.

    Args:
        read: reads the text as the command does.
        refusals: errors that the command reports in a line.
        begins: how each of several lines must begin if the reader reports every mistake; empty: only one line.

    Raises:
        FindingError: if a refusal has several lines or none.
    """
    try:
        return set(read())
    except UserError as error:
        message = error.message
    except refusals as error:
        message = str(error)
    lines = message.splitlines()
    if len(lines) != 1 and not (lines and begins and all(line.startswith(begins) for line in lines)):
        raise FindingError(f"not a line a mistake: {message!r}")
    return {" ".join(_VARYING.sub("", line.removeprefix(begins)[:300]).split())[:60] for line in lines}


def text_target(
    name: str,
    seeds: list[bytes],
    words: tuple[str, ...],
    read: Callable[[Path], Iterable[str]],
    *refusals: type[Exception],
    mistakes_a_line: bool = False,
) -> Target:
    """Return the target of a reader of a text file.

    Args:
        name: name of the target and of the file.
        seeds, words: see `changed_text`.
        read: reads the file at a path.
        refusals: as in `told`.
        mistakes_a_line: True if the reader documents one line for each mistake, with the file's name before it.
    """

    def run(data: bytes) -> Iterable[str]:
        with tempfile.TemporaryDirectory(prefix="swath-fuzz-") as folder:
            path = Path(folder, name)
            path.write_bytes(data)
            return told(lambda: read(path), *refusals, begins=f"{path}: " if mistakes_a_line else "")

    return Target(name, seeds, lambda rng, base: changed_text(rng, base, words), run)
