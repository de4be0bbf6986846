"""``make demo``: real recordings on real wires into a real recorder, and the proof that every byte is in the log.

python -m demo [--seconds 30] [--keep DIR]
"""

from __future__ import annotations

import argparse
import hashlib
import heapq
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from mcap.reader import make_reader
from rich.console import Console
from rich.live import Live
from rich.table import Table

from daemon.config import load_config
from daemon.replay import close_outputs, open_outputs, source_of_topic
from daemon.wire_player import Output, PlayReport, TimedUnit, play
from demo.captures import can_units, gnss_units, pps_units, scanner_units, until

WHAT = {
    "gnss/rover": "NovAtel ProPak6 SPAN, 2014, through a pty",
    "imu/main": "CANmod.gps, 2021, through a CAN bus (udp_multicast)",
    "scanner/top": "Velodyne VLP-16 with PPS, 2016, through UDP",
    "scanner/top/aux": "its position packets, second UDP port",
    "pps/main": "edges that belong to the GNSS recording",
}
CONFIG = """[session]
name = "demo"
directory = "{folder}/logs"
reserve_mb = 64

[pps.main]
source = "fixed:{folder}/pps"

[gnss.rover]
transport = "serial:{folder}/rover?baud=115200"
protocol = "novatel"
pps = "main"

[imu.main]
transport = "can:udp_multicast:239.74.163.2?port={can_port}"
protocol = "canmod-gps"

[scanner.top]
transport = "udp:127.0.0.1:{data_port}"
auxiliary = "udp:127.0.0.1:{position_port}"
protocol = "velodyne-vlp16"
installation = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
"""


class Hashed(Output):
    """An output that remembers what it sent."""

    def __init__(self, output: Output) -> None:
        self._output = output
        self.digest = hashlib.sha256()
        self.bytes = 0

    def send(self, data: bytes, due_realtime_ns: int) -> bool:
        """Send and remember."""
        sent = self._output.send(data, due_realtime_ns)
        if sent:
            self.digest.update(data)
            self.bytes += len(data)
        return sent

    def has_reader(self) -> bool:
        """As the output itself."""
        return self._output.has_reader()

    def close(self) -> None:
        """Close."""
        self._output.close()


def free_ports(count: int) -> list[int]:
    """UDP ports that nobody has."""
    sockets = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(count)]
    for sock in sockets:
        sock.bind(("127.0.0.1", 0))
    ports = [sock.getsockname()[1] for sock in sockets]
    for sock in sockets:
        sock.close()
    return ports


def all_units(seconds: float) -> Iterator[TimedUnit]:
    """Everything, in order of time."""
    streams = [
        until(stream, seconds) for stream in (gnss_units(), can_units(), scanner_units(seconds), pps_units(seconds))
    ]
    return heapq.merge(*streams, key=lambda unit: unit.time_ns)


def start_recorder(folder: Path, sources: int) -> subprocess.Popen[bytes]:
    """``swath run``, all its devices open."""
    journal = folder / "journal.txt"
    with journal.open("w") as stderr:
        command = [sys.executable, "-m", "daemon.cli.main", "run", str(folder / "swath.toml")]
        recorder = subprocess.Popen(command, stderr=stderr)
    deadline = time.monotonic() + 30
    while journal.read_text().count("device_opened") < sources:
        if recorder.poll() is not None or time.monotonic() > deadline:
            recorder.kill()
            raise SystemExit(f"the recorder did not start:\n{journal.read_text()}")
        time.sleep(0.05)
    return recorder


def progress_table(seconds: float, total: float, report: PlayReport) -> Table:
    """What has been sent so far."""
    table = Table(title=f"playing {seconds:4.1f} of {total:.0f} s, as fast as it was recorded", title_justify="left")
    for column in ("source", "units", "bytes", "recording"):
        table.add_column(column, justify="left" if column in ("source", "recording") else "right")
    for source, what in WHAT.items():
        table.add_row(source, f"{report.units[source]:,}", f"{report.bytes[source]:,}", what)
    return table


def logged_by_source(logs: Path) -> tuple[dict[str, str], Counter[str], Counter[str]]:
    """Digest, bytes and units of each source in the log, read with the official reader, CRCs checked."""
    digests = {source: hashlib.sha256() for source in WHAT}
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


def prove(console: Console, logs: Path, outputs: dict[str, Hashed], report: PlayReport) -> bool:
    """Compare what was sent with what is in the log, byte by byte by their digests."""
    digests, sizes, units = logged_by_source(logs)
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


def demonstrate(console: Console, folder: Path, seconds: float) -> bool:
    """Record, show, prove."""
    data_port, position_port, can_port = free_ports(3)
    config_path = folder / "swath.toml"
    text = CONFIG.format(folder=folder, can_port=can_port, data_port=data_port, position_port=position_port)
    config_path.write_text(text)
    opened = open_outputs(load_config(config_path), with_pps=True)
    outputs = {source: Hashed(output) for source, output in opened.items()}
    try:
        recorder = start_recorder(folder, len(WHAT))
        with Live(console=console, refresh_per_second=4) as live:

            def tell(played_s: float, report: PlayReport) -> None:
                live.update(progress_table(played_s, seconds, report))

            report = play(all_units(seconds), outputs, progress=tell)
            tell(seconds, report)
        time.sleep(1.5)  # one more status with everything in it
        recorder.send_signal(signal.SIGTERM)
        ended = recorder.wait(30)
    finally:
        close_outputs(opened)
    console.print(f"[bold]$ swath info {folder}/logs[/]")
    info = subprocess.run([sys.executable, "-m", "daemon.cli.main", "info", str(folder / "logs")], check=False)
    console.print(
        "The recordings are of different days and places: the time of each source stands on its own, "
        "and only the GNSS recording has PPS edges here."
    )
    good = prove(console, folder / "logs", outputs, report)
    return good and ended == 0 and info.returncode == 0


def main() -> int:
    """The demonstration; 0 when everything is as it should be."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--keep", type=Path, help="folder for the log; without it the log is removed at the end")
    arguments = parser.parse_args()
    console = Console(width=None if sys.stdout.isatty() else 110)
    folder = Path(tempfile.mkdtemp(prefix="swath-demo-")) if arguments.keep is None else arguments.keep.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    try:
        good = demonstrate(console, folder, arguments.seconds)
    finally:
        if arguments.keep is None:
            shutil.rmtree(folder)
    if arguments.keep is not None:
        console.print(f"the log is in {folder}{os.sep}logs")
    console.print("[bold green]demonstration passed[/]" if good else "[bold red]demonstration FAILED[/]")
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
