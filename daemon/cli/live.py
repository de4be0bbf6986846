"""The command ``swath live``: computes and shows points during a recording."""

from __future__ import annotations

import contextlib
import json
import signal
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from swath.daemon.cli.options import AcceptVerdict
from swath.daemon.errors import ExitCode, UserError, one_line
from swath.daemon.log.directory import DEFAULT_CONFIG, log_directory
from swath.daemon.processing.requirements import require_installed

if TYPE_CHECKING:
    from rich.console import Console, Group

    from swath.daemon.config import Config
    from swath.daemon.config.tables import LiveConfig
    from swath.daemon.processing.live.serve import LiveServer

JOURNAL_S = 60.0  # between two lines for the journal; systemd shows the status all the time


def command(
    where: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="[CONFIG|DIR]",
            help="Configuration or log directory of the recorder. --replay: logs and a configuration.",
            readable=False,
        ),
    ] = None,
    from_start: Annotated[
        bool,
        typer.Option(
            "--from-start", help="Begin at the start of the recording instead of now; reads older data from the disk."
        ),
    ] = False,
    replay: Annotated[
        bool, typer.Option("--replay", help="Process finished logs the same way, as fast as possible.")
    ] = False,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="DIR", help="--replay: folder for its files.")
    ] = None,
    points: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Also write all points as one array (.npy), for comparisons.")
    ] = None,
    serve: Annotated[
        bool, typer.Option("--serve", help="Also serve live.mcap's topics to Foxglove, on this computer only.")
    ] = False,
    serve_port: Annotated[
        int | None, typer.Option(help="--serve: port to listen at; 8765 if none is given.", min=0, max=65535)
    ] = None,
    accept_verdict: AcceptVerdict = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the status as JSON, one object per line.")] = False,
) -> None:
    """Georeference the running recording and show its progress.

    Follows the growing log until the recording ends. Writes live.mcap (opens in Foxglove), coverage.png, coverage.json
    and live.json under live/ in the log directory. Positions come from the device's own INS solution if it has one,
    otherwise from IMU and GNSS. The recorder does not depend on this program; it may be stopped at any time.
    """
    require_installed("swath live", "foxglove")
    _check(where, output, replay=replay)
    if serve_port is not None and not serve:
        raise UserError("--serve-port needs --serve, which serves Foxglove's viewer", ExitCode.USAGE)
    paths = where or [DEFAULT_CONFIG]
    with _serving(serve, serve_port) as server:
        if replay:
            found = _replay(paths, output or Path(), points, server, accept_verdict=accept_verdict, as_json=as_json)
        else:
            found = _follow(
                paths[0], points, server, from_start=from_start, accept_verdict=accept_verdict, as_json=as_json
            )
    if "no end" in found["state"]:
        raise typer.Exit(int(ExitCode.PROBLEM))
    _refuse_unusable(found)


@contextlib.contextmanager
def _serving(serve: bool, port: int | None) -> Iterator[LiveServer | None]:
    """Serve Foxglove's viewer during the block if it is wanted, at the port that the viewer proposes by default."""
    if not serve:
        yield None
        return
    from swath.daemon.processing.live.serve import ADDRESS, PORT, LiveServer

    server = LiveServer(PORT if port is None else port)
    print(f"serving ws://{ADDRESS}:{server.port} for Foxglove", file=sys.stderr, flush=True)
    try:
        yield server
    finally:
        server.close()


def _refuse_unusable(found: dict[str, Any]) -> None:
    """Refuse the result with `UserError` if its verdict is that the points are not to be used."""
    from swath.daemon.processing.carried_verdict import refusal

    unusable = refusal(found.get("verdict") or {})
    if unusable:
        raise UserError(one_line(unusable))


def _check(where: list[Path] | None, output: Path | None, *, replay: bool) -> None:
    if replay and (not where or output is None):
        raise UserError("--replay needs logs and -o DIR: swath live --replay LOG… -o DIR [CONFIG]", ExitCode.USAGE)
    if not replay and output is not None:
        raise UserError(
            "-o needs --replay; files of a running recording go under live/ in its directory", ExitCode.USAGE
        )
    if not replay and len(where or []) > 1:
        raise UserError("too many arguments; give one CONFIG or DIR", ExitCode.USAGE)


@contextlib.contextmanager
def _stop_signals() -> Iterator[list[int]]:
    """Collect SIGINT and SIGTERM in a list during the block, so that the first one ends the work in order."""
    stop: list[int] = []
    before = {signum: signal.getsignal(signum) for signum in (signal.SIGINT, signal.SIGTERM)}
    for signum in before:
        signal.signal(signum, lambda number, frame: stop.append(number))
    try:
        yield stop
    finally:
        for signum, handler in before.items():
            signal.signal(signum, handler)


# ---------------------------------------------------------------------------------------------- a recording


