"""Tests PPS on DCD beside data on one 16550 in a virtual machine, as root: pytest tests/drivers/guest_dcd.py

/dev/ttyS1 must have a pulse of 0.1 s on DCD each second and NMEA at 38400 baud.
"""

from __future__ import annotations

import threading
import time

from swath.drivers.transports.base import RawEdge
from swath.drivers.transports.pps.serial_dcd import SerialDcdPps
from swath.drivers.transports.serial_port import SerialTransport
from swath.drivers.transports.spec import parse_transport

PORT = "/dev/ttyS1"


def test_both_edges_and_the_data_of_one_port_are_received() -> None:
    serial = SerialTransport(parse_transport(f"serial:{PORT}?baud=38400"))
    rising, falling = SerialDcdPps(PORT), SerialDcdPps(PORT, edge="clear")
    serial.open()
    rising.open()
    falling.open()
    asserts: list[RawEdge] = []
    clears: list[RawEdge] = []
    data = b""
    end_s = time.monotonic() + 6.5
    while time.monotonic() < end_s:
        asserts += rising.receive(0.05)
        clears += falling.receive(0.05)
        data += b"".join(block.units.tobytes() for block in serial.receive(0.05))
    for edges in (asserts, clears):
        assert len(edges) >= 5
        assert [edge.sequence - edges[0].sequence for edge in edges] == list(range(len(edges)))
        assert not any(edge.kernel_stamp for edge in edges)
    assert {edge.edge for edge in asserts} == {"assert"}
    assert {edge.edge for edge in clears} == {"clear"}
    assert data.count(b"$GPZDA") >= 5
    for source in (serial, rising, falling):
        source.close()


def test_close_ends_a_wait_and_the_port_can_be_opened_again() -> None:
    source = SerialDcdPps(PORT)
    source.open()
    while source.receive(0.3):  # read until no edge comes for 0.3 s
        pass
    got: list[list[RawEdge]] = []
    thread = threading.Thread(target=lambda: got.append(source.receive(60.0)))
    thread.start()
    source.close()
    thread.join(timeout=30.0)
    assert not thread.is_alive()
    source.open()
    assert source.receive(30.0) or source.receive(30.0)
    source.close()
