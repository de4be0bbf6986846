"""The command ``swath monitor``: shows a running recorder on the terminal."""

from __future__ import annotations

import asyncio
import json
import os
import sys
import termios
import time
import tty
from collections.abc import Callable, Iterator
from contextlib import aclosing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from swath.daemon.errors import ExitCode, UserError, one_line
from swath.daemon.log.directory import DEFAULT_CONFIG, log_directory

if TYPE_CHECKING:
    from rich.console import Console, Group

EVENTS_SHOWN = 8
MARK_KEY = "m"
MARK_TEXT = "marked in swath monitor"
KEYS = f"{MARK_KEY}: write a mark into the log; Ctrl-C: leave"
LOOK_S = 0.1  # between two looks with --once
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

    directory = log_directory(where)
    if once:
        raise typer.Exit(int(EXIT[asyncio.run(_once(directory, as_json, decode=decode))]))
    console = Console()
    if as_json or not console.is_terminal:
        asyncio.run(_print(directory, every, as_json, decode=decode))
    else:
        asyncio.run(_show(directory, every, console, decode=decode))


async def _once(directory: Path, as_json: bool, *, decode: bool) -> str:
    """Print the state as soon as it is known; return the verdict."""
    from swath.daemon.monitor.display import watch

    deadline_s = time.monotonic() + FIRST_STATUS_S
    found: dict[str, Any] = {}
    async with aclosing(watch(directory, LOOK_S, decode=decode)) as looks:
        async for monitor in looks:
            found = monitor.snapshot()
            starts = found["verdict"] != "not recording" and not found["sources"] and time.monotonic() < deadline_s
            if not (monitor.is_undecided or starts):
                break
    print(json.dumps(found, indent=2) if as_json else one_line(found["sentence"]))
    return str(found["verdict"])


async def _print(directory: Path, every_s: float, as_json: bool, *, decode: bool) -> None:
    from swath.daemon.monitor.display import watch

    async with aclosing(watch(directory, every_s, decode=decode)) as looks:
        async for monitor in looks:
            found = monitor.snapshot()
            print(json.dumps(found) if as_json else one_line(found["sentence"]), flush=True)


async def _show(directory: Path, every_s: float, console: Console, *, decode: bool) -> None:
    """Show a page until Ctrl-C."""
    from rich.live import Live

    from swath.daemon.monitor.display import watch

    foot = KEYS
    marks: list[asyncio.Future[str]] = []

    def pressed(keys: str) -> None:
        if MARK_KEY in keys:
            marks.append(asyncio.get_running_loop().run_in_executor(None, _mark, directory))

    with _keys(pressed), Live(console=console, auto_refresh=False, screen=True) as live:
        async with aclosing(watch(directory, every_s, decode=decode)) as looks:
            async for monitor in looks:
                while marks and marks[0].done():
                    foot = f"{marks.pop(0).result()}; {KEYS}"
                live.update(page(monitor.snapshot(), foot), refresh=True)


@contextmanager
def _keys(pressed: Callable[[str], None]) -> Iterator[None]:
    """Call a function with the keys that are pressed; the terminal shows none."""
    if not sys.stdin.isatty():
        yield
        return
    terminal, loop = sys.stdin.fileno(), asyncio.get_running_loop()

    def read() -> None:
        keys = os.read(terminal, 64).decode("ascii", "ignore")
        if keys:
            pressed(keys)
        else:  # a closed terminal is always ready
            loop.remove_reader(terminal)

    before = termios.tcgetattr(terminal)
    try:
        tty.setcbreak(terminal)
        loop.add_reader(terminal, read)
        yield
    finally:
        loop.remove_reader(terminal)
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
