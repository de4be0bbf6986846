"""Finds the devices that a configuration names: their parsers and files, their clocks, and the axes of the IMU.

Georeferencing and navigation share it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from swath.daemon.config.config import PARSER_FILES, Config, DeviceTable, attachment_name
from swath.daemon.config.tables import GnssConfig, ImuConfig, ScannerConfig
from swath.daemon.errors import ConfigError
from swath.daemon.log.format import SessionInfo
from swath.daemon.processing.setup.models import gimbal_sources
from swath.drivers.driver import RAW, Driver, UnknownProtocolError
from swath.drivers.parser import DeviceKind, DriverSettingsError, Parser
from swath.georef.arrays import FloatArray, StructArray
from swath.georef.geodesy.rotations import attitude_of, rot_l_from_b
from swath.georef.records import InsSolution, NamesEdge
from swath.georef.stream.clocks import ClockPlan, DevicePlan, GnssPlan, PpsPlan
from swath.georef.timescales import StampScale


class Sources:
    """The devices of one log; pickles.

    Attributes:
        config: configuration of the log, or another one.
        attachments: the files that the configuration names, by their names in a log.
        scanners: names of the scanners that are read.
        sent: content that scanners themselves sent in place of their ``geometry.file``, by name.
        gimbal_sources: sources of gimbals' angles; they do not give the aircraft's position.
        ins_source: source of the INS solutions for the growing trajectory: the first IMU whose protocol has them, else
            the first receiver; None: there is no such source.
    """

    def __init__(
        self,
        config: Config,
        attachments: Mapping[str, bytes],
        scanners: Sequence[str] = (),
        sent: Mapping[str, bytes] | None = None,
    ) -> None:
        """Find the source of each kind of data.

        Raises:
            ConfigError: a protocol is unknown.
        """
        self.config = config
        self.attachments = dict(attachments)
        self.scanners = list(scanners)
        self.sent = dict(sent or {})
        self.gimbal_sources = {source for name in self.scanners for _, source in gimbal_sources(config, name)}
        self.ins_source = self._ins_source()

    def _ins_source(self) -> str | None:
        for wanted in ("imu", "gnss"):
            for kind, name, table in self.config.device_tables():
                source = f"{kind}/{name}"
                if kind != wanted or source in self.gimbal_sources:
                    continue
                if InsSolution in self._driver(kind, name, table).yields:
                    return source
        return None

    @property
    def ins_protocol(self) -> str:
        """Protocol of `ins_source`; empty if there is none."""
        return self.protocol(self.ins_source)

    def protocol(self, source: str | None) -> str:
        """Return the protocol of ``gnss/name`` or ``imu/name``; empty for None."""
        kind, _, name = (source or "").partition("/")
        tables: Mapping[str, GnssConfig | ImuConfig] = self.config.imu if kind == "imu" else self.config.gnss
        return tables[name].protocol if name else ""

    @property
    def imu_source(self) -> str | None:
        """The first IMU of the aircraft."""
        return next(
            (
                source
                for name, imu in self.config.imu.items()
                if (source := f"imu/{name}") not in self.gimbal_sources and imu.protocol != RAW
            ),
            None,
        )

    @property
    def clock_of_imu(self) -> str | None:
        """The source of the host's time for that IMU."""
        source = self.imu_source
        return None if source is None else self.clock_of(self.config.imu[source.removeprefix("imu/")].pps)

    def edge_of(self, source: str) -> str | None:
        """Return the polarity of the edges of ``pps/name``; None: there is no such source."""
        pps = self.config.pps.get(source.removeprefix("pps/"))
        return None if pps is None else pps.edge

    def inside(self, source: str) -> list[str]:
        """Return sources whose messages are in a wire's bytes: its own, an IMU or INS inside a receiver's or scanner's
        stream, a receiver inside an IMU's. A scanner's second port (``/aux``) is part of its stream.
        """
        source = source.removesuffix("/aux")
        transport = source.replace("/", ":", 1)
        tables = self.config.device_tables()
        return [source, *(f"{kind}/{name}" for kind, name, table in tables if table.transport == transport)]

    def holds_imu(self, topic: str) -> bool:
        """Return whether a topic is of a scanner that holds an IMU in its stream (``transport = "scanner:NAME"``)."""
        held = [imu.transport.partition(":") for imu in self.config.imu.values()]
        return any(kind == "scanner" and topic.startswith(f"/scanner/{name}/") for kind, _, name in held)

    def is_in_scanner(self, source: str) -> bool:
        """Return whether a source is an IMU in the stream of a scanner."""
        imu = self.config.imu.get(source.removeprefix("imu/")) if source.startswith("imu/") else None
        return imu is not None and imu.transport.startswith("scanner:")

    def parsers(self, kinds: tuple[DeviceKind, ...], *, whole: bool = False) -> dict[str, Parser]:
        """Return new parsers of these kinds of sources, by source.

        A receiver's parser gives times only, unless its INS is needed or all its messages are (``whole``).

        Raises:
            ConfigError: a driver cannot work with its settings.
        """
        made: dict[str, Parser] = {}
        for kind, name, table in self.config.device_tables():
            if kind not in kinds or (kind == "scanner" and name not in self.scanners):
                continue
            source = f"{kind}/{name}"
            driver = self._driver(kind, name, table)
            make = driver.make_parser
            wanted = whole or source == self.ins_source or source in self.gimbal_sources
            if kind == "gnss" and not wanted and driver.make_time_parser is not None:
                make = driver.make_time_parser
            try:
                made[source] = make(self.config.settings_with(kind, name, table, self.files, compiled=True))
            except DriverSettingsError as error:
                raise ConfigError(f"{kind}.{name}: {error}") from error
        return made

    def scanner_time_parsers(self) -> dict[str, Parser]:
        """Return new parsers of the scanners' time messages, by source; without returns, if drivers have such a parser.

        Raises:
            ConfigError: a driver cannot work with its settings.
        """
        made: dict[str, Parser] = {}
        for name in self.scanners:
            table, source = self.config.scanner[name], f"scanner/{name}"
            driver = self._driver("scanner", name, table)
            make = driver.make_time_parser or driver.make_parser
            try:
                made[source] = make(self.config.settings_with("scanner", name, table, self.files))
            except DriverSettingsError as error:
                raise ConfigError(f"scanner.{name}: {error}") from error
        return made

    def ins_parser(self) -> dict[str, Parser]:
        """Return the parser of an IMU that is also the INS; empty if a receiver's own stream holds the solutions."""
        source = self.ins_source or ""
        return {source: self.parsers(("imu",))[source]} if source.startswith("imu/") else {}

    def files(self, name: str, table: DeviceTable) -> dict[str, bytes]:
        """Return the files of a device that its parser reads, by their configuration's key."""
        found: dict[str, bytes] = {}
        for key, path in self.config.files_of(table).items():
            stored = self.attachments.get(attachment_name(key, name, path))
            if key in PARSER_FILES and stored is not None:
                found[key] = stored
        if isinstance(table, ScannerConfig) and name in self.sent and "geometry" not in self.config.files_of(table):
            found["geometry"] = self.sent[name]
        return found

    def _driver(self, kind: DeviceKind, name: str, table: DeviceTable) -> Driver:
        try:
            return self.config.driver_of(kind, table)
        except UnknownProtocolError as error:
            raise ConfigError(f"{kind}.{name}.protocol: {error}") from error

    def clock_plan(self, info: SessionInfo) -> ClockPlan:
        """Return the plan of a session's clocks."""
        config = self.config
        configured = {
            gnss.pps: gnss.leap_seconds for gnss in config.gnss.values() if gnss.pps and gnss.leap_seconds is not None
        }
        devices: dict[str, DevicePlan] = {}
        heads: dict[str, GnssPlan] = {}  # heads that report the time themselves, if no other source does
        for name in self.scanners:
            table, source = config.scanner[name], f"scanner/{name}"
            driver = self._driver("scanner", name, table)
            clock = self.clock_of(table.pps)
            if clock is None:
                heads[source] = GnssPlan()
            wanted = StampScale(table.clock) if driver.past_hour or not driver.line_scanner else None
            devices[source] = DevicePlan(clock or source, driver.past_hour, wanted)
        return ClockPlan(
            host_minus_monotonic_ns=info.realtime_ns - info.monotonic_ns,
            pps={f"pps/{name}": PpsPlan(configured.get(name), pps.delay_ns) for name, pps in config.pps.items()},
            gnss={
                f"gnss/{name}": GnssPlan(
                    f"pps/{gnss.pps}" if gnss.pps else None,
                    None if gnss.names_edge == "auto" else NamesEdge(gnss.names_edge),
                    gnss.leap_seconds,
                )
                for name, gnss in config.gnss.items()
                if gnss.protocol != RAW
            }
            | heads,
            devices=devices,
        )

    def clock_of(self, pps: str | None) -> str | None:
        """Return the clock of a device: its pulse's; for a device without one, the first that the host has."""
        if pps is not None:
            return f"pps/{pps}"
        shown = [
            *(f"pps/{name}" for name in self.config.pps),
            *(f"gnss/{name}" for name, gnss in self.config.gnss.items() if gnss.protocol != RAW),
        ]
        return shown[0] if shown else None

    def ins_rows(self, rows: StructArray, source: str | None = None) -> StructArray:
        """Return the solutions of an INS, that of georeferencing or ``source``, with the attitude of b instead of the
        IMU's own axes (``rotation_b_imu``).
        """
        rot_b_from_imu = self._rotation_b_imu(source or self.ins_source)
        if np.array_equal(rot_b_from_imu, np.eye(3)):
            return rows
        turned = rows.copy()
        rot_l_from_imu = rot_l_from_b(rows["roll_rad"], rows["pitch_rad"], rows["heading_rad"])
        attitude = attitude_of(rot_l_from_imu @ rot_b_from_imu.T)
        turned["roll_rad"], turned["pitch_rad"], turned["heading_rad"] = attitude
        return turned

    def in_b(self, measured: FloatArray) -> FloatArray:
        """Return turn rates or specific forces (n, 3) of the IMU along the axes of b."""
        turned: FloatArray = measured @ self._rotation_b_imu(self.imu_source).T
        return turned

    def _rotation_b_imu(self, source: str | None) -> FloatArray:
        imu = self.config.imu.get((source or "").removeprefix("imu/"))
        return np.eye(3) if imu is None else np.array(imu.rotation_b_imu, dtype=np.float64)
