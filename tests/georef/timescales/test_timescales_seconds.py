"""Tests that no second is wrong while LOCKED or HOLDOVER, over 1e5 simulated seconds with all faults.

The simulation (clock_simulation.py) has 23 ppm, a random walk of frequency of 2e-9/√s, and ramps of 0.5 ppm/min in some
cases; stamps of 1.5 µs or 300 µs; 1 % outliers of 300 µs, 2 to 10 % missing and 1 to 5 % spurious edges; messages 5 ms
to 0.9 s late with up to 20 % stalls of up to 1.5 s. A wrong second is an error above 0.5 s.
"""

from __future__ import annotations

import datetime as dt
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

from swath.georef.records import NamesEdge, TimeMessage, TimeScale, TimeTag
from swath.georef.timescales import PpsClock, TimeState
from tests.georef.clock_run import Outcome, run
from tests.georef.clock_simulation import (
    HOST_START_NS,
    NS,
    Edges,
    Oscillator,
    Sender,
    Simulation,
    gps_second,
    utc_tag,
    week_tag,
)
from tests.georef.timescales.builders import START, UTC, nmea, tim_tp

SECONDS = 3000
LEAP_AT = gps_second(dt.datetime(2028, 6, 30, 23, 59, 59, tzinfo=dt.UTC), 18) + 1
LOCKED, HOLDOVER, COARSE, NO_TIME = TimeState.LOCKED, TimeState.HOLDOVER, TimeState.COARSE, TimeState.NO_TIME


def time_gps(**more: Any) -> Sender:
    """Return a sender of week and time of week with leap seconds."""
    return Sender("NAV-TIMEGPS", week_tag(leap=18), **more)


@dataclass
class Case:
    """A scenario and its expected result; `steady` is the state of nearly all seconds after the first 30."""

    name: str
    senders: list[Sender]
    steady: TimeState = LOCKED
    edges: Edges = field(default_factory=Edges)
    assumed_leap: int | None = 18
    start: int = START
    ramps: bool = False
    events: tuple[str, ...] = ("second_known",)
    wall: Callable[[int, int], tuple[int, bool]] | None = None  # second, true GPS ns: realtime ns, disciplined

    def run(self) -> tuple[Simulation, Outcome]:
        """Return the simulation and the clock's outcome."""
        oscillator = Oscillator(SECONDS, seed=len(self.name), ramps=self.ramps)
        simulation = Simulation(self.start, oscillator, self.edges, self.senders, seed=len(self.name) + 7)
        clock = PpsClock(self.assumed_leap)

        def wall(second: int, host_ns: int) -> None:
            if self.wall is not None:
                realtime, disciplined = self.wall(second, simulation.true_gps_ns(host_ns))
                clock.set_wall_clock(host_ns, realtime, disciplined=disciplined, sigma_s=0.01)

        return simulation, run(simulation, clock, each_second=wall)


def unix_ns(gps_ns: int) -> int:
    """Return CLOCK_REALTIME, ns, of a GPS time with 18 leap seconds."""
    return gps_ns + (315_964_800 - 18) * NS


def stepped_wall(second: int, gps_ns: int) -> tuple[int, bool]:
    """Return a wall clock (ns) that claims discipline while it is stepped by ± 1 h and slewed by 100 ppm."""
    hours = 1 if 1000 <= second < 1500 else -1 if 2000 <= second < 2500 else 0
    return unix_ns(gps_ns) + hours * 3600 * NS + second * 100_000, True


def cold(second: int) -> bool:
    """Return False during the first minutes of a receiver, when it knows nothing yet."""
    return second >= 400


