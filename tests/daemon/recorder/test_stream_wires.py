"""Tests every driver of a byte stream over every wire: pty, UDP and TCP, on real devices and sockets."""

from __future__ import annotations

import array
import fcntl
import os
import socket
import termios
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

from swath.daemon.config import load_config, parse_config
from swath.daemon.devices.check import check_everything
from swath.daemon.devices.identify import Heard
from swath.daemon.devices.setup import Outcome, apply_setup, plan_setup
from swath.daemon.errors import ConfigError
from swath.daemon.log.parsers import stored_parsers
from swath.daemon.log.reader import open_logs
from swath.daemon.replay.units import close_outputs, open_outputs
from swath.daemon.replay.wire_player import TcpOutput
from swath.drivers.driver import KINDS, RECEIVER_RECORDS, STREAM_TRANSPORTS, Driver, all_drivers
from swath.drivers.transports.base import TransportError
from swath.drivers.transports.opening import open_transport
from swath.drivers.transports.spec import TransportSpec, parse_transport
from swath.georef.records import Chunk
from tests.daemon.builders import Pty, nmea_zda
from tests.daemon.commands import swath
from tests.daemon.log_check import read_log
from tests.daemon.receivers import novatel_replies
from tests.daemon.rig import Recorder, free_udp_port, one_processor, session_table, wait_until
from tests.daemon.wires import pty, repeating, tcp_server, udp_sender
from tests.fuzz.recordings import settings_of, streams_of

STREAMS = [
    driver
    for kind in KINDS
    for driver in all_drivers(kind).values()
    if set(STREAM_TRANSPORTS) <= set(driver.transports)
]
RECEIVERS_INSIDE = {driver.protocol for driver in all_drivers("gnss").values() if "imu" in driver.transports}
PIECE_BYTES = 700
MOST_BYTES = 20_000


def recording_of(driver: Driver) -> bytes:
    """Return what a device of the driver sent: the recording with most messages."""

    def messages(data: bytes) -> int:
        parser = driver.make_parser(settings_of(driver)[0])
        parser.feed(Chunk("x", 0, data))
        return parser.counters.messages.total()

    return max((data[:MOST_BYTES] for data in streams_of(driver)), key=messages)


@contextmanager
def sending_end(wire: str, folder: Path, name: str) -> Iterator[tuple[str, Callable[[bytes], object]]]:
    """Provide the device's end of a wire: the transport that reaches it, and the function that sends on it."""
    if wire == "serial":
        line = Pty(folder / name)

        def write(data: bytes) -> None:
            """Write a piece once the one before was read: a line has no end that a reader could wait for."""
            wait_until(lambda: not _unread(line.slave), "the line is read", 60.0)
            line.write(data)

        yield f"serial:{folder / name}", write
        line.unplug()
    elif wire == "udp":
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            port = free_udp_port()
            yield f"udp:127.0.0.1:{port}", lambda data: sender.sendto(data, ("127.0.0.1", port))
    else:
        with socket.create_server(("127.0.0.1", 0)) as server:
            server.settimeout(30.0)
            peers: list[socket.socket] = []

            def send(data: bytes) -> None:
                if not peers:
                    peers.append(server.accept()[0])
                peers[0].sendall(data)

            yield f"tcp:127.0.0.1:{server.getsockname()[1]}?silent_s=600", send
            for peer in peers:
                peer.close()


def _unread(terminal: int) -> int:
    waiting = array.array("i", [0])
    fcntl.ioctl(terminal, termios.FIONREAD, waiting)
    return waiting[0]


