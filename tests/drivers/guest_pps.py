"""Tests kernel PPS on a real /dev/pps0 in a virtual machine, as root: `pytest tests/drivers/guest_pps.py`.

pps_sim.ko must be loaded: it makes a pulse on each second of CLOCK_REALTIME and has the parameters on and drop.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import pytest

from swath.drivers.transports.base import RawEdge, TransportError
from swath.drivers.transports.pps.kernel import KernelPps
from swath.georef.timescales.gps_time import SECOND_NS

PARAMETERS = Path("/sys/module/pps_sim/parameters")


@pytest.fixture
def pps() -> Iterator[KernelPps]:
    source = KernelPps("/dev/pps0")
    source.open()
    yield source
    source.close()


def edges(source: KernelPps, time_s: float) -> list[RawEdge]:
    end_s, found = time.monotonic() + time_s, []
    while time.monotonic() < end_s:
        found += source.receive(0.5)
    return found


def test_each_second_gives_exactly_one_edge(pps: KernelPps) -> None:
    found = edges(pps, 5.5)
    assert 5 <= len(found) <= 6
    for before, after in pairwise(found):
        assert after.sequence == before.sequence + 1
        assert abs(after.realtime_ns - before.realtime_ns - SECOND_NS) < 50_000_000
    assert all(edge.kernel_stamp and edge.edge == "assert" for edge in found)


def test_opening_delivers_no_old_edge(pps: KernelPps) -> None:
    opened_ns = time.time_ns()
    [first, *_] = edges(pps, 1.5)
    assert first.realtime_ns > opened_ns - 50_000_000


def test_a_late_reader_gets_the_latest_edge_and_sees_the_gap(pps: KernelPps) -> None:
    last = edges(pps, 1.5)[-1]
    time.sleep(3.0)
    first = edges(pps, 0.2)[0]
    assert 2 <= first.sequence - last.sequence <= 3


def test_silence_gives_no_edges(pps: KernelPps) -> None:
    (PARAMETERS / "on").write_text("0")
    edges(pps, 1.2)
    assert pps.receive(0.3) == []
    (PARAMETERS / "on").write_text("1")
    assert edges(pps, 2.5)


def test_an_edge_that_the_driver_does_not_capture_is_refused() -> None:
    with pytest.raises(TransportError, match="does not capture the clear edge"):
        KernelPps("/dev/pps0", edge="clear").open()


def test_an_unprivileged_user_is_shown_the_udev_rule_and_needs_no_capability() -> None:
    assert opened_as_nobody() == "not permitted"
    os.chmod("/dev/pps0", 0o666)
    assert opened_as_nobody() == "open"
    os.chmod("/dev/pps0", 0o600)


def opened_as_nobody() -> str:
    reader, writer = os.pipe()
    if os.fork() == 0:
        os.setgid(65534)
        os.setuid(65534)
        try:
            KernelPps("/dev/pps0").open()
            os.write(writer, b"open")
        except TransportError as error:
            os.write(writer, b"not permitted" if "udev rule" in str(error) else str(error).encode())
        os._exit(0)
    os.close(writer)
    os.wait()
    with os.fdopen(reader, "rb") as pipe:
        return pipe.read().decode()
