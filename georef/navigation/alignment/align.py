"""Find the start of navigation: attitude, velocity and position of the body from its own motion and GNSS.

One method serves any motion of the vehicle: attitude, velocity, position and sensor errors at a moment are fitted to
the last minute (`alignment_fit`), and the covariance shows how much that minute determines. At rest the fit levels, and
finds north by the earth's rate as far as the gyroscopes are good enough; in motion, airborne or not, changes of
velocity give the heading; before any change, the course over ground gives it, with the sigma of crabbing. A second
antenna or a device's own attitude are observations like others.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np

from swath.georef.arrays import BoolArray, FloatArray, Int64Array, StructArray
from swath.georef.geodesy.earth import geodetic_from_e
from swath.georef.geodesy.gravity import EARTH_RATE_RADPS
from swath.georef.geodesy.rotations import attitude_of, rot_z
from swath.georef.navigation.alignment.blocks import Blocks, Felt
from swath.georef.navigation.alignment.fit import PLACE, TILT, VELOCITY, Fitted, Problem
from swath.georef.navigation.inputs import (
    OBSERVATION_DTYPE,
    ImuNoise,
    Inertial,
    Kind,
    NavigationError,
    Setup,
    Start,
    sort_observations,
)
from swath.georef.timescales.gps_time import SECOND_NS

WINDOW_NS = 60 * SECOND_NS
THINNED_NS = 9 * SECOND_NS // 10  # minimum between used observations of a kind, since neighbours share their noise
FEWEST = 4  # minimum number of observations
SHORTEST_S = {"given": 5.0, "good": 10.0, "fair": 30.0, "still": 58.0}  # minimum seconds of data, by the kind of result
GOOD_RAD, FAIR_RAD, TILT_RAD = np.radians([2.0, 12.0, 2.0])
CRAB_RAD = float(np.radians(10.0))
COURSE_MPS = 5.0  # from this speed on the course gives the heading
KNOWN_RAD, BACKWARDS_RAD = np.radians([20.0, 60.0])
MISFIT = 25.0  # reduced χ² beyond which no fit is accepted
STILL_RADPS, STILL_MPS2, STILL_MPS = 2e-3, 0.05, 0.05
CHANGE_MPS, CHANGE_SIGMAS = 0.3, 5.0  # minimum change of velocity that determines a heading
STILL_NS = 3 * SECOND_NS
USED = (Kind.POSITION, Kind.VELOCITY, Kind.HEADING, Kind.ATTITUDE)
CHUNK_NS = 10 * SECOND_NS


class AlignmentError(NavigationError):
    """Raised if the data give no initial attitude; the message names the missing data."""


@dataclass(frozen=True, eq=False)
class AlignedStart(Start):
    """A start found by alignment.

    Attributes:
        method: "still", "motion", "course", "dual antenna" or "given".
        text: the method in words, with the sigmas.
    """

    method: str
    text: str


class Aligner:
    """Takes inertial samples and observations as they come, until the start is known.

    The result depends on the data alone, not on their division into batches or on which of the two comes first;
    observations must come in order of time. An epoch is examined once inertial samples and a later observation are
    available.

    Args:
        setup: lever arms, baseline and noise.
        crab_sigma_rad: sigma of heading − course.

    Attributes:
        start: where navigation may begin; None until it is known.
        state: in words: what the aligner waits for, or how it found the start.
        counts: observations not used, by reason: unusable, out_of_order.
    """

    def __init__(self, setup: Setup, crab_sigma_rad: float = CRAB_RAD) -> None:
        self.start: AlignedStart | None = None
        self.state = "waits for GNSS positions and inertial samples"
        self.counts: Counter[str] = Counter()
        self._setup, self._crab_rad = setup, crab_sigma_rad
        self._blocks = Blocks()
        self._waiting = np.zeros(0, OBSERVATION_DTYPE)
        self._window = np.zeros(0, OBSERVATION_DTYPE)
        self._latest_ns: dict[tuple[int, int], int] = {}  # by kind and antenna
        self._done_ns: int | None = None

    def feed(self, inertial: Inertial) -> None:
        """Take the next inertial samples."""
        if self.start is None:
            self._blocks.feed(inertial)
            self._work()

    def observe(self, rows: StructArray) -> None:
        """Take the next observations, `OBSERVATION_DTYPE`."""
        if self.start is None:
            sound = _sound(rows, len(self._setup.lever_arms_b))
            late = sound & (rows["time_ns"] <= self._done_ns) if self._done_ns is not None else sound & False
            self.counts += Counter(unusable=int((~sound).sum()), out_of_order=int(late.sum()))
            used = rows[sound & ~late & np.isin(rows["kind"], USED)]
            self._waiting = sort_observations(np.concatenate([self._waiting, used]))
            self._work()

    def _work(self) -> None:
        """Examine every epoch for which no more data will come."""
        while self.start is None and len(self._waiting):
            now_ns = int(self._waiting["time_ns"][0])
            count = int(np.searchsorted(self._waiting["time_ns"], now_ns, side="right"))
            if count == len(self._waiting) or self._blocks.covered_ns is None or self._blocks.covered_ns < now_ns:
                break
            rows, self._waiting = self._waiting[:count], self._waiting[count:]
            self._done_ns = now_ns
            if self._keep(rows):
                self._blocks.forget_before(now_ns - WINDOW_NS - SECOND_NS)
                self._window = self._window[self._window["time_ns"] >= now_ns - WINDOW_NS]
                self._look(now_ns)

    def _keep(self, rows: StructArray) -> bool:
        """Keep an epoch's rows that are not too close to the rows before; return whether a position is among them."""
        kept = []
        for number, row in enumerate(rows):
            key = int(row["kind"]), int(row["antenna"])
            if int(row["time_ns"]) - self._latest_ns.get(key, -WINDOW_NS) >= THINNED_NS:
                self._latest_ns[key] = int(row["time_ns"])
                kept.append(number)
        self._window = np.concatenate([self._window, rows[kept]])
        return bool((rows["kind"][kept] == Kind.POSITION).any())

    def _look(self, now_ns: int) -> None:
        """Try for a start at an epoch with a position."""
        felt = self._blocks.felt(now_ns - WINDOW_NS, now_ns)
        if felt is None:
            self.state = "waits for inertial samples at the time of GNSS's"
            return
        rows = self._window[self._window["time_ns"] >= felt.time_ns[0]]
        seconds = (now_ns - int(rows["time_ns"][0])) / SECOND_NS
        most = max(int((rows["kind"] == kind).sum()) for kind in (Kind.POSITION, Kind.VELOCITY))
        has_attitude = np.isin((Kind.HEADING, Kind.ATTITUDE), rows["kind"]).any()
        if most < FEWEST or seconds < SHORTEST_S["given" if has_attitude else "good"]:
            self.state = f"has {seconds:.0f} s of GNSS and inertial samples together, needs {SHORTEST_S['good']:.0f} s"
            return
        still_ns = _still(felt, rows, self._setup.noise)
        problem = Problem(felt, rows, self._setup, still_ns)
        fitted, method = self._fit(problem, standing=len(still_ns) > 0)
        self._judge(now_ns, fitted, method if _moved(rows) or method in GIVEN else TOLD_LITTLE[method], seconds)

    def _fit(self, problem: Problem, *, standing: bool) -> tuple[Fitted, str]:
        """Return the best fit, and the source of its heading."""
        fitted = problem.fit(problem.first_guess())
        if problem.has_attitude:
            return fitted, "given"
        if problem.has_heading:
            return fitted, "dual antenna"
        speed = float(np.hypot(*fitted.velocity_l[:2]))
        if speed < COURSE_MPS:
            return fitted, "still" if standing else "motion"
        course = float(np.arctan2(fitted.velocity_l[1], fitted.velocity_l[0]))
        heading = float(attitude_of(fitted.rot_l_from_b)[2])
        sigma = float(fitted.sigma(TILT)[2])
        off = (course - heading + np.pi) % (2.0 * np.pi) - np.pi
        if sigma < KNOWN_RAD and abs(off) > BACKWARDS_RAD and fitted.misfit < MISFIT:
            return fitted, "motion"  # the vehicle moves backwards
        given = course, float(np.hypot(self._crab_rad, fitted.sigma(VELOCITY)[:2].max() / speed))
        guesses = [fitted.rot_l_from_b]
        if abs(off) > KNOWN_RAD:
            guesses.append(rot_z(off) @ fitted.rot_l_from_b)
        best = min((problem.fit(guess, given) for guess in guesses), key=lambda each: each.cost)
        return best, "motion" if best.sigma(TILT)[2] < 0.6 * self._crab_rad else "course"

    def _judge(self, now_ns: int, fitted: Fitted, method: str, seconds: float) -> None:
        """Accept a fit as the start, or describe the missing data."""
        sigma = fitted.sigma(TILT)
        if method == "still":  # whatever the fit gives: a gyroscope cannot tell its bias from the earth's rate
            compass = self._setup.noise.gyro_bias / max(_level_earth_rate(fitted.position_e), 1e-9)
            sigma[2] = max(float(sigma[2]), min(compass, np.pi))
        north, east, heading = sigma.tolist()
        tilt = max(north, east)
        words = f"heading {_degrees(heading)}, roll/pitch {_degrees(tilt)}"
        if fitted.misfit > MISFIT:
            self.state = (
                f"inertial samples do not fit GNSS's velocities (residuals {np.sqrt(fitted.misfit):.0f} times their "
                "sigma): check rotation_b_imu, lever_arm_m and the time stamps"
            )
            return
        good = heading <= GOOD_RAD and seconds >= SHORTEST_S["good"]
        kind = "given" if method in GIVEN else "still" if method == "still" else "fair"
        fair = heading <= FAIR_RAD and seconds >= SHORTEST_S[kind]
        if tilt <= TILT_RAD and (good or fair):
            roll, pitch, yaw = (float(angle) for angle in attitude_of(fitted.rot_l_from_b))
            self.state = f"aligned {FOUND[method]}: {words}"
            self.start = AlignedStart(
                now_ns,
                fitted.position_e,
                fitted.velocity_l,
                np.array([roll, pitch, yaw]),
                fitted.sigma(PLACE),
                fitted.sigma(VELOCITY),
                sigma,
                method,
                self.state,
            )
        elif tilt > TILT_RAD:
            self.state = f"roll and pitch known to {_degrees(tilt)} yet: waits for more GNSS positions and velocities"
        else:
            self.state = f"{words} yet: waits for {AWAITED[method]}"