@pytest.mark.slow
def test_every_stream_is_recorded_and_read_over_every_wire(tmp_path: Path) -> None:
    """All drivers and wires are in one recorder: the log has each byte, and its records are those of the recording."""
    assert {driver.protocol for driver in STREAMS} >= {"nmea", "ubx", "sbf", "novatel", "xsens-xbus", "rtcm3"}
    sent = {f"{driver.kind}/{driver.protocol}": recording_of(driver) for driver in STREAMS}
    logs = tmp_path / "logs"
    with ExitStack() as stack:
        config, sends = session_table(logs), {}
        for driver in STREAMS:
            for wire in STREAM_TRANSPORTS:
                name = f"{driver.protocol}-{wire}"
                text, send = stack.enter_context(sending_end(wire, tmp_path, f"{driver.kind}-{name}"))
                config += f'[{driver.kind}.{name}]\ntransport = "{text}"\nprotocol = "{driver.protocol}"\n'
                if driver.kind == "imu" and driver.protocol in RECEIVERS_INSIDE:
                    config += f'[gnss.in-{name}]\ntransport = "imu:{name}"\nprotocol = "{driver.protocol}"\n'
                sends[f"{driver.kind}/{name}"] = send, sent[f"{driver.kind}/{driver.protocol}"]
        recorder = stack.enter_context(Recorder(tmp_path / "rig", config))
        recorder.wait_said("device_opened", times=len(sends))
        for first in range(0, MOST_BYTES, PIECE_BYTES):
            for send, data in sends.values():
                if piece := data[first : first + PIECE_BYTES]:
                    send(piece)
        assert recorder.stop() == 0, recorder.stderr()
    content = read_log(logs)
    (session,) = open_logs([logs])
    heard_inside: Counter[str] = Counter()
    for source, (_, data) in sends.items():
        assert content.data(source) == data, source
        if source.endswith("-udp"):  # one unit a datagram
            assert {len(unit) for _, unit in content.units[source][:-1]} == {PIECE_BYTES}
        whole, cut = (stored_parsers(session.attachments())[0][source] for _ in range(2))
        expected, found = Heard(), Heard()
        expected.add(whole.feed(Chunk(source, content.units[source][0][0], data)))
        for time_ns, unit in content.units[source]:
            found.add(cut.feed(Chunk(source, time_ns, unit)))
        assert whole.counters.messages.total() > 0, source
        assert cut.counters == whole.counters, source
        assert found.counts == expected.counts, source
        if source.startswith("imu/") and source[4:].rpartition("-")[0] in RECEIVERS_INSIDE:
            receiver, inside = stored_parsers(session.attachments())[0][f"gnss/in-{source[4:]}"], Heard()
            for time_ns, unit in content.units[source]:
                inside.add(receiver.feed(Chunk(source, time_ns, unit)))
            kinds = {kind.__name__ for kind in RECEIVER_RECORDS}
            told = {kind: count for kind, count in found.counts.items() if kind in kinds}
            # of protocol `records`, a parser gives the records of its own kind of device alone
            assert told == ({} if source.startswith("imu/records-") else inside.counts), source
            heard_inside += inside.counts
    assert heard_inside["TimeMessage"] > 0
    assert heard_inside["GnssFix"] > 0


def test_check_reads_a_receiver_over_every_wire_and_names_another_protocol(tmp_path: Path) -> None:
    def text(name: str, transport: str, protocol: str = "nmea") -> str:
        return f'[gnss.{name}]\ntransport = "{transport}"\nprotocol = "{protocol}"\n'

    def epoch(number: int) -> bytes:
        return nmea_zda(36_000 + number)

    port, other = free_udp_port(), free_udp_port()
    with (
        pty(epoch) as path,
        udp_sender(port, epoch),
        tcp_server(epoch) as tcp,
        udp_sender(other, epoch),
        tcp_server(epoch) as other_tcp,
        tcp_server() as mute,
    ):
        config = session_table(tmp_path) + text("pty", f"serial:{path}")
        config += text("udp", f"udp:127.0.0.1:{port}") + text("tcp", f"tcp:127.0.0.1:{tcp}")
        config += text("other-udp", f"udp:127.0.0.1:{other}", "ubx")
        config += text("other-tcp", f"tcp:localhost:{other_tcp}", "sbf") + text("mute", f"tcp:127.0.0.1:{mute}")
        found = check_everything(parse_config(config, tmp_path / "swath.toml"), 1.2)
    reports = {report.source.removeprefix("gnss/"): report for report in found}
    for wire in ("pty", "udp", "tcp"):
        assert reports[wire].problems == [], wire
        assert reports[wire].records["TimeMessage"] >= 5, wire
        assert "2026-11-21 10:0" in reports[wire].time
    assert reports["other-udp"].problems == ["sends nmea, but ubx is configured"]
    assert reports["other-tcp"].problems == ["sends nmea, but sbf is configured"]
    (said,) = [problem for problem in reports["mute"].problems if "time" not in problem]
    assert said == "opened, but sent nothing in 1.2 s; check its power, wiring and output port"


def test_setup_sends_over_tcp_and_reads_the_answers(tmp_path: Path) -> None:
    commands: list[bytes] = []
    with socket.create_server(("127.0.0.1", 0)) as server:

        def serve() -> None:
            peer, _ = server.accept()
            with peer, peer.makefile("rb") as lines:
                for line in lines:
                    commands.append(line.rstrip())
                    peer.sendall(novatel_replies()(commands[-1]))

        thread = threading.Thread(target=serve)
        thread.start()
        text = f'[gnss.rover]\ntransport = "tcp:127.0.0.1:{server.getsockname()[1]}"\nprotocol = "novatel"\n'
        (wire,) = plan_setup(parse_config(session_table(tmp_path) + text, tmp_path / "swath.toml"))
        apply_setup(wire, 10.0)
        thread.join(10.0)
    assert {step.outcome for step in wire.steps()} == {Outcome.ACCEPTED}
    assert commands == [step.message.data.rstrip() for step in wire.steps()]


