"""Writes a log's records as one MCAP file that Foxglove and PlotJuggler open.

Two kinds of topics hold them, all in protobuf. What a viewer draws has Foxglove's own schemas: positions, clouds,
poses, transforms, the recorder's events. What a viewer plots is a message for each row of a table of records, with all
its columns, in a schema made of these columns.
"""

from __future__ import annotations

import heapq
import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from foxglove import messages as fox
from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorProto, FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass
from mcap.writer import IndexType, Writer
from numpy.typing import NDArray

from swath.daemon.processing.records.places import (
    ENU_FROM_NED,
    LOCAL,
    ROWS_AT_ONCE,
    Cloud,
    clouds,
    first_place,
    frame_of,
    local_poses,
    mount_of,
    with_pose,
)
from swath.daemon.processing.records.read import LogRecords
from swath.daemon.processing.records.tables import KINDS, flat_columns
from swath.georef.arrays import FloatArray, Int64Array, StructArray
from swath.georef.geodesy.rotations import quaternion_from_rot
from swath.georef.progress import Tell, silent
from swath.georef.records import FixType, ScannerReturns
from swath.georef.timescales import SECOND_NS

BODY = "body"  # forward, right, down
STATUS = "status"
SCHEMAS = {
    "fixes": "Fix",
    "headings": "Heading",
    "marks": "Mark",
    "times": "Time",
    "samples": "Sample",
    "solutions": "Solution",
}
_FIELD_TYPES = {
    "f8": FieldDescriptorProto.TYPE_DOUBLE,
    "f4": FieldDescriptorProto.TYPE_FLOAT,
    "i8": FieldDescriptorProto.TYPE_INT64,
    "i": FieldDescriptorProto.TYPE_INT32,
    "u8": FieldDescriptorProto.TYPE_UINT64,
    "u": FieldDescriptorProto.TYPE_UINT32,
    "b": FieldDescriptorProto.TYPE_BOOL,
    "U": FieldDescriptorProto.TYPE_STRING,
}
_NUMERIC = fox.PackedElementFieldNumericType
_PACKED = {
    "f4": _NUMERIC.Float32,
    "f8": _NUMERIC.Float64,
    "u1": _NUMERIC.Uint8,
    "u2": _NUMERIC.Uint16,
    "u4": _NUMERIC.Uint32,
}
POINT_DTYPE = np.dtype(
    [
        *((axis, "<f4") for axis in "xyz"),  # in the scanner's frame, m
        ("intensity", "<f4"),
        ("time_ns", "<u4"),  # after the cloud's time
        ("time_sigma_s", "<f4"),  # nan: unknown
        ("range_m", "<f4"),
        ("pulse_width_ns", "<f4"),
        ("channel", "<u2"),
        ("return_number", "u1"),
        ("number_of_returns", "u1"),
        ("mta_zone", "u1"),
        ("flags", "u1"),
    ]
)
_LEVELS = {
    "info": fox.LogLevel.Info,
    "warning": fox.LogLevel.Warning,
    "error": fox.LogLevel.Error,
    "critical": fox.LogLevel.Fatal,
}
_COVARIANCE = fox.LocationFixPositionCovarianceType


class Schema(NamedTuple):
    """A schema of messages in protobuf, with the descriptor that a reader decodes them by."""

    name: str
    data: bytes


class Message(NamedTuple):
    """A message for the file; ``encoded`` is bytes in the schema."""

    posix_ns: int
    topic: str
    schema: Schema
    encoded: bytes


