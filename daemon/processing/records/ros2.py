"""Exports a log as a bag of ROS 2 (MCAP) with standard messages, which Foxglove, RViz and other programs of ROS open.

Messages: ROS's packages sensor_msgs, nav_msgs, tf2_msgs, diagnostic_msgs. Conventions: REP 103 (units; east, north, up;
forward, left, up), REP 105 (names of frames), REP 145 (an IMU's samples along its own axes).
"""

from __future__ import annotations

import heapq
import shutil
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from swath.daemon.errors import ExitCode, UserError
from swath.daemon.log.format import LogError, safe_attachment_path
from swath.daemon.log.reader import PartDamage, Session
from swath.daemon.processing.records.places import (
    ENU_FROM_NED,
    LOCAL,
    Pose,
    clouds,
    first_place,
    frame_of,
    local_poses,
    mount_of,
    with_pose,
)
from swath.daemon.processing.records.read import LogRecords
from swath.daemon.written import make_folder, note_written
from swath.drivers.driver import RAW
from swath.georef.arrays import FloatArray, Int64Array, StructArray
from swath.georef.geodesy.rotations import quaternion_from_rot, rot_l_from_b
from swath.georef.records import FixType
from swath.georef.timescales import SECOND_NS

METADATA = "metadata.yaml"
BASE = "base_link"  # forward, left, up (REP 103, 105)
FRD_FROM_FLU = np.diag([1.0, -1.0, -1.0])
NAV_SAT_FIX, IMU = "sensor_msgs/msg/NavSatFix", "sensor_msgs/msg/Imu"
TIME_REFERENCE, POINT_CLOUD = "sensor_msgs/msg/TimeReference", "sensor_msgs/msg/PointCloud2"
DIAGNOSTICS, ODOMETRY, TF = "diagnostic_msgs/msg/DiagnosticArray", "nav_msgs/msg/Odometry", "tf2_msgs/msg/TFMessage"
POINT_DTYPE = np.dtype([(name, "<f4") for name in ("x", "y", "z", "intensity", "time")])
_STORE = get_typestore(Stores.ROS2_HUMBLE)
_UNFINISHED = ".part"
_NO_FIX, _FIX, _CORRECTED = -1, 0, 2  # sensor_msgs/NavSatStatus: STATUS_NO_FIX, STATUS_FIX, STATUS_GBAS_FIX
_STATUS = {
    FixType.NONE: _NO_FIX,
    FixType.DIFFERENTIAL: _CORRECTED,
    FixType.RTK_FLOAT: _CORRECTED,
    FixType.RTK_FIXED: _CORRECTED,
}
_SERVICE_GPS = 1
_OK = 0  # diagnostic_msgs/DiagnosticStatus
_NO_SUCH = np.array([-1.0, *[0.0] * 8])  # sensor_msgs/Imu: the message has no such quantity
_FOREVER = QosTime(9223372036, 854775807)
_KEPT = Qos(
    history=QosHistory.KEEP_LAST,
    depth=1,
    reliability=QosReliability.RELIABLE,
    durability=QosDurability.TRANSIENT_LOCAL,
    deadline=_FOREVER,
    lifespan=_FOREVER,
    liveliness=QosLiveliness.AUTOMATIC,
    liveliness_lease_duration=_FOREVER,
    avoid_ros_namespace_conventions=False,
)  # as tf2_ros offers it, so that a program that comes later gets the message too
_COVARIANCE_UNKNOWN, _COVARIANCE_KNOWN = 0, 3
_FLOAT32 = 7  # sensor_msgs/PointField
Message = tuple[int, str, str, Any]  # POSIX time of arrival, topic, type, message


