"""Compiles the numba loops of `swath live`, `georef` and `calibrate` before the first data, and keeps them on disk.

A moment of made-up returns goes the whole way: parser, model, air, mapping frame, products. Loops kept from an earlier
run are only read. This module holds no list of loops; a loop is compiled because it has run.
"""

from __future__ import annotations

import contextlib
import datetime as dt
import gc
import io
import math
import pickle
import time
import tomllib
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pyproj

from swath.calib.adjust import adjust
from swath.calib.equations.trajectory_prior import gauss_markov
from swath.calib.flight import Flight, Head, Swath, Tangent
from swath.calib.parameters import ParameterOptions
from swath.calib.planes.matching import rematch
from swath.calib.planes.search import find_planes
from swath.daemon.config.config import Config
from swath.daemon.config.tables import Tables
from swath.daemon.log.format import SessionInfo
from swath.daemon.processing.compiling import compilations
from swath.daemon.processing.live.frame import LocalFrame, Maps
from swath.daemon.processing.live.grid import NO_STRIPS, CellGrid, paint_points
from swath.daemon.processing.live.lines import warm_up_lines
from swath.daemon.processing.live.look import LastLook
from swath.daemon.processing.live.painting import LiveMap
from swath.daemon.processing.live.products import Thinning
from swath.daemon.processing.live.tiles import Head as TileHead
from swath.daemon.processing.setup.setup import Options, Setup
from swath.drivers.driver import find_driver
from swath.drivers.parser import DeviceSettings, Parser
from swath.drivers.scanner.hesai.heads import MODE_LAST_STRONGEST
from swath.drivers.scanner.hesai.heads import MODE_STRONGEST as HESAI_STRONGEST
from swath.drivers.scanner.hesai.models import XT32
from swath.drivers.scanner.hesai.parser import encode_point_packet
from swath.drivers.scanner.ouster.parser import OusterParser
from swath.drivers.scanner.srep.layout import SrepHeader, encode_datagram
from swath.drivers.scanner.velodyne.parser import MODE_DUAL, MODE_STRONGEST, encode_data_packet
from swath.georef.arrays import FloatArray, Int64Array, StructArray
from swath.georef.formats.las import LasSettings, LasWriter
from swath.georef.geodesy.earth import e_from_geodetic, geodetic_from_e
from swath.georef.geodesy.gravity import gravity_e
from swath.georef.mapping.crs_names import plain_code
from swath.georef.navigation.alignment.align import Aligner
from swath.georef.navigation.filter.filter import NavigationFilter, run_filter
from swath.georef.navigation.filter.smoother import forward, smooth
from swath.georef.navigation.inputs import GRADES, OBSERVATION_DTYPE, Inertial, Kind, Start, sort_observations
from swath.georef.navigation.inputs import Setup as NavigationSetup
from swath.georef.points import Points
from swath.georef.progress import Tell, silent
from swath.georef.records import (
    DEVICE_CLOCK_DTYPE,
    INS_DTYPE,
    RETURN_DTYPE,
    ChunkBatch,
    FixType,
    NamesEdge,
    PpsEdge,
    ScannerReturns,
    TimeMessage,
    TimeScale,
    TimeTag,
)
from swath.georef.scanner.beams import LineGeometry
from swath.georef.scanner.calibration import nominal
from swath.georef.scanner.uncertainty import Noise
from swath.georef.surface.local import warm_up_surface
from swath.georef.timescales.gps_time import SECOND_NS, unix_ns_from_gps, week_from_gps
from swath.georef.trajectory.trajectory import Trajectory

LINE_FROM_NS = 1_465_000_000 * SECOND_NS
LINE_S, APART_S = 4, 60
RETURNS_HZ, SCANS_HZ, HALF_ANGLE_RAD = 4000, 20, 0.3
LINE_MPS, LINE_HEIGHT_M = 10.0, 50.0

