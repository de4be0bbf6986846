"""Tests recording while the wall clock is stepped by an hour in both directions, which affects all programs."""

from __future__ import annotations

import contextlib
import socket
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from swath.daemon.log.host_clock import read_clock_pair
from tests.daemon.log_check import read_log
from tests.daemon.rig import Recorder, free_udp_port, session_table

HOUR_NS = 3600 * 1_000_000_000


@contextlib.contextmanager
def restored_clock() -> Iterator[int]:
    """Restore the wall clock afterwards, as if nothing had changed it, and yield its offset (ns)."""
    offset_ns = read_clock_pair().offset_ns
    try:
        yield offset_ns
    finally:
        time.clock_settime_ns(time.CLOCK_REALTIME, time.monotonic_ns() + offset_ns)


@pytest.mark.alone
@pytest.mark.parametrize("step_ns", [HOUR_NS, -HOUR_NS])
def test_a_wall_clock_step_of_an_hour_does_not_affect_the_recording(tmp_path: Path, step_ns: int) -> None:
    port, logs = free_udp_port(), tmp_path / "logs"
    table = f'[scanner.left]\ntransport = "udp:127.0.0.1:{port}"\nprotocol = "srep"\nmirror_factor = 1.0\n'
    sent_ns: list[tuple[int, int]] = []  # before and after the call
    with (
        Recorder(tmp_path, session_table(logs) + table) as recorder,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock,
        restored_clock() as offset_ns,
    ):
        recorder.wait_said("device_opened")

        def send(seconds: float) -> None:
            end = time.monotonic() + seconds
            while time.monotonic() < end:
                before_ns = time.monotonic_ns()
                sock.sendto(len(sent_ns).to_bytes(4, "little"), ("127.0.0.1", port))
                sent_ns.append((before_ns, time.monotonic_ns()))
                time.sleep(0.002)

        send(0.5)
        time.clock_settime_ns(time.CLOCK_REALTIME, time.monotonic_ns() + offset_ns + step_ns)
        send(0.5)
        time.clock_settime_ns(time.CLOCK_REALTIME, time.monotonic_ns() + offset_ns)
        send(0.5)
        time.sleep(1.2)
        assert recorder.stop() == 0
    content = read_log(logs)
    (session,) = {path.name.split("_")[0] for path in logs.glob("*.mcap")}
    times = [time_ns for time_ns, _ in content.units["scanner/left"]]
    assert len(times) == len(sent_ns), session
    clocks = [value for _, value in content.messages["/clock"]]
    start_ns = clocks[0]["realtime_ns"] - clocks[0]["monotonic_ns"]
    spans = [(time_ns - start_ns, *span) for time_ns, span in zip(times, sent_ns, strict=True)]
    # loopback delivers within the send call, even on a busy machine; the clocks' rates differ a little
    assert all(before - 1_000_000 < stamp < after + 1_000_000 for stamp, before, after in spans), spans
    assert len(content.events("wall_clock_stepped")) == 2
    assert content.messages["/status/scanner/left"][-1][1]["stamp_ambiguous"] == 0
