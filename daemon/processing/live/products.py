"""Writes what the operator sees during the flight: thinned points, the aircraft's position, and the coverage.

Counts and grids use every point; only live.mcap is thinned. Nothing here affects the points themselves.
"""

from __future__ import annotations

import json
import math
import os
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from swath.daemon.config.tables import LiveConfig
from swath.daemon.errors import one_line
from swath.daemon.processing.live.coverage import write_coverage
from swath.daemon.processing.live.frame import LocalFrame, Maps
from swath.daemon.processing.live.look import PROFILE, LastLook
from swath.daemon.processing.live.mcap import (
    NAME,
    LiveMcap,
    LivePose,
    cloud_message,
    grid_message,
    log_message,
    pose_messages,
)
from swath.daemon.processing.live.painting import COVERAGE, LiveMap
from swath.daemon.processing.live.serve import LiveServer
from swath.daemon.processing.live.unanswered import UnansweredPulses
from swath.georef.arrays import Int64Array
from swath.georef.compiled import jit_cached
from swath.georef.geodesy.earth import geodetic_from_e
from swath.georef.points import Points
from swath.georef.timescales.gps_time import SECOND_NS, unix_from_gps
from swath.georef.trajectory.trajectory import Trajectory

POSE_NS = 100_000_000  # between two poses
ROOM_AGAIN = 1.05  # free space, relative to where writing stopped, at which it begins again
TILES_SHARE = 0.5  # of the quota: at most this much is for the map's tiles, the rest for live.mcap
GRID_NS, GRID_CELLS = 10 * SECOND_NS, 256  # between two pictures of the coverage, and cells along a side of one
FIRST_STRIDE = 16  # of the thinning, until the points of one second have been counted


class Thinning:
    """Selects points for display: at most so many per second of GPS time, spread over it.

    The stride follows from the number of points in the second before; it depends on points and their order, not on
    blocks.
    """

    def __init__(self, points_per_s: int) -> None:
        self._limit = points_per_s
        self._state = np.array([np.iinfo(np.int64).min, 0, 0, FIRST_STRIDE, 0], dtype=np.int64)

    def keep(self, time_ns: Int64Array) -> Int64Array:
        """Return the indexes (k,) of the points to keep; points come in the order of their arrival."""
        kept_ones = np.empty(len(time_ns), dtype=np.int64)
        return kept_ones[: _thin(time_ns, self._limit, self._state, kept_ones)]