def write_mcap(
    records: LogRecords,
    path: Path,
    sources: Sequence[str],
    span: tuple[int | None, int | None],
    notes: list[str],
    tell: Tell = silent,
) -> Counter[str]:
    """Write the records of sources into a file; return the number of messages by topic.

    Messages have the time of what they tell: POSIX time by GPS time, as `LogRecords.posix_ns` gives it.

    Args:
        records: of the session.
        path: of the file.
        sources: ``gnss/rover``, ….
        span: GPS time, [start, stop); None: the log's begin or end.
        notes: gets remarks, one line each.
        tell: called with the progress.

    Raises:
        UserError: the log does not know GPS time, and a span is wanted.
        OSError: the log cannot be read or the file cannot be written.
    """
    tables: dict[str, dict[str, StructArray]] = {}
    for number, source in enumerate(sources):
        tell("records", number, len(sources), "sources")
        tables[source] = records.tables(source, _but_returns(), *span)
    origin = first_place(tables)
    streams = [_events(records, span)] if set(sources) == set(records.sources) else []
    bodies = [source for source in sources if len(tables[source]["solutions"])]
    for source, found in tables.items():
        streams += [_plotted(records, source, name, table) for name, table in found.items() if name != STATUS]
        streams += _statuses(records, source, found[STATUS])
        streams.append(_positions(records, source, found["fixes"]))
        if source in bodies:
            solutions = records.in_body(source, found["solutions"])
            streams.append(_poses(records, source, solutions, origin, moves_body=source == bodies[0]))
        if records.sources[source] == "scanner":
            streams.append(_clouds(records, source, span, notes))
    if len(bodies) > 1:
        notes.append(f"/tf moves the body by the solutions of {bodies[0]}")
    metadata = {"session_id": records.session.session_id, "time": "POSIX time, by GPS time and leap seconds"}
    if origin is not None:
        metadata |= {name: repr(float(origin[name])) for name in ("lat_rad", "lon_rad", "height_m")}
    return _write(path, metadata, heapq.merge(*streams, key=lambda message: message.posix_ns))


def _but_returns() -> list[str]:
    return [name for name, kind in KINDS.items() if kind.record is not ScannerReturns]


def _write(path: Path, metadata: dict[str, str], messages: Iterator[Message]) -> Counter[str]:
    """Write messages, in their order."""
    written: Counter[str] = Counter()
    schemas: dict[Schema, int] = {}
    channels: dict[str, int] = {}
    with path.open("wb") as file:
        writer = Writer(file, index_types=IndexType.ALL & ~IndexType.ATTACHMENT)  # there are none
        writer.start(profile="", library="swath")
        writer.add_metadata("swath.records", metadata)
        for posix_ns, topic, schema, encoded in messages:
            if topic not in channels:
                if schema not in schemas:
                    schemas[schema] = writer.register_schema(schema.name, "protobuf", schema.data)
                channels[topic] = writer.register_channel(topic, "protobuf", schemas[schema])
            writer.add_message(channels[topic], posix_ns, encoded, posix_ns, written[topic])
            written[topic] += 1
        writer.finish()
    return written


# --- a message for each row -----------------------------------------------------------------------------------------


def row_type(name: str, columns: Mapping[str, NDArray[Any]]) -> tuple[Callable[..., Any], Schema]:
    """Return the class of messages that hold a row of columns, and its schema ``swath.<name>``."""
    file = FileDescriptorProto(name=f"swath/{name}.proto", package="swath", syntax="proto3")
    message = file.message_type.add(name=name)
    for number, (field, column) in enumerate(columns.items(), 1):
        kind = column.dtype.kind
        kind = _FIELD_TYPES.get(f"{kind}{column.dtype.itemsize}") or _FIELD_TYPES[kind]
        message.field.add(name=field, number=number, type=kind, label=FieldDescriptorProto.LABEL_OPTIONAL)
    pool = DescriptorPool()
    pool.AddSerializedFile(file.SerializeToString())
    made = GetMessageClass(pool.FindMessageTypeByName(f"swath.{name}"))
    return made, Schema(f"swath.{name}", FileDescriptorSet(file=[file]).SerializeToString())


def _rows(topic: str, name: str, columns: Mapping[str, NDArray[Any]], posix_ns: Int64Array) -> Iterator[Message]:
    """Yield a message for each row of columns, in the order of their times."""
    make, schema = row_type(name, columns)
    order = np.argsort(posix_ns, kind="stable")
    for begin in range(0, len(order), ROWS_AT_ONCE):
        chosen = order[begin : begin + ROWS_AT_ONCE]
        values = zip(*(column[chosen].tolist() for column in columns.values()), strict=True)
        for at_ns, row in zip(posix_ns[chosen].tolist(), values, strict=True):
            yield Message(at_ns, topic, schema, make(**dict(zip(columns, row, strict=True))).SerializeToString())


