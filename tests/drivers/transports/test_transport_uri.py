"""Tests transport strings: right ones are read, wrong ones give one line with the remedy."""

from __future__ import annotations

from pathlib import Path

import pytest

from swath.drivers.transports.can.adapter import PythonCanTransport, keyword_value
from swath.drivers.transports.can.socketcan import SocketCanTransport
from swath.drivers.transports.opening import open_pps, open_transport
from swath.drivers.transports.pps.fixed import FixedPps
from swath.drivers.transports.pps.kernel import KernelPps
from swath.drivers.transports.pps.serial_dcd import SerialDcdPps
from swath.drivers.transports.serial_port import SerialTransport
from swath.drivers.transports.spec import parse_pps, parse_transport
from swath.drivers.transports.tcp_socket import TcpTransport
from swath.drivers.transports.udp_socket import UdpTransport


def test_udp_address_with_every_option_is_parsed() -> None:
    text = "udp:0.0.0.0:2368?group=239.1.2.3&source=192.168.1.201&interface=eth1&buffer_mb=8"
    spec = parse_transport(text)
    assert (spec.kind, spec.host, spec.port, spec.text) == ("udp", "0.0.0.0", 2368, text)
    assert spec.options == {
        "group": "239.1.2.3",
        "source": "192.168.1.201",
        "interface": "eth1",
        "buffer_mb": "8",
    }
    assert isinstance(open_transport(spec), UdpTransport)


@pytest.mark.parametrize(
    ("text", "host", "port"),
    [
        ("tcp:192.168.3.1:28784?silent_s=30.5", "192.168.3.1", 28784),
        ("tcp:moxa.local:4001", "moxa.local", 4001),
        ("tcp:[fe80::1]:5017", "fe80::1", 5017),
    ],
)
def test_tcp_addresses_are_parsed(text: str, host: str, port: int) -> None:
    spec = parse_transport(text)
    assert (spec.kind, spec.host, spec.port, spec.text) == ("tcp", host, port, text)
    assert isinstance(open_transport(spec), TcpTransport)


def test_serial_path_and_flags_are_parsed() -> None:
    spec = parse_transport("serial:/dev/serial/by-id/usb-u-blox:00?baud=921600&parity=E&rtscts=yes&xonxoff=0")
    assert (spec.kind, spec.address) == ("serial", "/dev/serial/by-id/usb-u-blox:00")
    assert spec.flag("rtscts")
    assert not spec.flag("xonxoff")
    assert not spec.flag("dsrdtr")
    assert isinstance(open_transport(spec), SerialTransport)


@pytest.mark.parametrize(
    ("text", "interface", "channel", "transport"),
    [
        ("can:socketcan:can0?bitrate=1000000", "socketcan", "can0", SocketCanTransport),
        ("can:udp_multicast:ff15:7079:7468::73?port=43113", "udp_multicast", "ff15:7079:7468::73", PythonCanTransport),
        ("can:slcan:/dev/ttyUSB0?bitrate=500000", "slcan", "/dev/ttyUSB0", PythonCanTransport),
    ],
)
def test_can_addresses_are_parsed(text: str, interface: str, channel: str, transport: type) -> None:
    spec = parse_transport(text)
    assert (spec.interface, spec.channel) == (interface, channel)
    assert isinstance(open_transport(spec), transport)


