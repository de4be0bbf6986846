"""``swath replay``: what a second recorder gets from the wires is what the first one got."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from daemon.wire_player import PtyOutput
from tests.daemon.log_check import LogContent, read_log
from tests.daemon.rig import Recorder, free_udp_port, one_processor, session_table
from tests.daemon.test_cli import ROOT
from tests.daemon.test_recording import ROVER, SREP, Pty, nmea_zda

SECONDS = 4


def record_first(folder: Path) -> LogContent:
    """A log of two parts' worth of wires: datagrams, sentences and edges of a few seconds."""
    port, link, fifo = free_udp_port(), folder / "rover", folder / "pps"
    folder.mkdir()
    os.mkfifo(fifo)
    pty = Pty(link)
    config = session_table(folder / "logs") + SREP.format(port=port) + ROVER.format(path=link, fifo=fifo)
    with (
        Recorder(folder, config) as recorder,
        fifo.open("w") as edges,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender,
    ):
        recorder.wait_said("device_opened", times=3)
        with one_processor():
            for second in range(SECONDS):
                edges.write(f"{time.time_ns()} {second + 1}\n")
                edges.flush()
                pty.write(nmea_zda(second))
                for _ in range(50):
                    sender.sendto(os.urandom(400), ("127.0.0.1", port))
                time.sleep(0.5)
        time.sleep(0.5)
        assert recorder.stop() == 0, recorder.stderr()
    pty.unplug()
    return read_log(folder / "logs")


@pytest.mark.parametrize("pace", ["1", "2"])
def test_a_second_recorder_gets_the_same_bytes(tmp_path: Path, pace: str) -> None:
    first = record_first(tmp_path / "first")
    port, link, fifo = free_udp_port(), tmp_path / "rover", tmp_path / "pps"
    config = session_table(tmp_path / "logs") + SREP.format(port=port) + ROVER.format(path=link, fifo=fifo)
    config += (
        f'[scanner.right]\ntransport = "udp:127.0.0.1:{free_udp_port()}"\nprotocol = "srep"\nmirror_factor = 1.0\n'
    )
    with Recorder(tmp_path / "second", config) as recorder:
        wires = str(recorder.config)
        recorder.wait_said("scanner/left device_opened")
        command = [sys.executable, "-m", "daemon.cli.main", "replay", "--pace", pace, "--wire", wires]
        # the recorder looks again for ports that were absent: the log's own start must not be over by then
        os.mkfifo(fifo)
        pty = PtyOutput(link)
        recorder.wait_said("gnss/rover device_opened")
        recorder.wait_said("pps/main device_opened")
        pty.close()
        recorder.wait_said("gnss/rover device_lost")
        played = subprocess.run(
            [*command, str(tmp_path / "first/logs")], cwd=ROOT, capture_output=True, text=True, timeout=60, check=False
        )
        assert played.returncode == 0, played.stderr
        time.sleep(0.5)
        assert recorder.stop() == 0, recorder.stderr()
    second = read_log(tmp_path / "logs")
    datagrams = [[data for _, data in log.units["scanner/left"]] for log in (first, second)]
    assert datagrams[0] == datagrams[1]
    edges = [value["edge_time_ns"] for _, value in second.messages["/pps/main"]]
    assert len(edges) == (SECONDS if pace == "1" else 0)
    before = [value["edge_time_ns"] for _, value in first.messages["/pps/main"]]
    for (old, new), (old_next, new_next) in zip(
        list(zip(before, edges, strict=False))[:-1], list(zip(before, edges, strict=False))[1:], strict=True
    ):
        assert abs((new_next - new) - (old_next - old)) < 50_000  # a stamp is slewed with the wall clock, no more
    assert "scanner/right: nothing in" in played.stderr
    states = {value["time_state"] for _, value in second.messages["/status/pps/main"]}
    assert "LOCKED" not in states


def test_a_port_that_nobody_reads_does_not_hold_up_the_rest(tmp_path: Path) -> None:
    output = PtyOutput(tmp_path / "port")
    started = time.monotonic()
    refused = sum(not output.send(b"x" * 4096, 0) for _ in range(200))
    assert refused > 190
    assert time.monotonic() - started < 30  # waited for once, not two hundred times
    output.close()
    assert not (tmp_path / "port").is_symlink()