CASES = [
    Case("message 5 ms late", [Sender("RMC", UTC, delay_s=0.006, jitter_s=0.001)]),
    Case("messages 15 ms late", nmea(0.015, 0.002)),
    Case("messages 0.2 s late", nmea(0.2)),
    Case("message 0.6 s late with 0.1 s jitter", [Sender("RMC", UTC, delay_s=0.6, jitter_s=0.1)]),
    Case("2 % stalls to 1.5 s", nmea(0.1, stalls=0.02)),
    Case("20 % stalls to 1.5 s", nmea(0.3, stalls=0.2)),
    Case("20 % stalls to 1.5 s, slow line, GPS scale", [Sender("TIME", week_tag(), delay_s=0.5, stalls=0.2)]),
    Case("10 % missing, 5 % spurious", nmea(), edges=Edges(missing=0.1, spurious=0.05)),
    Case("user-space stamps", nmea(), edges=Edges(noise_ns=300e3, missing=0.1, spurious=0.05)),
    Case("ramps", nmea(stalls=0.1), ramps=True, edges=Edges(missing=0.05, spurious=0.05)),
    Case("ramps, user-space stamps", nmea(), ramps=True, edges=Edges(noise_ns=300e3)),
    Case("leap second, NMEA only", [Sender("RMC", utc_tag(18, LEAP_AT))], start=LEAP_AT - 1500),
    Case(
        "leap second, said", [Sender("PVT", utc_tag(18, LEAP_AT, said=True))], start=LEAP_AT - 1500, assumed_leap=None
    ),
    Case(
        "leap second, NMEA beside a receiver that says",
        [Sender("RMC", utc_tag(18, LEAP_AT)), Sender("PVT", utc_tag(18, LEAP_AT, said=True))],
        start=LEAP_AT - 1500,
        events=("second_known",),
    ),
    Case("week 2047 to 2048", [Sender("TIME", week_tag())], start=2048 * 604_800 - 1500),
    Case("week 4095 to 4096", [Sender("TIME", week_tag())], start=4096 * 604_800 - 1500),
    Case(
        "week turns over 5 s later than the time of week",
        [Sender("TIME", week_tag(), error_s=lambda s: -604_800 if 1500 <= s < 1505 else 0)],
        start=2048 * 604_800 - 1500,
    ),
    Case("hour and day wrap, no date beside", [*nmea(), Sender("GGA", utc_tag(18, dated=False))], start=START + 41_700),
    Case(
        "cold start: invalid and wrong until the receiver knows",
        nmea(valid=cold, error_s=lambda s: 0 if cold(s) else -3),
        events=("second_known",),
    ),
    Case(
        "cold start: default leap count, then said",
        [
            *nmea(error_s=lambda s: 0 if s >= 700 else 2),
            Sender("NAV-TIMEGPS", lambda s: week_tag(leap=18 if s >= START + 700 else None)(s)),
        ],
        events=("second_ambiguous", "second_known"),
    ),
    Case("leap unknown", nmea(), COARSE, assumed_leap=None, events=("leap_unknown",)),
    Case(
        "assumed leap count too small, then said",
        [*nmea(), time_gps(silent=lambda s: s < 700)],
        assumed_leap=17,
        events=("leap_unknown", "leap_seconds_changed", "second_known"),
    ),
    Case("steady 0.8 s", [Sender("RMC", UTC, delay_s=0.8)], COARSE, events=("second_ambiguous",)),
    Case("0.9 s with 0.08 s jitter", [Sender("RMC", UTC, delay_s=0.9, jitter_s=0.08)], COARSE),
    Case(
        "straddling: one sentence before the next edge, one after",
        [Sender("RMC", UTC, delay_s=0.96), Sender("ZDA", UTC, delay_s=1.04)],
        COARSE,
        events=("second_ambiguous",),
    ),
    Case("steady 0.8 s, bound message decides", [*nmea(0.8), tim_tp()]),
    Case("steady 0.85 s, wall clock decides", nmea(0.85), wall=lambda _, gps: (unix_ns(gps), True)),
    Case("steady 1.2 s, wall clock decides", nmea(1.2), wall=lambda _, gps: (unix_ns(gps), True)),
    Case("steady 0.8 s, wall clock not disciplined", nmea(0.8), COARSE, wall=lambda _, gps: (unix_ns(gps), False)),
    Case("wall clock stepped and slewed", nmea(), wall=stepped_wall),
    Case(
        "two receivers contradict",
        [*nmea(), Sender("RMC", UTC, source="gnss/base", error_s=lambda s: 1)],
        COARSE,
        events=("second_ambiguous",),
    ),
    Case(
        "two receivers contradict, bound message decides",
        [*nmea(), Sender("RMC", UTC, source="gnss/base", error_s=lambda s: 1), tim_tp()],
    ),
    Case("PPS without time", [], NO_TIME, events=()),
    Case("time without PPS", nmea(), COARSE, edges=Edges(silent=lambda s: True), events=()),
    Case(
        "inverted polarity: edges 0.1 s late",
        nmea(0.04),
        COARSE,
        edges=Edges(late_s=lambda s: 0.1),
        events=("second_ambiguous",),
    ),
]


