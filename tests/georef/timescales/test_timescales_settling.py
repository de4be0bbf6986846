"""Tests that the second after the flight is that of most messages, and in flight its source may withdraw it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from swath.georef.timescales import PpsClock, TimeState
from tests.georef.clock_run import Outcome, run
from tests.georef.clock_simulation import NS, Edges, Oscillator, Sender, Simulation, utc_tag, week_tag
from tests.georef.timescales.builders import START, nmea, tim_tp

SECONDS = 300
UTC = utc_tag(18)


def flown(
    senders: list[Sender], *, seconds: int = SECONDS, edges: Edges | None = None
) -> tuple[Simulation, Outcome, PpsClock]:
    """Run a clock that keeps its history, and return the simulation, its outcome and the clock."""
    simulation = Simulation(START, Oscillator(seconds, seed=5), edges or Edges(), senders, seed=11)
    clock = PpsClock(18, keep_history=True)
    return simulation, run(simulation, clock), clock


def errors_s(simulation: Simulation, clock: PpsClock, from_s: int = 8, to_s: int = SECONDS - 2) -> tuple[Any, Any]:
    """Return errors and sigmas, s, of all seconds, computed after the flight."""
    hosts = np.array([simulation.host_ns(second + 0.25) for second in range(from_s, to_s)], np.int64)
    truth = np.array([simulation.true_gps_ns(int(host)) for host in hosts])
    gps_ns, sigma_ns = clock.gps_from_host(hosts)
    return (gps_ns - truth) / NS, sigma_ns / NS


@pytest.mark.parametrize("error_s", [1, 20, -1, 3600])
@pytest.mark.parametrize("wrong_s", [20, 60, 140])
def test_wrong_seconds_at_the_start_are_corrected_after_the_flight(error_s: int, wrong_s: int) -> None:
    simulation, _, clock = flown(nmea(error_s=lambda s: error_s if s < wrong_s else 0))
    (line,) = clock.settle()
    wrong, sigma = errors_s(simulation, clock)
    assert np.abs(wrong).max() < 1e-4
    assert sigma.max() < 1e-3
    named, total = (int(word) for word in line.split(":")[1].split(" messages")[0].split(" of "))
    assert line.startswith("gnss/rover: ")
    assert abs(named - (SECONDS - wrong_s)) <= 5
    assert abs(total - SECONDS) <= 5
    assert f"name a second {error_s:+d} s from it; these are corrected" in line
    assert ("the majority is small, so all times may be off by that" in line) == (named < 0.75 * total)


@pytest.mark.parametrize("error_s", [1, -1, 20])
def test_only_the_tags_of_the_wrong_stretch_are_corrected(error_s: int) -> None:
    """The arrival of each tag decides; messages that were delayed for more than a second are right all the same."""
    simulation, _, clock = flown(nmea(error_s=lambda s: error_s if s < 60 else 0, stalls=0.05))
    clock.settle()
    hosts = np.array([simulation.host_ns(second + 0.22) for second in range(10, SECONDS - 10)], np.int64)
    found = clock.tag_error_s("gnss/rover", hosts, utc=True)
    assert found[:40].tolist() == [error_s] * 40
    assert found[60:].tolist() == [0] * len(found[60:])
    assert clock.tag_error_s("gnss/rover", hosts, utc=False).tolist() == [0] * len(hosts)
    assert clock.tag_error_s("gnss/other", hosts, utc=True).tolist() == [0] * len(hosts)


def test_a_wrong_stretch_in_flight_is_not_doubtful_after_settling() -> None:
    simulation, outcome, clock = flown(nmea(error_s=lambda s: 1 if 100 <= s < 150 else 0))
    assert "second_ambiguous" in outcome.codes
    _, before = errors_s(simulation, clock)
    assert before.max() >= 1.0
    assert len(clock.settle()) == 1
    wrong, sigma = errors_s(simulation, clock)
    assert np.abs(wrong).max() < 1e-4
    assert sigma.max() < 1e-3


def test_a_flight_without_contradictions_is_unchanged_and_gives_no_event() -> None:
    simulation, _, clock = flown(nmea(stalls=0.1))
    before = errors_s(simulation, clock)
    assert clock.settle() == []
    after = errors_s(simulation, clock)
    assert np.array_equal(before[0], after[0])
    assert np.array_equal(before[1], after[1])


def test_receivers_that_always_contradict_each_other_are_not_outvoted() -> None:
    """Two kinds of messages of one receiver against one of another decide nothing; the refusal can name both."""
    senders = [*nmea(), Sender("RMC", UTC, source="gnss/base", error_s=lambda s: 1)]
    simulation, _, clock = flown(senders)
    assert clock.settle() == []
    _, sigma = errors_s(simulation, clock)
    assert sigma.min() >= 0.3
    assert clock.status(simulation.host_ns(SECONDS - 2)).state is TimeState.COARSE


def test_receivers_that_contradict_each_other_in_succession_are_refused() -> None:
    """The second receiver begins minutes after the first and names another second, so neither can be trusted."""
    senders = [
        *nmea(silent=lambda s: s >= 100),
        Sender("RMC", UTC, source="gnss/base", error_s=lambda s: 1, silent=lambda s: s < 180),
    ]
    simulation, _, clock = flown(senders)
    clock.settle()
    status = clock.status(simulation.host_ns(SECONDS - 2))
    assert "name a second" in status.ambiguous
    assert "gnss/base RMC" in status.ambiguous
    assert errors_s(simulation, clock)[1].min() >= 1.0


def test_messages_bound_to_their_edges_outvote_any_number_of_others() -> None:
    senders = [*nmea(1.2), tim_tp()]
    senders[-1].silent = lambda s: s < 200
    simulation, _, clock = flown(senders)
    clock.settle()
    assert np.abs(errors_s(simulation, clock)[0]).max() < 1e-4


def test_seconds_of_restarted_edges_are_settled_with_earlier_ones_of_the_same_phase() -> None:
    """The edges pause and return at the same phase; only the earlier ones had a wrong label at the start."""
    edges = Edges(late_s=lambda s: 0.1 if 40 <= s < 60 else 0.0)
    simulation, _, clock = flown(nmea(0.3, error_s=lambda s: 1 if s < 30 else 0), edges=edges)
    clock.settle()
    wrong, _ = errors_s(simulation, clock, from_s=80)
    assert np.abs(wrong).max() < 1e-4


def test_a_label_moves_in_flight_when_contradiction_outlasts_support() -> None:
    simulation, outcome, clock = flown(nmea(error_s=lambda s: 20 if s < 60 else 0))
    assert outcome.codes == ["second_known", "second_ambiguous", "relabelled", "second_confirmed"]
    at_s, text = next((second, text) for second, code, text in outcome.events if code == "relabelled")
    assert 115 <= at_s <= 130
    assert "-20 s" in text
    assert "name it" in text
    assert TimeState.LOCKED not in outcome.counts(75, at_s - 1)
    assert outcome.counts(at_s + 2)[TimeState.LOCKED] == len(outcome.states) - at_s - 2
    late = np.array(outcome.seconds) > at_s
    assert np.abs(np.array(outcome.errors_ns)[late]).max() < 1e5
    assert clock.status(simulation.host_ns(SECONDS - 2)).state is TimeState.LOCKED


def test_in_flight_a_label_is_not_moved_by_another_source() -> None:
    """The source that gave the label has become silent; another that names another second contradicts it."""
    senders = [
        *nmea(silent=lambda s: s >= 30),
        Sender("TIME", week_tag(), source="gnss/base", error_s=lambda s: 1, silent=lambda s: s < 30),
    ]
    _, outcome, _ = flown(senders)
    assert "relabelled" not in outcome.codes
    assert outcome.counts(120) == {TimeState.COARSE: len(outcome.states) - 120}
