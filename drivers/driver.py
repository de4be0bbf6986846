"""Finds protocol files by what they declare: no list to edit when a device is added."""

from __future__ import annotations

import importlib
import pkgutil
from functools import cache

from swath.drivers.parser import DeviceKind, Driver

KINDS: tuple[DeviceKind, ...] = ("gnss", "imu", "scanner", "corrections")


class UnknownProtocolError(LookupError):
    """No driver of that kind has that protocol; the text lists those there are."""


@cache
def all_drivers(kind: DeviceKind) -> dict[str, Driver]:
    """All drivers of a kind by protocol name, from the ``DRIVERS`` of each module in its folder."""
    package = importlib.import_module(f"drivers.{kind}")
    found: dict[str, Driver] = {}
    for info in sorted(pkgutil.iter_modules(package.__path__), key=lambda info: info.name):
        module = importlib.import_module(f"drivers.{kind}.{info.name}")
        for driver in getattr(module, "DRIVERS", ()):
            if driver.protocol in found:
                raise RuntimeError(f"two drivers declare {kind} protocol {driver.protocol!r}")
            found[driver.protocol] = driver
    return found


def find_driver(kind: DeviceKind, protocol: str) -> Driver:
    """The driver of a protocol.

    Raises:
        UnknownProtocolError: with the names that would be right.
    """
    drivers = all_drivers(kind)
    try:
        return drivers[protocol]
    except KeyError:
        known = ", ".join(sorted(drivers))
        raise UnknownProtocolError(f"no {kind} protocol {protocol!r}; there are: {known}") from None
