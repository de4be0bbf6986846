"""Tests the stream: its decisions over time, with stand-ins for trajectory and model, and known clocks."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

from swath.georef.arrays import ByteArray, Int64Array, StructArray
from swath.georef.points import Fate, Points
from swath.georef.records import (
    DEVICE_CLOCK_DTYPE,
    INS_DTYPE,
    RETURN_DTYPE,
    NamesEdge,
    PpsEdge,
    TimeMessage,
    TimeScale,
    TimeTag,
)
from swath.georef.scanner.encoder_motion import EncoderMotion
from swath.georef.stream.clocks import ClockPlan, DevicePlan, FrozenClocks, GnssPlan, HostClocks, PpsPlan, StreamClocks
from swath.georef.stream.stream import (
    CONTEXT_FLAG,
    CompletePath,
    GivenMotion,
    GrowingPath,
    ScannerChain,
    Stream,
    StreamSettings,
)
from swath.georef.timescales import SECOND_NS, WEEK_NS
from swath.georef.trajectory.buffer import TrajectoryBuffer

pytestmark = pytest.mark.xdist_group("kernels")

WEEK, TOW_S = 2423, 86_400
GPS_0 = WEEK * WEEK_NS + TOW_S * SECOND_NS  # at host time 0 of the tests
HOST_0 = 1_781_514_000 * SECOND_NS
DEVICE_0 = 3_000 * SECOND_NS + 111_222_333  # of the scanner's counter at the same moment
DRIFT = 20e-6  # the scanner's clock is fast
TICK = 100_000_000
PLAN = ClockPlan(
    0,
    {"pps/main": PpsPlan(18)},
    {"gnss/rover": GnssPlan("pps/main")},
    {"scanner/left": DevicePlan("pps/main"), "scanner/top": DevicePlan("pps/main", past_utc_hour=True)},
)


def device_ns(seconds: float | np.ndarray[Any, Any]) -> Any:
    """Return the scanner's counter (ns) at seconds since the start."""
    return DEVICE_0 + np.rint(np.asarray(seconds) * 1e9 * (1 + DRIFT)).astype(np.int64)


@dataclass
class Echo:
    """Model that writes time to easting so that the output shows its input, and counts its calls."""

    asked: list[int] = field(default_factory=list)

    def georeference(self, rows: StructArray, time_ns: Int64Array, trajectory: Any) -> tuple[Points, ByteArray]:
        self.asked.append(len(rows))
        fates = trajectory.fates(time_ns)
        good = fates == 0
        some = rows[good]
        single = some["range_m"].astype(np.float32)
        east = (time_ns[good] - GPS_0) * 1e-9
        points = Points(
            time_ns[good],
            np.stack([east, some["range_m"], np.zeros(len(some))], axis=1),
            None,
            some["encoder_rad"].astype(np.float32),
            single,
            some["intensity"],
            some["return_number"],
            some["number_of_returns"],
            some["channel"],
            some["mta_zone"],
        )
        return points, fates


