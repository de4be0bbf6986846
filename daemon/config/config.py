"""The loaded configuration: its tables, their file, its devices and the parts of it that go into a log."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from swath.daemon.config.tables import (
    AtmosphereConfig,
    AttitudeConfig,
    CalibrationConfig,
    CorrectionsConfig,
    GnssConfig,
    ImuConfig,
    MtaConfig,
    OutputConfig,
    PpsConfig,
    ProfileConfig,
    RawConfig,
    ScannerConfig,
    SessionConfig,
    Tables,
)
from swath.drivers.driver import RAW, Driver, NotLoadedError, UnknownProtocolError, find_driver
from swath.drivers.parser import DeviceKind, DeviceSettings
from swath.drivers.plugins import Package
from swath.drivers.transports.spec import TransportSpec, parse_transport

DeviceTable = GnssConfig | ImuConfig | ScannerConfig | CorrectionsConfig | RawConfig
FileKey = Literal["dbc", "calibration", "geometry"]
_PATH_SOURCES = ("fixed", "serial-dcd")  # kinds of PPS source whose path may be relative
PLAN_BESIDE = (".dbf", ".prj", ".cpg")  # files beside a shapefile that belong to it
DRIVERS_NAME = "drivers.json"  # attachment that names the packages of drivers that are not Swath's own
PARSER_FILES: tuple[FileKey, ...] = ("dbc", "geometry")  # files that a parser needs; it does not use the calibration


@dataclass(frozen=True, slots=True)
class DeviceEntry:
    """One device of the configuration.

    Attributes:
        kind, name: of its section; ``source`` is ``kind/name``.
        transport: source of its bytes; with a ``carrier`` if they are part of another stream.
        auxiliary: the same head's second port.
        protocol: the driver's name.
        pps: name of its PPS source.
        settings: the settings for its parser.
        files: the files it names, by key.
    """

    kind: DeviceKind
    name: str
    transport: TransportSpec
    auxiliary: TransportSpec | None
    protocol: str
    pps: str | None
    settings: DeviceSettings
    files: dict[FileKey, Path]

    @property
    def source(self) -> str:
        """``kind/name``, the name of the source in all parts of swath."""
        return f"{self.kind}/{self.name}"


class Config:
    """The configuration of one recorder.

    Attributes:
        tables: the tables of the file.
        path: the file, whose folder relative names refer to.
        text: content of the file.
        recorded_with: of a log, name and version of the package whose driver its recorder had, by ``kind/protocol``,
            where that was another one than Swath.
        not_loaded: of `as_recorded`, what the file's protocols are, and why they cannot be used, by ``kind/name``.
    """

    def __init__(self, tables: Tables, path: Path, text: str, recorded_with: Mapping[str, str] | None = None) -> None:
        self.tables = tables
        self.path = path
        self.text = text
        self.recorded_with = dict(recorded_with or {})
        self.not_loaded: dict[str, tuple[str, UnknownProtocolError]] = {}

    @property
    def session(self) -> SessionConfig:
        """Table ``[session]``, with an absolute directory."""
        session = self.tables.session
        return session.model_copy(update={"directory": str(self.resolve(session.directory))})

    @property
    def pps(self) -> dict[str, PpsConfig]:
        """Tables ``[pps.<name>]``, by name, with absolute paths of ports and FIFOs."""
        return {
            name: pps.model_copy(update={"source": self._absolute_source(pps.source)})
            for name, pps in self.tables.pps.items()
        }

    def _absolute_source(self, source: str) -> str:
        kind, _, path = source.partition(":")
        return f"{kind}:{self.resolve(path)}" if path and path.isprintable() and kind in _PATH_SOURCES else source

    @property
    def gnss(self) -> dict[str, GnssConfig]:
        """Tables ``[gnss.<name>]``, by name."""
        return self.tables.gnss

    @property
    def imu(self) -> dict[str, ImuConfig]:
        """Tables ``[imu.<name>]``, by name."""
        return self.tables.imu

    @property
    def scanner(self) -> dict[str, ScannerConfig]:
        """Tables ``[scanner.<name>]``, by name."""
        return self.tables.scanner

    @property
    def corrections(self) -> dict[str, CorrectionsConfig]:
        """Tables ``[corrections.<name>]``, by name."""
        return self.tables.corrections

    @property
    def raw(self) -> dict[str, RawConfig]:
        """Tables ``[raw.<name>]``, by name."""
        return self.tables.raw

    @property
    def attitude(self) -> AttitudeConfig:
        """Table ``[attitude]`` of the file."""
        return self.tables.attitude

    @property
    def atmosphere(self) -> AtmosphereConfig:
        """Table ``[atmosphere]`` of the file."""
        return self.tables.atmosphere

    @property
    def mta(self) -> MtaConfig:
        """Table ``[mta]`` of the file."""
        return self.tables.mta

    @property
    def profile(self) -> ProfileConfig:
        """Table ``[profile]`` of the file."""
        return self.tables.profile

    @property
    def calibration(self) -> CalibrationConfig:
        """Table ``[calibration]`` of the file."""
        return self.tables.calibration

    @property
    def output(self) -> OutputConfig:
        """Table ``[output]`` of the file."""
        return self.tables.output

    def resolve(self, name: str) -> Path:
        """Return an absolute path for a name in the file; relative names are relative to the file's folder."""
        return (self.path.parent / name).absolute()

    def transport(self, text: str) -> TransportSpec:
        """Parse a transport of the file; a relative path of a port is relative to the file's folder.

        Raises:
            ValueError: the text is invalid; the message names the error and a valid form.
        """
        spec = parse_transport(text)
        if spec.kind == "serial":
            return replace(spec, address=str(self.resolve(spec.address)))
        if spec.kind == "can" and "/" in spec.channel:  # a serial adapter
            return replace(spec, address=f"{spec.interface}:{self.resolve(spec.channel)}")
        return spec

    def device_tables(self) -> Iterator[tuple[DeviceKind, str, DeviceTable]]:
        """Yield (kind, name, table) of every device, in the order of the kinds and of the file."""
        for name, gnss in self.gnss.items():
            yield "gnss", name, gnss
        for name, imu in self.imu.items():
            yield "imu", name, imu
        for name, scanner in self.scanner.items():
            yield "scanner", name, scanner
        for name, corrections in self.corrections.items():
            yield "corrections", name, corrections
        for name, raw in self.raw.items():
            yield "raw", name, raw

    def driver_of(self, kind: DeviceKind, table: DeviceTable) -> Driver:
        """Return the driver of a device.

        Raises:
            UnknownProtocolError: there is none; of a log the text names the package that its recorder had.
        """
        return find_driver(kind, table.protocol, self.recorded_with.get(f"{kind}/{table.protocol}", ""))

    def as_recorded(self) -> Config:
        """Return the configuration in which devices whose package cannot be loaded have the protocol ``raw``.

        The recorder needs no driver: their bytes are kept, and read when the package works again.
        """
        lacking = self.without_driver()
        not_loaded = {source: found for source, found in lacking.items() if isinstance(found[1], NotLoadedError)}
        recorded = self.with_raw(not_loaded)
        recorded.not_loaded = not_loaded
        return recorded

    def without_driver(self) -> dict[str, tuple[str, UnknownProtocolError]]:
        """Return the protocols of devices that have no driver here, and why, by ``kind/name``."""
        found = {}
        for kind, name, table in self.device_tables():
            try:
                self.driver_of(kind, table)
            except UnknownProtocolError as error:
                found[f"{kind}/{name}"] = table.protocol, error
        return found

    def with_raw(self, sources: Collection[str]) -> Config:
        """Return the configuration in which the devices of these sources have the protocol ``raw``."""
        changed: dict[str, dict[str, DeviceTable]] = {}
        for kind, name, table in self.device_tables():
            raw = f"{kind}/{name}" in sources
            changed.setdefault(kind, {})[name] = table.model_copy(update={"protocol": RAW}) if raw else table
        return Config(self.tables.model_copy(update=changed), self.path, self.text, self.recorded_with)

    def files_of(self, table: DeviceTable) -> dict[FileKey, Path]:
        """Return the files that a device's table names, by key."""
        return {key: self.resolve(name) for key, name in _names_of(table).items()}

    def settings_of(self, kind: DeviceKind, name: str, table: DeviceTable) -> DeviceSettings:
        """Return the settings for the parser of a device; this reads the device's files.

        Raises:
            OSError: a file cannot be read.
        """

        def contents(_: str, of: DeviceTable) -> dict[str, bytes]:
            files = self.files_of(of)
            return {key: files[key].read_bytes() for key in PARSER_FILES if key in files}

        return self.settings_with(kind, name, table, contents)

    def settings_with(
        self,
        kind: DeviceKind,
        name: str,
        table: DeviceTable,
        contents: Callable[[str, DeviceTable], dict[str, bytes]],
        *,
        compiled: bool = False,
    ) -> DeviceSettings:
        """Return the settings for the parser of a device.

        A device inside the stream of another one has that one's keys and files too, where its own table has none.

        Args:
            kind, name, table: of the device.
            contents: returns the contents of the parser's files that a device's name and table name, by key.
            compiled: as in `DeviceSettings`.
        """
        values, files = plain_table(table), contents(name, table)
        carrier = self.carrier_of(table)
        if carrier is not None:
            outer_name, outer = carrier
            options = values.get("options") or plain_table(outer).get("options", {})
            values = {**plain_table(outer), **values, "options": options}
            files = {**contents(outer_name, outer), **files}
        return DeviceSettings(f"{kind}/{name}", values, files, compiled)

    def carrier_of(self, table: DeviceTable) -> tuple[str, DeviceTable] | None:
        """Return name and table of the device whose stream holds this one's bytes; None: it has its own wire, or that
        device does not exist.
        """
        kind, _, name = table.transport.partition(":")
        carriers: dict[str, Mapping[str, DeviceTable]] = {
            "gnss": self.gnss,
            "imu": self.imu,
            "scanner": self.scanner,
            "raw": self.raw,
        }
        tables = carriers.get(kind, {})
        return (name, tables[name]) if name in tables else None

    def devices(self) -> Iterator[DeviceEntry]:
        """Yield every device: GNSS, IMU, scanners, corrections, raw ones, in the order of the file."""
        for kind, name, table in self.device_tables():
            auxiliary = table.auxiliary if isinstance(table, ScannerConfig) else None
            yield DeviceEntry(
                kind=kind,
                name=name,
                transport=self.transport(table.transport),
                auxiliary=self.transport(auxiliary) if auxiliary else None,
                protocol=table.protocol,
                pps=None if isinstance(table, CorrectionsConfig | RawConfig) else table.pps,
                settings=self.settings_of(kind, name, table),
                files=self.files_of(table),
            )

    def attachments(self) -> list[tuple[str, str, bytes]]:
        """Return the attachments of every log as (name, media type, bytes); docs/log-format.md lists the names.

        Files of the flight plan that cannot be read are left out: who needs them has checked them.
        """
        found = [("config.toml", "application/toml", self.text.encode())]
        for _, name, table in self.device_tables():
            for key, path in self.files_of(table).items():
                attachment = attachment_name(key, name, path)
                if all(attachment != other for other, _, _ in found):
                    found.append((attachment, _media_type(path), path.read_bytes()))
        for path in self.plan_files():
            with contextlib.suppress(OSError, ValueError):
                found.append((plan_attachment(path.name), _media_type(path), path.read_bytes()))
        packages = {
            key: {"package": package.name, "version": package.version} for key, package in self.packages().items()
        }
        if packages:
            found.append((DRIVERS_NAME, "application/json", json.dumps(packages, indent=2).encode()))
        return found

    def plan_files(self) -> list[Path]:
        """Return the files of ``[plan]``, each once, with those beside a shapefile that exist."""
        found: list[Path] = []
        for name in (self.tables.plan.file, self.tables.plan.area):
            if name is None:
                continue
            path = self.resolve(name)
            suffixes = (*PLAN_BESIDE, *map(str.upper, PLAN_BESIDE)) if path.suffix.lower() == ".shp" else ()
            shapes = [one for one in map(path.with_suffix, suffixes) if one.is_file()]
            found += [one for one in (path, *shapes) if one not in found]
        return found

    def packages(self) -> dict[str, Package]:
        """Return the other packages whose drivers the devices have, by ``kind/protocol``."""
        found = {}
        for kind, _, table in self.device_tables():
            try:
                package = self.driver_of(kind, table).package
            except UnknownProtocolError:
                continue
            if package is not None:
                found[f"{kind}/{table.protocol}"] = package
        for source, (protocol, error) in self.not_loaded.items():
            if isinstance(error, NotLoadedError):
                found[f"{source.partition('/')[0]}/{protocol}"] = error.package
        return found

    def attachment_names(self) -> list[tuple[str, str]]:
        """Return, for every file that the tables name, its name in a log and its name in the configuration."""
        return [
            (attachment_name(key, name, self.resolve(named)), named)
            for _, name, table in self.device_tables()
            for key, named in _names_of(table).items()
        ] + [
            (plan_attachment(Path(named).name), named)
            for named in (self.tables.plan.file, self.tables.plan.area)
            if named is not None
        ]


