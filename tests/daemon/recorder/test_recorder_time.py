"""Tests time while recording: a real NovAtel recording and its edges through the configured wiring."""

from __future__ import annotations

from heapq import merge
from itertools import takewhile
from pathlib import Path

import numpy as np
import pytest

from demo.captures import gnss_units, pps_units
from swath.daemon.config import load_config
from swath.daemon.log.host_clock import ClockDiscipline
from swath.daemon.recorder.assembly import Assembly, assemble
from swath.daemon.replay.wire_player import TimedUnit
from swath.drivers.transports.base import UnitBlock
from swath.georef.timescales import SECOND_NS, PpsClock
from tests.daemon.journal import journal_of
from tests.daemon.rig import session_table

SECONDS = 40
UNDISCIPLINED = ClockDiscipline(0.0, 0x40, 16.0)
DISCIPLINED = ClockDiscipline(0.0, 0, 0.001)


def assembled(folder: Path, gnss: str = "", pps: str = "") -> Assembly:
    folder.mkdir()
    config = folder / "swath.toml"
    config.write_text(
        session_table(folder / "logs")
        + f'[gnss.rover]\ntransport = "serial:{folder}/rover"\nprotocol = "novatel"\npps = "main"\n{gnss}\n'
        + f'[pps.main]\nsource = "fixed:{folder}/pps"\n{pps}\n'
    )
    return assemble(load_config(config))


def play(assembly: Assembly, discipline: ClockDiscipline = UNDISCIPLINED) -> tuple[list[str], int]:
    """Feed the recording, and return the state of the PPS at each edge and the last edge's host time (ns)."""
    keeper, start_ns = assembly.timekeeper, assembly.clock.now_ns()
    units_seen, edge_seen = keeper.units_seen("gnss/rover"), keeper.edge_seen("pps/main")
    states: list[str] = []
    edge_ns = 0
    for unit in merge(played(), pps_units(SECONDS), key=lambda unit: unit.time_ns):
        host_ns = start_ns + unit.time_ns
        monotonic_ns = host_ns - assembly.clock.offset_ns
        sample = {"realtime_ns": host_ns, "monotonic_ns": monotonic_ns, "monotonic_raw_ns": monotonic_ns}
        if unit.source == "pps/main":
            edge_ns = host_ns
            keeper.clock_sample(sample, discipline)
            edge_seen(host_ns, len(states) + 1)
            states.append(str(keeper.status("pps/main", host_ns)["time_state"]))
        else:
            block = UnitBlock(np.frombuffer(unit.data, np.uint8)[np.newaxis, :])
            units_seen(np.array([host_ns], dtype=np.int64), block)
    return states, edge_ns


def played() -> list[TimedUnit]:
    return list(takewhile(lambda unit: unit.time_ns < SECONDS * SECOND_NS, gnss_units()))


def gps_of(assembly: Assembly, host_ns: int) -> int:
    """Return GPS time of a host time, ns."""
    clock: PpsClock = assembly.timekeeper._clocks["pps/main"]
    raw_ns = assembly.timekeeper._timeline.raw_at(host_ns)
    return int(clock.gps_from_host(np.array([raw_ns], dtype=np.int64))[0][0])


def test_recording_and_its_edges_are_locked(tmp_path: Path) -> None:
    assembly = assembled(tmp_path / "plain")
    states, edge_ns = play(assembly)
    assert states[0] != "LOCKED"
    assert set(states[20:]) == {"LOCKED"}
    status = assembly.timekeeper.status("gnss/rover", edge_ns)
    assert status["time_state"] == "LOCKED"
    assert status["time_sigma_ns"] is not None
    assert assembly.timekeeper.status("scanner/left", edge_ns) == {}
    whole_s = gps_of(assembly, edge_ns) / SECOND_NS
    assert abs(whole_s - round(whole_s)) < 1e-6


