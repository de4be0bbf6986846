"""Tests that a log's messages become the same points, however it is cut and while it grows.

The log is of a short virtual flight with a line scanner, a spinning head, and the receiver's own INS.
"""

from __future__ import annotations

import hashlib
import pickle
import random
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from swath.daemon.config import Config, load_config
from swath.daemon.log.follow import PartFollower
from swath.daemon.log.format import ChannelSpec, LogError
from swath.daemon.log.mcap import scan as scan_module
from swath.daemon.log.mcap.chunks import LogBatch
from swath.daemon.log.reader import Session, open_logs
from swath.daemon.processing.points import feed as feed_module
from swath.daemon.processing.points.clocks import LogClocks, read_clocks
from swath.daemon.processing.points.feed import LogFeed, Placed
from swath.daemon.processing.points.runs import JOINED_BYTES
from swath.daemon.processing.setup.models import TerrainRanges
from swath.daemon.processing.setup.setup import Options, Setup
from swath.daemon.simulate.into_log import fly_into_log
from swath.georef.arrays import Int64Array, StructArray
from swath.georef.coarse_terrain import CoarseTerrain
from swath.georef.points import Fate
from swath.georef.records import ChunkBatch, Record
from swath.georef.stream.stream import Stream, StreamSettings
from swath.georef.trajectory.buffer import TrajectoryBuffer
from swath.georef.trajectory.trajectory import Trajectory
from swath.sim.companions import companion_files, config_text, default_wires
from swath.sim.fly import VirtualFlight
from swath.sim.plan.plan import parse_plan

pytestmark = pytest.mark.xdist_group("kernels")

PLAN = """
[flight]
name = "cut"
seed = 11
speed_mps = 50.0

[[line]]
name = "1"
from_m = [-250, 0]
to_m = [250, 0]
height_m = 520

[[line]]
name = "2"  # never reached: so that there is ground below the way to the first
from_m = [-1000, 0]
to_m = [-900, 0]
height_m = 520

[gnss.rover]
ins = true
rate_hz = 1

[scanner.left]
prf_hz = 4000
on_lines_only = false

[scanner.top]
kind = "vlp16"
scan_hz = 10.0
installation = [[0, 0, 1], [1, 0, 0], [0, 1, 0]]
range_min_m = 1.0
range_max_m = 120.0
on_lines_only = false

[[fault]]
source = "scanner/top"
kind = "silent"
at_s = 0.4
for_s = 4.2
"""
SECONDS = 7.0
ENOUGH = StreamSettings(trajectory_wait_s=2.0)


@dataclass
class Flown:
    folder: Path
    config: Config

    def session(self) -> Session:
        (session,) = open_logs([self.folder / "logs"])
        return session


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Flown:
    """Return the flight in parts of some seconds."""
    folder = tmp_path_factory.mktemp("cut")
    plan = parse_plan(PLAN, Path())
    flight = VirtualFlight(plan, None, SECONDS)
    for name, data in companion_files(plan, flight.site, flight.scene).items():
        (folder / name).write_bytes(data)
    text = config_text(plan, default_wires(plan), "logs").replace("[session]", "[session]\nsplit_minutes = 0.035")
    (folder / "swath.toml").write_text(text)
    config = load_config(folder / "swath.toml")
    report = fly_into_log(config, folder / "logs", flight, plan.tables.flight.seed)
    assert len(report.paths) >= 3
    return Flown(folder, config)


@pytest.fixture(scope="module")
def setup(flown: Flown) -> Setup:
    return Setup.of_log(flown.session().attachments(), Options(datum="same", uncertainty=False))


def placed_of(setup: Setup, session: Session, batches: Iterable[LogBatch]) -> tuple[Placed, LogFeed]:
    """Return all points of a log made with its own INS, tick by tick."""
    feed = LogFeed(setup, setup.live_stream(session.info, ENOUGH))
    placed: Placed = []
    for batch in batches:
        placed += feed.take(batch)
    return placed + feed.close(), feed


