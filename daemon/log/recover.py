"""Repairs a damaged or unfinished log: all readable data is copied to a file beside it; the original is never touched.

Whole chunks are written again with their messages in the same order and with the same stamps; damaged ones are dropped
and reported. The copy has index and footer, so that every MCAP reader opens it.
"""

from __future__ import annotations

import contextlib
import os
import shutil
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

from mcap import records

from swath.daemon.log.claim import claim, is_being_written, stands_at
from swath.daemon.log.durable import sync_directory
from swath.daemon.log.format import SCHEMAS, SESSION_METADATA, ChannelSpec, LogError
from swath.daemon.log.mcap.chunks import chunk_batches, damage_within, take_description
from swath.daemon.log.mcap.encode import encode_raw
from swath.daemon.log.mcap.scan import (
    OP_ATTACHMENT,
    OP_CHANNEL,
    OP_CHUNK,
    OP_DATA_END,
    OP_METADATA,
    OP_SCHEMA,
    OP_STATISTICS,
    Damage,
    Record,
    parse_record,
    scan,
    summary_records,
)
from swath.daemon.log.mcap.writer import PartWriter, create_exclusively
from swath.daemon.log.reader import MAX_DAMAGE, RECOVERED, read_part_head
from swath.daemon.system import held_interrupts
from swath.daemon.written import note_written

UNFINISHED = ".part"  # suffix of a copy that is not complete yet


@dataclass(slots=True)
class RecoveryReport:
    """The findings about a log and the result of its recovery.

    Attributes:
        path: the original.
        recovered: the copy; None if the log was whole and nothing was written.
        chunks: number of good ones. messages: in them, by topic.
        damage: every stretch that could not be read.
        messages_lost: number over the whole log; None (unknown) if the original's statistics are missing or damaged.
    """

    path: Path
    recovered: Path | None = None
    chunks: int = 0
    messages: Counter[str] = field(default_factory=Counter)
    damage: list[Damage] = field(default_factory=list)
    messages_lost: int | None = None

    def add_damage(self, damage: Damage) -> None:
        """Note a stretch that could not be read; stretches beyond a thousand are merged into one, with the bytes of
        all.
        """
        if len(self.damage) < MAX_DAMAGE:
            self.damage.append(damage)
            return
        last = self.damage[-1]
        self.damage[-1] = Damage(last.offset, last.length + damage.length, "here and in many later places")

    @property
    def whole(self) -> bool:
        """True if the original has no damage."""
        return not self.damage

    @property
    def index_only(self) -> bool:
        """True if nothing but the index of the original is missing, or nothing at all."""
        return all(damage.index_only for damage in self.damage)

    @property
    def lost_bytes(self) -> int:
        """Number of bytes of the original that could not be read."""
        return sum(damage.length for damage in self.damage)

    def plain(self) -> dict[str, object]:
        """Return the report as plain values for ``--json``."""
        return {
            "path": str(self.path),
            "whole": self.whole,
            "index_only": self.index_only and not self.whole,
            "recovered": None if self.recovered is None else str(self.recovered),
            "chunks": self.chunks,
            "messages": dict(self.messages),
            "lost_bytes": self.lost_bytes,
            "messages_lost": self.messages_lost,
            "damage": [
                {"offset": item.offset, "length": item.length, "what": item.what, "messages": item.messages}
                for item in self.damage
            ],
        }


def examine(path: Path, progress: Callable[[int, int], None] = lambda done, total: None) -> RecoveryReport:
    """Read a log through and check every CRC; write nothing.

    ``progress`` is called with the bytes read and with all bytes.

    Raises:
        LogError: it is not a log.
    """
    read_part_head(path)
    return _pass(path, None, progress)


def recover(
    path: Path,
    destination: Path | None = None,
    *,
    keep_free_bytes: int = 0,
    tell: Callable[[str, int, int, str], None] = lambda *_: None,
) -> RecoveryReport:
    """Repair a log into ``<stem>.recovered.mcap`` beside it, or in the folder ``destination``.

    Args:
        path: the log; it is only read.
        destination: folder of the copy.
        keep_free_bytes: the recovery is refused if less space would stay free.
        tell: called with the progress, as `swath.georef.progress.Tell`.

    Raises:
        LogError: it is not a log, another process is recording or recovering it, the copy exists already, or there is
            no room for it.
        OSError: the copy cannot be written.
    """
    folder = path.parent if destination is None else destination
    target = folder / (path.name.removesuffix(".mcap") + RECOVERED)
    if is_being_written(path):
        raise LogError(f"{path}: is being recorded; recover it after the recording has ended")
    report = examine(path, lambda done, total: tell(f"checking {path.name}", done, total, "B"))
    if report.whole:
        return report
    _refuse_existing(target, path)
    free = shutil.disk_usage(folder).free
    needed = path.stat().st_size + keep_free_bytes
    if free < needed:
        raise LogError(f"{folder}: {free / 1e6:.0f} MB free, {needed / 1e6:.0f} MB needed to recover {path.name}")
    temporary = target.with_name(target.name + UNFINISHED)
    with _taken(temporary, path) as fd:
        _refuse_existing(target, path)  # another process may have made it meanwhile
        _give_to_owner_of(path, fd)
        head = read_part_head(path)
        writer = PartWriter(temporary, head.info, head.number, fd=os.dup(fd))
        report = _pass(path, writer, lambda done, total: tell(f"repairing {path.name}", done, total, "B"))
        with held_interrupts():
            temporary.rename(target)
            note_written(target)
        sync_directory(folder)
    report.recovered = target
    return report