@dataclass(slots=True)
class RosExport:
    """Lists the topics that an export to ROS 2 wrote.

    Attributes:
        folder: of the bag.
        messages: their number, by topic.
        notes: remarks for the reader, one line each.
        damage: parts of the log that could not be read.
    """

    folder: Path
    messages: Counter[str] = field(default_factory=Counter)
    notes: list[str] = field(default_factory=list)
    damage: list[PartDamage] = field(default_factory=list)

    def plain(self) -> dict[str, Any]:
        """Return the counts as plain values for ``--json``."""
        return {"messages": dict(self.messages)}

    def lines(self) -> list[str]:
        """Return a line for each topic."""
        return [f"{topic}: {count} messages" for topic, count in sorted(self.messages.items())]


def export_ros2(session: Session, directory: Path, *, overwrite: bool = False) -> RosExport:
    """Write a session as the bag ``directory/<session_id>``; the folder appears when it is complete.

    Args:
        session: as `open_logs` gives it.
        directory: created if necessary.
        overwrite: replace a bag of the same session.

    Raises:
        LogError: the log's name cannot be the name of a folder.
        UserError: the folder exists already, or the log has no configuration.
        OSError: it cannot be written; nothing is left of it.
    """
    target = safe_attachment_path(directory, session.session_id)
    if target.parent != directory:
        raise LogError(f"session {session.session_id[:60]!r}: cannot be a folder name; this session was not exported")
    if target.exists() and not overwrite:
        raise UserError(f"{target}: already exists; choose another folder or use --overwrite", ExitCode.USAGE)
    if target.exists() and not (target / METADATA).is_file():
        raise UserError(f"{target}: is not a bag; remove it or choose another folder", ExitCode.USAGE)
    unfinished = target.with_name(target.name + _UNFINISHED)
    if unfinished.exists():
        raise UserError(f"{unfinished}: is left of a killed export; remove it or choose another folder", ExitCode.IO)
    export = RosExport(target)
    records = LogRecords.of_session(session)
    make_folder(directory)
    unfinished.mkdir()
    try:
        _write(unfinished / target.name, export, records)
        if target.exists():
            shutil.rmtree(target)
        (unfinished / target.name).rename(target)
        note_written(target)
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)
    export.damage = list(dict.fromkeys(one for one in records.damage if one not in session.damage))
    return export


def _write(path: Path, export: RosExport, records: LogRecords) -> None:
    """Write all sources' messages, merged by the time of their arrival."""
    read = [source for source in records.sources if records.protocol(source) != RAW]
    tables = {source: records.tables(source, TABLES) for source in read if source not in records.without_driver}
    export.notes += [f"{source}: {why}" for source, why in records.without_driver.items()]
    origin = first_place(tables)
    bodies = [source for source, found in tables.items() if len(found["solutions"])]
    streams = [_mounts(records)]
    for source, found in tables.items():
        for name, make in _STREAMS.items():
            streams.append(make(source, found[name], records.posix_ns(found[name]).tolist()))
        if source in bodies:
            solutions = records.in_body(source, found["solutions"])
            streams.append(_solutions(records, source, solutions, origin, moves_body=source == bodies[0]))
        if records.sources[source] == "scanner":
            streams.append(_clouds(records, source, export.notes))
    if len(bodies) > 1:
        export.notes.append(f"/tf moves {BASE} by the solutions of {bodies[0]}")
    connections: dict[str, Any] = {}
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        for time_ns, topic, kind, message in heapq.merge(*streams, key=lambda one: one[0]):
            if topic not in connections:
                qos = [_KEPT] if topic == "/tf_static" else []
                connections[topic] = writer.add_connection(topic, kind, typestore=_STORE, offered_qos_profiles=qos)
            writer.write(connections[topic], max(0, time_ns), _STORE.serialize_cdr(message, kind))
            export.messages[topic] += 1


# --- parts of messages ----------------------------------------------------------------------------------------------


def _make(kind: str, **fields: Any) -> Any:
    return _STORE.types[kind](**fields)


def _time(unix_ns: int) -> Any:
    second, rest_ns = divmod(max(0, unix_ns), SECOND_NS)
    return _make("builtin_interfaces/msg/Time", sec=min(second, 2**31 - 1), nanosec=rest_ns)


