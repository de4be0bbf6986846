"""From a configuration, or the one in a log, to everything that makes points: parsers, clocks, models, mapping frame.

What a configuration cannot mean is one line of a `ConfigError` before anything is read.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from swath.daemon.config.config import PARSER_FILES, Config, DeviceTable, attachment_name, plain_table
from swath.daemon.config.tables import GnssConfig, ImuConfig, ScannerConfig
from swath.daemon.errors import ConfigError, UserError
from swath.daemon.log.format import LogError, SessionInfo
from swath.daemon.log.parsers import stored_config
from swath.daemon.processing.setup.models import (
    TerrainRanges,
    calibration_mistakes,
    gimbal_sources,
    make_georeferencer,
    make_motion,
    make_resolver,
    refuse_logged_gimbals,
)
from swath.daemon.processing.setup.terrain import terrain_of
from swath.drivers.driver import Driver, UnknownProtocolError, find_driver
from swath.drivers.parser import DeviceKind, DeviceSettings, DriverSettingsError, Parser
from swath.georef.coarse_terrain import CoarseTerrain
from swath.georef.geodesy.rotations import attitude_of, rot_l_from_b
from swath.georef.mapping.frame import Mapping as MappingFrame
from swath.georef.mapping.frame import MappingError
from swath.georef.records import InsSolution, NamesEdge, StructArray
from swath.georef.scanner.calibration import Calibration, CalibrationError, nominal, read_calibration
from swath.georef.scanner.mount import AngleSeries
from swath.georef.stream.clocks import ClockPlan, DevicePlan, FrozenClocks, GnssPlan, PpsPlan, StreamClocks
from swath.georef.stream.stream import CompletePath, GrowingPath, ScannerChain, Stream, StreamSettings
from swath.georef.text_encoding import decoded
from swath.georef.timescales import StampScale
from swath.georef.timescales.gps_time import SECOND_NS
from swath.georef.trajectory.buffer import TrajectoryBuffer
from swath.georef.trajectory.trajectory import Trajectory

ARCSEC = math.pi / 648_000
REACH_NS = 1_000_000  # beyond its own stamp, of a return whose calibration shifts no times
OFFICE = StreamSettings(settle_s=2.0)  # so that a latched edge on either side of a return is known


@dataclass(frozen=True, slots=True)
class Options:
    """What a command line says beside the configuration.

    Attributes:
        crs, datum, epoch: of the products, over ``[output]`` and the receiver's ``datum``.
        force_crs: a CRS that does not suit the place is taken, and warned of.
        scanners: only these; empty: all.
        calibrations: text of a calibration file and its name, by scanner; over the configuration's.
        uncertainty: sigmas are computed with the points.
        terrain: tells the zone of pulses in air; None: the returns before do.
        height_above_ground_m: at the first return, for pulses in air without a terrain model.
    """

    crs: str | None = None
    datum: str | None = None
    epoch: float | None = None
    force_crs: bool = False
    scanners: tuple[str, ...] = ()
    calibrations: Mapping[str, tuple[str, str]] = field(default_factory=dict)
    uncertainty: bool = True
    terrain: CoarseTerrain | None = None
    height_above_ground_m: float | None = None


class Setup:
    """Everything that one log's georeferencing needs; pickles.

    Attributes:
        config: of the log, or another one.
        calibrations: by scanner, those in use.
        mapping: frame of the points; None: they are in e.
        gimbal_sources: who tells the angles of gimbals, `take_angles`; they do not tell where the aircraft is.
        ins_source: whose INS gives the growing trajectory: the first IMU whose protocol tells one, else the first
            receiver; None: nobody's.
    """

    def __init__(self, config: Config, attachments: Mapping[str, bytes], options: Options | None = None) -> None:
        """attachments: the files that the configuration names, by their names in a log.

        Raises:
            ConfigError: something cannot be meant.
        """
        self.config = config
        self.options = options or Options()
        self._attachments = dict(attachments)
        self.scanners = self._chosen()
        self.gimbal_sources = {source for name in self.scanners for _, source in gimbal_sources(config, name)}
        self.ins_source = self._ins_source()
        self.calibrations = {name: self._calibration(name) for name in self.scanners}
        self.mapping = self._mapping()
        self.terrain = self.options.terrain or terrain_of(config)
        self._georeferencers = self._made(None)

    @classmethod
    def of_log(cls, attachments: Mapping[str, bytes], options: Options | None = None) -> Setup:
        """By what is stored in a log.

        Raises:
            UserError: the log has no configuration, or one that cannot be used.
        """
        try:
            config = stored_config(attachments)
        except LogError as error:
            raise UserError(f"{error}; give another with --config, to swath live --replay as CONFIG") from error
        if config is None:
            raise UserError("the log holds no configuration; give one with --config, to swath live --replay as CONFIG")
        return cls(config, attachments, options)

    @classmethod
    def of_config(cls, config: Config, options: Options | None = None) -> Setup:
        """By a configuration and the files beside it."""
        return cls(config, {name: data for name, _, data in config.attachments()}, options)

    # ------------------------------------------------------------------ sources

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
        """Of `ins_source`; empty where there is none."""
        return self.protocol(self.ins_source)

    def protocol(self, source: str | None) -> str:
        """Of ``gnss/name`` or ``imu/name``; empty of None."""
        kind, _, name = (source or "").partition("/")
        tables: Mapping[str, GnssConfig | ImuConfig] = self.config.imu if kind == "imu" else self.config.gnss
        return tables[name].protocol if name else ""

    @property
    def imu_source(self) -> str | None:
        """The first IMU of the aircraft."""
        return next((source for name in self.config.imu if (source := f"imu/{name}") not in self.gimbal_sources), None)

    @property
    def clock_of_imu(self) -> str | None:
        """The source that shows the host's time beside that IMU."""
        source = self.imu_source
        return None if source is None else self._clock_of(self.config.imu[source.removeprefix("imu/")].pps)

    def edge_of(self, source: str) -> str | None:
        """Polarity of the edges of ``pps/name``; None: no such source."""
        pps = self.config.pps.get(source.removeprefix("pps/"))
        return None if pps is None else pps.edge

    def inside(self, source: str) -> list[str]:
        """Sources whose messages stand in a wire's bytes: its own, and an IMU or INS inside a receiver's stream."""
        kind, _, name = source.partition("/")
        within = [f"imu/{imu}" for imu, table in self.config.imu.items() if table.transport == f"gnss:{name}"]
        return [source, *(within if kind == "gnss" else [])]

    def parsers(self, kinds: tuple[DeviceKind, ...], *, whole: bool = False) -> dict[str, Parser]:
        """New parsers of these kinds of sources, by source.

        A receiver's gives times only unless its INS is wanted, or all that it says (``whole``).

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
                made[source] = make(DeviceSettings(source, plain_table(table), self._files(name, table), compiled=True))
            except DriverSettingsError as error:
                raise ConfigError(f"{kind}.{name}: {error}") from error
        return made

    def scanner_time_parsers(self) -> dict[str, Parser]:
        """New parsers of what the scanners say of time, without returns, by source.

        Raises:
            ConfigError: a driver cannot work with its settings.
        """
        made: dict[str, Parser] = {}
        for name in self.scanners:
            table, source = self.config.scanner[name], f"scanner/{name}"
            make = self._driver("scanner", name, table).make_time_parser
            try:
                if make is not None:
                    made[source] = make(DeviceSettings(source, plain_table(table), self._files(name, table)))
            except DriverSettingsError as error:
                raise ConfigError(f"scanner.{name}: {error}") from error
        return made

    def ins_parser(self) -> dict[str, Parser]:
        """Of an IMU that is the INS too, its parser; empty where a receiver's own stream tells the solutions."""
        source = self.ins_source or ""
        return {source: self.parsers(("imu",))[source]} if source.startswith("imu/") else {}

    def _files(self, name: str, table: DeviceTable) -> dict[str, bytes]:
        found: dict[str, bytes] = {}
        for key, path in self.config.files_of(table).items():
            stored = self._attachments.get(attachment_name(key, name, path))
            if key in PARSER_FILES and stored is not None:
                found[key] = stored
        return found

    def _driver(self, kind: DeviceKind, name: str, table: DeviceTable) -> Driver:
        try:
            return find_driver(kind, table.protocol)
        except UnknownProtocolError as error:
            raise ConfigError(f"{kind}.{name}.protocol: {error}") from error

    def _chosen(self) -> list[str]:
        known = sorted(self.config.scanner)
        files = {name: f"{file}: " for name, (_, file) in self.options.calibrations.items()}
        for name in [*self.options.scanners, *self.options.calibrations]:
            if name not in known:
                raise ConfigError(
                    f"{files.get(name, '')}scanner {name}: is not in the configuration; there are: "
                    f"{', '.join(known) or 'none'}"
                )
        return [name for name in known if not self.options.scanners or name in self.options.scanners]

    # ------------------------------------------------------------------ time

    def clock_plan(self, info: SessionInfo) -> ClockPlan:
        """The clocks of a session."""
        config = self.config
        said = {
            gnss.pps: gnss.leap_seconds for gnss in config.gnss.values() if gnss.pps and gnss.leap_seconds is not None
        }
        devices: dict[str, DevicePlan] = {}
        heads: dict[str, GnssPlan] = {}  # that say the time themselves, where nobody else does
        for name in self.scanners:
            table, source = config.scanner[name], f"scanner/{name}"
            driver = find_driver("scanner", table.protocol)
            clock = self._clock_of(table.pps)
            if clock is None:
                heads[source] = GnssPlan()
            wanted = StampScale(table.clock) if driver.past_hour or not driver.line_scanner else None
            devices[source] = DevicePlan(clock or source, driver.past_hour, wanted)
        return ClockPlan(
            host_minus_monotonic_ns=info.realtime_ns - info.monotonic_ns,
            pps={f"pps/{name}": PpsPlan(said.get(name), pps.delay_ns) for name, pps in config.pps.items()},
            gnss={
                f"gnss/{name}": GnssPlan(
                    f"pps/{gnss.pps}" if gnss.pps else None,
                    None if gnss.names_edge == "auto" else NamesEdge(gnss.names_edge),
                    gnss.leap_seconds,
                )
                for name, gnss in config.gnss.items()
            }
            | heads,
            devices=devices,
        )

    def _clock_of(self, pps: str | None) -> str | None:
        """The clock of a device: its pulse's; of one that has none, the host's by the first that there is."""
        if pps is not None:
            return f"pps/{pps}"
        shown = [*(f"pps/{name}" for name in self.config.pps), *(f"gnss/{name}" for name in self.config.gnss)]
        return shown[0] if shown else None

    # ------------------------------------------------------------------ streams

    def live_stream(self, info: SessionInfo, settings: StreamSettings | None = None) -> Stream:
        """A stream whose clocks and trajectory grow with the log: the same live and in replay.

        Raises:
            ConfigError: a gimbal's angles are logged.
        """
        try:
            refuse_logged_gimbals(self.config, self.scanners)
        except ValueError as error:
            raise ConfigError(str(error)) from error
        path = GrowingPath(
            TrajectoryBuffer(self.protocol(self.ins_source), name=self.ins_source or ""), self.deflection_rad
        )
        plan = self.clock_plan(info)
        if self.imu_source is not None and self.clock_of_imu is not None:  # by whose clock a navigator places samples
            plan = replace(plan, devices={**plan.devices, self.imu_source: DevicePlan(self.clock_of_imu)})
        return Stream(self._chains(), StreamClocks.growing(plan), path, settings)

    def navigator(self, clocks: StreamClocks) -> Any:
        """What finds the way of a growing log, a `Navigator`; None: there are not both an IMU and a receiver."""
        from swath.daemon.processing.navigation.live import navigator_of

        return navigator_of(self.config, self._attachments, clocks)

    def office_stream(self, clocks: FrozenClocks, trajectory: Trajectory, settings: StreamSettings = OFFICE) -> Stream:
        """A stream with all of a log's clock and a complete trajectory, which is taken as it is."""
        return Stream(self._chains(), clocks.for_stream(), CompletePath(trajectory), settings)

    @property
    def deflection_rad(self) -> tuple[float, float] | None:
        """ξ, η of ``[attitude]``; None where the attitude refers to the ellipsoid."""
        attitude = self.config.attitude
        if attitude.xi_arcsec is None or attitude.eta_arcsec is None:
            return None
        return attitude.xi_arcsec * ARCSEC, attitude.eta_arcsec * ARCSEC

    def ins_rows(self, rows: StructArray) -> StructArray:
        """Solutions of the device's INS with the attitude of b instead of the IMU's own axes (``rotation_b_imu``)."""
        rot_b_from_imu = self._rotation_b_imu(self.ins_source)
        if np.array_equal(rot_b_from_imu, np.eye(3)):
            return rows
        turned = rows.copy()
        rot_l_from_imu = rot_l_from_b(rows["roll_rad"], rows["pitch_rad"], rows["heading_rad"])
        attitude = attitude_of(rot_l_from_imu @ rot_b_from_imu.T)
        turned["roll_rad"], turned["pitch_rad"], turned["heading_rad"] = attitude
        return turned

    def in_b(self, measured: NDArray[np.float64]) -> NDArray[np.float64]:
        """(n, 3) turn rates or specific forces of the IMU along the axes of b."""
        turned: NDArray[np.float64] = measured @ self._rotation_b_imu(self.imu_source).T
        return turned

    def _rotation_b_imu(self, source: str | None) -> NDArray[np.float64]:
        imu = self.config.imu.get((source or "").removeprefix("imu/"))
        return np.eye(3) if imu is None else np.array(imu.rotation_b_imu, dtype=np.float64)

    def _chains(self) -> dict[str, ScannerChain]:
        return {name: self._chain(name) for name in self.scanners}

    def _chain(self, name: str) -> ScannerChain:
        calibration = self.calibrations[name]
        later_s = [max(0.0, calibration.value(parameter)) for parameter in ("time_offset_s", "imu_latency_s")]
        reach_ns = REACH_NS + round(sum(later_s) * SECOND_NS)
        above_m = self.options.height_above_ground_m or self.config.mta.height_above_ground_m
        resolver = make_resolver(self.config.scanner[name], above_m)
        georeferencer = self._georeferencers[name]
        motion = make_motion(self.config.scanner[name], georeferencer.model)
        given = georeferencer.encoder_motion if motion is not None else None
        terrain = self.terrain
        predict = None if terrain is None or resolver is None else TerrainRanges(georeferencer.model, terrain)
        return ScannerChain(name, georeferencer, resolver, predict, reach_ns, motion, given)

    # ------------------------------------------------------------------ models

    def georeferencer(self, name: str) -> Any:
        """A scanner's `Georeferencer`."""
        return self._georeferencers[name]

    def take_angles(self, angles: Mapping[str, AngleSeries]) -> None:
        """What the sources of gimbals' angles told; before, returns of such a gimbal have no place.

        Raises:
            ConfigError: one of them told none.
        """
        if self.gimbal_sources:
            self._georeferencers = self._made(angles)

    def _made(self, angles: Mapping[str, AngleSeries] | None) -> dict[str, Any]:
        parsers = self.parsers(("scanner",))  # their tables of beams; and their settings' mistakes are told now
        return {name: self._georeferencer(name, parsers[f"scanner/{name}"], angles) for name in self.scanners}

    def _georeferencer(self, name: str, parser: Parser, angles: Mapping[str, AngleSeries] | None) -> Any:
        try:
            return make_georeferencer(
                self.config,
                name,
                self.calibrations[name].with_plausible_sigmas(),
                parser,
                self._files(name, self.config.scanner[name]).get("geometry"),
                self.mapping,
                uncertainty=self.options.uncertainty,
                angles=angles,
            )
        except ValueError as error:
            raise ConfigError(f"scanner.{name}: {error}") from error

    def _mapping(self) -> MappingFrame | None:
        output = self.config.output
        crs = self.options.crs or output.crs
        if crs is None:
            return None
        datum = self.options.datum or next((gnss.datum for gnss in self.config.gnss.values() if gnss.datum), None)
        epoch = output.epoch if self.options.epoch is None else self.options.epoch
        try:
            return MappingFrame(crs, datum=datum, epoch=epoch, accuracy_m=output.datum_accuracy_m)
        except MappingError as error:
            raise ConfigError(str(error)) from error

    def _calibration(self, name: str) -> Calibration:
        table = self.config.scanner[name]
        installation = np.eye(3) if table.installation is None else np.array(table.installation, dtype=np.float64)
        given = self.options.calibrations.get(name) or self._stored_calibration(name, table)
        if given is None:
            return nominal(name, table.lever_arm_m, installation)
        text, file = given
        try:
            calibration = read_calibration(text, file)
        except CalibrationError as error:
            raise ConfigError(str(error).splitlines()) from error
        if table.installation is not None and "installation_matrix" not in calibration.header:
            calibration = replace(calibration, installation_matrix=installation)
        mistakes = [
            f"{file}: {line}" for line in calibration_mistakes(calibration, name, table, self.config.atmosphere)
        ]
        if mistakes:
            raise ConfigError(mistakes)
        return calibration

    def _stored_calibration(self, name: str, table: ScannerConfig) -> tuple[str, str] | None:
        if table.calibration is None:
            return None
        stored = self._attachments.get(attachment_name("calibration", name, Path(table.calibration)))
        if stored is None:
            raise ConfigError(f"scanner.{name}.calibration: {table.calibration} is not in the log; give it by hand")
        return decoded(stored, "replace"), table.calibration
