"""Digests what this processor makes of a log, to compare it: ``python -m tests.arm64.outcome LOG FILE.npz``.

Each source has the digest of all records that its decoder gives. Trajectory and points, in e and on the map, are stored
before a file rounds them.
"""

from __future__ import annotations

import hashlib
import sys
from collections import defaultdict
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from swath.daemon.log.format import source_of_topic
from swath.daemon.log.parsers import stored_parsers
from swath.daemon.log.reader import open_logs
from swath.daemon.processing.flights.read import Flight, GeorefOptions, read_flights
from swath.daemon.processing.points.feed import LogFeed
from swath.daemon.processing.setup.setup import Options
from swath.georef.points import Points
from swath.georef.records import ChunkBatch

CRS = "EPSG:32632"


def main(log: Path, file: Path) -> None:
    """Write the digest of everything made of the log."""
    (flight,) = read_flights(GeorefOptions([log], log, options=Options(crs=CRS)), lambda *_: None)
    assert flight.trajectory is not None
    found: dict[str, Any] = {f"digest {source}": digest for source, digest in digests(log).items()}
    for name in ("time_ns", "position_e", "q_e_from_b", "velocity_e"):
        found[f"trajectory {name}"] = getattr(flight.trajectory, name)
    found |= {f"map {name}": column for name, column in columns(placed(flight)).items()}
    flight.setup.mapping = None
    flight.setup._georeferencers = flight.setup._made(None)
    found |= {f"e {name}": column for name, column in columns(placed(flight)).items()}
    np.savez(file, **found)


def digests(log: Path) -> dict[str, str]:
    """Return by source a digest of every byte of every record that its parser gives."""
    (session,) = open_logs([log])
    parsers, troubles = stored_parsers(session.attachments())
    assert not troubles
    sums: dict[str, Any] = defaultdict(hashlib.sha256)
    for batch in session.batches():
        source = (source_of_topic(batch.channel.topic) or "").removesuffix("/aux")
        if source in parsers:
            units = ChunkBatch(source_of_topic(batch.channel.topic) or "", batch.log_time_ns, batch.units)
            for record in parsers[source].feed_batch(units):
                told(sums[source], record)
    for source, parser in parsers.items():
        for record in parser.close():
            told(sums[source], record)
    return {source: digest.hexdigest() for source, digest in sums.items()}


def told(digest: Any, record: Any) -> None:
    """Return a record's type and fields as text: arrays by their bytes, numbers by their shortest unique decimals."""
    digest.update(type(record).__name__.encode())
    for field in fields(record):
        value = getattr(record, field.name)
        if not isinstance(value, np.ndarray):
            digest.update(repr(value).encode())
            continue
        for name in value.dtype.names or [...]:  # the bytes between columns of a row are undefined
            digest.update(value[name].tobytes())


def placed(flight: Flight) -> Points:
    """Return all points of a flight in the order of the log."""
    assert flight.trajectory is not None
    feed = LogFeed(flight.setup, flight.setup.office_stream(flight.clocks.clocks, flight.trajectory))
    points = [points for batch in flight.session.batches() for _, points in feed.take(batch)]
    return Points.concatenate(points + [points for _, points in feed.close()])


def columns(points: Points) -> dict[str, Any]:
    """Return the columns by name."""
    return {field.name: getattr(points, field.name) for field in fields(points)}


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
