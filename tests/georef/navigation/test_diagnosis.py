"""Tests that every fault put into sound data is found and named, and that sound data give no finding."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from swath.georef.arrays import FloatArray, StructArray
from swath.georef.geodesy.earth import geodetic_from_e, rot_e_from_l
from swath.georef.navigation.diagnosis.diagnose import Finding, diagnose
from swath.georef.navigation.diagnosis.time import TimeOffset, time_offset
from swath.georef.navigation.inputs import INNOVATION_DTYPE, Fate, Inertial, Kind, Setup, sort_observations
from swath.georef.records import FixType
from tests.georef.navigation.vehicles import BEGIN_NS, Recording, car, observed, reference, uav

pytestmark = pytest.mark.xdist_group("kernels")

Parts = tuple[Inertial, StructArray, Setup]
WEEK_NS = 604_800 * 10**9
FLIGHT = "tactical"


def survey() -> Recording:
    """Return a part of the flight: transit, S-turns and some of the lines."""
    return reference(FLIGHT).cut(100_150, 100_950)


def codes(parts: Parts) -> list[str]:
    return [finding.code for finding in diagnose(*parts)]


@pytest.mark.slow
@pytest.mark.parametrize("kinds", [(Kind.POSITION, Kind.VELOCITY), (Kind.POSITION,)], ids=["both", "positions"])
@pytest.mark.parametrize(
    "recording",
    [lambda: reference("tactical"), lambda: reference("mems"), car, uav],
    ids=["tactical", "mems", "car", "uav"],
)
def test_sound_data_have_no_findings(recording: Callable[[], Recording], kinds: tuple[Kind, ...]) -> None:
    sound = recording()
    assert diagnose(sound.inertial, sound.only(*kinds), sound.setup) == []


def test_a_vehicle_at_rest_gives_no_findings() -> None:
    parked = reference("mems").cut(100_010, 100_100)
    assert diagnose(parked.inertial, parked.rows, parked.setup) == []


def moved(seconds: float) -> Callable[[Parts], Parts]:
    def fault(parts: Parts) -> Parts:
        rows = parts[1].copy()
        rows["time_ns"] += round(seconds * 1e9)
        return parts[0], rows, parts[2]

    return fault


def sensed(angle: Any = 1.0, velocity: Any = 1.0) -> Callable[[Parts], Parts]:
    """Return samples with values multiplied by matrices or numbers."""

    def turned(values: FloatArray, by: Any) -> FloatArray:
        changed: FloatArray = values @ np.asarray(by).T if np.ndim(by) == 2 else values * by
        return changed

    def fault(parts: Parts) -> Parts:
        inertial = parts[0]
        samples = replace(
            inertial,
            angle_b=turned(inertial.angle_b, angle),
            velocity_b=turned(inertial.velocity_b, velocity),
        )
        return samples, parts[1], parts[2]

    return fault


def installed(matrix: Any) -> Callable[[Parts], Parts]:
    return sensed(np.asarray(matrix), np.asarray(matrix))


def arms(signs: Any) -> Callable[[Parts], Parts]:
    return lambda parts: (parts[0], parts[1], replace(parts[2], lever_arms_b=parts[2].lever_arms_b * signs))


def seen(kind: Kind, change: Callable[[StructArray], None]) -> Callable[[Parts], Parts]:
    """Change the observations of a kind in place."""

    def fault(parts: Parts) -> Parts:
        rows = parts[1].copy()
        part = rows[rows["kind"] == kind]
        change(part)
        rows[rows["kind"] == kind] = part
        return parts[0], sort_observations(rows), parts[2]

    return fault


def week_amiss(parts: Parts) -> Parts:
    rows = parts[1].copy()
    rows["time_ns"][len(rows) // 2 :] -= WEEK_NS
    return parts[0], sort_observations(rows), parts[2]


def lost(parts: Parts) -> Parts:
    inertial = parts[0]
    keep = np.ones(len(inertial), np.bool_)
    keep[20_000:20_400] = keep[60_000:60_050] = False
    angle_b, velocity_b = inertial.angle_b[keep], inertial.velocity_b[keep]
    left = Inertial(inertial.time_ns[keep], inertial.interval_s[keep], angle_b, velocity_b, inertial.bridged[keep])
    return left, parts[1], parts[2]


def bridged(share: float) -> Callable[[Parts], Parts]:
    def fault(parts: Parts) -> Parts:
        made_up = np.arange(len(parts[0])) % 100 < 100 * share
        return replace(parts[0], bridged=made_up), parts[1], parts[2]

    return fault


def at_body(parts: Parts) -> Parts:
    """Return the parts with positions reduced to the body's origin, as an INS gives them."""
    flight = reference(FLIGHT)
    assert flight.truth is not None
    rows = parts[1][parts[1]["kind"] == Kind.POSITION].copy()
    rot = flight.truth((rows["time_ns"] - BEGIN_NS) / 1e9)[0]
    lat, lon, _ = geodetic_from_e(rows["value"])
    rows["value"] -= np.einsum("nij,njk,k->ni", rot_e_from_l(lat, lon), rot, parts[2].lever_arms_b[0])
    return parts[0], rows, parts[2]


