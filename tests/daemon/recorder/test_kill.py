"""Tests kill -9 at a hundred random moments: what was sent half a second before is in the log.

The half second counts only time in which the machine ran: delays of a bystander process are subtracted.
"""

from __future__ import annotations

import json
import os
import random
import signal
import socket
import subprocess
import sys
import threading
import time
import tty
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import pytest

from swath.daemon.log.claim import is_being_written
from swath.daemon.log.reader import open_logs
from swath.daemon.log.recover import recover
from tests.daemon.log_check import official_counts
from tests.daemon.rig import HANGS_S, free_udp_port, session_table, wait_until

KILLS = 100
AT_ONCE = 6
LOSS_S = 0.5
HELD_UP_S = 0.02
BYSTANDER = """
import os, sys, time
waits, pages = (os.open(name, os.O_CREAT | os.O_WRONLY | os.O_TRUNC) for name in sys.argv[1:3])
held_up_s, before = float(sys.argv[3]), time.monotonic()
while True:
    time.sleep(0.001)
    os.pwrite(pages, bytes(4096), 0)
    now = time.monotonic()
    if now - before > held_up_s:
        os.write(waits, b"%.6f %.6f\\n" % (before, now))
    before = now
"""


class Bystander:
    """A process that wants to write a page every millisecond, and notes when it could not."""

    def __init__(self, folder: Path) -> None:
        self._waits = folder / "waits"
        command = [sys.executable, "-c", BYSTANDER, str(self._waits), str(folder / "pages"), str(HELD_UP_S)]
        self._process = subprocess.Popen(command)
        wait_until(self._waits.exists, "the bystander")

    def close(self) -> None:
        self._process.kill()
        self._process.wait(HANGS_S)

    def since(self, until: float, running_s: float) -> float:
        """Return the time (monotonic s) from which the machine ran `running_s` seconds in total until `until`."""
        moment = until
        for line in reversed(self._waits.read_text().splitlines()):
            begin, end = (float(word) for word in line.split())
            ran_s = moment - min(end, moment)
            if ran_s >= running_s:
                break
            moment, running_s = min(begin, moment), running_s - ran_s
        return moment - running_s


class ForkServer:
    """A process that forks recorders on demand."""

    def __init__(self) -> None:
        command = [sys.executable, "-m", "tests.daemon.fork_server"]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        self._lock = threading.Lock()

    def start(self, config: Path) -> int:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        with self._lock:
            self._process.stdin.write(f"{config}\n")
            self._process.stdin.flush()
            return int(self._process.stdout.readline())

    def close(self) -> None:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.close()
        self._process.wait(HANGS_S)
        self._process.stdout.close()


@pytest.fixture
def bystander(tmp_path: Path) -> Iterator[Bystander]:
    process = Bystander(tmp_path)
    yield process
    process.close()


@pytest.fixture(scope="module")
def server() -> Iterator[ForkServer]:
    fork_server = ForkServer()
    yield fork_server
    fork_server.close()


@dataclass
class Sent:
    """Numbered units of each stream with the monotonic second at which each was sent."""

    times: dict[str, list[float]]


