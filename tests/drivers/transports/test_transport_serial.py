"""Tests serial ports on real pseudo terminals: content, unplug, replug, two readers, and clear errors."""

from __future__ import annotations

import errno
import os
import random
import subprocess
import sys
import termios
import threading
import time
import tty
from collections.abc import Iterator
from pathlib import Path

import pytest

from swath.drivers.session import Session, SessionState
from swath.drivers.transports.base import TransportError, UnitBlock
from swath.drivers.transports.serial_port import SerialTransport
from swath.drivers.transports.spec import TransportSpec, parse_transport


class Device:
    """The far end of a pty, and the path by which a port is opened."""

    def __init__(self) -> None:
        self.master, slave = os.openpty()
        tty.setraw(self.master)
        self.path = os.ttyname(slave)
        os.close(slave)

    def write(self, data: bytes) -> None:
        while data:
            data = data[os.write(self.master, data) :]

    def unplug(self) -> None:
        if self.master >= 0:
            os.close(self.master)
            self.master = -1


@pytest.fixture
def device() -> Iterator[Device]:
    plugged = Device()
    yield plugged
    plugged.unplug()


def port(path: str, options: str = "?baud=921600") -> SerialTransport:
    return SerialTransport(parse_transport(f"serial:{path}{options}"))


def read_until(transport: SerialTransport, length: int) -> bytes:
    data = b""
    while len(data) < length:
        blocks = transport.receive(5.0)
        if not blocks:
            break
        data += content(blocks)
    return data


def content(blocks: list[UnitBlock]) -> bytes:
    return b"".join(block.units.tobytes() for block in blocks)


def test_every_byte_value_arrives_unchanged(device: Device) -> None:
    """No line discipline may touch the stream: not XON, not CR, not the interrupt character."""
    sent = bytes(range(256)) * 40 + random.Random(3).randbytes(200_000)
    serial = port(device.path)
    serial.open()
    writer = threading.Thread(target=device.write, args=(sent,))
    writer.start()
    received = read_until(serial, len(sent))
    writer.join()
    assert received == sent
    serial.close()


def test_each_read_gives_one_unit_without_a_timestamp(device: Device) -> None:
    serial = port(device.path)
    serial.open()
    device.write(b"$GPZDA")
    [block] = serial.receive(5.0)
    assert block.units.shape == (1, 6)
    assert block.kernel_realtime_ns is None
    assert block.peer is None
    assert serial.receive(0.0) == []
    serial.close()


def test_sent_bytes_reach_the_device(device: Device) -> None:
    serial = port(device.path)
    serial.open()
    serial.send(b"\x13\x11\r\n\x03")
    assert os.read(device.master, 100) == b"\x13\x11\r\n\x03"
    serial.close()