@dataclass
class Rig:
    """A stream with one scanner, fed second by second."""

    settings: StreamSettings = field(default_factory=StreamSettings)
    ins_s: tuple[float, float] = (0.0, 1e9)
    pps_s: tuple[float, float] = (0.0, 1e9)
    latch_s: tuple[float, float] = (0.0, 1e9)
    name: str = "left"

    def __post_init__(self) -> None:
        self.echo = Echo()
        self.stream = Stream(
            {self.name: ScannerChain(self.name, self.echo)},
            StreamClocks.growing(PLAN),
            GrowingPath(TrajectoryBuffer()),
            self.settings,
        )
        self.placed: list[tuple[float, Points]] = []
        self.given = 0

    def run(self, until_s: float, *, rows: int = 10, since_s: float = 0.0) -> Rig:
        """Feed and advance the stream tick by tick, a tenth of a second each."""
        for step in range(round(since_s * 10), round(until_s * 10)):
            self.feed(step / 10, rows)
            tick = HOST_0 + (step + 1) * TICK
            self.placed += [(step / 10 + 0.1, points) for _, points in self.stream.advance(tick)]
        return self

    def feed(self, at_s: float, rows: int) -> None:
        self.feed_host(at_s)
        times = at_s + np.arange(rows) / rows / 10
        latched = self.latch_s[0] <= at_s < self.latch_s[1]
        self.feed_scanner(return_rows(times), clock_rows(float(times[-1]), latched=latched))

    def feed_host(self, at_s: float, *, backwards: bool = False) -> None:
        second, clocks = int(at_s), self.stream.clocks
        if at_s == second and self.pps_s[0] <= at_s < self.pps_s[1]:
            edge, message = second_of(second)
            if backwards:
                clocks.add_message("gnss/rover", message)
            clocks.add_edge("pps/main", edge)
            if not backwards:
                clocks.add_message("gnss/rover", message)
        if self.ins_s[0] <= at_s < self.ins_s[1]:
            self.stream.path.add(ins_rows(at_s + 0.01 * np.arange(10)))

    def feed_scanner(self, rows: StructArray, sample: StructArray) -> None:
        self.given += len(rows)
        self.stream.add_returns(self.name, rows)
        self.stream.clocks.add_samples(f"scanner/{self.name}", sample)

    def fates(self) -> dict[Fate, int]:
        return self.stream.fates(self.name)


def second_of(second: int) -> tuple[PpsEdge, TimeMessage]:
    """Return an edge, and the message that names it 80 ms later."""
    host_ns = HOST_0 + second * SECOND_NS
    tag = TimeTag(TimeScale.GPS, (TOW_S + second) * SECOND_NS, week=WEEK)
    message = TimeMessage(host_ns + 80_000_000, tag, NamesEdge.PREVIOUS, bound=True, message="TIME")
    return PpsEdge(host_ns, second), message


def return_rows(times_s: np.ndarray[Any, Any]) -> StructArray:
    rows = np.zeros(len(times_s), RETURN_DTYPE)
    rows["host_time_ns"] = HOST_0 + np.rint(times_s * 1e9).astype(np.int64) + 1_000_000
    rows["device_time_ns"] = device_ns(times_s)
    rows["range_m"] = times_s
    rows["return_number"] = rows["number_of_returns"] = 1
    return rows


def clock_rows(time_s: float, *, latched: bool) -> StructArray:
    row = np.zeros(1, DEVICE_CLOCK_DTYPE)
    row["host_time_ns"] = HOST_0 + round(time_s * 1e9) + 1_000_000
    row["device_time_ns"] = device_ns(time_s)
    row["pps_time_ns"] = device_ns(int(time_s)) + 100 * (int(time_s) % 3) if latched else -1  # ticks of 10 MHz
    row["pps_count"] = int(time_s) + 1
    row["locked"] = -1
    return row


def ins_rows(times_s: np.ndarray[Any, Any]) -> StructArray:
    rows = np.zeros(len(times_s), INS_DTYPE)
    rows["gps_ns"] = GPS_0 + np.rint(times_s * 1e9).astype(np.int64)
    rows["lat_rad"], rows["height_m"] = 0.8, 500.0
    rows["lon_rad"] = 0.15 + 1e-5 * times_s
    return rows


def errors_s(rig: Rig) -> np.ndarray[Any, Any]:
    """Return errors of the times given to returns, s."""
    columns = np.concatenate([points.points_map[:, :2] for _, points in rig.placed])
    errors: np.ndarray[Any, Any] = np.abs(columns[:, 0] - columns[:, 1])
    return errors


