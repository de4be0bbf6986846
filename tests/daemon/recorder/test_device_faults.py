"""Tests faults of devices while recording: every unit is logged as it came, and the fault is reported."""

from __future__ import annotations

import contextlib
import functools
import json
import operator
import os
import random
import socket
import struct
import subprocess
import sys
import threading
import time
import tty
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import can
import pytest

from swath.daemon.log.parsers import stored_parsers
from swath.daemon.log.reader import open_logs
from swath.drivers.can_frames import encode_can_frame
from swath.drivers.scanner.srep.parser import SrepHeader, encode_datagram
from swath.georef.records import ChunkBatch, DeviceClockSamples, Record
from swath.georef.timescales import DeviceClock, PpsClock
from tests.daemon import faulty_can
from tests.daemon.log_check import read_log
from tests.daemon.rig import HANGS_S, Recorder, free_udp_port, one_processor, session_table

ROOT = Path(__file__).resolve().parents[3]


def info(logs: Path) -> dict[str, Any]:
    """Return the JSON of ``swath info`` for the only session; fail if it reports any loss or damage."""
    command = [sys.executable, "-m", "swath.daemon.cli.main", "info", "--json", str(logs)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=HANGS_S, check=True)
    (session,) = json.loads(done.stdout)["sessions"]
    sources: dict[str, Any] = session["sources"]
    return sources


# --- CAN: error frames, bus-off, an adapter that fails -----


