"""Finds drivers by the ``DRIVERS`` tuples of the protocol files, and those of other packages by their entry points; a
new device needs no entry in any list.
"""

from __future__ import annotations

import difflib
import importlib
import importlib.util
import pkgutil
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import TYPE_CHECKING, Any, Literal, TypeVar, get_args

from swath.drivers import plugins
from swath.drivers.guard import guarded, guarded_call
from swath.drivers.options import Options
from swath.drivers.parser import ChosenRecords, DeviceKind, DeviceSettings, Parser, RawParser
from swath.drivers.plugins import NotLoaded, Package
from swath.georef.records import (
    ByteRows,
    EventMark,
    GnssFix,
    GnssHeading,
    NamesEdge,
    Record,
    ScannerReturns,
    TimeMessage,
)

if TYPE_CHECKING:
    from swath.drivers.startup import StartupMessage, StartupOptions

TransportKind = Literal["serial", "can", "udp", "tcp", "gnss", "imu", "scanner", "raw", "ntrip"]

STREAM_TRANSPORTS: tuple[TransportKind, ...] = ("serial", "udp", "tcp")  # every wire that carries a byte stream

INTERFACE = 1  # number of what `swath.drivers.interface` promises; a change that breaks a driver raises it

KINDS: tuple[DeviceKind, ...] = ("gnss", "imu", "scanner", "corrections")
MOST_ALIKE = 3
FOLDERS: dict[DeviceKind, tuple[str, ...]] = {  # where drivers of a kind are declared: a receiver may hold an IMU and
    "gnss": ("gnss", "imu"),  # an IMU a receiver, and one protocol file then declares both
    "imu": ("imu", "gnss"),
    "scanner": ("scanner",),
    "corrections": ("corrections",),
    "raw": (),
}
ParserT = TypeVar("ParserT", bound=Parser)
RAW = "raw"  # the protocol of a device that no driver reads; any kind may have it


RECEIVER_RECORDS = (TimeMessage, GnssFix, GnssHeading, EventMark)


class UnknownProtocolError(LookupError):
    """No driver of that kind has that protocol; the text names the one that was probably meant, or all that exist."""


class NotLoadedError(UnknownProtocolError):
    """The driver of that protocol is in another package that cannot be used; the text says why.

    Attributes:
        package: the other package.
    """

    def __init__(self, text: str, package: Package) -> None:
        super().__init__(text)
        self.package = package


@cache
def all_drivers(kind: DeviceKind) -> dict[str, Driver]:
    """Return all drivers of a kind by protocol name: Swath's own, and those of other packages that can be loaded."""
    others = [driver for protocol in plugins.entry_points().of for driver in _of_package(protocol)[0]]
    found = _built_in(kind) | {driver.protocol: driver for driver in others if driver.kind == kind}
    return dict(sorted(found.items()))


def not_loaded() -> list[NotLoaded]:
    """Return the drivers of other packages that cannot be used, with the reasons."""
    entries = plugins.entry_points()
    found = [line for protocol in entries.of for line in _of_package(protocol)[1]]
    return found if entries.fault is None else [entries.fault, *found]


@cache
def _built_in(kind: DeviceKind) -> dict[str, Driver]:
    """Return Swath's own drivers of a kind by protocol name, from the ``DRIVERS`` of each module or of each package's
    ``parser`` module.
    """
    found: dict[str, Driver] = {}
    for driver in (driver for folder in FOLDERS[kind] for driver in _declared_in(folder)):
        if driver.kind != kind:
            continue
        if driver.protocol in found:
            raise RuntimeError(f"two drivers declare {kind} protocol {driver.protocol!r}")
        found[driver.protocol] = driver
    return found


@cache
def _declared_in(folder: str) -> tuple[Driver, ...]:
    """Return the drivers of all kinds that the protocol files of a folder declare."""
    package = importlib.import_module(f"swath.drivers.{folder}")
    found: list[Driver] = []
    for info in sorted(pkgutil.iter_modules(package.__path__), key=lambda info: info.name):
        name = f"{info.name}.parser" if info.ispkg else info.name
        if info.ispkg and importlib.util.find_spec(f"swath.drivers.{folder}.{name}") is None:
            continue
        module = importlib.import_module(f"swath.drivers.{folder}.{name}")
        found += getattr(module, "DRIVERS", ())
    return tuple(found)


@cache
def _of_package(protocol: str) -> tuple[tuple[Driver, ...], list[NotLoaded]]:
    """Return the drivers that another package declares for a protocol, or why they cannot be used."""
    if protocol == RAW or any(protocol in _built_in(kind) for kind in KINDS):
        reason = "Swath itself has a protocol of this name, which is used; give the package's protocol another name"
        return (), [NotLoaded(protocol, package, reason) for package, _ in plugins.entry_points().of[protocol]]
    found = plugins.imported(protocol)
    if isinstance(found, list):
        return (), found
    package, declared = found
    try:
        fault = _fault(protocol, declared)
    except (AttributeError, TypeError) as error:  # a field is not of its type
        fault = f"its driver cannot be read: {error}; correct the package"
    if fault:
        return (), [NotLoaded(protocol, package, fault)]
    return tuple(_guarded(driver, package) for driver in declared), []


