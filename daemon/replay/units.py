"""Reads a finished log as a sequence of timed units, and opens the outputs that a configuration names for them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path

from swath.daemon.config import Config
from swath.daemon.log.format import FIXED_SCHEME, source_of_topic
from swath.daemon.log.mcap.chunks import json_objects
from swath.daemon.log.reader import Session
from swath.daemon.replay.wire_player import Output, PpsOutput, TimedUnit, open_output


def timed_units(session: Session, *, with_pps: bool) -> Iterator[TimedUnit]:
    """Yield the raw units and PPS edges of a session in the order of their host time.

    The time of a PPS edge is that of the edge itself, not that of its message; a message without an edge time is
    skipped.
    """
    for batch in session.batches_by_time():
        source = source_of_topic(batch.channel.topic)
        if source is None:
            continue
        if source.startswith("pps/"):
            if with_pps:
                for _, value in json_objects(batch):
                    edge_time_ns = value.get("edge_time_ns")
                    if isinstance(edge_time_ns, int) and 0 <= edge_time_ns < 1 << 63:
                        yield TimedUnit(edge_time_ns, source, b"")
            continue
        for time_ns, row in zip(batch.log_time_ns.tolist(), batch.units, strict=True):
            yield TimedUnit(time_ns, source, row.tobytes())


def output_makers(config: Config, *, with_pps: bool) -> dict[str, Callable[[], Output]]:
    """Return functions that make the sending end of every transport that a configuration names; each raises
    TransportError.
    """
    makers: dict[str, Callable[[], Output]] = {}
    for device in config.devices():
        for spec, suffix in ((device.transport, ""), (device.auxiliary, "/aux")):
            if spec is not None and spec.carrier is None and spec.kind != "ntrip":  # a caster only sends
                makers[device.source + suffix] = partial(open_output, spec)
    for name, pps in config.pps.items():
        if with_pps and pps.source.startswith(FIXED_SCHEME):
            makers[f"pps/{name}"] = partial(PpsOutput, Path(pps.source.removeprefix(FIXED_SCHEME)))
    return makers


def open_outputs(config: Config, *, with_pps: bool) -> dict[str, Output]:
    """Open the sending ends of every transport that a configuration names.

    Raises:
        TransportError: one cannot be made; those already made are closed.
    """
    outputs: dict[str, Output] = {}
    try:
        for source, make in output_makers(config, with_pps=with_pps).items():
            outputs[source] = make()
    except OSError:
        close_outputs(outputs)
        raise
    return outputs


def close_outputs(outputs: Mapping[str, Output]) -> None:
    """Close all the outputs."""
    for output in outputs.values():
        output.close()