def digest(placed: Placed) -> str:
    """Return a digest of every column of every piece and of the order and sizes of the pieces."""
    found = hashlib.sha256()
    for name, points in placed:
        found.update(f"{name} {len(points)} ".encode())
        columns = (points.time_ns, points.points_map, points.scan_angle_rad, points.range_m, points.intensity)
        for column in (*columns, points.return_number, points.number_of_returns, points.channel, points.mta_zone):
            found.update(np.ascontiguousarray(column).tobytes())
    return found.hexdigest()


@pytest.fixture(scope="module")
def whole(setup: Setup, flown: Flown) -> tuple[Placed, LogFeed]:
    """Return the log in its own chunks."""
    return placed_of(setup, flown.session(), flown.session().batches())


def cut(batches: Iterable[LogBatch], longest: int, seed: int) -> Iterator[LogBatch]:
    """Return the same messages in runs of random lengths."""
    lengths = random.Random(seed)
    for batch in batches:
        first = 0
        while first < len(batch.log_time_ns):
            last = first + lengths.randint(1, longest)
            yield batch.between(first, last)
            first = last


@pytest.mark.slow
def test_every_return_has_a_fate_and_most_are_points(whole: tuple[Placed, LogFeed]) -> None:
    placed, feed = whole
    for name in ("left", "top"):
        fates = feed.stream.fates(name)
        points = sum(len(points) for scanner, points in placed if scanner == name)
        assert fates[Fate.GEOREFERENCED] == points > 5_000
        assert sum(fates.values()) == feed.counts[f"scanner/{name}"]["ScannerReturns"]
        assert feed.stream.waiting(name) == 0
        if name == "left":  # returns from before the clocks' lock have waited for it
            assert Fate.NO_TIME not in fates


def test_points_lie_on_the_ground(whole: tuple[Placed, LogFeed], flown: Flown) -> None:
    """Heights of flat terrain reveal every error of time, attitude and sign."""
    for name in ("left", "top"):
        heights = np.concatenate([points.points_map[:, 2] for scanner, points in whole[0] if scanner == name])
        assert np.median(np.abs(heights - np.median(heights))) < 0.5


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_random_partitions_give_the_same_bytes(
    whole: tuple[Placed, LogFeed], setup: Setup, flown: Flown, seed: int
) -> None:
    session = flown.session()
    placed, _ = placed_of(setup, session, cut(session.batches(), 200, seed))
    assert digest(placed) == digest(whole[0])


@pytest.mark.slow
def test_message_by_message_gives_the_same_bytes(whole: tuple[Placed, LogFeed], setup: Setup, flown: Flown) -> None:
    session = flown.session()
    placed, _ = placed_of(setup, session, cut(session.batches(), 1, 0))
    assert digest(placed) == digest(whole[0])


def test_a_growing_log_gives_the_same_bytes(
    whole: tuple[Placed, LogFeed], setup: Setup, flown: Flown, tmp_path: Path
) -> None:
    """Each part is written in pieces of any length and read as far as possible after each."""

    def growing() -> Iterator[LogBatch]:
        lengths = random.Random(4)
        for path in sorted((flown.folder / "logs").glob("*.mcap")):
            data = path.read_bytes()
            at = 4096 + path.read_bytes().find(b"swath.session")
            (tmp_path / path.name).write_bytes(data[:at])
            follower = None
            while at < len(data) or follower is None:
                step = data[at : at + lengths.randint(1, 300_000)]
                with (tmp_path / path.name).open("ab") as file:
                    file.write(step)
                at += len(step)
                follower = follower or opened(tmp_path / path.name)
                if follower is not None:
                    yield from follower.batches()
            assert follower.ended
            follower.close()

    placed, _ = placed_of(setup, flown.session(), growing())
    assert digest(placed) == digest(whole[0])


def opened(path: Path) -> PartFollower | None:
    """Return the log, or None while its first chunk is incomplete."""
    try:
        return PartFollower(path)
    except LogError:
        return None


@pytest.fixture(scope="module")
def known(setup: Setup, flown: Flown) -> LogClocks:
    return read_clocks(flown.session(), setup.sources)


