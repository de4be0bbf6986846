"""The command ``swath monitor``: shows a running recorder on the terminal."""

from __future__ import annotations

import json
import os
import select
import sys
import termios
import time
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from swath.daemon.errors import ExitCode, UserError, one_line
from swath.daemon.log.directory import DEFAULT_CONFIG, log_directory

if TYPE_CHECKING:
    from rich.console import Group

    from swath.daemon.monitor.display import Monitor

EVENTS_SHOWN = 8
MARK_KEY = "m"
MARK_TEXT = "marked in swath monitor"
KEYS = f"{MARK_KEY}: write a mark into the log; Ctrl-C: leave"
FIRST_STATUS_S = 3.0  # a recorder writes its first status one second after its start
STATE_STYLE = {"receiving": "green", "silent": "red", "stuck": "red", "absent": "red", "opening": "yellow"}
EXIT = {"recording": ExitCode.OK, "degraded": ExitCode.PROBLEM, "not recording": 2}


def command(
    where: Annotated[
        Path,
        typer.Argument(metavar="[CONFIG|DIR]", help="Configuration or log directory of the recorder.", readable=False),
    ] = DEFAULT_CONFIG,
    once: Annotated[
        bool, typer.Option("--once", help="Print one line and exit; the exit code is the verdict.")
    ] = False,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print one JSON object; without --once, one per line.")
    ] = False,
    every: Annotated[float, typer.Option(help="Seconds between updates.", min=0.1, max=60.0)] = 0.5,
    decode: Annotated[bool, typer.Option(help="Decode the bytes, for damaged messages, gaps and record rates.")] = True,
) -> None:
    """Show the state of each source (rate, age, losses, time status), the disk and the latest events.

    Reads the growing log only; on a terminal the key m asks the recorder for a mark. With --once the exit code is 0
    for recording, 1 for degraded, 2 for not recording.
    """
    from rich.console import Console
    from rich.live import Live

    from swath.daemon.monitor.display import Monitor

    directory = log_directory(where)
    monitor = Monitor(directory, decode=decode)
    if once:
        raise typer.Exit(int(EXIT[_once(monitor, as_json)]))
    console = Console()
    if as_json or not console.is_terminal:
        while True:
            monitor.poll()
            found = monitor.snapshot()
            print(json.dumps(found) if as_json else one_line(found["sentence"]), flush=True)
            time.sleep(every)
    foot = KEYS
    with _keys() as pressed, Live(console=console, auto_refresh=False, screen=True) as live:
        while True:
            monitor.poll()
            live.update(page(monitor.snapshot(), foot), refresh=True)
            if MARK_KEY in pressed(every):
                foot = f"{_mark(directory)}; {KEYS}"


@contextmanager
def _keys() -> Iterator[Callable[[float], str]]:
    """Give a function that waits for keys for at most so many seconds and returns them; the terminal shows none."""

    def wait(timeout_s: float) -> str:
        time.sleep(timeout_s)
        return ""

    def pressed(timeout_s: float) -> str:
        ready, _, _ = select.select([terminal], [], [], timeout_s)
        if not ready:
            return ""
        return os.read(terminal, 64).decode("ascii", "ignore") or wait(timeout_s)  # a closed terminal is always ready

    if not sys.stdin.isatty():
        yield wait
        return
    terminal = sys.stdin.fileno()
    before = termios.tcgetattr(terminal)
    try:
        tty.setcbreak(terminal)
        yield pressed
    finally:
        termios.tcsetattr(terminal, termios.TCSADRAIN, before)


def _mark(directory: Path) -> str:
    """Ask the recorder to write a mark; return in words what came of it."""
    from swath.daemon.log.words import clock_text
    from swath.daemon.recorder.control_client import ask

    try:
        answer = ask(directory, {"command": "mark", "text": MARK_TEXT})
    except UserError as error:
        return one_line(f"no mark: {error}")
    return f"marked at {clock_text(answer['time_ns'])}"


def _once(monitor: Monitor, as_json: bool) -> str:
    deadline_s = time.monotonic() + FIRST_STATUS_S
    monitor.poll()
    found = monitor.snapshot()
    while monitor.is_undecided or (
        found["verdict"] != "not recording" and not found["sources"] and time.monotonic() < deadline_s
    ):
        time.sleep(0.1)
        monitor.poll()
        found = monitor.snapshot()
    monitor.close()
    print(json.dumps(found, indent=2) if as_json else one_line(found["sentence"]))
    return str(found["verdict"])


