"""Tests that a given trajectory is compared with the log's fixes and IMU, and its faults are named."""

from __future__ import annotations

import copy
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pyproj import Transformer

from swath.daemon.config import Config
from swath.daemon.config.tables import GnssConfig
from swath.daemon.processing.given_trajectory import Belonging, Given, _nearest, judge_given, points_of
from swath.daemon.processing.points.clocks import LogClocks, read_clocks
from swath.daemon.processing.setup.setup import Options, Setup
from swath.georef.agreement import Apart
from swath.georef.geodesy.earth import geodetic_from_e
from swath.georef.trajectory.trajectory import Trajectory
from tests.daemon.short_flight import Flown, fly_short, two_lines

UNDULATION_M = 48.0  # of the virtual receiver
Angles = tuple[Any, Any, Any]


def plan(gnss: str) -> str:
    """Return a plan with two lines in the Alps, whose receiver has an antenna aside."""
    return two_lines(
        "given",
        flight="origin_deg = [47.48, 11.4]\nlead_s = 3.0",
        half_m=600.0,
        norths_m=(0.0, 200.0),
        height_m=800.0,
        gnss=f"lever_arm_m = [0.4, -0.25, -1.2]\n{gnss}",
        imu="",
        prf_hz=1000,
    )


@dataclass
class Log:
    """A log, what is read from it, and the truth."""

    flown: Flown
    setup: Setup
    clocks: LogClocks
    truth: Trajectory

    def judged(self, trajectory: Trajectory, at: str = "body", *, datum_is_said: bool = False) -> Belonging:
        """Judge a trajectory given for one of the points."""
        points = points_of(self.setup)
        moved = trajectory if at == "body" else trajectory.at_body(points[at])
        given = Given("x.out", moved, points[at], points, datum_is_said)
        return judge_given(given, self.setup, self.clocks, self.flown.log)

    def refused(self, trajectory: Trajectory, at: str = "body") -> str:
        """Return the single line with which a trajectory is refused."""
        (line,) = self.judged(trajectory, at).refused
        assert "\n" not in line
        assert line.startswith("x.out: ")
        return line


def read(flown: Flown) -> Log:
    setup = Setup.of_log(flown.session().attachments(), Options(uncertainty=False))
    clocks = read_clocks(flown.session(), setup.sources, positions=True)
    truth = flown.truth()
    assert len(clocks.imu_force_b) == len(clocks.imu_rate_b) > 0
    return Log(flown, setup, clocks, replace(truth, name="x.out"))


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Log:
    """Return the log of an RTK receiver with two lines and the turn between them."""
    return read(fly_short(tmp_path_factory.mktemp("rtk"), plan('grade = "rtk"')))


@pytest.fixture(scope="module")
def single(tmp_path_factory: pytest.TempPathFactory) -> Log:
    """Return the log of a single receiver that sends NMEA without sigmas."""
    return read(fly_short(tmp_path_factory.mktemp("spp"), plan('grade = "spp"\nprotocol = "nmea"')))


def raised(trajectory: Trajectory, change: Any) -> Trajectory:
    """Return the trajectory with another latitude, longitude and height."""
    return placed(trajectory, *change(*trajectory.geodetic()))


def placed(trajectory: Trajectory, lat: Any, lon: Any, height: Any, angles: Angles | None = None) -> Trajectory:
    return Trajectory.from_geodetic(
        trajectory.time_ns, lat, lon, height, trajectory.velocity_l(), *(angles or trajectory.attitude()), name="x.out"
    )


def turned(trajectory: Trajectory, change: Any) -> Trajectory:
    """Return the trajectory with other angles."""
    return placed(trajectory, *trajectory.geodetic(), angles=change(*trajectory.attitude()))


@pytest.mark.slow
def test_a_correct_trajectory_is_accepted_without_warnings(log: Log, single: Log) -> None:
    for one in (log, single):
        found = one.judged(one.truth)
        assert found.refused == []
        assert found.warnings == []


def test_errors_of_metres_in_single_fixes_do_not_refuse_a_trajectory(single: Log) -> None:
    found = single.judged(raised(single.truth, lambda lat, lon, height: (lat + 1.5 / 6.4e6, lon, height - 4.0)))
    assert found.refused == []