NAVIGATED_S, IMU_RATE_HZ = 12, 50
NAVIGATED_FROM_NS = 1_465_000_000 * SECOND_NS
PLACE = (np.radians(47.0), np.radians(9.0), 500.0)

ROWS = 500
LEAP_SECONDS = 18
START_NS = (405_555 * 3600 + LEAP_SECONDS) * SECOND_NS  # GPS: a full UTC hour of 2026, where some stamps begin
FLOWN_S = 15  # long enough for clocks to lock
INS_GOOD = 3  # NovAtel's INS_SOLUTION_GOOD
EPOCH_NS = 20_000_000
HEIGHT_M = 800.0
SOMEWHERE = (47.0, 9.0)  # degrees, for a mapping frame without an area of use
_HEAD_BYTES = 31  # bytes of a message in a log before its data; units of a log have this stride

_PLAN = """
[session]
name = "warm-up"
[pps.main]
source = "/dev/pps0"
[gnss.rover]
transport = "serial:/dev/null"
protocol = "novatel"
pps = "main"
datum = "same"
[scanner.line]
transport = "udp:127.0.0.1:2368"
protocol = "srep"
pps = "main"
mirror_factor = 1.0
[scanner.spinning]
transport = "udp:127.0.0.1:2369"
protocol = "velodyne-vlp16"
pps = "main"
installation = [[0, 1, 0], [0, 0, 1], [1, 0, 0]]
[output]
crs = "EPSG:25832"
"""
_AIR = '[atmosphere]\nranges = "vacuum"\nrefraction = "{refraction}"\n'
PLANS = (_PLAN, _PLAN + _AIR.format(refraction="ardc"), _PLAN + _AIR.format(refraction="spherical"))


@dataclass(frozen=True, slots=True)
class WarmUp:
    """The outcome of a warm-up.

    Attributes:
        compiled: number of loops that were not in the cache.
        seconds: duration of the warm-up.
        cache: folder that loops are kept in; None: none, so every process compiles them in memory.
    """

    compiled: int
    seconds: float
    cache: Path | None

    def text(self) -> str:
        """Return the outcome as one line for people."""
        what = f"{self.compiled} loops compiled" if self.compiled else "all loops were compiled already"
        where = (
            f"kept in {self.cache}"
            if self.cache is not None
            else "no cache folder is writable, so every process compiles in memory; set NUMBA_CACHE_DIR"
        )
        return f"{what} in {self.seconds:.1f} s; {where}"


def cache_folder() -> Path | None:
    """Return the folder that loops are kept in; None if there is none."""
    loop: Any = paint_points
    path: str | None = loop.stats.cache_path
    return None if path is None else Path(path)


def warm_up(setups: Iterable[Setup] = (), *, calibration: bool = False, tell: Tell = silent) -> WarmUp:
    """Run every loop once: for all kinds of configurations and for those given; for calibration if asked.

    ``tell`` is called with the progress.
    """
    began_s = time.monotonic()
    with compilations() as names:
        tell("decoding", 0, 0)
        _warm_parsers()
        tell("navigation", 0, 0)
        warm_navigation()
        plans = list(product(PLANS, (False, True)))
        for number, (plan, uncertainty) in enumerate(plans):
            tell("points", number, len(plans), "models")
            warm_setup(_setup(plan, uncertainty))
        for setup in setups:
            tell("the configuration's points", 0, 0)
            warm_setup(setup)
        if calibration:
            tell("calibration", 0, 0)
            warm_calibration()
    return WarmUp(len(names), time.monotonic() - began_s, cache_folder())


def _setup(plan: str, uncertainty: bool) -> Setup:
    config = Config(Tables.model_validate(tomllib.loads(plan)), Path("warm-up.toml"), plan)
    return Setup(config, {}, Options(uncertainty=uncertainty, covariances=uncertainty))


def get_ready(setup: Setup) -> None:
    """Compile what a configuration needs and collect garbage, before the first message of a recording.

    Objects loaded by now stay. Without the freeze the garbage collector would go through all of them in the midst of
    the flight, for a tenth of a second.
    """
    warm_setup(setup)
    gc.collect()
    gc.freeze()


