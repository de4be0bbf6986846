"""Targets for trajectories, antenna positions, and points with their sidecars."""

from __future__ import annotations

import io
import json
import random
import struct
import tempfile
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

import laspy
import numpy as np
import pyogrio.raw
import shapefile
from pyproj import CRS

from swath.calib.strips.cells import StripRules
from swath.daemon.config.tables import PlanConfig
from swath.daemon.processing.flightplan.geometry import LineGeometry
from swath.daemon.processing.flightplan.plan import PlanError
from swath.daemon.processing.flightplan.read import read_plan
from swath.daemon.processing.navigation.outside_positions import outside_observations
from swath.daemon.processing.quicklook.product_facts import rows_of, warnings_in
from swath.daemon.processing.strips.inputs import strips_of_files
from swath.georef.formats.sbet import sbet_bytes, smrmsg_bytes
from swath.georef.formats.trajectory.csv import csv_text
from swath.georef.formats.trajectory.file import read_trajectory
from swath.georef.mapping.frame import Mapping
from swath.georef.trajectory.trajectory import Trajectory, TrajectoryError
from swath.sim.plan.plan import load_plan
from tests.fuzz.engine import Target
from tests.fuzz.mutation import damage
from tests.fuzz.texts import NUMBERS, OF_CSV, OF_JSON, changed_text, told
from tests.georef.flown import START_NS, WEEK, flown

SPAN_NS = (START_NS, START_NS + 10**9)
OF_TIMES = (
    *("2026/11/21", "99999/01/01", "2026/13/41", "12:00:00.5", "99:99:99", "GPST", "UTC", "JST", "(deg)", "(rad)"),
    *(
        "(m)",
        "(HMS)",
        "(MDY)",
        "(+/-D M S)",
        "%",
        "99999",
        "Week",
        "UTCTime",
        "Latitude",
        "x-ecef(m)",
        "height(m)",
        "Q",
    ),
)
DOUBLES = (
    *(0.0, -1.0, 1.0, 7.0, 100.0, 1e6, 604_799.9, 604_800.0, 1e-310, 1e19, 1e160, -1e300, float("nan")),
    *(float("inf"), float("-inf")),
)
_PARTED = b"\n#### FILE ####\n"


def office_file_targets() -> Iterator[tuple[str, Callable[[], Target]]]:
    """Yield the targets of office files, each with what the command does before it reads a log."""
    yield "trajectory", _trajectories
    yield "sbet", _sbets
    yield "antenna-positions", _positions
    yield "points", _points
    yield "plan", _plans
    yield "points-sidecar", _beside_points


# --- trajectories ---------------------------------------------------------------------------------------------------