@jit_cached
def _thin(time_ns: Any, limit: int, state: Any, keep: Any) -> int:
    """Fill ``keep`` with the indexes of points to keep and return their number.

    state: first nanosecond after the second, points in it, those of them kept, stride, points until the next is kept.
    """
    count = 0
    end, points, shown, stride, until = state[0], state[1], state[2], state[3], state[4]
    for i in range(len(time_ns)):
        if time_ns[i] >= end:
            if points > 0:
                stride = max(1, -(-points // limit))
            end, points, shown, until = (time_ns[i] // SECOND_NS + 1) * SECOND_NS, 0, 0, 0
        if until == 0:
            until = stride
            if shown < limit:
                keep[count] = i
                count += 1
                shown += 1
        until -= 1
        points += 1
    state[0], state[1], state[2], state[3], state[4] = end, points, shown, stride, until
    return count


@dataclass(slots=True)
class Room:
    """Checks free space on the disk: writing stops below twice the recorder's reserve, and begins again above it."""

    folder: Path
    least_bytes: int
    free_bytes: int = 0
    is_enough: bool = True

    def look(self) -> bool:
        """Measure the free space and return True if it suffices."""
        disk = os.statvfs(self.folder)
        self.free_bytes = disk.f_bavail * disk.f_frsize
        wanted = self.least_bytes * (1.0 if self.is_enough else ROOM_AGAIN)
        self.is_enough = self.free_bytes > wanted
        return self.is_enough


class LiveProducts:
    """Takes points as they come, and writes the operator's files.

    Attributes:
        points: number of points by scanner; ``shown``: written to live.mcap; ``unwritten``: thinned but not written.
        map: the map of cells, with its tiles.
        look: the last moments.
        unanswered: by scanner, its pulses without a return, where its parser tells them.
        trouble: why no files are written, for people; empty: they are.
    """

    def __init__(
        self,
        folder: Path,
        live: LiveConfig,
        mapping: Maps | None,
        reserve_bytes: int,
        about: str,
        gps_from_host: Callable[[int], int | None] = lambda host_ns: None,
        server: LiveServer | None = None,
    ) -> None:
        """Prepare the folder.

        Args:
            folder: where files go.
            live: settings.
            mapping: the mapping frame of the points; None: e.
            reserve_bytes: the recorder's reserve of free space.
            about: describes the mapping frame for people.
            gps_from_host: gives GPS time of a host time; None: not known.
            server: serves what live.mcap gets; None: nobody.

        Raises:
            OSError: the folder cannot be written to.
        """
        folder.mkdir(parents=True, exist_ok=True)
        self.points: Counter[str] = Counter()
        self.shown = self.unwritten = 0
        self.trouble = ""
        self.room = Room(folder, 2 * reserve_bytes)
        self.frame: LocalFrame | None = None
        self.map = LiveMap(folder, live.cell_m, int(TILES_SHARE * live.live_quota_mb * 1e6), gps_from_host)
        self.look = LastLook()
        self.server = server
        self.unanswered: dict[str, UnansweredPulses] = {}
        self._trajectory: Trajectory | None = None
        self._placement: dict[str, Any] | None = None
        self._folder, self._live, self._mapping, self._about = folder, live, mapping, about
        self._thinning = Thinning(live.points_per_s)
        self._mcap: LiveMcap | None = None
        self._pose_ns = self._gridded_ns = 0

    def begin(self, trajectory: Trajectory | None) -> None:
        """Lay the local frame at the first known position; later calls change nothing.

        The trajectory sets it, not the points: these must not wait for PROJ, which is slow at its first use.
        """
        if self.frame is None and trajectory is not None and len(trajectory):
            self.frame = LocalFrame(trajectory.position_e[-1], self._mapping)

    def take(self, name: str, points: Points, trajectory: Trajectory | None, log_time_ns: int) -> None:
        """Take points of a scanner, in order, with the trajectory known by then."""
        self.points[name] += len(points)
        self.begin(trajectory)
        if self.frame is None:
            return
        if trajectory is not None:
            self.map.update(trajectory, log_time_ns)
        self.map.take(points, self.frame)
        if name in self.unanswered:
            self.map.grid.add_no_return(self.unanswered[name].places(points, self.frame))
        keep = self._thinning.keep(points.time_ns)
        count = len(keep)
        if count:
            cloud = self.frame.cloud_of(points, keep)
            self.look.take(name, points, keep, cloud)
            time_ns = unix_from_gps(int(points.time_ns[keep[0]]))
            written = self._publish({f"/points/{name}": cloud_message(cloud, time_ns)}, log_time_ns)
            self.shown += count * written
            self.unwritten += count * (not written)

    def take_pose(self, trajectory: Trajectory | None, log_time_ns: int) -> None:
        """Write the newest pose, at most ten times a second of log time; the first one lays the frame."""
        if trajectory is None or log_time_ns < self._pose_ns + POSE_NS:
            return
        self.map.update(trajectory, log_time_ns)
        self.begin(trajectory)
        if self.frame is None:
            return
        self._pose_ns = log_time_ns
        position_e = trajectory.position_e[-1]
        position, q_local_from_b = self.frame.pose_of(position_e, trajectory.q_e_from_b[-1])
        lat, lon, height = geodetic_from_e(position_e)
        self._trajectory = trajectory
        self.look.take_pose(int(trajectory.time_ns[-1]), position)
        for pulses in self.unanswered.values():
            self.map.grid.add_no_return(pulses.overdue(int(trajectory.time_ns[-1]), self.frame))
        pose = LivePose(
            unix_from_gps(int(trajectory.time_ns[-1])),
            math.degrees(lat),
            math.degrees(lon),
            float(height),
            position,
            q_local_from_b,
            trajectory.position_sigma_l[-1],
        )
        self._publish(pose_messages(pose), log_time_ns)
        if log_time_ns >= self._gridded_ns + GRID_NS and self.map.grid.points:
            self._gridded_ns = log_time_ns
            self._publish_grid(log_time_ns)

    def save_map(self, latest: dict[str, Any], log_time_ns: int, *, last: bool = False) -> None:
        """Write the map's changed tiles, at most once a second of log time unless they are the ``last``."""
        due = self.map.grid.has_changed if last else self.map.is_due(log_time_ns)
        if not due or not self._has_space:
            return
        self.map.save(log_time_ns, self.origin() | self.placement() | latest)
        if self._mcap is not None:
            self._mcap.beside_bytes = self.map.file_bytes
        try:
            self.look.save(self._folder, self.map.cutter.edges(), self.map.comparison.heights, last=last)
        except OSError as error:
            self.map.trouble = f"{PROFILE}: {error.strerror or error}: the last moments are not written"

    def placement(self) -> dict[str, Any]:
        """Return the entry ``placement`` of the map's index; nothing before there is a frame."""
        if self._placement is None and self.frame is not None:
            self._placement = {"placement": self.frame.placement()}
        return self._placement or {}

    def pose(self) -> dict[str, Any] | None:
        """Return the newest pose for people; None: there is none.

        ``lat_deg``, ``lon_deg`` and ``height_m`` are ellipsoidal; ``east_m``, ``north_m`` and ``up_m`` in the frame
        ``local``; ``heading_deg`` and ``track_deg`` from true north, ``map_heading_deg`` from that of the map;
        ``sigma_m`` is that of north, east, down, None: not known.
        """
        if self._trajectory is None or self.frame is None:
            return None
        last = self._trajectory.between(int(self._trajectory.time_ns[-1]), int(self._trajectory.time_ns[-1]))
        lat, lon, height = (float(values[-1]) for values in last.geodetic())
        roll, pitch, heading = (round(math.degrees(float(angle[-1])), 3) for angle in last.attitude())
        north, east, _ = last.velocity_l()[-1].tolist()
        position, q = self.frame.pose_of(last.position_e[-1], last.q_e_from_b[-1])
        nose_east, nose_north = 1.0 - 2.0 * (q[2] ** 2 + q[3] ** 2), 2.0 * (q[1] * q[2] + q[0] * q[3])
        sigma_m = last.position_sigma_l[-1]
        return {
            "gps_ns": int(last.time_ns[-1]),
            "lat_deg": round(math.degrees(lat), 9),
            "lon_deg": round(math.degrees(lon), 9),
            "height_m": round(height, 3),
            **dict(zip(("east_m", "north_m", "up_m"), np.round(position, 3).tolist(), strict=True)),
            "roll_deg": roll,
            "pitch_deg": pitch,
            "heading_deg": heading,
            "map_heading_deg": round(math.degrees(math.atan2(nose_east, nose_north)) % 360.0, 3),
            "track_deg": _known(math.degrees(math.atan2(east, north)) % 360.0),
            "speed_mps": _known(math.hypot(east, north)),
            "sigma_m": np.round(sigma_m, 4).tolist() if np.isfinite(sigma_m).all() else None,
        }

    @property
    def _has_space(self) -> bool:
        return not self.trouble.startswith("free space")

    def look_for_room(self) -> None:
        """Check for free space and stop or resume writing; call once a second."""
        try:
            is_enough = self.room.look()
        except OSError as error:
            self.trouble = f"{self._folder}: {error.strerror or error}: nothing is written any more"
            return
        if is_enough:
            if self.trouble.startswith("free space"):
                self.trouble = ""
            return
        least_mb = self.room.least_bytes / 1e6
        self.trouble = f"free space is down to {least_mb:.0f} MB, twice the recorder's reserve; writing is suspended"

    def publish_status(self, text: str, *, well: bool, log_time_ns: int) -> None:
        """Give a sentence for the operator, once there is a pose."""
        if self._trajectory is not None:
            time_ns = unix_from_gps(int(self._trajectory.time_ns[-1]))
            self._publish({"/status": log_message(text, well=well, time_ns=time_ns)}, log_time_ns)

    def _publish_grid(self, log_time_ns: int) -> None:
        counts, west_m, north_m, cell_m = self.map.grid.image(GRID_CELLS)
        assert self._trajectory is not None
        time_ns = unix_from_gps(int(self._trajectory.time_ns[-1]))
        density = (counts[::-1] / cell_m**2).astype(np.float32)
        grid = grid_message(density, west_m, north_m - len(counts) * cell_m, cell_m, time_ns)
        self._publish({"/coverage": grid}, log_time_ns)

    def _publish(self, messages: dict[str, Any], log_time_ns: int) -> bool:
        """Serve messages by topic, and write them to live.mcap if there is room; return True if all are written."""
        written = self.frame is not None
        for topic, message in messages.items():
            schema, data = message.get_schema(), message.encode()
            if self.server is not None:
                self.server.send(topic, schema, data, log_time_ns)
            written &= self._write(topic, schema, data, log_time_ns)
        return written

    def _write(self, topic: str, schema: Any, data: bytes, log_time_ns: int) -> bool:
        """Write to live.mcap, if there is a frame and room for it; return True if written."""
        if self.trouble or self.frame is None:
            return False
        try:
            if self._mcap is None:
                quota_bytes = int(self._live.live_quota_mb * 1e6)
                metadata = {key: json.dumps(value) for key, value in self.origin().items()}
                self._mcap = LiveMcap(self._folder, quota_bytes, metadata)
            written = self._mcap.add(topic, schema, data, log_time_ns)
        except OSError as error:
            self.trouble = f"{NAME}: {error.strerror or error}: nothing is written any more"
            return False
        if self._mcap.is_full:
            self.trouble = (
                f"{NAME} has reached live_quota_mb = {self._live.live_quota_mb:g}; no more data is added to it"
            )
        return written

    def origin(self) -> dict[str, Any]:
        """Return what the coordinates of the products refer to."""
        entry: dict[str, Any] = {"crs": self._about, "axes": "east, north, up, metres"}
        if self.frame is not None:
            entry["origin"] = [round(value, 4) for value in self.frame.origin.tolist()]
            entry["origin_unit_m"] = self.frame.unit_m.tolist()
        return entry

    def save_coverage(self, latest: dict[str, Any]) -> None:
        """Replace the coverage's numbers and picture, each at once; do nothing if there is no room."""
        if not self._has_space or not self.map.grid.points:
            return
        try:
            self.map.save_coverage(self.origin() | latest)
        except OSError as error:
            self.trouble = f"{COVERAGE}: {error.strerror or error}: nothing is written any more"

    def export_coverage(self) -> list[str]:
        """Write the map as GeoTIFF and KMZ; return why one is missing, if one is."""
        if not self._has_space:
            return [self.trouble]
        try:
            return write_coverage(self._folder)
        except (OSError, ValueError) as error:
            return [f"the coverage is not written: {one_line(str(error))}"]

    def close(self) -> None:
        """Finish and close live.mcap."""
        mcap, self._mcap = self._mcap, None
        if mcap is not None:
            try:
                mcap.close()
            except OSError as error:
                self.trouble = f"{NAME}: {error.strerror or error}: the file has no index"


def _known(value: float) -> float | None:
    return round(value, 3) if math.isfinite(value) else None
