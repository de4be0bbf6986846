"""Plays a recording into a real recorder over wires whose bytes are remembered, and proves that all were logged."""

from __future__ import annotations

import hashlib
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from mcap.reader import make_reader
from rich.console import Console
from rich.live import Live
from rich.table import Table

from swath.daemon.config import load_config
from swath.daemon.log.format import source_of_topic
from swath.daemon.replay.units import close_outputs, open_outputs
from swath.daemon.replay.wire_player import Output, PlayReport, TimedUnit, play

START_S, END_S = 30.0, 30.0


class Hashed(Output):
    """An output that remembers what it sent."""

    def __init__(self, output: Output) -> None:
        self._output = output
        self.digest = hashlib.sha256()
        self.bytes = 0

    def send(self, data: bytes, due_realtime_ns: int) -> bool:
        """Send the data, and remember them if they were sent."""
        sent = self._output.send(data, due_realtime_ns)
        if sent:
            self.digest.update(data)
            self.bytes += len(data)
        return sent

    def has_reader(self) -> bool:
        """Return whether the output has a reader."""
        return self._output.has_reader()

    def close(self) -> None:
        """Close the output itself."""
        self._output.close()


@dataclass(frozen=True, slots=True)
class Show:
    """One recording to be made before an audience.

    Attributes:
        title: of the table while it plays.
        what: the sources, each in a few words.
        units: what is played, in order of time.
        seconds: of it.
        remark: after `swath info`.
    """

    title: str
    what: Mapping[str, str]
    units: Iterable[TimedUnit]
    seconds: float
    remark: str


def start_recorder(folder: Path, sources: int) -> subprocess.Popen[bytes]:
    """Start ``swath run`` on the folder's configuration; return it when all its devices are open."""
    journal = folder / "journal.txt"
    with journal.open("w") as stderr:
        command = [sys.executable, "-m", "swath.daemon.cli.main", "run", str(folder / "swath.toml")]
        recorder = subprocess.Popen(command, stderr=stderr)
    deadline = time.monotonic() + START_S
    while journal.read_text().count("device_opened") < sources:
        if recorder.poll() is not None or time.monotonic() > deadline:
            recorder.kill()
            raise SystemExit(f"the recorder did not start:\n{journal.read_text()}")
        time.sleep(0.05)
    return recorder


def progress_table(show: Show, played_s: float, report: PlayReport) -> Table:
    """Return a table of what has been sent so far."""
    table = Table(title=f"{show.title}: {played_s:4.1f} of {show.seconds:.0f} s", title_justify="left")
    for column in ("source", "units", "bytes", "what"):
        table.add_column(column, justify="left" if column in ("source", "what") else "right")
    for source, what in show.what.items():
        table.add_row(source, f"{report.units[source]:,}", f"{report.bytes[source]:,}", what)
    return table


def logged_by_source(logs: Path, sources: Iterable[str]) -> tuple[dict[str, str], Counter[str], Counter[str]]:
    """Return digest, bytes and units of each source in the log, read with the official reader, CRCs checked."""
    digests = {source: hashlib.sha256() for source in sources}
    sizes: Counter[str] = Counter()
    units: Counter[str] = Counter()
    for path in sorted(logs.glob("*.mcap")):
        with path.open("rb") as file:
            for _, channel, message in make_reader(file, validate_crcs=True).iter_messages(log_time_order=False):
                source = source_of_topic(channel.topic)
                if source is not None:
                    units[source] += 1
                    digests[source].update(message.data)
                    sizes[source] += len(message.data)
    return {source: digest.hexdigest() for source, digest in digests.items()}, sizes, units


def prove(console: Console, logs: Path, outputs: Mapping[str, Hashed], report: PlayReport) -> bool:
    """Compare what was sent with what is in the log, byte by byte by their digests."""
    digests, sizes, units = logged_by_source(logs, outputs)
    table = Table(title="every byte sent is in the log (read with the official MCAP reader)", title_justify="left")
    for column in ("source", "bytes sent", "bytes in the log", "sha256", ""):
        table.add_column(column)
    good = True
    for source, output in outputs.items():
        if source.startswith("pps/"):
            same = units[source] == report.units[source]
            row = (source, f"{report.units[source]} edges", f"{units[source]} edges", "")
        else:
            same = digests[source] == output.digest.hexdigest() and sizes[source] == output.bytes
            row = (source, f"{output.bytes:,}", f"{sizes[source]:,}", digests[source][:16] + "…")
        good = good and same and not report.refused[source]
        table.add_row(*row, "[green]same[/]" if same else "[red]DIFFERENT[/]")
    console.print(table)
    return good


def perform(console: Console, folder: Path, show: Show) -> bool:
    """Record, show, prove; the configuration is the folder's ``swath.toml``, its logs go to ``logs``."""
    opened = open_outputs(load_config(folder / "swath.toml"), with_pps=True)
    outputs = {source: Hashed(output) for source, output in opened.items()}
    allowed = os.sched_getaffinity(0)  # playing leaves this thread on one processor, and what it starts later too
    recorder: subprocess.Popen[bytes] | None = None
    try:
        recorder = start_recorder(folder, len(show.what))
        with Live(console=console, refresh_per_second=4) as live:

            def tell(played_s: float, report: PlayReport) -> None:
                live.update(progress_table(show, played_s, report))

            report = play(show.units, outputs, progress=tell)
            tell(show.seconds, report)
        console.print()
        time.sleep(1.5)  # one more status with everything in it
        recorder.send_signal(signal.SIGTERM)
        ended = recorder.wait(END_S)
    finally:
        if recorder is not None and recorder.poll() is None:
            recorder.kill()
        os.sched_setaffinity(0, allowed)
        close_outputs(opened)
    console.print(f"[bold]$ swath info {folder}/logs[/]")
    info = subprocess.run([sys.executable, "-m", "swath.daemon.cli.main", "info", str(folder / "logs")], check=False)
    console.print(show.remark)
    good = prove(console, folder / "logs", outputs, report)
    return good and ended == 0 and info.returncode == 0
