"""Opens what a transport's address names (`swath.drivers.transports.spec`)."""

from __future__ import annotations

from collections.abc import Callable

from swath.drivers.transports.base import PpsSource, Transport
from swath.drivers.transports.can.socketcan import SocketCanTransport
from swath.drivers.transports.ntrip import NtripTransport
from swath.drivers.transports.pps.kernel import FixedPps, KernelPps, SerialDcdPps
from swath.drivers.transports.serial_port import SerialTransport
from swath.drivers.transports.spec import TransportSpec, refuse_unprintable
from swath.drivers.transports.udp_socket import UdpTransport

PPS_FORMS = "/dev/pps0, serial-dcd:/dev/ttyS0 or fixed:<path>"


def open_transport(spec: TransportSpec, stopped: Callable[[], bool] = lambda: False) -> Transport:
    """The transport for ``spec``, not yet opened; ``stopped`` is asked while opening waits for a distant computer.

    Raises:
        ValueError: the kind has no transport of its own (gnss).
    """
    if spec.kind == "udp":
        return UdpTransport(spec)
    if spec.kind == "serial":
        return SerialTransport(spec)
    if spec.kind == "can":
        return _open_can(spec)
    if spec.kind == "ntrip":
        return NtripTransport(spec, stopped)
    raise ValueError(f"transport {spec.text!r}: is inside another device's stream, there is nothing to open")


def _open_can(spec: TransportSpec) -> Transport:
    if spec.interface == "socketcan":
        return SocketCanTransport(spec)
    from swath.drivers.transports.can.adapter import PythonCanTransport

    return PythonCanTransport(spec)


def parse_pps(text: str, edge: str = "assert") -> PpsSource:
    """The PPS source for ``text``, not yet opened.

    Raises:
        ValueError: one line naming what is wrong and what would be right.
    """
    refuse_unprintable("PPS source", text)
    if edge not in ("assert", "clear"):
        raise ValueError(f"PPS edge {edge!r}: want assert or clear")
    kind, colon, path = text.partition(":")
    if text.startswith("/"):
        return KernelPps(text, edge)
    if kind == "serial-dcd" and path.startswith("/"):
        return SerialDcdPps(path, edge)
    if kind == "fixed" and colon and path:
        return FixedPps(path, edge)
    raise ValueError(f"PPS source {text!r}: want {PPS_FORMS}")
