"""The command ``swath offload``: copies logs off the aircraft."""

from __future__ import annotations

import contextlib
import json
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from swath.daemon.cli.progress import transfer_bar
from swath.daemon.errors import ExitCode, UserError, one_line
from swath.daemon.log.directory import log_directory

if TYPE_CHECKING:
    from swath.daemon.exchange.offload import OffloadReport


def command(
    where: Annotated[
        Path,
        typer.Argument(metavar="DIR", help="Where the logs are, or the recorder's configuration.", readable=False),
    ],
    destination: Annotated[
        Path, typer.Argument(metavar="DEST", help="A folder on another disk, which must be there.", readable=False)
    ],
    verify: Annotated[bool, typer.Option("--verify", help="Read copies that are there already once more.")] = False,
    same_disk: Annotated[bool, typer.Option("--same-disk", help="DEST may be on the disk of the logs.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object, for scripts.")] = False,
) -> None:
    """Copy finished logs to DEST, read each copy back, list their SHA-256 in DEST/SHA256SUMS, say what may be deleted.

    Goes on where an interrupted run ended. A log being recorded is passed over; nothing is deleted or overwritten.
    Exit code 3 when a log could not be copied or DEST is full, 4 when a copy is not what the log holds.
    """
    from swath.daemon.exchange.offload import is_growing, offload
    from swath.daemon.system import give_way

    directory = log_directory(where)
    if any(map(is_growing, directory.glob("*.mcap"))):
        give_way()
    report: OffloadReport | None = None
    said = 0
    with transfer_bar() as bar:
        task = bar.add_task("", total=None)

        def tell(name: str, done: int, total: int) -> None:
            bar.update(task, description=one_line(name), completed=done, total=total)

        for report in offload(directory, destination, verify=verify, same_disk=same_disk, progress=tell):
            if not as_json and len(report.copied) > said:
                said = len(report.copied)
                copied = report.copied[-1]
                print(f"{one_line(copied.name)}: copied and read back, {copied.bytes / 1e6:,.1f} MB", flush=True)
    if report is None:
        raise UserError(f"{directory}: no logs (*.mcap) there", ExitCode.IO)
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
        checked = "read again now" if verify else "checked when copied"
        print(f"{count} log{'s' if count != 1 else ''} there already, {checked}")
    for name in report.recording:
        print(f"{one_line(name)}: is being recorded; not copied")
    for name in report.left_open:
        print(f"{one_line(name)}: was left open by a crash and is copied as it is; swath recover completes it")
    sizes = _sizes(report.deletable)
    if sizes:
        print(f"may be deleted, {len(sizes)} of the logs, {sum(sizes.values()) / 1e6:,.1f} MB:")
        for path in sizes:
            print(f"  rm {one_line(shlex.quote(str(path)))}")


def _sizes(paths: Sequence[Path]) -> dict[Path, int]:
    """Return the sizes in bytes of the files that still exist."""
    sizes: dict[Path, int] = {}
    for path in paths:
        with contextlib.suppress(FileNotFoundError):
            sizes[path] = path.stat().st_size
    return sizes
