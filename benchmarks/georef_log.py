"""Measure what a return costs from the log to a LAZ file, and from the log to the live georeferencer's products.

python -m benchmarks.georef_log [--seconds 70] [--repeats 3] [--log FOLDER] [--live FOLDER] [--json FILE]

Two virtual flights are made in a temporary folder: one of 400 000 pulses a second with an INS in its log, and for the
live georeferencer one of two scanners of a million pulses a second each. Figures are nanoseconds of this process's own
CPU time a return, medians over the repeats. The figure of a block is the difference between passes with and without it;
beside the sum of the blocks stands the time of the whole, done as `swath georef` does it. `benchmarks.georef_workers`
measures whole runs in wall-clock time.

The column before the last is the limit asked for, stated for a machine on which LASzip alone took 250 ns a point, 294
with three sigmas. As machines differ, the last column scales that limit by the time that LASzip takes here, in the
same run.
"""

from __future__ import annotations

import argparse
import io
import json
import resource
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import lazrs
import numpy as np

from benchmarks.cpu_time import cpu_seconds
from swath.daemon.config.tables import LiveConfig
from swath.daemon.log.chunk_index import SCANNER as SCANNER_TOPICS
from swath.daemon.log.chunk_index import index_log, read_chunks
from swath.daemon.log.format import source_of_topic
from swath.daemon.log.mcap.chunks import LogBatch
from swath.daemon.log.reader import Session, open_logs
from swath.daemon.processing.live.session import replay
from swath.daemon.processing.points.clocks import read_clocks
from swath.daemon.processing.points.feed import LogFeed
from swath.daemon.processing.points.jobs import Job, SessionPlan, run_job
from swath.daemon.processing.setup.setup import Options, Setup
from swath.daemon.system import keep_freed_memory
from swath.georef.formats.las import BLOCK, LasSettings, PointPacker
from swath.georef.formats.las_header import POINT_FORMAT
from swath.georef.points import Fate, Points
from swath.georef.records import ChunkBatch, ScannerReturns
from swath.georef.strips import Segment
from swath.georef.trajectory.buffer import TrajectoryBuffer

CRS = "EPSG:32633"
SOME_POINTS = 1_000_000  # kept in memory for the costs of the file; a whole flight needs too much memory
POINT_BYTES = 30  # of a record of format 6, without extra bytes
PLAN = """
[flight]
name = "bench"
origin_deg = [52.520, 13.410]
crs = "EPSG:32633"
speed_mps = 60.0
turbulence = "none"
lead_s = 1.0
[[line]]
name = "long"
from_m = [-54000.0, 0.0]
to_m = [54000.0, 0.0]
height_m = 590.0
[terrain]
height_m = 90.0
cell_m = 50.0
[control]
points = 0
[gnss.rover]
ins = true
[imu.main]
grade = "tactical"
"""
SCANNER = """
[scanner.{name}]
kind = "oscillating"
motion = "triangle"
prf_hz = {prf_hz}
scan_hz = {scan_hz}
half_angle_deg = 30.0
return_slots = 2
pulses_per_datagram = {pulses}
range_max_m = 1500.0
reference_range_m = 500.0
"""
ONE_HEAD = [SCANNER.format(name="left", prf_hz=400_000.0, scan_hz=100.0, pulses=60)]
TWO_HEADS = [SCANNER.format(name=name, prf_hz=1_000_000.0, scan_hz=200.0, pulses=100) for name in ("left", "right")]
LIVE_SECONDS = 15.0


LASZIP_NS = {False: 250.0, True: 294.0}  # a point, where the limits were stated: without and with sigmas


@dataclass
class Figure:
    """One line of a table: a value, and the limit asked for in the same unit, or None.

    ``here`` is that limit scaled by LASzip's time on this machine over its time where the limit was stated.
    """

    name: str
    value: float
    unit: str
    asked: float | None = None
    here: float | None = None


