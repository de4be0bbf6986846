"""Tests pulses in air from the wire to points: SREP with byte 15 = 255 and the true pulse of every echo.

The flight is 1200 m above hills, with two to four pulses in the air, a jittering pulse rate, a tick that is no whole
nanosecond, four pulses in ten without a return, and lost datagrams. The truth is computed here with PROJ and SciPy.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from pyproj import Transformer
from scipy.spatial.transform import Rotation

from swath.daemon.config.tables import ScannerConfig
from swath.daemon.processing.setup.models import TerrainRanges, connect, make_resolver
from swath.drivers.parser import DeviceSettings
from swath.drivers.scanner.srep.layout import SrepHeader, encode_datagram
from swath.drivers.scanner.srep.parser import SrepParser
from swath.georef.arrays import BoolArray, FloatArray, Int64Array, StructArray
from swath.georef.coarse_terrain import CoarseTerrain
from swath.georef.georeference import Georeferencer
from swath.georef.points import Fate, Points
from swath.georef.records import ChunkBatch, ScannerReturns
from swath.georef.scanner.beams import LineGeometry
from swath.georef.scanner.calibration import RangeOffset, nominal
from swath.georef.scanner.ranging import PulseRates
from swath.georef.scanner.sensor_model import SensorModel
from swath.georef.stream.stream import CompletePath, ScannerChain, Stream, StreamSettings
from swath.georef.trajectory.trajectory import Trajectory

pytestmark = pytest.mark.xdist_group("kernels")


C_MPS = 299_792_458.0
LAT_DEG, LON_DEG = 47.2, 8.9
TICK_HZ = 150_000_000
PULSES, PER_DATAGRAM, SLOTS = 60_000, 100, 3
PERIOD = 428  # ticks, 350 kHz: 428 m a zone
COUNTS = 1 << 20
FIRST_TICKS = 7_654_321_987
GPS_MINUS_DEVICE_NS = 1_400_000_000_000_000_000
LOST = (
    0,
    100,
    200,
    233,
    318,
    411,
    412,
    502,
)  # including the first: its echoes could belong to pulses before the log
ARM_B = np.array([0.4, -0.2, 0.9])
ABOVE_M, GROUND_M, HILL_M, HILL_LENGTH_M = 1200.0, 500.0, 330.0, 2600.0


# ---------------------------------------------------------------------------------------------------- what was flown


def frame() -> tuple[FloatArray, Rotation]:
    """Return the origin in e, m, of a level frame (north, east, down), and its rotation to e."""
    to_e = Transformer.from_crs(4979, 4978, always_xy=True)
    return np.array(to_e.transform(LON_DEG, LAT_DEG, 0.0)), Rotation.from_euler("ZY", [LON_DEG, -LAT_DEG - 90], True)


def flown(seconds: FloatArray) -> tuple[FloatArray, Rotation]:
    """Return positions (n, 3), m, in the level frame and attitudes of a straight flight that rolls slowly."""
    position = np.stack([62.0 * seconds, 3.0 * seconds, -ABOVE_M - GROUND_M - 0.5 * seconds], axis=1)
    level = Rotation.from_euler("ZYX", [0.05, 0.02, -0.03])
    return position, level * Rotation.from_rotvec(seconds[:, np.newaxis] * np.array([0.12, 0.03, -0.02]))


def ground_down(north: FloatArray, east: FloatArray) -> FloatArray:
    """Return the down coordinate of the hills, m."""
    down: FloatArray = -GROUND_M + HILL_M * np.sin(2 * np.pi * east / HILL_LENGTH_M + north / 300.0)
    return down


def to_the_ground(from_l: FloatArray, along_l: FloatArray) -> FloatArray:
    """Return ranges (n,), m, to the ground by bisection."""
    near, far = np.full(len(from_l), 300.0), np.full(len(from_l), 3000.0)
    for _ in range(60):
        middle = 0.5 * (near + far)
        north, east, down = (from_l + middle[:, np.newaxis] * along_l).T
        above = down < ground_down(north, east)
        near, far = np.where(above, middle, near), np.where(above, far, middle)
    return near


@dataclass(frozen=True)
class Flight:
    """Emissions (n,), their echoes (k,) with pulse and record, and the datagrams sent."""

    ticks: Int64Array
    pulse: Int64Array
    record: Int64Array
    range_m: FloatArray
    points_e: FloatArray
    datagrams: list[bytes]

    @property
    def zone(self) -> Int64Array:
        return self.record - self.pulse

    @property
    def came(self) -> BoolArray:
        """Return (k,) True where the echo's record was not lost."""
        return ~np.isin(self.record // PER_DATAGRAM, LOST)

    @property
    def known(self) -> BoolArray:
        """Return (k,) True where the echo's emission was not lost either."""
        return self.came & ~np.isin(self.pulse // PER_DATAGRAM, LOST)


@cache
def flight() -> Flight:
    random = np.random.default_rng(11)
    ticks = np.concatenate([[0], np.cumsum(random.integers(PERIOD - 12, PERIOD + 13, PULSES - 1))])
    seconds = ticks / TICK_HZ
    encoder = np.rint(np.radians(30.0) * np.sin(2 * np.pi * 80.0 * seconds) * COUNTS / (4 * np.pi)).astype(np.int64)
    angle = encoder * (4 * np.pi / COUNTS)
    position, attitude = flown(seconds)
    along = attitude.apply(np.stack([np.zeros(PULSES), np.sin(angle), np.cos(angle)], axis=1))
    scanner = position + attitude.apply(ARM_B)
    ground_m = to_the_ground(scanner, along)
    hit = random.random(PULSES) < 0.6
    trees = hit & (random.random(PULSES) < 0.25)
    pulse = np.concatenate([np.flatnonzero(hit), np.flatnonzero(trees)])
    range_m = np.concatenate([ground_m[hit], ground_m[trees] - 8.0])
    metres = C_MPS / (2 * TICK_HZ)
    record = np.searchsorted(ticks, ticks[pulse] + range_m / metres, side="right") - 1
    wire = np.rint((range_m - (ticks[record] - ticks[pulse]) * metres) / 1e-4).astype(np.int64)
    order = np.lexsort([wire, record])
    pulse, range_m, record, wire = pulse[order], range_m[order], record[order], wire[order]
    slot = np.arange(len(record)) - np.searchsorted(record, record)
    there = (slot < SLOTS) & (wire > 0) & (record < PULSES - 1)  # echoes in the last record would wait for the next one
    pulse, range_m, record, wire, slot = (one[there] for one in (pulse, range_m, record, wire, slot))
    cells = np.zeros((2, PULSES, SLOTS), np.int64)
    cells[:, record, slot] = wire, pulse
    datagrams = []
    for number in range(PULSES // PER_DATAGRAM):
        of = slice(number * PER_DATAGRAM, (number + 1) * PER_DATAGRAM)
        first = FIRST_TICKS + int(ticks[of.start])
        header = SrepHeader(
            number, mta_zone=255, tick_hz=TICK_HZ, first_ticks=first, encoder_counts=COUNTS, prf_mhz=350_000_000
        )
        datagrams.append(encode_datagram(header, ticks[of] - ticks[of.start], encoder[of], cells[0, of], cells[1, of]))
    origin_e, rot_e_from_l = frame()
    points_e = origin_e + rot_e_from_l.apply(scanner[pulse] + range_m[:, np.newaxis] * along[pulse])
    return Flight(ticks, pulse, record, range_m, points_e, datagrams)


# ------------------------------------------------------------------------------------------------ what is made of it


def trajectory() -> Trajectory:
    seconds = np.arange(-2, 30) / 100.0
    origin_e, rot_e_from_l = frame()
    position, attitude = flown(seconds)
    q = (rot_e_from_l * attitude).as_quat()[:, [3, 0, 1, 2]]
    q *= np.sign(q @ q[0])[:, np.newaxis]
    unsaid = np.full((len(seconds), 3), np.nan)
    start_ns = GPS_MINUS_DEVICE_NS + FIRST_TICKS * 10**9 // TICK_HZ
    time_ns = start_ns + np.rint(seconds * 1e9).astype(np.int64)
    position_e = origin_e + rot_e_from_l.apply(position)
    return Trajectory(time_ns, position_e, q, np.zeros((len(q), 3)), unsaid, unsaid, 150_000_000, "flown")


def coarse_terrain() -> CoarseTerrain:
    """Return the hills at nodes 110 m apart, 25 m too high."""
    lat_step, lon_step = np.radians(1e-3), np.radians(1.4e-3)
    rows, columns = np.meshgrid(np.arange(-12, 13), np.arange(-12, 13), indexing="ij")
    origin_e, rot_e_from_l = frame()
    to_e = Transformer.from_crs(4979, 4978, always_xy=True)
    lat, lon = np.radians(LAT_DEG) + rows * lat_step, np.radians(LON_DEG) + columns * lon_step
    height = np.full(lat.shape, GROUND_M)
    for _ in range(8):
        points_e = np.stack(to_e.transform(np.degrees(lon), np.degrees(lat), height), axis=-1).reshape(-1, 3)
        at_north, at_east, down = rot_e_from_l.inv().apply(points_e - origin_e).T
        height = height + (down - ground_down(at_north, at_east)).reshape(lat.shape)
    return CoarseTerrain(height + 25.0, (float(lon[0, 0]), float(lat[0, 0])), (lon_step, lat_step))


class SteadyClocks:
    """Stand-in for clocks: the scanner's counter runs as GPS does."""

    def update(self) -> None:
        """Do nothing, because these clocks need no update."""

    def place(self, source: str, rows: StructArray, worst_ns: float) -> tuple[BoolArray, Int64Array]:
        del source, worst_ns
        return np.ones(len(rows), np.bool_), rows["device_time_ns"] + GPS_MINUS_DEVICE_NS


@dataclass
class Made:
    points: Points
    fates: dict[Fate, int]
    chain: ScannerChain


def made_of(*, terrain: bool, at_once: int = 37, emissions: bool = True, offsets: tuple[Any, ...] = ()) -> Made:
    """Georeference the datagrams that were not lost, `at_once` at a time, with a tick after each."""
    keys = {"transport": "udp:0.0.0.0:2368", "protocol": "srep", "mirror_factor": 2.0, "range_max_m": 2200.0}
    table = ScannerConfig.model_validate(keys)
    calibration = replace(nominal("left", ARM_B, np.eye(3)), range_offsets=offsets)
    model = SensorModel(calibration, LineGeometry())
    predict = TerrainRanges(model, coarse_terrain()) if terrain else None
    chain = ScannerChain("left", Georeferencer(model), make_resolver(table, ABOVE_M), predict)
    parser = SrepParser(DeviceSettings("scanner/left", {"mirror_factor": 2.0}))
    connect(chain, parser)
    parser.emissions = emissions
    clocks: Any = SteadyClocks()
    stream = Stream({"left": chain}, clocks, CompletePath(trajectory()), StreamSettings())
    units = [unit for number, unit in enumerate(flight().datagrams) if number not in LOST]
    placed = []
    for first in range(0, len(units), at_once):
        some = units[first : first + at_once]
        rows = np.frombuffer(b"".join(some), np.uint8).reshape(len(some), -1)
        for record in parser.feed_batch(ChunkBatch("scanner/left", np.arange(len(some)) + first, rows)):
            if isinstance(record, ScannerReturns):
                stream.add_returns("left", record.rows)
        placed += stream.advance(first * 100_000)
    placed += stream.close()
    assert parser.counters.errors == {"sequence_gap": len(LOST) - 1}
    return Made(Points.concatenate([points for _, points in placed]), stream.fates("left"), chain)


def echoes_of(points: Points) -> NDArray[np.intp]:
    """Return which echo each point is: its intensity gives the pulse, its range separates tree and ground."""
    true = flight()
    order = np.lexsort([true.range_m, true.pulse])
    pulse, range_m = true.pulse[order], true.range_m[order]
    shot = points.intensity.astype(np.int64)
    first = np.searchsorted(pulse, shot)
    second = np.minimum(first + 1, len(order) - 1)
    other = pulse[second] == shot
    farther = other & (np.abs(range_m[second] - points.range_m) < np.abs(range_m[first] - points.range_m))
    return order[np.where(farther, second, first)]


@pytest.mark.parametrize("terrain", [True, False], ids=["terrain", "continuity"])
def test_echoes_are_assigned_to_their_pulse(terrain: bool) -> None:
    true, made = flight(), made_of(terrain=terrain)
    assert set(np.unique(true.zone[true.known]).tolist()) == {2, 3, 4}
    empty = 1.0 - len(np.unique(true.record)) / PULSES
    assert 0.35 < empty < 0.5  # records without an echo
    echo = echoes_of(made.points)
    apart_m = np.linalg.norm(made.points.points_map - true.points_e[echo], axis=1)
    right = made.points.mta_zone == true.zone[echo]
    assert right.mean() > 0.999
    assert apart_m[right].max() < 0.002
    np.testing.assert_array_equal(right, apart_m < 0.002)
    # echoes are lost if their emission was
    counts = made.fates
    assert counts[Fate.GEOREFERENCED] + counts[Fate.MTA_GAP] + counts.get(Fate.MTA_AMBIGUOUS, 0) == true.came.sum()
    assert counts[Fate.MTA_GAP] == (true.came & ~true.known).sum() > 5
    assert counts[Fate.GEOREFERENCED] >= 0.999 * true.known.sum()
    assert len(np.unique(echo)) == len(echo)


def test_returns_of_a_pulse_are_numbered_across_records() -> None:
    true, points = flight(), made_of(terrain=True).points
    both = points.number_of_returns == 2
    assert both.sum() > 5_000
    first, last = points.take(both & (points.return_number == 1)), points.take(both & (points.return_number == 2))
    np.testing.assert_array_equal(first.time_ns, last.time_ns)
    np.testing.assert_array_equal(first.intensity, last.intensity)
    np.testing.assert_allclose(last.range_m - first.range_m, 8.0, rtol=0, atol=1e-3)
    assert (first.mta_zone != last.mta_zone).any()
    ticks = FIRST_TICKS + true.ticks[points.intensity.astype(np.int64)]
    floors = ticks // TICK_HZ * 10**9 + ticks % TICK_HZ * 10**9 // TICK_HZ
    np.testing.assert_array_equal(points.time_ns, floors + GPS_MINUS_DEVICE_NS)


def test_results_do_not_depend_on_how_the_log_is_cut() -> None:
    one, other = made_of(terrain=False), made_of(terrain=False, at_once=600)
    np.testing.assert_array_equal(one.points.points_map, other.points.points_map)
    assert one.fates == other.fates


def test_without_pulses_that_gave_no_return_most_points_are_lost() -> None:
    """This shows what the rows of pulses without a return are needed for."""
    alone = made_of(terrain=True, emissions=False)
    assert alone.fates[Fate.MTA_GAP] > 0.3 * flight().came.sum()


def test_an_offset_by_pulse_rate_uses_the_rate_of_the_header() -> None:
    plain = made_of(terrain=True)
    for prf_hz, offset_m in ((350_000.0, 0.25), (300_000.0, 0.0)):
        shifted = made_of(terrain=True, offsets=(RangeOffset(0.25, prf_hz=prf_hz),))
        moved_m = np.linalg.norm(shifted.points.points_map - plain.points.points_map, axis=1)
        np.testing.assert_allclose(moved_m, offset_m, rtol=0, atol=1e-6)


def test_each_run_of_a_pulse_rate_has_its_own_offset() -> None:
    rates = PulseRates()
    rates.note(5 << 16, 200_000.0, 10**8)
    rates.note(9 << 16, 350_000.0, TICK_HZ)
    rates.note(7 << 16, 100_000.0, 10**8)  # came late
    ids = np.array([4 << 16, 5 << 16, (6 << 16) + 3, 7 << 16, 9 << 16, (9 << 16) + 1, 8 << 16])
    assert rates.runs(ids) == [
        (0, 1, None, None),
        (1, 3, 200_000.0, 10**8),
        (3, 4, 100_000.0, 10**8),
        (4, 6, 350_000.0, TICK_HZ),
        (6, 7, 100_000.0, 10**8),
    ]
