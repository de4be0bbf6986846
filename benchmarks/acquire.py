"""Measure what recording costs: CPU time of the recorder's process, losses and memory.

python -m benchmarks.acquire [--seconds 60] [--repeats 3] [--only LINE] [--json FILE]

Beside each CPU figure stands a limit: what the bare building blocks cost in the same run. They read with recvmmsg
and write each batch to a file, without time stamps, log format, checksums or index. Sender and receiver share the
machine.
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import json
import operator
import os
import signal
import socket
import statistics
import subprocess
import sys
import tempfile
import threading
import time
import tty
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

from swath.daemon.log.reader import open_logs

TICKS = os.sysconf("SC_CLK_TCK")
CAN_GROUP = "239.74.163.99"
PAGE = os.sysconf("SC_PAGE_SIZE")


@dataclass
class Figure:
    """One line of the table, with the recorder's counts and costs."""

    name: str
    sent: int
    recorded: int
    cpu_percent: float
    limit_cpu_percent: float | None
    rss_mb: float
    note: str = ""
    lost: dict[str, int] = field(default_factory=dict)


def cpu_s(pid: int) -> float:
    """Return the CPU seconds, user and system, that a process has used so far."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / TICKS


def rss_mb(pid: int) -> float:
    """Return the resident memory of a process, in megabytes."""
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * PAGE / 1e6


def free_port() -> int:
    """Return a UDP port that no process uses."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


@contextlib.contextmanager
def recorder(folder: Path, tables: str) -> Iterator[subprocess.Popen[bytes]]:
    """Run ``swath run`` with these configuration tables.

    Yields the process once it records; terminates it on exit and waits for its end.

    Raises:
        SystemExit: the recorder ended before it recorded.
    """
    config = folder / "swath.toml"
    logs = folder / "logs"
    config.write_text(f'[session]\nname = "bench"\ndirectory = "{logs}"\nreserve_mb = 1\n{tables}')
    with (folder / "stderr.txt").open("w") as stderr:
        process = subprocess.Popen([sys.executable, "-m", "swath.daemon.cli.main", "run", str(config)], stderr=stderr)
    try:
        while not (logs / "recording.json").exists():
            if process.poll() is not None:
                raise SystemExit((folder / "stderr.txt").read_text())
            time.sleep(0.05)
        time.sleep(1.0)
        yield process
    finally:
        process.send_signal(signal.SIGTERM)
        process.wait(60)


def sender(*words: object) -> subprocess.Popen[str]:
    """Start a process of `benchmarks.senders` with these arguments."""
    command = [sys.executable, "-m", "benchmarks.senders", *map(str, words)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True)


def scanner_table(port: int) -> str:
    """Return the configuration table of a scanner on a UDP port."""
    return f'[scanner.left]\ntransport = "udp:127.0.0.1:{port}"\nprotocol = "srep"\nmirror_factor = 1.0\n'


def last_status(folder: Path) -> dict[str, dict[str, int]]:
    """Return the last status of each source in the log."""
    statuses: dict[str, dict[str, int]] = {}
    for session in open_logs([folder / "logs"]):
        for batch in session.batches(lambda topic: topic.startswith("/status/")):
            statuses[batch.channel.topic.removeprefix("/status/")] = json.loads(batch.units[-1].tobytes())
    return statuses


def record_udp(length: int, rate: float, seconds: float) -> Figure:
    """Record datagrams of one length and rate, and return the recorder's figures."""
    with tempfile.TemporaryDirectory() as scratch:
        folder, port = Path(scratch), free_port()
        with recorder(folder, scanner_table(port)) as process:
            before, started = cpu_s(process.pid), time.monotonic()
            load = sender("udp", port, length, rate, seconds)
            highest = 0.0
            while load.poll() is None:
                highest = max(highest, rss_mb(process.pid))
                time.sleep(0.25)
            cpu = (cpu_s(process.pid) - before) / (time.monotonic() - started) * 100
            assert load.stdout is not None
            sent_text, took_text = load.stdout.read().split()
            time.sleep(2.0)
        status = last_status(folder)["scanner/left"]
    sent, took = int(sent_text), float(took_text)
    note = f"{sent / took:,.0f} datagrams/s, {sent * length / took / 1e6:.0f} MB/s"
    lost = {key: status[key] for key in ("lost_kernel", "lost_queue", "lost_write") if status[key]}
    name = f"UDP {rate:,.0f} × {length} B/s"
    return Figure(name, sent, status["written"], cpu, None, highest, note, lost)


BARE = """
import os, socket, sys, time
from swath.drivers.transports.datagrams import MessageReader, ask_receive_buffer
port, path = int(sys.argv[1]), sys.argv[2]
sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
ask_receive_buffer(sock, 32 << 20)
sock.bind(("127.0.0.1", port))
reader = MessageReader(65535, 256, peers=False)
reader._expected = int(sys.argv[3])
fd = os.open(path, os.O_WRONLY | os.O_CREAT)
print("ready", flush=True)
total = 0
while True:
    time.sleep(0.004)
    while count := reader.read(sock.fileno()):
        total += count
        os.write(fd, reader.rows(count))
        if count < reader.offered:
            break
"""


