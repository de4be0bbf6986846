"""Measure whole runs of `swath georef` in wall-clock time, the start of processes included, beside LASzip alone.

python -m benchmarks.georef_workers [--seconds 159] [--log FOLDER …] [--workers 1 2]

A virtual flight of 400 000 pulses a second (60 million returns in 159 s) is made in a temporary folder, unless --log
gives logs; logs of several sizes show whether the cost of a return and the memory grow with the size. The flight is
georeferenced in four strips with each number of worker processes. Beside it stands the rate of as many processes that
do only LASzip at the same time, because two processes are not twice as fast as one if both processors share one core.
"""

from __future__ import annotations

import argparse
import multiprocessing
import resource
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from benchmarks.georef_log import CRS, ONE_HEAD, POINT_BYTES, Bench, compress, fly
from swath.daemon.processing.flights.read import GeorefOptions
from swath.daemon.processing.georeferencing.run import georeference
from swath.daemon.processing.setup.setup import Options
from swath.daemon.system import keep_freed_memory

STRIPS = 4
ASKED = {False: 3.2e6, True: 2.5e6}  # returns a second with two workers: without and with three sigmas
LIMIT = {False: 8.0e6, True: 6.8e6}  # points a second of LASzip on two cores, where the above were stated
SOME_POINTS = 1_000_000


@dataclass(frozen=True)
class Run:
    """The figures of one run of `swath georef`.

    Attributes:
        points: number of points written.
        seconds: wall-clock time.
        cpu_ns: CPU time a point, of all processes.
        most_mb: memory of the largest worker so far.
        laszip: points a second of as many processes that do only LASzip at the same time.
    """

    points: int
    seconds: float
    cpu_ns: float
    most_mb: float
    laszip: float


def strips_of(bench: Bench, path: Path) -> Path:
    """Write a file that divides the flight into strips of equal duration, and return its path."""
    first, last = bench.index.spans()
    (device, *_) = bench.clocks.clocks.host.plan.devices.values()
    gps_ns, _ = bench.clocks.clocks.host.gps_from_host(device.clock, np.array([first.min(), last.max()]))
    begin, end = bench.trajectory.span
    edges = np.linspace(max(begin, int(gps_ns[0])), min(end, int(gps_ns[1])), STRIPS + 1).astype(np.int64)
    lines = [f"{start},{stop}\n" for start, stop in pairwise(edges.tolist())]
    path.write_text("start_gps_ns,end_gps_ns\n" + "".join(lines))
    return path


def run(log: Path, strips: Path, folder: Path, workers: int, *, sigmas: bool, laszip: float) -> Run:
    """Run the georeferencing of the log and return its figures."""
    options = Options(crs=CRS, uncertainty=sigmas)
    georef_options = GeorefOptions(
        [log], folder / "out", options=options, strips=str(strips), workers=workers, sigmas=sigmas, overwrite=True
    )
    before, start = _cpu_seconds(), time.perf_counter()
    record = georeference(georef_options, lambda *_: None).record
    seconds, cpu = time.perf_counter() - start, _cpu_seconds() - before
    points = sum(strip["points"] for strip in record["strips"])
    most = resource.getrusage(resource.RUSAGE_CHILDREN if workers > 1 else resource.RUSAGE_SELF).ru_maxrss / 1024
    return Run(points, seconds, cpu / points * 1e9, most, laszip)


def laszip_rate(blocks: list[bytes], extra: int, processes: int) -> float:
    """Return the points a second of processes that compress the same points at the same time."""
    context = multiprocessing.get_context("fork")
    ready, go = context.Barrier(processes + 1), context.Barrier(processes + 1)

    def work() -> None:
        ready.wait()
        go.wait()
        compress(blocks, extra)

    workers = [context.Process(target=work) for _ in range(processes)]
    for worker in workers:
        worker.start()
    ready.wait()
    start = time.perf_counter()
    go.wait()
    for worker in workers:
        worker.join()
    points = sum(map(len, blocks)) // (POINT_BYTES + extra)
    return processes * points / (time.perf_counter() - start)


def packed_of(bench: Bench) -> tuple[list[bytes], int]:
    """Return records of some of the flight's points, and the number of extra bytes in each."""
    some, count = [], 0
    for points in bench.placed():
        some.append(points)
        count += len(points)
        if count > SOME_POINTS:
            break
    return bench.pack(some), bench.las.header(1).dtype.itemsize - POINT_BYTES


def runs(log: Path, folder: Path, numbers: list[int], *, sigmas: bool) -> Iterator[tuple[int, Run]]:
    """Run the georeferencing of a log with each number of workers, and yield the number and the figures."""
    bench = Bench(log, folder, sigmas=sigmas, count=False)
    strips = strips_of(bench, folder / "strips.csv")
    blocks, extra = packed_of(bench)
    for workers in numbers:
        laszip = laszip_rate(blocks, extra, workers)
        yield workers, run(log, strips, folder, workers, sigmas=sigmas, laszip=laszip)


def _cpu_seconds() -> float:
    """Return the CPU seconds of this process and of its children that have ended."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(one.ru_utime + one.ru_stime for one in used)


def line(one: Run, workers: int, *, sigmas: bool) -> str:
    """Return one line of the table."""
    rate = one.points / one.seconds
    asked, share = (f"{ASKED[sigmas] / 1e6:.1f}", f"{ASKED[sigmas] / LIMIT[sigmas]:.2f}") if workers == 2 else ("", "")
    return (
        f"{one.points:<12}{sigmas!s:<7}{workers:>7}{one.seconds:>7.1f}{rate / 1e6:>6.2f}{asked:>7}{one.cpu_ns:>8.0f}"
        f"{one.most_mb:>9.0f}{one.laszip / 1e6:>12.2f}{rate / one.laszip:>13.2f}{share:>7}"
    )


def main() -> None:
    """Measure and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--seconds", type=float, default=159.0, help="duration of the flight; nine seconds of it have no returns"
    )
    parser.add_argument("--log", type=Path, nargs="*", default=[], help="use these logs instead of making one")
    parser.add_argument("--workers", type=int, nargs="*", default=[1, 2])
    parser.add_argument("--folder", type=Path, help="parent of the temporary folder; default: that of the system")
    parser.add_argument("--no-sigmas", action="store_true", help="measure only runs without sigmas")
    arguments = parser.parse_args()
    keep_freed_memory()  # as every command of swath does
    with tempfile.TemporaryDirectory(dir=arguments.folder) as name:
        folder = Path(name)
        logs = arguments.log or [fly(folder / "flight", arguments.seconds, ONE_HEAD)]
        print("returns     sigmas workers      s   M/s  asked  CPU ns  peak MB  LASzip M/s  rate/LASzip  asked")
        for log in logs:
            for sigmas in (False,) if arguments.no_sigmas else (False, True):
                for workers, one in runs(log, folder, arguments.workers, sigmas=sigmas):
                    print(line(one, workers, sigmas=sigmas), flush=True)


if __name__ == "__main__":
    main()