GIVEN = ("given", "dual antenna")
FOUND = {
    "given": "by the device's own attitude",
    "dual antenna": "with dual-antenna heading",
    "still": "standing still, by gyrocompassing",
    "motion": "in motion",
    "course": "in motion, heading by the course over ground",
}
TOLD_LITTLE = {
    "still": "still",
    "motion": "still",
    "course": "course",
}  # methods to report if the velocity hardly changed
AWAITED = {
    "given": "more data",
    "dual antenna": "more dual-antenna headings",
    "still": "first motion (these gyroscopes do not find north standing still) or dual-antenna heading",
    "motion": "a change of speed, a turn, or speed enough for a course",
    "course": "a turn or change of speed",
}


def align(
    inertial: Inertial, observations: StructArray, setup: Setup, crab_sigma_rad: float = CRAB_RAD
) -> AlignedStart:
    """Return the earliest start that the data give.

    Args:
        inertial: samples.
        observations: `OBSERVATION_DTYPE`.
        setup: lever arms, baseline and noise.
        crab_sigma_rad: sigma of heading − course.

    Raises:
        AlignmentError: no start was found; the message names the missing data.
    """
    aligner = Aligner(setup, crab_sigma_rad)
    rows = sort_observations(observations)
    times = [each for each in (inertial.time_ns, rows["time_ns"]) if len(each)]
    if len(times) == 2:
        for begin_ns in range(int(min(t[0] for t in times)), int(max(t[-1] for t in times)) + 1, CHUNK_NS):
            span = np.array([begin_ns, begin_ns + CHUNK_NS])
            aligner.feed(inertial.between(*np.searchsorted(inertial.time_ns, span).tolist()))
            aligner.observe(rows[slice(*np.searchsorted(rows["time_ns"], span).tolist())])
            if aligner.start is not None:
                return aligner.start
    raise AlignmentError(f"no alignment: {aligner.state}")


