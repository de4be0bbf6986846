"""Thins a navigated flight for drawing: keeps the smallest and the largest value of each column of pixels.

Five hours at 200 Hz are 3.6 million epochs; a line drawn through every thousandth hides the spike between two of them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from swath.georef.arrays import BoolArray, FloatArray, Int64Array, StructArray
from swath.georef.geodesy.earth import geodetic_from_e, rot_e_from_l
from swath.georef.geodesy.quaternions import about, conjugate, product, rotated
from swath.georef.mapping.chart import Chart, chart_of
from swath.georef.mapping.frame import Mapping
from swath.georef.navigation.inputs import Fate, Kind, Setup, Solution
from swath.georef.strips import cut, straight_spans
from swath.georef.timescales.gps_time import SECOND_NS
from swath.georef.trajectory.trajectory import Trajectory

COLUMNS = 1000  # of pixels that a time axis spans
BLOCK = 1 << 15  # epochs converted at once
GROUP = 16  # epochs that share a vertical if they are close
MOST_COMPARED = 200_000  # epochs of the separation, which steps at updates and is smooth between them
GAP_INTERVALS = 3.0  # a line is broken after so many usual intervals without a sample
STRAIGHT_HZ = 5.0  # rate of the epochs in which straight flight is looked for
FLYING = 0.5  # of the speed that nine tenths of the epochs keep below: slower is not flown
DETERMINED = 0.7  # of the sigma before; an error whose sigma stays larger is not determined by the flight
PRIORS = {"gyro_misalignment": "misalignment", "accel_misalignment": "misalignment"}  # names in the noise's settings
OUTAGE_S = 5.0  # minimum time without a position that counts as an outage
USED = (int(Fate.TAKEN), int(Fate.INFLATED), int(Fate.REACQUIRED))
SHORT = float(np.sqrt(0.02))  # sigma of a difference relative to the filter's, below which it is meaningless


@dataclass(frozen=True, eq=False)
class Flight:
    """The data of a page.

    Attributes:
        title: name of the log that was navigated.
        forward: the filter's solution.
        smoothed: the smoother's solution; None: the flight was not smoothed.
        setup: installation and noise of the run.
        start: how the start was found, in words.
        noise_found: factors on sigmas that the innovations suggest, by kind of observation.
        notes: doubts and missing data, one line each.
        missing_s: total time of the log's samples without a trajectory.
        mapping: mapping of the flight's products, for the map; None: the map is in the UTM zone.
        facts: lines for the reader that are no doubts.
    """

    title: str
    forward: Solution
    smoothed: Solution | None
    setup: Setup
    start: str = ""
    noise_found: dict[str, float] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    missing_s: float = 0.0
    mapping: Mapping | None = None
    facts: tuple[str, ...] = ()

    @property
    def best(self) -> Solution:
        """The smoothed solution, or the filter's if there is none."""
        return self.forward if self.smoothed is None else self.smoothed

    @property
    def start_ns(self) -> int:
        """GPS time of the first epoch; zero of every time axis."""
        return int(self.best.time_ns[0])

    @property
    def duration_s(self) -> float:
        """Time from the first epoch to the last."""
        return float(self.best.time_ns[-1] - self.best.time_ns[0]) / SECOND_NS


