"""Finds drivers by the ``DRIVERS`` tuples of the protocol files; a new device needs no entry in any list."""

from __future__ import annotations

import difflib
import importlib
import importlib.util
import pkgutil
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Literal

from swath.drivers.parser import ChosenRecords, DeviceKind, DeviceSettings, Parser, RawParser
from swath.georef.records import ByteRows, EventMark, GnssFix, GnssHeading, NamesEdge, TimeMessage

if TYPE_CHECKING:
    from swath.drivers.startup import StartupMessage, StartupOptions

TransportKind = Literal["serial", "can", "udp", "tcp", "gnss", "imu", "scanner", "raw", "ntrip"]

STREAM_TRANSPORTS: tuple[TransportKind, ...] = ("serial", "udp", "tcp")  # every wire that carries a byte stream

KINDS: tuple[DeviceKind, ...] = ("gnss", "imu", "scanner", "corrections")
MOST_ALIKE = 3
FOLDERS: dict[DeviceKind, tuple[str, ...]] = {  # where drivers of a kind are declared: a receiver may hold an IMU and
    "gnss": ("gnss", "imu"),  # an IMU a receiver, and one protocol file then declares both
    "imu": ("imu", "gnss"),
    "scanner": ("scanner",),
    "corrections": ("corrections",),
    "raw": (),
}
RAW = "raw"  # the protocol of a device that no driver reads; any kind may have it


RECEIVER_RECORDS = (TimeMessage, GnssFix, GnssHeading, EventMark)


class UnknownProtocolError(LookupError):
    """No driver of that kind has that protocol; the text names the one that was probably meant, or all that exist."""


@cache
def all_drivers(kind: DeviceKind) -> dict[str, Driver]:
    """Return all drivers of a kind by protocol name, from the ``DRIVERS`` of each module or of each package's
    ``parser`` module.
    """
    found: dict[str, Driver] = {}
    for driver in (driver for folder in FOLDERS[kind] for driver in _declared_in(folder)):
        if driver.kind != kind:
            continue
        if driver.protocol in found:
            raise RuntimeError(f"two drivers declare {kind} protocol {driver.protocol!r}")
        found[driver.protocol] = driver
    return dict(sorted(found.items()))


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


def find_driver(kind: DeviceKind, protocol: str) -> Driver:
    """Return the driver of a protocol.

    Raises:
        UnknownProtocolError: the protocol is unknown; the text names those that were probably meant, or all known ones.
    """
    if protocol == RAW:
        return raw_driver(kind)
    drivers = all_drivers(kind)
    try:
        return drivers[protocol]
    except KeyError:
        meant = probable_protocols(protocol, drivers)
        known = f"did you mean {' or '.join(meant)}?" if meant else f"there are: {', '.join(sorted([*drivers, RAW]))}"
        raise UnknownProtocolError(f"unknown {kind} protocol {protocol!r}; {known}") from None


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
    )
