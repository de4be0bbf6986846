"""Repeats the recorder's time keeping over what it logged, in order of arrival."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from swath.daemon.log.events import Event, Events, Severity
from swath.daemon.log.host_clock import ClockDiscipline
from swath.daemon.log.mcap.chunks import json_objects
from swath.daemon.log.parsers import stored_parsers
from swath.daemon.log.reader import open_logs
from swath.daemon.recorder.timekeeper import TimeKeeper
from swath.drivers.transports.base import UnitBlock

LEAP_S = 18
GPS_EPOCH_S = 315_964_800
UNDISCIPLINED = ClockDiscipline(0.0, 0x40, 16.0)


@dataclass(frozen=True)
class Labelled:
    """One moment of the recording: the host's clocks and UTC as known then, all in ns, and the clock's state."""

    monotonic_ns: int
    raw_ns: int
    utc_ns: int
    state: str


class _Unheard(Events):
    """Events that are discarded; the recorder's own are in its log."""

    def __init__(self) -> None:
        pass

    def post(self, severity: Severity, source: str, code: str, text: str) -> Event:
        return Event(0, severity, source, code, text)


def labelled(logs: Path) -> list[Labelled]:
    """Return ten moments a second of a recording of ``pps/main`` and ``gnss/rover``, where a time was known."""
    (session,) = open_logs([logs])
    offset_ns = session.info.realtime_ns - session.info.monotonic_ns
    keeper = TimeKeeper(_Unheard(), offset_ns)
    keeper.add_pps("pps/main", LEAP_S, 0)
    parsers, _ = stored_parsers(session.attachments())
    keeper.add_gnss("gnss/rover", "pps/main", parsers["gnss/rover"], None, LEAP_S)
    units_seen, edge_seen = keeper.units_seen("gnss/rover"), keeper.edge_seen("pps/main")
    found: list[Labelled] = []
    for batch in session.batches_by_time():
        topic = batch.channel.topic
        if topic == "/gnss/rover/raw":
            for time_ns, row in zip(batch.log_time_ns.tolist(), batch.units, strict=True):
                units_seen(np.array([time_ns], np.int64), UnitBlock(row[np.newaxis, :]))
        elif topic == "/pps/main":
            for _, edge in json_objects(batch):
                edge_seen(edge["edge_time_ns"], edge["sequence"])
        elif topic == "/clock":
            for _, sample in json_objects(batch):
                keeper.clock_sample(sample, UNDISCIPLINED)
                moment = _moment(keeper, sample["monotonic_ns"], sample["monotonic_raw_ns"], offset_ns)
                found += [moment] if moment is not None else []
    return found


def _moment(keeper: TimeKeeper, monotonic_ns: int, raw_ns: int, offset_ns: int) -> Labelled | None:
    host_ns = monotonic_ns + offset_ns
    state = str(keeper.status("pps/main", host_ns)["time_state"])
    if state == "NO_TIME":
        return None
    gps_ns, _ = keeper._clocks["pps/main"].gps_from_host(np.array([raw_ns], np.int64))
    return Labelled(monotonic_ns, raw_ns, int(gps_ns[0]) + (GPS_EPOCH_S - LEAP_S) * 1_000_000_000, state)


def wrong_seconds(moments: list[Labelled], truth_ns: Callable[[Labelled], int]) -> list[tuple[Labelled, float]]:
    """Return moments that claim to know their second but are wrong, and the error, s."""
    errors = [(moment, (moment.utc_ns - truth_ns(moment)) * 1e-9) for moment in moments]
    return [(moment, error) for moment, error in errors if moment.state in ("LOCKED", "HOLDOVER") and abs(error) > 0.5]


def states_between(logs: Path, begin_ns: int, end_ns: int) -> set[str]:
    """Return the states that the recorder reported for its clock between two times of CLOCK_MONOTONIC, ns."""
    (session,) = open_logs([logs])
    offset_ns = session.info.realtime_ns - session.info.monotonic_ns
    return {
        str(json.loads(row.tobytes())["time_state"])
        for batch in session.batches(lambda topic: topic == "/status/pps/main")
        for time_ns, row in zip(batch.log_time_ns.tolist(), batch.units, strict=True)
        if begin_ns < time_ns - offset_ns < end_ns
    }