class Pixels:
    """Samples grouped into columns of pixels by their time.

    Attributes:
        time_ns: (n,) times of the samples.
        starts: (m,) index of the first sample of each column that has samples.
        at_s: (m,) mean time of the columns' samples since the page's zero.
        broken: (m − 1,) True if there are no data between a column and the next.
    """

    def __init__(self, time_ns: Int64Array, zero_ns: int, columns: int = COLUMNS) -> None:
        self.time_ns = time_ns
        if not len(time_ns):
            self.starts, self.at_s = np.empty(0, np.int64), np.empty(0)
            self.broken = np.empty(0, bool)
            return
        span_ns = max(int(time_ns[-1] - time_ns[0]), 1)
        edges_ns = time_ns[0] + (np.arange(columns, dtype=np.float64) * (span_ns / columns)).astype(np.int64)
        self.starts = np.unique(np.searchsorted(time_ns, edges_ns))
        ends = np.append(self.starts[1:], len(self.time_ns)) - 1
        middle_ns = (time_ns[self.starts] - zero_ns) // 2 + (time_ns[ends] - zero_ns) // 2
        self.at_s = middle_ns / SECOND_NS
        usual_ns = float(np.median(np.diff(time_ns))) if len(self.time_ns) > 1 else 0.0
        before_ns = time_ns[self.starts[1:]] - time_ns[ends[:-1]]
        self.broken = before_ns > max(GAP_INTERVALS * usual_ns, 1.5 * span_ns / columns)

    def __len__(self) -> int:
        return len(self.starts)

    def blocks(self, most: int = BLOCK) -> Iterator[tuple[slice, slice]]:
        """Yield slices of columns and of their samples, about `most` samples at a time."""
        first = 0
        while first < len(self):
            last = max(int(np.searchsorted(self.starts, self.starts[first] + most, side="right")) - 1, first + 1)
            end = len(self.time_ns) if last >= len(self) else int(self.starts[last])
            yield slice(first, min(last, len(self))), slice(int(self.starts[first]), end)
            first = last

    def band(self, values: FloatArray) -> FloatArray:
        """Return the smallest and largest (2, m, …) of values (n, …) in each column; nan only if all are."""
        return np.stack([np.fmin.reduceat(values, self.starts), np.fmax.reduceat(values, self.starts)])

    def line(self, band: FloatArray, broken: BoolArray | None = None) -> tuple[FloatArray, FloatArray]:
        """Return times and values (k,) of a line through both ends of each column, broken at gaps."""
        where = np.flatnonzero(self.broken if broken is None else self.broken | broken) + 1
        at_s = np.insert(self.at_s, where, np.nan)
        return np.repeat(at_s, 2), np.insert(band, where, np.nan, axis=1).T.reshape(-1)


@dataclass(frozen=True, eq=False)
class Course:
    """The best solution, thinned.

    Attributes:
        pixels: pixels of its epochs.
        chart: coordinates of the map.
        place: (2, p) easting and northing on the map at `place_ns`.
        place_ns: (p,) GPS times.
        height_m, speed_mps, climb_mps: (2, m) bands.
        attitude_deg: (2, m, 3) of roll, pitch, heading; heading may pass 0 or 360 by what a column spans.
    """

    pixels: Pixels
    chart: Chart
    place: FloatArray
    place_ns: Int64Array
    height_m: FloatArray
    speed_mps: FloatArray
    climb_mps: FloatArray
    attitude_deg: FloatArray


def _trajectory(solution: Solution, part: slice | Int64Array) -> Trajectory:
    return Trajectory(
        solution.time_ns[part],
        solution.position_e[part],
        solution.q_e_from_b[part],
        solution.velocity_e[part],
        solution.position_sigma_l[part],
        solution.attitude_sigma_rad[part],
    )


def course_of(flight: Flight) -> Course:
    """Return place, speed and attitude of a flight; every epoch enters the bands."""
    solution = flight.best
    pixels = Pixels(solution.time_ns, flight.start_ns)
    bands = np.empty((2, len(pixels), 6))
    for columns, part in pixels.blocks():
        rows = _local_rows(solution, part)
        starts = pixels.starts[columns] - part.start
        bands[0, columns], bands[1, columns] = (at.reduceat(rows, starts, axis=1).T for at in (np.fmin, np.fmax))
    turns = np.floor(bands[..., 5].mean(axis=0) / 360.0)
    bands[..., 5] -= 360.0 * np.where(np.isfinite(turns), turns, 0.0)
    where = np.unique(np.linspace(0, len(solution) - 1, 4 * COLUMNS).astype(np.int64))
    position_e = solution.position_e[where]
    chart = chart_of(flight.mapping, position_e)
    there = np.isfinite(position_e).all(axis=1)
    place = np.full((2, len(where)), np.nan)
    place[:, there] = chart.map_from_e(position_e[there]).T
    return Course(
        pixels, chart, place, solution.time_ns[where], bands[..., 0], bands[..., 1], bands[..., 2], bands[..., 3:]
    )


