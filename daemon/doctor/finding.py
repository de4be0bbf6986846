"""The result of a check, and the access to the files that checks read."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path


class Verdict(StrEnum):
    """The severity of a finding."""

    OK = "ok"
    NOTE = "note"  # worth knowing, but costs no data
    WRONG = "wrong"  # would cost data


@dataclass(frozen=True, slots=True)
class Finding:
    """One line of the report.

    Attributes:
        check: name of the check.
        mend: the command or other remedy; "" if there is nothing to do.
    """

    check: str
    verdict: Verdict
    text: str
    mend: str = ""


def read_text(path: Path) -> str | None:
    """Return the text of a small file without surrounding blanks; None if it cannot be read."""
    try:
        return path.read_text(errors="replace").strip()
    except OSError:
        return None


@dataclass(frozen=True, slots=True)
class Tree:
    """The file tree of a computer: the real one, or one made for tests."""

    root: Path = Path("/")

    def at(self, path: str | Path) -> Path:
        """Return the path in this tree of an absolute path of the computer."""
        return self.root / str(path).lstrip("/")

    def read(self, path: str | Path) -> str | None:
        """Return a file's text as `read_text` gives it."""
        return read_text(self.at(path))

    def number(self, path: str | Path) -> int | None:
        """Read a file that holds a whole number; return None if it does not."""
        try:
            return int(self.read(path) or "")
        except ValueError:
            return None

    def processes(self) -> set[str]:
        """Return the names of the running programs, as far as this user may see them."""
        names = map(read_text, self.at("/proc").glob("[0-9]*/comm"))
        return {name for name in names if name}
