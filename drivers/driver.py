"""Finds drivers by the ``DRIVERS`` tuples of the protocol files; a new device needs no entry in any list."""

from __future__ import annotations

import importlib
import importlib.util
import pkgutil
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Literal

from swath.drivers.parser import DeviceKind, DeviceSettings, Parser
from swath.georef.records import NamesEdge

if TYPE_CHECKING:
    from swath.drivers.startup import StartupMessage, StartupOptions

TransportKind = Literal["serial", "can", "udp", "tcp", "gnss", "ntrip"]

STREAM_TRANSPORTS: tuple[TransportKind, ...] = ("serial", "udp", "tcp")  # every wire that carries a byte stream

KINDS: tuple[DeviceKind, ...] = ("gnss", "imu", "scanner", "corrections")


class UnknownProtocolError(LookupError):
    """No driver of that kind has that protocol; the text lists the protocols that exist."""


@cache
def all_drivers(kind: DeviceKind) -> dict[str, Driver]:
    """Return all drivers of a kind by protocol name, from the ``DRIVERS`` of each module or of each package's
    ``parser`` module.
    """
    package = importlib.import_module(f"swath.drivers.{kind}")
    found: dict[str, Driver] = {}
    for info in sorted(pkgutil.iter_modules(package.__path__), key=lambda info: info.name):
        name = f"{info.name}.parser" if info.ispkg else info.name
        if info.ispkg and importlib.util.find_spec(f"swath.drivers.{kind}.{name}") is None:
            continue
        module = importlib.import_module(f"swath.drivers.{kind}.{name}")
        for driver in getattr(module, "DRIVERS", ()):
            if driver.protocol in found:
                raise RuntimeError(f"two drivers declare {kind} protocol {driver.protocol!r}")
            found[driver.protocol] = driver
    return found


def find_driver(kind: DeviceKind, protocol: str) -> Driver:
    """Return the driver of a protocol.

    Raises:
        UnknownProtocolError: the protocol is unknown; the text lists the known ones.
    """
    drivers = all_drivers(kind)
    try:
        return drivers[protocol]
    except KeyError:
        known = ", ".join(sorted(drivers))
        raise UnknownProtocolError(f"unknown {kind} protocol {protocol!r}; there are: {known}") from None


@dataclass(frozen=True, slots=True)
class Driver:
    """Holds what a protocol file declares about one protocol in its ``DRIVERS`` tuple.

    Attributes:
        protocol: its name in the configuration.
        kind: gnss, imu, scanner or corrections.
        transports: kinds of transport that can carry it; `STREAM_TRANSPORTS` for the byte stream of a port.
        yields: record types that its parser returns.
        summary: one line for ``swath devices``.
        make_parser: builds the parser of all record types.
        make_time_parser: builds the parser that the recorder runs, which returns time messages (and device clock
            samples) only; None where the device sends no time.
        make_probe: builds a parser that only counts messages of this protocol, where make_parser needs more than
            default settings; it is used to recognise this protocol when another one was configured.
        names_edge: which PPS edge its time messages refer to by default; None where they are mixed or refer to no edge.
        tells_pps: whether the device itself reports the PPS latch in its clock samples, rather than the configuration.
        needs: configuration keys that it requires.
        line_scanner: True for a scanner with one beam, whose path the configuration's ``geometry`` declares. The parser
            of any other scanner has ``beams``, a `swath.drivers.scanner.beams.BeamTable` to georeference returns.
        aimed: True for a scanner whose returns have an elevation beside the encoder's angle (`AIMED_RETURN_DTYPE`), and
            therefore neither a path nor beams.
        wavelength_nm: a scanner's wavelength by its maker's data sheet; None: 1064, as in most airborne scanners.
        eight_bit_intensity: whether a scanner's intensities range from 0 to 255.
        past_hour: whether a scanner's device time counts from the last full hour of UTC.
        startup: builds the messages that a device needs before a survey, in sending order, and raises
            `DriverSettingsError`; None where the device needs no such message.
    """

    protocol: str
    kind: DeviceKind
    transports: tuple[TransportKind, ...]
    yields: tuple[type, ...]
    summary: str
    make_parser: Callable[[DeviceSettings], Parser]
    make_time_parser: Callable[[DeviceSettings], Parser] | None = None
    make_probe: Callable[[DeviceSettings], Parser] | None = None
    names_edge: NamesEdge | None = None
    tells_pps: bool = True
    needs: tuple[str, ...] = ()
    line_scanner: bool = False
    aimed: bool = False
    wavelength_nm: float | None = None
    eight_bit_intensity: bool = False
    past_hour: bool = False
    startup: Callable[[DeviceSettings, StartupOptions], tuple[StartupMessage, ...]] | None = None