def test_returns_before_the_lock_wait_and_are_then_timed() -> None:
    rig = Rig().run(20.0)
    first_tick, first = rig.placed[0]
    assert 4.0 <= first_tick <= 5.2  # locking takes five edges
    assert first.points_map[0, 1] == 0.0  # from the first return on
    assert len(first) > 300
    assert errors_s(rig)[: len(first)].max() < 5e-6
    assert rig.fates().keys() == {Fate.GEOREFERENCED}
    assert rig.fates()[Fate.GEOREFERENCED] + rig.stream.waiting("left") == rig.given


def test_returns_whose_lock_comes_too_late_have_no_time() -> None:
    rig = Rig(pps_s=(3.0, 1e9)).run(20.0)
    assert 100 < rig.fates()[Fate.NO_TIME] < 500  # PPS comes after 3 s and the lock 4.1 s later; returns wait 5 s
    assert errors_s(rig).max() < 5e-6
    tick, points = rig.placed[0]
    assert points.points_map[0, 1] == pytest.approx(tick - 5.0, abs=0.11)


def test_every_return_has_one_fate_at_the_end() -> None:
    rig = Rig(pps_s=(3.0, 1e9), ins_s=(4.0, 12.0)).run(20.0)
    rig.placed += [(20.0, points) for _, points in rig.stream.close()]
    fates = rig.fates()
    assert rig.stream.waiting("left") == 0
    assert sum(fates.values()) == rig.given
    assert fates[Fate.GEOREFERENCED] == sum(len(points) for _, points in rig.placed)
    assert fates[Fate.OUTSIDE_TRAJECTORY] > 700  # after the trajectory's end


def test_a_scanner_without_latch_runs_free_and_is_refused() -> None:
    rig = Rig(latch_s=(1e9, 1e9)).run(12.0)
    rig.stream.close()
    assert rig.placed == []
    assert rig.fates() == {Fate.NO_TIME: rig.given}
    worse = Rig(StreamSettings(max_time_sigma_ns=1e7), latch_s=(1e9, 1e9)).run(12.0)
    assert sum(len(points) for _, points in worse.placed) > 900


@pytest.mark.slow
def test_after_a_lost_pulse_points_end_when_the_sigma_has_grown() -> None:
    """A device without a latch wanders by some 30 ns/s per √s, so it soon exceeds half a microsecond."""
    tight = StreamSettings(max_time_sigma_ns=500.0)
    rig = Rig(tight, latch_s=(0.0, 10.0)).run(26.0)
    rig.stream.close()
    last = max(float(points.points_map[:, 1].max()) for _, points in rig.placed)
    assert 12.0 < last < 24.0
    fates = rig.fates()
    assert fates[Fate.NO_TIME] == rig.given - fates[Fate.GEOREFERENCED] > 100
    assert errors_s(rig).max() < 3 * 0.5e-6


def test_a_head_on_another_hour_is_refused() -> None:
    """A locked Velodyne counts from the UTC hour; a head that contradicts the host's hour is refused."""
    for lag_s, placed in ((0.0, True), (700.0, False)):
        rig = Rig(name="top")
        past_hour_ns = (GPS_0 - 18 * SECOND_NS - round(lag_s * 1e9)) % (3600 * SECOND_NS)
        for step in range(120):
            rig.feed_host(step / 10)
            times = step / 10 + np.arange(10) / 100
            rows = return_rows(times)
            rows["device_time_ns"] = past_hour_ns + np.rint(times * 1e9).astype(np.int64)
            sample = clock_rows(float(times[-1]), latched=False)
            sample["device_time_ns"], sample["pps_count"], sample["locked"] = rows["device_time_ns"][-1], -1, 1
            rig.feed_scanner(rows, sample)
            rig.placed += [(step / 10, points) for _, points in rig.stream.advance(HOST_0 + (step + 1) * TICK)]
        rig.stream.close()
        assert bool(rig.placed) is placed
        if placed:
            assert errors_s(rig).max() < 1e-6
        else:
            assert rig.fates() == {Fate.NO_TIME: 1200}


