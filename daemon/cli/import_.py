"""The command ``swath import``: makes a log from captures."""

from __future__ import annotations

import contextlib
import json
import logging
import math
import os
import resource
from collections.abc import Callable, Sequence
from datetime import UTC, datetime, tzinfo
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeVar
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

import typer

from swath.daemon.errors import ExitCode, UserError, one_line
from swath.daemon.written import NO_ROOM, error_words, make_folder, written_words
from swath.georef.progress import BYTES

if TYPE_CHECKING:
    from swath.daemon.config import Config
    from swath.daemon.exchange.captures import Capture
    from swath.daemon.exchange.import_ import ImportReport
    from swath.daemon.exchange.routes import Routes

ValueT = TypeVar("ValueT")

MOST_OF_CAPTURES = 1.2  # size of a log by that of its captures; what is of other devices is left out, chunks compressed


def command(
    config: Annotated[
        Path, typer.Argument(metavar="CONFIG", help="Configuration that describes the devices; with --list, a bag.")
    ],
    files: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="FILE…", help="Captures, logs of CAN buses, CSV or Parquet files, bags, or the folder of an export."
        ),
    ] = None,
    output: Annotated[Path | None, typer.Option("--output", "-o", metavar="DIR", help="Directory for the log.")] = None,
    source: Annotated[
        list[str] | None,
        typer.Option(metavar="KIND/NAME[:WHICH]=FILE", help="The device whose bytes FILE holds; repeatable."),
    ] = None,
    start: Annotated[
        list[str] | None,
        typer.Option(metavar="[SOURCE=]TIME", help="Start time of a file without times, such as 2026-11-21T10:15:00Z."),
    ] = None,
    zone: Annotated[
        str | None,
        typer.Option(metavar="ZONE", help="Zone of files with local times: +02:00 or Europe/Zurich. Default: UTC."),
    ] = None,
    baud: Annotated[
        list[str] | None,
        typer.Option(metavar="[SOURCE=]N", help="Baud rate of that file; 0: all bytes at once. Default: from CONFIG."),
    ] = None,
    keep_copies: Annotated[
        bool, typer.Option("--keep-copies", help="Keep duplicate packets; default: drop the second copy.")
    ] = False,
    list_: Annotated[
        bool, typer.Option("--list", help="List what of a ROS bag can be imported, and propose a configuration.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object, for scripts.")] = False,
) -> None:
    """Make a log from captures of tcpdump, str2str, Livox Viewer or CAN loggers, ROS bags, tables, or an export.

    CONFIG's ports and CAN interfaces assign the units of network captures and CAN logs to devices; a serial stream
    needs --source. The topics of a bag go to the devices of their protocols, or are named by --source. Exit code 4 when
    a capture is damaged, 1 when a capture holds nothing from CONFIG's devices.
    """
    from swath.daemon.config import load_config
    from swath.daemon.exchange.capture_files import ImportOptions, find_captures
    from swath.daemon.exchange.routes import Routes
    from swath.daemon.free_space import check_space

    if list_:
        _list([config, *(files or ())], as_json)
        return
    if output is None:
        raise UserError("import: want -o DIR, the directory for the log (or --list BAG)", ExitCode.USAGE)
    logging.getLogger("swath").addHandler(logging.NullHandler())  # findings about captures are printed below
    options = ImportOptions(
        source or (), _by_source(start, _time_ns), _by_source(baud, _baud), keep_copies, _zone(zone)
    )
    loaded = load_config(config, with_plan=True)  # the log stores it
    routes = Routes.of(loaded)
    captures = find_captures(routes, files or (), options)
    size = sum(path.stat().st_size for capture in captures for path in capture.files() if path.exists())
    check_space(output, "logs", least_bytes=0.0, most_bytes=MOST_OF_CAPTURES * size)
    report = _import(loaded, routes, captures, output)
    if as_json:
        found = {"session_id": report.session_id, "log": [str(path) for path in report.paths], "units": report.units}
        print(json.dumps(found | {"captures": [capture.plain() for capture in captures]}, indent=2))
    else:
        _print(report, captures)
    damaged = [capture for capture in captures if capture.tally.damage]
    lines = [_damage(capture) for capture in damaged]
    lines += [_of_nobody(capture, routes) for capture in captures if not capture.units and not capture.tally.damage]
    if lines:
        raise UserError("\n".join(map(one_line, lines)), ExitCode.DAMAGE if damaged else ExitCode.PROBLEM)


def _list(bags: list[Path], as_json: bool) -> None:
    from swath.daemon.exchange.bag_listing import list_bag
    from swath.drivers.transports.base import TransportError

    try:
        listings = [list_bag(path) for path in bags]
    except TransportError as error:
        raise UserError(one_line(str(error)), ExitCode.IO) from error
    if as_json:
        print(json.dumps({"bags": [listing.plain() for listing in listings]}, indent=2))
    else:
        print("\n".join(listing.text() for listing in listings), end="")


