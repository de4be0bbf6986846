"""Prior of the trajectory's errors along the strips, with their actual correlation in time.

Errors are given at knots, a few seconds apart, and are linear between them. They are ADDED to the trajectory to make it
true: position north, east, down (m), then small turns of the body about north, east, down (rad).

Their covariance comes exactly from navigation's own run (`from_smoother`), or, if there is only a trajectory with
sigmas, from these and e-folding times (`gauss_markov`). White errors, one per return, would average out over a strip
and make the calibration's sigmas five to ten times too small.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from swath.calib.equations.inverse import inverted
from swath.calib.flight import Flight, FlightError
from swath.georef.arrays import FloatArray, Int64Array
from swath.georef.geodesy.earth import geodetic_from_e, rot_e_from_l
from swath.georef.geodesy.quaternions import product
from swath.georef.geodesy.rotations import attitude_of, rot_from_quaternion
from swath.georef.navigation.cross_covariance import ErrorChain
from swath.georef.timescales import SECOND_NS
from swath.georef.trajectory.trajectory import Trajectory, gps_text

ERRORS = 6  # per knot
MOST_KNOTS = 400  # a matrix (2400, 2400) is factorised at every linearisation
MARGIN_NS = SECOND_NS // 2  # before and after a strip: time offsets may move returns there
ROUNDING = 1e-9  # of a variance: keeps the covariance positive where neighbouring knots are almost equal
NEAR_NS = SECOND_NS  # greatest distance of a knot from a moment of a chain


@dataclass(frozen=True)
class Taus:
    """E-folding times of a trajectory's errors.

    The defaults fit a smoothed, tightly controlled INS with carrier-phase GNSS. Its remaining position errors are
    residual troposphere, ionosphere and multipath, which last about a minute. Its tilt drifts with the accelerometers'
    biases between manoeuvres, and its heading lasts longer still, because only turns make it observable.

    Attributes:
        position_s, roll_pitch_s, heading_s: e-folding times.
        lasting_tilt, lasting_heading: shares of the variances that do not fade but last for the whole flight, about the
            body's axes.
    """

    position_s: float = 60.0
    roll_pitch_s: float = 100.0
    heading_s: float = 200.0
    lasting_tilt: float = 0.0
    lasting_heading: float = 0.0

    def of_components(self) -> FloatArray:
        """Return the times (6,) of north, east, down, roll, pitch, heading."""
        return np.array([self.position_s] * 3 + [self.roll_pitch_s] * 2 + [self.heading_s])

    def lasting(self) -> FloatArray:
        """Return the lasting shares (6,) of the same components."""
        return np.array([0.0] * 3 + [self.lasting_tilt] * 2 + [self.lasting_heading])


@dataclass(frozen=True, eq=False)
class Knots:
    """The knots at which the trajectory's errors are estimated.

    Attributes:
        trajectory_index: (k,) index in `Flight.trajectories`.
        time_ns: (k,) GPS time, rising within a trajectory.
        strip: (k,) number of the strip.
        apart_s: greatest distance of neighbours in a strip.
        widened: whether that distance had to be larger than requested.
    """

    trajectory_index: Int64Array
    time_ns: Int64Array
    strip: Int64Array
    apart_s: float
    widened: bool

    def __len__(self) -> int:
        """Return the number of knots."""
        return len(self.time_ns)


@dataclass(frozen=True, eq=False)
class TrajectoryPrior:
    """The trajectory's errors before the adjustment: jointly normal, with zero mean.

    Attributes:
        trajectory_index: (k,) index in `Flight.trajectories`.
        time_ns: (k,) GPS time, rising within a trajectory.
        strip: (k,) number of the strip.
        covariance: (6k, 6k); a knot has north, east, down (m), then small turns of the body about n, e, d (rad).
        notes: for display: the source of the covariance and changes to it.
        walk_rad2: (k,) variance of the attitude's random walk from a knot to the next, about each axis; all returns of
            one moment share it. Empty: it is not known, and counts as zero.
    """

    trajectory_index: Int64Array
    time_ns: Int64Array
    strip: Int64Array
    covariance: FloatArray
    notes: tuple[str, ...] = ()
    walk_rad2: FloatArray = field(default_factory=lambda: np.zeros(0))

    def __len__(self) -> int:
        """Return the number of knots."""
        return len(self.time_ns)

    @cached_property
    def information(self) -> FloatArray:
        """Inverse (6k, 6k) of the covariance; raises LinAlgError if it has none."""
        return inverted(self.covariance)

    def between(self, trajectory_index: int, time_ns: Int64Array) -> tuple[Int64Array, Int64Array, FloatArray]:
        """Return the knots (n,) before and after moments (n,) of a trajectory, and the share (n,) of the later one.

        Outside the range of its knots only the nearest knot counts.
        """
        mine = np.flatnonzero(self.trajectory_index == trajectory_index)
        knots = self.time_ns[mine]
        after = np.clip(np.searchsorted(knots, time_ns), 1, max(len(knots) - 1, 1))
        before, after = after - 1, np.minimum(after, len(knots) - 1)
        apart = np.maximum(knots[after] - knots[before], 1)
        return mine[before], mine[after], np.clip((time_ns - knots[before]) / apart, 0.0, 1.0)

    def sigmas(self) -> FloatArray:
        """Return the sigmas (k, 6) of the errors."""
        sigmas: FloatArray = np.sqrt(np.diag(self.covariance)).reshape(-1, ERRORS)
        return sigmas


def knots_of(flight: Flight, knot_s: float, most: int = MOST_KNOTS) -> Knots:
    """Return knots over the strips only, each strip with a small margin before and after it.

    Args:
        flight: its swaths give the times of the strips.
        knot_s: wanted distance.
        most: greatest number of knots; if it would be exceeded, the distance is widened.

    Raises:
        FlightError: there are no strips, or the distance is not a positive time.
    """
    if not (np.isfinite(knot_s) and knot_s > 0.0):
        raise FlightError(f"trajectory errors: the knots are {knot_s:g} s apart; the interval must exceed 0 s")
    strips = _strips(flight)
    if not strips:
        raise FlightError("trajectory errors: the flight has no strip with returns; at least one is needed")
    return knots_within(strips, knot_s, most)


def knots_within(strips: Sequence[tuple[int, int, int, int]], knot_s: float, most: int = MOST_KNOTS) -> Knots:
    """Return knots over spans of time.

    Args:
        strips: trajectory, number, and GPS times of begin and end of each, by trajectory and time; they do not overlap.
        knot_s: wanted distance.
        most: greatest number of knots; if it would be exceeded, the distance is widened.
    """
    lengths = np.array([end - begin for _, _, begin, end in strips]) / SECOND_NS
    apart_s = knot_s
    while _counts(lengths, apart_s).sum() > most and apart_s < lengths.max():
        apart_s *= 1.05
    columns: list[tuple[int, int, int]] = []
    for (trajectory_index, strip, begin, end), count in zip(strips, _counts(lengths, apart_s).tolist(), strict=True):
        times = np.rint(np.linspace(0.0, end - begin, count)).astype(np.int64) + begin
        columns += [(trajectory_index, time, strip) for time in times.tolist()]
    flown_of, time_ns, strip_of = np.array(columns, dtype=np.int64).T
    return Knots(flown_of, time_ns, strip_of, apart_s, apart_s > knot_s)


def _counts(lengths_s: FloatArray, apart_s: float) -> Int64Array:
    return np.ceil(lengths_s / apart_s - 1e-9).astype(np.int64) + 1


def _strips(flight: Flight) -> list[tuple[int, int, int, int]]:
    """Return (trajectory, number, begin, end) of each strip, by time, over all its scanners; margins do not overlap."""
    spans: dict[tuple[int, int], tuple[int, int]] = {}
    for swath in flight.swaths:
        if len(swath):
            key = (swath.trajectory_index, swath.strip)
            first, last = spans.get(key, (2**62, -(2**62)))
            spans[key] = (min(first, int(swath.time_ns[0])), max(last, int(swath.time_ns[-1])))
    ordered = sorted((trajectory_index, *span, strip) for (trajectory_index, strip), span in spans.items())
    found = []
    for at, (trajectory_index, first, last, strip) in enumerate(ordered):
        low, high = flight.trajectories[trajectory_index].span
        before = ordered[at - 1][2] if at and ordered[at - 1][0] == trajectory_index else None
        after = ordered[at + 1][1] if at + 1 < len(ordered) and ordered[at + 1][0] == trajectory_index else None
        begin, end = max(first - MARGIN_NS, low), min(last + MARGIN_NS, high)
        if before is not None:
            begin = max(begin, (before + first) // 2 + 1)
        if after is not None:
            end = min(end, (last + after) // 2)
        found.append((trajectory_index, strip, begin, max(end, begin + 1)))
    return found


def gauss_markov(flight: Flight, taus: Taus = Taus(), knot_s: float = 5.0) -> TrajectoryPrior:
    """Return the prior from the trajectories' sigmas, with each component as a separate Gauss–Markov process.

    cov(a, b) = σ_a σ_b exp(−|t_a − t_b| / τ) for north, east, down and for roll, pitch, heading, these then turned to
    north, east, down; strips of one trajectory stay correlated, trajectories are independent (Gelb 1974, 2.2-12).

    Args:
        flight: with trajectories that have sigmas.
        taus: e-folding times.
        knot_s: distance of knots; widened where there would be more than `MOST_KNOTS`.

    Raises:
        FlightError: a trajectory has no sigmas where they are needed.
    """
    return gauss_markov_at(knots_of(flight, knot_s), flight.trajectories, taus)


def gauss_markov_at(knots: Knots, trajectories: Sequence[Trajectory], taus: Taus) -> TrajectoryPrior:
    """Return the prior of `gauss_markov` at given knots.

    Raises:
        FlightError: a trajectory has no sigmas where they are needed.
    """
    covariance = np.zeros((len(knots), ERRORS, len(knots), ERRORS))
    for number, trajectory in enumerate(trajectories):
        at = np.flatnonzero(knots.trajectory_index == number)
        if not len(at):
            continue
        sigmas, turns = _told(trajectory, knots.time_ns[at])
        since_s = (knots.time_ns[at] - knots.time_ns[at[0]]) / SECOND_NS
        apart_s = np.abs(since_s[:, np.newaxis] - since_s)
        lasting = taus.lasting()
        fading = lasting + (1.0 - lasting) * np.exp(-apart_s[..., np.newaxis] / taus.of_components())
        own = fading * sigmas[:, np.newaxis] * sigmas[np.newaxis]
        block = np.zeros((len(at), ERRORS, len(at), ERRORS))
        for axis in range(3):
            block[:, axis, :, axis] = own[..., axis]
        block[:, 3:, :, 3:] = np.einsum("iam,ijm,jbm->iajb", turns, own[..., 3:], turns, optimize=True)
        covariance[at[0] : at[-1] + 1, :, at[0] : at[-1] + 1] = block
    times = f"{taus.position_s:g} s, roll and pitch {taus.roll_pitch_s:g} s, heading {taus.heading_s:g} s"
    source = f"sigmas of the trajectory, correlated in time: position {times}"
    return _prior(knots, covariance, source)


def _told(trajectory: Trajectory, time_ns: Int64Array) -> tuple[FloatArray, FloatArray]:
    """Return a trajectory's sigmas (k, 6) of north, east, down, roll, pitch, heading, and turns (k, 3, 3).

    The turns are about n, e, d, per unit of roll, pitch and heading.
    """
    at = np.clip(np.searchsorted(trajectory.time_ns, time_ns), 0, len(trajectory) - 1)
    since, epochs = (times - trajectory.time_ns[0] for times in (time_ns, trajectory.time_ns))
    told = np.concatenate([trajectory.position_sigma_l, trajectory.attitude_sigma_rad], axis=1)
    sigmas = np.stack([np.interp(since, epochs, column) for column in told.T], axis=1)
    known = np.isfinite(sigmas) & (sigmas >= 0.0)
    if not known.all():
        first = int(np.argmax(~known.all(axis=1)))
        what = "position" if not known[first, :3].all() else "attitude"
        where = f"trajectory {trajectory.name} has no {what} sigma at {gps_text(int(time_ns[first]))}"
        want = "put an smrmsg beside the SBET, add sigma_… columns to the CSV, or let swath navigate"
        raise FlightError(f"{where}; a calibration needs sigmas: {want}")
    lat, lon, _ = geodetic_from_e(trajectory.position_e[at])
    rot_l_from_b = np.swapaxes(rot_e_from_l(lat, lon), 1, 2) @ rot_from_quaternion(trajectory.q_e_from_b[at])
    _, pitch, heading = attitude_of(rot_l_from_b)
    none = np.zeros_like(pitch)
    nose = [np.cos(pitch) * np.cos(heading), np.cos(pitch) * np.sin(heading), -np.sin(pitch)]
    right, down = [-np.sin(heading), np.cos(heading), none], [none, none, none + 1.0]
    return sigmas, np.moveaxis(np.array([nose, right, down]), 2, 0).swapaxes(1, 2)


def from_smoother(flight: Flight, chains: Sequence[ErrorChain], knot_s: float = 1.0) -> TrajectoryPrior:
    """Return the prior from navigation's smoothed runs: the smoother's joint covariance of their errors.

    Args:
        flight: on the smoothed trajectories.
        chains: `swath.georef.navigation.cross_covariance.error_chain` of each trajectory's run; the finer they are, the
            nearer the knots are to the requested times.
        knot_s: distance of knots; widened where there would be more than `MOST_KNOTS`. The gyroscopes' random walk
            between two knots is not among the unknowns, so the distance should be small: with a tactical unit (0.1°/√h)
            that error is half of 0.1° √(1 s / 1 h).

    Raises:
        FlightError: the number of chains differs from that of trajectories, or a chain does not cover the strips.
    """
    if len(chains) != len(flight.trajectories):
        raise FlightError(
            f"trajectory errors: {len(chains)} runs for {len(flight.trajectories)} trajectories; every trajectory "
            "needs its run"
        )
    knots = knots_of(flight, knot_s)
    times, strips, trajectory_index, blocks = [], [], [], []
    for number, chain in enumerate(chains):
        at = np.flatnonzero(knots.trajectory_index == number)
        part = chain.at(knots.time_ns[at]) if len(at) else chain
        if not len(at):
            continue
        nearest = _strip_at(part.time_ns, knots, at, flight.trajectories[number].name)
        times.append(part.time_ns)
        strips.append(nearest)
        trajectory_index.append(np.full(len(part), number))
        blocks.append(part.covariance())
    joined = replace(
        knots,
        trajectory_index=np.concatenate(trajectory_index),
        time_ns=np.concatenate(times),
        strip=np.concatenate(strips),
    )
    covariance, begin = np.zeros((ERRORS * len(joined), ERRORS * len(joined))), 0
    for block in blocks:
        part_of = slice(begin, begin + len(block))
        covariance[part_of, part_of] = block
        begin = part_of.stop
    prior = _prior(joined, covariance, "the smoother's own joint covariance")
    return replace(prior, walk_rad2=_walked(prior))


def _walked(prior: TrajectoryPrior) -> FloatArray:
    """Return `TrajectoryPrior.walk_rad2` (k,), at the rate of the median interval; 0 for a strip's last knot.

    In a turn, scale errors change the attitude error by far more, but steadily: knots follow that change, it is no
    random walk.
    """
    count = len(prior)
    joint, at = prior.covariance.reshape(count, ERRORS, count, ERRORS), np.arange(count - 1)
    apart_s = np.where(np.diff(prior.strip) == 0, np.diff(prior.time_ns), 0) / SECOND_NS
    differ = sum(
        joint[at, axis, at, axis] + joint[at + 1, axis, at + 1, axis] - 2.0 * joint[at, axis, at + 1, axis]
        for axis in range(3, ERRORS)
    )
    near = apart_s > 0.0
    rate = float(np.median(np.maximum(differ[near] / 3.0, 0.0) / apart_s[near])) if near.any() else 0.0
    return np.append(rate * apart_s, 0.0)


def _strip_at(time_ns: Int64Array, knots: Knots, at: Int64Array, name: str) -> Int64Array:
    """Return the strips (k,) of a chain's moments.

    Raises:
        FlightError: a requested knot has no moment near it.
    """
    wanted, strips = knots.time_ns[at], knots.strip[at]
    after = np.clip(np.searchsorted(time_ns, wanted), 1, max(len(time_ns) - 1, 1))
    near = np.minimum(
        np.abs(time_ns[after - 1] - wanted), np.abs(time_ns[np.minimum(after, len(time_ns) - 1)] - wanted)
    )
    if near.max() > max(NEAR_NS, round(knots.apart_s * SECOND_NS)):
        lost = gps_text(int(wanted[int(np.argmax(near))]))
        raise FlightError(
            f"trajectory {name}: the smoother's run does not cover {lost}; use the run that covers all strips"
        )
    back = np.clip(np.searchsorted(wanted, time_ns), 1, max(len(wanted) - 1, 1))
    second = np.minimum(back, len(wanted) - 1)
    nearer = np.abs(wanted[back - 1] - time_ns) <= np.abs(wanted[second] - time_ns)
    return np.where(nearer, strips[back - 1], strips[second])


def _prior(knots: Knots, covariance: FloatArray, source: str) -> TrajectoryPrior:
    size = ERRORS * len(knots)
    square = covariance.reshape(size, size)
    notes = [f"{source}; {len(knots)} knots, {knots.apart_s:.3g} s apart"]
    if knots.widened:
        notes.append(f"the knots are {knots.apart_s:.3g} s apart, so that there are at most {MOST_KNOTS}")
    return TrajectoryPrior(knots.trajectory_index, knots.time_ns, knots.strip, positive(square), tuple(notes))


def positive(covariance: FloatArray) -> FloatArray:
    """Return a covariance (n, n) that has an inverse; eigenvalues that rounding made negative count as zero.

    A heading that was known to degrees, and to thousandths after smoothing, has smoothed covariances that are small
    differences of large numbers. Directions in which the correlation is negative by that are raised to `ROUNDING`.
    """
    symmetric = 0.5 * (covariance + covariance.T)
    at, variances = np.diag_indices(len(symmetric)), np.diag(symmetric)
    raised = symmetric.copy()
    raised[at] = variances * (1.0 + ROUNDING)
    try:
        inverted(raised)
    except np.linalg.LinAlgError:
        if not (variances > 0.0).all():
            return raised
        scale = np.sqrt(variances)
        values, vectors = np.linalg.eigh(symmetric / np.outer(scale, scale))
        vectors *= scale[:, np.newaxis]
        raised = (vectors * np.maximum(values, ROUNDING * values[-1])) @ vectors.T
    return raised


def draw(prior: TrajectoryPrior, rng: np.random.Generator) -> FloatArray:
    """Draw random errors (k, 6) with the covariance of the prior.

    Directions in which the covariance is zero apart from rounding (eigenvalues of the correlation, some of them below
    0) get no error.
    """
    sigmas = np.sqrt(np.maximum(np.diag(prior.covariance), 0.0))
    divisor = np.where(sigmas > 0.0, sigmas, 1.0)
    values, vectors = np.linalg.eigh(prior.covariance / np.outer(divisor, divisor))
    drawn = vectors @ (np.sqrt(np.maximum(values, 0.0)) * rng.standard_normal(len(values)))
    errors: FloatArray = (sigmas * drawn).reshape(-1, ERRORS)
    return errors


def apply(trajectory: Trajectory, trajectory_index: int, prior: TrajectoryPrior, errors: FloatArray) -> Trajectory:
    """Return a trajectory with errors added.

    Between knots, also between those of two strips, the errors are linear; before the first knot and after the last one
    they are constant, so the path has no steps. Velocity and sigmas stay.

    Args:
        trajectory: index ``trajectory_index`` in the flight.
        trajectory_index: selects the trajectory's own knots of the prior.
        prior: has the knots.
        errors: (k, 6) of all knots, as `draw` returns them; with reversed signs a true trajectory becomes an erroneous
            one.
    """
    mine = prior.trajectory_index == trajectory_index
    if not mine.any():
        return trajectory
    knot_ns = prior.time_ns[mine]
    since, at = (trajectory.time_ns - knot_ns[0]).astype(np.float64), (knot_ns - knot_ns[0]).astype(np.float64)
    along = np.stack([np.interp(since, at, column) for column in errors[mine].T], axis=1)
    lat, lon, _ = trajectory.geodetic()
    rot = rot_e_from_l(lat, lon)
    shift_e, turn_e = (np.einsum("nij,nj->ni", rot, part) for part in (along[:, :3], along[:, 3:]))
    return replace(
        trajectory,
        position_e=trajectory.position_e + shift_e,
        q_e_from_b=product(_turn(turn_e), trajectory.q_e_from_b),
    )


def _turn(rotvec: FloatArray) -> FloatArray:
    """Return quaternions (n, 4) of rotation vectors (n, 3)."""
    half = 0.5 * np.linalg.norm(rotvec, axis=1, keepdims=True)
    return np.concatenate([np.cos(half), 0.5 * rotvec * np.sinc(half / np.pi)], axis=1)