def test_returns_wait_for_the_trajectory_at_most_the_given_time() -> None:
    rig = Rig(ins_s=(0.0, 10.0)).run(10.0)
    before = rig.fates()[Fate.GEOREFERENCED]
    rig.run(11.9, since_s=10.0)
    assert rig.fates().get(Fate.OUTSIDE_TRAJECTORY, 0) == 0
    assert before >= rig.given - 190 - 20
    rig.run(14.0, since_s=11.9)
    assert rig.fates()[Fate.OUTSIDE_TRAJECTORY] == pytest.approx(200, abs=25)


def test_a_gap_in_the_trajectory_is_counted_as_a_gap() -> None:
    rig = Rig(ins_s=(0.0, 8.0)).run(8.0)
    rig.ins_s = (8.5, 1e9)
    rig.run(15.0, since_s=8.0)
    fates = rig.fates()
    assert fates[Fate.TRAJECTORY_GAP] == pytest.approx(50, abs=2)
    assert Fate.OUTSIDE_TRAJECTORY not in fates


def test_queues_are_bounded_and_dropped_returns_are_counted() -> None:
    rig = Rig(StreamSettings(max_rows=150), pps_s=(1e9, 1e9)).run(4.0)
    assert rig.stream.waiting("left") <= 150
    assert rig.fates() == {Fate.NO_TIME: rig.given - rig.stream.waiting("left")}
    rig = Rig(StreamSettings(max_rows=150, trajectory_wait_s=60.0, time_wait_s=60.0), ins_s=(1e9, 1e9)).run(20.0)
    assert rig.stream.waiting("left") <= 150
    assert rig.fates()[Fate.OUTSIDE_TRAJECTORY] > 1000


def test_context_rows_give_no_points_and_are_not_counted() -> None:
    rig = Rig().run(8.0)
    rig.stream.advance(HOST_0 + 81 * TICK)
    before, waiting = rig.fates(), rig.stream.waiting("left")
    rows = return_rows(np.arange(8.2, 8.4, 0.01))
    rows["flags"] |= CONTEXT_FLAG
    rig.stream.add_returns("left", rows)
    rig.stream.close()
    assert sum(rig.fates().values()) == sum(before.values()) + waiting


def test_discarded_returns_are_passed_on_with_their_fate_and_known_time() -> None:
    """Pulses without a return and rows of the margin are not discarded returns."""
    rig = Rig(pps_s=(3.0, 1e9), ins_s=(4.0, 12.0))
    taken: list[tuple[StructArray, Int64Array, ByteArray]] = []
    rig.stream.chain("left").left_out = lambda rows, time_ns, fates, _: taken.append((rows, time_ns, fates))
    for flag, returns in ((0, 0), (CONTEXT_FLAG, 1)):
        early = return_rows(np.arange(10) / 100)
        early["flags"], early["number_of_returns"] = flag, returns
        rig.stream.add_returns("left", early)
    rig.run(20.0)
    rig.stream.close()
    rows, time_ns, fates = (np.concatenate(column) for column in zip(*taken, strict=True))
    counts = rig.fates()
    assert sum(counts.values()) == rig.given
    assert set(fates.tolist()) == {Fate.NO_TIME, Fate.OUTSIDE_TRAJECTORY}
    assert all(np.count_nonzero(fates == fate) == counts[fate] for fate in set(fates.tolist()))
    assert (time_ns[fates == Fate.NO_TIME] == -1).all()
    outside = fates == Fate.OUTSIDE_TRAJECTORY
    assert np.abs(time_ns[outside] - GPS_0 - rows["range_m"][outside] * 1e9).max() < 5_000


def test_the_order_in_which_a_tick_is_fed_does_not_matter() -> None:
    """Edges, messages and readings of one tick are processed in a fixed order, whichever was fed first."""
    digests = []
    for backwards in (False, True):
        rig = Rig()
        for step in range(90):
            rig.feed_host(step / 10, backwards=backwards)
            times = step / 10 + np.arange(10) / 100
            rig.feed_scanner(return_rows(times), clock_rows(float(times[-1]), latched=True))
            rig.placed += [(step / 10, points) for _, points in rig.stream.advance(HOST_0 + (step + 1) * TICK)]
        digests.append([points.time_ns.tobytes() for _, points in rig.placed])
    assert digests[0] == digests[1]
    assert len(digests[0]) > 30


