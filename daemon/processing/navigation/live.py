"""Navigates an aircraft while its log grows: takes a stream's samples and fixes at its ticks and gives poses.

All decisions depend on the log's content and its ticks, so a log followed while it grows and the same log read
afterwards give the same poses.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from swath.daemon.errors import UserError
from swath.daemon.processing.navigation.observations import (
    fix_observations,
    gps_times,
    heading_observations,
    heading_times,
)
from swath.daemon.processing.navigation.sources import NavigationSources
from swath.daemon.processing.navigation.times import GrowingCounter
from swath.georef.arrays import BoolArray, Int64Array, StructArray
from swath.georef.geodesy.earth import geodetic_from_e, rot_e_from_l
from swath.georef.geodesy.rotations import attitude_of, rot_from_quaternion
from swath.georef.navigation.alignment.align import Aligner
from swath.georef.navigation.filter.filter import NavigationFilter
from swath.georef.navigation.inputs import OBSERVATION_DTYPE, Inertial, NavigationError, sort_observations
from swath.georef.navigation.samples import Sampler
from swath.georef.records import IMU_DTYPE, INS_DTYPE, GnssFix, GnssHeading, ImuSamples, Record
from swath.georef.timescales import SECOND_NS, WEEK_NS

if TYPE_CHECKING:
    from swath.daemon.config.config import Config
    from swath.georef.navigation.filter.types import Path
    from swath.georef.stream.clocks import StreamClocks

HOLD_S = 0.3  # maximum delay of fixes after the samples of their time
TIME_WAIT_NS = 5 * SECOND_NS  # longest wait for a clock that is not known yet
MAX_TIME_SIGMA_NS = 1e7  # of a sample: a worse time is not used
REALIGN_NS = 30 * SECOND_NS  # of missing samples: after them the attitude is aligned anew
KEPT_NS = 10 * SECOND_NS  # of samples before the start that was found
EPOCH_LASTS_NS = 2 * SECOND_NS  # all messages of one epoch come within it
NEVER_NS = 1 << 62
GOOD_STATUS = 3  # status of a good solution, as a device's INS would send it


class Navigator:
    """Finds the start of navigation and runs the filter.

    Args:
        sources: the IMU and the receiver to use.
        clocks: clocks of the stream; their plan has the IMU among its devices.

    Attributes:
        counts: number of records by fate.
        parsers: of the IMU and of all receivers, by source; the caller feeds them and passes their records to `take`.
    """

    def __init__(self, sources: NavigationSources, clocks: StreamClocks) -> None:
        self.counts: Counter[str] = Counter()
        self.parsers = sources.parsers()
        self._sources, self._clocks = sources, clocks
        self._setup = sources.setup()
        table = sources.imu
        self._sampler = Sampler(table.rate_hz, table.sample, table.stamp, sources.rot_b_from_imu)
        self._aligner = Aligner(self._setup)
        self._filter: NavigationFilter | None = None
        self._imu: list[StructArray] = []
        self._fixes: list[GnssFix] = []
        self._headings: list[GnssHeading] = []
        self._said: set[str] = set()  # names of messages received
        self._handed: set[tuple[int, int, int]] = set()  # time, kind, antenna of observations of the last seconds
        self._latest_heading_ns = -(1 << 62)
        self._kept: list[Inertial] = []
        self._kept_rows: list[StructArray] = []
        self._counter = GrowingCounter(table.rate_hz)

    @property
    def state(self) -> str:
        """Progress in words: what the navigator waits for, or how it found the start."""
        return self._aligner.state

    def take(self, source: str, record: Record) -> None:
        """Take a record of the stream; records of other sources and kinds are ignored."""
        if isinstance(record, ImuSamples) and source == self._sources.imu_source:
            self._imu.append(self._counter.told(record.rows, self._clocks, source))
        elif isinstance(record, GnssFix) and source == self._sources.gnss_source:
            self._fixes.append(record)
            self._said.add(record.message)
        elif isinstance(record, GnssHeading) and source == self._sources.gnss_source:
            self._headings.append(record)

    def advance(self, tick_ns: int) -> StructArray:
        """Return poses that have become known at a tick of the log: `INS_DTYPE`, attitude of b."""
        self._clocks.update()
        observations, gaps = self._observations(tick_ns), len(self._sampler.gaps)
        inertial = self._inertial(tick_ns)
        if any(end - begin > REALIGN_NS for begin, end in self._sampler.gaps[gaps:]):
            self._begin_anew()
        if self._filter is None:
            self._align(inertial, observations)
        else:
            self._filter.observe(observations)
            self._filter.feed(inertial)
        return np.empty(0, INS_DTYPE) if self._filter is None else poses(self._filter.new_path())

    def close(self) -> StructArray:
        """Return the last poses at the end of the log."""
        rows = self.advance(NEVER_NS)
        if self._filter is None:
            return rows
        self._filter.flush()
        return np.concatenate([rows, poses(self._filter.new_path())])

    def _begin_anew(self) -> None:
        self.counts["aligned anew"] += 1
        self._aligner, self._filter = Aligner(self._setup), None
        self._kept, self._kept_rows = [], []

    def _align(self, inertial: Inertial, observations: StructArray) -> None:
        self._kept.append(inertial)
        self._kept_rows.append(observations)
        self._aligner.feed(inertial)
        self._aligner.observe(observations)
        newest_ns = max((int(piece.time_ns[-1]) for piece in self._kept if len(piece)), default=0)
        self._kept = [piece for piece in self._kept if len(piece) and piece.time_ns[-1] > newest_ns - KEPT_NS]
        self._kept_rows = [rows[rows["time_ns"] > newest_ns - KEPT_NS] for rows in self._kept_rows if len(rows)]
        if self._aligner.start is None:
            return
        self._filter = NavigationFilter(self._setup, self._aligner.start, hold_s=HOLD_S, smoothed=False)
        for rows in self._kept_rows:
            self._filter.observe(rows[rows["time_ns"] > self._aligner.start.time_ns])
        for piece in self._kept:
            self._filter.feed(piece)
        self._kept, self._kept_rows = [], []

    # ------------------------------------------------------------------ times

    def _inertial(self, tick_ns: int) -> Inertial:
        """Return samples whose times are known by now."""
        rows = np.concatenate([np.empty(0, IMU_DTYPE), *self._imu])
        time_ns, known = self._times(rows)
        if not known.all():  # samples behind a waiting one wait too and stay in order
            first = int(np.argmin(known))
            late = ~known & (tick_ns - rows["host_time_ns"] > TIME_WAIT_NS)
            self.counts["samples without time"] += int(late.sum())
            waits = np.zeros(len(rows), np.bool_)
            waits[first:] = True
            waits &= tick_ns - rows["host_time_ns"] <= TIME_WAIT_NS
            self._imu = [rows[waits]]
            rows, time_ns = rows[known & ~waits], time_ns[known & ~waits]
        else:
            self._imu = []
        return self._sampler.feed(rows, time_ns)

    def _times(self, rows: StructArray) -> tuple[Int64Array, BoolArray]:
        """Return GPS ns (n,) of samples, and flags (n,) of those that are known."""
        source = self._sources.imu_source
        own = rows["gps_week"] >= 0
        if own.any():
            return rows["gps_week"].astype(np.int64) * WEEK_NS + rows["device_time_ns"], own
        if self._sources.clock is None or not len(rows):
            return np.zeros(len(rows), np.int64), np.zeros(len(rows), np.bool_)
        gps_ns, sigma_ns = self._clocks.gps_from_device(source, rows["device_time_ns"], rows["host_time_ns"])
        return gps_ns, sigma_ns <= MAX_TIME_SIGMA_NS

    def _observations(self, tick_ns: int) -> StructArray:
        """Return observations of fixes and headings before the tick; those without a known time wait."""
        host, source = self._clocks.host, self._sources.gnss_source
        fixes, headings = self._fixes, self._headings
        fix_ns = gps_times(host, source, [fix.host_time_ns for fix in fixes], [fix.time for fix in fixes])
        told_ns = gps_times(host, source, [one.host_time_ns for one in headings], [one.time for one in headings])
        heading_ns = heading_times(headings, told_ns, fixes, fix_ns)
        self._fixes = [
            fix
            for fix, at in zip(fixes, fix_ns, strict=True)
            if at is None and tick_ns - fix.host_time_ns <= TIME_WAIT_NS
        ]
        self._headings = []
        waiting = set(map(id, self._fixes))
        taken = [(fix, at) for fix, at in zip(fixes, fix_ns, strict=True) if id(fix) not in waiting]
        found = fix_observations(
            [fix for fix, _ in taken], [at for _, at in taken], len(self._setup.lever_arms_b), self._said
        )
        self.counts.update({f"fix {why.replace('_', ' ')}": count for why, count in found.refused.items()})
        return sort_observations(np.concatenate([self._fresh(found.rows), self._directions(headings, heading_ns)]))

    def _fresh(self, rows: StructArray) -> StructArray:
        """Return the rows without those that an earlier tick had for the same epoch, as receivers split and repeat
        epochs.
        """
        keys = list(zip(rows["time_ns"].tolist(), rows["kind"].tolist(), rows["antenna"].tolist(), strict=True))
        fresh = np.array([key not in self._handed for key in keys], dtype=np.bool_)
        self.counts["fix repeated in epoch"] += int((~fresh).sum())
        newest_ns = max((at_ns for at_ns, _, _ in keys), default=-NEVER_NS)
        self._handed = {key for key in self._handed if key[0] > newest_ns - EPOCH_LASTS_NS} | set(keys)
        return rows[fresh]

    def _directions(self, headings: list[GnssHeading], time_ns: list[int | None]) -> StructArray:
        """Return headings of the baseline that are later than those returned before."""
        if self._setup.baseline_b is None:
            return np.empty(0, OBSERVATION_DTYPE)
        found = heading_observations(headings, time_ns, float(np.linalg.norm(self._setup.baseline_b))).rows
        rows = found[found["time_ns"] > self._latest_heading_ns]
        if len(rows):
            self._latest_heading_ns = int(rows["time_ns"][-1])
        return rows


def navigator_of(config: Config, attachments: Mapping[str, bytes], clocks: StreamClocks) -> Navigator | None:
    """Return a navigator for a configuration; None if it lacks an IMU or a receiver to navigate with."""
    if not config.imu or not config.gnss:
        return None
    try:
        return Navigator(NavigationSources(config, attachments), clocks)
    except (UserError, NavigationError):
        return None


def poses(path: Path) -> StructArray:
    """Return states of a filter (n, …) as `INS_DTYPE` rows."""
    rows = np.zeros(len(path.time_ns), INS_DTYPE)
    lat, lon, height = geodetic_from_e(path.states[:, :3])
    rot_l_from_e = rot_e_from_l(lat, lon).swapaxes(-1, -2)
    attitude = attitude_of(rot_l_from_e @ rot_from_quaternion(path.states[:, 6:10]))
    rows["host_time_ns"], rows["gps_ns"], rows["status"] = -1, path.time_ns, GOOD_STATUS
    rows["lat_rad"], rows["lon_rad"], rows["height_m"] = lat, lon, height
    rows["velocity_l"] = np.einsum("nij,nj->ni", rot_l_from_e, path.states[:, 3:6])
    rows["roll_rad"], rows["pitch_rad"], rows["heading_rad"] = attitude
    rows["position_sigma_l"], rows["velocity_sigma_l"] = path.sigma[:, :3], path.sigma[:, 3:6]
    rows["attitude_sigma_rad"] = path.sigma[:, 6:9]
    return rows
