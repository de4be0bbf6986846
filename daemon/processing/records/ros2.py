"""Exports a log as a bag of ROS 2 (MCAP) with standard messages, which Foxglove, RViz and other programs of ROS open.

Messages: ROS's packages sensor_msgs and std_msgs. Conventions: REP 103 (units; east, north, up), REP 145 (an IMU's
samples along its own axes).
"""

from __future__ import annotations

import heapq
import shutil
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from swath.daemon.errors import ExitCode, UserError
from swath.daemon.log.format import LogError, safe_attachment_path
from swath.daemon.log.reader import PartDamage, Session
from swath.daemon.processing.live.products import unix_from_gps
from swath.daemon.processing.records.capture import places_s
from swath.daemon.processing.records.read import LogRecords
from swath.daemon.written import make_folder, note_written
from swath.drivers.parser import DriverSettingsError
from swath.georef.arrays import FloatArray, Int64Array, StructArray
from swath.georef.records import FixType
from swath.georef.timescales import SECOND_NS

METADATA = "metadata.yaml"
CLOUD_NS = SECOND_NS // 10  # the longest span of a cloud
POINT_DTYPE = np.dtype([(name, "<f4") for name in ("x", "y", "z", "intensity", "time")])
_STORE = get_typestore(Stores.ROS2_HUMBLE)
_UNFINISHED = ".part"
_ENU_FROM_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
_NO_FIX, _FIX, _CORRECTED = -1, 0, 2  # sensor_msgs/NavSatStatus: STATUS_NO_FIX, STATUS_FIX, STATUS_GBAS_FIX
_STATUS = {
    FixType.NONE: _NO_FIX,
    FixType.DIFFERENTIAL: _CORRECTED,
    FixType.RTK_FLOAT: _CORRECTED,
    FixType.RTK_FIXED: _CORRECTED,
}
_SERVICE_GPS = 1
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
    streams: list[Iterator[Message]] = []
    for source, kind in records.sources.items():
        if kind == "gnss":
            streams += [_fixes(records, source), _times(records, source)]
        elif kind == "imu":
            streams.append(_samples(records, source))
        elif kind == "scanner":
            streams.append(_clouds(records, source, export.notes))
    connections: dict[str, Any] = {}
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        for time_ns, topic, kind_of_message, message in heapq.merge(*streams, key=lambda one: one[0]):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind_of_message, typestore=_STORE)
            writer.write(connections[topic], max(0, time_ns), _STORE.serialize_cdr(message, kind_of_message))
            export.messages[topic] += 1


# --- parts of messages ----------------------------------------------------------------------------------------------


def _make(kind: str, **fields: Any) -> Any:
    return _STORE.types[kind](**fields)


def _time(unix_ns: int) -> Any:
    second, rest_ns = divmod(max(0, unix_ns), SECOND_NS)
    return _make("builtin_interfaces/msg/Time", sec=min(second, 2**31 - 1), nanosec=rest_ns)


def _header(unix_ns: int, source: str) -> Any:
    return _make("std_msgs/msg/Header", stamp=_time(unix_ns), frame_id=source.replace("/", "_"))


def _unix_ns(gps_ns: int, host_ns: int) -> int:
    """Return the POSIX time of a record: by its GPS time, or by the host's clock where that is unknown."""
    return unix_from_gps(gps_ns) if gps_ns >= 0 else host_ns


def _vector(values: FloatArray) -> Any:
    x, y, z = values.tolist()
    return _make("geometry_msgs/msg/Vector3", x=x, y=y, z=z)


# --- messages -------------------------------------------------------------------------------------------------------


def _fixes(records: LogRecords, source: str) -> Iterator[Message]:
    """Yield the positions of a receiver."""
    for row in records.table(source, "fixes"):
        if np.isfinite(row["lat_rad"]):
            yield int(row["host_time_ns"]), f"/{source}/fix", "sensor_msgs/msg/NavSatFix", nav_sat_fix(row, source)