class FaultyCan:
    """The other end of a faulty bus."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.off = Path(f"{path}.off")
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.sent: list[bytes] = []

    def frames(self, count: int) -> None:
        for _ in range(count):
            self.frame(encode_can_frame(0x121, len(self.sent).to_bytes(8, "little")))

    def error_frame(self, error_class: int) -> None:
        self.frame(struct.pack("<IB3x8x", 0x2000_0000 | error_class, 8))

    def frame(self, frame: bytes) -> None:
        self._socket.sendto(frame, str(self.path))
        self.sent.append(frame)

    def fail(self, text: str) -> None:
        self._socket.sendto(text.encode(), str(self.path))

    def close(self) -> None:
        self._socket.close()


@pytest.fixture
def faulty(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[FaultyCan]:
    paths = [faulty_can.install(tmp_path), str(ROOT), os.environ.get("PYTHONPATH", "")]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, paths)))
    bus = FaultyCan(tmp_path / "bus")
    yield bus
    bus.close()


@pytest.mark.slow
def test_bus_off_and_error_frames_are_reported_and_the_bus_is_reopened(
    tmp_path: Path, logs: Path, faulty: FaultyCan
) -> None:
    """Three classes of error frames and bus-off with restart come before an adapter that fails for a while."""
    config = f'[imu.main]\ntransport = "can:faulty:{faulty.path}"\nprotocol = "canmod-gps"\n'
    with Recorder(tmp_path / "rig", session_table(logs) + config) as recorder:
        recorder.wait_said("imu/main device_opened")
        faulty.frames(100)
        for error_class in (0x04, 0x08, 0x80):  # controller problem, protocol violation, bus error
            faulty.error_frame(error_class)
            faulty.frames(10)
        faulty.error_frame(0x40)
        faulty.error_frame(0x100)  # and restarted
        faulty.frames(50)
        recorder.wait_said("imu/main can_bus_off")
        recorder.wait_said("imu/main can_errors")
        faulty.off.touch()
        faulty.frames(50)
        faulty.fail("bus-off: the adapter has given up")
        recorder.wait_said("imu/main device_lost")
        recorder.wait_said("the controller is bus-off")
        faulty.off.unlink()
        recorder.wait_said("imu/main device_opened", times=2)
        faulty.frames(100)
        faulty.error_frame(0x40)
        assert recorder.stop() == 0, recorder.stderr()
    content = read_log(logs)
    assert [data for _, data in content.units["imu/main"]] == faulty.sent
    status = content.messages["/status/imu/main"][-1][1]
    assert (status["units"], status["written"]) == (len(faulty.sent), len(faulty.sent))
    assert (status["error_frames"], status["bus_off"]) == (6, 2)
    assert content.events("can_bus_off")[0]["severity"] == "error"
    assert "the adapter has given up" in content.events("device_lost")[0]["text"]
    numbers = info(logs)["imu/main"]
    assert numbers["trouble"] == {"error_frames": 6, "bus_off": 2}


# --- devices that can be sent on ------------------------------------------------------------------------------------


class Wire:
    """One end of a wire; `sent` is the content that the log must have, unit by unit or joined."""

    def __init__(self, source: str, table: str, send: Callable[[bytes], object], close: Callable[[], object]) -> None:
        self.source, self.table = source, f"[{source.replace('/', '.')}]\n{table}\n"
        self._send, self.close = send, close
        self.sent: list[bytes] = []

    def send(self, data: bytes) -> None:
        self.sent.append(data)
        self._send(data)


def udp_wire(source: str) -> Wire:
    port, sock = free_udp_port(), socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    table = f'transport = "udp:127.0.0.1:{port}"\nprotocol = "srep"\nmirror_factor = 1.0'
    return Wire(source, table, lambda data: sock.sendto(data, ("127.0.0.1", port)), sock.close)


def serial_wire(source: str, protocol: str = "nmea") -> Wire:
    main, secondary = os.openpty()
    tty.setraw(secondary)

    def close() -> None:
        os.close(main)
        os.close(secondary)

    def send(data: bytes) -> None:
        while data:
            data = data[os.write(main, data) :]

    return Wire(
        source, f'transport = "serial:{os.ttyname(secondary)}?baud=921600"\nprotocol = "{protocol}"', send, close
    )


def can_wire(source: str, table: str = 'protocol = "canmod-gps"') -> Wire:
    port = free_udp_port()
    bus = can.Bus(interface="udp_multicast", channel="239.74.163.97", port=port)

    def send(frame: bytes) -> None:
        identifier, length = struct.unpack_from("<IB", frame)
        message = can.Message(arbitration_id=identifier, data=frame[8 : 8 + length], is_extended_id=False)
        message.timestamp = time.time()
        bus.send(message)

    transport = f'transport = "can:udp_multicast:239.74.163.97?port={port}"'
    return Wire(source, f"{transport}\n{table}", send, bus.shutdown)


def nmea(body: str) -> bytes:
    return f"${body}*{functools.reduce(operator.xor, body.encode()):02X}\r\n".encode()


def zda(number: int) -> bytes:
    return nmea(f"GPZDA,10{number // 60 % 60:02d}{number % 60:02d}.00,21,11,2026,00,00")


def account_of(content: Any, wire: Wire) -> dict[str, Any]:
    """Return the last status of a source; fail unless all its units are in the log."""
    status: dict[str, Any] = content.messages[f"/status/{wire.source}"][-1][1]
    assert status["lost_kernel"] == status["lost_queue"] == status["lost_write"] == 0, wire.source
    assert status["bytes"] == sum(map(len, wire.sent)), wire.source
    if wire.source.startswith("gnss/"):
        assert content.data(wire.source) == b"".join(wire.sent), wire.source
    else:
        assert [data for _, data in content.units[wire.source]] == wire.sent, wire.source
        assert status["units"] == status["written"] == len(wire.sent), wire.source
    return status


@contextlib.contextmanager
def recording(tmp_path: Path, logs: Path, wires: list[Wire]) -> Iterator[Recorder]:
    """Run a recorder with some wires, all open; it must end without error."""
    config = session_table(logs) + "".join(wire.table for wire in wires)
    try:
        with Recorder(tmp_path, config) as recorder:
            recorder.wait_said("device_opened", times=len(wires))
            yield recorder
            assert recorder.stop() == 0, recorder.stderr()
    finally:
        for wire in wires:
            wire.close()


# --- two of everything ----------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_two_devices_of_each_kind_are_recorded_and_a_changed_receiver_is_reported(tmp_path: Path, logs: Path) -> None:
    """Each source has exactly its own units; only the receiver that no longer gives time is reported."""
    scanners = [udp_wire("scanner/left"), udp_wire("scanner/right")]
    rover, base = serial_wire("gnss/rover"), serial_wire("gnss/base")
    imus = [can_wire("imu/main"), can_wire("imu/spare")]

    def send(wire: Wire, make: Callable[[int], bytes], count: int, pause_s: float) -> None:
        with one_processor():
            for number in range(count):
                wire.send(make(number))
                time.sleep(pause_s)

    def change(recorder: Recorder) -> None:
        for number in range(20):
            base.send(zda(number))
            time.sleep(0.02)
        while "gnss/base time_messages_stopped" not in recorder.stderr() and len(base.sent) < 1000:
            base.send(nmea("GPGSV,1,1,02,02,41,106,45,05,30,200,44"))
            time.sleep(0.05)
        base.send(zda(60))

    def frame(number: int) -> bytes:
        return encode_can_frame(0x121, number.to_bytes(8, "little"))

    with recording(tmp_path, logs, [*scanners, rover, base, *imus]) as recorder:
        jobs: list[Callable[[], None]] = [
            lambda: send(scanners[0], lambda number: number.to_bytes(8, "little") + bytes(1196), 3000, 0.0005),
            lambda: send(scanners[1], lambda number: number.to_bytes(4, "big") + bytes(8444), 1700, 0.001),
            lambda: send(rover, zda, 400, 0.015),
            lambda: send(imus[0], frame, 900, 0.002),
            lambda: send(imus[1], frame, 600, 0.003),
            lambda: change(recorder),
        ]
        threads = [threading.Thread(target=job) for job in jobs]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        recorder.wait_said("gnss/base time_messages_back")
    content = read_log(logs)
    for wire in (*scanners, rover, base, *imus):
        account_of(content, wire)
    told = [(event["source"], event["code"]) for _, event in content.messages["/events"] if event["severity"] != "info"]
    assert [entry for entry in told if entry[1] != "silent"] == [("gnss/base", "time_messages_stopped")]
    (stopped,) = content.events("time_messages_stopped")
    assert "check its messages and baud rate" in stopped["text"]


def heard_at(data: bytes, sent_baud: int, heard_baud: int) -> bytes:
    """Return what a UART at one rate reads from bytes sent at another, 8N1, sampling each bit in its middle."""
    bits = [1] * 20  # the line at rest
    for byte in data:
        bits += [0, *(byte >> place & 1 for place in range(8)), 1]
    bits += [1] * 20
    ratio = sent_baud / heard_baud
    heard, at, end = bytearray(), 0.0, len(bits) - 10 * max(1.0, ratio)

    def line(places: float) -> int:
        return bits[int(at + (places + 0.5) * ratio)]

    while at < end:
        if line(-0.5) == 0:  # a start bit
            heard.append(sum(line(1 + place) << place for place in range(8)))
            at += 9.5 * ratio
        at += ratio / 16
    return bytes(heard)


@pytest.mark.slow
def test_a_receiver_that_changes_its_baud_rate_is_reported_and_recorded_unchanged(tmp_path: Path, logs: Path) -> None:
    rover = serial_wire("gnss/rover")
    assert heard_at(zda(1), 9600, 9600) == zda(1)
    with recording(tmp_path, logs, [rover]) as recorder:
        for number in range(20):
            rover.send(zda(number))
            time.sleep(0.02)
        number = 20
        while "gnss/rover time_messages_stopped" not in recorder.stderr() and number < 1000:
            rover.send(heard_at(zda(number), 38400, 115200))
            number += 1
            time.sleep(0.05)
        rover.send(zda(number))
        recorder.wait_said("gnss/rover time_messages_back")
    content = read_log(logs)
    account_of(content, rover)
    (stopped,) = content.events("time_messages_stopped")
    assert "check its messages and baud rate" in stopped["text"]
    assert info(logs)["gnss/rover"]["decoded"]["messages"] == {"ZDA": 21}


# --- counters -------------------------------------------------------------------------------------------------------

IMU_TABLE = """protocol = "dbc"
dbc = "{dbc}"
rate_hz = 100
[{table}.signals]
specific_force = ["ACC.acc_x", "ACC.acc_y", "ACC.acc_z"]
angular_rate = ["GYR.gyr_x", "GYR.gyr_y", "GYR.gyr_z"]
sample_ticks = "SAMPLE.ticks"
pps_ticks = "SYNC.pps_ticks"
packet_counter = "SAMPLE.packet_counter"
"""


def line(sequence: int, first_ticks: int, pps_count: int) -> bytes:
    latched = first_ticks // 10_000_000 * 10_000_000
    header = SrepHeader(sequence=sequence, first_ticks=first_ticks, pps_count=pps_count, pps_ticks=latched)
    return encode_datagram(header, [0, 1], [0, 1], [[10_000], [10_001]])


def imu_sample(number: int, ticks: int) -> list[bytes]:
    return [
        encode_can_frame(259, struct.pack("<I", ticks // 1_000_000 * 1_000_000)),
        encode_can_frame(257, struct.pack("<hhh", 1, 2, 3)),
        encode_can_frame(258, struct.pack("<hhh", 1, 2, 3)),
        encode_can_frame(256, struct.pack("<IhBB", ticks, 2500, 0, number & 0xFF)),
    ]


def segments(logs: Path, source: str) -> int:
    """Return the number of segments that the time model makes of a device's clock in the log."""
    clock = DeviceClock(PpsClock(18))
    (session,) = open_logs([logs])
    parsers, troubles = stored_parsers(session.attachments())
    assert not troubles
    for batch in session.batches(lambda topic: topic == f"/{source}/raw"):
        records: list[Record] = parsers[source].feed_batch(ChunkBatch(source, batch.log_time_ns, batch.units))
        for record in records:
            if isinstance(record, DeviceClockSamples):
                clock.add(record.rows)
    return clock.status().segments


