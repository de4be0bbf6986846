"""Tests corrections of a base station: logged byte for byte, counted, and passed to a receiver."""

from __future__ import annotations

import json
import os
import select
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

from swath.daemon.config import parse_config
from swath.daemon.config.load import validate
from swath.daemon.devices.check import check_everything
from swath.daemon.errors import ConfigError
from swath.daemon.log.block_queue import BlockQueue
from swath.daemon.log.channels import ChannelTable
from swath.daemon.log.events import Events
from swath.daemon.log.host_clock import HostClock
from swath.daemon.recorder.corrections import MOST_WAITING, Relay
from tests.daemon.builders import Pty
from tests.daemon.commands import swath
from tests.daemon.journal import journal_of
from tests.daemon.log_check import official_counts, read_log
from tests.daemon.rig import Recorder, session_table, wait_until
from tests.drivers.caster import caster
from tests.drivers.recordings import expected, recording

NAME = "rtcm3.bndm.log"
DATA = recording("rtcm3", NAME)
FRAMES = expected("rtcm3")[NAME]["frame_scan_own"]["rtcm3_crc_ok"]
V2 = b"HTTP/1.1 200 OK\r\nContent-Type: gnss/data\r\n\r\n"
ROVER = '[gnss.rover]\ntransport = "serial:{path}?baud=921600"\nprotocol = "nmea"\n'
BASE = '[corrections.base]\ntransport = "ntrip:127.0.0.1:{port}/ZIMM0?user=anna"\n'
FORWARD = 'forward_to = "gnss.rover"\n'
SERIAL = '[corrections.base]\ntransport = "serial:{path}?baud=115200"\n'


@contextmanager
def reader(descriptor: int) -> Iterator[bytearray]:
    """Collect the bytes that arrive at the other end of a port."""
    got, ended = bytearray(), threading.Event()

    def read() -> None:
        while not ended.is_set():
            if select.select([descriptor], [], [], 0.05)[0]:
                got.extend(os.read(descriptor, 65536))

    thread = threading.Thread(target=read)
    thread.start()
    try:
        yield got
    finally:
        ended.set()
        thread.join()


@pytest.mark.slow
def test_data_of_a_caster_are_logged_and_reach_the_receiver(tmp_path: Path) -> None:
    """The caster hangs up in the middle; the second connection sends the rest."""
    logs, half = tmp_path / "logs", len(DATA) // 2
    all_sent, ready = threading.Event(), threading.Event()

    def script(sock: socket.socket, number: int) -> None:
        sock.sendall(V2)
        ready.wait(60.0)
        part = DATA[half:] if number else DATA[:half]
        for at in range(0, len(part), 500):
            sock.sendall(part[at : at + 500])
            time.sleep(0.01)
        if number:
            all_sent.wait(60.0)

    with ExitStack() as stack:
        pty = Pty(tmp_path / "rover")
        stack.callback(pty.unplug)
        found = stack.enter_context(caster(script))
        got = stack.enter_context(reader(pty.master))
        config = session_table(logs) + ROVER.format(path=pty.link) + BASE.format(port=found.port) + FORWARD
        recorder = stack.enter_context(Recorder(tmp_path, config))
        recorder.wait_said("gnss/rover device_opened")
        ready.set()
        recorder.wait_said("corrections/base device_lost")
        wait_until(lambda: len(got) >= len(DATA), "all corrections at the receiver")
        time.sleep(1.3)
        assert recorder.stop() == 0, recorder.stderr()
        all_sent.set()
    assert bytes(got) == DATA
    assert len(found.requests) == 2
    content = read_log(logs)
    assert content.data("corrections/base") == DATA
    (path,) = logs.glob("*.mcap")
    assert official_counts(path)["/corrections/base/raw"] == len(content.units["corrections/base"])
    status = content.messages["/status/corrections/base"][-1][1]
    assert sum(status["messages"].values()) == FRAMES
    assert status["messages"]["RTCM1004"] > 0
    assert (status["bad_checksums"], status["forwarded_bytes"], status["forward_dropped_bytes"]) == (0, len(DATA), 0)
    assert "forwarded_bytes" not in content.messages["/status/gnss/rover"][-1][1]
    result = swath("info", "--json", str(logs))
    source = json.loads(result.stdout)["sessions"][0]["sources"]["corrections/base"]
    assert sum(source["decoded"]["messages"].values()) == FRAMES


def test_a_serial_base_is_logged_without_a_receiver(tmp_path: Path) -> None:
    logs, pty = tmp_path / "logs", Pty(tmp_path / "base")
    with Recorder(tmp_path, session_table(logs) + SERIAL.format(path=pty.link)) as recorder:
        recorder.wait_said("corrections/base device_opened")
        for at in range(0, len(DATA), 1000):
            pty.write(DATA[at : at + 1000])
            time.sleep(0.02)
        time.sleep(1.3)
        assert recorder.stop() == 0, recorder.stderr()
    pty.unplug()
    content = read_log(logs)
    assert content.data("corrections/base") == DATA
    status = content.messages["/status/corrections/base"][-1][1]
    assert sum(status["messages"].values()) == FRAMES
    assert "forwarded_bytes" not in status


