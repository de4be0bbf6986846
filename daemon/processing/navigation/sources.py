"""Chooses the IMU and the receiver that a log is navigated with; holds their parsers, clocks and the filter's setup."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from swath.daemon.config.checks import check_antennas
from swath.daemon.config.config import PARSER_FILES, Config, attachment_name
from swath.daemon.config.tables import GnssConfig, ImuConfig, MtaConfig, NoiseConfig, OutputConfig
from swath.daemon.errors import ConfigError, ExitCode, UserError
from swath.daemon.log.format import LogError, SessionInfo
from swath.daemon.log.parsers import stored_config
from swath.daemon.processing.setup.models import gimbal_sources
from swath.daemon.processing.setup.sources import Sources
from swath.drivers.driver import RAW, UnknownProtocolError
from swath.drivers.parser import DriverSettingsError, Parser
from swath.georef.arrays import FloatArray, StructArray
from swath.georef.navigation.inputs import ARM_UNSAID_M, GRADES, ImuNoise, Setup, imu_noise
from swath.georef.stream.clocks import ClockPlan, DevicePlan

if TYPE_CHECKING:
    from swath.daemon.log.reader import Session


# Receivers' sigmas of positions are taken as those of their total error. Half of its variance lasts for about a minute:
# multipath, the atmosphere, the orbits. A whole flight's innovations correct both (`swath.georef.navigation.noise`).
CORRELATED_SHARE, CORRELATION_S = 0.5, 60.0
HEADING_SHARE, HEADING_CORRELATION_S = 0.36, 60.0  # the same for dual-antenna headings (multipath)


class NavigationSources:
    """The sources of a session that it is navigated with.

    Args:
        config: configuration of the log, or another one.
        attachments: the files that it names, by their names in a log.
        imu, gnss: names; None: the first IMU and the first receiver that do not belong to a gimbal.
        outside: True if positions come from a file, so that a receiver is not needed.
        arm_b: (3,) lever arm of the primary antenna, m, in place of the receiver's; None: the receiver's.

    Attributes:
        imu_name, gnss_name: names in the configuration; gnss_name is None if it has no receiver.
        clock: source of the host's time for the IMU.
        ins_source: source whose own INS may send solutions; None: there is no such source.

    Raises:
        ConfigError, UserError: sources are missing or cannot be used.
    """

    def __init__(
        self,
        config: Config,
        attachments: Mapping[str, bytes],
        imu: str | None = None,
        gnss: str | None = None,
        *,
        outside: bool = False,
        arm_b: Sequence[float] | None = None,
    ) -> None:
        self.config = config
        self._arm_b = arm_b
        self._attachments = dict(attachments)
        gimbals = {source for name in config.scanner for _, source in gimbal_sources(config, name)}
        of_aircraft = [
            name for name, table in config.imu.items() if f"imu/{name}" not in gimbals and table.protocol != RAW
        ]
        self.imu_name = _chosen("imu", imu, list(config.imu), of_aircraft)
        receivers = [
            name for name, table in config.gnss.items() if f"gnss/{name}" not in gimbals and table.protocol != RAW
        ]
        self.gnss_name: str | None = None
        if receivers or gnss is not None or not outside:
            self.gnss_name = _chosen("gnss", gnss, list(config.gnss), receivers)
        table = {self.imu_name: config.imu[self.imu_name]}
        self._devices = Sources(without_scanners(config, imu=table), attachments)
        self.clock = self._devices.clock_of_imu
        self.ins_source = self._devices.ins_source

    @property
    def imu(self) -> ImuConfig:
        """The IMU's table in the configuration."""
        return self.config.imu[self.imu_name]

    @property
    def gnss(self) -> GnssConfig | None:
        """The receiver's table in the configuration; None: there is no receiver."""
        return None if self.gnss_name is None else self.config.gnss[self.gnss_name]

    @property
    def imu_source(self) -> str:
        """The IMU's source name, as ``imu/main``."""
        return f"imu/{self.imu_name}"

    @property
    def gnss_source(self) -> str | None:
        """The receiver's source name, as ``gnss/rover``; None: there is no receiver."""
        return None if self.gnss_name is None else f"gnss/{self.gnss_name}"

    @property
    def arm_is_said(self) -> bool:
        """True if the lever arm of the positions' antenna is known before the flight."""
        return self.gnss is not None or self._arm_b is not None

    @property
    def imu_is_in_receiver(self) -> bool:
        """True if the IMU is inside the receiver, or the receiver in the IMU, which makes an INS of both."""
        inside = self.gnss is not None and self.gnss.transport == f"imu:{self.imu_name}"
        return inside or self.imu.transport == f"gnss:{self.gnss_name}"

    @property
    def noise_by_grade(self) -> dict[str, float]:
        """Keys of ``[imu.….noise]`` that the configuration does not set, with the values of its grade."""
        table = self.imu.noise
        noise = noise_of(table)
        one = imu_noise(**dict.fromkeys(_NOISE_FIELDS, 1.0))  # each key's unit
        absent = [key for key in _NOISE_FIELDS if getattr(table, key) is None]
        found = {key: getattr(noise, field) / getattr(one, field) for key, field in _NOISE_FIELDS.items()}
        return {key: float(f"{found[key]:.6g}") for key in absent}

    def noise_words(self) -> str:
        """Return a line on which keys of the noise come from a grade and whether it was chosen; empty if none do."""
        table, given = self.imu.noise, self.noise_by_grade
        if not given:
            return ""
        chosen = "" if "grade" in table.model_fields_set else ", the default"
        values = ", ".join(f"{key} {value:g}" for key, value in given.items())
        return f"Noise by grade {table.grade}{chosen} (imu.{self.imu_name}.noise does not set these): {values}"

    # ------------------------------------------------------------------ reading

    def parsers(self) -> dict[str, Parser]:
        """Return new parsers of the IMU and of all receivers, by source.

        Raises:
            ConfigError: a driver cannot work with its settings.
        """
        made: dict[str, Parser] = {}
        for kind, name, table in self.config.device_tables():
            if kind in ("scanner", "corrections", "raw") or (kind == "imu" and name != self.imu_name):
                continue
            source = f"{kind}/{name}"
            try:
                settings = self.config.settings_with(kind, name, table, self._files, compiled=True)
                made[source] = self.config.driver_of(kind, table).make_parser(settings)
            except UnknownProtocolError as error:
                raise ConfigError(f"{kind}.{name}.protocol: {error}") from error
            except DriverSettingsError as error:
                raise ConfigError(f"{kind}.{name}: {error}") from error
        return made

    def _files(self, name: str, table: Any) -> dict[str, bytes]:
        found: dict[str, bytes] = {}
        for key, path in self.config.files_of(table).items():
            stored = self._attachments.get(attachment_name(key, name, path))
            if key in PARSER_FILES and stored is not None:
                found[key] = stored
        return found

    def inside(self, source: str) -> list[str]:
        """Return the sources whose messages are in a wire's bytes."""
        return self._devices.inside(source)

    def holds_imu(self, topic: str) -> bool:
        """Return whether a topic is of a scanner that holds the IMU in its stream."""
        kind, _, name = self.imu.transport.partition(":")
        return kind == "scanner" and topic.startswith(f"/scanner/{name}/")

    def edge_of(self, source: str) -> str | None:
        """Return the polarity of the edges of ``pps/name``; None: there is no such source."""
        return self._devices.edge_of(source)

    def clock_plan(self, info: SessionInfo) -> ClockPlan:
        """Return the clocks of a session, the IMU's own among them."""
        plan = self._devices.clock_plan(info)
        devices = {} if self.clock is None else {self.imu_source: DevicePlan(self.clock)}
        return replace(plan, devices=devices)

    # ------------------------------------------------------------------ the filter's setup

    @property
    def rot_b_from_imu(self) -> FloatArray:
        """Rotation (3, 3) from the IMU's axes to b, by ``rotation_b_imu``."""
        return np.array(self.imu.rotation_b_imu, dtype=np.float64)

    def ins_rows_in_b(self, rows: StructArray) -> StructArray:
        """Return solutions of the device's INS with the attitude of b."""
        return self._devices.ins_rows(rows)

    def setup(self, *, time_sigma_s: float = 0.0) -> Setup:
        """Return lever arms, baseline and noise; a ``time_sigma_s`` above 0 has an offset of the
        IMU's times estimated.
        """
        table = self.gnss
        arms = [np.zeros(3) if table is None else np.array(table.lever_arm_m, dtype=np.float64)]
        if table is not None and table.secondary_lever_arm_m is not None:
            arms.append(np.array(table.secondary_lever_arm_m, dtype=np.float64))
            for problem in check_antennas(f"gnss.{self.gnss_name}", table):
                raise ConfigError(problem)
        setup = filter_setup(noise_of(self.imu.noise), arms, time_sigma_s=time_sigma_s)
        if self._arm_b is not None:
            own = np.stack([np.array(self._arm_b, dtype=np.float64), *arms[1:]])
            setup = replace(setup, lever_arms_b=own)
        return setup if self.arm_is_said else replace(setup, estimate_lever_arm=ARM_UNSAID_M)