@pytest.mark.slow
def test_restarts_and_repeated_or_reordered_datagrams_are_reported_as_such(tmp_path: Path, logs: Path) -> None:
    """Units are recorded unchanged and reported by their kind, never as gaps; a restart is a new segment."""
    dbc = Path(__file__).resolve().parents[3] / "fixtures" / "config" / "imu.dbc"
    restarting, shuffled = udp_wire("scanner/left"), udp_wire("scanner/right")
    imu = can_wire("imu/main", IMU_TABLE.format(dbc=dbc, table="imu.main"))
    order = [number ^ 1 for number in range(400)]  # neighbours swapped
    for at in range(395, -1, -5):  # every fifth again, two places later
        order.insert(at + 2, order[at])
    with recording(tmp_path, logs, [restarting, shuffled, imu]), one_processor():
        for number in range(200):
            restarting.send(line(5000 + number, 4_000_000_000 + 10_000 * number, 400))
        for number in order:
            shuffled.send(line(number, 10_000 * number, 0))
        for number in range(100):
            for frame in imu_sample(number, 3_600_000_000 + 10_000 * number):
                imu.send(frame)
        time.sleep(0.3)
        for number in range(200):
            restarting.send(line(number, 10_000 * number, 0))
        for number in range(100):
            for frame in imu_sample(number, 10_000 * number):
                imu.send(frame)
    content = read_log(logs)
    for wire in (restarting, shuffled, imu):
        account_of(content, wire)
    errors = {source: numbers["decoded"]["errors"] for source, numbers in info(logs).items()}
    assert errors["scanner/left"] == {"restart": 1}
    assert errors["scanner/right"] == {"sequence_gap": 199, "out_of_order": 200, "duplicate": 80}
    assert errors["imu/main"] == {"restart": 1}
    assert [segments(logs, wire.source) for wire in (restarting, shuffled, imu)] == [2, 1, 2]