def bare_udp(length: int, rate: float, seconds: float) -> float:
    """Return the CPU percent of the bare building blocks for these datagrams."""
    with tempfile.TemporaryDirectory() as name:
        port = free_port()
        command = [sys.executable, "-c", BARE, str(port), f"{name}/raw", str(length)]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        try:
            assert process.stdout is not None
            process.stdout.readline()
            before, started = cpu_s(process.pid), time.monotonic()
            sender("udp", port, length, rate, seconds).communicate()
            return (cpu_s(process.pid) - before) / (time.monotonic() - started) * 100
        finally:
            process.kill()
            process.communicate()


def stall(seconds: float) -> Figure:
    """Record 20 000 datagrams a second while the recorder is stopped for half a second (SIGSTOP)."""
    with tempfile.TemporaryDirectory() as name:
        folder, port = Path(name), free_port()
        with recorder(folder, scanner_table(port)) as process:
            load = sender("udp", port, 1206, 20000, seconds)
            time.sleep(seconds / 2)
            process.send_signal(signal.SIGSTOP)
            time.sleep(0.5)
            process.send_signal(signal.SIGCONT)
            out, _ = load.communicate()
            time.sleep(2.0)
        status = last_status(folder)["scanner/left"]
    granted = status["receive_buffer_bytes"]
    note = f"receive buffer granted {granted / 1e6:.0f} MB"
    return Figure("0.5 s stall at 20,000 × 1206 B/s", int(out.split()[0]), status["written"], 0.0, None, 0.0, note)


@contextlib.contextmanager
def serial_port(folder: Path) -> Iterator[int]:
    """Open a pseudo-terminal at ``folder``/rover and yield the descriptor to write to."""
    master, slave = os.openpty()
    tty.setraw(slave)
    (folder / "rover").symlink_to(os.ttyname(slave))
    try:
        yield master
    finally:
        os.close(master)
        os.close(slave)


@contextlib.contextmanager
def other_load(master: int, seconds: float) -> Iterator[list[int]]:
    """Send GNSS data at 921600 baud through a pseudo-terminal and 1000 CAN frames a second on a udp_multicast bus.

    Yields a list, to which the number of CAN frames sent is appended on exit.
    """
    writer = threading.Thread(target=_write_serial, args=(master, 92160.0, seconds))
    writer.start()
    can = sender("can", CAN_GROUP, 1000, seconds)
    sent: list[int] = []
    try:
        yield sent
    finally:
        writer.join()
        sent.append(int(can.communicate()[0]))


def with_others(seconds: float) -> Figure:
    """Measure what a GNSS receiver and a CAN unit cost in addition to a scanner.

    The scanner sends 20 000 datagrams a second, in a first recording alone, in a second one beside the other sensors.
    """
    cpu: list[float] = []
    for others in (False, True):
        with tempfile.TemporaryDirectory() as name, serial_port(Path(name)) as master:
            folder, port = Path(name), free_port()
            tables = scanner_table(port) + (
                f'[gnss.rover]\ntransport = "serial:{folder}/rover?baud=921600"\nprotocol = "nmea"\n'
                f'[imu.main]\ntransport = "can:udp_multicast:{CAN_GROUP}"\nprotocol = "canmod-gps"\n'
            )
            with recorder(folder, tables) as process:
                before, started = cpu_s(process.pid), time.monotonic()
                with contextlib.ExitStack() as load:
                    sent = load.enter_context(other_load(master, seconds)) if others else []
                    sender("udp", port, 1206, 20000, seconds).communicate()
                    cpu.append((cpu_s(process.pid) - before) / (time.monotonic() - started) * 100)
                memory = rss_mb(process.pid)
                time.sleep(2.0)
            status = last_status(folder)
    note = f"on top of {cpu[0]:.1f} % for the scanner; GNSS {status['gnss/rover']['bytes']:,} bytes"
    name = "GNSS 921600 baud + CAN 1000 frames/s"
    return Figure(name, sent[0], status["imu/main"]["written"], cpu[1] - cpu[0], bare_others(seconds), memory, note)


BARE_OTHERS = """
import os, sys, threading, time
import can
fd = os.open(sys.argv[1], os.O_RDONLY | os.O_NOCTTY)
bus = can.Bus(interface="udp_multicast", channel=sys.argv[2])
out = os.open(sys.argv[3], os.O_WRONLY | os.O_CREAT)
print("ready", flush=True)
def serial():
    while True:
        time.sleep(0.008)
        os.write(out, os.read(fd, 65536))
def frames():
    while True:
        time.sleep(0.016)
        while (message := bus.recv(0)) is not None:
            os.write(out, message.data)
threading.Thread(target=serial, daemon=True).start()
frames()
"""