def _local_rows(solution: Solution, part: slice) -> FloatArray:
    """Return (6, n) height, horizontal speed, climb, roll, pitch, heading (degrees, unwrapped) of consecutive epochs.

    Epochs close in time share the vertical of the first of them; the error is a few metres over the earth's radius.
    """
    time_ns = solution.time_ns[part]
    n = len(time_ns)
    size = GROUP if n > 1 and int(np.diff(time_ns).max()) * GROUP <= SECOND_NS else 1
    first = np.arange(0, n, size)

    def grouped(columns: FloatArray) -> FloatArray:
        padded = np.pad(columns[part], ((0, -n % size), (0, 0)), mode="edge")
        return padded.reshape(len(first), size, -1)

    position_e = grouped(solution.position_e)
    lat, lon, height_m = geodetic_from_e(position_e[:, 0])
    to_e = rot_e_from_l(lat, lon)
    moved_l = (position_e - position_e[:, :1]) @ to_e
    velocity_l = (grouped(solution.velocity_e) @ to_e).reshape(-1, 3)[:n].T
    q_l_from_e = conjugate(product(about(2, lon), about(1, -lat - np.pi / 2)))
    units = np.eye(4)
    turn = np.stack([product(q_l_from_e, units[i]) for i in range(4)], axis=1)  # rows: the image of each component
    w, x, y, z = np.ascontiguousarray((grouped(solution.q_e_from_b) @ turn).reshape(-1, 4)[:n].T)
    roll = np.arctan2(2 * (y * z + w * x), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - x * z), -1.0, 1.0))
    heading = np.arctan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z))
    height = (height_m[:, np.newaxis] - moved_l[..., 2]).reshape(-1)[:n]
    angles = np.degrees([roll, pitch, np.unwrap(heading)])
    return np.stack([height, np.hypot(velocity_l[0], velocity_l[1]), -velocity_l[2], *angles])


@dataclass(frozen=True, eq=False)
class Separation:
    """The difference filter − smoother, and its predicted sigma.

    The smoother's error is orthogonal to the difference, so its covariance is P_filter − P_smoother (Fraser and Potter
    1969).

    Attributes:
        time_ns: (k,) epochs that are compared.
        position_m, velocity_mps, attitude_rad: (k, 3) north, east, down; roll, pitch, heading.
        position_sigma_m, velocity_sigma_mps, attitude_sigma_rad: (k, 3); nan where the filter's and the smoother's
            sigmas hardly differ, so that the difference is meaningless. If a time offset was estimated, the positions'
            is too large along the track: the smoother's refers to GNSS's time.
    """

    time_ns: Int64Array
    position_m: FloatArray
    velocity_mps: FloatArray
    attitude_rad: FloatArray
    position_sigma_m: FloatArray
    velocity_sigma_mps: FloatArray
    attitude_sigma_rad: FloatArray


