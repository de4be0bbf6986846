"""Parses transport and PPS texts of the configuration into `TransportSpec` and `PpsSpec`.

serial:<path>?baud=921600&bytesize=8&parity=N&stopbits=1&rtscts=no&xonxoff=no&dsrdtr=no
udp:<host>:<port>?group=239.1.2.3&source=192.168.1.201&interface=eth1&buffer_mb=32
tcp:<host>:<port>?silent_s=10
can:<interface>:<channel>?<keyword>=<value>…
gnss:<name>
imu:<name>
scanner:<name>
raw:<name>
ntrip:<host>:<port>/<mountpoint>?user=<name>&password_env=<variable>&version=2&position=47.5,8.7,500
"""

from __future__ import annotations

import ipaddress
import os
from collections.abc import Callable
from dataclasses import dataclass, field

PPS_FORMS = "/dev/pps0, serial-dcd:/dev/ttyS0 or fixed:<path>"
FORMS = (
    "serial:<path>, udp:<host>:<port>, tcp:<host>:<port>, can:<interface>:<channel>, gnss:<name>, imu:<name>, "
    "scanner:<name>, raw:<name> or ntrip:<host>:<port>/<mountpoint>"
)
CARRIERS = ("gnss", "imu", "scanner", "raw")  # kinds of device whose stream can hold another device
MAX_BUFFER_MB = 1023  # the kernel stores twice the value in an int
MAX_SILENT_S = 86_400
MAX_BAUD = 20_000_000  # no UART is faster; the kernel's speed is an int of 32 bits

_TRUE = {"1", "true", "yes", "on"}
_FALSE = {"0", "false", "no", "off"}


@dataclass(frozen=True, slots=True)
class TransportSpec:
    """One checked transport of the configuration.

    Attributes:
        kind: "serial", "udp", "tcp", "can", "ntrip"; or one of `CARRIERS` (inside the stream of that device: no
            transport of its own).
        address: the text between the kind and the options.
        options: keyword to value, as text.
        text: the whole text, as configured.
    """

    kind: str
    address: str
    options: dict[str, str] = field(default_factory=dict)
    text: str = ""

    @property
    def host(self) -> str:
        """Local address of a UDP port; name or address of a TCP server."""
        return self.address.rpartition(":")[0].strip("[]")

    @property
    def port(self) -> int:
        """Port number of a UDP port or a TCP server."""
        return int(self.address.rpartition(":")[2])

    @property
    def interface(self) -> str:
        """Kind of CAN interface by python-can's name (socketcan, slcan, …)."""
        return self.address.partition(":")[0]

    @property
    def channel(self) -> str:
        """CAN channel (can0, /dev/ttyUSB0, 239.74.163.2)."""
        return self.address.partition(":")[2]

    @property
    def ntrip_host(self) -> str:
        """A caster's name or address."""
        return self.address.partition("/")[0].rpartition(":")[0].strip("[]")

    @property
    def ntrip_port(self) -> int:
        """A caster's port number."""
        return int(self.address.partition("/")[0].rpartition(":")[2])

    @property
    def mountpoint(self) -> str:
        """Mountpoint of a caster."""
        return self.address.partition("/")[2]

    @property
    def carrier(self) -> str | None:
        """Source whose stream holds the device's bytes, as ``gnss/rover``; None: the transport is a wire of its own."""
        return f"{self.kind}/{self.address}" if self.kind in CARRIERS else None

    @property
    def device(self) -> str:
        """Identity of the port, bus or device: equal for two texts that mean the same one, which only one source can
        have.
        """
        if self.kind == "serial":
            return f"serial:{os.path.realpath(self.address)}"
        if self.kind == "udp":
            return f"udp:{self.options.get('group', self.host)}:{self.port}"
        return f"{self.kind}:{self.address}"

    def flag(self, key: str, default: bool = False) -> bool:
        """Return the value of a yes-or-no option."""
        return _boolean(self.options[key]) if key in self.options else default


