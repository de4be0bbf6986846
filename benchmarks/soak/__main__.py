"""Test a recorder with a full set of sensors over a long time for leaks, drift, losses and unexpected events.

python -m benchmarks.soak [--minutes 60] [--rate 0.1] [--keep DIR]

At rate 1 the sensors are two scanners of 10 000 datagrams/s, GNSS receivers of 921600 and 115200 baud, inertial units
of 1000 and 200 samples/s on CAN, and PPS. --rate is the share of these rates at which they send; PPS and time messages
keep their rate. Every part is read as soon as it is finished, with the official MCAP reader too, and removed unless
--keep is given, so that the disk does not limit the duration. Latency is the age of a chunk's oldest message, by its
arrival stamp, when the chunk can be read; all other messages are younger. Exit status 1 if a check fails.
"""

from __future__ import annotations

import argparse
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from benchmarks.acquire import cpu_s, free_port
from benchmarks.soak.log import Found
from benchmarks.soak.sensors import InertialUnit, Pulse, Receiver, Scanner, Sensor
from benchmarks.soak.watchers import Watcher, note_ages, read_parts

DBC = Path(__file__).resolve().parents[2] / "fixtures" / "config" / "imu.dbc"
EXPECTED_EVENTS = {
    "session_started",
    "session_ended",
    "device_opened",
    "second_known",
    "part_opened",
    "part_closed",
    "receive_buffer_small",  # depends on the machine, whose kernel settings need not be those of an aircraft's
}
WARM_UP = 0.2  # share of the run that is left out where memory and descriptors are judged
RSS_GROWTH_MB = 3.0  # from the second third after the warm-up to the last; an hour shows a leak of 1 kB/s
LATER = 1.5  # greatest median latency of the last third, in multiples of the first third's
PERCENTILES = (50.0, 95.0, 99.0, 99.9)
PARTS = 12  # of a run, so that the index of the growing part rises and falls several times
PART_MINUTES = 2.0  # at most, as the disk must hold a part that is read beside the one that grows

TABLES = """[session]
name = "soak"
directory = "{folder}/logs"
reserve_mb = 500
split_minutes = {split_minutes}
[pps.main]
source = "fixed:{folder}/pps"
[gnss.rover]
transport = "serial:{folder}/rover?baud=921600"
protocol = "nmea"
pps = "main"
leap_seconds = 18
[gnss.base]
transport = "serial:{folder}/base?baud=115200"
protocol = "nmea"
leap_seconds = 18
"""
SCANNER = """[scanner.{name}]
transport = "udp:127.0.0.1:{port}"
protocol = "srep"
mirror_factor = 1.0
"""
IMU = """[imu.{name}]
transport = "can:udp_multicast:{group}?port={port}"
protocol = "dbc"
dbc = "{dbc}"
rate_hz = {rate_hz}
[imu.{name}.signals]
specific_force = ["ACC.acc_x", "ACC.acc_y", "ACC.acc_z"]
angular_rate = ["GYR.gyr_x", "GYR.gyr_y", "GYR.gyr_z"]
sample_ticks = "SAMPLE.ticks"
temperature = "SAMPLE.temperature"
packet_counter = "SAMPLE.packet_counter"
"""
CAN_GROUP = "239.74.163.98"


@dataclass
class Sample:
    """The memory and open files of the recorder at one moment."""

    seconds: float
    rss_mb: float
    descriptors: int