def _texts() -> list[bytes]:
    """Return a second of flight as CSV, as Waypoint text in two layouts, and as .pos in two."""
    path = flown(12, 0.1)
    lat, lon, height = path.geodetic()
    roll, pitch, heading = (np.degrees(angle) for angle in path.attitude())
    seconds = (path.time_ns - WEEK * 604_800 * 10**9) / 1e9
    angles = list(zip(roll, pitch, heading, strict=True))
    places = list(zip(np.degrees(lat), np.degrees(lon), height, strict=True))
    rows = [
        f"{WEEK} {s:.3f} {a:.10f} {b:.10f} {h:.4f} {r:.6f} {p:.6f} {y:.6f} 0.02 0.02 0.03 1 9"
        for s, (a, b, h), (r, p, y) in zip(seconds, places, angles, strict=True)
    ]
    head = "Project: x\nPosition: 1.0\nUTC Offset: 18 s\n\n"
    titles = "Week GPSTime Latitude Longitude H-Ell Roll Pitch Heading SDNorth SDEast SDHeight Q NS"
    units = "     (sec)   (deg)    (deg)     (m)   (deg) (deg) (deg)   (m)     (m)    (m)"
    waypoint = "\n".join([head + titles, units, *rows, ""])
    dated = "\n".join(
        [
            "UTCDate UTCTime Latitude Longitude H-Ell",
            "(MDY) (HMS) (+/-D M S) (+/-D M S) (m)",
            *(f"11/21/2026 12:00:{n:05.2f} 47 30 {n / 100:.5f} 8 54 {n / 90:.5f} {900 + n}" for n in range(12)),
            "",
        ]
    )
    pos = "% program : RTKPOST\n%  GPST latitude(deg) longitude(deg) height(m) Q ns "
    pos += "sdn(m) sde(m) sdu(m) sdne(m) sdeu(m) sdun(m)\n"
    pos += "".join(
        f"2026/11/21 12:00:{n / 10:06.3f} {a:.9f} {b:.9f} {h:.4f} 1 9 0.01 0.01 0.02 0.001 -0.001 0\n"
        for n, (a, b, h) in enumerate(places)
    )
    ecef = "%  GPST x-ecef(m) y-ecef(m) z-ecef(m) Q ns sdx(m) sdy(m) sdz(m) "
    ecef += "sdxy(m) sdyz(m) sdzx(m) vx(m/s) vy(m/s) vz(m/s)\n"
    ecef += "".join(
        f"{WEEK} {s:.3f} {x:.4f} {y:.4f} {z:.4f} 2 9 0.01 0.01 0.02 0 0 0 1 2 3\n"
        for s, (x, y, z) in zip(seconds, path.position_e, strict=True)
    )
    return [one.encode() for one in (csv_text(path), waypoint, pos, ecef, dated)]


def _used(trajectory: Trajectory) -> Iterator[str]:
    """Use a trajectory as every command does."""
    trajectory.require_attitude()
    trajectory.fates((trajectory.time_ns[:-1] + trajectory.time_ns[1:]) // 2)
    trajectory.turn_rates_b()
    assert np.isfinite(trajectory.position_e).all()
    csv_text(trajectory)
    yield f"{len(trajectory)} epochs, {len(trajectory.gaps())} gaps"


def _trajectories() -> Target:
    words = (*NUMBERS, *OF_CSV, *OF_TIMES)

    def run(data: bytes) -> Iterator[str]:
        seen = told(lambda: _used(read_trajectory(data, "file", span_ns=SPAN_NS)), TrajectoryError)
        seen |= told(lambda: _used(read_trajectory(data, "file", week=WEEK, leap_seconds=18)), TrajectoryError)
        seen |= told(lambda: [read_trajectory(data, "file", needs_attitude=False).name], TrajectoryError)
        return iter(seen)

    return Target("trajectory", _texts(), lambda rng, base: changed_text(rng, base, words), run)


def _positions() -> Target:
    words = (*NUMBERS, *OF_CSV, *OF_TIMES)

    def run(data: bytes) -> Iterator[str]:
        def read() -> Iterator[str]:
            observed = outside_observations(path, (0, 1 << 62), WEEK, 18).observed
            yield f"{len(observed.rows)} rows"

        with tempfile.TemporaryDirectory(prefix="swath-fuzz-") as folder:
            path = Path(folder, "positions")
            path.write_bytes(data)
            return iter(told(read, TrajectoryError))

    return Target("antenna-positions", _texts()[2:], lambda rng, base: changed_text(rng, base, words), run)


def _sbets() -> Target:
    path = flown(12, 0.1)
    late = flown(12, 0.1, start_ns=(WEEK * 604_800 + 604_799) * 10**9 + 500_000_000)
    seeds = [_PARTED.join([sbet_bytes(one), smrmsg_bytes(one)]) for one in (path, late)]

    def run(data: bytes) -> Iterator[str]:
        sbet, parted, smrmsg = data.partition(_PARTED)

        def read() -> Iterator[str]:
            yield from _used(read_trajectory(sbet, "sbet", span_ns=SPAN_NS, smrmsg=smrmsg if parted else None))

        return iter(
            told(read, TrajectoryError) | told(lambda: _used(read_trajectory(sbet, "sbet", week=WEEK)), TrajectoryError)
        )

    return Target("sbet", [*seeds, sbet_bytes(path), smrmsg_bytes(path)], _changed_doubles, run)


def _changed_doubles(rng: random.Random, base: bytes) -> bytes:
    """Change usually one number of one record, or of one column of all records."""
    parts = base.split(_PARTED)
    at = rng.randrange(len(parts))
    if rng.random() < 0.2 or len(parts[at]) < 136:
        parts[at] = damage(rng, parts[at])
        return _PARTED.join(parts)
    doubles = 10 if at else 17
    whole = bytearray(parts[at])
    count = len(whole) // 8
    first, value = rng.randrange(count), struct.pack("<d", rng.choice(DOUBLES))
    for place in range(first, count, doubles) if rng.random() < 0.3 else (first,):
        whole[8 * place : 8 * place + 8] = value
    parts[at] = bytes(whole)
    return _PARTED.join(parts)


# --- points ---------------------------------------------------------------------------------------------------------


def _las(suffix: str) -> bytes:
    """Return two overlapping strips of a slope as a LAS or LAZ file."""
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales, header.offsets = [0.001] * 3, [465_000.0, 5_261_000.0, 450.0]
    header.add_crs(CRS.from_epsg(32632))
    las = laspy.LasData(header)
    side = np.arange(0.0, 12.0)
    x, y = (grid.ravel() for grid in np.meshgrid(side, side))
    las.x = 465_000.0 + np.r_[x, x + 3.3]
    las.y = 5_261_000.0 + np.r_[y, y + 0.4]
    las.z = 450.0 + 0.05 * np.r_[x, x + 3.3] + np.r_[0 * x, 0 * x + 0.02]
    las.point_source_id = np.repeat([1, 2], len(x))
    las.return_number = las.number_of_returns = np.ones(2 * len(x), np.uint8)
    las.gps_time = START_NS / 1e9 - 1e9 + np.linspace(0.0, 1.0, 2 * len(x))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, f"points.{suffix}")
        las.write(path)
        return path.read_bytes()