def _follow(
    where: Path,
    points: Path | None,
    server: LiveServer | None,
    *,
    from_start: bool,
    accept_verdict: bool,
    as_json: bool,
) -> dict[str, Any]:
    """Follow a recording until it ends or a signal stops it.

    During compilation a signal ends the process at once, because compiling does not check for collected signals.
    """
    from rich.console import Console

    from swath.daemon.config import load_config
    from swath.daemon.config.tables import LiveConfig
    from swath.daemon.processing.compiling import before_compiling
    from swath.daemon.processing.live.session import Live
    from swath.daemon.processing.setup.sent_files import example_files
    from swath.daemon.processing.setup.setup import Options, Setup
    from swath.daemon.processing.warm_up import get_ready, warm_up
    from swath.daemon.recorder.service_manager import ServiceManager
    from swath.daemon.system import lower_priority

    directory = log_directory(where)
    config = None if where.is_dir() else load_config(where)
    lower_priority()
    manager = ServiceManager()
    manager.notify(STATUS="compiling")
    with before_compiling(_tell_of_compiling):
        warmed = warm_up(
            [] if config is None else [Setup.of_config(config, Options(uncertainty=False), example_files(config))]
        )
    with _stop_signals() as stop, _teller(Console(), manager, as_json=as_json) as tell:
        if warmed.cache is None or warmed.compiled:
            print(one_line(warmed.text()), file=sys.stderr, flush=True)
        manager.notify(READY="1", STATUS="waiting for a recording to begin")
        live = LiveConfig() if config is None else config.tables.live
        following = Live(
            directory,
            live,
            tell,
            from_start=from_start,
            points=points,
            prepare=get_ready,
            accept_verdict=accept_verdict,
            server=server,
        )
        return following.run(lambda: bool(stop))


def _tell_of_compiling() -> None:
    text = "compiling; this takes a minute or more. Run `swath warm-up` before a flight to avoid it"
    print(text, file=sys.stderr, flush=True)


@contextlib.contextmanager
def _teller(console: Console, manager: Any, *, as_json: bool) -> Iterator[Callable[[dict[str, Any]], None]]:
    """Give a function that shows a status: a page on a terminal, else a line each second, for a service less often."""
    from rich.live import Live as Screen

    said_s = -JOURNAL_S

    def tell_line(found: dict[str, Any]) -> None:
        nonlocal said_s
        manager.notify(STATUS=found["sentence"], WATCHDOG="1")
        ends = found["state"].startswith("ended")
        if manager.watchdog_s is None or ends or time.monotonic() - said_s >= JOURNAL_S:
            said_s = time.monotonic()
            print(json.dumps(found) if as_json else found["sentence"], flush=True)

    if as_json or not console.is_terminal:
        yield tell_line
        return
    last: dict[str, Any] = {"sentence": ""}
    with Screen(console=console, auto_refresh=False, screen=True) as screen:

        def tell_page(found: dict[str, Any]) -> None:
            last.update(found)
            screen.update(page(found), refresh=True)

        yield tell_page
    print(last["sentence"])


def page(found: dict[str, Any]) -> Group:
    """Return the page for the terminal."""
    from rich.console import Group, RenderableType
    from rich.table import Table
    from rich.text import Text

    from swath.daemon.processing.live.status import is_well

    style = "bold green" if is_well(found) else "bold yellow"
    parts: list[RenderableType] = [Text(found["sentence"], style=style), Text("")]
    if "points" not in found:
        return Group(*parts)
    table = Table(box=None, pad_edge=False, header_style="bold")
    for column in ("scanner", "points", "a second", "waiting", "delay after pulse: p50", "p95", "max"):
        table.add_column(column, justify="left" if column == "scanner" else "right")
    for name, count in found["points"].items():
        latency = (found["latency_s"].get(f"scanner/{name}") or {}).get("pulse") or {}
        seconds = [f"{latency[key]:.2f} s" if latency else "" for key in ("p50", "p95", "max")]
        rate, waiting = found["points_per_s"][name], found["waiting"][name]
        table.add_row(one_line(name), f"{count:,}", f"{rate:,}", f"{waiting:,}", *seconds)
    parts.append(table)
    for name, fates in found["fates"].items():
        counts = ", ".join(f"{count:,} {fate.replace('_', ' ')}" for fate, count in fates.items())
        parts.append(Text(one_line(f"{name}: {counts}"), style="dim"))
    clocks = ", ".join(f"{source} {one['state']}" for source, one in found["time"].items())
    parts.append(Text(f"\n{one_line(clocks)}; {found['free_bytes'] / 1e9:,.1f} GB free"))
    return Group(*parts)


# ---------------------------------------------------------------------------------------------- finished logs


def _replay(
    paths: list[Path],
    output: Path,
    points: Path | None,
    server: LiveServer | None,
    *,
    accept_verdict: bool,
    as_json: bool,
) -> dict[str, Any]:
    from swath.daemon.config import load_config
    from swath.daemon.log.format import LogError
    from swath.daemon.log.reader import open_logs
    from swath.daemon.processing.live.session import replay
    from swath.daemon.processing.setup.setup import Options, Setup

    configs = [path for path in paths if path.suffix == ".toml"]
    passed_over: list[str] = []
    try:
        sessions = open_logs([path for path in paths if path not in configs], passed_over)
    except LogError as error:
        raise UserError(one_line(str(error)), ExitCode.IO) from error
    for line in passed_over:
        print(f"passed over: {one_line(line)}", file=sys.stderr)
    if len(sessions) != 1 or len(configs) > 1:
        names = ", ".join(session.session_id for session in sessions)
        raise UserError(
            f"--replay takes one session and at most one configuration; got the sessions {names or 'none'}",
            ExitCode.USAGE,
        )
    config: Config | None = load_config(configs[0], with_plan=True) if configs else None
    options = Options(uncertainty=False)
    setup = Setup.of_session(sessions[0], config, options)
    live: LiveConfig = setup.config.tables.live
    found = replay(sessions[0], setup, output, live, points, accept_verdict=accept_verdict, server=server)
    print(json.dumps(found, indent=2) if as_json else found["sentence"])
    return found