def _refuse_existing(target: Path, path: Path) -> None:
    if target.exists():
        raise LogError(f"{target}: already exists; remove it to recover {path.name} again")


@contextlib.contextmanager
def _taken(temporary: Path, path: Path) -> Iterator[int]:
    """Hold the file of a copy, empty and claimed, for the duration of the block; remove it unless it was renamed.

    A process that removes or renames a file of this name must hold the claim on it and have checked that the name still
    refers to this file.
    """
    with contextlib.suppress(FileNotFoundError):
        _remove_left_behind(temporary, path)
    try:
        fd = create_exclusively(temporary)
    except FileExistsError:
        raise _taken_by_another(path) from None
    try:
        if not claim(fd) or not stands_at(fd, temporary):
            raise _taken_by_another(path)
        try:
            yield fd
        finally:
            if stands_at(fd, temporary):
                temporary.unlink()
    finally:
        os.close(fd)


def _remove_left_behind(temporary: Path, path: Path) -> None:
    """Remove the rest of an interrupted recovery.

    Raises:
        LogError: the other recovery is still running.
        FileNotFoundError: there is nothing to remove.
    """
    fd = os.open(temporary, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        if not claim(fd):
            raise _taken_by_another(path)
        if stands_at(fd, temporary):
            temporary.unlink()
    finally:
        os.close(fd)


def _taken_by_another(path: Path) -> LogError:
    return LogError(f"{path}: is being recovered by another process")


def _give_to_owner_of(path: Path, fd: int) -> None:
    """Give the copy the owner and permissions of the log, because readers use the copy instead of the log.

    A copy made by root would otherwise be readable by root only, and the recorder's user would lose access to the data.
    """
    original = path.stat()
    with contextlib.suppress(PermissionError):  # some file systems have no owners
        if os.geteuid() == 0:
            os.fchown(fd, original.st_uid, original.st_gid)
        os.fchmod(fd, original.st_mode & 0o777)


def _pass(
    path: Path, writer: PartWriter | None, progress: Callable[[int, int], None] = lambda done, total: None
) -> RecoveryReport:
    """Read the whole log; if a writer is given, write all good data to the copy and close it."""
    report = RecoveryReport(path)
    channels: dict[int, ChannelSpec] = {}
    schemas: dict[int, records.Schema] = {}
    end: Record | None = None
    try:
        with path.open("rb") as file:
            size = path.stat().st_size
            for found in scan(file, size):
                progress(found.offset, size)
                if isinstance(found, Damage):
                    report.add_damage(found)
                    end = None
                elif found.opcode == OP_CHUNK:
                    _copy_chunk(found, writer, channels, schemas, report)
                elif found.opcode in (OP_CHANNEL, OP_SCHEMA):
                    _take_description(found, channels, schemas, report)
                elif found.opcode == OP_DATA_END:
                    end = found
                elif writer is not None:
                    _copy_outside(found, writer)
            stated = None if end is None else _stated_messages(file, end, size)
            saved = report.messages.total()
            report.messages_lost = None if stated is None or stated < saved else stated - saved
        if writer is not None:
            writer.finish()
    finally:
        if writer is not None:
            writer.close()
    return report


def _stated_messages(file: BinaryIO, end: Record, size: int) -> int | None:
    """Return the message count from the statistics of a file whose end is whole; None if it has no statistics."""
    for found in summary_records(file, end.offset + end.length, size):
        if found.opcode == OP_STATISTICS:
            try:
                return parse_record(records.Statistics, found.body).message_count
            except LogError:
                return None
    return None


def _take_description(
    found: Record, channels: dict[int, ChannelSpec], schemas: dict[int, records.Schema], report: RecoveryReport
) -> None:
    try:
        take_description(found, channels, schemas)
    except LogError as error:
        report.add_damage(Damage(found.offset, found.length, str(error)))


def _copy_chunk(
    found: Record,
    writer: PartWriter | None,
    channels: dict[int, ChannelSpec],
    schemas: dict[int, records.Schema],
    report: RecoveryReport,
) -> None:
    lost: Counter[str] = Counter()
    try:
        batches = list(chunk_batches(found.body, channels, schemas, lost=lost))
    except LogError as error:
        report.add_damage(Damage(found.offset, found.length, str(error)))
        return
    if lost:
        report.add_damage(damage_within(found, lost))
    report.chunks += 1
    for batch in batches:
        report.messages[batch.channel.topic] += len(batch.units)
        if writer is not None:
            _copy_schema(batch.channel, schemas, writer)
            writer.add_channel(batch.channel_id, batch.channel)
            writer.add(encode_raw(batch.channel_id, batch.log_time_ns, batch.rows))
    if writer is not None:
        writer.flush()


def _copy_schema(channel: ChannelSpec, schemas: dict[int, records.Schema], writer: PartWriter) -> None:
    """Copy the schema of a channel if it is not one of swath's own."""
    if channel.schema is not None and channel.schema not in SCHEMAS:
        writer.add_schema(next(one for one in schemas.values() if one.name == channel.schema))


def _copy_outside(found: Record, writer: PartWriter) -> None:
    if found.opcode == OP_ATTACHMENT:
        attachment = parse_record(records.Attachment, found.body)
        writer.add_attachment(attachment.name, attachment.media_type, attachment.data, attachment.log_time)
    elif found.opcode == OP_METADATA:
        metadata = parse_record(records.Metadata, found.body)
        if metadata.name != SESSION_METADATA:
            writer.add_metadata(metadata.name, metadata.metadata)