def up_by(one: Log, own_m: float, *, metres: float | None = None, sigmas: float | None = None) -> Trajectory:
    """Return the truth raised until it is so many metres, or sigmas, off the fixes; its own sigma is `own_m`."""
    sure = replace(one.truth, position_sigma_l=np.full((len(one.truth), 3), own_m))

    def lifted(up_m: float) -> Trajectory:
        high = raised(sure, lambda lat, lon, height: (lat, lon, height + up_m))
        return replace(high, position_sigma_l=sure.position_sigma_l)

    def apart(up_m: float) -> Apart:
        given = Given("x.out", lifted(up_m), (0.0, 0.0, 0.0), points_of(one.setup), False)
        found, _, _ = _nearest(given, one.setup, one.clocks)
        assert found is not None
        return found

    tried_m = 3.0
    there = apart(tried_m)
    wanted_m = metres if sigmas is None else sigmas * there.metres / there.sigmas
    assert wanted_m is not None
    up_m = tried_m + wanted_m - there.metres
    assert apart(up_m).metres == pytest.approx(wanted_m, abs=1e-4)
    return lifted(up_m)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("own_m", "limit", "warned", "refused"),
    [
        (0.1, {"sigmas": 4.98}, False, False),
        (0.1, {"sigmas": 5.02}, True, False),
        (0.1, {"sigmas": 19.95}, True, False),  # 2.3 m
        (0.1, {"sigmas": 20.05}, False, True),
        (0.5, {"metres": 2.99}, True, False),  # 6 sigmas
        (0.5, {"metres": 3.01}, False, True),
        (2.0, {"metres": 2.99}, False, False),
        (2.0, {"metres": 3.01}, False, True),  # 1.5 sigmas of the trajectory, but 60 of the fixes
    ],
)
def test_warnings_and_refusals_begin_at_their_limits(
    log: Log, own_m: float, limit: dict[str, float], warned: bool, refused: bool
) -> None:
    """From 3 m or 20 sigmas on it is refused, from 5 sigmas on there is a warning, and below nothing."""
    found = log.judged(up_by(log, own_m, **limit))
    assert (len(found.warnings), len(found.refused)) == (int(warned), int(refused))
    for line in [*found.warnings, *found.refused]:
        assert line.startswith("x.out: lies ")


@pytest.mark.parametrize(("metres", "warned"), [(2.99, False), (3.01, True), (5.0, True), (8.0, True)])
def test_a_trajectory_metres_from_poor_fixes_gives_a_warning_about_both(
    single: Log, metres: float, warned: bool
) -> None:
    """The time or the datum is not blamed, because such fixes cannot exclude it and nothing indicates it."""
    found = single.judged(up_by(single, 0.1, metres=metres))
    assert found.refused == []
    assert len(found.warnings) == int(warned)
    assert all(
        line.endswith(": fixes of this kind may be wrong by this amount, or the trajectory may be")
        for line in found.warnings
    )


def test_a_trajectory_48_m_low_is_recognised_as_above_the_geoid(log: Log, single: Log) -> None:
    for one in (log, single):
        line = one.refused(raised(one.truth, lambda lat, lon, height: (lat, lon, height - UNDULATION_M)))
        assert "its heights are above the geoid, which lies +48.0 m from the ellipsoid at this place" in line
    assert "up -48.0" in log.refused(raised(log.truth, lambda lat, lon, height: (lat, lon, height - UNDULATION_M)))


def test_a_trajectory_7_km_east_is_recognised_as_of_another_place(log: Log) -> None:
    line = log.refused(raised(log.truth, lambda lat, lon, height: (lat, lon + np.radians(0.1), height)))
    assert "lies 7.5 km off the fixes of gnss/rover" in line
    assert "in another place" in line
    assert "latitude and longitude are exchanged" in log.refused(
        raised(log.truth, lambda lat, lon, height: (lon, lat, height))
    )