def _plotted(records: LogRecords, source: str, name: str, table: StructArray) -> Iterator[Message]:
    return _rows(f"/{source}/{name}", SCHEMAS[name], flat_columns(table), records.posix_ns(table))


def _statuses(records: LogRecords, source: str, table: StructArray) -> Iterator[Iterator[Message]]:
    """Yield a stream for each kind of status message: its values differ from those of others."""
    for message in dict.fromkeys(table["message"].tolist()):
        rows = table[table["message"] == message]
        columns = {name: rows[name] for name in ("gps_ns", "time_sigma_s", "host_time_ns")}
        for key in dict.fromkeys(key for values in rows["values"] for key in values):
            name = _identifier(key)
            columns[f"{name}_" if name in columns else name] = _column([values.get(key) for values in rows["values"]])
        name = _identifier(f"Status_{source}_{message}")
        yield _rows(f"/{source}/{STATUS}/{_identifier(message)}", name, columns, records.posix_ns(rows))


def _column(values: Sequence[Any]) -> NDArray[Any]:
    """Return a column of a status's values: of one type if all have it, else numbers with nan or text."""
    types = {type(value) for value in values}
    if types == {bool}:
        return np.array(values, np.bool_)
    if types <= {bool, int, float, type(None)}:
        if types == {int} and all(abs(value) < 1 << 63 for value in values):
            return np.array(values, np.int64)
        return np.array([np.nan if value is None else value for value in values], np.float64)
    return np.array(["" if value is None else str(value) for value in values])


def _identifier(text: str) -> str:
    """Return a text as a name of protobuf."""
    name = re.sub(r"\W", "_", text, flags=re.ASCII)
    return name if name and not name[0].isdigit() else f"_{name}"


# --- what is drawn --------------------------------------------------------------------------------------------------


def _fox(posix_ns: int, topic: str, message: Any) -> Message:
    found = message.get_schema()
    return Message(posix_ns, topic, Schema(found.name, found.data), message.encode())