def _names_of(table: DeviceTable) -> dict[FileKey, str]:
    named: dict[FileKey, str | None] = {}
    if isinstance(table, ImuConfig):
        named["dbc"] = table.dbc
    if isinstance(table, ScannerConfig):
        named["calibration"] = table.calibration
        named["geometry"] = table.geometry.file if table.geometry else None
    return {key: name for key, name in named.items() if name is not None}


def plain_table(table: DeviceTable) -> dict[str, Any]:
    """Return a device's table as plain values, with defaults filled in."""
    return table.model_dump()


def attachment_name(key: FileKey, device: str, path: Path) -> str:
    """Return the name of a device's file in a log."""
    if key == "dbc":
        return f"dbc/{path.name}"
    suffix = path.suffix if key == "geometry" else ".toml"
    return f"{key}/{device}{suffix}"


def plan_attachment(name: str) -> str:
    """Return the name of a file of the flight plan in a log."""
    return f"plan/{name}"


def _media_type(path: Path) -> str:
    known = {
        ".toml": "application/toml",
        ".json": "application/json",
        ".csv": "text/csv",
        ".geojson": "application/geo+json",
        ".kml": "application/vnd.google-earth.kml+xml",
        ".kmz": "application/vnd.google-earth.kmz",
        ".gpkg": "application/geopackage+sqlite3",
        ".shp": "application/octet-stream",
        ".dbf": "application/octet-stream",
    }
    return known.get(path.suffix.lower(), "text/plain")
