"""Tests what listening to a configuration tells its clocks, with clocks that keep what they hear."""

from __future__ import annotations

import asyncio
import math
import os
import time
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from swath.daemon.config import parse_config
from swath.daemon.devices.listening import Listening, Times
from swath.georef.records import PpsEdge, Record
from tests.daemon.builders import nmea_sentence
from tests.daemon.rig import free_udp_port
from tests.daemon.wires import pty, tcp_server, udp_sender

ZDA = nmea_sentence("GPZDA,101500.00,21,11,2026,00,00")


class Heard:
    """Clocks that note what they are given and know no time."""

    def __init__(self) -> None:
        self.readings: list[tuple[int, int, int, float]] = []
        self.edges: list[PpsEdge] = []
        self.late: dict[str, list[bool]] = {}

    def add_reading(
        self, realtime_ns: int, monotonic_ns: int, monotonic_raw_ns: int, max_error_s: float = math.inf
    ) -> None:
        self.readings.append((realtime_ns, monotonic_ns, monotonic_raw_ns, max_error_s))

    def add_edge(self, source: str, edge: PpsEdge) -> None:
        assert source == "pps/main"
        self.edges.append(edge)

    def take(self, source: str, records: Sequence[Record], *, late: bool = False) -> list[Times]:
        self.late.setdefault(source, []).append(late)
        return [Times(np.array([-1]), np.array([math.nan])) for _ in records]

    def least(self, names: Iterable[str]) -> int:
        """Return how many readings of each receiver came at the least."""
        return min(len(self.late.get(f"gnss/{name}", [])) for name in names)

    def state(self, source: str, host_ns: int) -> tuple[str, float] | None:
        return None


async def test_clocks_learn_what_was_late_by_a_slow_reader(tmp_path: Path) -> None:
    """A datagram has a stamp of its own; one reading of a port or a connection may hold bytes of seconds."""
    fifo, port = tmp_path / "edges", free_udp_port()
    os.mkfifo(fifo)
    edges = os.open(fifo, os.O_RDWR | os.O_NONBLOCK)
    heard = Heard()
    with pty(lambda _: ZDA) as path, tcp_server(lambda _: ZDA) as server, udp_sender(port, lambda _: ZDA):
        wires = {"port": f"serial:{path}", "net": f"tcp:127.0.0.1:{server}", "datagrams": f"udp:127.0.0.1:{port}"}
        text = f'[session]\nname = "x"\ndirectory = "."\n[pps.main]\nsource = "fixed:{fifo}"\n' + "".join(
            f'[gnss.{name}]\ntransport = "{wire}"\nprotocol = "nmea"\n' for name, wire in wires.items()
        )
        config = parse_config(text, tmp_path / "swath.toml")
        async with Listening(config.devices(), config.pps, queue_bytes=1, make_clocks=lambda _: heard) as listening:
            stamp_ns = time.time_ns()
            os.write(edges, f"{stamp_ns} 7\n".encode())
            while heard.least(wires) < 2 or not heard.edges:  # noqa: ASYNC110  (threads do it)
                await asyncio.sleep(0.01)
            await asyncio.sleep(0.5)  # each wire has one batch in its lane, and waits with the second
            while heard.least(wires) < 3:
                await listening.take()
            assert listening.status("pps/main").units == 1
    os.close(edges)
    assert {source: late[:3] for source, late in heard.late.items()} == {
        "gnss/port": [False, False, True],
        "gnss/net": [False, False, True],
        "gnss/datagrams": [False, False, False],
    }
    (edge,) = heard.edges
    assert edge.sequence == 7
    assert abs(edge.host_time_ns - stamp_ns) < 1_000_000_000
    assert 3 <= len(heard.readings) <= 60
    realtime_ns, monotonic_ns, raw_ns, _ = heard.readings[-1]
    assert abs(realtime_ns - time.time_ns()) < 60e9
    assert monotonic_ns < time.monotonic_ns()
    assert raw_ns > 0
