"""Tests the session's states, with time and device controlled by the test."""

from __future__ import annotations

import threading
from itertools import pairwise

import pytest

from swath.drivers.session import FIRST_WAIT_S, LONGEST_WAIT_S, Session, SessionState
from swath.drivers.transports.base import UnitBlock
from tests.drivers.switch_transport import SwitchTransport


class Bench:
    """A session on transports with switches, whose clock advances by its own pauses."""

    def __init__(self) -> None:
        self.now_s = 100.0
        self.made: list[SwitchTransport] = []
        self.refuse_open = False
        self.raise_after: int | None = None
        self.changes: list[tuple[str, str]] = []
        self.pauses: list[float] = []
        self.session: Session[UnitBlock] = Session(
            self.make,
            on_change=lambda state, reason: self.changes.append((state.value, reason)),
            monotonic_s=lambda: self.now_s,
            pause=self.pause,
        )

    def make(self) -> SwitchTransport:
        transport = SwitchTransport()
        transport.refuse_open = self.refuse_open
        transport.raise_after = self.raise_after
        self.made.append(transport)
        return transport

    def pause(self, time_s: float) -> None:
        self.pauses.append(time_s)
        self.now_s += time_s

    def attempt_times(self, attempts: int) -> list[float]:
        """Return when the next ``attempts`` openings were tried, s."""
        times: list[float] = []
        while len(times) < attempts:
            made = len(self.made)
            self.session.receive(1e9)
            if len(self.made) > made:
                times.append(self.now_s)
        return times


@pytest.fixture
def bench() -> Bench:
    return Bench()


def state_of(session: Session[UnitBlock]) -> SessionState:
    return session.state


def numbers(blocks: list[UnitBlock]) -> list[int]:
    return [int.from_bytes(row.tobytes(), "big") for block in blocks for row in block.units]


def test_a_session_opens_on_the_first_receive_and_then_delivers(bench: Bench) -> None:
    assert state_of(bench.session) == SessionState.CLOSED
    assert bench.session.receive(0.1) == []
    assert state_of(bench.session) == SessionState.OPEN
    assert numbers(bench.session.receive(0.1)) == [1]
    assert bench.changes == [("opening", ""), ("open", "")]


def test_the_retry_delay_of_an_absent_device_doubles_up_to_its_limit(bench: Bench) -> None:
    bench.refuse_open = True
    times = bench.attempt_times(8)
    waits = [after - before for before, after in pairwise(times)]
    assert waits == [0.25, 0.5, 1.0, 2.0, 4.0, 5.0, 5.0]
    assert state_of(bench.session) == SessionState.WAITING
    assert bench.session.last_error == "switch: there is no device"


def test_an_unforeseen_error_on_opening_is_retried() -> None:
    """An error of the system while opening ends no thread, because the next try may succeed."""

    class Odd(SwitchTransport):
        def open(self) -> None:
            raise FileNotFoundError(2, "No such file or directory", "/dev/none")

    session: Session[UnitBlock] = Session(Odd, pause=lambda _: None)
    assert session.receive(0.1) == []
    assert state_of(session) == SessionState.WAITING
    assert session.last_error == "[Errno 2] No such file or directory: '/dev/none'"


def test_a_pause_is_never_longer_than_the_time_given(bench: Bench) -> None:
    bench.refuse_open = True
    for _ in range(200):
        bench.session.receive(0.1)
    assert max(bench.pauses) <= 0.1
    assert len(bench.made) > 3


def test_a_device_that_vanishes_is_reopened_when_it_returns(bench: Bench) -> None:
    bench.raise_after = 2
    bench.session.receive(0.1)
    assert numbers(bench.session.receive(0.1) + bench.session.receive(0.1)) == [1, 2]
    assert bench.session.receive(0.1) == []
    assert state_of(bench.session) == SessionState.WAITING
    assert bench.session.last_error == "switch: has gone"
    assert bench.made[0].closings == 1
    bench.raise_after = None
    bench.attempt_times(1)
    assert state_of(bench.session) == SessionState.OPEN
    assert numbers(bench.session.receive(0.1)) == [1]
    assert bench.session.openings == 2
    assert bench.changes == [
        ("opening", ""),
        ("open", ""),
        ("waiting", "switch: has gone"),
        ("opening", ""),
        ("open", ""),
    ]