def _header(unix_ns: int, frame: str) -> Any:
    return _make("std_msgs/msg/Header", stamp=_time(unix_ns), frame_id=frame)


def _vector(values: FloatArray) -> Any:
    x, y, z = values.tolist()
    return _make("geometry_msgs/msg/Vector3", x=x, y=y, z=z)


def _quaternion(q: FloatArray) -> Any:
    w, x, y, z = q.tolist()
    return _make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)


def _turned(sigmas: FloatArray, rotation: FloatArray) -> FloatArray:
    """Return the covariance (3, 3) of sigmas (3,) along axes that a rotation turns; 0 of one that is unknown."""
    covariance: FloatArray = rotation @ np.diag(np.nan_to_num(sigmas.astype(np.float64)) ** 2) @ rotation.T
    return covariance


def _transform(unix_ns: int, parent: str, child: str, place: FloatArray, q: FloatArray) -> Any:
    transform = _make("geometry_msgs/msg/Transform", translation=_vector(place), rotation=_quaternion(q))
    return _make(
        "geometry_msgs/msg/TransformStamped",
        header=_header(unix_ns, parent),
        child_frame_id=child,
        transform=transform,
    )


# --- messages of a device's tables ----------------------------------------------------------------------------------


def _fixes(source: str, fixes: StructArray, times: list[int]) -> Iterator[Message]:
    """Yield the positions of a receiver."""
    for row, unix_ns in zip(fixes, times, strict=True):
        if np.isfinite(row["lat_rad"]):
            yield int(row["host_time_ns"]), f"/{source}/fix", NAV_SAT_FIX, fix_message(row, unix_ns, frame_of(source))


def fix_message(row: Any, unix_ns: int, frame: str) -> Any:
    """Return the message of a row of fixes: degrees, height above the ellipsoid, covariance east, north, up, m²."""
    status = _STATUS.get(FixType(int(row["fix_type"])), _FIX) if row["valid"] else _NO_FIX
    return _position(row, row["position_cov_l"], status, unix_ns, frame)


def _position(row: Any, covariance_l: FloatArray, status: int, unix_ns: int, frame: str) -> Any:
    known = bool(np.isfinite(covariance_l).all())
    enu = ENU_FROM_NED @ covariance_l @ ENU_FROM_NED.T if known else np.zeros((3, 3))
    return _make(
        NAV_SAT_FIX,
        header=_header(unix_ns, frame),
        status=_make("sensor_msgs/msg/NavSatStatus", status=status, service=_SERVICE_GPS),
        latitude=float(np.degrees(row["lat_rad"])),
        longitude=float(np.degrees(row["lon_rad"])),
        altitude=float(row["height_m"]),
        position_covariance=enu.reshape(9),
        position_covariance_type=_COVARIANCE_KNOWN if known else _COVARIANCE_UNKNOWN,
    )


def _times(source: str, messages: StructArray, times: list[int]) -> Iterator[Message]:
    """Yield what a receiver's time messages name, with the host's time of their arrival as stamp."""
    for row, named_ns in zip(messages, times, strict=True):
        if row["gps_ns"] >= 0 and row["valid"]:
            host_ns = int(row["host_time_ns"])
            header = _header(host_ns, frame_of(source))
            message = _make(TIME_REFERENCE, header=header, time_ref=_time(named_ns), source=source)
            yield host_ns, f"/{source}/time", TIME_REFERENCE, message


def _samples(source: str, samples: StructArray, times: list[int]) -> Iterator[Message]:
    """Yield the samples of an inertial unit, along its own axes, without attitude."""
    level, unknown = _quaternion(np.array([1.0, 0.0, 0.0, 0.0])), np.zeros(9)
    for row, unix_ns in zip(samples, times, strict=True):
        message = _make(
            IMU,
            header=_header(unix_ns, frame_of(source)),
            orientation=level,
            orientation_covariance=_NO_SUCH,
            angular_velocity=_vector(row["angular_rate_b"]),
            angular_velocity_covariance=unknown,
            linear_acceleration=_vector(row["specific_force_b"]),
            linear_acceleration_covariance=unknown,
        )
        yield int(row["host_time_ns"]), f"/{source}/data_raw", IMU, message