def _sound(rows: StructArray, antennas: int) -> BoolArray:
    """Return (n,) whether a row is usable: finite, with a sigma, of a known antenna."""
    needed = np.where(rows["kind"] == Kind.HEADING, 1, 3)
    component = np.arange(3) < needed[:, None]
    sound = np.isfinite(rows["value"]) & np.isfinite(rows["sigma"]) & (rows["sigma"] > 0.0)
    known = (rows["antenna"] < antennas) | ~np.isin(rows["kind"], (Kind.POSITION, Kind.VELOCITY))
    usable: BoolArray = (sound | ~component).all(axis=1) & known
    return usable | ~np.isin(rows["kind"], USED)


def _still(felt: Felt, rows: StructArray, noise: ImuNoise) -> Int64Array:
    """Return GPS times of the positions after the last movement seen by sensors or GNSS; none if too few seconds."""
    block_s = np.sqrt(np.maximum(np.diff(felt.before_s[::-1])[::-1], 1e-3))[:, None]
    rate = np.abs(felt.rate_b) > STILL_RADPS + 3.0 * noise.gyro_bias + 5.0 * noise.angle_random_walk / block_s
    usual = np.median(felt.force_b[-20:], axis=0)
    push = np.abs(felt.force_b - usual) > STILL_MPS2 + 5.0 * noise.velocity_random_walk / block_s
    moved_ns = [felt.time_ns[:-1][(rate | push).any(axis=1)]]
    speed = rows[rows["kind"] == Kind.VELOCITY]
    place = rows[rows["kind"] == Kind.POSITION]
    moved_ns.append(speed["time_ns"][(np.abs(speed["value"]) > STILL_MPS + 2.0 * speed["sigma"]).any(axis=1)])
    apart = np.linalg.norm(place["value"] - place["value"][-1], axis=1)
    moved_ns.append(place["time_ns"][apart > STILL_MPS + 4.0 * place["sigma"].max(axis=1)])
    last_ns = max((int(times[-1]) for times in moved_ns if len(times)), default=int(felt.time_ns[0]))
    times: Int64Array = place["time_ns"][place["time_ns"] > last_ns]
    return times if len(times) and int(times[-1]) - last_ns >= STILL_NS else times[:0]