def test_complete_clocks_time_earlier_returns_whatever_the_start_of_the_piece() -> None:
    host = HostClocks(PLAN, keep_history=True)
    for second in range(30):
        edge, message = second_of(second)
        host.add_edge("pps/main", edge)
        host.add_message("gnss/rover", message)
    host.update()
    buffer = TrajectoryBuffer()
    buffer.append(ins_rows(np.arange(0.0, 29.95, 0.01)))
    times: list[dict[float, int]] = []
    for begin_s, end_s in ((0.0, 30.0), (7.0, 19.0)):
        rig = Rig(pps_s=(1e9, 1e9), ins_s=(1e9, 1e9))
        clocks = FrozenClocks(host).for_stream()
        path = CompletePath(buffer.snapshot())
        chains = {"left": ScannerChain("left", rig.echo)}
        rig.stream = Stream(chains, clocks, path, StreamSettings(settle_s=2.0))
        rig.run(end_s, since_s=begin_s)
        rig.placed += [(end_s, points) for _, points in rig.stream.close()]
        assert errors_s(rig).max() < 5e-6
        columns = [(points.points_map[:, 1], points.time_ns) for _, points in rig.placed]
        times.append({float(at): int(ns) for east, gps in columns for at, ns in zip(east, gps, strict=True)})
    whole, piece = times
    assert min(whole) == 0.0
    assert len(whole) == 2995  # the trajectory ends before the returns do
    assert {at: ns for at, ns in piece.items() if 8.0 < at < 18.0} == {
        at: ns for at, ns in whole.items() if 8.0 < at < 18.0
    }


@dataclass
class Turning(Echo):
    """Model that writes the encoder's rate to the height."""

    given: GivenMotion = field(default_factory=GivenMotion)

    def georeference(self, rows: StructArray, time_ns: Int64Array, trajectory: Any) -> tuple[Points, ByteArray]:
        points, fates = super().georeference(rows, time_ns, trajectory)
        points.points_map[:, 2] = self.given.motion(rows, time_ns)[0][fates == 0]
        return points, fates


def test_encoder_motion_belongs_to_its_row() -> None:
    """The shaft turns evenly at 3 rad/s; rows that only give context to their neighbours become no points."""
    rig, echo = Rig(), Turning()
    motion = EncoderMotion(steady=True)
    chain = ScannerChain("left", echo, motion=motion, given=echo.given)
    rig.stream = Stream({"left": chain}, StreamClocks.growing(PLAN), GrowingPath(TrajectoryBuffer()))
    for step in range(70):
        rig.feed_host(step / 10)
        rows = return_rows(step / 10 + np.arange(1000) / 10_000)
        rows["encoder_rad"] = 3.0 * rows["range_m"] % 6.0
        rows["pulse_id"] = 1000 * step + np.arange(1000)
        rows["flags"] = CONTEXT_FLAG if step >= 68 else 0
        rig.feed_scanner(rows, clock_rows(step / 10 + 0.09, latched=True))
        rig.placed += [(step / 10, points) for _, points in rig.stream.advance(HOST_0 + (step + 1) * TICK)]
    rig.placed += [(7.0, points) for _, points in rig.stream.close()]
    columns = np.concatenate([points.points_map for _, points in rig.placed])
    assert len(columns) == rig.fates()[Fate.GEOREFERENCED] == 68_000
    assert columns[:, 1].max() == pytest.approx(6.7999)
    assert np.median(columns[:, 2]) == pytest.approx(3.0, abs=1e-3)
    assert rig.stream.waiting("left") == 0


