"""Defines names and layouts of the log as in docs/log-format.md: topics, schemas, session metadata, attachments."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Literal

FIXED_SCHEME = "fixed:"

PROFILE = "swath"
LIBRARY = "swath"
MAGIC = b"\x89MCAP0\r\n"
CHUNK_BYTES = 1 << 20
CHUNK_OPEN_NS = 250_000_000
SESSION_METADATA = "swath.session"
MAX_PART = 999_999

ChunkClass = Literal["scanner", "other"]
CHUNK_CLASSES: tuple[ChunkClass, ...] = ("scanner", "other")


class LogError(Exception):
    """A file is not a swath log, or cannot be read as one; the message is one line that names the problem and the
    place.
    """


@dataclass(frozen=True, slots=True)
class ChannelSpec:
    """A channel as described in the log.

    Attributes:
        topic: ``/gnss/rover/raw`` …
        message_encoding: ``x-swath-serial``, ``x-swath-can``, ``x-swath-udp`` or ``json``.
        metadata: of the channel.
        schema: name in `SCHEMAS`; None for raw channels (schema id 0).
        chunk_class: channels of one class share chunks.
    """

    topic: str
    message_encoding: str
    metadata: dict[str, str] = field(default_factory=dict)
    schema: str | None = None
    chunk_class: ChunkClass = "other"


@dataclass(frozen=True, slots=True)
class SessionInfo:
    """Content of ``swath.session``: it ties the parts together, and host time to the clocks of the computer.

    Attributes:
        realtime_ns, monotonic_ns: one reading of both clocks; log_time = monotonic + (realtime_ns − monotonic_ns).
        origin: "import" for a log made from captures, "simulation" for a flight of the virtual aircraft; None for a
            recording.
    """

    session_id: str
    software: str
    host: str
    boot_id: str
    realtime_ns: int
    monotonic_ns: int
    origin: str | None = None

    def to_metadata(self, part: int) -> dict[str, str]:
        """Return the metadata record of a part."""
        values = {
            "session_id": self.session_id,
            "part": str(part),
            "software": self.software,
            "host": self.host,
            "boot_id": self.boot_id,
            "realtime_ns": str(self.realtime_ns),
            "monotonic_ns": str(self.monotonic_ns),
        }
        return values | ({"origin": self.origin} if self.origin is not None else {})

    @classmethod
    def from_metadata(cls, values: dict[str, str]) -> tuple[SessionInfo, int]:
        """Read a metadata record: the session and the number of the part.

        Raises:
            LogError: a key is missing or is not a number.
        """
        try:
            info = cls(
                session_id=values["session_id"],
                software=values["software"],
                host=values["host"],
                boot_id=values["boot_id"],
                realtime_ns=int(values["realtime_ns"]),
                monotonic_ns=int(values["monotonic_ns"]),
                origin=values.get("origin"),
            )
            part = int(values["part"])
        except (KeyError, ValueError) as error:
            raise LogError(f"metadata {SESSION_METADATA}: {error} is missing or wrong") from error
        if not 0 <= part <= MAX_PART:
            raise LogError(f"metadata {SESSION_METADATA}: part {part} is not a part number, want 0 to {MAX_PART}")
        return info, part


def _object(title: str, required: dict[str, str], optional: dict[str, str]) -> bytes:
    types = {"int": {"type": "integer"}, "str": {"type": "string"}, "num": {"type": ["number", "null"]}}
    schema = {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": title,
        "type": "object",
        "properties": {key: types[kind] for key, kind in (required | optional).items()},
        "required": list(required),
    }
    return json.dumps(schema, separators=(",", ":")).encode()


SCHEMAS: dict[str, bytes] = {
    "swath.Pps": _object(
        "swath.Pps", {"edge_time_ns": "int", "sequence": "int"}, {"edge": "str", "realtime_ns": "int"}
    ),
    "swath.Clock": _object(
        "swath.Clock",
        {
            "realtime_ns": "int",
            "monotonic_ns": "int",
            "monotonic_raw_ns": "int",
            "frequency_ppm": "num",
            "status": "int",
        },
        {"max_error_s": "num"},
    ),
    "swath.Status": _object(
        "swath.Status",
        {
            "bytes": "int",
            "units": "int",
            "written": "int",
            "lost_kernel": "int",
            "lost_queue": "int",
            "lost_write": "int",
            "last_unit_age_s": "num",
            "receive_buffer_bytes": "int",
            "queue_high_water": "int",
            "write_ms_max": "num",
            "sync_ms_max": "num",
            "state": "str",
        },
        {
            "time_state": "str",
            "time_sigma_ns": "num",
            "stamp_ambiguous": "int",
            "error_frames": "int",
            "bus_off": "int",
            "line_errors": "int",
            "refused": "int",
            "refused_senders": "str",
        },
    ),
    "swath.Event": _object(
        "swath.Event", {"time_ns": "int", "severity": "str", "source": "str", "code": "str", "text": "str"}, {}
    ),
}
SCHEMA_IDS: dict[str, int] = {name: number for number, name in enumerate(SCHEMAS, start=1)}


def safe_attachment_path(folder: Path, name: str) -> Path:
    """Return the path below ``folder`` where an attachment may be written.

    Raises:
        LogError: the name would lead out of the folder.
    """
    parts = PurePosixPath(name).parts
    if not parts or name.startswith("/") or ".." in parts or "\\" in name or "\0" in name:
        raise LogError(f"attachment {name!r}: is not a valid name; it was not written")
    return folder.joinpath(*parts)


def source_of_topic(topic: str) -> str | None:
    """Return the source of a topic: ``/scanner/left/aux/raw`` → ``scanner/left/aux``; ``/pps/main`` → ``pps/main``;
    else None.
    """
    if topic.startswith("/pps/"):
        return topic[1:]
    return topic[1 : -len("/raw")] if topic.endswith("/raw") else None
