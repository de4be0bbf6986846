"""Finds protocol files by what they declare: no list to edit when a device is added."""

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

TransportKind = Literal["serial", "can", "udp", "gnss", "ntrip"]

KINDS: tuple[DeviceKind, ...] = ("gnss", "imu", "scanner", "corrections")


class UnknownProtocolError(LookupError):
    """No driver of that kind has that protocol; the text lists those there are."""


@cache
def all_drivers(kind: DeviceKind) -> dict[str, Driver]:
    """Return all drivers of a kind by protocol name, from the ``DRIVERS`` of each module, or of each package's
    ``parser``.
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
        UnknownProtocolError: with the names that would be right.
    """
    drivers = all_drivers(kind)
    try:
        return drivers[protocol]
    except KeyError:
        known = ", ".join(sorted(drivers))
        raise UnknownProtocolError(f"no {kind} protocol {protocol!r}; there are: {known}") from None


@dataclass(frozen=True, slots=True)
class Driver:
    """What a protocol file declares in its ``DRIVERS`` tuple.

    Attributes:
        protocol: the name in the configuration.
        kind: gnss, imu, scanner or corrections.
        transports: kinds of transport it can come by.
        yields: record types it gives.
        summary: one line for ``swath devices``.
        make_parser: builds the parser of everything.
        make_time_parser: builds the parser the recorder runs: time messages (and device clock samples) only; None
            where the device says no time.
        make_probe: builds the parser that only counts what looks like this protocol, where make_parser needs more than
            defaults; it is asked when another protocol was configured.
        names_edge: which edge its time messages name by default; None where mixed or none.
        tells_pps: whether a latch in its clock samples is the device's own word, not only the configuration's.
        needs: configuration keys without which it cannot work.
        line_scanner: of a scanner: one beam, which goes as the configuration's ``geometry`` declares. The parser of any
            other has ``beams``, a `swath.drivers.scanner.beams.BeamTable`, by which returns are georeferenced.
        wavelength_nm: of a scanner's light, by its maker's data sheet; None: 1064, as of most airborne ones.
        eight_bit_intensity: whether a scanner's intensities are 0 to 255.
        past_hour: whether a scanner's device time is that past the full hour of UTC.
        startup: builds the messages a device needs before a survey, in the order they are sent, and raises
            `DriverSettingsError`; None where there are none.
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
    wavelength_nm: float | None = None
    eight_bit_intensity: bool = False
    past_hour: bool = False
    startup: Callable[[DeviceSettings, StartupOptions], tuple[StartupMessage, ...]] | None = None