def nav_sat_fix(row: Any, source: str) -> Any:
    """Return the message of a row of fixes: degrees, height above the ellipsoid, covariance east, north, up, m²."""
    fix_type = FixType(int(row["fix_type"]))
    covariance_l: FloatArray = row["position_cov_l"]
    known = bool(np.isfinite(covariance_l).all())
    enu = _ENU_FROM_NED @ covariance_l @ _ENU_FROM_NED.T if known else np.zeros((3, 3))
    status = _STATUS.get(fix_type, _FIX) if row["valid"] else _NO_FIX
    return _make(
        "sensor_msgs/msg/NavSatFix",
        header=_header(_unix_ns(int(row["gps_ns"]), int(row["host_time_ns"])), source),
        status=_make("sensor_msgs/msg/NavSatStatus", status=status, service=_SERVICE_GPS),
        latitude=float(np.degrees(row["lat_rad"])),
        longitude=float(np.degrees(row["lon_rad"])),
        altitude=float(row["height_m"]),
        position_covariance=enu.reshape(9),
        position_covariance_type=_COVARIANCE_KNOWN if known else _COVARIANCE_UNKNOWN,
    )


def _times(records: LogRecords, source: str) -> Iterator[Message]:
    """Yield what a receiver's time messages name, with the host's time of their arrival as stamp."""
    for row in records.table(source, "times"):
        gps_ns, host_ns = int(row["gps_ns"]), int(row["host_time_ns"])
        if gps_ns >= 0 and row["valid"]:
            kind = "sensor_msgs/msg/TimeReference"
            named = _time(unix_from_gps(gps_ns))
            yield (
                host_ns,
                f"/{source}/time",
                kind,
                _make(kind, header=_header(host_ns, source), time_ref=named, source=source),
            )


def _samples(records: LogRecords, source: str) -> Iterator[Message]:
    """Yield the samples of an inertial unit, along its own axes, without attitude."""
    kind = "sensor_msgs/msg/Imu"
    level = _make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0)
    unknown, none = np.zeros(9), np.array([-1.0, *[0.0] * 8])  # −1: the message has no such quantity
    for row in records.table(source, "samples"):
        host_ns = int(row["host_time_ns"])
        message = _make(
            kind,
            header=_header(_unix_ns(int(row["gps_ns"]), host_ns), source),
            orientation=level,
            orientation_covariance=none,
            angular_velocity=_vector(row["angular_rate_b"]),
            angular_velocity_covariance=unknown,
            linear_acceleration=_vector(row["specific_force_b"]),
            linear_acceleration_covariance=unknown,
        )
        yield host_ns, f"/{source}/data_raw", kind, message


def _clouds(records: LogRecords, source: str, notes: list[str]) -> Iterator[Message]:
    """Yield the returns of a scanner in its own frame, in clouds of a tenth of a second at most."""
    table = records.config.scanner[source.removeprefix("scanner/")]
    try:
        geometry = records.geometry(source)
    except (ValueError, DriverSettingsError) as error:
        notes.append(f"{source}: no points: {error}")
        return
    for rows in records.returns(source):
        places, placed = places_s(rows, geometry, (table.range_min_m, table.range_max_m))
        unix_ns = _times_of(placed)
        cuts = np.flatnonzero(np.diff(unix_ns // CLOUD_NS)) + 1
        for part in np.split(np.arange(len(placed)), cuts):
            if len(part):
                host_ns = int(placed["host_time_ns"][part[-1]])
                cloud = point_cloud(places[part], placed[part], unix_ns[part], source)
                yield host_ns, f"/{source}/points", "sensor_msgs/msg/PointCloud2", cloud


def _times_of(rows: StructArray) -> Int64Array:
    """Return the POSIX time of each return."""
    gps_ns: Int64Array = rows["gps_ns"]
    times: Int64Array = rows["host_time_ns"].copy()
    known = np.flatnonzero(gps_ns >= 0)
    if len(known):  # leap seconds are those of the first: a batch is far shorter than a day
        first = int(gps_ns[known[0]])
        times[known] = gps_ns[known] + (unix_from_gps(first) - first)
    return times


def point_cloud(places: FloatArray, rows: StructArray, unix_ns: Int64Array, source: str) -> Any:
    """Return the message of some returns.

    Args:
        places: (n, 3) in the scanner's frame, m.
        rows: (n,) table of the returns.
        unix_ns: (n,) POSIX times, ns.
        source: ``scanner/left``.
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
        "sensor_msgs/msg/PointCloud2",
        header=_header(int(unix_ns[0]), source),
        height=1,
        width=len(points),
        fields=fields,
        is_bigendian=False,
        point_step=POINT_DTYPE.itemsize,
        row_step=points.nbytes,
        data=points.view(np.uint8),
        is_dense=True,
    )