def _headings(source: str, headings: StructArray, times: list[int]) -> Iterator[Message]:
    """Yield the valid headings of a receiver."""
    for row, unix_ns in zip(headings, times, strict=True):
        if row["valid"] and np.isfinite(row["heading_rad"]):
            yield int(row["host_time_ns"]), f"/{source}/heading", IMU, heading_message(row, unix_ns, frame_of(source))


def heading_message(row: Any, unix_ns: int, frame: str) -> Any:
    """Return the message of a row of headings: the attitude of the baseline, forward, left, up to east, north, up.

    Roll, and pitch where it is unknown, are 0. The covariance is about east, north, up; 0: unknown.
    """
    pitch_rad = float(np.nan_to_num(row["pitch_rad"]))
    rotation = ENU_FROM_NED @ rot_l_from_b(0.0, pitch_rad, float(row["heading_rad"])) @ FRD_FROM_FLU
    sigmas = np.array([0.0, row["pitch_sigma_rad"], row["heading_sigma_rad"]])
    zero = _vector(np.zeros(3))
    return _make(
        IMU,
        header=_header(unix_ns, frame),
        orientation=_quaternion(quaternion_from_rot(rotation)),
        orientation_covariance=_turned(sigmas, rotation).reshape(9),
        angular_velocity=zero,
        angular_velocity_covariance=_NO_SUCH,
        linear_acceleration=zero,
        linear_acceleration_covariance=_NO_SUCH,
    )


def _statuses(source: str, statuses: StructArray, times: list[int]) -> Iterator[Message]:
    """Yield a device's status as diagnostics, each value as text."""
    for row, unix_ns in zip(statuses, times, strict=True):
        values = [
            _make("diagnostic_msgs/msg/KeyValue", key=key, value=str(value)) for key, value in row["values"].items()
        ]
        status = _make(
            "diagnostic_msgs/msg/DiagnosticStatus",
            level=_OK,
            name=f"{source}: {row['message']}",
            message="",
            hardware_id=source,
            values=values,
        )
        message = _make(DIAGNOSTICS, header=_header(unix_ns, ""), status=[status])
        yield int(row["host_time_ns"]), "/diagnostics", DIAGNOSTICS, message


_STREAMS: dict[str, Callable[[str, StructArray, list[int]], Iterator[Message]]] = {
    "fixes": _fixes,
    "times": _times,
    "headings": _headings,
    "samples": _samples,
    "status": _statuses,
}
TABLES = (*_STREAMS, "solutions")


# --- the aircraft ---------------------------------------------------------------------------------------------------


def _solutions(
    records: LogRecords, source: str, solutions: StructArray, origin: Any, *, moves_body: bool
) -> Iterator[Message]:
    """Yield position and motion of an INS, and with ``moves_body`` the transform from ``local`` to the body."""
    rows = with_pose(solutions)
    poses, times = local_poses(rows, origin, FRD_FROM_FLU), records.posix_ns(rows).tolist()
    for row, pose, unix_ns in zip(rows, poses, times, strict=True):
        host_ns = int(row["host_time_ns"])
        covariance_l = np.diag(row["position_sigma_l"].astype(np.float64) ** 2)
        yield host_ns, f"/{source}/ins_fix", NAV_SAT_FIX, _position(row, covariance_l, _FIX, unix_ns, BASE)
        yield host_ns, f"/{source}/odometry", ODOMETRY, odometry(row, pose, unix_ns)
        if moves_body:
            moved = _transform(unix_ns, LOCAL, BASE, pose.position, pose.q)
            yield host_ns, "/tf", TF, _make(TF, transforms=[moved])