def _fault(protocol: str, declared: tuple[Any, ...]) -> str:
    """Return why the objects of an entry point cannot be used as drivers; empty: they can."""
    for driver in declared:
        if not isinstance(driver, Driver):
            return f"its entry point names a {type(driver).__name__}; want a Driver, or a tuple of them"
        if driver.interface != INTERFACE:
            other = "no interface" if driver.interface is None else f"interface {driver.interface}"
            return (
                f"it is written for {other} of drivers, this Swath has {INTERFACE}; install a version of the package "
                "for it"
            )
        if driver.protocol != protocol:
            return f"its driver has the protocol {driver.protocol!r}; give the entry point the same name"
        where = f"its {driver.kind} driver"
        if driver.kind not in KINDS:
            return f"{where} is of no kind; want one of {', '.join(KINDS)}"
        unknown = [one for one in driver.transports if one not in get_args(TransportKind)]
        if unknown or not driver.transports:
            return f"{where} names the transports {list(driver.transports)}; want some of {get_args(TransportKind)}"
        if not set(driver.yields) <= set(get_args(Record)) or (driver.kind == "scanner") != (
            ScannerReturns in driver.yields
        ):
            return f"{where} yields what such a device has not; want records, of a scanner ScannerReturns"
        if driver.options is not None and not (
            isinstance(driver.options, type) and issubclass(driver.options, Options)
        ):
            return f"{where} has options that are no subclass of swath.drivers.interface.Options"
    kinds = [driver.kind for driver in declared]
    return "" if kinds and len(set(kinds)) == len(kinds) else "it declares no driver, or two of one kind; want one"


def _guarded(driver: Driver, package: Package) -> Driver:
    """Return the driver of another package with all that it is called by guarded against its faults."""
    name = str(package)
    make, time, probe = driver.make_parser, driver.make_time_parser, driver.make_probe
    sent, startup = driver.sent_file, driver.startup
    return replace(
        driver,
        package=package,
        make_parser=guarded(make, name, driver.yields),
        make_time_parser=None if time is None else guarded(time, name, driver.yields),
        make_probe=None if probe is None else guarded(probe, name, driver.yields),
        sent_file=None if sent is None else replace(sent, find=guarded_call(sent.find, name)),
        startup=None if startup is None else guarded_call(startup, name, refuse=True),
    )


def find_driver(kind: DeviceKind, protocol: str, recorded_with: str = "") -> Driver:
    """Return the driver of a protocol.

    Args:
        kind: gnss, imu, scanner, corrections or raw.
        protocol: name of the protocol.
        recorded_with: name and version of the other package whose driver it was for the recorder of a log; empty: it
            was Swath's own, or no log is read.

    Raises:
        UnknownProtocolError: the protocol is unknown; the text names the package that is missing or cannot be loaded
            (`NotLoadedError`), those protocols that were probably meant, or all known ones.
    """
    if protocol == RAW:
        return raw_driver(kind)
    if protocol in (built_in := _built_in(kind)):
        return built_in[protocol]
    if protocol in plugins.entry_points().of:
        drivers, reasons = _of_package(protocol)
        if reasons:
            raise NotLoadedError(f"{kind} protocol {protocol!r}: {reasons[0]}", reasons[0].package)
        for driver in drivers:
            if driver.kind == kind:
                return driver
    elif recorded_with:
        raise UnknownProtocolError(
            f"{kind} protocol {protocol!r} is that of the package {recorded_with}, which is not installed here; "
            "install it beside swath"
        )
    known = all_drivers(kind)
    meant = probable_protocols(protocol, known)
    there = f"there are: {', '.join(sorted([*known, RAW]))}; others need their package installed beside swath"
    hint = f"did you mean {' or '.join(meant)}?" if meant else there
    raise UnknownProtocolError(f"unknown {kind} protocol {protocol!r}; {hint}")