def dual(baseline_b: FloatArray, configured_b: FloatArray) -> Callable[[Parts], Parts]:
    def fault(parts: Parts) -> Parts:
        flight = reference(FLIGHT)
        assert flight.truth is not None
        t = np.arange(100_150.0, 100_950.0)
        ahead = flight.truth(t)[0] @ baseline_b
        said = np.zeros((len(t), 3))
        said[:, 0], said[:, 1] = np.arctan2(ahead[:, 1], ahead[:, 0]), -np.arcsin(ahead[:, 2])
        heading = observed(Kind.HEADING, t, said, np.full(3, 0.003), FixType.RTK_FIXED)
        rows = sort_observations(np.concatenate([parts[1], heading]))
        return parts[0], rows, replace(parts[2], baseline_b=configured_b)

    return fault


def stands(part: StructArray) -> None:
    part["value"] = part["value"][0]


def no_fix(part: StructArray) -> None:
    part["fix_type"] = FixType.NONE


def kilometres_an_hour(part: StructArray) -> None:
    part["value"] *= 3.6


def other_place(parts: Parts) -> Parts:
    """Return the parts with positions and velocities of another flight: the same one, ten minutes later."""
    other = reference(FLIGHT).cut(100_750, 101_550).rows.copy()
    other["time_ns"] -= 600 * 10**9
    return parts[0], other, parts[2]


def another_stands(parts: Parts) -> Parts:
    inertial, rows, setup = seen(Kind.POSITION, stands)(parts)
    rows["value"][rows["kind"] == Kind.VELOCITY] = 0.0
    return inertial, rows, setup