def test_the_first_pass_skips_scanner_data(
    setup: Setup, flown: Flown, known: LogClocks, monkeypatch: pytest.MonkeyPatch
) -> None:
    unpacked: list[int] = []
    unpack = scan_module.unpack_chunk

    def counted(body: bytes) -> bytes:
        unpacked.append(len(body))
        return unpack(body)

    monkeypatch.setattr(scan_module, "unpack_chunk", counted)
    again = read_clocks(flown.session(), setup.sources)
    size = sum(path.stat().st_size for path in (flown.folder / "logs").glob("*.mcap"))
    assert sum(unpacked) < 0.5 * size
    assert again.ins_rows.tobytes() == known.ins_rows.tobytes()
    assert again.counts == known.counts
    assert known.counts["gnss/rover"]["InsSolution"] == len(known.ins_rows) > 600
    assert known.imu_rate_b.shape == (len(known.imu_gps_ns), 3)
    assert len(known.imu_gps_ns) > 1300
    assert np.abs(known.imu_rate_b).max() < 1.0


def office(setup: Setup, known: LogClocks, batches: Iterable[tuple[LogBatch, bool]]) -> tuple[Placed, Stream]:
    buffer = TrajectoryBuffer("novatel")
    buffer.append(known.ins_rows)
    stream = setup.office_stream(known.clocks, buffer.snapshot())
    feed = LogFeed(setup, stream)
    placed: Placed = []
    for batch, own in batches:
        placed += feed.take(batch, context=not own)
    return placed + feed.close(), stream


def by_time(placed: Placed, name: str) -> dict[tuple[int, int, int], bytes]:
    """Return the coordinates of each point by its time, channel and number."""
    found: dict[tuple[int, int, int], bytes] = {}
    for scanner, points in placed:
        if scanner == name:
            keys = zip(points.time_ns.tolist(), points.channel.tolist(), points.return_number.tolist(), strict=True)
            found |= {key: row.tobytes() for key, row in zip(keys, points.points_map, strict=True)}
    return found


def test_pieces_of_a_log_together_give_the_whole(setup: Setup, flown: Flown, known: LogClocks) -> None:
    """The clocks are complete and can be pickled; each return is in the piece that has its message."""
    session = flown.session()
    known = pickle.loads(pickle.dumps(known))
    setup = pickle.loads(pickle.dumps(setup))
    scanners = [batch for batch in session.batches() if batch.channel.topic.startswith("/scanner/")]
    whole, stream = office(setup, known, ((batch, True) for batch in scanners))
    middle = len(scanners) // 2
    halves = [
        office(setup, known, ((batch, place < middle) for place, batch in enumerate(scanners)))[0],
        office(setup, known, ((batch, place >= middle) for place, batch in enumerate(scanners)))[0],
    ]
    for name in ("left", "top"):
        one, other = (by_time(half, name) for half in halves)
        assert not one.keys() & other.keys()
        assert one | other == by_time(whole, name)
        assert len(one) > 3000
        assert len(other) > 3000
        assert Fate.NO_TIME not in stream.fates("left")


def test_invalid_readings_and_edges_are_dropped(setup: Setup, flown: Flown) -> None:
    session = flown.session()
    pps = next(batch for batch in session.batches() if batch.channel.topic == "/pps/main")
    feed = LogFeed(setup, setup.live_stream(session.info))
    for text in ('{"sequence": 3}', '{"edge_time_ns": true}', '{"edge_time_ns": 5, "edge": "clear"}', "[]", "{"):
        rows = np.frombuffer(bytes(31) + text.encode(), np.uint8).reshape(1, -1)
        feed.take(LogBatch(pps.channel, pps.channel_id, pps.log_time_ns[:1], rows))
    assert feed.counts["pps/main"] == {"refused": 3}