def _looked_at(folder: str) -> Iterator[str]:
    strips = strips_of_files([Path(folder)], StripRules(), lambda *_: None)
    for source in strips.look.sources:
        rows_of(source.sidecar)
        warnings_in(source.sidecar)
        yield source.damage[-60:]
    yield f"{len(strips.look.names)} strips, {strips.seen is not None}"
    yield from (note.partition("no signatures")[2][:40] for note in strips.notes)


def _points() -> Target:
    def run(data: bytes) -> Iterator[str]:
        with tempfile.TemporaryDirectory(prefix="swath-fuzz-") as folder:
            Path(folder, "points.laz").write_bytes(data)
            return iter(told(lambda: _looked_at(folder)))

    def mutate(rng: random.Random, base: bytes) -> bytes:
        """Change the header, what lies between it and the points, or any bytes."""
        kind = rng.random()
        end = 375 if kind < 0.6 else min(len(base), 1600)
        head = damage(rng, base[:end], resize=False, start=rng.choice((4, 24, 90, 100, 131, 227)))
        return head + base[end:] if kind < 0.9 else damage(rng, base)

    return Target("points", [_las("laz"), _las("las")], mutate, run, None, lambda size: (256 << 20) + 400 * size)


def _beside_points() -> Target:
    laz = _las("laz")
    sidecar = {
        "software": "swath",
        "complete": True,
        "crs": Mapping("EPSG:32632", datum="same").description(),
        "strips": [{"number": n, "file": "points.laz", "first_gps_ns": START_NS} for n in (1, 2)],
        "counts": {"left": {"read": 288, "written": 288}},
        "calibrations": {"left": {"id": "cal-1"}},
        "warnings": ["none"],
    }
    trajectory = csv_text(flown(12, 0.1)).encode()
    seeds = [_PARTED.join([json.dumps(sidecar, indent=1).encode(), trajectory])]

    def run(data: bytes) -> Iterator[str]:
        told_by, _, path = data.partition(_PARTED)
        with tempfile.TemporaryDirectory(prefix="swath-fuzz-") as folder:
            Path(folder, "points.laz").write_bytes(laz)
            Path(folder, "points.json").write_bytes(told_by)
            Path(folder, "log_trajectory.csv").write_bytes(path)
            return iter(told(lambda: _looked_at(folder)))

    words = (*NUMBERS, *OF_JSON, '"EPSG:4978"', '"EPSG:4326"', '"antenna"')

    def mutate(rng: random.Random, base: bytes) -> bytes:
        head, parted, path = base.partition(_PARTED)
        return changed_text(rng, head, words) + parted + path

    return Target("points-sidecar", seeds, mutate, run, None, lambda size: (256 << 20) + 400 * size)