def bare_others(seconds: float) -> float:
    """Return the CPU percent of reading the same port and bus and writing the bytes to a file."""
    with tempfile.TemporaryDirectory() as name, serial_port(Path(name)) as master:
        command = [sys.executable, "-c", BARE_OTHERS, f"{name}/rover", CAN_GROUP, f"{name}/raw"]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        try:
            assert process.stdout is not None
            process.stdout.readline()
            before, started = cpu_s(process.pid), time.monotonic()
            with other_load(master, seconds):
                pass
            return (cpu_s(process.pid) - before) / (time.monotonic() - started) * 100
        finally:
            process.kill()
            process.communicate()


def no_data(seconds: float) -> Figure:
    """Measure what a recorder costs that receives no data."""
    with tempfile.TemporaryDirectory() as name:
        with recorder(Path(name), scanner_table(free_port())) as process:
            before, started = cpu_s(process.pid), time.monotonic()
            time.sleep(seconds)
            cpu = (cpu_s(process.pid) - before) / (time.monotonic() - started) * 100
            memory = rss_mb(process.pid)
    return Figure("no data", 0, 0, cpu, None, memory)


def _write_serial(fd: int, bytes_per_s: float, seconds: float) -> None:
    """Write NMEA sentences to a descriptor at a rate, for so many seconds."""
    body = b"PSWTH," + b"x" * 97
    line = b"$%s*%02X\r\n" % (body, functools.reduce(operator.xor, body))
    sent, start = 0, time.monotonic()
    while (elapsed := time.monotonic() - start) < seconds:
        while sent < elapsed * bytes_per_s:
            sent += os.write(fd, line)
        time.sleep(0.001)


def sustained(length: int, rate: float, seconds: float, bare_seconds: float) -> Figure:
    """Record datagrams of one length and rate, and add what the bare building blocks cost for the same."""
    figure = record_udp(length, rate, seconds)
    figure.limit_cpu_percent = bare_udp(length, rate, bare_seconds)
    return figure


LOADS: dict[str, Callable[[float], Figure]] = {
    "small": lambda seconds: sustained(1206, 20000.0, seconds, min(seconds, 15.0)),
    "large": lambda seconds: sustained(8448, 5000.0, seconds, min(seconds, 15.0)),
    "fast": lambda seconds: sustained(1206, 110000.0, 10.0, 5.0),
    "stall": lambda seconds: stall(6.0),
    "others": with_others,
    "idle": lambda seconds: no_data(10.0),
}


def median(runs: list[Figure]) -> Figure:
    """Return the run with the median CPU; its note lists the losses and the CPU range of all runs."""
    middle = sorted(runs, key=lambda figure: figure.cpu_percent)[len(runs) // 2]
    lost = sum(figure.sent - figure.recorded for figure in runs)
    where = "; ".join(f"{key} {count}" for figure in runs for key, count in figure.lost.items())
    spread = f"{min(f.cpu_percent for f in runs):.1f} to {max(f.cpu_percent for f in runs):.1f}"
    limits = [figure.limit_cpu_percent for figure in runs if figure.limit_cpu_percent is not None]
    bare = statistics.median(limits) if limits else None
    note = f"{middle.note}; {lost} lost in {len(runs)} runs{f' ({where})' if where else ''}; {spread} %"
    return replace(middle, limit_cpu_percent=bare, rss_mb=max(f.rss_mb for f in runs), note=note)


def main() -> None:
    """Measure and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0, help="duration of the sustained loads")
    parser.add_argument(
        "--only", choices=LOADS, action="append", help="measure only this line of the table; may be repeated"
    )
    parser.add_argument("--repeats", type=int, default=3, help="number of runs; the table gives their medians")
    parser.add_argument("--json", type=Path, help="also write the figures to this file")
    arguments = parser.parse_args()
    chosen = [load for name, load in LOADS.items() if name in (arguments.only or LOADS)]
    runs = [[load(arguments.seconds) for load in chosen] for _ in range(arguments.repeats)]
    figures = [median(list(lines)) for lines in zip(*runs, strict=True)]
    print(f"{'load':<38} {'sent':>10} {'recorded':>10} {'CPU %':>6} {'bare %':>7} {'RSS MB':>7}  note")
    for figure in figures:
        bare = f"{figure.limit_cpu_percent:7.1f}" if figure.limit_cpu_percent is not None else "      -"
        print(
            f"{figure.name:<38} {figure.sent:>10,} {figure.recorded:>10,} {figure.cpu_percent:6.1f} {bare} "
            f"{figure.rss_mb:7.0f}  {figure.note}"
        )
    if arguments.json:
        arguments.json.write_text(json.dumps([asdict(figure) for figure in figures], indent=1))


if __name__ == "__main__":
    main()