class Bench:
    """The log of one flight, with the steps that are measured on it."""

    def __init__(self, log: Path, folder: Path, *, sigmas: bool, count: bool = True) -> None:
        self.session: Session = open_logs([log])[0]
        self.setup = Setup.of_log(self.session.attachments(), Options(crs=CRS, uncertainty=sigmas))
        self.clocks = read_clocks(self.session, self.setup.sources)
        buffer = TrajectoryBuffer(self.setup.sources.ins_protocol, name="ins")
        buffer.append(self.clocks.ins_rows)
        self.trajectory = buffer.snapshot()
        assert self.setup.mapping is not None
        self.setup.mapping.settle(self.trajectory.position_e[:: max(1, len(self.trajectory) // 100)])
        self.index = index_log(self.session)
        self.places = self.index.scanner_chunks()
        near = np.floor(self.setup.mapping.map_from_e(self.trajectory.position_e[:1])[0] / 1000.0) * 1000.0
        self.las = LasSettings(self.setup.mapping.wkt, tuple(near.tolist()), sigmas=sigmas)
        self.path = folder / "bench.laz"
        self.folder = folder
        self.returns = self.decode() if count else 0

    def batches(self) -> Iterator[LogBatch]:
        """Yield the scanners' messages, in order."""
        yield from read_chunks(self.index, self.places, lambda topic: topic.startswith(SCANNER_TOPICS), [])

    def read(self) -> int:
        """Read all chunks, check their CRCs and return the number of messages."""
        return sum(len(batch.units) for batch in self.batches())

    def decode(self) -> int:
        """Decode all messages and return the number of returns."""
        parsers, count = self.setup.sources.parsers(("scanner",)), 0
        for batch in self.batches():
            parser = parsers[source_of_topic(batch.channel.topic) or ""]
            records = parser.feed_batch(ChunkBatch("bench", batch.log_time_ns, batch.units))
            count += sum(len(record.rows) for record in records if isinstance(record, ScannerReturns))
        return count

    def placed(self, *, whole: bool = True) -> Iterator[Points]:
        """Yield points in the mapping frame; if not ``whole``, give returns GPS times but make no points of them."""
        setup = self.setup
        stream = setup.office_stream(self.clocks.clocks, self.trajectory)
        if not whole:
            for name in stream.scanners:
                stream.chain(name).georeferencer = _Nothing(len(Fate))
        feed = LogFeed(setup, stream)
        for batch in self.batches():
            for _, points in feed.take(batch):
                yield points
        for _, points in feed.close():
            yield points

    def pack(self, pieces: list[Points]) -> list[bytes]:
        """Return the LAS records of these points."""
        packer = PointPacker(self.las.header(1), 1)
        return [packer.pack(piece, at).tobytes() for piece in pieces for at in range(0, len(piece), BLOCK)]

    def job(self) -> None:
        """Write the log to a LAZ file, as a worker does it."""
        first, last = self.index.spans()
        self.path.unlink(missing_ok=True)
        numbers = {name: number for number, name in enumerate(self.setup.scanners)}
        plan = SessionPlan(self.index, self.setup, self.clocks.clocks, self.las, {}, numbers)
        segment = Segment(1, int(first.min()), int(last.max()) + 1)
        run_job(plan, Job(0, segment, self.places, self.trajectory, self.path))

    def replay(self) -> None:
        """Replay the whole log through the live georeferencer."""
        replay(self.session, self.setup, self.folder / "live", LiveConfig(), None)

    def live_points(self) -> int:
        """Make the live georeferencer's points without any of its products, and return their number."""
        feed = LogFeed(self.setup, self.setup.live_stream(self.session.info))
        count = sum(len(points) for batch in self.session.batches() for _, points in feed.take(batch))
        return count + sum(len(points) for _, points in feed.close())


class _Nothing:
    """A georeferencer that takes returns and makes no points."""

    encoder_motion = None

    def __init__(self, fates: int) -> None:
        self._fates = fates

    def georeference(self, rows: Any, time_ns: Any, trajectory: Any) -> tuple[Points, Any]:
        """Return no points, and a fate of 0 for each return."""
        del time_ns, trajectory
        return _no_points(), np.zeros(len(rows), np.uint8)


def _no_points() -> Points:
    """Return an empty set of points."""
    single, byte = np.zeros(0, np.float32), np.zeros(0, np.uint8)
    times, places, beams = np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros(0, np.uint16)
    return Points(times, places, None, single, single, single, byte, byte, beams, byte)


def compress(blocks: list[bytes], extra: int) -> None:
    """Compress the records with LASzip, without writing them."""
    out = io.BytesIO()
    compressor = lazrs.LasZipCompressor(out, lazrs.LazVlr.new_for_compression(POINT_FORMAT, extra))
    for block in blocks:
        compressor.compress_many(np.frombuffer(block, np.uint8))
    compressor.done()


def cost(work: Callable[[], object], returns: int, repeats: int) -> float:
    """Return the median of nanoseconds of CPU time a return."""
    return cpu_seconds(work, repeats) / returns * 1e9


def file_costs(bench: Bench, repeats: int) -> tuple[float, float]:
    """Return nanoseconds a point of making records and of LASzip, for some of the flight's points."""
    some: list[Points] = []
    for points in bench.placed():
        some.append(points)
        if sum(map(len, some)) > SOME_POINTS:
            break
    count = sum(map(len, some))
    packed = bench.pack(some)
    extra = bench.las.header(1).dtype.itemsize - POINT_BYTES
    packing = cost(lambda: bench.pack(some), count, repeats)
    return packing, cost(lambda: compress(packed, extra), count, repeats)


def blocks(bench: Bench, repeats: int) -> list[Figure]:
    """Measure the blocks of the way to a LAZ file, their sum and the whole."""
    sigmas, count = bench.las.sigmas, bench.returns

    def ns(work: Callable[[], object]) -> float:
        return cost(work, count, repeats)

    read, decoded = ns(bench.read), ns(bench.decode)
    timed = ns(lambda: sum(map(len, bench.placed(whole=False))))
    made = ns(lambda: sum(map(len, bench.placed())))
    packing, laszip = file_costs(bench, repeats)
    parts = {
        "reading, CRC of the chunks": read,
        "decoding, CRC of the datagrams": decoded - read,
        "clocks, waiting": timed - decoded,
        "georeferencing, mapping" + ", sigmas" * sigmas: made - timed,
        "LAS records": packing,
        "lazrs": laszip,
    }
    slower = laszip / LASZIP_NS[sigmas]
    figures = [Figure(name, value, "ns") for name, value in parts.items()]
    points, laz = None if sigmas else 250.0, 800.0 if sigmas else 625.0
    figures.append(Figure("log to points, all of it", made, "ns", points, points and points * slower))
    figures.append(Figure("sum of the blocks", sum(parts.values()), "ns"))
    figures.append(Figure("log to LAZ, all of it", ns(bench.job), "ns", laz, laz * slower))
    return figures


def live_figures(log: Path, folder: Path, repeats: int) -> list[Figure]:
    """Measure what a point costs the live georeferencer, by replay of a flight of two million pulses a second."""
    bench = Bench(log, folder, sigmas=False)
    slower = file_costs(bench, repeats)[1] / LASZIP_NS[False]
    points, live = (cost(work, bench.returns, repeats) for work in (bench.live_points, bench.replay))
    return [
        Figure("log to points", points, "ns"),
        Figure("map, strips, thinning, live.mcap, status", live - points, "ns", 40.0, 40.0 * slower),
        Figure("all of it", live, "ns", 300.0, 300.0 * slower),
        Figure("share of a core, at 2 M points/s", live / 5.0, "%", 60.0, 60.0 * slower),
    ]


def measure(log: Path, live_log: Path, folder: Path, repeats: int) -> dict[str, list[Figure]]:
    """Measure the figures of all tables."""
    tables: dict[str, list[Figure]] = {}
    for sigmas in (False, True):
        name = "with three sigmas" if sigmas else "without sigmas"
        tables[name] = blocks(Bench(log, folder, sigmas=sigmas), repeats)
    tables["live, by replay, two heads of 1 MHz"] = live_figures(live_log, folder, repeats)
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    tables["memory"] = [Figure("peak", most, "MB", 1000.0, 1000.0)]
    return tables


def fly(folder: Path, seconds: float, heads: list[str]) -> Path:
    """Make the log of a flight with these scanners in a new folder, and return the log's path."""
    folder.mkdir()
    (folder / "plan.toml").write_text(PLAN + "".join(heads))
    arguments = ["sim", "fly", str(folder / "plan.toml"), "--seconds", f"{seconds:g}", "--no-truth"]
    run_swath(*arguments, "-o", str(folder / "log"))
    return folder / "log"


def run_swath(*arguments: str) -> None:
    """Run a command of swath, without its output."""
    swath = [sys.executable, "-c", "from swath.daemon.cli.main import main; main()"]
    subprocess.run([*swath, *arguments], check=True, stdout=subprocess.DEVNULL)


def main() -> None:
    """Measure and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--seconds", type=float, default=70.0, help="duration of the flight; its first nine seconds have no returns"
    )
    parser.add_argument("--repeats", type=int, default=3, help="measurements per figure; the median counts")
    parser.add_argument("--log", type=Path, help="use this log instead of making one")
    parser.add_argument("--live", type=Path, help="use this log of two scanners instead of making one")
    parser.add_argument("--json", type=Path, help="also write the figures to this file")
    arguments = parser.parse_args()
    keep_freed_memory()  # as every command of swath does
    with tempfile.TemporaryDirectory() as folder:
        log = arguments.log or fly(Path(folder, "one"), arguments.seconds, ONE_HEAD)
        live = arguments.live or fly(Path(folder, "two"), LIVE_SECONDS, TWO_HEADS)
        tables = measure(log, live, Path(folder), arguments.repeats)
    for title, figures in tables.items():
        print(title)
        for one in figures:
            asked = f"{one.asked:>8.4g} {one.here:>8.4g}" if one.asked is not None and one.here is not None else ""
            print(f"  {one.name:<44} {one.value:>8.4g} {one.unit:<4} {asked}")
    if arguments.json:
        arguments.json.write_text(
            json.dumps({name: [asdict(one) for one in figures] for name, figures in tables.items()})
        )


if __name__ == "__main__":
    main()