class Soak:
    """One run of the soak, with all that was found.

    Args:
        folder: folder for all files.
        minutes: duration of the run.
        rate: share of the sensors' full rates.
        keep: whether parts are left in the folder.
    """

    def __init__(self, folder: Path, minutes: float, rate: float, *, keep: bool) -> None:
        self._folder, self._minutes, self._keep = folder, minutes, keep
        self._can_port = free_port()
        ports = free_port(), free_port()
        self.sensors: list[Sensor] = [
            Pulse("pps/main", folder / "pps"),
            Receiver("gnss/rover", folder / "rover", 92_160 * rate),
            Receiver("gnss/base", folder / "base", 11_520 * rate),
            InertialUnit("imu/main", CAN_GROUP, self._can_port, 1000 * rate),
            InertialUnit("imu/spare", CAN_GROUP, self._can_port + 1, 200 * rate),
            Scanner("scanner/left", ports[0], 10_000 * rate),
            Scanner("scanner/right", ports[1], 10_000 * rate),
        ]
        config = TABLES.format(folder=folder, split_minutes=max(0.5, min(minutes / PARTS, PART_MINUTES)))
        for name, port in zip(("left", "right"), ports, strict=True):
            config += SCANNER.format(name=name, port=port)
        for number, (name, hz) in enumerate((("main", 1000 * rate), ("spare", 200 * rate))):
            config += IMU.format(name=name, group=CAN_GROUP, port=self._can_port + number, dbc=DBC, rate_hz=hz)
        (folder / "swath.toml").write_text(config)
        self.found = Found()
        self.samples: list[Sample] = []
        self.ages: list[tuple[float, float]] = []
        self.cpu_percent = 0.0
        self.exit_status = -1
        self.journal = ""

    def run(self, tell: Callable[[str], None]) -> None:
        """Run the recorder, sample its process every second and read every finished part; then stop everything."""
        logs = self._folder / "logs"
        command = [sys.executable, "-m", "swath.daemon.cli.main", "run", str(self._folder / "swath.toml")]
        with (self._folder / "journal.txt").open("w") as journal:
            recorder = subprocess.Popen(command, stderr=journal)
        reader, ages = Watcher(read_parts, logs, keep=self._keep), Watcher(note_ages, logs)
        try:
            self._start_as_opened(recorder)
            self._watch(recorder, tell)
            self.ages = ages.found()
            for sensor in self.sensors:
                sensor.stop.set()
            for sensor in self.sensors:
                sensor.join()
            recorder.send_signal(signal.SIGTERM)
            self.exit_status = recorder.wait(90)
        finally:
            if recorder.poll() is None:
                recorder.kill()
                recorder.wait()
            for sensor in self.sensors:
                if isinstance(sensor, (Receiver, Pulse)):
                    sensor.unplug()
        self.found = reader.found()
        self.journal = (self._folder / "journal.txt").read_text()

    def _start_as_opened(self, recorder: subprocess.Popen[bytes]) -> None:
        """Start each sensor once its device is open, so that all its data is received from the beginning."""
        journal = self._folder / "journal.txt"
        deadline = time.monotonic() + 60
        waiting = list(self.sensors)
        while waiting:
            text = journal.read_text()
            if recorder.poll() is not None or time.monotonic() > deadline:
                raise SystemExit(f"the recorder did not start:\n{text}")
            for sensor in [sensor for sensor in waiting if f"{sensor.source} device_opened" in text]:
                sensor.start()
                waiting.remove(sensor)
            time.sleep(0.05)

    def _watch(self, recorder: subprocess.Popen[bytes], tell: Callable[[str], None]) -> None:
        """Watch the recorder every second until the time is over, or until it or a sensor has failed."""
        start_s, before = time.monotonic(), cpu_s(recorder.pid)
        minute = 0
        while (elapsed := time.monotonic() - start_s) < self._minutes * 60:
            if recorder.poll() is not None or any(sensor.failed for sensor in self.sensors):
                break
            self.samples.append(look(recorder.pid, elapsed))
            if elapsed // 60 > minute:
                minute = int(elapsed // 60)
                self.cpu_percent = (cpu_s(recorder.pid) - before) / elapsed * 100
                now = self.samples[-1]
                tell(f"{minute} min: {now.rss_mb:.1f} MB, {now.descriptors} files, {self.cpu_percent:.1f} % CPU")
            time.sleep(1.0)
        self.cpu_percent = (cpu_s(recorder.pid) - before) / (time.monotonic() - start_s) * 100


def look(pid: int, seconds: float) -> Sample:
    """Return the process's own memory and the number of its open files."""
    status = Path(f"/proc/{pid}/status").read_text()
    anonymous_kb = next(int(line.split()[1]) for line in status.splitlines() if line.startswith("RssAnon"))
    return Sample(seconds, anonymous_kb * 1024 / 1e6, len(list(Path(f"/proc/{pid}/fd").iterdir())))


def growth(samples: list[Sample]) -> tuple[float, float]:
    """Return how much memory grew, in megabytes, and its slope in megabytes an hour.

    The growth is from the second third of the run after its warm-up to the last third.
    """
    judged = samples[int(len(samples) * WARM_UP) :]
    third = max(1, len(judged) // 3)
    later, last = judged[third : 2 * third], judged[2 * third :]
    slope = np.polyfit([s.seconds for s in judged], [s.rss_mb for s in judged], 1)[0] if len(judged) > 2 else 0.0
    if not later or not last:
        return 0.0, 0.0
    return max(s.rss_mb for s in last) - max(s.rss_mb for s in later), float(slope) * 3600


def problems(soak: Soak) -> list[str]:
    """Return a line for each check that failed."""
    wrong = soak.found.wrong + account_problems(soak) + process_problems(soak)
    wrong += [f"event: {event}" for event in soak.found.events if event["code"] not in EXPECTED_EVENTS]
    if (state := soak.found.status.get("gnss/rover", {}).get("time_state")) != "LOCKED":
        wrong.append(f"gnss/rover is {state} at the end")
    return wrong


def account_problems(soak: Soak) -> list[str]:
    """Return a line for each source whose counts differ: sent, in the status, in the log (bytes for serial lines)."""
    wrong = []
    for sensor in soak.sensors:
        status = soak.found.status.get(sensor.source, {})
        if sensor.source.startswith("gnss/"):
            sent, recorded, in_log = sensor.bytes, status.get("bytes"), soak.found.bytes[sensor.source]
        else:
            sent, recorded, in_log = sensor.sent, status.get("written"), soak.found.units[sensor.source]
        if sensor.failed is not None or not sent == recorded == in_log:
            wrong.append(f"{sensor.source}: {sent} sent, {recorded} told, {in_log} in the log; {sensor.failed}")
    return wrong


def process_problems(soak: Soak) -> list[str]:
    """Return a line for each fault of the process: its exit status, its memory, files or latency."""
    wrong = [] if soak.exit_status == 0 else [f"the recorder ended with {soak.exit_status}"]
    grown, _ = growth(soak.samples)
    if grown > RSS_GROWTH_MB:
        wrong.append(f"memory grew by {grown:.1f} MB")
    judged = soak.samples[int(len(soak.samples) * WARM_UP) :]
    if judged and min(s.descriptors for s in judged[-60:]) > min(s.descriptors for s in judged[:60]):
        wrong.append("open files grew")
    thirds = latencies(soak.ages)
    if not thirds or thirds[-1][0] > LATER * thirds[0][0]:
        wrong.append(f"latency grew, or was not seen: {[f'{third[0]:.3f} s' for third in thirds]}")
    return wrong


def latencies(ages: list[tuple[float, float]]) -> list[list[float]]:
    """Return `PERCENTILES` of the ages (s) in each third of a run; an empty list if there are no chunks."""
    if not ages:
        return []
    at_s, age_s = np.array(ages).T
    edges = np.linspace(0.0, at_s[-1] + 1e-9, 4)
    thirds = [age_s[(at_s >= low) & (at_s < high)] for low, high in pairwise(edges)]
    return [np.percentile(third, PERCENTILES).tolist() for third in thirds if len(third)]


def report(soak: Soak) -> None:
    """Print the figures of the run."""
    found = soak.found
    print(f"{'source':<14} {'sent':>12} {'in the log':>12} {'MB':>9}  longest pause of the sender")
    for sensor in soak.sensors:
        print(
            f"{sensor.source:<14} {sensor.sent:>12,} {found.units[sensor.source]:>12,} "
            f"{found.bytes[sensor.source] / 1e6:>9.1f}  {sensor.late_s * 1e3:.0f} ms"
        )
    grown, slope = growth(soak.samples)
    memory = [sample.rss_mb for sample in soak.samples]
    files = sorted({sample.descriptors for sample in soak.samples})
    print(
        f"memory {min(memory):.1f} to {max(memory):.1f} MB, {grown:+.2f} MB in the last third, slope {slope:+.2f} MB/h"
    )
    print(f"{'latency, ms':<14} {'':>12} " + " ".join(f"{f'{percent:g} %':>9}" for percent in PERCENTILES))
    for name, third in zip(("first third", "second", "last"), latencies(soak.ages), strict=False):
        print(f"{name:<14} {'':>12} " + " ".join(f"{1e3 * value:>9.0f}" for value in third))
    print(f"open files {files}, {soak.cpu_percent:.1f} % CPU, {found.parts} parts")
    print(f"events {dict(Counter(event['code'] for event in found.events))}")


def main() -> int:
    """Run the soak and report; return 0 if all checks passed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--rate", type=float, default=0.1, help="share of the sensors' full rates")
    parser.add_argument("--keep", type=Path, help="a new folder for the log; without it parts are read and removed")
    arguments = parser.parse_args()
    keep: Path | None = arguments.keep
    folder = Path(tempfile.mkdtemp(prefix="swath-soak-")) if keep is None else keep.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    try:
        soak = Soak(folder, arguments.minutes, arguments.rate, keep=keep is not None)
        soak.run(lambda line: print(line, flush=True))
        report(soak)
        wrong = problems(soak)
    finally:
        if keep is None:
            shutil.rmtree(folder)
    if wrong:
        print(soak.journal)
    for line in wrong:
        print(f"WRONG: {line}")
    print("soak FAILED" if wrong else "soak passed")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