def send_until(stop: threading.Event, port: int, master: int, fifo: int, sent: Sent) -> None:
    """Send a datagram each millisecond, a line every 10 ms and an edge every 100 ms, all numbered."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        number = 0
        while not stop.is_set():
            sent.times["scanner"].append(time.monotonic())
            sock.sendto(number.to_bytes(4, "little") + b"x" * 200, ("127.0.0.1", port))
            if number % 10 == 0:
                sent.times["gnss"].append(time.monotonic())
                os.write(master, b"$P,%08d\r\n" % (number // 10))
            if number % 100 == 0:
                sent.times["pps"].append(time.monotonic())
                os.write(fifo, b"%d %d\n" % (time.time_ns(), number // 100 + 1))
            number += 1
            time.sleep(0.001)


def record_and_kill(server: ForkServer, bystander: Bystander, folder: Path, after_s: float) -> None:
    """Run one recorder, kill it, and check its log."""
    folder.mkdir()
    port, link, fifo_path, logs = free_udp_port(), folder / "rover", folder / "pps", folder / "logs"
    master, slave = os.openpty()
    tty.setraw(slave)
    link.symlink_to(os.ttyname(slave))
    os.mkfifo(fifo_path)
    fifo = os.open(fifo_path, os.O_RDWR)
    config = folder / "swath.toml"
    config.write_text(
        session_table(logs, compression='"none"')
        + f'[scanner.left]\ntransport = "udp:127.0.0.1:{port}"\nprotocol = "srep"\nmirror_factor = 1.0\n'
        + f'[gnss.rover]\ntransport = "serial:{link}"\nprotocol = "nmea"\npps = "main"\n'
        + f'[pps.main]\nsource = "fixed:{fifo_path}"\n'
    )
    pid = server.start(config)
    wait_until(lambda: opened_devices(logs) == 3, "three devices opened, and that in the log")
    stop, sent = threading.Event(), Sent({"scanner": [], "gnss": [], "pps": []})
    thread = threading.Thread(target=send_until, args=(stop, port, master, fifo, sent))
    thread.start()
    time.sleep(after_s)
    os.kill(pid, signal.SIGKILL)
    killed = time.monotonic()
    stop.set()
    thread.join()
    for fd in (master, slave, fifo):
        os.close(fd)
    wait_until(lambda: not is_being_written(next(logs.glob("*.mcap"))), "the killed recorder to be gone")
    check_what_is_left(logs, sent, bystander.since(killed, LOSS_S))


def opened_devices(logs: Path) -> int:
    """Return the number of devices that the uncompressed log reports as open."""
    return sum(path.read_bytes().count(b'"code":"device_opened"') for path in logs.glob("*.mcap"))


def check_what_is_left(logs: Path, sent: Sent, safe: float) -> None:
    """Check that the file has every unit sent until `safe` (monotonic s), and the recovered file the same units."""
    (path,) = logs.glob("*.mcap")
    found = numbers_in(path)
    for stream, times in sent.times.items():
        expected = [n for n, at in enumerate(times) if at < safe]
        missing = set(expected) - set(found[stream])
        assert not missing, f"{stream}: {len(missing)} units sent {LOSS_S} s before the kill are missing"
    report = recover(path)
    recovered = path.with_suffix(".recovered.mcap")
    assert report is not None
    assert numbers_in(recovered) == found
    counts = official_counts(recovered)
    assert counts["/scanner/left/raw"] == len(found["scanner"])
    assert counts["/pps/main"] == len(found["pps"])


def numbers_in(path: Path) -> dict[str, list[int]]:
    """Return the numbers of each stream's units in a log."""
    found: dict[str, list[int]] = {"scanner": [], "pps": []}
    text = b""
    for session in open_logs([path]):
        for batch in session.batches():
            for row in batch.units:
                data = row.tobytes()
                if batch.channel.topic.startswith("/scanner"):
                    found["scanner"].append(int.from_bytes(data[:4], "little"))
                elif batch.channel.topic.startswith("/pps"):
                    found["pps"].append(json.loads(data)["sequence"] - 1)
                elif batch.channel.topic == "/gnss/rover/raw":
                    text += data
    lines = text.split(b"\r\n")[:-1]
    return found | {"gnss": [int(line.split(b",")[1]) for line in lines if line.startswith(b"$P,") and len(line) == 11]}


@pytest.mark.slow
@pytest.mark.alone
def test_a_recorder_killed_at_random_moments_loses_only_open_chunks(
    server: ForkServer, bystander: Bystander, tmp_path: Path
) -> None:
    rng = random.Random(20261121)
    moments = [rng.uniform(0.05, 2.0) for _ in range(KILLS)]
    with ThreadPoolExecutor(AT_ONCE) as pool:
        jobs = [
            pool.submit(record_and_kill, server, bystander, tmp_path / str(number), after_s)
            for number, after_s in enumerate(moments)
        ]
        for job in jobs:
            job.result()
