"""Find where a flight was from a few seconds of its log, before anything long is done."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

import numpy as np

from swath.daemon.config.config import Config
from swath.daemon.log.chunk_index import ChunkPlace, LogIndex, index_log, read_chunks
from swath.daemon.log.format import LogError, source_of_topic
from swath.daemon.log.reader import Session
from swath.daemon.processing.setup.sources import Sources
from swath.georef.arrays import FloatArray
from swath.georef.records import ChunkBatch, FixType, GnssFix, InsSolution

SAMPLES = 12  # places along the log
LASTS_NS = 1_500_000_000  # of each: receivers that send one fix a second are met


def flight_places(session: Session, config: Config, attachments: Mapping[str, bytes]) -> FloatArray:
    """Return latitudes and longitudes (n, 2), degrees, of a few places along a session.

    They are those of receivers and of an INS, to be compared with places that are kilometres apart; none if neither
    gives any, if all parts were cut off (walking through them takes as long as reading them), or if the log cannot be
    read, which other code reports.
    """
    try:
        index = index_log(session, walk=False)
        found = [place for run in _runs(index) for place in _places(index, run, Sources(config, attachments))]
    except (LogError, OSError):
        found = []
    return np.array(found, np.float64).reshape(-1, 2)


def _runs(index: LogIndex) -> Iterator[list[ChunkPlace]]:
    """Yield a few chunks of everything but scanners at places along the log."""
    chunks = [chunk for chunk in index.chunks if chunk.other and not chunk.scanner]
    for start in sorted({round(at) for at in np.linspace(0, len(chunks) - 1, SAMPLES)} if chunks else ()):
        until_ns = chunks[start].start_ns + LASTS_NS
        run = [chunk for chunk in chunks[start : start + SAMPLES] if chunk.start_ns <= until_ns]
        yield run


def _places(index: LogIndex, chunks: list[ChunkPlace], sources: Sources) -> list[tuple[float, float]]:
    """Return the places that sources give in a stretch of the log; no parser remembers an earlier stretch."""
    parsers = sources.parsers(("gnss", "imu"), whole=True)
    found: list[tuple[float, float]] = []
    for batch in read_chunks(index, chunks, lambda topic: topic.startswith(("/gnss/", "/imu/")), []):
        source = source_of_topic(batch.channel.topic)
        for name in () if source is None else sources.inside(source):
            if name not in parsers or name in sources.gimbal_sources:
                continue
            for record in parsers[name].feed_batches([ChunkBatch(source or "", batch.log_time_ns, batch.units)]):
                if isinstance(record, GnssFix) and record.valid and record.fix_type is not FixType.NONE:
                    found.append((record.lat_rad or 0.0, record.lon_rad or 0.0))
                elif isinstance(record, InsSolution):
                    found += zip(record.rows["lat_rad"].tolist(), record.rows["lon_rad"].tolist(), strict=True)
    known = [(lat, lon) for lat, lon in found if math.isfinite(lat + lon) and (lat, lon) != (0.0, 0.0)]
    return [(math.degrees(lat), math.degrees(lon)) for lat, lon in known[:1]]
