"""What a return costs on its way from a log to a LAZ file, and to the live georeferencer's products.

python -m benchmarks.georef_log [--seconds 70] [--repeats 3] [--log FOLDER] [--live FOLDER] [--json FILE]

A virtual flight of 400 000 pulses a second with an INS in its log is made in a temporary folder, and for the live
georeferencer another of two scanners of a million each. Figures are medians over the repeats: nanoseconds of this
process's own CPU time a return. Each block is measured as what a pass takes longer than the one without it; beside
their sum stands what the whole takes when it is done as `swath georef` does it. Whole runs by the clock on the wall:
`benchmarks.georef_workers`.

What is asked was stated beside what LASzip alone took on the machine that the limits come from, 250 ns a point, 294
with three sigmas. Machines differ, and so do minutes: the last column is what is asked in the measure of what LASzip
takes here, in the same run.
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
SOME_POINTS = 1_000_000  # for what is measured on points that are held: all would not fit into a small memory
POINT_BYTES = 30  # of format 6, without what stands behind it
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


LASZIP_NS = {False: 250.0, True: 294.0}  # a point, by lazrs alone, where the limits were stated: without, with sigmas


@dataclass
class Figure:
    """A line of a table: nanoseconds a return, or a rate; what was asked in the same unit; None: nothing.

    ``here`` is what was asked as many times what LASzip takes here as it was of what that took there.
    """

    name: str
    value: float
    unit: str
    asked: float | None = None
    here: float | None = None


class Bench:
    """One flight's log, and all that can be done with it."""

    def __init__(self, log: Path, folder: Path, *, sigmas: bool, count: bool = True) -> None:
        self.session: Session = open_logs([log])[0]
        self.setup = Setup.of_log(self.session.attachments(), Options(crs=CRS, uncertainty=sigmas))
        self.clocks = read_clocks(self.session, self.setup)
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
        """Messages of the scanner, in order."""
        yield from read_chunks(self.index, self.places, lambda topic: topic.startswith(SCANNER_TOPICS), [])

    def read(self) -> int:
        """All chunks, their CRCs checked."""
        return sum(len(batch.units) for batch in self.batches())

    def decode(self) -> int:
        """All returns; how many."""
        parsers, count = self.setup.sources.parsers(("scanner",)), 0
        for batch in self.batches():
            parser = parsers[source_of_topic(batch.channel.topic) or ""]
            records = parser.feed_batch(ChunkBatch("bench", batch.log_time_ns, batch.units))
            count += sum(len(record.rows) for record in records if isinstance(record, ScannerReturns))
        return count

    def placed(self, *, whole: bool = True) -> Iterator[Points]:
        """Points in the mapping frame; not ``whole``: returns with their GPS times only."""
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
        """Records of points."""
        packer = PointPacker(self.las.header(1), 1)
        return [packer.pack(piece, at).tobytes() for piece in pieces for at in range(0, len(piece), BLOCK)]

    def job(self) -> None:
        """Log to LAZ, as a worker does it."""
        first, last = self.index.spans()
        self.path.unlink(missing_ok=True)
        numbers = {name: number for number, name in enumerate(self.setup.scanners)}
        plan = SessionPlan(self.index, self.setup, self.clocks.clocks, self.las, {}, numbers)
        segment = Segment(1, int(first.min()), int(last.max()) + 1)
        run_job(plan, Job(0, segment, self.places, self.trajectory, self.path))

    def replay(self) -> None:
        """All of the log through the live georeferencer."""
        replay(self.session, self.setup, self.folder / "live", LiveConfig(), None)

    def live_points(self) -> int:
        """The same without what is shown and told; how many."""
        feed = LogFeed(self.setup, self.setup.live_stream(self.session.info))
        count = sum(len(points) for batch in self.session.batches() for _, points in feed.take(batch))
        return count + sum(len(points) for _, points in feed.close())


class _Nothing:
    """Takes returns where points would be made of them."""

    encoder_motion = None

    def __init__(self, fates: int) -> None:
        self._fates = fates

    def georeference(self, rows: Any, time_ns: Any, trajectory: Any) -> tuple[Points, Any]:
        del time_ns, trajectory
        return _no_points(), np.zeros(len(rows), np.uint8)


def _no_points() -> Points:
    single, byte = np.zeros(0, np.float32), np.zeros(0, np.uint8)
    times, places, beams = np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros(0, np.uint16)
    return Points(times, places, None, single, single, single, byte, byte, beams, byte)


def compress(blocks: list[bytes], extra: int) -> None:
    """Through LASzip, and nothing else."""
    out = io.BytesIO()
    compressor = lazrs.LasZipCompressor(out, lazrs.LazVlr.new_for_compression(POINT_FORMAT, extra))
    for block in blocks:
        compressor.compress_many(np.frombuffer(block, np.uint8))
    compressor.done()


def cost(work: Callable[[], object], returns: int, repeats: int) -> float:
    """Median of nanoseconds of CPU time a return."""
    return cpu_seconds(work, repeats) / returns * 1e9


def file_costs(bench: Bench, repeats: int) -> tuple[float, float]:
    """Nanoseconds a point of making records of points, and of LASzip, over some of the flight's points."""
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
    """The blocks of a way to LAZ, their sum and the whole."""
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
    """What a point costs the live georeferencer, by replay of a flight of two million pulses a second."""
    bench = Bench(log, folder, sigmas=False)
    slower = file_costs(bench, repeats)[1] / LASZIP_NS[False]
    points, live = (cost(work, bench.returns, repeats) for work in (bench.live_points, bench.replay))
    return [
        Figure("log to points", points, "ns"),
        Figure("grid, thinning, live.mcap, status", live - points, "ns", 40.0, 40.0 * slower),
        Figure("all of it", live, "ns", 300.0, 300.0 * slower),
        Figure("of a core, at 2 M points/s", live / 5.0, "%", 60.0, 60.0 * slower),
    ]


def measure(log: Path, live_log: Path, folder: Path, repeats: int) -> dict[str, list[Figure]]:
    """All tables."""
    tables: dict[str, list[Figure]] = {}
    for sigmas in (False, True):
        name = "with three sigmas" if sigmas else "without sigmas"
        tables[name] = blocks(Bench(log, folder, sigmas=sigmas), repeats)
    tables["live, by replay, two heads of 1 MHz"] = live_figures(live_log, folder, repeats)
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    tables["memory"] = [Figure("most", most, "MB", 1000.0, 1000.0)]
    return tables


def fly(folder: Path, seconds: float, heads: list[str]) -> Path:
    """Make a flight's log with these scanners, in a folder that is made."""
    folder.mkdir()
    (folder / "plan.toml").write_text(PLAN + "".join(heads))
    swath = [sys.executable, "-c", "from swath.daemon.cli.main import main; main()"]
    arguments = ["sim", "fly", str(folder / "plan.toml"), "--seconds", f"{seconds:g}", "--no-truth"]
    subprocess.run([*swath, *arguments, "-o", str(folder / "log")], check=True, stdout=subprocess.DEVNULL)
    return folder / "log"


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=70.0, help="of the flight; the first nine are without returns")
    parser.add_argument("--repeats", type=int, default=3, help="measurements a figure, of which the median counts")
    parser.add_argument("--log", type=Path, help="a flight made before")
    parser.add_argument("--live", type=Path, help="a flight of two scanners made before")
    parser.add_argument("--json", type=Path, help="write the figures here too")
    arguments = parser.parse_args()
    keep_freed_memory()  # as every command of ours does
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