def expected_events(case: Case) -> tuple[str, ...]:
    """Return the named events, and for COARSE by delay its reason."""
    return ("second_ambiguous",) if case.steady is COARSE and case.events == ("second_known",) else case.events


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_no_second_is_wrong(case: Case) -> None:
    """The steady state is as expected, and the log gives the reason."""
    _, outcome = case.run()
    assert outcome.wrong_seconds == 0
    late = outcome.counts(720 if case.name.startswith(("cold", "assumed")) else 30)
    assert late[case.steady] >= 0.995 * late.total(), late
    if case.steady is not LOCKED:
        assert not outcome.seconds, "never LOCKED"
    for code in expected_events(case):
        assert code in outcome.codes


def test_the_simulated_time_is_long_enough() -> None:
    """The cases above simulate 1e5 seconds together."""
    assert len(CASES) * SECONDS >= 100_000


def simulate(
    senders: list[Sender], edges: Edges | None = None, clock: PpsClock | None = None, seconds: int = 2500
) -> tuple[Simulation, Outcome]:
    """Run one simulation."""
    simulation = Simulation(START, Oscillator(seconds, seed=5), edges or Edges(), senders, seed=11)
    return simulation, run(simulation, clock or PpsClock(18))


def test_holdover_follows_when_edges_stop_and_lock_returns_with_them() -> None:
    """The sigma grows in HOLDOVER; when edges return the state is LOCKED at once, without a new label."""
    _, outcome = simulate(nmea(), Edges(silent=lambda s: 1000 <= s < 1900))
    assert outcome.wrong_seconds == 0
    assert outcome.counts(1010, 1890) == {HOLDOVER: 880}
    assert outcome.counts(1910)[LOCKED] == len(outcome.states) - 1910
    at = outcome.seconds.index(1100)
    assert outcome.sigmas_ns[at] < outcome.sigmas_ns[at + 300] < outcome.sigmas_ns[at + 700]
    assert outcome.codes == ["second_known"]


def test_holdover_ends_in_lost_when_the_sigma_passes_its_limit() -> None:
    """Beyond the limit time is still given, with its sigma."""
    clock = PpsClock(18, lost_sigma_ns=20_000.0)
    _, outcome = simulate(nmea(), Edges(silent=lambda s: s >= 1000), clock)
    states = outcome.counts(1000)
    assert states[HOLDOVER] > 30
    assert outcome.states[-1] is TimeState.LOST
    assert max(outcome.sigmas_ns) <= 20_000.0


def test_a_receiver_restart_with_pulses_off_phase_gives_holdover() -> None:
    """A restarting receiver pulses at any phase and marks its time invalid; afterwards the state is as before."""
    edges = Edges(late_s=lambda s: 0.37 if 1000 <= s < 1100 else 0.0)
    _, outcome = simulate(nmea(valid=lambda s: not 1000 <= s < 1110), edges)
    assert outcome.wrong_seconds == 0
    assert outcome.counts(1010, 1098) == {HOLDOVER: 88}
    assert outcome.counts(1110)[LOCKED] == len(outcome.states) - 1110
    assert outcome.codes == ["second_known"]


@pytest.mark.parametrize("sender", ["bound to the edge before", "bound to the next edge", "NMEA"])
@pytest.mark.parametrize("phase_s", [0.2, 0.45, 0.55, 0.8])
@pytest.mark.parametrize("found_s", [5, 7, 12, 40])
def test_pulses_before_a_receiver_has_time_name_no_second(sender: str, phase_s: float, found_s: int) -> None:
    """Until a receiver has time, its pulses have any phase and its messages are invalid; then both are right."""
    known: dict[str, Any] = {"valid": lambda s: s >= found_s}
    senders = {
        "bound to the edge before": [Sender("TIME", week_tag(), bound=True, delay_s=0.1, **known)],
        "bound to the next edge": [
            Sender("TIM-TP", week_tag(), names_edge=NamesEdge.NEXT, bound=True, delay_s=0.1, **known)
        ],
        "NMEA": nmea(**known),
    }[sender]
    edges = Edges(late_s=lambda s: phase_s if s < found_s else 0.0)
    _, outcome = simulate(senders, edges, seconds=300)
    assert np.abs(outcome.errors_ns).max() < 2e6
    assert outcome.counts(found_s + 60) == {LOCKED: len(outcome.states) - found_s - 60}
    assert "second_ambiguous" not in outcome.codes


