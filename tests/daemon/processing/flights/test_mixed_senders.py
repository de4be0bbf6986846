"""Tests logs in which several heads sent to one port, as delivered (ros-drivers/velodyne #346)."""

from __future__ import annotations

from pathlib import Path

import pytest

from swath.daemon.log.chunk_index import index_log
from swath.daemon.log.reader import open_logs
from swath.daemon.log.statistics import session_statistics
from swath.daemon.processing.flights.read import mixed_scanners
from tests.daemon.exchange.builders import Unit, write_config, write_log

LEFT, RIGHT = ("192.168.1.201", 2368), ("192.168.1.202", 2368)


@pytest.mark.parametrize(
    ("order", "found"),
    [("LRLRLR", {"192.168.1.201": 3, "192.168.1.202": 3}), ("LLLRRR", {}), ("LLLLLL", {})],
    ids=["two heads", "one head that changed its address", "one head"],
)
def test_two_heads_on_one_port_are_found_in_a_log(order: str, found: dict[str, int], tmp_path: Path) -> None:
    senders = {"L": LEFT, "R": RIGHT}
    units: list[Unit] = [
        ("scanner/top", 1_792_000_000_000_000_000 + 1_000_000 * at, bytes([at]), senders[one])
        for at, one in enumerate(order)
    ]
    log = write_log(tmp_path / "logs", write_config(tmp_path), units)
    (session,) = open_logs([log])
    numbers = session_statistics(session, decode=False)
    assert numbers["sources"]["scanner/top"]["mixed_senders"] == found
    assert mixed_scanners(index_log(session)) == ({"scanner/top": found} if found else {})