def _moved(rows: StructArray) -> bool:
    """Return whether horizontal velocity changed by clearly more than GNSS's noise."""
    speed, place = (rows[rows["kind"] == kind] for kind in (Kind.VELOCITY, Kind.POSITION))
    if len(speed) >= FEWEST:
        velocity, sigma = speed["value"][:, :2], speed["sigma"][:, :2]
    else:
        step_s = np.diff(place["time_ns"])[:, None] / SECOND_NS
        velocity, sigma = np.diff(place["value"], axis=0) / step_s, np.sqrt(2.0) * place["sigma"][1:] / step_s
    change = np.linalg.norm(velocity - np.median(velocity, axis=0), axis=1)
    return bool((change > CHANGE_MPS + CHANGE_SIGMAS * sigma.max(axis=1)).any())


def _level_earth_rate(position_e: FloatArray) -> float:
    """Return the horizontal component of the earth's rate, rad/s."""
    return float(EARTH_RATE_RADPS * np.cos(geodetic_from_e(position_e)[0]))


def _degrees(angle_rad: float) -> str:
    """Format an angle in degrees with about two significant figures."""
    degrees = np.degrees(angle_rad)
    return f"{degrees:.0f}°" if degrees >= 10.0 else f"{degrees:.1f}°" if degrees >= 0.1 else f"{degrees:.2g}°"
