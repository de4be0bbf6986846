"""Readers of logs that tests of the log compare."""

from __future__ import annotations

from pathlib import Path

from mcap.reader import NonSeekingReader, make_reader

from swath.daemon.log.reader import Session
from tests.daemon.builders import Content


def read_all(session: Session) -> Content:
    """Return the content of a session in file order."""
    content: Content = {}
    for batch in session.batches():
        rows = content.setdefault(batch.channel.topic, [])
        rows += [(t, u.tobytes()) for t, u in zip(batch.log_time_ns.tolist(), batch.units, strict=True)]
    return content


def official(path: Path, *, seeking: bool = True) -> Content:
    """Return the content of a file as MCAP's own reader reads it."""
    content: Content = {}
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True) if seeking else NonSeekingReader(file, validate_crcs=True)
        for _, channel, message in reader.iter_messages(log_time_order=False):
            content.setdefault(channel.topic, []).append((message.log_time, message.data))
    return content