def warm_setup(setup: Setup) -> None:
    """Run once what one configuration needs; the setup itself is not changed."""
    if setup.sources.imu_source is not None and setup.config.gnss:
        warm_navigation()
    copy: Setup = pickle.loads(pickle.dumps(setup))  # a mapping frame settles by its first points
    parsers = copy.sources.parsers(("scanner",))
    for name in copy.scanners:
        parser = parsers[f"scanner/{name}"]
        for packets in _packets_for(parser, copy.config.scanner[name].protocol):
            _decoded(parser, packets)
    with contextlib.suppress(ValueError):  # errors that such a place or such returns raise do not matter here
        placed, trajectory = _placed(copy)
        for _, points in placed:
            _warm_products(points)
            _warm_frame(points, trajectory, copy.mapping)


def _warm_frame(points: Points, trajectory: Trajectory | None, mapping: Maps | None) -> None:
    if trajectory is not None:
        frame = LocalFrame(trajectory.position_e[-1], mapping)
        keep = Thinning(1000).keep(points.time_ns)
        cloud = frame.cloud_of(points, keep)
        frame.pose_of(trajectory.position_e[-1], trajectory.q_e_from_b[-1])
        frame.placement()
        made = LiveMap(Path(), 1.0, 0, lambda host_ns: None)
        made.update(trajectory, 0)
        made.take(points, frame)
        made.end()
        for place, pack in made.grid.take_changed():
            pack(TileHead(*place, 1, 1.0, 1, 0.0, 0))
        look = LastLook()
        for at in (0, -1):
            look.take_pose(int(trajectory.time_ns[at]), frame.of_e(trajectory.position_e[at : at + 1 or None])[0])
        if len(keep):
            look.take("line", points, keep, cloud)
            look.profile(NO_STRIPS, made.comparison.heights)
            warm_up_lines(points, trajectory, frame)
        trajectory.between(int(trajectory.time_ns[-1]), int(trajectory.time_ns[-1])).velocity_l()
        trajectory.poses(list(trajectory.span))


def _warm_products(points: Points) -> None:
    points = Points.concatenate([points, points])
    grid = CellGrid(1.0)
    if len(points):
        grid.add(points, points.points_map[0].copy(), np.ones(3))
    grid.add(Points.empty(1, with_sigmas=False), np.zeros(3), np.ones(3), places=np.zeros((1, 3)))
    grid.numbers()
    sigmas = points.sigma_map is not None
    if points.beam_map is not None and len(points):
        for level in (True, False):
            warm_up_surface(points, level=level)
    middle = points.points_map.mean(axis=0) if len(points) else np.zeros(3)
    writer = LasWriter(io.BytesIO(), LasSettings("", tuple(np.round(middle).tolist()), sigmas=sigmas), 1)
    if len(points):
        writer.write(points)
    writer.close()


# ---------------------------------------------------------------------- made-up flight


def _placed(setup: Setup) -> tuple[list[tuple[str, Points]], Trajectory | None]:
    """Return points of a quarter of a minute of level flight, long enough for clocks to lock, and its trajectory."""
    unix_ns = unix_ns_from_gps(START_NS, LEAP_SECONDS)
    stream = setup.live_stream(SessionInfo("warm-up", "swath", "", "", unix_ns, 0))
    clocks = stream.clocks
    placed: list[tuple[str, Points]] = []
    for second in range(FLOWN_S):
        passed_ns = second * SECOND_NS
        host_ns = unix_ns + passed_ns
        clocks.add_reading(host_ns, passed_ns, passed_ns)
        for source in clocks.host.plan.pps:
            clocks.add_edge(source, PpsEdge(host_ns, second))
        week, of_week_ns = week_from_gps(START_NS + passed_ns)
        tag = TimeTag(TimeScale.GPS, of_week_ns, week=week, leap_seconds=LEAP_SECONDS)
        for source in clocks.host.plan.gnss:
            clocks.add_message(source, TimeMessage(host_ns + 50_000_000, tag, NamesEdge.PREVIOUS, bound=True))
        for source in clocks.host.plan.devices:
            clocks.add_samples(source, _device_clock(host_ns, passed_ns, second))
        stream.path.add(setup.sources.ins_rows(_solutions(setup, START_NS + passed_ns)))
        for name in stream.scanners:
            stream.add_returns(name, _returns(host_ns, passed_ns))
        placed += stream.advance(host_ns + SECOND_NS)
    return placed + stream.close(), stream.path.update()