def contradicted(free_s: int, seconds: int) -> Outcome:
    """Return a run with a receiver that calls its time valid while its pulses are wrong, then moves them by 0.8 s."""
    edges = Edges(late_s=lambda s: 0.2 if s < free_s else 0.0)
    return simulate([Sender("TIME", week_tag(), bound=True, delay_s=0.1)], edges, seconds=seconds)[1]


def test_new_edges_replace_ended_ones_after_twice_their_duration() -> None:
    """The contradiction is reported once; new edges take over, with an event, after twice the duration."""
    outcome = contradicted(100, 600)
    assert outcome.codes == ["second_known", "second_ambiguous", "relabelled"]
    (_, at), (taken_over_s, text) = [(s, text) for s, code, text in outcome.events if code != "second_known"]
    assert "-0.8 s off" in at
    assert 280 < taken_over_s < 330  # 100 s, then twice as many new edges; some are missing, some fit by chance
    assert "-0.8 s" in text
    assert outcome.counts(120, taken_over_s - 1) == {COARSE: taken_over_s - 121}
    assert outcome.counts(taken_over_s + 1)[LOCKED] == len(outcome.states) - taken_over_s - 1
    late = np.array(outcome.seconds) > taken_over_s
    assert np.abs(np.array(outcome.errors_ns)[late]).max() < 1e5


def test_labels_from_rejected_edges_are_doubtful_in_post_processing() -> None:
    outcome = contradicted(100, 600)
    host_ns = np.array([HOST_START_NS + 50 * NS, HOST_START_NS + 500 * NS])
    _, sigma_ns = outcome.clock.gps_from_host(host_ns)
    assert sigma_ns[0] >= 1e9 > 1e5 > sigma_ns[1]


def test_edges_at_a_new_phase_are_relocked_and_logged() -> None:
    """The edges move by 0.1 s, as if the polarity were swapped, and stay; the log says by how much."""
    _, outcome = simulate(nmea(0.3), Edges(late_s=lambda s: 0.1 if s >= 1000 else 0.0))
    assert outcome.wrong_seconds == 0
    assert "pps_relocked" in outcome.codes
    assert "-100.0" in next(text for _, code, text in outcome.events if code == "pps_relocked")
    assert outcome.counts(1100)[LOCKED] == len(outcome.states) - 1100


def test_a_restarted_receiver_with_a_wrong_valid_time_makes_the_state_coarse() -> None:
    """A valid time that is one second off does not change the label; the state is COARSE until both agree again."""
    _, outcome = simulate(nmea(error_s=lambda s: -1 if 1000 <= s < 1100 else 0))
    assert outcome.wrong_seconds == 0
    assert outcome.counts(1020, 1099) == {COARSE: 79}
    assert outcome.codes == ["second_known", "second_ambiguous", "second_confirmed"]
    assert outcome.counts(1120)[LOCKED] == len(outcome.states) - 1120


def default_leap_count(seconds_ahead: int, wall: Callable[[int], int] | None) -> Outcome:
    """Return a run with NMEA alone, valid from the start, whose leap count is too small until second 700."""
    senders = nmea(error_s=lambda s: 0 if s >= 700 else seconds_ahead)
    simulation = Simulation(START, Oscillator(1500, seed=5), Edges(), senders, seed=11)
    clock = PpsClock(18)

    def set_wall(_: int, host_ns: int) -> None:
        if wall is not None:
            realtime_ns = unix_ns(wall(simulation.true_gps_ns(host_ns)))
            clock.set_wall_clock(host_ns, realtime_ns, disciplined=True, sigma_s=0.01)

    return run(simulation, clock, each_second=set_wall)


@pytest.mark.parametrize("seconds_ahead", [1, 2, 18])
def test_a_synchronised_wall_clock_reveals_a_default_leap_count(seconds_ahead: int) -> None:
    """The state is COARSE, with the reason, until the receiver knows the count, and never LOCKED on a wrong second."""
    outcome = default_leap_count(seconds_ahead, lambda gps_ns: gps_ns)
    assert outcome.wrong_seconds == 0
    assert outcome.counts(30, 700) == {COARSE: 670}
    assert outcome.counts(730)[LOCKED] == len(outcome.states) - 730
    assert outcome.codes == ["second_ambiguous", "second_confirmed", "second_known"]
    assert f"{seconds_ahead:+d} s against the disciplined wall clock: its leap seconds?" in outcome.events[0][2]