def test_an_address_inside_a_gnss_stream_cannot_be_opened() -> None:
    spec = parse_transport("gnss:rover")
    assert (spec.kind, spec.address) == ("gnss", "rover")
    with pytest.raises(ValueError, match="cannot be opened itself"):
        open_transport(spec)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "want serial:<path>"),
        ("tcp:1.2.3.4", "want tcp:<host>:<port>, such as tcp:192.168.3.1:28784"),
        ("tcp:1.2.3.4:0", "port '0' should be 1 to 65535"),
        ("tcp:a..b:5000", "host 'a..b' is not a valid host name"),
        ("tcp:1.2.3.4:5000?silent_s=0", "silent_s=0 should be seconds, 1 to 86400"),
        ("tcp:1.2.3.4:5000?silent_s=nan", "silent_s=nan should be seconds, 1 to 86400"),
        ("tcp:1.2.3.4:5000?baud=9600", "unknown option 'baud'; tcp knows: silent_s"),
        ("/dev/ttyUSB0:460800", "want serial:/dev/ttyUSB0?baud=460800"),
        ("/dev/serial/by-id/usb-u-blox:00:9600", "want serial:/dev/serial/by-id/usb-u-blox:00?baud=9600"),
        ("/dev/ttyUSB0", "want serial:/dev/ttyUSB0?baud=921600"),
        ("192.168.3.1:28784", "want tcp:192.168.3.1:28784 or udp:0.0.0.0:28784"),
        ("udp", "want serial:<path>"),
        ("udp:2368", "want udp:<IPv4 address>:<port>"),
        ("udp:localhost:2368", "want udp:<IPv4 address>:<port>"),
        ("udp:0.0.0.0:70000", "port '70000' should be 1 to 65535"),
        ("udp:0.0.0.0:0", "port '0' should be 1 to 65535"),
        ("udp:0.0.0.0:٢٣", "should be 1 to 65535"),
        ("udp:0.0.0.0:2368?grop=239.1.1.1", "unknown option 'grop'; udp knows: group, source, interface, buffer_mb"),
        ("udp:0.0.0.0:2368?group=10.0.0.1", "group=10.0.0.1 should be an IPv4 multicast address"),
        ("udp:0.0.0.0:2368?source=scanner", "source=scanner should be the sender's IPv4 address"),
        ("udp:0.0.0.0:2368?buffer_mb=4000", "buffer_mb=4000 should be whole mebibytes, 1 to 1023"),
        ("udp:0.0.0.0:2368?", "option '' should be <keyword>=<value>"),
        ("udp:0.0.0.0:2368?group", "option 'group' should be <keyword>=<value>"),
        ("udp:0.0.0.0:2368?buffer_mb=1&buffer_mb=2", "option 'buffer_mb' is given twice"),
        ("serial:", "want serial:<path>"),
        ("serial:/dev/ttyUSB0?baud=fast", "baud=fast should be a whole number, 1 to 20000000"),
        ("serial:/dev/ttyUSB0?baud=-1", "baud=-1 should be a whole number"),
        ("serial:/dev/ttyUSB0?baud=0", "baud=0 should be a whole number, 1 to 20000000"),
        ("serial:/dev/ttyUSB0?baud=20000001", "baud=20000001 should be a whole number, 1 to 20000000"),
        ("serial:/dev/ttyUSB0?baud=2147483648", "baud=2147483648 should be a whole number, 1 to 20000000"),
        ("serial:/dev/ttyUSB0?parity=even", "parity=even should be N, E, O, M or S"),
        ("serial:/dev/ttyUSB0?stopbits=3", "stopbits=3 should be 1, 1.5 or 2"),
        ("serial:/dev/ttyUSB0?rtscts=maybe", "rtscts=maybe should be yes or no"),
        ("can:can0", "want can:<interface>:<channel>"),
        ("can:sockecan:can0", "unknown CAN interface 'sockecan'; python-can has: "),
        ("can:slcan:/dev/ttyUSB0?channel=3", "channel is not an option; want can:<interface>:<channel>?…"),
        ("can:virtual:x?interface=y", "interface is not an option"),
        ("can:socketcan:can0?bitrat=5", "unknown option 'bitrat'"),
        ("serial:/dev/a\0b", "contains an unprintable character"),
        ("can:socketcan:a\0b", "contains an unprintable character"),
        ("udp:0.0.0.0:2368?interface=eth1\n", "contains an unprintable character"),
        ("gnss:", "want gnss:<name>"),
        ("gnss:rover?baud=5", "want gnss:<name>"),
    ],
)
def test_error_for_a_wrong_address_shows_a_valid_one(text: str, says: str) -> None:
    with pytest.raises(ValueError) as caught:
        parse_transport(text)
    assert says in str(caught.value)
    assert repr(text) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_two_spellings_of_one_device_are_the_same_device(tmp_path: Path) -> None:
    link = tmp_path / "gnss"
    link.symlink_to("/dev/null")
    assert parse_transport(f"serial:{link}").device == parse_transport("serial:/dev/null?baud=9600").device
    first = parse_transport("udp:0.0.0.0:2368?group=239.1.2.3").device
    assert first != parse_transport("udp:0.0.0.0:2368?group=239.1.2.4").device
    assert first == parse_transport("udp:192.168.1.1:2368?group=239.1.2.3&buffer_mb=3").device


def test_pps_addresses_are_parsed() -> None:
    assert isinstance(open_pps(parse_pps("/dev/pps0")), KernelPps)
    assert isinstance(open_pps(parse_pps("serial-dcd:/dev/ttyS0", edge="clear")), SerialDcdPps)
    assert isinstance(open_pps(parse_pps("fixed:edges.txt")), FixedPps)


@pytest.mark.parametrize("text", ["", "pps0", "fixed:", "serial-dcd:", "gpio:4"])
def test_error_for_a_wrong_pps_address_shows_a_valid_one(text: str) -> None:
    with pytest.raises(ValueError, match="want /dev/pps0, serial-dcd:/dev/ttyS0 or fixed:<path>"):
        parse_pps(text)


@pytest.mark.parametrize("text", ["fixed:x\0y", "/dev/pps\0", "serial-dcd:/dev/tty\x1bS0"])
def test_a_pps_address_with_a_control_character_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="contains an unprintable character"):
        parse_pps(text)


def test_a_wrong_pps_edge_is_refused() -> None:
    with pytest.raises(ValueError, match="want assert or clear"):
        parse_pps("/dev/pps0", edge="rising")


@pytest.mark.parametrize(
    ("text", "value"),
    [("500000", 500000), ("0x10", 16), ("0.5", 0.5), ("true", True), ("No", False), ("/dev/ttyUSB0", "/dev/ttyUSB0")],
)
def test_options_are_converted_to_the_types_of_python_can(text: str, value: object) -> None:
    got = keyword_value(text)
    assert got == value
    assert type(got) is type(value)