def filter_setup(noise: ImuNoise, arms_b: Sequence[FloatArray], *, time_sigma_s: float = 0.0) -> Setup:
    """Return the filter's setup for an IMU and a receiver with antennas (3,), primary first; see
    `NavigationSources`.
    """
    return Setup(
        noise=noise,
        lever_arms_b=np.stack(arms_b),
        baseline_b=arms_b[1] - arms_b[0] if len(arms_b) > 1 else None,
        estimate_time_offset_s=time_sigma_s,
        gnss_correlation_s=CORRELATION_S,
        gnss_correlated_share=CORRELATED_SHARE,
        gnss_heading_correlation_s=HEADING_CORRELATION_S,
        gnss_heading_share=HEADING_SHARE,
    )


def files_of(session: Session, config: Config | None) -> dict[str, bytes]:
    """Return the files that a configuration names, by their names in a log: the log's own, or those on disk.

    The log's are used for its own configuration or None.

    Raises:
        OSError: a file cannot be read.
    """
    stored = session.attachments()
    if config is None or stored.get("config.toml") == config.text.encode():
        return stored
    return {name: data for name, _, data in config.attachments()}


def config_of_log(attachments: Mapping[str, bytes]) -> Config:
    """Return the configuration that is stored in a log.

    Raises:
        UserError: there is no configuration, or it cannot be used.
    """
    try:
        config = stored_config(attachments)
    except LogError as error:
        raise UserError(f"{error}; give another configuration with --config") from error
    if config is None:
        raise UserError("the log holds no configuration; give one with --config")
    return config


