"""Measure how fast `swath import` reads bags of ROS, and the most memory that it takes.

python -m benchmarks.import_bag [--megabytes 2000] [--containers db3 mcap bag]

Bags of VLP-16 packets, in scans of a tenth of a second, are made in a temporary folder: one a tenth as large as asked
for, and one as large. Each is imported by a process of its own. *Read* is the rate of the reader alone, *import* that
of the whole import to the log on the disk, by bytes of the bag, once by the clock and once by CPU time. The limit is
`cp` of the same bag in the same run.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, get_args

import numpy as np

from swath.drivers.captures.opening import read_bag
from tests.drivers.captures.bags import START_NS, Container, Ros, bag_writer

SCAN, PACKET, TOPIC = "velodyne_msgs/msg/VelodyneScan", "velodyne_msgs/msg/VelodynePacket", "/velodyne_packets"
PACKETS, STEP_NS = 150, 663_000
CONFIG = """
[session]
name = "bench"

[scanner.top]
transport = "udp:0.0.0.0:2368"
protocol = "velodyne-vlp16"
installation = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
"""


def make_bag(path: Path, container: Container, size: float) -> Path:
    """Write a bag of about ``size`` bytes and return its file."""
    ros = Ros(container)
    serialise: Any = ros.store.serialize_ros1 if container == "bag" else ros.store.serialize_cdr
    rng = np.random.default_rng(0)
    stamped: list[tuple[int, bytes]] = [(0, rng.bytes(1206)) for _ in range(PACKETS)]
    scan = ros.scan(SCAN, PACKET, stamped)
    writer, file = bag_writer(path, container)
    with writer:
        connection = writer.add_connection(TOPIC, SCAN, typestore=ros.store)
        time_ns, written = START_NS, 0
        while written < size:
            for packet in scan.packets:
                packet.stamp.sec, packet.stamp.nanosec = divmod(time_ns, 10**9)
                time_ns += STEP_NS
            data = serialise(scan, SCAN)
            writer.write(connection, time_ns, data)
            written += len(data)
    return file


def run_import(folder: Path, bag: Path) -> tuple[float, float, int]:
    """Import a bag by a process of its own; return seconds, seconds of CPU time, and the most bytes of memory."""
    config, logs = folder / "config.toml", folder / "logs"
    config.write_text(CONFIG)
    words = [sys.executable, "-m", "swath.daemon.cli.main", "import", str(config), str(bag), "-o", str(logs)]
    started = time.perf_counter()
    process = subprocess.Popen(words, stdout=subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    seconds = time.perf_counter() - started
    if process.returncode:
        raise SystemExit(f"swath import ended with {process.returncode}")
    shutil.rmtree(logs)
    return seconds, usage.ru_utime + usage.ru_stime, usage.ru_maxrss * 1024


def main(arguments: Sequence[str] = ()) -> None:
    """Measure and print a line for each bag."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--megabytes", type=float, default=2000.0)
    parser.add_argument("--containers", nargs="+", choices=get_args(Container), default=get_args(Container))
    options = parser.parse_args(arguments)
    print("| bag | MB | read MB/s | import MB/s | import MB a CPU second | memory MB | cp MB/s |")
    print("|---|---|---|---|---|---|---|")
    for container in options.containers:
        for size in (0.1e6 * options.megabytes, 1e6 * options.megabytes):
            with tempfile.TemporaryDirectory(prefix="swath-bench-") as name:
                folder = Path(name)
                bag = make_bag(folder / "bag", container, size)
                length = bag.stat().st_size / 1e6
                started = time.perf_counter()
                shutil.copyfile(bag, folder / "copy")
                copy_s = time.perf_counter() - started
                (folder / "copy").unlink()
                started = time.perf_counter()
                for _ in read_bag(bag, [TOPIC]):
                    pass
                read_s = time.perf_counter() - started
                import_s, cpu_s, memory = run_import(folder, bag)
                rates = [length / seconds for seconds in (read_s, import_s, cpu_s, copy_s)]
                rates.insert(3, memory / 1e6)
                print(f"| {container} | {length:.0f} | {' | '.join(f'{rate:.0f}' for rate in rates)} |", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