def page(found: dict[str, Any], foot: str = "") -> Group:
    """Return the page for the terminal; ``foot`` is its last line."""
    from rich.console import Group, RenderableType
    from rich.table import Table
    from rich.text import Text

    style = {"recording": "bold green", "degraded": "bold yellow"}.get(found["verdict"], "bold red")
    parts: list[RenderableType] = [Text(one_line(found["sentence"]), style=style), Text("")]
    table = Table(box=None, pad_edge=False, header_style="bold")
    for column in ("source", "state", "per s", "age", "lost k/q/w", "time"):
        words = column in ("source", "state", "time")
        table.add_column(column, justify="left" if words else "right", overflow="fold", no_wrap=not words)
    for source, values in found["sources"].items():
        table.add_row(*_row(source, values))
    parts.append(table)
    for source, values in found["sources"].items():
        if (text := _decoded(values.get("decoded"))) is not None:
            parts.append(Text(one_line(f"{source}: {text}"), style="dim"))
    parts += [Text(one_line(note), style="yellow") for note in found["notes"]]
    parts.append(Text(f"\n{_disk(found)}\n"))
    for event in found["events"][-EVENTS_SHOWN:]:
        parts.append(_event(event))
    if foot:
        parts.append(Text(f"\n{one_line(foot)}", style="dim"))
    return Group(*parts)


def _row(source: str, values: dict[str, Any]) -> tuple[Any, ...]:
    from rich.text import Text

    lost = "/".join(str(count) for count in values["lost"].values())
    state = str(values["state"])
    return (
        Text(one_line(source)),
        Text(one_line(state), style=STATE_STYLE.get(state, "")),
        "" if values["rate_hz"] is None else f"{values['rate_hz']:,.1f}",
        "never" if values["age_s"] is None else f"{values['age_s']:.1f} s",
        Text(lost, style="" if lost == "0/0/0" else "red"),
        Text(time_text(values)),
    )


def time_text(values: dict[str, Any]) -> str:
    """Format the time status, as in ``LOCKED ±0.3 µs``; return an empty text for a source without a clock."""
    state, sigma_ns = values.get("time_state"), values.get("time_sigma_ns")
    if state is None:
        return ""
    if not isinstance(sigma_ns, (int, float)):
        return one_line(str(state))
    sigma = f"{sigma_ns * 1e-3:.1f} µs" if sigma_ns < 1e6 else f"{sigma_ns * 1e-6:.0f} ms"
    return one_line(f"{state} ±{sigma}")


def _decoded(decoded: dict[str, Any] | None) -> str | None:
    if decoded is None:
        return None
    parts = [f"{rate:,.1f} {name}/s" for name, rate in decoded["records_hz"].items()]
    if decoded["bad"]:
        parts.append(f"{decoded['bad']} messages damaged")
    parts += [f"{count} × {code}" for code, count in decoded["errors"].items() if count]
    text = ", ".join(parts) or "nothing decoded"
    share = decoded["share"]
    return text if share == 1.0 else f"{text} (of {share:.0%} of the seconds)"


def _disk(found: dict[str, Any]) -> str:
    rate, hours = found["bytes_per_s"] / 1e6, found["hours_left"]
    left = "" if hours is None else f", {hours:,.1f} h left at the highest rate of the last half hour"
    reserve = f", of which {found['reserve_bytes'] / 1e9:.1f} GB reserve" if found["reserve_bytes"] else ""
    return f"{rate:,.2f} MB/s; {found['free_bytes'] / 1e9:,.1f} GB free{reserve}{left}"


def _event(event: dict[str, Any]) -> Any:
    from rich.text import Text

    from swath.daemon.log.words import clock_text

    when, severity = clock_text(event.get("time_ns")), str(event.get("severity"))
    style = {"critical": "bold red", "error": "red", "warning": "yellow"}.get(severity, "")
    return Text(one_line(f"{when} {event.get('source')} {event.get('code')}: {event.get('text')}"), style=style)