def odometry(row: Any, pose: Pose, unix_ns: int) -> Any:
    """Return the message of a row of solutions: velocity forward, left, up; variances are 0 where a sigma is unknown.

    Args:
        row: of solutions.
        pose: of the axes forward, left, up in ``local``.
        unix_ns: its time.
    """
    rotation = pose.rotation
    pose_covariance, twist_covariance = np.zeros((6, 6)), np.zeros((6, 6))
    pose_covariance[:3, :3] = _turned(row["position_sigma_l"], ENU_FROM_NED)
    pose_covariance[3:, 3:] = _turned(row["attitude_sigma_rad"], rotation)
    twist_covariance[:3, :3] = _turned(row["velocity_sigma_l"], rotation.T @ ENU_FROM_NED)
    x, y, z = pose.position.tolist()
    place = _make("geometry_msgs/msg/Point", x=x, y=y, z=z)
    posed = _make("geometry_msgs/msg/Pose", position=place, orientation=_quaternion(pose.q))
    velocity = _vector(np.nan_to_num(rotation.T @ ENU_FROM_NED @ row["velocity_l"]))
    twist = _make("geometry_msgs/msg/Twist", linear=velocity, angular=_vector(np.zeros(3)))
    with_covariance = "geometry_msgs/msg/{}WithCovariance"
    return _make(
        ODOMETRY,
        header=_header(unix_ns, LOCAL),
        child_frame_id=BASE,
        pose=_make(with_covariance.format("Pose"), pose=posed, covariance=pose_covariance.reshape(36)),
        twist=_make(with_covariance.format("Twist"), twist=twist, covariance=twist_covariance.reshape(36)),
    )


def _mounts(records: LogRecords) -> Iterator[Message]:
    """Yield the transforms from the body to the scanners, as installed, once for the whole bag."""
    host_ns, found = records.begin_host_ns, []
    for source, kind in records.sources.items():
        mount = mount_of(records, source) if kind == "scanner" else None
        if mount is not None:
            place, rotation = FRD_FROM_FLU @ mount[0], FRD_FROM_FLU @ mount[1]  # the matrix is its own inverse
            found.append(
                _transform(records.posix_of_host(host_ns), BASE, frame_of(source), place, quaternion_from_rot(rotation))
            )
    if found:
        yield host_ns, "/tf_static", TF, _make(TF, transforms=found)


def _clouds(records: LogRecords, source: str, notes: list[str]) -> Iterator[Message]:
    """Yield the returns of a scanner in its own frame, in clouds of a tenth of a second at most."""
    for places, rows, posix_ns in clouds(records, source, notes):
        host_ns = int(rows["host_time_ns"][-1])
        cloud = point_cloud(places, rows, posix_ns, frame_of(source))
        yield host_ns, f"/{source}/points", POINT_CLOUD, cloud


def point_cloud(places: FloatArray, rows: StructArray, unix_ns: Int64Array, frame: str) -> Any:
    """Return the message of some returns.

    Args:
        places: (n, 3) in the scanner's frame, m.
        rows: (n,) table of the returns.
        unix_ns: (n,) POSIX times, ns.
        frame: the scanner's.
    """
    points = np.empty(len(rows), POINT_DTYPE)
    points["x"], points["y"], points["z"] = places.T
    points["intensity"] = rows["intensity"]
    points["time"] = (unix_ns - unix_ns[0]) * 1e-9
    fields = [
        _make("sensor_msgs/msg/PointField", name=name, offset=4 * number, datatype=_FLOAT32, count=1)
        for number, name in enumerate(POINT_DTYPE.names or ())
    ]
    return _make(
        POINT_CLOUD,
        header=_header(int(unix_ns[0]), frame),
        height=1,
        width=len(points),
        fields=fields,
        is_bigendian=False,
        point_step=POINT_DTYPE.itemsize,
        row_step=points.nbytes,
        data=points.view(np.uint8),
        is_dense=True,
    )