def test_a_distant_place_along_a_straight_line_is_not_a_time_offset(log: Log) -> None:
    """The line is flown east at 50 m/s, so 7.5 km would be 151 s, outside the recorded time."""
    fixes = {source: rows[: len(rows) // 5] for source, rows in log.clocks.fixes.items()}
    clocks = replace(log.clocks, fixes=fixes)
    east = raised(log.truth, lambda lat, lon, height: (lat, lon + np.radians(0.1), height))
    line = replace(log, clocks=clocks).refused(east)
    assert "its time were" not in line
    assert "in another place" in line


def test_heights_in_feet_are_recognised(log: Log) -> None:
    line = log.refused(raised(log.truth, lambda lat, lon, height: (lat, lon, height / 0.3048)))
    assert "its heights are in feet" in line
    line = log.refused(raised(log.truth, lambda lat, lon, height: (lat, lon, (height - UNDULATION_M) / 0.3048)))
    assert "its heights are in feet" in line


@pytest.mark.parametrize(("code", "words"), [("EPSG:4230", "ED50"), ("EPSG:4312", "MGI")])
def test_another_datum_is_recognised(log: Log, code: str, words: str) -> None:
    """An old national datum differs by tens to hundreds of metres; PROJ makes the case, at another place."""
    there = Transformer.from_crs("EPSG:4979", code, always_xy=True)

    def moved(lat: Any, lon: Any, height: Any) -> Any:
        east_deg, north_deg = there.transform(np.degrees(lon), np.degrees(lat))
        return np.radians(north_deg), np.radians(east_deg), height

    line = log.refused(raised(log.truth, lambda lat, lon, height: moved(lat, lon, height)))
    assert "its datum differs" in line
    assert words in line


def test_a_continental_frame_is_distinguished_from_a_global_one(log: Log) -> None:
    """ETRS89 is 0.8 m from ITRF there, which exceeds 20 sigmas of an RTK fix and of the trajectory."""
    there = Transformer.from_crs("EPSG:7789", "EPSG:4936", always_xy=True)
    epoch = np.full(len(log.truth), 2026.5)
    x, y, z = log.truth.position_e.T
    moved = np.stack(there.transform(x, y, z, epoch)[:3], axis=1)
    apart_m = float(np.linalg.norm(moved - log.truth.position_e, axis=1).mean())
    assert 0.6 < apart_m < 1.0
    sure = replace(log.truth, position_e=moved, position_sigma_l=np.full((len(moved), 3), 0.01))
    line = log.refused(sure)
    assert "its datum differs" in line
    assert "ETRS89" in line or "ETRF" in line
    found = log.judged(sure, datum_is_said=True)  # the wrong datum may then be the receiver's
    assert not found.refused
    assert "its datum differs" in found.warnings[0]


def test_a_reference_point_other_than_stated_is_recognised(log: Log) -> None:
    sure = replace(log.truth, position_sigma_l=np.full((len(log.truth), 3), 0.01))
    of_antenna = sure.at_body([-0.4, 0.25, 1.2])
    assert "use --trajectory-at antenna" in log.refused(of_antenna)
    assert log.judged(of_antenna, "antenna").refused == []
    assert "use --trajectory-at body" in log.refused(sure, "antenna")
    mirrored = sure.at_body([-0.8, 0.5, 2.4])
    assert "lever arm has the opposite sign" in log.refused(mirrored)


def test_an_antenna_without_a_lever_arm_gives_only_a_warning(log: Log) -> None:
    """It is 1.2 m away, over 20 sigmas, because lever_arm_m is not configured; the warning names the key."""
    table = log.setup.config.gnss["rover"]
    unsaid = GnssConfig(transport=table.transport, protocol=table.protocol, pps=table.pps)
    config = log.setup.config
    setup = copy.copy(log.setup)
    setup.config = Config(config.tables.model_copy(update={"gnss": {"rover": unsaid}}), config.path, config.text)
    sure = replace(log.truth, position_sigma_l=np.full((len(log.truth), 3), 0.01))
    found = replace(log, setup=setup).judged(sure)
    assert found.refused == []
    (line,) = found.warnings
    assert "gnss.rover.lever_arm_m is not configured" in line


def test_a_time_offset_is_recognised_by_the_distance_flown(log: Log) -> None:
    line = log.refused(replace(log.truth, time_ns=log.truth.time_ns - 2_000_000_000))
    assert "as if its time were 2.00 s early" in line
    found = log.judged(replace(log.truth, time_ns=log.truth.time_ns - 18_000_000_000))
    assert "18.00 s early; it is in UTC, not GPS time" in found.refused[-1]


FLIPS = {
    "pitch has the opposite sign": lambda roll, pitch, heading: (roll, -pitch, heading),
    "roll has the opposite sign": lambda roll, pitch, heading: (-roll, pitch, heading),
    "heading has the opposite sign": lambda roll, pitch, heading: (roll, pitch, -heading),
    "pitch and heading have the opposite sign (axes forward, left, up": lambda roll, pitch, heading: (
        roll,
        -pitch,
        np.pi / 2 - heading,
    ),
    "roll and pitch are swapped": lambda roll, pitch, heading: (pitch, roll, heading),
}


@pytest.mark.parametrize("words", list(FLIPS))
def test_angles_of_another_convention_are_recognised(log: Log, words: str) -> None:
    found = log.judged(turned(log.truth, FLIPS[words]))
    assert words in found.refused[0]
    assert "turns like the IMU" in found.refused[0]


@pytest.mark.parametrize("words", list(FLIPS)[:3])
def test_one_straight_line_of_20_seconds_suffices_to_recognise_other_angles(log: Log, words: str) -> None:
    begin = log.truth.time_ns[0] + 4_000_000_000
    line = turned(log.truth.between(int(begin), int(begin) + 20_000_000_000), FLIPS[words])
    assert words in log.judged(line).refused[0]


def test_headings_from_grid_north_are_recognised(log: Log) -> None:
    """The convergence of UTM zone 32 is (11.4° − 9°) sin 47.48° = 1.77° there."""
    grid_rad = np.radians(2.4 * np.sin(np.radians(47.48)))
    line = log.refused(turned(log.truth, lambda roll, pitch, heading: (roll, pitch, heading - grid_rad)))
    assert "counts from grid north, which lies +1.7" in line
    off = log.judged(turned(log.truth, lambda roll, pitch, heading: (roll, pitch, heading + np.radians(3.0))))
    assert "heading is +3.0" in off.refused[0]


def test_a_trajectory_of_another_flight_is_refused_by_its_turns(log: Log) -> None:
    """It follows the same path but with another motion about it."""
    random = np.random.default_rng(5)
    count = len(log.truth)
    since_s = (log.truth.time_ns - log.truth.time_ns[0]) / 1e9
    waves = np.sin(2 * np.pi * np.outer(since_s, random.uniform(0.1, 0.5, 6)) + random.uniform(0, 6, 6))
    wobble = 0.01 * np.stack([waves[:, :2].sum(1), waves[:, 2:4].sum(1), waves[:, 4:].sum(1)])
    assert wobble.shape == (3, count)
    other = turned(log.truth, lambda roll, pitch, heading: tuple(wobble + np.array([[0.0], [0.0], [1.0]])))
    line = log.judged(other).refused[0]
    assert "does not turn like the IMU" in line
    assert "give the trajectory of this flight" in line


@pytest.fixture(scope="module")
def rough(tmp_path_factory: pytest.TempPathFactory) -> list[Log]:
    """Return one plan flown twice in light turbulence, with an inertial unit of the lowest grade."""
    flights = []
    for seed in (1, 2):
        flight = f'origin_deg = [47.48, 11.4]\nlead_s = 3.0\nturbulence = "light"\nseed = {seed}'
        text = two_lines("rough", flight=flight, gnss='grade = "rtk"', imu='grade = "consumer"', prf_hz=200)
        flights.append(read(fly_short(tmp_path_factory.mktemp("rough"), text)))
    return flights


@pytest.mark.slow
def test_another_flight_over_the_same_lines_is_refused_by_its_gusts(rough: list[Log]) -> None:
    """The flights turn alike (correlation 0.9) and are a decimetre apart, which the fixes cannot separate."""
    for one, other in (rough, rough[::-1]):
        assert one.judged(one.truth).refused == []
        line = one.refused(other.truth)
        assert "its response to gusts differs (correlation" in line
        assert "another flight over the same lines" in line


@pytest.mark.parametrize(("every", "digits"), [(10, 2), (4, 3), (1, 2)])
def test_rounded_attitudes_at_20_hz_are_accepted(rough: list[Log], every: int, digits: int) -> None:
    """Attitudes may also be late, which is reported elsewhere."""
    truth = rough[0].truth
    angles = [np.radians(np.round(np.degrees(angle), digits)) for angle in truth.attitude()]
    columns = [column[::every] for column in (*truth.geodetic(), truth.velocity_l(), *angles)]
    for late_ns in (0, 100_000_000, 15_000_000_000):
        given = Trajectory.from_geodetic(truth.time_ns[::every] + late_ns, *columns, name="x.out")
        assert not any("gusts" in line for line in rough[0].judged(given).refused)


def test_noise_is_not_taken_for_gusts(log: Log) -> None:
    """In calm air angles with noise of 0.02° contain no gusts, and the flight is this one."""
    noise = np.radians(0.02) * np.random.default_rng(7).standard_normal((3, len(log.truth)))
    given = turned(log.truth, lambda *angles: tuple(np.stack(angles) + noise))
    assert not any("gusts" in line for line in log.judged(given).refused)


def test_the_truth_matches_the_ellipsoidal_height_of_the_fixes(log: Log) -> None:
    """The fixes used for comparison are the receiver's, reduced to the ellipsoid by its undulation."""
    fixes = [fix for fix in log.clocks.fixes["gnss/rover"] if fix.height_m is not None]
    height = float(np.median(geodetic_from_e(log.truth.position_e)[2]))
    assert np.median([fix.height_m for fix in fixes]) == pytest.approx(height + 1.2, abs=0.3)
    assert all(fix.undulation_m == pytest.approx(UNDULATION_M) for fix in fixes)
    assert Path(log.flown.log).exists()