# --- garbage --------------------------------------------------------------------------------------------------------

GARBAGE_BYTES = 4 * 92_160  # 4 s of a line of 921600 baud
SYNCS = (
    b"$GPRMC,",
    b"\xb5\x62\x01\x07",
    b"\xaa\x44\x12\x1c",
    b"$@\x12\x34",
    b"\xd3\x03\xff",
    b"#BESTPOSA,",
    b"\xfa\xff",
)


def thread_cpu_s(recorder: Recorder, name: str) -> float:
    """Return user plus system seconds of one thread."""
    stat = Path(f"/proc/{recorder.process.pid}/task/{recorder.thread(name)}/stat").read_text()
    fields = stat.rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def memory_mb(recorder: Recorder) -> float:
    """Return the private memory of the recorder, MB."""
    status = Path(f"/proc/{recorder.process.pid}/status").read_text()
    return next(int(row.split()[1]) for row in status.splitlines() if row.startswith("RssAnon")) / 1e3


@pytest.mark.slow
@pytest.mark.alone
def test_garbage_at_full_rate_does_not_affect_other_sources(tmp_path: Path, logs: Path) -> None:
    """The garbage is beginnings of messages that never end, and 20 000 invalid datagrams a second."""
    good, noisy = udp_wire("scanner/left"), udp_wire("scanner/right")
    rover, babbling = serial_wire("gnss/rover", "ubx"), serial_wire("gnss/base", "ubx")
    generator = random.Random(1)
    garbage = b"".join(generator.choice(SYNCS) + generator.randbytes(12) for _ in range(GARBAGE_BYTES // 18))
    port = noisy.table.split("127.0.0.1:")[1].split('"')[0]
    with recording(tmp_path, logs, [good, noisy, rover, babbling]) as recorder:
        cpu_before_s, memory_before_mb = thread_cpu_s(recorder, "gnss/base"), memory_mb(recorder)
        command = [sys.executable, "-m", "benchmarks.senders", "udp", port, "1206", "20000", "4"]
        flood = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True)
        line = threading.Thread(target=babble, args=(babbling, garbage))
        line.start()
        highest_mb = 0.0
        number = 0
        while flood.poll() is None or line.is_alive():
            good.send(number.to_bytes(8, "little") + bytes(1196))
            rover.send(nmea(f"GPGGA,{number}"))
            number += 1
            time.sleep(0.004)
            if number % 20 == 0:
                highest_mb = max(highest_mb, memory_mb(recorder))
        line.join()
        out, _ = flood.communicate()
        cpu_s = thread_cpu_s(recorder, "gnss/base") - cpu_before_s
    content = read_log(logs)
    for wire in (good, rover, babbling):
        account_of(content, wire)
    status = content.messages["/status/scanner/right"][-1][1]
    assert status["units"] == int(out.split()[0])
    assert len(content.units["scanner/right"]) == status["written"]
    assert highest_mb - memory_before_mb < 80  # the queue has 64 MiB, less than was sent
    assert cpu_s < 1.0  # on a real line this would be a quarter of a core
    assert info(logs)["scanner/right"]["decoded"]["bad_messages"] == status["written"]


def babble(wire: Wire, data: bytes) -> None:
    """Send garbage at the rate of a line of 921600 baud."""
    start_s = time.monotonic()
    for at in range(0, len(data), 460):
        time.sleep(max(0.0, start_s + at / 92_160 - time.monotonic()))
        wire.send(data[at : at + 460])


@pytest.mark.slow
def test_a_device_still_opening_at_the_end_has_lost_no_data(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as mute:  # a gateway that takes connections and says nothing
        transport = f"can:socketcand:can0?host=127.0.0.1&port={mute.getsockname()[1]}"
        config = f'{session_table(tmp_path / "logs")}[imu.main]\ntransport = "{transport}"\nprotocol = "canmod-gps"\n'
        with Recorder(tmp_path, config) as recorder:
            with mute.accept()[0]:
                assert recorder.stop() == 0
    assert "stuck" not in recorder.stderr()