def _device_clock(host_ns: int, passed_ns: int, second: int) -> StructArray:
    since_ns = np.arange(0, SECOND_NS, 50_000_000)
    rows = np.zeros(len(since_ns), dtype=DEVICE_CLOCK_DTYPE)
    rows["host_time_ns"], rows["device_time_ns"] = host_ns + since_ns + 500_000, passed_ns + since_ns
    rows["pps_time_ns"], rows["pps_count"], rows["locked"] = passed_ns, second, 1
    return rows


def _solutions(setup: Setup, gps_ns: int) -> StructArray:
    """Return a second of level flight in the mapping frame's area of use, as a device's INS would report it."""
    lat_deg, lon_deg = SOMEWHERE
    crs, area = setup.options.crs or setup.config.output.crs, None
    with contextlib.suppress(pyproj.exceptions.CRSError):
        area = None if crs is None else pyproj.CRS.from_user_input(plain_code(crs)).area_of_use
    if area is not None:
        lat_deg, lon_deg = (area.south + area.north) / 2, (area.west + area.east) / 2
    rows = np.zeros(SECOND_NS // EPOCH_NS, dtype=INS_DTYPE)
    rows["gps_ns"] = gps_ns + EPOCH_NS * np.arange(len(rows))
    rows["lat_rad"] = math.radians(lat_deg) + 1e-5 * (rows["gps_ns"] - START_NS) / SECOND_NS
    rows["lon_rad"], rows["height_m"] = math.radians(lon_deg), HEIGHT_M
    rows["velocity_l"] = (60.0, 0.0, 0.0)
    rows["position_sigma_l"], rows["attitude_sigma_rad"] = 0.02, 1e-4
    rows["status"] = INS_GOOD
    return rows


def _returns(host_ns: int, passed_ns: int) -> StructArray:
    since_ns = np.arange(ROWS) * (SECOND_NS // ROWS)
    rows = np.zeros(ROWS, dtype=RETURN_DTYPE)
    rows["host_time_ns"], rows["device_time_ns"] = host_ns + since_ns + 500_000, passed_ns + since_ns
    rows["range_m"], rows["encoder_rad"] = HEIGHT_M, np.linspace(-0.3, 0.3, ROWS)
    rows["return_number"] = rows["number_of_returns"] = 1
    rows["intensity"], rows["pulse_id"] = 100.0, np.arange(ROWS)
    return rows


# ---------------------------------------------------------------------- packets of every maker


def _warm_parsers() -> None:
    """Warm up the decoding of protocols that no plan above names; an Ouster's needs its metadata and is left out."""
    for protocol, config in (
        ("srep", {"mirror_factor": 2.0, "geometry": {"type": "polygon", "facets": 4}}),
        ("hesai-xt32", {}),
    ):
        parser = find_driver("scanner", protocol).make_parser(DeviceSettings("scanner/one", config, compiled=True))
        for packets in _packets_for(parser, protocol):
            _decoded(parser, packets)


def _decoded(parser: Parser, packets: list[bytes]) -> list[StructArray]:
    """Return the returns decoded from packets of one length, passed to the parser as a log passes them."""
    units = np.zeros((len(packets), _HEAD_BYTES + len(packets[0])), dtype=np.uint8)
    units[:, _HEAD_BYTES:] = np.frombuffer(b"".join(packets), np.uint8).reshape(len(packets), -1)
    host_ns: Int64Array = np.arange(len(packets), dtype=np.int64) * 1_000_000
    records = parser.feed_batch(ChunkBatch("scanner/one", host_ns, units[:, _HEAD_BYTES:]))
    return [record.rows for record in records if isinstance(record, ScannerReturns)]


def _packets_for(parser: Parser, protocol: str) -> list[list[bytes]]:
    """Return batches of two packets in each mode of a head; empty for a protocol without an encoder."""
    if isinstance(parser, OusterParser):
        return [_ouster(parser)]
    make = _PACKETS.get(protocol.partition("-")[0])
    return [] if make is None else make()


def _srep() -> list[list[bytes]]:
    encoder = np.arange(20) * 1000

    def datagram(sequence: int, slots: int) -> bytes:
        header = SrepHeader(flags=1, sequence=sequence, pps_count=3, first_ticks=50_000 * sequence)
        return encode_datagram(header, np.arange(20) * 50, encoder, np.full((20, slots), 8_000_000), 100, 400)

    return [[datagram(sequence, slots) for sequence in (2 * slots, 2 * slots + 1)] for slots in (1, 2)]


def _velodyne() -> list[list[bytes]]:
    ranges = np.full((12, 32), 20_000)
    single, pairs = np.arange(12) * 40, np.repeat(np.arange(6) * 40, 2)
    return [
        [encode_data_packet(stamp_us, azimuth, ranges, 50, mode) for stamp_us in (1_000, 2_327)]
        for mode, azimuth in ((MODE_STRONGEST, single), (MODE_DUAL, pairs))
    ]


def _hesai() -> list[list[bytes]]:
    ranges = np.full((XT32.blocks, XT32.channels), 5_000)
    single, pairs = np.arange(XT32.blocks) * 18, np.repeat(np.arange(XT32.blocks // 2) * 18, 2)
    when = dt.datetime(2026, 4, 15, 10, 0, 0, tzinfo=dt.UTC)
    return [
        [encode_point_packet(when, azimuth, ranges, 50, mode, sequence=number) for number in (1, 2)]
        for mode, azimuth in ((HESAI_STRONGEST, single), (MODE_LAST_STRONGEST, pairs))
    ]


def _ouster(parser: OusterParser) -> list[bytes]:
    per_packet = parser.head.columns_per_packet
    ranges = {name: 20_000 for name in parser.layout.profile.fields if name.startswith("RANGE")}
    return [
        parser.layout.encode(1, first, 1_000_000_000 + 100_000 * np.arange(first, first + per_packet), ranges)
        for first in (0, per_packet)
    ]


_PACKETS: dict[str, Callable[[], list[list[bytes]]]] = {"srep": _srep, "velodyne": _velodyne, "hesai": _hesai}


def warm_navigation() -> None:
    """Run alignment, filter and smoother once."""
    position_e = e_from_geodetic(*PLACE)
    inertial, observations = _standing(float(np.linalg.norm(gravity_e(position_e)))), _seen(position_e)
    setup = NavigationSetup(GRADES["tactical"], np.array([[0.1, 0.0, -1.0]]))
    aligner = Aligner(setup)
    aligner.feed(inertial)
    aligner.observe(observations)
    small = np.full(3, 0.1)
    start = Start(NAVIGATED_FROM_NS, position_e, np.zeros(3), np.zeros(3), small, small, np.radians(small))
    run = run_filter(inertial, observations, setup, start)
    forward(run)
    smooth(run)
    live = NavigationFilter(setup, start, smoothed=False)
    live.observe(observations)
    live.feed(inertial)


def _standing(gravity_mps2: float) -> Inertial:
    count = NAVIGATED_S * IMU_RATE_HZ
    time_ns = NAVIGATED_FROM_NS + np.arange(1, count + 1) * (SECOND_NS // IMU_RATE_HZ)
    velocity_b = np.tile([0.0, 0.0, -gravity_mps2 / IMU_RATE_HZ], (count, 1))
    return Inertial(
        time_ns, np.full(count, 1 / IMU_RATE_HZ), np.zeros((count, 3)), velocity_b, np.zeros(count, np.bool_)
    )


def _seen(position_e: FloatArray) -> StructArray:
    rows = np.zeros(2 * NAVIGATED_S, OBSERVATION_DTYPE)
    rows["time_ns"] = NAVIGATED_FROM_NS + np.repeat(np.arange(NAVIGATED_S), 2) * SECOND_NS
    rows["kind"] = np.tile([int(Kind.POSITION), int(Kind.VELOCITY)], NAVIGATED_S)
    rows["fix_type"], rows["satellites"], rows["sigma"] = int(FixType.RTK_FIXED), 12, 0.02
    rows["value"][::2] = position_e
    return sort_observations(rows)


def warm_calibration() -> None:
    """Run the search for planes and the adjustment once."""
    flight = _flight()
    planes = find_planes(flight)
    planes = rematch(flight, planes)
    with contextlib.suppress(ValueError):  # that such a flight does not determine the parameters does not matter here
        adjust(flight, planes, ParameterOptions("basic"), gauss_markov(flight))


def _flight() -> Flight:
    frame = Tangent.at(e_from_geodetic(np.radians(47.0), np.radians(9.0), 0.0))
    head = Head("line", nominal("line", np.zeros(3), np.eye(3)), LineGeometry(), Noise(0.02, 1e-5, 0.0, 0.0))
    trajectory = _trajectory(frame)
    bare = Flight(frame, (head,), (trajectory,), ())
    swaths = []
    for strip, begin_ns in enumerate((LINE_FROM_NS, LINE_FROM_NS + APART_S * SECOND_NS), start=1):
        swath = _swath(strip, begin_ns + SECOND_NS // 2)
        points_t = bare.place(swath, head.start)
        swaths.append(Swath(swath.name, 0, strip, 0, swath.rows, swath.time_ns, points_t))
    return Flight(frame, (head,), (trajectory,), tuple(swaths))


def _trajectory(frame: Tangent) -> Trajectory:
    """Return a trajectory that flies the same line northwards twice."""
    since_s = np.arange(0.0, LINE_S + 1.0, 0.02)
    north_m = LINE_MPS * (since_s - 0.5 * LINE_S)
    lat, lon, height = geodetic_from_e(
        frame.e_from_t(np.stack([0.0 * north_m, north_m, np.full(len(north_m), LINE_HEIGHT_M)], axis=1))
    )
    one_ns = LINE_FROM_NS + np.rint(since_s * SECOND_NS).astype(np.int64)
    time_ns = np.concatenate([one_ns, one_ns + APART_S * SECOND_NS])
    level, sigma = np.zeros(len(time_ns)), np.full((len(time_ns), 3), 0.02)
    return Trajectory.from_geodetic(
        time_ns, np.tile(lat, 2), np.tile(lon, 2), np.tile(height, 2), np.zeros_like(sigma), level, level, level,
        position_sigma_l=sigma, attitude_sigma_rad=0.01 * sigma, name="warm-up",
    )  # fmt: skip


def _swath(strip: int, begin_ns: int) -> Swath:
    """Return returns from level ground, not placed yet."""
    count = LINE_S * RETURNS_HZ
    since_s = np.arange(count) / RETURNS_HZ
    rows = np.zeros(count, RETURN_DTYPE)
    rows["return_number"] = rows["number_of_returns"] = 1
    rows["encoder_rad"] = HALF_ANGLE_RAD * np.sin(2.0 * np.pi * SCANS_HZ * since_s)
    rows["range_m"] = LINE_HEIGHT_M / np.cos(rows["encoder_rad"])
    time_ns = begin_ns + np.rint(since_s * SECOND_NS).astype(np.int64)
    return Swath(f"{strip:02d}", 0, strip, 0, rows, time_ns, np.zeros((count, 3)))