@dataclass
class PulsesInAir:
    """Resolver that delays three returns and drops every tenth."""

    counts: Counter[str] = field(default_factory=Counter)
    held: StructArray = field(default_factory=lambda: np.zeros(0, RETURN_DTYPE))

    @property
    def waiting(self) -> int:
        return len(self.held)

    def feed(self, rows: StructArray, predicted_m: np.ndarray[Any, Any] | None = None) -> StructArray:
        assert predicted_m is None
        rows = np.concatenate([self.held, rows])
        rows, self.held = rows[:-3], rows[-3:]
        return self._given(rows)

    def flush(self) -> StructArray:
        rows, self.held = self.held, self.held[:0]
        return self._given(rows)

    def _given(self, rows: StructArray) -> StructArray:
        dropped = np.rint(rows["range_m"] * 100).astype(np.int64) % 10 == 0
        self.counts["mta_gap"] += int(dropped.sum())
        rows = rows[~dropped].copy()
        rows["device_time_ns"] -= 10_000
        return rows


def test_returns_of_unknown_zone_get_the_time_of_their_emission() -> None:
    rig = Rig()
    chain = ScannerChain("left", rig.echo, resolver=PulsesInAir())
    rig.stream = Stream({"left": chain}, StreamClocks.growing(PLAN), GrowingPath(TrajectoryBuffer()))
    for step in range(90):
        rig.feed_host(step / 10)
        rows = return_rows(step / 10 + np.arange(10) / 100)
        rows["mta_zone"] = 255
        rig.feed_scanner(rows, clock_rows(step / 10 + 0.09, latched=True))
        rig.placed += [(step / 10, points) for _, points in rig.stream.advance(HOST_0 + (step + 1) * TICK)]
        assert sum(rig.fates().values()) + rig.stream.waiting("left") == rig.given
    rig.placed += [(9.0, points) for _, points in rig.stream.close()]
    assert rig.fates()[Fate.MTA_GAP] == 90
    assert rig.stream.waiting("left") == 0
    columns = np.concatenate([points.points_map for _, points in rig.placed])
    assert len(columns) == rig.fates()[Fate.GEOREFERENCED] > 800
    assert columns[:, 0] - columns[:, 1] == pytest.approx(-1e-5, abs=3e-6)


def test_interpolated_times_match_the_device_clock() -> None:
    """Interpolated times are within 2 ns of those computed for each row; across a restart every row is computed."""
    rig = Rig().run(12.0)
    clocks, rows = rig.stream.clocks, return_rows(np.arange(9.0, 12.0, 0.0007))
    good, quick = clocks.place("scanner/left", rows, 1e6)
    exact, _ = clocks.gps_from_device("scanner/left", rows["device_time_ns"], rows["host_time_ns"])
    assert good.all()
    assert 0 < np.abs(quick - exact).max() <= 2
    rows["device_time_ns"][2000:] -= DEVICE_0 - SECOND_NS
    again = clock_rows(12.0, latched=True)
    again["device_time_ns"] -= DEVICE_0 - SECOND_NS
    again["pps_time_ns"], again["pps_count"] = again["device_time_ns"], 1
    again["host_time_ns"] = rows["host_time_ns"][2000]
    clocks.add_samples("scanner/left", again)
    clocks.update()
    good, placed = clocks.place("scanner/left", rows, 1e6)
    assert np.array_equal(
        placed[:2000],
        clocks.gps_from_device("scanner/left", rows["device_time_ns"][:2000], rows["host_time_ns"][:2000])[0],
    )
    assert good[:2000].all()
    assert np.abs(placed[2000:][good[2000:]] - quick[2000:][good[2000:]]).max(initial=0) < 50_000_000


def test_edges_of_one_tick_are_taken_in_the_order_of_their_times() -> None:
    host = HostClocks(PLAN)
    for second in (1, 0, 3, 2):
        host.add_edge("pps/main", second_of(second)[0])
    host.update()
    assert "backwards" not in host.by_source["pps/main"].edges_refused
