"""Makes a damaged or unfinished log whole: what can be read is copied beside it, the original is never touched.

Whole chunks are written again with their messages in the same order and with the same stamps; bad ones are dropped
and told. The copy has index and footer, so that every MCAP reader opens it.
"""

from __future__ import annotations

import shutil
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

from mcap import records

from daemon.log.chunks import chunk_batches, damage_within, take_description
from daemon.log.claim import is_being_written
from daemon.log.durable import sync_directory
from daemon.log.encode import encode_raw
from daemon.log.format import SCHEMAS, SESSION_METADATA, ChannelSpec, LogError
from daemon.log.reader import MAX_DAMAGE, RECOVERED, read_part_head
from daemon.log.scan import (
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
from daemon.log.writer import PartWriter


@dataclass(slots=True)
class RecoveryReport:
    """What was found in a log and what was done about it.

    Attributes:
        path: the original.
        recovered: the copy; None where the log was whole and nothing was written.
        chunks: good ones. messages: in them, by topic.
        damage: every stretch that could not be read.
        messages_lost: in all, where the statistics at the end of the original are whole; None: unknown.
    """

    path: Path
    recovered: Path | None = None
    chunks: int = 0
    messages: Counter[str] = field(default_factory=Counter)
    damage: list[Damage] = field(default_factory=list)
    messages_lost: int | None = None

    def add_damage(self, damage: Damage) -> None:
        """Note a stretch that could not be read; beyond a thousand they are one, with the bytes of all."""
        if len(self.damage) < MAX_DAMAGE:
            self.damage.append(damage)
            return
        last = self.damage[-1]
        self.damage[-1] = Damage(last.offset, last.length + damage.length, "here and in many places behind")

    @property
    def whole(self) -> bool:
        """Nothing is wrong with the original."""
        return not self.damage

    @property
    def lost_bytes(self) -> int:
        """Bytes of the original that could not be read."""
        return sum(damage.length for damage in self.damage)

    def plain(self) -> dict[str, object]:
        """For ``--json``."""
        return {
            "path": str(self.path),
            "whole": self.whole,
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


def examine(path: Path) -> RecoveryReport:
    """Read a log through and check every CRC; writes nothing.

    Raises:
        LogError: it is no log.
    """
    return _pass(path, None)


def recover(path: Path, destination: Path | None = None, *, keep_free_bytes: int = 0) -> RecoveryReport:
    """Repair a log into ``<stem>.recovered.mcap`` beside it, or in the folder ``destination``.

    Args:
        path: the log; it is only read.
        destination: folder of the copy.
        keep_free_bytes: the copy is given up when less would stay free.

    Raises:
        LogError: it is no log, it is being recorded, the copy is there already, or there is no room for it.
        OSError: the copy cannot be written.
    """
    folder = path.parent if destination is None else destination
    target = folder / (path.name.removesuffix(".mcap") + RECOVERED)
    if is_being_written(path):
        raise LogError(f"{path}: is being recorded; there is nothing to recover yet")
    report = examine(path)
    if report.whole:
        return report
    if target.exists():
        raise LogError(f"{target}: is there already; remove it to recover {path.name} again")
    free = shutil.disk_usage(folder).free
    needed = path.stat().st_size + keep_free_bytes
    if free < needed:
        raise LogError(f"{folder}: {free / 1e6:.0f} MB free, {needed / 1e6:.0f} MB needed to recover {path.name}")
    temporary = target.with_name(target.name + ".part")
    temporary.unlink(missing_ok=True)
    try:
        report = _pass(path, temporary)
        temporary.rename(target)
        sync_directory(folder)
    finally:
        temporary.unlink(missing_ok=True)
    report.recovered = target
    return report


def _pass(path: Path, copy: Path | None) -> RecoveryReport:
    """Read all; write what is good to ``copy`` if there is one."""
    head = read_part_head(path)
    report = RecoveryReport(path)
    writer = None if copy is None else PartWriter(copy, head.info, head.number, compression="auto")
    channels: dict[int, ChannelSpec] = {}
    schemas: dict[int, records.Schema] = {}
    end: Record | None = None
    try:
        with path.open("rb") as file:
            size = path.stat().st_size
            for found in scan(file, size):
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
            said = None if end is None else _messages_said(file, end, size)
            saved = report.messages.total()
            report.messages_lost = None if said is None or said < saved else said - saved
        if writer is not None:
            writer.finish()
    finally:
        if writer is not None:
            writer.close()
    return report


def _messages_said(file: BinaryIO, end: Record, size: int) -> int | None:
    """How many messages the statistics of a file whose end is whole speak of; None where it has none."""
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
    """The schema of a channel where it is a stranger's."""
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
