"""Estimate from a log how many returns it holds, and what their points and files will take on disk."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from swath.daemon.free_space import check_space
from swath.daemon.log.chunk_index import ChunkPlace, LogIndex, index_log, read_chunks
from swath.daemon.log.format import LogError, source_of_topic
from swath.daemon.log.reader import Session
from swath.daemon.processing.setup.setup import Setup
from swath.georef.records import ChunkBatch, ScannerReturns

SAMPLES = 5  # chunks along the log
IN_STRIPS = 0.3  # share of the returns that lies in strips, at least; the others are in turns and on the way
LAZ_BYTES = (3.0, 12.0)  # of a point in LAZ, with sigmas: from quiet returns to dense, noisy ones


def check_space_for_returns(
    folder: Path, what: str, bytes_a_return: tuple[float, float], sessions: Sequence[Session], setups: Sequence[Setup]
) -> None:
    """Compare the space that files of returns will need with the space there is, before the logs are read.

    The number of returns is estimated, and their share in strips is not known yet.

    Args:
        folder, what: as of `swath.daemon.free_space.check_space`.
        bytes_a_return: in the files: at least, and at most.
        sessions, setups: of the logs.

    Raises:
        UserError: there is certainly too little.
    """
    count = sum(estimated_returns(session, setup) for session, setup in zip(sessions, setups, strict=True))
    least, most = bytes_a_return
    check_space(folder, what, least_bytes=IN_STRIPS * count * least, most_bytes=count * most)


def estimated_returns(session: Session, setup: Setup) -> int:
    """Return about how many returns a session holds, from a few of its chunks; 0 if they cannot be decoded alone.

    Parts that were cut off count as empty: walking through them takes as long as reading them.
    """
    try:
        index = index_log(session, walk=False)
    except (LogError, OSError):  # reported by the code that reads the log
        return 0
    chunks = index.scanner_chunks()
    taken = {round(at) for at in np.linspace(0, len(chunks) - 1, SAMPLES)} if chunks else set()
    read_bytes = sum(chunks[at].length for at in taken)
    found = sum(_returns_in(index, setup, chunks[at]) for at in taken)
    return round(found * sum(chunk.length for chunk in chunks) / read_bytes) if read_bytes else 0


def _returns_in(index: LogIndex, setup: Setup, chunk: ChunkPlace) -> int:
    """Return the number of returns in a scanner chunk; no parser remembers an earlier chunk."""
    parsers = setup.sources.parsers(("scanner",))
    found = 0
    for batch in read_chunks(index, [chunk], None, []):
        source = source_of_topic(batch.channel.topic)
        if source not in parsers:
            continue
        records = parsers[source].feed_batches([ChunkBatch(source, batch.log_time_ns, batch.units)])
        found += sum(len(record.rows) for record in records if isinstance(record, ScannerReturns))
    return found
