"""Finds settings that are allowed and hardly meant: they would record, and spoil or lose what is made from the log.

Every finding is a line ``key: the fact; the remedy``. The recorder starts nevertheless; `swath check` reports them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from swath.daemon.config.config import Config
from swath.daemon.config.tables import CorrectionsConfig, GnssConfig, ImuConfig, RawConfig, ScannerConfig
from swath.drivers.driver import RAW, find_driver
from swath.drivers.transports.spec import parse_transport
from swath.georef.records import DeviceClockSamples, TimeMessage
from swath.georef.text_encoding import decoded
from swath.georef.toml_tables import toml_tables

LONG_ARM_M = 30.0  # longer than the way from an IMU to an antenna or scanner on any usual aircraft
MILLIMETRES = 1000.0
NO_SOURCE = "no source is configured; add a section such as [gnss.rover], [imu.main] or [scanner.left]"
USUAL_BAUDS = (
    *(1200, 2400, 4800, 9600, 14400, 19200, 28800, 38400, 57600, 76800, 115200, 128000, 230400, 250000, 256000),
    *(460800, 500000, 576000, 921600, 1000000, 1152000, 1500000, 2000000, 2500000, 3000000, 3500000, 4000000),
    *(6000000, 8000000, 12000000),
)


def configuration_findings(config: Config) -> list[str]:
    """Return what is hardly meant in a valid configuration, one line each."""
    lines = [] if any(config.device_tables()) or config.pps else [NO_SOURCE]
    for source, (_, error) in config.not_loaded.items():
        lines.append(f"{source.replace('/', '.')}.protocol: {error}; meanwhile the device is recorded as it comes")
    return [*lines, *lever_arm_findings(config), *_bauds(config), *_unseen_pps(config), *_untold_angles(config)]


def scanner_lever_arm_b(config: Config, name: str) -> tuple[str, list[float]]:
    """Return the key and the value of a scanner's lever arm, m in b: the calibration file's if there is one."""
    table = config.scanner[name]
    if table.calibration is not None:
        try:
            content = toml_tables(decoded(config.resolve(table.calibration).read_bytes()))
            parameters = content["parameters"]
            arm = [float(parameters[f"lever_arm_{axis}_m"]) for axis in "xyz"]
        except (OSError, ValueError, KeyError, TypeError):
            return f"scanner.{name}.lever_arm_m", table.lever_arm_m  # a log's copy, whose files are attachments
        return f"scanner.{name}.calibration: parameters.lever_arm_x_m to lever_arm_z_m", arm
    return f"scanner.{name}.lever_arm_m", table.lever_arm_m


def lever_arm_findings(config: Config) -> list[str]:
    """Return a line for each lever arm that is longer than any aircraft needs."""
    arms: list[tuple[str, Sequence[float]]] = []
    for name, gnss in config.gnss.items():
        arms.append((f"gnss.{name}.lever_arm_m", gnss.lever_arm_m))
        if gnss.secondary_lever_arm_m is not None:
            arms.append((f"gnss.{name}.secondary_lever_arm_m", gnss.secondary_lever_arm_m))
    for name, scanner in config.scanner.items():
        arms.append(scanner_lever_arm_b(config, name))
        for number, stage in enumerate(scanner.gimbal.stages if scanner.gimbal else []):
            arms.append((f"scanner.{name}.gimbal.stages[{number}].lever_arm_m", stage.lever_arm_m))
    lines = []
    for key, arm in arms:
        length_m = math.hypot(*arm)
        if length_m > LONG_ARM_M:
            metres = ", ".join(f"{value / MILLIMETRES + 0.0:g}" for value in arm)
            lines.append(f"{key}: is {length_m:.0f} m long; give metres: if these are millimetres, [{metres}]")
    return lines


def _bauds(config: Config) -> Iterator[str]:
    """Yield a line for each speed of a serial port that no device has."""
    for kind, name, table in config.device_tables():
        spec = parse_transport(table.transport)
        baud = int(spec.options.get("baud", USUAL_BAUDS[0])) if spec.kind == "serial" else USUAL_BAUDS[0]
        if baud not in USUAL_BAUDS:
            near = min(USUAL_BAUDS, key=lambda usual: abs(math.log(usual / baud)))
            yield f"{kind}.{name}.transport: no usual port runs at {baud} baud; did you mean baud={near}?"


def _unseen_pps(config: Config) -> Iterator[str]:
    """Yield a line for each device with a ``pps`` whose data cannot show that it sees the pulse."""
    for kind, name, table in config.device_tables():
        if (
            isinstance(table, CorrectionsConfig | GnssConfig | RawConfig)
            or table.pps is None
            or table.protocol == RAW
            or parse_transport(table.transport).carrier is not None
        ):
            continue
        way = _why_unseen(table, find_driver(kind, table.protocol).yields)
        if way:
            yield f"{kind}.{name}.pps: nothing shows that the device sees its PPS: {way}"


def _untold_angles(config: Config) -> Iterator[str]:
    """Yield a line for each scanner that sends its own angles, if neither a port nor a file gives them."""
    for name, table in config.scanner.items():
        sent = None if table.protocol == RAW else find_driver("scanner", table.protocol).sent_file
        if sent is not None and table.auxiliary is None and (table.geometry is None or table.geometry.file is None):
            yield (
                f"scanner.{name}.auxiliary: is missing, the port of the {sent.what}s, which alone state the angles of "
                "its beams; add it, or give geometry.file"
            )


def _why_unseen(table: ImuConfig | ScannerConfig, yields: tuple[type, ...]) -> str:
    """Return why a device's data do not show its pulses, with the remedy; empty where they do."""
    if isinstance(table, ScannerConfig):
        silent = TimeMessage in yields and table.auxiliary is None
        return "its position packets tell it, and no port receives them; set auxiliary" if silent else ""
    latches = DeviceClockSamples in yields or TimeMessage in yields
    if not latches or table.protocol == "oxts-ncom":
        return f"{table.protocol} does not send what it latches at a pulse; remove pps"
    if table.protocol == "dbc" and (table.signals is None or table.signals.pps_ticks is None):
        return "its signals have no pps_ticks, the counter latched at a pulse; add it or remove pps"
    if table.protocol == "sbg-ellipse" and table.pps_event is None:
        return "pps_event is missing, the Sync In input that it is wired to; add it or remove pps"
    return ""
