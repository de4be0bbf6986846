"""Finds drivers of other packages by their entry points in the group ``swath.drivers``.

The name of an entry point is the protocol, its object a `swath.drivers.driver.Driver` or a tuple of them, one for each
kind of device. A package is imported only if its protocol is asked for, or all protocols are. What is wrong with a
package concerns no other device.
"""

from __future__ import annotations

import importlib.metadata
import re
from collections import defaultdict
from dataclasses import dataclass
from functools import cache
from typing import Any

GROUP = "swath.drivers"
PROTOCOL = re.compile(r"[a-z0-9]+(-[a-z0-9]+)*")
REMEDY = "install what it needs, or a version of it for this Swath, or uninstall it"


@dataclass(frozen=True, slots=True)
class Package:
    """Name and version of an installed package."""

    name: str
    version: str

    def __str__(self) -> str:
        """Return ``name version``."""
        return f"{self.name} {self.version}"


UNREADABLE = Package("(metadata unreadable)", "")


@dataclass(frozen=True, slots=True)
class NotLoaded:
    """A driver of another package that cannot be used.

    Attributes:
        protocol: name of its entry point; empty: no entry point can be read.
        package: its package.
        reason: why, with the remedy, in one line.
    """

    protocol: str
    package: Package
    reason: str

    def __str__(self) -> str:
        """Return the line for the user, without the protocol."""
        return f"package {self.package} is not loaded: {self.reason}"


@dataclass(frozen=True, slots=True)
class EntryPoints:
    """The entry points of all installed packages.

    Attributes:
        of: package and entry point by protocol, sorted; several packages may declare the same.
        fault: why there are none, if the metadata of the installed packages cannot be read.
    """

    of: dict[str, list[tuple[Package, importlib.metadata.EntryPoint]]]
    fault: NotLoaded | None = None


@cache
def entry_points() -> EntryPoints:
    """Return the entry points of all installed packages; none of them is imported."""
    found: dict[str, list[tuple[Package, importlib.metadata.EntryPoint]]] = defaultdict(list)
    try:
        for entry in importlib.metadata.entry_points(group=GROUP):
            found[entry.name].append((_package_of(entry), entry))
        for several in found.values():
            several.sort(key=lambda one: str(one[0]))
    except Exception as error:  # one damaged file of any package in the environment
        return EntryPoints({}, NotLoaded("", UNREADABLE, f"{_words(error)}; reinstall the damaged package"))
    return EntryPoints(dict(sorted(found.items())))


def _package_of(entry: importlib.metadata.EntryPoint) -> Package:
    try:
        return UNREADABLE if entry.dist is None else Package(str(entry.dist.name), str(entry.dist.version))
    except Exception:  # its METADATA is damaged
        return UNREADABLE


def imported(protocol: str) -> tuple[Package, tuple[Any, ...]] | list[NotLoaded]:
    """Import what the package of a protocol declares for it; return package and objects, or why it cannot be used."""
    declared = entry_points().of[protocol]
    if len(declared) > 1:
        names = " and ".join(sorted(str(package) for package, _ in declared))
        return [NotLoaded(protocol, package, f"{names} declare it; uninstall all but one") for package, _ in declared]
    package, entry = declared[0]
    if not PROTOCOL.fullmatch(protocol):
        return [NotLoaded(protocol, package, "the name of a protocol has a-z, 0-9 and single hyphens; correct it")]
    try:
        loaded = entry.load()
    except (Exception, SystemExit) as error:
        return [NotLoaded(protocol, package, f"{_words(error)}; {REMEDY}")]
    return package, tuple(loaded) if isinstance(loaded, tuple | list) else (loaded,)


def _words(error: BaseException) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split())