RIGHT = np.array([0.0, 1.0, 0.0])
FAULTS: list[tuple[str, Callable[[Parts], Parts], str, str]] = [
    (
        "hour",
        moved(5000.0),
        "no_common_time",
        "week 2300 100150.000 s to week 2300 100949.995 s, GNSS's",
    ),
    ("week", moved(604_800.0), "no_common_time", r"they are \+1 weeks apart: the week number of one of them is wrong"),
    ("crossing", week_amiss, "week_jump", "about a week: the week number changed"),
    ("lost", lost, "imu_gaps", "2 gaps of 2.25 s in all, the longest of 2.00 s after week 2300 100249.995 s"),
    ("bridged", bridged(0.05), "imu_bridged", r"5\.0 % of the IMU's intervals had to be interpolated over short gaps"),
    ("half the rate", bridged(0.5), "imu_rate", "set rate_hz to their true rate"),
    ("no fix", seen(Kind.POSITION, no_fix), "gnss_bad", "100 % of GNSS's positions have no fix"),
    ("km/h", seen(Kind.VELOCITY, kilometres_an_hour), "positions_and_velocities", "differ by 1[0-9][0-9]"),
    ("late", moved(0.15), "time_offset", r"are 1[45]\d ms late against the IMU's \(±"),
    ("UTC", moved(-18.0), "time_offset", r"are 1[78]\.\d\d s early .*: GPS and UTC differ by these 18 s"),
    ("in g", sensed(1.0, 1 / 9.80665), "force_size", "it seems to be in g"),
    ("degrees", sensed(180 / np.pi), "gyro_unit", "angular_rate has the wrong unit: degrees are read as radians"),
    ("gyro z", sensed(np.diag([1.0, 1.0, -1.0])), "gyro_axes", r"read as \(\+x, \+y, -z\) for body x, y, z"),
    ("gyro x", sensed(np.diag([-1.0, 1.0, 1.0])), "gyro_axes", r"read as \(-x, \+y, \+z\) for body x, y, z"),
    ("gyro x y", sensed(np.eye(3)[[1, 0, 2]]), "gyro_axes", r"read as \(\+y, \+x, \+z\) for body x, y, z"),
    ("accelerometer z", sensed(1.0, np.diag([1.0, 1.0, -1.0])), "accel_axes", r"read as \(\+x, \+y, -z\) for body"),
    (
        "z up",
        installed(np.diag([1.0, -1.0, -1.0])),
        "axes",
        r"body z reads \+1 g .* goes along body \+x; .* from the left by \[\[1, 0, 0\], \[0, -1, 0\], \[0, 0, -1\]\]",
    ),
    ("backwards", installed(np.diag([-1.0, -1.0, 1.0])), "axes", r"goes along body -x; .*\[\[-1, 0, 0\], \[0, -1, 0\]"),
    (
        "on its nose",
        installed([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]),
        "axes",
        r"body x reads -1 g .*body -z; .*\[\[0, 0, -1\], \[0, 1, 0\], \[1, 0, 0\]\]",
    ),
    ("-l", arms(-1.0), "lever_arm_sign", r"the data fit -l better than .* \[-0.35, 0.12, 1.10\] m: \[0\.[34]\d, "),
    ("-z of l", arms([1.0, 1.0, -1.0]), "lever_arm_sign", "the sign of z is wrong in the given lever_arm_m"),
    ("at the body", at_body, "position_at_body", "are those of the body's origin, not of an antenna"),
    ("at the antenna", arms(0.0), "lever_arm", "check whether they are an INS solution at the antenna"),
    ("antennas", dual(RIGHT, -RIGHT), "antennas_swapped", "headings are 1(79|80)° off .* antennas are exchanged"),
    ("baseline", dual(RIGHT, np.array([1.0, 0.0, 0.0])), "heading_offset", r"\+(89|90)° off .*secondary_lever_arm_m"),
    ("another flight", other_place, "not_one_motion", "GNSS and IMU show different motion"),
    ("one that stands", another_stands, "not_one_motion", "GNSS and IMU show different motion"),
]


@pytest.mark.slow
@pytest.mark.parametrize(("fault", "code", "words"), [case[1:] for case in FAULTS], ids=[case[0] for case in FAULTS])
def test_a_fault_is_found_and_named(fault: Callable[[Parts], Parts], code: str, words: str) -> None:
    sound = survey()
    findings = diagnose(*fault((sound.inertial, sound.rows, sound.setup)))
    assert [finding.code for finding in findings] == [code]
    assert re.search(words, findings[0].text), findings[0].text
    assert "\n" not in findings[0].text


def test_two_correctly_mounted_antennas_give_no_findings() -> None:
    sound = survey()
    assert codes(dual(RIGHT, RIGHT)((sound.inertial, sound.rows, sound.setup))) == []


@pytest.mark.parametrize(
    ("matrix", "reading"),
    [
        (np.diag([1.0, -1.0, -1.0]), r"body z reads \+1\.0"),
        (np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]), "body x reads -1.0"),
        (np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]), r"body y reads \+1\.0"),
    ],
)
def test_gravity_in_the_wrong_axis_is_found_at_rest_with_the_right_remedy(matrix: FloatArray, reading: str) -> None:
    parked = reference("mems").cut(100_010, 100_100)
    parts = installed(matrix)((parked.inertial, parked.rows, parked.setup))
    (finding,) = diagnose(*parts)
    assert finding.code == "gravity_axis"
    assert re.search(reading, finding.text)
    said = re.search(r"by (\[\[.*?\]\])", finding.text)
    assert said is not None
    cure = np.array(json.loads(said[1]), dtype=np.float64)
    assert codes(installed(cure)(parts)) == []