def without_scanners(config: Config, **tables: Any) -> Config:
    """Return a configuration without scanners, calibrations and mapping frame, which navigation does not need."""
    update: dict[str, Any] = {
        "scanner": {},
        "output": OutputConfig.model_validate({}),
        "mta": MtaConfig.model_validate({}),
    }
    tables_left = config.tables.model_copy(update=update | tables)
    return Config(tables_left, config.path, config.text, config.recorded_with)


def _chosen(kind: str, wanted: str | None, known: list[str], usual: list[str]) -> str:
    """Return the wanted name in the configuration; without one, the first of those usually meant."""
    if wanted is not None:
        if wanted in known:
            return wanted
        option = "--imu" if kind == "imu" else "--gnss-name"
        raise UserError(
            f"{option}: the configuration has no [{kind}.{wanted}]; it has: {', '.join(known) or 'none'}",
            ExitCode.USAGE,
        )
    if usual:
        return usual[0]
    what = {
        "imu": "no IMU of the aircraft; add [imu.NAME], or give a finished trajectory",
        "gnss": "no GNSS receiver; add [gnss.NAME], or give --gnss FILE",
    }[kind]
    raise UserError(f"the configuration has {what}", ExitCode.USAGE)


_NOISE_FIELDS = {
    "angle_random_walk_deg_per_sqrt_h": "angle_random_walk",
    "velocity_random_walk_m_per_s_per_sqrt_h": "velocity_random_walk",
    "gyro_bias_deg_per_h": "gyro_bias",
    "accel_bias_mg": "accel_bias",
    "bias_correlation_h": "bias_correlation_s",
    "gyro_scale_ppm": "gyro_scale",
    "accel_scale_ppm": "accel_scale",
    "misalignment_mrad": "misalignment",
}


def noise_of(table: NoiseConfig) -> ImuNoise:
    """Return the noise of ``[imu.….noise]``; values that it leaves out are its grade's."""
    configured = {key: value for key, value in table.model_dump().items() if key != "grade" and value is not None}
    grade = GRADES[table.grade]
    in_si = imu_noise(**(dict.fromkeys(_NOISE_FIELDS, 0.0) | configured))
    chosen = {_NOISE_FIELDS[key]: getattr(in_si, _NOISE_FIELDS[key]) for key in configured}
    return ImuNoise(**({field.name: getattr(grade, field.name) for field in fields(grade)} | chosen))