def parse_transport(text: str) -> TransportSpec:
    """Parse and check a transport text.

    Raises:
        ValueError: the text is invalid; the message names the error and a valid form.
    """
    refuse_unprintable("transport", text)
    kind, colon, rest = text.partition(":")
    if kind not in _CHECKS or not colon:
        raise ValueError(f"transport {text!r}: want {_meant(text) or FORMS}")
    address, question, query = rest.partition("?")
    options = _parse_options(text, query) if question else {}
    spec = TransportSpec(kind, address, options, text)
    _CHECKS[kind](spec)
    return spec


def _meant(text: str) -> str:
    """Return the transport that a text in the form of other programs means; "" if there is none to guess."""
    place, colon, number = text.partition("?")[0].rpartition(":")
    if text.startswith("/"):
        path, baud = (place, number) if colon and number.isdecimal() else (text.partition("?")[0], "921600")
        return f"serial:{path}?baud={baud}"
    if place not in ("", *_CHECKS) and not {"/", ":"} & set(place) and _is_port(number):
        return f"tcp:{place}:{number} or udp:0.0.0.0:{number}"
    return ""


def refuse_unprintable(what: str, text: str) -> None:
    """Refuse unprintable characters with `ValueError`: no path, name or address has any, and the system rejects a zero
    byte.
    """
    if not text.isprintable():
        raise ValueError(f"{what} {text!r}: contains an unprintable character; want a path, name or address")


def _parse_options(text: str, query: str) -> dict[str, str]:
    options: dict[str, str] = {}
    for item in query.split("&"):
        key, equals, value = item.partition("=")
        if not key or not equals or not value:
            raise ValueError(f"transport {text!r}: option {item!r} should be <keyword>=<value>, joined by '&'")
        if key in options:
            raise ValueError(f"transport {text!r}: option {key!r} is given twice")
        options[key] = value
    return options


def _boolean(value: str) -> bool:
    if value.lower() in _TRUE:
        return True
    if value.lower() in _FALSE:
        return False
    raise ValueError(f"{value!r} is neither yes nor no")


def _ipv4(value: str) -> bool:
    ipaddress.IPv4Address(value)
    return True


def _positive(value: str) -> bool:
    if not value.isascii() or not value.isdecimal() or int(value) == 0:
        raise ValueError("not a positive whole number")
    return True


def _one_of(*values: str) -> Callable[[str], bool]:
    def check(value: str) -> bool:
        if value not in values:
            raise ValueError(f"not one of {values}")
        return True

    return check


def _multicast(value: str) -> bool:
    if not ipaddress.IPv4Address(value).is_multicast:
        raise ValueError("not multicast")
    return True


def _buffer_mb(value: str) -> bool:
    if _positive(value) and int(value) > MAX_BUFFER_MB:
        raise ValueError("too large")
    return True


def _silent_s(value: str) -> bool:
    if not 1.0 <= float(value) <= MAX_SILENT_S:
        raise ValueError("out of bounds")
    return True


def _is_port(value: str) -> bool:
    return value.isascii() and value.isdecimal() and 1 <= int(value) <= 65535


def _baud(value: str) -> bool:
    if _positive(value) and int(value) > MAX_BAUD:
        raise ValueError("too fast")
    return True


def ntrip_position(value: str) -> tuple[float, float, float]:
    """Return latitude and longitude in degrees and height in m of ``47.5,8.7,500``; raises ValueError for any other
    text.
    """
    lat, lon, height = (float(part) for part in value.split(","))
    if not (abs(lat) <= 90.0 and abs(lon) <= 180.0 and abs(height) <= 10_000.0):
        raise ValueError("not on earth")
    return lat, lon, height


def _printable(value: str) -> bool:
    if not value.isprintable() or ":" in value:
        raise ValueError("not printable")
    return True