def test_an_uncontradicted_default_leap_count_is_used_until_a_new_one_outlasts_it() -> None:
    """No software can detect this alone (docs/time.md).

    When the count changes, the state is COARSE, with events, until the new one has lasted longer than the old one.
    """
    outcome = default_leap_count(2, None)
    assert outcome.counts(30, 700) == {LOCKED: 670}
    assert outcome.codes == ["second_known", "second_ambiguous", "relabelled", "second_confirmed"]
    assert "-2 s against the second held" in outcome.events[1][2]
    moved_s = outcome.events[2][0]
    assert 1350 < moved_s < 1450
    assert outcome.counts(730, moved_s) == {COARSE: moved_s - 730}
    assert outcome.counts(moved_s + 2) == {LOCKED: len(outcome.states) - moved_s - 2}
    late = np.array(outcome.seconds) > moved_s
    assert np.abs(np.array(outcome.errors_ns)[late]).max() < 1e5


def test_a_wall_clock_of_another_hour_changes_nothing() -> None:
    outcome = default_leap_count(0, lambda gps_ns: gps_ns - 3600 * NS)
    assert outcome.wrong_seconds == 0
    assert outcome.counts(30)[LOCKED] == len(outcome.states) - 30


def test_a_reported_leap_count_relabels_all_seconds_in_one_logged_step() -> None:
    """18 replaces the assumed 19: two events are logged, and all seconds since lock move together, with the history."""
    senders = [Sender("RMC", UTC), time_gps(silent=lambda s: s < 500)]
    clock = PpsClock(19, keep_history=True)
    simulation, outcome = simulate(senders, clock=clock, seconds=1000)
    assert outcome.codes == ["second_known", "leap_seconds_changed", "relabelled"]
    assert [second for second, _, _ in outcome.events[1:]] == [500, 500]
    hosts = np.array([simulation.host_ns(s + 0.25) for s in range(10, 900)])
    truth = np.array([simulation.true_gps_ns(int(host)) for host in hosts])
    assert np.max(np.abs(clock.gps_from_host(hosts)[0] - truth)) < 10_000
    status = clock.status(simulation.host_ns(900))
    assert (status.leap_seconds, status.leap_origin) == (18, "receiver")


def test_a_bound_message_corrects_a_label_and_is_logged() -> None:
    """Messages 1.2 s late look 0.2 s late, which is undetectable until TIM-TP comes and moves the label."""
    senders = [*nmea(1.2), tim_tp()]
    senders[-1].silent = lambda s: s < 500
    _, outcome = simulate(senders, seconds=1000)
    assert "relabelled" in outcome.codes
    errors = [error for second, error in zip(outcome.seconds, outcome.errors_ns, strict=True) if second > 520]
    assert max(abs(error) for error in errors) < 10_000
    assert outcome.counts(520)[LOCKED] == len(outcome.states) - 520


def test_messages_that_become_late_do_not_change_a_held_label() -> None:
    """Edges carry the label on; a delay that grows from 0.3 s to 0.85 s only causes a warning."""
    early = [Sender("RMC", UTC, delay_s=0.3, silent=lambda s: s >= 500)]
    late = [Sender("RMC", UTC, delay_s=0.85, silent=lambda s: s < 500)]
    _, outcome = simulate([*early, *late], seconds=1000)
    assert outcome.wrong_seconds == 0
    assert outcome.codes == ["second_known", "messages_late"]
    assert outcome.counts(20) == {LOCKED: len(outcome.states) - 20}


def test_the_leap_second_table_suffices_where_it_reaches() -> None:
    """The built-in table covers UTC of 2019 without configuration; a contradicting configured count is a guess."""
    start = gps_second(dt.datetime(2019, 5, 1, tzinfo=dt.UTC), 18)

    def last(assumed: int | None) -> tuple[TimeState, str]:
        simulation = Simulation(start, Oscillator(100, seed=5), Edges(), nmea(), seed=11)
        clock = run(simulation, PpsClock(assumed)).clock
        status = clock.status(simulation.host_ns(98.5))
        return status.state, status.leap_origin

    assert last(None) == (LOCKED, "table")
    assert last(18) == (LOCKED, "configured")
    assert last(16) == (COARSE, "guess")


