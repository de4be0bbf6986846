"""What a check finds, and the files it looks at."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path


class Verdict(StrEnum):
    """How much a finding matters."""

    OK = "ok"
    NOTE = "note"  # worth knowing; no data is lost by it
    WRONG = "wrong"  # would cost data


@dataclass(frozen=True, slots=True)
class Finding:
    """One line of the report.

    Attributes:
        check: what was looked at.
        mend: the command, or what else to do; "" where nothing is to be done.
    """

    check: str
    verdict: Verdict
    text: str
    mend: str = ""


def read_text(path: Path) -> str | None:
    """Return a small file's text without blanks at its ends; None where it cannot be read."""
    try:
        return path.read_text(errors="replace").strip()
    except OSError:
        return None


@dataclass(frozen=True, slots=True)
class Tree:
    """The files of a computer: its own, or a made one."""

    root: Path = Path("/")

    def at(self, path: str | Path) -> Path:
        """Return an absolute path of the computer."""
        return self.root / str(path).lstrip("/")

    def read(self, path: str | Path) -> str | None:
        """Return a file's text as `read_text` gives it."""
        return read_text(self.at(path))

    def number(self, path: str | Path) -> int | None:
        """Return a file that holds a whole number; None where it does not."""
        try:
            return int(self.read(path) or "")
        except ValueError:
            return None

    def processes(self) -> set[str]:
        """Return names of the programs that run, as far as this user may see them."""
        names = map(read_text, self.at("/proc").glob("[0-9]*/comm"))
        return {name for name in names if name}