def _variable(value: str) -> bool:
    if not value.isidentifier():
        raise ValueError("not a variable's name")
    return True


_Option = tuple[Callable[[str], object], str]

# option: (check, description of a valid value)
SERIAL_OPTIONS: dict[str, _Option] = {
    "baud": (_baud, f"a whole number, 1 to {MAX_BAUD}, such as 921600"),
    "bytesize": (_one_of("5", "6", "7", "8"), "5, 6, 7 or 8"),
    "parity": (_one_of("N", "E", "O", "M", "S"), "N, E, O, M or S"),
    "stopbits": (_one_of("1", "1.5", "2"), "1, 1.5 or 2"),
    "rtscts": (_boolean, "yes or no"),
    "xonxoff": (_boolean, "yes or no"),
    "dsrdtr": (_boolean, "yes or no"),
}
UDP_OPTIONS: dict[str, _Option] = {
    "group": (_multicast, "an IPv4 multicast address such as 239.1.2.3"),
    "source": (_ipv4, "the sender's IPv4 address such as 192.168.1.201"),
    "interface": (bool, "an interface such as eth1"),
    "buffer_mb": (_buffer_mb, f"whole mebibytes, 1 to {MAX_BUFFER_MB}"),
}
TCP_OPTIONS: dict[str, _Option] = {
    "silent_s": (_silent_s, f"seconds, 1 to {MAX_SILENT_S}, after which a mute connection is made anew"),
}
SOCKETCAN_OPTIONS: dict[str, _Option] = {
    "bitrate": (_positive, "bits per second such as 1000000"),
    "data_bitrate": (_positive, "bits per second such as 4000000"),
    "fd": (_boolean, "yes or no"),
    "buffer_mb": (_buffer_mb, f"whole mebibytes, 1 to {MAX_BUFFER_MB}"),
}


NTRIP_OPTIONS: dict[str, _Option] = {
    "user": (_printable, "a user's name, without a colon"),
    "password_env": (_variable, "the name of the environment variable that holds the password"),
    "version": (_one_of("1", "2"), "1 or 2"),
    "position": (ntrip_position, "latitude,longitude,height in degrees and metres, such as 47.5,8.7,500"),
}


def _check_options(spec: TransportSpec, table: dict[str, _Option]) -> None:
    for key, value in spec.options.items():
        if key not in table:
            known = ", ".join(table) or "none"
            raise ValueError(f"transport {spec.text!r}: unknown option {key!r}; {spec.kind} knows: {known}")
        check, want = table[key]
        try:
            check(value)
        except ValueError:
            raise ValueError(f"transport {spec.text!r}: {key}={value} should be {want}") from None


def _check_serial(spec: TransportSpec) -> None:
    if not spec.address:
        raise ValueError(f"transport {spec.text!r}: want serial:<path>, such as serial:/dev/ttyUSB0?baud=921600")
    _check_options(spec, SERIAL_OPTIONS)


def _check_udp(spec: TransportSpec) -> None:
    host, colon, port = spec.address.rpartition(":")
    try:
        valid = bool(colon) and _ipv4(host)
    except ValueError:
        valid = False
    if not valid:
        raise ValueError(f"transport {spec.text!r}: want udp:<IPv4 address>:<port>, such as udp:0.0.0.0:2368")
    if not _is_port(port):
        raise ValueError(f"transport {spec.text!r}: port {port!r} should be 1 to 65535")
    _check_options(spec, UDP_OPTIONS)


def _check_tcp(spec: TransportSpec) -> None:
    host, colon, port = spec.address.rpartition(":")
    if not host or not colon or "/" in spec.address or " " in spec.address:
        raise ValueError(f"transport {spec.text!r}: want tcp:<host>:<port>, such as tcp:192.168.3.1:28784")
    if not _is_port(port):
        raise ValueError(f"transport {spec.text!r}: port {port!r} should be 1 to 65535")
    _check_host(spec, spec.host)
    _check_options(spec, TCP_OPTIONS)