def _stamp(posix_ns: int) -> Any:
    return fox.Timestamp(sec=posix_ns // SECOND_NS, nsec=posix_ns % SECOND_NS)


def _vector(values: FloatArray) -> Any:
    x, y, z = values.tolist()
    return fox.Vector3(x=x, y=y, z=z)


def _quaternion(q: FloatArray) -> Any:
    w, x, y, z = q.tolist()
    return fox.Quaternion(x=x, y=y, z=z, w=w)


def _in_order(records: LogRecords, table: StructArray) -> tuple[StructArray, list[int]]:
    posix_ns = records.posix_ns(table)
    order = np.argsort(posix_ns, kind="stable")
    return table[order], posix_ns[order].tolist()


def location_fix(row: Any, covariance_l: FloatArray, posix_ns: int, frame: str) -> Any:
    """Return the message of a position: degrees, height above the ellipsoid, covariance east, north, up, m².

    Args:
        row: of fixes or solutions.
        covariance_l: (3, 3) north, east, down; nan: unknown.
        posix_ns: its time.
        frame: name of the antenna's or the body's frame.
    """
    known = bool(np.isfinite(covariance_l).all())
    enu = ENU_FROM_NED @ covariance_l @ ENU_FROM_NED.T if known else np.zeros((3, 3))
    return fox.LocationFix(
        timestamp=_stamp(posix_ns),
        frame_id=frame,
        latitude=float(np.degrees(row["lat_rad"])),
        longitude=float(np.degrees(row["lon_rad"])),
        altitude=float(row["height_m"]),
        position_covariance=enu.ravel().tolist(),
        position_covariance_type=_COVARIANCE.Known if known else _COVARIANCE.Unknown,
    )


def _positions(records: LogRecords, source: str, fixes: StructArray) -> Iterator[Message]:
    """Yield the valid positions of a receiver."""
    there = np.isfinite(fixes["lat_rad"]) & fixes["valid"] & (fixes["fix_type"] != FixType.NONE)
    for row, posix_ns in zip(*_in_order(records, fixes[there]), strict=True):
        yield _fox(
            posix_ns, f"/{source}/position", location_fix(row, row["position_cov_l"], posix_ns, frame_of(source))
        )


def _poses(
    records: LogRecords, source: str, solutions: StructArray, origin: Any, *, moves_body: bool
) -> Iterator[Message]:
    """Yield position and pose of an INS, and with ``moves_body`` the transform from ``local`` to the body."""
    rows, times = _in_order(records, with_pose(solutions))
    for row, pose, posix_ns in zip(rows, local_poses(rows, origin), times, strict=True):
        covariance_l = np.diag(row["position_sigma_l"].astype(np.float64) ** 2)
        yield _fox(posix_ns, f"/{source}/ins_position", location_fix(row, covariance_l, posix_ns, BODY))
        orientation = _quaternion(pose.q)
        placed = fox.Pose(position=_vector(pose.position), orientation=orientation)
        posed = fox.PoseInFrame(timestamp=_stamp(posix_ns), frame_id=LOCAL, pose=placed)
        yield _fox(posix_ns, f"/{source}/pose", posed)
        if moves_body:
            yield _transform(posix_ns, LOCAL, BODY, pose.position, pose.q)


def _transform(posix_ns: int, parent: str, child: str, place: FloatArray, q: FloatArray) -> Message:
    message = fox.FrameTransform(
        timestamp=_stamp(posix_ns),
        parent_frame_id=parent,
        child_frame_id=child,
        translation=_vector(place),
        rotation=_quaternion(q),
    )
    return _fox(posix_ns, "/tf", message)


def _clouds(
    records: LogRecords, source: str, span: tuple[int | None, int | None], notes: list[str]
) -> Iterator[Message]:
    """Yield the returns of a scanner in its own frame, each cloud behind the place of that frame in the body."""
    mount = mount_of(records, source)
    for cloud in clouds(records, source, notes, *span):
        posix_ns = int(cloud.posix_ns.min())
        if mount is not None:
            yield _transform(posix_ns, BODY, frame_of(source), mount[0], quaternion_from_rot(mount[1]))
        yield _fox(posix_ns, f"/{source}/points", point_cloud(cloud, frame_of(source)))


def point_cloud(cloud: Cloud, frame: str) -> Any:
    """Return the message of some returns."""
    places, rows, posix_ns = cloud
    first_ns = int(posix_ns.min())
    points = np.empty(len(rows), POINT_DTYPE)
    points["x"], points["y"], points["z"] = places.T
    points["time_ns"] = posix_ns - first_ns
    for name in (POINT_DTYPE.names or ())[3:]:
        if name != "time_ns":
            points[name] = rows[name]
    fields = [
        fox.PackedElementField(name=name, offset=int(place[1]), type=_PACKED[place[0].str[1:]])
        for name, place in (POINT_DTYPE.fields or {}).items()
    ]
    at_origin = fox.Pose(position=fox.Vector3(x=0, y=0, z=0), orientation=fox.Quaternion(x=0, y=0, z=0, w=1))
    return fox.PointCloud(
        timestamp=_stamp(first_ns),
        frame_id=frame,
        pose=at_origin,
        point_stride=POINT_DTYPE.itemsize,
        fields=fields,
        data=points.tobytes(),
    )


def _events(records: LogRecords, span: tuple[int | None, int | None]) -> Iterator[Message]:
    """Yield the recorder's events."""
    begin_ns, end_ns = records.host_span(*span)
    for event in records.events():
        host_ns = event.get("time_ns")
        if not isinstance(host_ns, int) or not begin_ns <= host_ns < end_ns:
            continue
        posix_ns = records.posix_of_host(host_ns)
        message = fox.Log(
            timestamp=_stamp(posix_ns),
            level=_LEVELS.get(str(event.get("severity")), fox.LogLevel.Unknown),
            message=f"{event.get('code')}: {event.get('text')}",
            name=str(event.get("source")),
            file="",
            line=0,
        )
        yield _fox(posix_ns, "/events", message)