def test_a_receiver_far_from_a_synchronised_clock_is_reported_once(
    caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    caplog.set_level("INFO", "swath")
    play(assembled(tmp_path / "x"), DISCIPLINED)  # a recording of another year, beside today's clock
    (event,) = [event for event in journal_of(caplog) if event.code == "time_far_from_host"]
    assert (event.source, event.severity) == ("gnss/rover", "warning")
    assert "days behind this computer's clock (kept by" in event.text


def test_delay_and_named_edge_of_the_configuration_are_used(tmp_path: Path) -> None:
    seconds = {}
    for name, keys in {
        "plain": {},
        "late": {"pps": "delay_ns = 250000"},
        "next": {"gnss": 'names_edge = "next"'},
    }.items():
        assembly = assembled(tmp_path / name, **keys)
        _, edge_ns = play(assembly)
        seconds[name] = gps_of(assembly, edge_ns) / SECOND_NS
    # a late stamp lies after its edge; messages that name the next edge give this edge the second before theirs
    assert abs(seconds["late"] - seconds["plain"] - 250e-6) < 2e-6
    assert abs(seconds["next"] - seconds["plain"] + 1.0) < 2e-6


GSV = b"$GPGSV,1,1,02,02,41,106,45,05,30,200,44*7E\r\n"
CHANGED_S, BACK_S = 15, 30


def play_changing(assembly: Assembly, *, edges: bool, messages: bool) -> dict[str, list[str]]:
    """Play the recording with other sentences, without time, instead of all messages for 15 s.

    Return each source's states, one per second.
    """
    keeper, start_ns = assembly.timekeeper, assembly.clock.now_ns()
    units_seen, edge_seen = keeper.units_seen("gnss/rover"), keeper.edge_seen("pps/main")
    changed = (TimedUnit(at * SECOND_NS // 5, "gnss/rover", GSV) for at in range(CHANGED_S * 5, BACK_S * 5))
    kept = (unit for unit in played() if not CHANGED_S <= unit.time_ns / SECOND_NS < BACK_S)
    ticks = (TimedUnit(at * SECOND_NS + SECOND_NS // 2, "tick", b"") for at in range(SECONDS + 70))
    streams = [ticks, pps_units(SECONDS) if edges else (), *([changed, kept] if messages else [])]
    states: dict[str, list[str]] = {"gnss/rover": [], "pps/main": []}
    for sequence, unit in enumerate(merge(*streams, key=lambda unit: unit.time_ns)):
        host_ns = start_ns + unit.time_ns
        if unit.source == "tick":
            monotonic_ns = host_ns - assembly.clock.offset_ns
            sample = {"realtime_ns": host_ns, "monotonic_ns": monotonic_ns, "monotonic_raw_ns": monotonic_ns}
            keeper.clock_sample(sample, UNDISCIPLINED)
            for source, found in states.items():
                found.append(str(keeper.status(source, host_ns)["time_state"]))
        elif unit.source == "pps/main":
            edge_seen(host_ns, sequence)
        else:
            block = UnitBlock(np.frombuffer(unit.data, np.uint8)[np.newaxis, :])
            units_seen(np.array([host_ns], dtype=np.int64), block)
    return states


def told_of(caplog: pytest.LogCaptureFixture, *codes: str) -> list[str]:
    return [event.code for event in journal_of(caplog) if event.code in codes]


def test_a_receiver_that_changes_its_messages_is_reported_and_edges_keep_the_second(
    caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    caplog.set_level("INFO", "swath")
    assembly = assembled(tmp_path / "x")
    states = play_changing(assembly, edges=True, messages=True)
    assert set(states["gnss/rover"][12:SECONDS]) == {"LOCKED"}
    assert set(states["gnss/rover"][SECONDS + 6 : SECONDS + 30]) == {"HOLDOVER"}  # then there are no edges any more
    assert told_of(caplog, "time_messages_stopped", "time_messages_back", "second_ambiguous") == [
        "time_messages_stopped",
        "time_messages_back",
    ]


def test_time_without_pps_is_coarse_and_lost_a_minute_after_its_last_message(
    caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    caplog.set_level("INFO", "swath")
    assembly = assembled(tmp_path / "x")
    states = play_changing(assembly, edges=False, messages=True)
    assert states["gnss/rover"][0] == "NO_TIME"
    assert set(states["gnss/rover"][8 : SECONDS + 59]) == {"COARSE"}
    assert states["gnss/rover"][SECONDS + 62 :] == ["LOST"] * 8
    assert states["pps/main"] == states["gnss/rover"]  # they share the clock
    assert told_of(caplog, "time_messages_stopped") == ["time_messages_stopped"]  # at the end no data comes at all


def test_a_pps_without_time_messages_gives_no_second(caplog: pytest.LogCaptureFixture, tmp_path: Path) -> None:
    caplog.set_level("INFO", "swath")
    assembly = assembled(tmp_path / "x")
    states = play_changing(assembly, edges=True, messages=False)
    assert set(states["pps/main"]) == set(states["gnss/rover"]) == {"NO_TIME"}
    assert told_of(caplog, "second_known", "time_messages_stopped") == []


@pytest.mark.parametrize("broken", ["parser", "clock"])
def test_a_defect_in_time_keeping_is_reported_once_and_never_affects_the_recording(
    caplog: pytest.LogCaptureFixture, tmp_path: Path, broken: str
) -> None:
    caplog.set_level("INFO", "swath")
    assembly = assembled(tmp_path / "x")
    keeper = assembly.timekeeper

    def defect(*unused: object, **also: object) -> None:
        raise ZeroDivisionError("a defect")

    if broken == "parser":
        keeper._sources["gnss/rover"].parser.feed_batch = defect  # type: ignore[method-assign, assignment]
    else:
        for method in ("add_edge", "status", "set_wall_clock"):
            setattr(keeper._clocks["pps/main"], method, defect)
    play(assembly)
    told = [event for event in journal_of(caplog) if event.code == "time_parser_failed"]
    assert {event.source for event in told} == ({"gnss/rover"} if broken == "parser" else {"clock", "pps/main"})
    assert len(told) == len({event.source for event in told})
    assert keeper.status("pps/main", assembly.clock.now_ns())["time_state"] == "NO_TIME"