# --- flight plans ---------------------------------------------------------------------------------------------------

_PLACEMARK = (
    b"<kml><Placemark><name>4</name><LineString><altitudeMode>relativeToGround</altitudeMode>"
    b"<coordinates>8.9,47.5,800 8.95,47.52,800</coordinates></LineString></Placemark></kml>"
)
_GEOJSON = b"""{"type": "FeatureCollection", "features": [{"type": "Feature", "properties": {"name": "4"}, "geometry":
{"type": "MultiLineString", "coordinates": [[[8.9, 47.5, 1500], [8.95, 47.52, 1500]]]}}, {"type": "Feature", "geometry":
{"type": "Polygon", "coordinates": [[[8.8, 47.4], [9.0, 47.4], [9.0, 47.6], [8.8, 47.4]]]}}]}"""


def _plans() -> Target:
    """Return the target of flight plans; a case is the file's suffix, a line's end, and its content."""
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("doc.kml", _PLACEMARK)
    shape = io.BytesIO()
    with shapefile.Writer(shp=shape, shx=io.BytesIO(), dbf=io.BytesIO(), shapeType=shapefile.POLYLINEZ) as writer:
        writer.field("name", "C")
        writer.linez([[[8.9, 47.5, 1500.0], [8.95, 47.52, 1500.0]]])
        writer.record("4")
    line = struct.pack("<BII4d", 1, 2, 2, 8.9, 47.5, 8.95, 47.52)
    with tempfile.TemporaryDirectory(prefix="swath-fuzz-") as folder:
        path = Path(folder, "plan.gpkg")
        pyogrio.raw.write(path, np.array([line], dtype=object), [np.array(["4"], dtype=object)], ["name"],
                          geometry_type="LineString", crs="EPSG:4326", driver="GPKG")  # fmt: skip
        package = path.read_bytes()
    sim = load_plan("small").text.encode()
    contents = {".kml": _PLACEMARK, ".kmz": packed.getvalue(), ".geojson": _GEOJSON, ".toml": sim, ".gpkg": package}
    seeds = [suffix.encode() + b"\n" + data for suffix, data in (contents | {".shp": shape.getvalue()}).items()]

    def read(data: bytes) -> set[str]:
        suffix, _, content = data.partition(b"\n")
        config = PlanConfig(file=f"plan{suffix.decode('utf-8', 'replace')}", crs="EPSG:4326")

        def seen() -> Iterator[str]:
            plan = read_plan(config, {str(config.file): content})
            assert plan is not None
            places = LineGeometry(plan.lines).places(np.array([0.83]), np.array([0.16]))
            assert np.isfinite(places.distance_m).all()
            yield from [*plan.notes, *(f"line {line.name}" for line in plan.lines)]

        return told(seen, PlanError)

    def change(rng: random.Random, base: bytes) -> bytes:
        suffix, _, content = base.partition(b"\n")
        return suffix + b"\n" + damage(rng, content)

    return Target("plan", seeds, change, read)