def test_remedy_for_rotated_axes_is_right() -> None:
    sound = survey()
    parts = installed([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])((sound.inertial, sound.rows, sound.setup))
    (finding,) = diagnose(*parts)
    said = re.search(r"by (\[\[.*\]\])", finding.text)
    assert said is not None
    assert codes(installed(np.array(json.loads(said[1]), dtype=np.float64))(parts)) == []


@pytest.mark.slow
@pytest.mark.parametrize("recording", [lambda: reference("mems"), uav], ids=["mems", "uav"])
@pytest.mark.parametrize("seconds", [0.3, -1.25])
def test_time_offsets_are_measured(recording: Callable[[], Recording], seconds: float) -> None:
    sound = recording()
    as_it_is = time_offset(sound.inertial, sound.rows)
    shifted = time_offset(*moved(seconds)((sound.inertial, sound.rows, sound.setup))[:2])
    assert as_it_is is not None
    assert shifted is not None
    assert not as_it_is.is_wrong
    assert shifted.is_wrong
    assert abs(shifted.seconds - as_it_is.seconds - seconds) < 0.01


def test_missing_data_are_reported() -> None:
    sound = survey()
    assert codes((sound.inertial.between(0, 0), sound.rows, sound.setup)) == ["no_data"]
    assert codes((sound.inertial, sound.only(Kind.VELOCITY), sound.setup)) == ["no_data"]


@dataclass(frozen=True)
class Innovations:
    innovations: StructArray


@dataclass(frozen=True)
class Solved:
    smoothed: Any


@dataclass(frozen=True)
class Timed:
    innovations: StructArray
    time_offset_s: FloatArray


def velocity_innovations(rows: StructArray, size_mps: float) -> StructArray:
    """Return one innovation for each observed velocity, with every component of the given size."""
    found = np.zeros(int((rows["kind"] == Kind.VELOCITY).sum()), INNOVATION_DTYPE)
    found["kind"], found["value"] = Kind.VELOCITY, size_mps
    return found


@pytest.mark.slow
@pytest.mark.parametrize(("size_mps", "told"), [(0.02, False), (2.0, True)])
def test_a_filter_that_follows_gnss_rules_out_a_time_offset(size_mps: float, told: bool) -> None:
    """An offset of 0.3 s would show as more than one metre per second in the velocities of the turns."""
    sound = survey()
    parts = moved(0.3)((sound.inertial, sound.rows, sound.setup))
    solved = Solved(Timed(velocity_innovations(parts[1], size_mps), np.zeros(0)))
    assert ("time_offset" in [finding.code for finding in diagnose(*parts, solved)]) == told


@pytest.mark.slow
@pytest.mark.parametrize(("taken_out_s", "told"), [(-0.3, []), (0.0, ["time_offset"])])
def test_an_offset_already_removed_by_the_filter_is_not_reported_again(taken_out_s: float, told: list[str]) -> None:
    sound = survey()
    inertial, rows, setup = moved(0.3)((sound.inertial, sound.rows, sound.setup))
    timed = Timed(velocity_innovations(rows, 2.0), np.array([taken_out_s]))
    found = diagnose(inertial, rows, replace(setup, estimate_time_offset_s=1.0), Solved(timed))
    assert [finding.code for finding in found] == told


def test_contradicting_comparisons_give_no_offset() -> None:
    """On a car's recording a correlation of 0.757 gave −340 ± 13 ms, and one of 0.987 gave −10 ms."""
    lone = TimeOffset(-0.34, 0.05, 0.757, 0.70, "force")
    assert lone.is_wrong
    assert not replace(lone, contradiction="by the turn -10 ± 50 ms").is_wrong
    assert not replace(lone, sigma=0.12).is_wrong


def component_late(rows: StructArray, component: str, late_s: float) -> StructArray:
    """Return velocities of which one component, ``course`` or ``down``, lags, as if it alone were filtered."""
    rows, at = rows.copy(), np.flatnonzero(rows["kind"] == Kind.VELOCITY)
    t = (rows["time_ns"][at] - rows["time_ns"][at[0]]) / 1e9
    north, east, down = rows["value"][at].T
    course = np.unwrap(np.arctan2(east, north))
    if component == "course":
        course = np.interp(t - late_s, t, course)
    else:
        down = np.interp(t - late_s, t, down)
    speed = np.hypot(north, east)
    rows["value"][at] = np.column_stack([speed * np.cos(course), speed * np.sin(course), down])
    return rows


