"""Tests the backlog between wires' threads and their reader, and the thread of a wire."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Iterator

import pytest

from swath.drivers.listening import Backlog, BusyError, Listener, LoopReader, Measured, Overflow
from swath.drivers.session import Session
from swath.drivers.transports.base import TransportError, UnitBlock
from tests.drivers.switch_transport import SwitchTransport


def item(number: int, size: int = 10, units: int = 1) -> Measured[int]:
    return Measured(number, size, units, size)


def popped(backlog: Backlog[int]) -> Iterator[int]:
    while (found := backlog.pop()) is not None:
        yield found


def test_items_of_several_wires_come_in_order_of_arrival() -> None:
    backlog: Backlog[int] = Backlog(100, Overflow.WAIT)
    for number in range(6):
        backlog.put("ab"[number % 2], item(number))
    assert list(popped(backlog)) == list(range(6))


def test_the_oldest_of_a_full_wire_go_and_are_counted_in_units() -> None:
    """The other wire loses nothing; an item that is larger than the limit finds room in an empty lane."""
    backlog: Backlog[int] = Backlog(30, Overflow.DROP)
    backlog.put("slow", item(100))
    for number in range(10):
        assert backlog.put("fast", item(number, units=2)) == 0.0
    assert list(popped(backlog)) == [100, 7, 8, 9]
    assert (backlog.dropped("fast"), backlog.dropped("slow"), backlog.dropped("unknown")) == (14, 0, 0)
    backlog.put("fast", item(1, size=99))
    assert list(popped(backlog)) == [1]


def test_a_full_wire_waits_for_its_reader_and_loses_nothing() -> None:
    backlog: Backlog[int] = Backlog(30, Overflow.WAIT)
    waited: list[float] = []
    thread = threading.Thread(target=lambda: waited.extend(backlog.put("a", item(n)) for n in range(20)))
    thread.start()
    found: list[int] = []
    while len(found) < 20:
        time.sleep(0.005)
        found += [one for one in [backlog.pop()] if one is not None]
    thread.join()
    assert found == list(range(20))
    assert sum(waited) > 0.01
    assert backlog.dropped("a") == 0


def test_closing_frees_a_waiting_thread_and_keeps_what_came_before() -> None:
    backlog: Backlog[int] = Backlog(10, Overflow.WAIT)
    backlog.put("a", item(1))
    thread = threading.Thread(target=backlog.put, args=("a", item(2)))
    thread.start()
    time.sleep(0.02)
    backlog.close()
    thread.join(5.0)
    assert not thread.is_alive()
    assert list(popped(backlog)) == [1]


def test_a_reader_is_woken_once_for_many_items() -> None:
    wakes: list[int] = []
    backlog: Backlog[int] = Backlog(10_000, Overflow.WAIT, lambda: wakes.append(1))
    assert backlog.pop() is None
    for number in range(100):
        backlog.put("a", item(number))
    assert len(wakes) == 1
    assert len(list(popped(backlog))) == 100
    backlog.close()
    assert len(wakes) == 2


def test_an_error_comes_after_the_items_before_it() -> None:
    backlog: Backlog[int] = Backlog(100, Overflow.WAIT)
    backlog.put("a", item(1))
    backlog.fail(ZeroDivisionError("a defect"))
    assert backlog.pop() == 1
    with pytest.raises(ZeroDivisionError):
        backlog.pop()


class TestLoopReader:
    async def test_a_cancelled_task_takes_no_item_along(self) -> None:
        reader: LoopReader[int] = LoopReader(100, Overflow.WAIT)
        for number in range(3):
            task = asyncio.create_task(reader.take())
            await asyncio.sleep(0)  # the task is in its pause, or waits
            reader.backlog.put("a", item(number))
            task.cancel()
            with pytest.raises(asyncio.CancelledError):
                await task
        reader.backlog.close()
        assert [await reader.take() for _ in range(4)] == [0, 1, 2, None]

    async def test_a_reader_that_is_behind_leaves_the_loop_to_others(self) -> None:
        reader: LoopReader[int] = LoopReader(10_000, Overflow.WAIT)
        for number in range(50):
            reader.backlog.put("a", item(number))
        turns = 0

        async def other() -> None:
            nonlocal turns
            while True:
                turns += 1
                await asyncio.sleep(0)

        task = asyncio.create_task(other())
        for _ in range(50):
            await reader.take()
        task.cancel()
        assert turns >= 49

    async def test_two_tasks_cannot_read_at_once(self) -> None:
        reader: LoopReader[int] = LoopReader(100, Overflow.WAIT)
        task = asyncio.create_task(reader.take())
        await asyncio.sleep(0.01)
        with pytest.raises(BusyError, match="another task already reads"):
            await reader.take()
        reader.backlog.close()
        assert await task is None


def numbers(blocks: list[UnitBlock], late: bool) -> Measured[tuple[int, bool]]:
    (block,) = blocks
    time.sleep(0.001)
    return Measured((int.from_bytes(block.units.tobytes(), "big"), late), 10, 1, 4)


class TestListener:
    @pytest.fixture
    def transports(self) -> list[SwitchTransport]:
        return []

    def listener(
        self, transports: list[SwitchTransport], backlog: Backlog[tuple[int, bool]], **switches: object
    ) -> Listener[UnitBlock, tuple[int, bool]]:
        def make() -> SwitchTransport:
            transports.append(SwitchTransport())
            for name, value in switches.items():
                setattr(transports[-1], name, value)
            return transports[-1]

        return Listener("a", lambda told: Session(make, on_change=told), backlog, numbers)

    def test_a_lost_device_is_opened_again(self, transports: list[SwitchTransport]) -> None:
        backlog: Backlog[tuple[int, bool]] = Backlog(1 << 20, Overflow.WAIT)
        listener = self.listener(transports, backlog, raise_after=5)
        assert listener.state == "opening"
        listener.start()
        found: list[int] = []
        while len(found) < 12:
            time.sleep(0.005)
            found += [one[0] for one in [backlog.pop()] if one is not None]
        assert found == [1, 2, 3, 4, 5, 1, 2, 3, 4, 5, 1, 2]
        assert listener.session.openings >= 3
        listener.stop()
        listener.join(5.0)
        assert (listener.is_alive(), listener.state) == (False, "closed")
        assert sum(transport.is_open for transport in transports) == 0
        assert listener.units == listener.bytes // 4 >= 12

    def test_bytes_that_lay_in_the_kernel_are_told_as_late(self, transports: list[SwitchTransport]) -> None:
        backlog: Backlog[tuple[int, bool]] = Backlog(20, Overflow.WAIT)
        listener = self.listener(transports, backlog)
        listener.start()
        time.sleep(0.3)  # the lane is full, and the thread waits
        backlog.pop()
        time.sleep(0.05)
        backlog.pop()
        time.sleep(0.05)
        listener.stop()
        backlog.close()
        listener.join(5.0)
        assert list(popped_late(backlog)) == [(3, False), (4, True)]

    def test_a_defect_reaches_the_reader(self, transports: list[SwitchTransport]) -> None:
        backlog: Backlog[tuple[int, bool]] = Backlog(20, Overflow.WAIT)

        def fail(blocks: list[UnitBlock], late: bool) -> Measured[tuple[int, bool]]:
            raise ZeroDivisionError

        listener = Listener("a", lambda told: Session(SwitchTransport, on_change=told), backlog, fail)
        listener.start()
        listener.join(5.0)
        with pytest.raises(ZeroDivisionError):
            backlog.pop()

    def test_an_absent_device_was_tried(self, transports: list[SwitchTransport]) -> None:
        backlog: Backlog[tuple[int, bool]] = Backlog(20, Overflow.WAIT)
        changes: list[str] = []
        listener = self.listener(transports, backlog, refuse_open=True)
        listener._changed = lambda: changes.append(listener.state)
        assert not listener.was_tried
        listener.start()
        while not listener.was_tried:
            time.sleep(0.005)
        assert listener.state == "absent"
        assert listener.session.last_error == str(TransportError("switch: there is no device"))
        listener.stop()
        listener.join(5.0)
        assert changes[:2] == ["opening", "absent"]


def popped_late(backlog: Backlog[tuple[int, bool]]) -> Iterator[tuple[int, bool]]:
    while (found := backlog.pop()) is not None:
        yield found
