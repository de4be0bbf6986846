"""Finds files of an earlier run: those that a command refuses to replace, and those that would describe other data.

A page's record names its own files (``files``) and, for pages about points, the files of points that it shows (``of``).
Only files that a record names are removed, never others.
"""

from __future__ import annotations

import json
import os
from collections.abc import Collection, Iterable
from pathlib import Path
from typing import Any

from swath.daemon.errors import ExitCode, UserError

POINT_PAGES = ("view.json", "strips.json")  # records of pages that show points
MOST_BYTES = 64 << 20  # a larger file is no record


def refuse_existing(paths: Iterable[Path], *, overwrite: bool, instead: str = "folder") -> None:
    """Refuse to replace files of an earlier run unless the user allows it.

    Args:
        paths: files that would be replaced.
        overwrite: replace them.
        instead: what the user may choose otherwise.

    Raises:
        UserError: one exists.
    """
    for path in paths:
        if not overwrite and os.path.lexists(path):
            raise UserError(f"{path}: already exists; choose another {instead} or use --overwrite", ExitCode.USAGE)


def relative_to(folder: Path, files: Iterable[Path]) -> list[str]:
    """Return the paths of files as seen from a folder, for ``of``: they stay right when all are moved together."""
    return [os.path.relpath(file.resolve(), folder.resolve()) for file in files]


def listed_files(record: Path) -> list[Path]:
    """Return the files beside a record that it names as made with it, without the record; [] if there is no record."""
    names = {Path(name).name for name in _texts(_read(record), "files")}
    beside = [record.with_name(name) for name in sorted(names - {record.name, "", ".", ".."})]
    return [path for path in beside if path.is_file() and not path.is_symlink()]


def stale_pages(folder: Path, points: Iterable[Path]) -> list[Path]:
    """Return the pages with all their files, in a folder of points or in a folder within it, that show these points."""
    gone = {path.resolve() for path in points}
    found: list[Path] = []
    for name in POINT_PAGES:
        for record in [folder / name, *sorted(folder.glob(f"*/{name}"))]:
            shown = {(record.parent / one).resolve() for one in _texts(_read(record), "of")}
            if shown & gone:
                found += [*listed_files(record), record]
    return found


def stale_records(outcome: Path, scanners: Collection[str]) -> list[Path]:
    """Return the records beside the outcome of an earlier calibration that are of other scanners than these.

    Args:
        outcome: file whose ``calibrations`` has the id of each scanner's calibration; records with other ids stay.
        scanners: names of the scanners whose records are replaced.
    """
    named = _read(outcome).get("calibrations")
    found: list[Path] = []
    for name, identity in named.items() if isinstance(named, dict) else ():
        record = outcome.with_name(f"{Path(name).name}.record.json")
        if name not in scanners and _read(record).get("id") == identity:
            found += [record.with_suffix(suffix) for suffix in (".xml", ".npz", ".json")]
    return [path for path in found if path.is_file() and not path.is_symlink()]


def _texts(record: dict[str, Any], key: str) -> list[str]:
    entries = record.get(key)
    return [one for one in entries if isinstance(one, str)] if isinstance(entries, list) else []


def _read(path: Path) -> dict[str, Any]:
    """Return a record's content; {} if it cannot be read as one."""
    try:
        if not path.is_file() or path.stat().st_size > MOST_BYTES:
            return {}
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return content if isinstance(content, dict) else {}