def separation_of(flight: Flight) -> Separation | None:
    """Return filter − smoother; None if the flight was not smoothed, or the solutions share no epoch."""
    forward, smoothed = flight.forward, flight.smoothed
    if smoothed is None:
        return None
    every = max(1, -(-len(forward) // MOST_COMPARED))
    chosen = np.arange(0, len(forward), every)
    other = np.minimum(np.searchsorted(smoothed.time_ns, forward.time_ns[chosen]), len(smoothed) - 1)
    same = smoothed.time_ns[other] == forward.time_ns[chosen]
    chosen, other = chosen[same], other[same]
    if not len(chosen):
        return None
    lat, lon, _ = _trajectory(smoothed, other).geodetic()
    to_l = conjugate(_q_e_from_l(lat, lon))
    first, second = _trajectory(forward, chosen).attitude(), _trajectory(smoothed, other).attitude()
    turned = np.column_stack([(a - b + np.pi) % (2 * np.pi) - np.pi for a, b in zip(first, second, strict=True)])
    return Separation(
        forward.time_ns[chosen],
        rotated(to_l, forward.position_e[chosen] - smoothed.position_e[other]),
        rotated(to_l, forward.velocity_e[chosen] - smoothed.velocity_e[other]),
        turned,
        _of_difference(forward.position_sigma_l[chosen], smoothed.position_sigma_l[other]),
        _of_difference(forward.velocity_sigma_l[chosen], smoothed.velocity_sigma_l[other]),
        _of_difference(forward.attitude_sigma_rad[chosen], smoothed.attitude_sigma_rad[other]),
    )


def _q_e_from_l(lat: FloatArray, lon: FloatArray) -> FloatArray:
    return product(about(2, lon), about(1, -lat - np.pi / 2))


def _of_difference(forward: FloatArray, smoothed: FloatArray) -> FloatArray:
    forward, smoothed = forward.astype(np.float64), smoothed.astype(np.float64)
    variance = forward**2 - smoothed**2
    return np.sqrt(np.where(variance > (SHORT * forward) ** 2, variance, np.nan))


def used_positions(solution: Solution) -> StructArray:
    """Return innovations (k,) of the positions that the filter used, one per time."""
    rows = solution.innovations
    rows = rows[(rows["kind"] == Kind.POSITION) & np.isin(rows["fate"], USED)]
    chosen: StructArray = rows[np.unique(rows["time_ns"], return_index=True)[1]]
    return chosen


def outages_of(flight: Flight) -> Int64Array:
    """Return GPS times (k, 2) between which no position was used; the flight's ends count as positions."""
    used_ns = used_positions(flight.forward)["time_ns"]
    usual_ns = float(np.median(np.diff(used_ns))) if len(used_ns) > 2 else 0.0
    ends_ns = flight.best.time_ns[[0, -1]]
    times_ns = np.concatenate([ends_ns[:1], used_ns[(used_ns > ends_ns[0]) & (used_ns < ends_ns[1])], ends_ns[1:]])
    long = np.diff(times_ns) > max(OUTAGE_S * SECOND_NS, GAP_INTERVALS * usual_ns)
    return np.stack([times_ns[:-1][long], times_ns[1:][long]], axis=1)


def fix_types_at(flight: Flight, time_ns: Int64Array) -> NDArray[np.int16]:
    """Return the fix type (n,) of the position before each time; −1 in outages. Earlier times have the first
    position's.
    """
    used = used_positions(flight.forward)
    last = np.searchsorted(used["time_ns"], time_ns, side="right") - 1
    types = np.full(len(time_ns), -1, np.int16)
    if len(used):
        types = used["fix_type"][np.maximum(last, 0)].astype(np.int16)
    for begin_ns, end_ns in outages_of(flight):
        types[(time_ns > begin_ns) & (time_ns < end_ns)] = -1
    return types


def bridged_spans(solution: Solution) -> Int64Array:
    """Return GPS times (k, 2) of runs of bridged inertial samples, from the epoch before a run to its last."""
    if not solution.bridged.any():
        return np.empty((0, 2), np.int64)
    change = np.diff(np.concatenate([[0], solution.bridged.astype(np.int8), [0]]))
    begin, end = np.flatnonzero(change == 1), np.flatnonzero(change == -1)
    return np.stack([solution.time_ns[np.maximum(begin - 1, 0)], solution.time_ns[end - 1]], axis=1)


def straight_flight(flight: Flight) -> Int64Array:
    """Return GPS times (k, 2) of straight flight, by the rules that cut strips; when the laser was on is not known."""
    solution = flight.best
    usual_s = float(np.median(np.diff(solution.time_ns[:10_000]))) / SECOND_NS if len(solution) > 1 else 1.0
    thinned = _trajectory(solution, slice(None, None, max(1, round(1.0 / (STRAIGHT_HZ * usual_s)))))
    if len(thinned) < 2:
        return np.empty((0, 2), np.int64)
    roll, _, heading = thinned.attitude()
    straight = straight_spans(thinned.time_ns, np.nan_to_num(heading), np.nan_to_num(roll))
    speed_mps = np.nan_to_num(np.linalg.norm(thinned.velocity_e, axis=1))
    change = np.diff(np.concatenate([[0], (speed_mps > FLYING * np.percentile(speed_mps, 90.0)).astype(np.int8), [0]]))
    begin, end = np.flatnonzero(change == 1), np.flatnonzero(change == -1) - 1
    flying = list(zip(thinned.time_ns[begin].tolist(), (thinned.time_ns[end] + 1).tolist(), strict=True))
    return np.array(cut(straight, flying), np.int64).reshape(-1, 2)


def determined_axes(flight: Flight, name: str) -> list[int]:
    """Return the axes on which the flight determines an error of the sensors: its sigma falls clearly below the first.

    Args:
        flight: with the solution's nodes.
        name: field of `Solution`, such as ``gyro_scale``.
    """
    sigmas = getattr(flight.best, f"{name}_sigma")
    prior = getattr(flight.setup.noise, PRIORS.get(name, name))
    if not len(sigmas) or prior <= 0.0:
        return []
    return [axis for axis in range(sigmas.shape[1]) if float(np.nanmin(sigmas[:, axis])) < DETERMINED * prior]
