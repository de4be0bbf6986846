"""Builds from a configuration, or the one in a log, all that makes points: parsers, clocks, models, mapping frame.

An invalid setting gives one line of a `ConfigError` before any data is read.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from swath.daemon.config.config import Config, attachment_name
from swath.daemon.config.tables import ScannerConfig
from swath.daemon.errors import ConfigError, UserError
from swath.daemon.log.format import LogError, SessionInfo
from swath.daemon.log.parsers import stored_config
from swath.daemon.log.reader import Session
from swath.daemon.processing.setup.models import (
    TerrainRanges,
    calibration_mistakes,
    make_georeferencer,
    make_motion,
    make_resolver,
    refuse_logged_gimbals,
)
from swath.daemon.processing.setup.sent_files import sent_file_of, sent_files
from swath.daemon.processing.setup.sources import Sources
from swath.daemon.processing.setup.terrain import terrain_of
from swath.drivers.parser import Parser
from swath.georef.coarse_terrain import CoarseTerrain
from swath.georef.mapping.frame import Mapping as MappingFrame
from swath.georef.mapping.frame import MappingError
from swath.georef.scanner.calibration import Calibration, CalibrationError, nominal, read_calibration
from swath.georef.scanner.mount import AngleSeries
from swath.georef.stream.clocks import DevicePlan, FrozenClocks, StreamClocks
from swath.georef.stream.stream import CompletePath, GrowingPath, ScannerChain, Stream, StreamSettings
from swath.georef.surface.local import Surface
from swath.georef.text_encoding import decoded
from swath.georef.timescales.gps_time import SECOND_NS
from swath.georef.trajectory.buffer import TrajectoryBuffer
from swath.georef.trajectory.trajectory import Trajectory

ARCSEC = math.pi / 648_000
REACH_NS = 1_000_000  # for a return whose calibration shifts no times: how far data beyond its stamp are needed
OFFICE = StreamSettings(settle_s=2.0)  # long enough that latched edges on both sides of a return are known


@dataclass(frozen=True, slots=True)
class Options:
    """The options of a command beside the configuration.

    Attributes:
        crs, datum, epoch: mapping frame of the products; they override ``[output]`` and the receiver's ``datum``.
        force_crs: accept a CRS that does not suit the place, with a warning.
        scanners: scanners to use; empty: all.
        calibrations: text of a calibration file and its name, by scanner; they override the configuration's.
        uncertainty: compute sigmas with the points.
        surface: what the sigmas take the beams' footprints to fall on.
        incidence, range_sigma, covariances: compute these with the points too; they need ``uncertainty``.
        terrain: terrain model that gives the zone of pulses in air; None: the preceding returns do.
        height_above_ground_m: height at the first return, for pulses in air without a terrain model.
    """

    crs: str | None = None
    datum: str | None = None
    epoch: float | None = None
    force_crs: bool = False
    scanners: tuple[str, ...] = ()
    calibrations: Mapping[str, tuple[str, str]] = field(default_factory=dict)
    uncertainty: bool = True
    surface: Surface = "planes"
    incidence: bool = False
    range_sigma: bool = False
    covariances: bool = False
    terrain: CoarseTerrain | None = None
    height_above_ground_m: float | None = None


def config_in_log(attachments: Mapping[str, bytes]) -> Config:
    """Return the configuration that is stored in a log.

    Raises:
        UserError: the log has none, or one of another version.
    """
    try:
        config = stored_config(attachments)
    except LogError as error:
        raise UserError(f"{error}; give another with --config, to swath live --replay as CONFIG") from error
    if config is None:
        raise UserError("the log holds no configuration; give one with --config, to swath live --replay as CONFIG")
    return config


class Setup:
    """Everything that one log's georeferencing needs; pickles.

    Attributes:
        config: configuration of the log, or another one.
        calibrations: calibrations in use, by scanner.
        mapping: mapping frame of the points; None: they are in e.
        sources: the devices; angles of gimbals are given by `take_angles`.
    """

    def __init__(
        self,
        config: Config,
        attachments: Mapping[str, bytes],
        options: Options | None = None,
        sent: Mapping[str, bytes] | None = None,
    ) -> None:
        """Build the setup.

        Args:
            config: configuration of the log, or another one.
            attachments: the files that the configuration names, by their names in a log.
            options: of the command.
            sent: what scanners sent in place of their ``geometry.file``, by name; see `sent_files`.

        Raises:
            ConfigError: a setting is invalid.
        """
        self.config = config
        self.options = options or Options()
        self.scanners = self._chosen()
        self.sources = Sources(config, attachments, self.scanners, sent)
        self.calibrations = {name: self._calibration(name) for name in self.scanners}
        self.mapping = self._mapping()
        self.terrain = self.options.terrain or terrain_of(config)
        self._georeferencers = self._made(None)

    @classmethod
    def of_log(
        cls, attachments: Mapping[str, bytes], options: Options | None = None, sent: Mapping[str, bytes] | None = None
    ) -> Setup:
        """Make the setup from the configuration that is stored in a log.

        Raises:
            UserError: the log has no configuration, or one that cannot be used.
        """
        return cls(config_in_log(attachments), attachments, options, sent)

    @classmethod
    def of_session(cls, session: Session, config: Config | None, options: Options | None = None) -> Setup:
        """Make the setup from a log, with its own configuration or another one, and with what scanners sent in it.

        Raises:
            UserError: as for `of_log`; LogError, OSError: the log cannot be read.
        """
        scanners = () if options is None else options.scanners
        if config is not None:
            return cls.of_config(config, options, sent_files(session, config, scanners))
        attachments = session.attachments()
        config = config_in_log(attachments)
        return cls(config, attachments, options, sent_files(session, config, scanners))

    @classmethod
    def of_config(
        cls, config: Config, options: Options | None = None, sent: Mapping[str, bytes] | None = None
    ) -> Setup:
        """Make the setup from a configuration and the files beside it."""
        return cls(config, {name: data for name, _, data in config.attachments()}, options, sent)

    def _chosen(self) -> list[str]:
        known = sorted(self.config.scanner)
        files = {name: f"{file}: " for name, (_, file) in self.options.calibrations.items()}
        for name in [*self.options.scanners, *self.options.calibrations]:
            if name not in known:
                raise ConfigError(
                    f"{files.get(name, '')}scanner {name}: is not in the configuration, which has: "
                    f"{', '.join(known) or 'none'}"
                )
        return [name for name in known if not self.options.scanners or name in self.options.scanners]

    # ------------------------------------------------------------------ streams

    def live_stream(self, info: SessionInfo, settings: StreamSettings | None = None) -> Stream:
        """Return a stream whose clocks and trajectory grow with the log: the same live and in replay.

        Raises:
            ConfigError: a gimbal's angles are logged.
        """
        try:
            refuse_logged_gimbals(self.config, self.scanners)
        except ValueError as error:
            raise ConfigError(str(error)) from error
        path = GrowingPath(
            TrajectoryBuffer(self.sources.protocol(self.sources.ins_source), name=self.sources.ins_source or ""),
            self.deflection_rad,
        )
        plan = self.sources.clock_plan(info)
        if (
            self.sources.imu_source is not None and self.sources.clock_of_imu is not None
        ):  # a navigator places samples by its clock
            plan = replace(
                plan, devices={**plan.devices, self.sources.imu_source: DevicePlan(self.sources.clock_of_imu)}
            )
        return Stream(self._chains(), StreamClocks.growing(plan), path, settings)

    def office_stream(self, clocks: FrozenClocks, trajectory: Trajectory, settings: StreamSettings = OFFICE) -> Stream:
        """Return a stream with all of a log's clocks and a complete trajectory, which is used unchanged."""
        return Stream(self._chains(), clocks.for_stream(), CompletePath(trajectory), settings)

    @property
    def deflection_rad(self) -> tuple[float, float] | None:
        """Deflection ξ, η of ``[attitude]``; None if the attitude refers to the ellipsoid."""
        attitude = self.config.attitude
        if attitude.xi_arcsec is None or attitude.eta_arcsec is None:
            return None
        return attitude.xi_arcsec * ARCSEC, attitude.eta_arcsec * ARCSEC

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
        """Return a scanner's `Georeferencer`."""
        return self._georeferencers[name]

    def take_angles(self, angles: Mapping[str, AngleSeries]) -> None:
        """Take the angles that sources of gimbals sent; without them, returns on such a gimbal have no place.

        Raises:
            ConfigError: a source sent no angles.
        """
        if self.sources.gimbal_sources:
            self._georeferencers = self._made(angles)

    def _made(self, angles: Mapping[str, AngleSeries] | None) -> dict[str, Any]:
        parsers = self.sources.parsers(("scanner",))  # they hold tables of beams; and wrong settings are reported now
        return {name: self._georeferencer(name, parsers[f"scanner/{name}"], angles) for name in self.scanners}

    def _georeferencer(self, name: str, parser: Parser, angles: Mapping[str, AngleSeries] | None) -> Any:
        sent = sent_file_of(self.config.scanner[name])
        if sent is not None and name not in self.sources.sent:
            raise ConfigError(
                f"scanner.{name}: no {sent.what} of the head was received, which states the angles of its beams; give "
                "geometry.file (after the flight in a configuration with --config), and record the port (auxiliary)"
            )
        try:
            return make_georeferencer(
                self.config,
                name,
                self.calibrations[name].with_plausible_sigmas(),
                parser,
                self.sources.files(name, self.config.scanner[name]).get("geometry"),
                self.mapping,
                uncertainty=self.options.uncertainty,
                angles=angles,
                with_beams=self._needs_surface(name),
                with_covariances=self.options.covariances,
            )
        except ValueError as error:
            raise ConfigError(f"scanner.{name}: {error}") from error

    def _needs_surface(self, name: str) -> bool:
        """Return whether anything that is wanted of a scanner's points depends on the surface."""
        if self.options.surface == "none" or not self.options.uncertainty:
            return False
        return self.options.incidence or self.config.scanner[name].divergence_mrad > 0.0

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
        stored = self.sources.attachments.get(attachment_name("calibration", name, Path(table.calibration)))
        if stored is None:
            raise ConfigError(
                f"scanner.{name}.calibration: {table.calibration} is not in the log; give it with --calibration"
            )
        return decoded(stored, "replace"), table.calibration