def test_replay_serves_the_tcp_port_that_a_recorder_connects_to() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        spec = parse_transport(f"tcp:127.0.0.1:{server.getsockname()[1]}")
        with pytest.raises(TransportError, match="cannot listen there: Address already in use"):
            TcpOutput(spec)
    output = TcpOutput(spec)
    assert not output.has_reader()
    assert not output.send(b"lost", 0)
    reader = open_transport(spec)
    reader.open()
    wait_until(output.has_reader, "a reader", 10.0)
    assert output.send(b"first ", 0)
    assert output.send(b"second", 0)
    output.close()
    assert b"".join(block.units.tobytes() for block in reader.receive(1.0)) == b"first second"
    with pytest.raises(TransportError, match="closed the connection"):
        reader.receive(1.0)
    reader.close()
    with pytest.raises(TransportError, match=r"give tcp:127\.0\.0\.1:<port> to replay"):
        TcpOutput(TransportSpec("tcp", "192.0.2.1:5000", {}, "tcp:192.0.2.1:5000"))


@pytest.mark.slow
def test_two_heads_on_one_port_are_two_sources_and_strangers_are_named(tmp_path: Path) -> None:
    port, logs = free_udp_port(), tmp_path / "logs"
    config = session_table(logs)
    for head, name in ((2, "left"), (3, "right")):
        transport = f"udp:0.0.0.0:{port}?source=127.0.0.{head}"
        config += f'[scanner.{name}]\ntransport = "{transport}"\nprotocol = "srep"\nmirror_factor = 1.0\n'
    sent = {"scanner/left": 2, "scanner/right": 3, "a": 4, "b": 5, "c": 6, "d": 7}

    def send(number: int) -> None:
        for name, last in sent.items():
            sender = senders[name]
            if name.startswith("scanner") or number % last == 0:  # the stranger at 127.0.0.7 sends least
                sender.sendto(b"%s %d" % (name.encode(), number), ("127.0.0.1", port))

    with ExitStack() as stack:
        senders = {}
        for name, last in sent.items():
            senders[name] = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
            senders[name].bind((f"127.0.0.{last}", 0))
        with Recorder(tmp_path / "rig", config) as recorder:
            recorder.wait_said("device_opened", times=2)
            with one_processor():
                for number in range(420):
                    send(number)
            recorder.wait_said("units_refused")
            assert recorder.stop() == 0, recorder.stderr()
        with repeating(send):
            found = check_everything(parse_config(config, tmp_path / "swath.toml"), 1.0)
    content = read_log(logs)
    for name in ("scanner/left", "scanner/right"):
        assert [data for _, data in content.units[name]] == [b"%s %d" % (name.encode(), n) for n in range(420)]
    statuses = [content.messages[f"/status/{name}"][-1][1] for name in ("scanner/left", "scanner/right")]
    (refusing,) = [status for status in statuses if "refused" in status]
    assert refusing["refused"] == 105 + 84 + 70 + 60
    assert refusing["refused_senders"] == "127.0.0.4 (105), 127.0.0.5 (84), 127.0.0.6 (70)"
    assert "; most of 127.0.0." in content.events("units_refused")[0]["text"]
    assert "refused senders: 127.0.0.4 (105), 127.0.0.5 (84), 127.0.0.6 (70)" in swath("info", str(logs)).stdout
    (note,) = [note for report in found for note in report.notes if "senders other than" in note]
    assert "127.0.0.4 (" in note
    assert all(report.units > 5 for report in found[:2])


def test_relative_ports_and_fifos_are_beside_the_configuration(tmp_path: Path) -> None:
    """The recorder, the check and the replay run in a folder that is not the configuration's."""
    folder = tmp_path / "rig"
    folder.mkdir()
    line = Pty(folder / "port")
    os.mkfifo(folder / "pulse")
    text = '[session]\nname = "x"\ndirectory = "logs"\nreserve_mb = 1\n[pps.main]\nsource = "fixed:pulse"\n'
    text += '[gnss.rover]\ntransport = "serial:port"\nprotocol = "nmea"\npps = "main"\n'
    with Recorder(folder, text) as recorder, (folder / "pulse").open("w") as edges:
        recorder.wait_said("device_opened", times=2)
        line.write(nmea_zda(36_000))
        edges.write(f"{time.time_ns()} 1\n")
        edges.flush()
        wait_until(lambda: not _unread(line.slave), "the line is read", 60.0)
        assert recorder.stop() == 0, recorder.stderr()
    content = read_log(folder / "logs")
    assert content.data("gnss/rover") == nmea_zda(36_000)
    assert len(content.messages["/pps/main"]) == 1
    config = load_config(folder / "swath.toml")
    reports = {report.source: report for report in check_everything(config, 0.3)}
    assert reports["gnss/rover"].opens
    assert reports["pps/main"].opens
    line.unplug()
    outputs = open_outputs(config, with_pps=True)
    assert (folder / "port").is_symlink()
    close_outputs(outputs)
    twice = text + f'[gnss.other]\ntransport = "serial:{folder}/port"\nprotocol = "nmea"\n'
    with pytest.raises(ConfigError, match=f"both use the device {folder}/port"):
        parse_config(twice, folder / "swath.toml")
