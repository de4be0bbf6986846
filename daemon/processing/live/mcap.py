"""Writes ``live.mcap``: points, position and pose in Foxglove's own schemas, so that its viewer opens the file
directly.

The fixed frame is ``local``: east, north, up, in metres from an origin near the first position; the file's metadata
record ``swath.live`` and ``live.json`` give the origin in the output's coordinates. ``body`` moves in it.
"""

from __future__ import annotations

import contextlib
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from foxglove import messages as fox
from mcap.writer import CompressionType, Writer
from numpy.typing import NDArray

from swath.georef.arrays import FloatArray
from swath.georef.timescales.gps_time import SECOND_NS

FRAME, BODY = "local", "body"
NAME, PREVIOUS = "live.mcap", "live.previous.mcap"
CLOUD_DTYPE = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4")])
CHUNK_BYTES = 256 << 10
END_BYTES = 64 << 10  # of the file's index and schemas, plus some for each chunk
END_BYTES_PER_CHUNK = 512


@dataclass(frozen=True, slots=True)
class LivePose:
    """Position and attitude of the body.

    Attributes:
        time_ns: UTC as POSIX nanoseconds.
        lat_deg, lon_deg, height_m: ellipsoidal.
        position: (3,) in the frame ``local``.
        q_local_from_b: (4,) scalar first.
        sigma_l: (3,) m, north, east, down; nan: unknown.
    """

    time_ns: int
    lat_deg: float
    lon_deg: float
    height_m: float
    position: FloatArray
    q_local_from_b: FloatArray
    sigma_l: FloatArray


class LiveMcap:
    """Writes ``live.mcap`` in a folder; the previous run's file stays as ``live.previous.mcap`` while the quota allows.

    Attributes:
        is_full: True if the quota is used up; further messages are not written.
        beside_bytes: size of other files that count towards the quota.
    """

    def __init__(self, folder: Path, quota_bytes: int, metadata: dict[str, str]) -> None:
        """Create the file and rename that of the previous run.

        Raises:
            OSError: the file cannot be created.
        """
        self.is_full = False
        self.beside_bytes = 0
        self._quota_bytes = quota_bytes
        self._previous = folder / PREVIOUS
        path = folder / NAME
        with contextlib.suppress(FileNotFoundError):
            path.rename(self._previous)
        self._previous_bytes = _size_of(self._previous)
        self._file = path.open("wb")
        self._writer = Writer(self._file, chunk_size=CHUNK_BYTES, compression=CompressionType.NONE)
        self._writer.start(profile="", library="swath")
        self._writer.add_metadata("swath.live", metadata)
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._since_flush = 0
        self._last_size = 0
        self._chunks = 0

    @property
    def size(self) -> int:
        """Maximum size in bytes of the file if it is closed now."""
        written = self._file.tell()
        if written != self._last_size:  # a chunk was closed: at most the last message is in the next one
            self._chunks += 1
            self._last_size, self._since_flush = written, 0
        return written + self._since_flush + END_BYTES + END_BYTES_PER_CHUNK * self._chunks

    def add(self, topic: str, schema: Any, data: bytes, log_time_ns: int) -> bool:
        """Add a message, encoded as its schema says; return True if it was written."""
        if self._is_beyond(len(data)):
            return False
        if topic not in self._channels:
            if schema.name not in self._schemas:
                self._schemas[schema.name] = self._writer.register_schema(schema.name, schema.encoding, schema.data)
            self._channels[topic] = self._writer.register_channel(topic, "protobuf", self._schemas[schema.name])
        self._writer.add_message(self._channels[topic], log_time_ns, data, log_time_ns)
        self._since_flush += len(data) + 64
        return True

    def _is_beyond(self, length: int) -> bool:
        """Return True if a message would exceed the quota; the previous run's file is deleted first."""
        if self.is_full:
            return True
        size = self.size + self.beside_bytes + length + 64
        if size + self._previous_bytes > self._quota_bytes and self._previous_bytes:
            self._previous.unlink(missing_ok=True)
            self._previous_bytes = 0
        self.is_full = size > self._quota_bytes
        return self.is_full

    def close(self) -> None:
        """Write index and footer, and close the file.

        Raises:
            OSError: the files cannot be written to disk.
        """
        try:
            self._writer.finish()
        finally:
            self._file.close()