def test_edges_may_arrive_after_their_messages() -> None:
    """The PPS thread wakes 80 ms late, so messages 15 ms after an edge are received before the edge."""
    simulation = Simulation(START, Oscillator(300, seed=5), Edges(), nmea(0.015, 0.001), seed=11)
    told = sorted(simulation, key=lambda event: event[0] + (NS * 80 // 1000 if event[1] == "edge" else 0))
    assert [event[1] for event in told[:4]] != [event[1] for event in list(simulation)[:4]]
    clock = PpsClock(18)
    for host_ns, _, source, message in told:
        if message is None:
            clock.add_edge(host_ns, 0)
        else:
            clock.add_message(source, message)
    host = simulation.host_ns(297.9)
    status = clock.status(host)
    assert status.state is LOCKED
    assert status.offset_ns is not None
    assert abs(host + status.offset_ns - simulation.true_gps_ns(host)) < 10_000
    assert [event.code for event in clock.drain_events()] == ["second_known"]


def test_the_named_edge_can_be_configured() -> None:
    """The sentence of this receiver names the next edge, as configured, and the second is right."""
    senders = [Sender("ZDA", UTC, delay_s=0.3, error_s=lambda s: 1)]
    simulation = Simulation(START, Oscillator(100, seed=5), Edges(), senders, seed=11)
    outcome = run(simulation, PpsClock(18, names_edge=NamesEdge.NEXT))
    assert outcome.wrong_seconds == 0
    assert outcome.states[-1] is LOCKED


def test_delay_is_subtracted() -> None:
    """A configured delay of cable and capture of 5 µs disappears from the errors."""
    simulation = Simulation(
        START, Oscillator(300, seed=5), Edges(noise_ns=50.0, late_s=lambda s: 5e-6), nmea(), seed=11
    )
    biased, right = run(simulation, PpsClock(18)), run(simulation, PpsClock(18, delay_ns=5000))
    assert np.mean(biased.errors_ns[100:]) == pytest.approx(-5000, abs=100)
    assert np.mean(right.errors_ns[100:]) == pytest.approx(0, abs=100)


def test_coarse_time_is_accurate_to_half_a_second() -> None:
    """Without PPS the time is within its ± 0.5 s for any delay up to 0.7 s."""
    for delay in (0.01, 0.2, 0.5, 0.7):
        simulation, outcome = simulate([Sender("RMC", UTC, delay_s=delay)], Edges(silent=lambda s: True), seconds=200)
        host = simulation.host_ns(150.3)
        status = outcome.clock.status(host)
        assert status.offset_ns is not None
        assert abs(host + status.offset_ns - simulation.true_gps_ns(host)) < NS // 2
        assert status.sigma_ns == pytest.approx(0.3 * NS)


def test_quantisation_of_the_edge_is_subtracted() -> None:
    """qErr of TIM-TP belongs to the edge that it names; corrected edges fit several times better."""
    errors = np.rint(np.random.default_rng(3).uniform(-100.0, 100.0, 602))

    def noise(told: bool) -> float:
        clock = PpsClock(18)
        for second in range(600):
            host = 10**12 + second * (NS + 23_000)
            week, of_week = divmod(START + second + 1, 604_800)
            clock.add_edge(host + int(errors[second]), second)
            tag = TimeTag(TimeScale.GPS, of_week * NS, week)
            quantisation = float(errors[second + 1]) if told else 0.0
            message = TimeMessage(host + NS // 10, tag, NamesEdge.NEXT, bound=True, quantisation_ns=quantisation)
            clock.add_message("gnss/rover", message)
        noise_ns = clock.status(10**12 + 600 * NS).noise_ns
        assert noise_ns is not None
        return noise_ns

    assert noise(told=False) == pytest.approx(200.0 / 12**0.5, rel=0.25)
    assert noise(told=True) < 10.0


def test_quantisation_received_after_the_edge_corrects_it() -> None:
    """A message that names the previous edge corrects it afterwards, as if it had been known before."""
    errors = np.rint(np.random.default_rng(4).uniform(-100.0, 100.0, 602))
    clock = PpsClock(18)
    for second in range(600):
        host = 10**12 + second * (NS + 23_000)
        week, of_week = divmod(START + second, 604_800)
        clock.add_edge(host + int(errors[second]), second)
        tag = TimeTag(TimeScale.GPS, of_week * NS, week)
        message = TimeMessage(
            host + NS // 10, tag, NamesEdge.PREVIOUS, bound=True, quantisation_ns=float(errors[second])
        )
        clock.add_message("gnss/rover", message)
    host = 10**12 + 599 * (NS + 23_000)
    gps, _ = clock.gps_from_host(np.array([host]))
    assert abs(int(gps[0]) - (START + 599) * NS) < 15