@pytest.mark.slow
def test_an_absent_receiver_does_not_stop_the_recording(tmp_path: Path) -> None:
    logs = tmp_path / "logs"
    sent = threading.Event()

    def script(sock: socket.socket, number: int) -> None:
        sock.sendall(V2 + DATA)
        sent.wait(60.0)

    with caster(script) as found:
        config = session_table(logs) + ROVER.format(path=tmp_path / "nothing") + BASE.format(port=found.port) + FORWARD
        with Recorder(tmp_path, config) as recorder:
            recorder.wait_said("forwarding_failed")
            time.sleep(1.3)
            assert recorder.stop() == 0, recorder.stderr()
        sent.set()
    content = read_log(logs)
    assert content.data("corrections/base") == DATA
    status = content.messages["/status/corrections/base"][-1][1]
    assert (status["forwarded_bytes"], status["forward_dropped_bytes"]) == (0, len(DATA))
    assert len(content.events("forwarding_failed")) == 1


def test_stopping_does_not_wait_for_a_silent_caster(tmp_path: Path) -> None:
    hold = threading.Event()

    def script(sock: socket.socket, number: int) -> None:
        hold.wait(60.0)

    with caster(script) as found:
        with Recorder(tmp_path, session_table(tmp_path / "logs") + BASE.format(port=found.port)) as recorder:
            wait_until(lambda: found.requests, "the request")
            assert recorder.stop() == 0, recorder.stderr()
        hold.set()
    assert "stuck" not in recorder.stderr()


def test_a_relay_never_waits_for_its_port(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO", "swath")
    events = Events(HostClock(), BlockQueue(1 << 20), ChannelTable())
    stop, in_hand, go_on, taken = threading.Event(), threading.Event(), threading.Event(), bytearray()

    def send(data: bytes) -> bool:
        in_hand.set()
        go_on.wait(30.0)
        taken.extend(data)
        return True

    relay = Relay("corrections/base", "gnss.rover", send, events, stop)
    relay.put(bytes([0]))
    assert in_hand.wait(30.0)
    for number in range(1, MOST_WAITING + 20):
        relay.put(bytes([number]))
    assert relay.dropped_bytes == 19
    go_on.set()
    wait_until(lambda: relay.forwarded_bytes + relay.dropped_bytes == MOST_WAITING + 20, "the rest")
    assert bytes(taken) == bytes(range(MOST_WAITING + 1))
    assert [event.code for event in journal_of(caplog)] == ["forwarding_failed", "forwarding_again"]
    stop.set()
    relay.join(30.0)
    assert not relay.is_alive()


def test_check_reports_the_caster_response(tmp_path: Path) -> None:
    ended = threading.Event()

    def script(sock: socket.socket, number: int) -> None:
        sock.sendall(V2 + DATA[:4000])
        ended.wait(30.0)

    with caster(script) as found, caster(lambda sock, number: sock.sendall(b"HTTP/1.1 401 No\r\n\r\n")) as closed:
        text = session_table(tmp_path) + BASE.format(port=found.port)
        text += BASE.format(port=closed.port).replace("base", "other")
        reports = {one.source: one for one in check_everything(parse_config(text, tmp_path / "a.toml"), 1.5)}
        ended.set()
    base, other = reports["corrections/base"], reports["corrections/other"]
    assert (base.opens, base.bytes, base.problems) == (True, 4000, [])
    assert base.records["DeviceStatus"] > 0
    (problem,) = other.problems
    assert (
        problem
        == f"ntrip:127.0.0.1:{closed.port}/ZIMM0: the caster rejects user or password; check user and password_env"
    )


@pytest.mark.parametrize(
    ("table", "said"),
    [
        (
            {"transport": "can:socketcan:can0"},
            'corrections.base.transport: got "can:socketcan:can0"; rtcm3 supports: serial, udp, tcp, ntrip',
        ),
        (
            {"transport": "ntrip:a:1/B", "protocol": "nmea"},
            "corrections.base.protocol: unknown corrections protocol 'nmea'",
        ),
        (
            {"transport": "ntrip:a:1/B", "forward_to": "gnss.left"},
            'forward_to: got "gnss.left", want a receiver such as gnss.rover; there are: gnss.rover, gnss.net',
        ),
        (
            {"transport": "ntrip:a:1/B", "forward_to": "gnss.net"},
            "corrections.base.forward_to: gnss.net has no port to write to; want a receiver by serial: or tcp:",
        ),
        (
            {"transport": "serial:/dev/ttyS9"},
            "gnss.rover.transport and corrections.base.transport: both use the device",
        ),
        ({"transport": "ntrip:a:1/B", "pps": "main"}, "corrections.base.pps: unknown key"),
    ],
)
def test_impossible_settings_are_refused_in_one_line(tmp_path: Path, table: dict[str, str], said: str) -> None:
    whole = {
        "session": {"name": "x"},
        "gnss": {
            "rover": {"transport": "serial:/dev/ttyS9", "protocol": "nmea"},
            "net": {"transport": "udp:0.0.0.0:4000", "protocol": "nmea"},
        },
        "corrections": {"base": table},
    }
    with pytest.raises(ConfigError) as caught:
        validate(whole, tmp_path / "a.toml", "")
    assert [line for line in caught.value.lines if said in line], caught.value.lines


def test_two_sources_of_one_mountpoint_are_refused(tmp_path: Path) -> None:
    whole = {
        "session": {"name": "x"},
        "corrections": {"a": {"transport": "ntrip:c:2101/M"}, "b": {"transport": "ntrip:c:2101/M?user=x"}},
    }
    with pytest.raises(ConfigError) as caught:
        validate(whole, tmp_path / "a.toml", "")
    assert "both use the mountpoint c:2101/M" in caught.value.lines[0]