def _check_can(spec: TransportSpec) -> None:
    if not spec.interface or not spec.channel:
        raise ValueError(f"transport {spec.text!r}: want can:<interface>:<channel>, such as can:socketcan:can0")
    if spec.interface == "socketcan":
        _check_options(spec, SOCKETCAN_OPTIONS)
        return
    from can.interfaces import VALID_INTERFACES

    if spec.interface not in VALID_INTERFACES:
        known = ", ".join(sorted(VALID_INTERFACES))
        raise ValueError(f"transport {spec.text!r}: unknown CAN interface {spec.interface!r}; python-can has: {known}")
    if taken := [key for key in ("interface", "channel", "ignore_config") if key in spec.options]:
        raise ValueError(f"transport {spec.text!r}: {taken[0]} is not an option; want can:<interface>:<channel>?…")


def _check_carrier(spec: TransportSpec) -> None:
    if not spec.address or spec.options:
        want = f"{spec.kind}:<name> of a [{spec.kind}.<name>] section, without options"
        raise ValueError(f"transport {spec.text!r}: want {want}")


def _check_host(spec: TransportSpec, host: str) -> None:
    """Refuse a name that the resolver would not accept: it first encodes the name, as Python does here."""
    try:
        valid = bool(host.encode("idna"))
    except UnicodeError:
        valid = False
    if not valid:
        raise ValueError(
            f"transport {spec.text!r}: host {host!r} is not a valid host name: want 1 to 63 letters between its dots"
        )


def _check_ntrip(spec: TransportSpec) -> None:
    place, _, mountpoint = spec.address.partition("/")
    host, _, port = place.rpartition(":")
    if not host or not mountpoint or not all(letter.isprintable() and letter != " " for letter in spec.address):
        raise ValueError(
            f"transport {spec.text!r}: want ntrip:<host>:<port>/<mountpoint>, such as ntrip:caster.example:2101/ZIMM0"
        )
    if not _is_port(port):
        raise ValueError(f"transport {spec.text!r}: port {port!r} should be 1 to 65535, such as 2101")
    _check_host(spec, spec.ntrip_host)
    _check_options(spec, NTRIP_OPTIONS)
    if "password_env" in spec.options and "user" not in spec.options:
        raise ValueError(f"transport {spec.text!r}: password_env needs user=<name> too")


_CHECKS: dict[str, Callable[[TransportSpec], None]] = {
    "serial": _check_serial,
    "udp": _check_udp,
    "tcp": _check_tcp,
    "can": _check_can,
    "gnss": _check_carrier,
    "imu": _check_carrier,
    "scanner": _check_carrier,
    "raw": _check_carrier,
    "ntrip": _check_ntrip,
}


@dataclass(frozen=True, slots=True)
class PpsSpec:
    """A source of pulse-per-second edges, as the configuration names it.

    Attributes:
        kind: "device" (the kernel's PPS API), "serial-dcd" or "fixed".
        path: path of the device, the serial port, or the file of edges.
        edge: "assert" or "clear".
    """

    kind: str
    path: str
    edge: str


def parse_pps(text: str, edge: str = "assert") -> PpsSpec:
    """Parse and check the text of a PPS source.

    Raises:
        ValueError: the text is invalid; the message names the error and a valid form.
    """
    refuse_unprintable("PPS source", text)
    if edge not in ("assert", "clear"):
        raise ValueError(f"PPS edge {edge!r}: want assert or clear")
    kind, colon, path = text.partition(":")
    if text.startswith("/"):
        return PpsSpec("device", text, edge)
    if kind == "serial-dcd" and colon and path:
        return PpsSpec(kind, path, edge)
    if kind == "fixed" and colon and path:
        return PpsSpec(kind, path, edge)
    raise ValueError(f"PPS source {text!r}: want {PPS_FORMS}")