def test_send_to_a_blocked_line_raises_a_transport_error(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("swath.drivers.transports.serial_port.SEND_TIMEOUT_S", 0.1)
    serial = port(device.path)
    serial.open()
    with pytest.raises(TransportError, match="accepts no data"):
        serial.send(bytes(1 << 20))
    serial.close()


def test_unplugging_while_waiting_raises_a_transport_error(device: Device) -> None:
    serial = port(device.path)
    serial.open()
    unplug = threading.Timer(0.1, device.unplug)
    unplug.start()
    with pytest.raises(TransportError, match=f"{device.path} was disconnected"):
        serial.receive(30.0)
    unplug.join()
    with pytest.raises(TransportError, match="was disconnected"):
        serial.send(b"x")
    serial.close()


def test_a_replugged_device_is_reopened_under_its_stable_name(device: Device, tmp_path: Path) -> None:
    """The name is a link, as udev makes it; the session opens its current target."""
    link = tmp_path / "gnss"
    link.symlink_to(device.path)
    spec = parse_transport(f"serial:{link}?baud=115200")
    session = Session(lambda: SerialTransport(spec), pause=lambda _: None)
    assert session.receive(0.0) == []
    device.write(b"before")
    assert content(session.receive(5.0)) == b"before"
    link.unlink()
    device.unplug()
    assert session.receive(5.0) == []
    assert session.state.value == SessionState.WAITING.value
    assert "was disconnected" in session.last_error

    deadline = time.monotonic() + 30.0
    while "does not exist" not in session.last_error and time.monotonic() < deadline:
        session.receive(0.0)
    assert f"{link} does not exist" in session.last_error

    again = Device()
    link.symlink_to(again.path)
    while session.openings < 2 and time.monotonic() < deadline:
        session.receive(0.0)
    again.write(b"after")
    assert content(session.receive(5.0)) == b"after"
    assert session.state.value == SessionState.OPEN.value
    session.close()
    again.unplug()


def test_a_port_already_open_in_this_program_is_refused(device: Device) -> None:
    first, second = port(device.path), port(device.path)
    first.open()
    with pytest.raises(TransportError, match=f"{device.path} is in use by this program itself"):
        second.open()
    first.close()
    second.open()
    second.close()


def test_a_port_held_by_another_process_is_refused(device: Device) -> None:
    code = (
        "import sys\n"
        "from swath.drivers.transports.serial_port import SerialTransport\n"
        "from swath.drivers.transports.spec import parse_transport\n"
        "t = SerialTransport(parse_transport('serial:' + sys.argv[1])); t.open()\n"
        "sys.stdout.write('open\\n'); sys.stdout.flush(); sys.stdin.read()\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code, device.path], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "open\n"
        with pytest.raises(TransportError, match=rf"in use by python\S* \(process {other.pid}\)"):
            port(device.path).open()
        other.communicate(input="")


@pytest.mark.parametrize(
    ("path", "says"),
    [
        ("/nonexistent/ttyUSB0", "/nonexistent/ttyUSB0 does not exist"),
        ("/dev/null", "/dev/null is not a serial port; see `ls /dev/serial/by-id`"),
        (__file__, "test_transport_serial.py is not a serial port; see `ls /dev/serial/by-id`"),
        ("/tmp", "cannot open /tmp as a serial port: Is a directory"),
    ],
)
def test_error_on_opening_gives_the_reason(path: str, says: str) -> None:
    serial = port(path)
    with pytest.raises(TransportError, match=says) as caught:
        serial.open()
    assert "\n" not in str(caught.value)
    serial.close()


def test_a_baud_rate_unknown_to_the_kernel_raises_a_transport_error(device: Device) -> None:
    """Settings are checked earlier; an unchecked rate must still not end the thread of its port."""
    serial = SerialTransport(TransportSpec("serial", device.path, {"baud": str(1 << 32)}))
    with pytest.raises(TransportError, match="cannot open"):
        serial.open()
    serial.close()


def test_error_for_a_port_without_permission_names_the_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    """root may open anything, so the refusal is simulated; the wording is what is tested."""

    def refuse(*_: object, **__: object) -> None:
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr("serial.Serial", refuse)
    with pytest.raises(TransportError, match="not permitted to this user; add it to the group dialout"):
        port("/dev/ttyUSB0").open()


def test_close_from_another_thread_ends_a_blocked_receive(device: Device) -> None:
    serial = port(device.path)
    serial.open()
    got: list[object] = []
    thread = threading.Thread(target=lambda: got.append(serial.receive(60.0)))
    thread.start()
    time.sleep(0.1)
    serial.close()
    thread.join(timeout=30.0)
    assert got == [[]]
    serial.close()


def test_reopening_leaks_no_descriptor(device: Device) -> None:
    serial = port(device.path)
    serial.open()
    serial.close()
    before = len(os.listdir("/proc/self/fd"))
    for _ in range(5):
        serial.open()
        serial.close()
    assert len(os.listdir("/proc/self/fd")) == before


def test_line_settings_reach_the_driver(device: Device) -> None:
    """All settings but character size and parity bit are checked; a pty keeps these at eight and none."""
    serial = port(device.path, "?baud=57600&bytesize=7&parity=O&stopbits=2&rtscts=yes&xonxoff=yes")
    serial.open()
    iflag, _, cflag, _, ispeed, ospeed, _ = termios.tcgetattr(serial._fd)
    assert ispeed == ospeed == termios.B57600
    assert cflag & termios.PARODD
    assert cflag & termios.CSTOPB
    assert cflag & termios.CRTSCTS
    assert iflag & termios.IXON
    assert not iflag & termios.BRKINT
    serial.close()