def test_scanner_units_of_any_length_are_decoded_in_batches(
    setup: Setup, flown: Flown, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A batch ends when it is large enough, when another wire's units come, or at a tick."""
    session = flown.session()
    feed = LogFeed(setup, setup.live_stream(session.info))
    left = next(batch for batch in session.batches() if batch.channel.topic == "/scanner/left/raw")
    aux = replace(left.channel, topic="/scanner/left/aux/raw")
    seen: list[list[tuple[int, ...]]] = []

    def noted(batches: Sequence[ChunkBatch]) -> list[Record]:
        assert len({batch.source for batch in batches}) == 1
        seen.append([batch.units.shape for batch in batches])
        return []

    monkeypatch.setattr(feed.parser("scanner/left"), "feed_batches", noted)

    def take(channel: ChannelSpec, count: int, length: int, after_ns: int = 0) -> None:
        rows = np.zeros((count, 31 + length), np.uint8)
        feed.take(LogBatch(channel, left.channel_id, np.full(count, 10**18 + after_ns), rows))

    for count, length in ((3, 1492), (1, 52), (2, 412)):
        take(left.channel, count, length)
    assert seen == []
    take(aux, 1, 52)
    assert seen == [[(3, 1492), (1, 52), (2, 412)]]
    take(left.channel, 100, 1492)
    take(left.channel, 1, 1000)
    assert seen[1:] == [[(1, 52)]]
    take(left.channel, 1, JOINED_BYTES - 150_200)
    assert seen[2:] == [[(100, 1492), (1, 1000), (1, JOINED_BYTES - 150_200)]]
    take(left.channel, 4, 52)
    take(left.channel, 4, 60, after_ns=200_000_000)
    assert seen[3:] == [[(4, 52)]]
    feed.close()
    assert seen[4:] == [[(4, 60)]]


def test_decisions_on_a_log_without_advancing_time_follow_its_bytes(
    setup: Setup, flown: Flown, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(feed_module, "TICK_BYTES", 1 << 20)
    session = flown.session()
    ticks: list[int] = []
    stream = setup.live_stream(session.info)
    monkeypatch.setattr(stream, "advance", lambda tick_ns: [ticks.append(tick_ns)][:0])  # type: ignore[func-returns-value]
    feed = LogFeed(setup, stream)
    for batch in session.batches():
        feed.take(LogBatch(batch.channel, batch.channel_id, np.full_like(batch.log_time_ns, 10**18), batch.rows))
    size = sum(batch.rows.size for batch in session.batches())
    assert len(ticks) == pytest.approx(size / (1 << 20), abs=1.1)
    assert set(ticks) == {10**18}


def test_a_batch_is_split_at_every_tick(setup: Setup, flown: Flown, monkeypatch: pytest.MonkeyPatch) -> None:
    session = flown.session()
    clock = next(batch for batch in session.batches() if batch.channel.topic == "/clock")
    stream = setup.live_stream(session.info)
    seen: list[tuple[int, int]] = []
    readings: list[int] = []
    monkeypatch.setattr(stream, "advance", lambda tick_ns: [seen.append((tick_ns, len(readings)))][:0])  # type: ignore[func-returns-value]
    monkeypatch.setattr(stream.clocks, "add_reading", lambda *reading: readings.append(0))
    times = 10**18 + 10**6 * np.array([0, 60, 199, 200, 180, 260, 399, 900, 920, 880, 1000])
    feed = LogFeed(setup, stream)
    feed.take(LogBatch(clock.channel, clock.channel_id, times, np.repeat(clock.rows[:1], len(times), axis=0)))
    assert [(tick - 10**18) // 10**6 for tick, _ in seen] == [200, 800, 1000]
    assert [before for _, before in seen] == [3, 7, 10]


def test_a_terrain_model_predicts_the_measured_range(
    setup: Setup, flown: Flown, known: LogClocks, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A coarse grid around the site knows the heights of the flat ground, so the prediction equals the range."""
    terrain = CoarseTerrain(np.full((2, 2), 450.0), (0.14, 0.81), (0.03, 0.04))
    georeferencer = setup.georeferencer("left")
    predict = TerrainRanges(georeferencer.model, terrain)
    differences: list[np.ndarray[Any, Any]] = []
    georeference = georeferencer.georeference

    def noted(rows: StructArray, time_ns: Int64Array, trajectory: Trajectory) -> Any:
        differences.append(predict(rows, time_ns, trajectory) - rows["range_m"])
        return georeference(rows, time_ns, trajectory)

    monkeypatch.setattr(georeferencer, "georeference", noted)
    office(setup, known, ((batch, True) for batch in flown.session().batches()))
    found = np.concatenate(differences)
    found = found[np.isfinite(found)]
    assert len(found) > 10_000
    assert np.quantile(np.abs(found), 0.95) < 1.0