def cloud_message(points: NDArray[Any], time_ns: int) -> Any:
    """Return points (n,) of `CLOUD_DTYPE` in the frame ``local`` as a message."""
    return fox.PointCloud(
        timestamp=_stamp(time_ns),
        frame_id=FRAME,
        pose=_pose(fox.Vector3(x=0, y=0, z=0)),
        point_stride=CLOUD_DTYPE.itemsize,
        fields=[_field(str(name), 4 * place) for place, name in enumerate(CLOUD_DTYPE.names or ())],
        data=points.tobytes(),
    )


def pose_messages(pose: LivePose) -> dict[str, Any]:
    """Return position, pose and the transform to the body as messages, by topic."""
    stamp = _stamp(pose.time_ns)
    w, *xyz = pose.q_local_from_b.tolist()
    turned = fox.Quaternion(x=xyz[0], y=xyz[1], z=xyz[2], w=w)
    x, y, z = pose.position.tolist()
    place = fox.Vector3(x=x, y=y, z=z)
    known = bool(np.isfinite(pose.sigma_l).all())
    kinds = fox.LocationFixPositionCovarianceType
    north, east, down = (pose.sigma_l**2).tolist() if known else (0.0, 0.0, 0.0)
    fix = fox.LocationFix(
        timestamp=stamp,
        frame_id=BODY,
        latitude=pose.lat_deg,
        longitude=pose.lon_deg,
        altitude=pose.height_m,
        position_covariance=[east, 0, 0, 0, north, 0, 0, 0, down],
        position_covariance_type=kinds.DiagonalKnown if known else kinds.Unknown,
    )
    transform = fox.FrameTransform(
        timestamp=stamp, parent_frame_id=FRAME, child_frame_id=BODY, translation=place, rotation=turned
    )
    in_frame = fox.PoseInFrame(timestamp=stamp, frame_id=FRAME, pose=fox.Pose(position=place, orientation=turned))
    return {"/position": fix, "/pose": in_frame, "/tf": transform}


def grid_message(density: NDArray[np.float32], west_m: float, south_m: float, cell_m: float, time_ns: int) -> Any:
    """Return points per square metre (rows from the south, columns from the west) in the frame ``local``."""
    rows = np.ascontiguousarray(density, "<f4")
    return fox.Grid(
        timestamp=_stamp(time_ns),
        frame_id=FRAME,
        pose=_pose(fox.Vector3(x=west_m, y=south_m, z=0)),
        column_count=rows.shape[1],
        cell_size=fox.Vector2(x=cell_m, y=cell_m),
        row_stride=4 * rows.shape[1],
        cell_stride=4,
        fields=[_field("points_per_m2", 0)],
        data=rows.tobytes(),
    )


def log_message(text: str, *, well: bool, time_ns: int) -> Any:
    """Return a sentence for the operator as a message."""
    level = fox.LogLevel.Info if well else fox.LogLevel.Warning
    return fox.Log(timestamp=_stamp(time_ns), level=level, message=text, name="swath live")


def _pose(position: Any) -> Any:
    return fox.Pose(position=position, orientation=fox.Quaternion(x=0, y=0, z=0, w=1))


def _field(name: str, offset: int) -> Any:
    return fox.PackedElementField(name=name, offset=offset, type=fox.PackedElementFieldNumericType.Float32)


def _stamp(time_ns: int) -> Any:
    return fox.Timestamp(sec=time_ns // SECOND_NS, nsec=time_ns % SECOND_NS)


def _size_of(path: Path) -> int:
    try:
        return os.stat(path).st_size
    except OSError:
        return 0
