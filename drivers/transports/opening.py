"""Makes the transport or PPS source for a specification of `swath.drivers.transports.spec`."""

from __future__ import annotations

from collections.abc import Callable

from swath.drivers.transports.base import PpsSource, Transport
from swath.drivers.transports.can.socketcan import SocketCanTransport
from swath.drivers.transports.ntrip import NtripTransport
from swath.drivers.transports.pps.fixed import FixedPps
from swath.drivers.transports.pps.kernel import KernelPps
from swath.drivers.transports.pps.serial_dcd import SerialDcdPps
from swath.drivers.transports.serial_port import SerialTransport
from swath.drivers.transports.spec import PpsSpec, TransportSpec
from swath.drivers.transports.tcp_socket import TcpTransport
from swath.drivers.transports.udp_socket import UdpTransport


def open_transport(spec: TransportSpec, stopped: Callable[[], bool] = lambda: False) -> Transport:
    """Return the transport for ``spec``, not yet opened.

    Args:
        spec: the transport to make.
        stopped: called while opening waits for a distant computer; True ends the wait.

    Raises:
        ValueError: the kind has no transport of its own (gnss, imu, raw).
    """
    if spec.kind == "udp":
        return UdpTransport(spec)
    if spec.kind == "serial":
        return SerialTransport(spec)
    if spec.kind == "tcp":
        return TcpTransport(spec, stopped)
    if spec.kind == "can":
        return _open_can(spec)
    if spec.kind == "ntrip":
        return NtripTransport(spec, stopped)
    raise ValueError(f"transport {spec.text!r}: is inside the stream of another device and cannot be opened itself")


def _open_can(spec: TransportSpec) -> Transport:
    if spec.interface == "socketcan":
        return SocketCanTransport(spec)
    from swath.drivers.transports.can.adapter import PythonCanTransport

    return PythonCanTransport(spec)


def open_pps(spec: PpsSpec) -> PpsSource:
    """Return the source of edges for ``spec``, not yet opened."""
    if spec.kind == "device":
        return KernelPps(spec.path, spec.edge)
    if spec.kind == "serial-dcd":
        return SerialDcdPps(spec.path, spec.edge)
    return FixedPps(spec.path, spec.edge)
