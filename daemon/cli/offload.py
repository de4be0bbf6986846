"""The command ``swath offload``: copies logs off the aircraft."""

from __future__ import annotations

import contextlib
import json
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from swath.daemon.cli.progress import progress_bar
from swath.daemon.errors import ExitCode, UserError, one_line
from swath.daemon.log.directory import log_directory
from swath.georef.progress import BYTES

if TYPE_CHECKING:
    from swath.daemon.exchange.offload import OffloadReport


def command(
    where: Annotated[
        Path,
        typer.Argument(metavar="DIR", help="Log directory, or configuration of the recorder.", readable=False),
    ],
    destination: Annotated[
        Path, typer.Argument(metavar="DEST", help="Existing folder on another disk.", readable=False)
    ],
    verify: Annotated[bool, typer.Option("--verify", help="Also read copies of earlier runs again.")] = False,
    same_disk: Annotated[bool, typer.Option("--same-disk", help="Allow DEST on the same disk as the logs.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object, for scripts.")] = False,
) -> None:
    """Copy finished logs to DEST, read each copy back, list checksums in DEST/SHA256SUMS, name logs safe to delete.

    Continues an interrupted run. Leaves out logs that are being recorded; deletes and overwrites nothing.
    Exit code 3 when a log could not be copied or DEST is full, 4 when a copy differs from its log.
    """
    from swath.daemon.exchange.offload import is_growing, offload
    from swath.daemon.system import give_way

    directory = log_directory(where)
    if any(map(is_growing, directory.glob("*.mcap"))):
        give_way()
    report: OffloadReport | None = None
    printed = 0
    with progress_bar() as tell:

        def progress(name: str, done: int, total: int) -> None:
            tell(name, done, total, BYTES)

        for report in offload(directory, destination, verify=verify, same_disk=same_disk, progress=progress):
            if not as_json and len(report.copied) > printed:
                printed = len(report.copied)
                copied = report.copied[-1]
                print(f"{one_line(copied.name)}: copied and read back, {copied.bytes / 1e6:,.1f} MB", flush=True)
    if report is None:
        raise UserError(f"{directory}: contains no logs (*.mcap)", ExitCode.IO)
    if as_json:
        print(json.dumps(report.plain(), indent=2))
    else:
        _print(report, verify)
    lines = [*report.differ, *report.failed, *([report.stopped] if report.stopped else [])]
    if lines:
        raise UserError("\n".join(map(one_line, lines)), ExitCode.DAMAGE if report.differ else ExitCode.IO)


def _print(report: OffloadReport, verify: bool) -> None:
    if report.there:
        count = len(report.there)
        checked = "read again now" if verify else "verified when copied"
        print(f"{count} log{'s' if count != 1 else ''} already copied, {checked}")
    for name in report.recording:
        print(f"{one_line(name)}: is being recorded; not copied")
    for name in report.left_open:
        print(f"{one_line(name)}: was left open by a crash and is copied unchanged; run swath recover to complete it")
    sizes = _sizes(report.deletable)
    if sizes:
        print(f"safe to delete: {len(sizes)} log{'s' if len(sizes) != 1 else ''}, {sum(sizes.values()) / 1e6:,.1f} MB")
        for path in sizes:
            print(f"  rm {one_line(shlex.quote(str(path)))}")


def _sizes(paths: Sequence[Path]) -> dict[Path, int]:
    """Return the sizes in bytes of the files that still exist."""
    sizes: dict[Path, int] = {}
    for path in paths:
        with contextlib.suppress(FileNotFoundError):
            sizes[path] = path.stat().st_size
    return sizes