def probable_protocols(wanted: str, drivers: Mapping[str, Driver]) -> list[str]:
    """Return the protocols that a misspelt name probably means.

    The first of these rules that finds any counts: the same letters and digits; the same without the maker; a part
    between the hyphens; a word of the summary (``septentrio``, ``OS1``); the name or all its words anywhere in protocol
    and summary (``PandarXT 32``); at most three similar names.
    """
    letters = _letters(wanted)
    if not letters:
        return []
    words = [_letters(word) for word in re.split(r"[^0-9A-Za-z]+", wanted) if word]
    in_words = {name: _letters(f"{name} {driver.summary}") for name, driver in drivers.items()}
    parts = {name: {name, *name.split("-")} for name in drivers}
    named = {name: set(map(_letters, re.split(r"[\s,:;]+", driver.summary))) for name, driver in drivers.items()}
    rules: tuple[Callable[[str], bool], ...] = (
        lambda name: _letters(name) == letters,
        lambda name: _letters(name.partition("-")[2]) == letters,
        lambda name: letters in map(_letters, parts[name]),
        lambda name: letters in named[name],
        lambda name: len(letters) > 2 and letters in in_words[name],
        lambda name: len(letters) > 2 and all(word in in_words[name] for word in words),
    )
    for rule in rules:
        if found := sorted(name for name in drivers if rule(name)):
            return found
    alike = {part: name for name in sorted(drivers) for part in parts[name]}
    close = difflib.get_close_matches(wanted.lower(), alike, n=MOST_ALIKE, cutoff=0.6)
    return list(dict.fromkeys(alike[part] for part in close))


def _letters(text: str) -> str:
    """Return the letters and digits of a text, in lower case."""
    return re.sub(r"[^0-9a-z]", "", text.lower())


@dataclass(frozen=True, slots=True)
class SentFile:
    """Describes what a device sends that serves as its ``geometry.file``, where none is configured.

    Attributes:
        what: its name in a message to the user, in the singular.
        find: returns the content from units (n, length) of equal length; None: they do not contain it.
        example: makes such content of no device, to try things out without data.
    """

    what: str
    find: Callable[[ByteRows], bytes | None]
    example: Callable[[], bytes]


@dataclass(frozen=True, slots=True)
class Driver:
    """Holds what a protocol file declares about one protocol in its ``DRIVERS`` tuple.

    Attributes:
        protocol: its name in the configuration.
        kind: gnss, imu, scanner or corrections.
        transports: kinds of transport that can carry it; `STREAM_TRANSPORTS` for the byte stream of a port; ``gnss``,
            ``imu`` or ``scanner`` for a device inside the stream of a receiver, inertial unit or scanner of the same
            protocol.
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
        bytes_per_s: the most that a device of this protocol sends, by its maker's data sheet; None: unknown, taken as
            that of a large scanner for a scanner, and as little for others.
        sent_file: what a scanner itself sends that serves as its ``geometry.file``; None: it sends no such thing.
        startup: builds the messages that a device needs before a survey, in sending order, and raises
            `DriverSettingsError`; None where the device needs no such message.
        options: model of the keys that only this driver knows, the table ``options`` of its section; None: it has none.
        interface: number of the `swath.drivers.interface` that it is written for, `INTERFACE`; a driver of another
            package must state it.
        package: the other package that it came from; None: Swath. Set when it is loaded.
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
    bytes_per_s: float | None = None
    sent_file: SentFile | None = None
    startup: Callable[[DeviceSettings, StartupOptions], tuple[StartupMessage, ...]] | None = None
    options: type[Options] | None = None
    interface: int | None = None
    package: Package | None = None


@cache
def raw_driver(kind: DeviceKind) -> Driver:
    """Return the driver of any device of a kind that is recorded as it comes, to be read later by a driver of its
    own.
    """
    return Driver(
        protocol=RAW,
        kind=kind,
        transports=(*STREAM_TRANSPORTS, "can", "ntrip"),
        yields=(),
        summary="any device, recorded as it comes and counted; no driver reads it",
        make_parser=RawParser,
    )


def times_only(parser: Callable[..., ParserT]) -> Callable[[DeviceSettings], ParserT]:
    """Return what makes the recorder's parser: a ``parser`` that is asked for time messages only."""
    return partial(parser, wanted=(TimeMessage,))


def receiver_inside(unit: Driver, make_parser: Callable[[DeviceSettings], Parser] | None = None) -> Driver:
    """Return the driver of the GNSS receiver inside an inertial unit (``transport = "imu:NAME"``).

    Its parser reads the unit's stream once more, for the receiver's records only. Its settings have the unit's keys and
    files where the receiver's own table has none.

    Args:
        unit: the driver of the inertial unit.
        make_parser: builds the parser of the receiver's records, where one costs less than the unit's own; None: the
            unit's parser, whose other records are left out.
    """

    def chosen(settings: DeviceSettings) -> Parser:
        return ChosenRecords(unit.make_parser(settings), RECEIVER_RECORDS)

    return Driver(
        protocol=unit.protocol,
        kind="gnss",
        transports=("imu",),
        yields=tuple(kind for kind in unit.yields if kind in RECEIVER_RECORDS),
        summary=f"the receiver inside it: {unit.summary}",
        make_parser=make_parser or chosen,
        make_time_parser=unit.make_time_parser,
        names_edge=unit.names_edge,
        options=unit.options,
        interface=unit.interface,
    )