def test_data_resets_the_retry_delay(bench: Bench) -> None:
    bench.refuse_open = True
    bench.attempt_times(6)
    bench.refuse_open = False
    bench.raise_after = 1
    bench.attempt_times(1)
    bench.session.receive(0.1)
    bench.session.receive(0.1)  # goes
    gone_s = bench.now_s
    assert bench.attempt_times(1)[0] - gone_s == FIRST_WAIT_S


def test_the_retry_delay_grows_while_a_device_closes_at_once(bench: Bench) -> None:
    bench.raise_after = 0
    times = bench.attempt_times(8)
    assert times[-1] - times[-2] == LONGEST_WAIT_S


def test_a_silent_device_that_was_open_long_is_retried_soon(bench: Bench) -> None:
    bench.refuse_open = True
    bench.attempt_times(6)
    bench.refuse_open = False
    bench.attempt_times(1)
    bench.made[-1].silent = True
    for _ in range(10):
        assert bench.session.receive(1.0) == []
        bench.now_s += 1.0
    assert state_of(bench.session) == SessionState.OPEN  # silence is no failure
    bench.made[-1].raise_after = 0
    bench.session.receive(1.0)
    gone_s = bench.now_s
    assert bench.attempt_times(1)[0] - gone_s == FIRST_WAIT_S


def test_counters_are_summed_over_openings(bench: Bench) -> None:
    bench.raise_after = 10
    bench.session.receive(0.1)
    bench.made[0].drop_every = 5
    bench.made[0].counters.receive_buffer_bytes = 1000
    units = [n for _ in range(11) for n in numbers(bench.session.receive(0.1))]
    assert units == [1, 2, 3, 4, 6, 7, 8, 9]
    assert bench.session.poll_counters().lost_kernel == 2
    bench.attempt_times(1)
    bench.made[1].counters.lost_kernel = 3
    bench.made[1].counters.receive_buffer_bytes = 2000
    counters = bench.session.poll_counters()
    assert counters.lost_kernel == 5
    assert counters.receive_buffer_bytes == 2000
    bench.session.close()
    assert bench.session.poll_counters() == counters


def test_send_works_while_open_and_raises_otherwise(bench: Bench) -> None:
    assert not bench.session.send(b"early")
    bench.session.receive(0.1)
    assert bench.session.send(b"now")
    assert bench.made[0].sent == [b"now"]
    bench.made[0].is_open = False
    assert not bench.session.send(b"late")
    assert bench.session.last_error == "switch: is closed"


def test_a_closed_session_delivers_and_opens_nothing(bench: Bench) -> None:
    bench.session.receive(0.1)
    bench.session.close()
    bench.session.close()
    assert state_of(bench.session) == SessionState.CLOSED
    assert bench.session.receive(0.1) == []
    assert len(bench.made) == 1
    assert bench.made[0].closings == 1
    assert bench.changes[-1] == ("closed", "")


def test_close_ends_the_wait_of_the_receiving_thread() -> None:
    transport = SwitchTransport()
    transport.refuse_open = True
    session = Session(lambda: transport)
    session.receive(0.0)
    session._attempt_at_s += 600.0
    thread = threading.Thread(target=session.receive, args=(600.0,))
    thread.start()
    session.close()
    thread.join(timeout=30.0)
    assert not thread.is_alive()
    assert state_of(session) == SessionState.CLOSED


def test_a_session_can_be_closed_while_a_stalled_device_is_read() -> None:
    transport = SwitchTransport()
    transport.stall_s = 0.3
    session = Session(lambda: transport)
    session.receive(0.0)
    thread = threading.Thread(target=session.receive, args=(0.0,))
    thread.start()
    session.close()
    thread.join(timeout=30.0)
    assert state_of(session) == SessionState.CLOSED
    assert transport.closings == 1
