"""The command ``swath info``: reports the content of logs."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from swath.daemon.errors import ExitCode, UserError, one_line
from swath.georef.progress import BYTES, Tell

if TYPE_CHECKING:
    from rich.console import Console

MOST_MESSAGES = 24  # names of messages in a source's line


def command(
    logs: Annotated[list[Path], typer.Argument(help="Logs, or directories of logs.", metavar="LOG…")],
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object, for scripts.")] = False,
    quick: Annotated[bool, typer.Option("--quick", help="Count units without decoding them.")] = False,
) -> None:
    """Show duration, counts, rates, gaps, losses, time status, events and damage of logs.

    Exit code 1 when units are not accounted for or a part is missing, 4 when data is damaged. An index that is
    missing, as after a kill, is no damage.
    """
    from swath.daemon.cli.progress import page_console, progress_bar
    from swath.daemon.log.format import LogError
    from swath.daemon.log.reader import open_logs
    from swath.daemon.log.statistics import session_statistics

    passed_over: list[str] = []
    try:
        sessions = open_logs(logs, passed_over)
        with progress_bar() as tell:
            for session in sessions:
                session.progress = partial(_tell, tell, session.session_id)
            found = [session_statistics(session, decode=not quick) for session in sessions]
    except LogError as error:
        raise UserError(str(error), ExitCode.IO) from error
    if as_json:
        print(json.dumps({"sessions": found, "passed_over": passed_over}, indent=2))
    else:
        console = page_console()
        for numbers in found:
            _print_session(console, numbers)
        for line in passed_over:
            console.print(f"[red]passed over: {_plain(line)}[/]", highlight=False)
    if passed_over or any(_real_damage(numbers) for numbers in found):
        raise typer.Exit(int(ExitCode.DAMAGE))
    if any(numbers["missing_parts"] or _unaccounted(numbers) for numbers in found):
        raise typer.Exit(int(ExitCode.PROBLEM))


def _tell(tell: Tell, name: str, done: int, total: int) -> None:
    tell(f"reading {name}", done, total, BYTES)


def _plain(text: object) -> str:
    """Return a text of a log as one line, without markup that the console would interpret."""
    from rich.markup import escape

    return escape(one_line(str(text)))


def _real_damage(numbers: dict[str, Any]) -> list[dict[str, Any]]:
    return [damage for damage in numbers["damage"] if not damage.get("index_only")]


def _unaccounted(numbers: dict[str, Any]) -> int:
    return sum(int(source["account_errors"]) for source in numbers["sources"].values())


def _print_session(console: Console, numbers: dict[str, Any]) -> None:
    from rich.table import Table

    from swath.daemon.log.words import clock_text

    start = datetime.fromtimestamp((numbers["start_ns"] or 0) * 1e-9, tz=UTC)
    console.print(
        f"[bold]{_plain(numbers['session_id'])}[/]  {start:%Y-%m-%d %H:%M:%S} UTC, {numbers['duration_s']:.1f} s"
    )
    parts = f"{len(numbers['parts'])} part{'s' if len(numbers['parts']) != 1 else ''}, {numbers['bytes'] / 1e6:.1f} MB"
    imported = f" ({numbers['origin']})" if numbers["origin"] != "recording" else ""
    origin = _plain(f"{numbers['software']} on {numbers['host']}{imported}")
    console.print(f"{parts}, {origin}")
    if numbers["growing"] is not None:
        console.print(f"{_plain(numbers['growing'])} is still being recorded; counted up to now", highlight=False)
    for number in numbers["missing_parts"]:
        console.print(f"[red]part {number} is missing[/]")
    table = Table(box=None, pad_edge=False, header_style="bold")
    for column in ("source", "units", "MB", "per s", "gaps", "longest", "lost k/q/w", "time"):
        if column in ("source", "time"):  # words may wrap, but a truncated number would show another value
            table.add_column(column, overflow="fold", min_width=len("HOLDOVER"))
        else:
            table.add_column(column, justify="right", no_wrap=True)
    for source, values in numbers["sources"].items():
        table.add_row(*_row(source, values))
    console.print(table)
    for source, values in numbers["sources"].items():
        if "decoded" in values:
            console.print(f"{_plain(source)}: {_plain(_decoded(values['decoded']))}", highlight=False)
            if messages := _messages(values["decoded"]["messages"]):
                console.print(f"  messages: {_plain(messages)}", highlight=False)
    _print_trouble(console, numbers)
    unaccounted = _unaccounted(numbers)
    if unaccounted:
        console.print(f"[red]{unaccounted} status messages do not account for all units[/]")
    without_status = [source for source, values in numbers["sources"].items() if not values["has_status"]]
    if without_status:
        console.print(f"no status of {_plain(', '.join(without_status))}: losses are unknown", highlight=False)
    if numbers["missing_parts"] or _real_damage(numbers):
        console.print("[red]incomplete: units in missing parts and damaged places are not counted above[/]")
    elif not unaccounted and not without_status:
        console.print("every unit is accounted for: units = written + lost_kernel + lost_queue + lost_write")
    for event in numbers["marks"]:
        text_of_mark = f"{clock_text(event.get('time_ns'))} mark: {_plain(event.get('text', '?'))}"
        console.print(f"  {text_of_mark}", highlight=False)
    for event in numbers["last_events"]:
        severity, origin, code, text = (_plain(event.get(key, "?")) for key in ("severity", "source", "code", "text"))
        console.print(f"  {severity}: {origin} {code}: {text}", highlight=False)
    for damage in numbers["damage"]:
        if damage.get("index_only"):
            text = f"{damage['file']}: only its index is missing, as after a kill; swath recover writes it"
            console.print(_plain(text), highlight=False)
            continue
        messages = "" if damage["messages"] is None else f", {damage['messages']} messages"
        text = f"{damage['file']} at byte {damage['offset']}: {damage['length']} bytes, {damage['what']}{messages}"
        console.print(f"[red]damage: {_plain(text)}[/]", highlight=False)
    for note in numbers["notes"]:
        console.print(f"note: {_plain(note)}", highlight=False)


def _print_trouble(console: Console, numbers: dict[str, Any]) -> None:
    """Print the error counts that wires and controllers report themselves, and what degrades the streams."""
    from swath.daemon.log.wires import mixed_text

    for source, values in numbers["sources"].items():
        if values.get("degraded"):
            faults = _plain(", ".join(values["degraded"]))
            console.print(f"[red]{_plain(source)}: DEGRADED: {faults}[/]", highlight=False)
        if values.get("mixed_senders") and not source.startswith("raw/"):
            text = mixed_text(values["mixed_senders"], recorded=True)
            console.print(f"[red]{_plain(source)}: {_plain(text)}[/]", highlight=False)
        if values["trouble"]:
            counts = ", ".join(f"{count:,} {key.replace('_', ' ')}" for key, count in values["trouble"].items())
            senders = f"; refused senders: {values['refused_senders']}" if values.get("refused_senders") else ""
            console.print(f"[red]{_plain(source)}: {_plain(counts + senders)}[/]", highlight=False)


def _row(source: str, values: dict[str, Any]) -> tuple[str, ...]:
    lost = values["lost"]
    losses = f"{lost['lost_kernel']}/{lost['lost_queue']}/{lost['lost_write']}" if values["has_status"] else ""
    rate = "" if values["rate_hz"] is None else f"{values['rate_hz']:,.1f}"
    return (
        _plain(source),
        f"{values['units']:,}",
        f"{values['bytes'] / 1e6:,.2f}",
        rate,
        str(values["gaps"]),
        f"{values['longest_gap_s']:.2f} s",
        losses if losses in ("", "0/0/0") else f"[red]{losses}[/]",
        _time(values),
    )


def _time(values: dict[str, Any]) -> str:
    state = values.get("time_state")
    if state is None:
        return ""
    sigma = values["time_sigma_ns"]
    sigma_text = f" ±{sigma / 1e3:.1f}µs" if isinstance(sigma, (int, float)) and sigma < 1e6 else ""
    return _plain(state) + sigma_text


def _messages(counts: dict[str, int]) -> str:
    """Return the most frequent messages by name, and the number of further ones."""
    frequent = sorted(((count, name) for name, count in counts.items() if count), key=lambda item: (-item[0], item[1]))
    texts = [f"{count:,} {name}" for count, name in frequent[:MOST_MESSAGES]]
    if len(frequent) > MOST_MESSAGES:
        texts.append(
            f"{sum(count for count, _ in frequent[MOST_MESSAGES:]):,} of {len(frequent) - MOST_MESSAGES} others"
        )
    return ", ".join(texts)


def _decoded(decoded: dict[str, Any]) -> str:
    parts = [f"{count:,} {name}" for name, count in sorted(decoded["records"].items(), key=lambda item: -item[1])]
    for key, words in (("bad_checksums", "bad checksums"), ("bad_messages", "bad messages")):
        if decoded[key]:
            parts.append(f"{decoded[key]} {words}")
    parts += [f"{count} × {code}" for code, count in decoded["errors"].items() if count]
    return ", ".join(parts) or "nothing decoded"