@pytest.mark.parametrize(
    ("recording", "component", "late_s", "compared"),
    [
        (car, "course", 0.5, "turn"),
        (car, "course", -0.7, "turn"),
        (lambda: reference("tactical"), "down", 1.0, "force"),
    ],
    ids=["course late", "course early", "down late"],
)
@pytest.mark.slow
def test_motion_late_in_one_signal_only_is_reported_as_unclear(
    recording: Callable[[], Recording], component: str, late_s: float, compared: str
) -> None:
    """The comparison with that component shows the lag, and the speed contradicts it.

    If the motion is late as a whole, all comparisons show it.
    """
    sound = recording()
    rows = component_late(sound.rows, component, late_s)
    found = time_offset(sound.inertial, rows)
    assert found is not None
    assert (found.compared, found.is_certain, found.is_wrong) == (compared, False, False)
    assert found.seconds == pytest.approx(late_s, abs=0.16)  # a car's course turns 0.14 s after its nose
    assert re.fullmatch(r"by the speed [+-]\d+ ± \d+ ms", found.contradiction)
    (finding,) = diagnose(sound.inertial, rows, sound.setup)
    assert (finding.code, finding.severity) == ("time_unclear", "warning")
    assert f"by the {compared} {1000 * found.seconds:+.0f} ± " in finding.text
    assert found.contradiction in finding.text
    assert codes(moved(late_s)((sound.inertial, sound.rows, sound.setup))) == ["time_offset"]


@pytest.mark.parametrize("late_s", [2.0, -18.0])
def test_noise_of_dense_positions_does_not_hide_an_offset(late_s: float) -> None:
    """Positions to 1.5 cm at 5 Hz imply accelerations with noise of 0.9 m/s², more than the flight's own."""
    sound = reference("tactical").cut(100_150, 100_300)
    rows = sound.only(Kind.POSITION)
    begin_ns, end_ns = int(rows["time_ns"][0]), int(rows["time_ns"][-1])
    dense = np.repeat(rows[:1], (end_ns - begin_ns) // 200_000_000)
    dense["time_ns"] += np.arange(len(dense)) * 200_000_000
    through = CubicSpline((rows["time_ns"] - begin_ns) / 1e9, rows["value"])
    noise = np.random.default_rng(1).normal(0.0, 0.015, (len(dense), 3))
    dense["value"] = through((dense["time_ns"] - begin_ns) / 1e9) + noise
    assert codes((sound.inertial, dense, sound.setup)) == []
    late, *_ = diagnose(*moved(late_s)((sound.inertial, dense, sound.setup)))
    assert late.code == "time_offset"


def test_the_sigma_of_a_time_offset_is_honest() -> None:
    """Offsets of stretches of 250 s scatter no more than their sigmas say; the worst is within four."""
    whole = reference("mems")
    begin = float(whole.inertial.time_ns[0] - BEGIN_NS) / 1e9
    parts = [whole.cut(begin + at, begin + at + 250.0) for at in (100.0, 350.0)]
    found = [time_offset(part.inertial, part.rows) for part in parts]
    assert all(each is not None and abs(each.seconds) < 4.0 * each.sigma for each in found), found


def test_observations_refused_by_the_filter_are_reported() -> None:
    sound = survey()
    rows = np.zeros(100, INNOVATION_DTYPE)
    rows["kind"] = Kind.POSITION
    rows["fate"][:60] = Fate.REJECTED
    findings = diagnose(sound.inertial, sound.rows, sound.setup, Solved(Innovations(rows)))
    assert findings == [Finding("gnss_rejected", "warning", findings[0].text)]
    assert "rejected 60 % of GNSS's positions" in findings[0].text
    rows["fate"][:60] = Fate.TAKEN
    assert diagnose(sound.inertial, sound.rows, sound.setup, Solved(Innovations(rows))) == []


def test_errors_are_listed_before_warnings() -> None:
    sound = survey()
    parts = arms(-1.0)(lost((sound.inertial, sound.rows, sound.setup)))
    assert [finding.severity for finding in diagnose(*parts)] == ["error", "warning"]