def _import(config: Config, routes: Routes, captures: list[Capture], output: Path) -> ImportReport:
    from swath.daemon.cli.progress import progress_bar
    from swath.daemon.exchange.import_ import import_captures
    from swath.daemon.log.directory import LOCK, take_directory
    from swath.drivers.transports.base import TransportError

    most = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))  # merging keeps all captures open at once
    new = not output.exists()
    with contextlib.suppress(OSError):  # `take_directory` says why
        make_folder(output)
    lock = take_directory(output, "--output")
    try:
        with progress_bar() as tell:
            return import_captures(
                config, routes, captures, output, lambda done, total: tell("reading captures", done, total, BYTES)
            )
    except TransportError as error:
        raise UserError(one_line(str(error)), ExitCode.IO) from error
    except OSError as error:
        text = error_words(error, output)
        if error.errno not in NO_ROOM:
            text += f"; {written_words()}"
        raise UserError(one_line(text), ExitCode.IO) from error
    finally:
        os.close(lock)
        if new and [path.name for path in output.iterdir()] == [LOCK]:
            (output / LOCK).unlink()


def _by_source(texts: Sequence[str] | None, parse: Callable[[str], ValueT]) -> dict[str, ValueT]:
    """Parse options of the form ``SOURCE=value``, or ``value`` for all sources, into a dict by source."""
    found: dict[str, ValueT] = {}
    for text in texts or ():
        source, _, value = text.rpartition("=")
        try:
            found[source] = parse(value)
        except ValueError as error:
            raise UserError(f"{text}: {error}", ExitCode.USAGE) from error
    return found


def _time_ns(text: str) -> int:
    """Parse a time in ISO 8601 with Z or an offset, or in seconds since 1970 with up to nine decimals; return
    nanoseconds.
    """
    whole, _, fraction = text.partition(".")
    if whole.isdecimal() and len(whole) <= 10 and (not fraction or (fraction.isdecimal() and len(fraction) <= 9)):
        return int(whole) * 1_000_000_000 + int(fraction.ljust(9, "0"))
    want = "want a time such as 2026-11-21T10:15:00Z, or seconds since 1970"
    try:
        time = datetime.fromisoformat(text)
    except ValueError as error:
        raise ValueError(want) from error
    if time.tzinfo is None:
        raise ValueError(f"{want}, with Z or an offset from UTC")
    since = time - datetime(1970, 1, 1, tzinfo=UTC)
    if since.days < 0:
        raise ValueError(f"{want}, after 1970")
    return (since.days * 86_400 + since.seconds) * 1_000_000_000 + since.microseconds * 1000


def _zone(text: str | None) -> tzinfo | None:
    """Parse an offset from UTC such as +02:00, or the name of a time zone."""
    if text is None:
        return None
    with contextlib.suppress(ValueError):
        if offset := datetime.fromisoformat(f"2000-01-01T00:00:00{text}").tzinfo:
            return offset
    with contextlib.suppress(ValueError, OSError, ZoneInfoNotFoundError):
        return ZoneInfo(text)
    raise UserError(f"--zone {text}: want an offset such as +02:00, or a zone such as Europe/Zurich", ExitCode.USAGE)


def _baud(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (value == 0 or 1 <= value <= 1e9):
        raise ValueError("want bits per second, or 0 for all bytes at once")
    return value


def _print(report: ImportReport, captures: list[Capture]) -> None:
    for capture in captures:
        parts = [f"{count} units of {source}" for source, count in sorted(capture.units.items())] or ["no units"]
        parts += [f"{count} {what} passed over" for what, count in capture.tally.passed.items() if count]
        if capture.tally.missing_bytes:
            parts.append(f"{capture.tally.missing_bytes} bytes of TCP not captured")
        if capture.passed:
            most = ", ".join(f"{what} ({count})" for what, count in capture.passed.most_common(5))
            parts.append(f"{capture.passed.total()} from unknown devices: {most}")
        print(one_line(f"{capture.path}: {capture.kind}, {', '.join(parts)}"))
        for head in capture.heads.values():
            print(one_line(f"  {head.words()}"))
        for line in capture.warnings():
            print(one_line(f"warning: {line}"))
    for path in report.paths:
        print(path)


def _damage(capture: Capture) -> str:
    tally = capture.tally
    more = f" ({tally.damage} such places)" if tally.damage > 1 else ""
    return f"{tally.first_damage}{more}; everything readable is in the log"


def _of_nobody(capture: Capture, routes: Routes) -> str:
    there = ", ".join(f"{what} ({count})" for what, count in capture.passed.most_common(5))
    if capture.kind == "bag":
        held = there or "no messages with the bytes of a device"
        gives = "proposes a configuration" if there else "lists its topics"
        return f"{capture.path}: holds {held}; `swath import --list {capture.path}` {gives}"
    if not there:
        return f"{capture.path}: is empty"
    return (
        f"{capture.path}: holds {there}, but the configuration has {routes.described(capture.kind)}; "
        "give --source kind/name=FILE"
    )
