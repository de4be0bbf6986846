"""Checks what types cannot express: references to names, files, wires used twice, the requirements of the drivers.

Every check yields lines ``key: the fault; a correct value``; the caller puts the file's name in front.

Calibration files are checked here for readability and for the right scanner (CONVENTIONS, calibration file); calib
reads the full model. The recorder only keeps a copy, and refuses to start with the wrong file.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, get_args

import numpy as np
from pydantic import BaseModel, ValidationError

from swath.daemon.config.config import Config, DeviceTable
from swath.daemon.config.faults import describe
from swath.daemon.config.rotations import rotation_problem
from swath.daemon.config.tables import CorrectionsConfig, GnssConfig, ImuConfig, RawConfig, ScannerConfig
from swath.drivers.driver import RAW, Driver, NotLoadedError, UnknownProtocolError
from swath.drivers.parser import DeviceKind, DriverSettingsError
from swath.drivers.startup import StartupOptions
from swath.drivers.transports.spec import TransportSpec, parse_pps, parse_transport
from swath.georef.text_encoding import decoded
from swath.georef.toml_tables import TomlError, toml_tables

CONVENTIONS_VERSION = 1
METHODS = ("nominal", "planes", "tie_points", "profiles", "control", "combined")
NEEDED_TEXTS = ("id", "scanner", "method")
NEEDED_PARAMETERS = (
    "omega_deg",
    "phi_deg",
    "kappa_deg",
    "range_offset_m",
    "lever_arm_x_m",
    "lever_arm_y_m",
    "lever_arm_z_m",
)

WILDCARD = "0.0.0.0"
PLAN_SUFFIXES = (".toml", ".kml", ".kmz", ".geojson", ".json", ".gpkg", ".shp")
MAX_PLAN_BYTES = 16 << 20  # each part of a log holds the plan
MIN_BASELINE_M = 0.1  # a shorter baseline gives no useful heading


def check_devices(config: Config, *, with_plan: bool = True) -> list[str]:
    """Check a configuration whose types are right and return all findings; ``with_plan``: also the plan's files."""
    lines: list[str] = []
    lines += _check_directory(config)
    lines += _check_pps(config)
    lines += _check_files(config)
    lines += _check_plan(config) if with_plan else []
    for kind, name, table in config.device_tables():
        lines += _check_device(config, kind, name, table)
    lines += _check_wires(config)
    return lines


def _check_pps(config: Config) -> Iterator[str]:
    taken: dict[tuple[str, str], str] = {}
    for name, pps in config.pps.items():
        key = f"pps.{name}.source"
        try:
            parse_pps(pps.source, edge=pps.edge)
        except ValueError as error:
            yield f"{key}: {error}"
            continue
        device = (os.path.realpath(pps.source.partition(":")[2] or pps.source), pps.edge)
        if device in taken:
            yield f"{taken[device]} and {key}: both use {pps.source}; give each its own device or edge"
        taken.setdefault(device, key)


def _check_files(config: Config) -> Iterator[str]:
    """Check that all named files exist, and that no two different DBC files have the same name: the log keeps them by
    name.
    """
    dbc_of: dict[str, tuple[str, Path]] = {}
    for kind, name, table in config.device_tables():
        for file_key, path in config.files_of(table).items():
            key = f"{kind}.{name}.{'geometry.file' if file_key == 'geometry' else file_key}"
            problem = _unreadable(path)
            if problem:
                yield f"{key}: {path}: {problem}; give a file, relative to the configuration"
                continue
            if file_key == "dbc":
                first_key, first_path = dbc_of.setdefault(path.name, (key, path))
                if first_path.read_bytes() != path.read_bytes():
                    yield f"{first_key} and {key}: two files are named {path.name}; rename one, logs store them by name"
    if config.mta.terrain:
        problem = _unreadable(config.resolve(config.mta.terrain))
        if problem:
            yield f"mta.terrain: {config.resolve(config.mta.terrain)}: {problem}; give a file or leave it empty"


def _check_plan(config: Config) -> Iterator[str]:
    """Check that the files of the flight plan exist; what they hold is checked where they are used."""
    plan = config.tables.plan
    named: dict[str, Path] = {}
    for key, name in (("plan.file", plan.file), ("plan.area", plan.area)):
        if name is None:
            continue
        path = config.resolve(name)
        problem = _unreadable(path)
        if problem:
            yield f"{key}: {path}: {problem}; give a file, relative to the configuration"
        elif path.suffix.lower() not in PLAN_SUFFIXES:
            yield f'{key}: got "{name}", want a file of one of the kinds {", ".join(PLAN_SUFFIXES)}'
        elif path.stat().st_size > MAX_PLAN_BYTES:
            size_mb = path.stat().st_size / 1e6
            yield f"{key}: {path} has {size_mb:.0f} MB; want at most {MAX_PLAN_BYTES / 1e6:.0f} MB, the lines alone"
        elif named.setdefault(path.name, path) != path:
            yield f"plan.file and plan.area: two files are named {path.name}; rename one, logs store them by name"
    if plan.area is not None and plan.file is None:
        yield "plan.area: needs plan.file, the lines that are to cover it"


def _unreadable(path: Path) -> str | None:
    if path.is_dir():
        return "is a directory"
    try:
        with path.open("rb"):
            return None
    except OSError as error:
        return error.strerror or str(error)
    except ValueError:
        return "contains a zero character"


def _check_directory(config: Config) -> Iterator[str]:
    if "\0" in config.session.directory:
        yield "session.directory: contains a zero character; want a path"


def _check_device(config: Config, kind: DeviceKind, name: str, table: DeviceTable) -> Iterator[str]:
    section = f"{kind}.{name}"
    if isinstance(table, CorrectionsConfig):
        yield from _check_forwarding(config, section, table)
    elif isinstance(table, RawConfig):
        pass
    elif table.pps is not None and table.pps not in config.pps:
        known = ", ".join(config.pps) or "none; add [pps.main]"
        yield f'{section}.pps: got "{table.pps}", want the name of a [pps.<name>]; there are: {known}'
    yield from _check_rotations(section, table)
    if isinstance(table, GnssConfig):
        yield from check_antennas(section, table)
    if isinstance(table, ScannerConfig):
        yield from _check_calibration(config, name, table)
        yield from _check_gimbal(config, name, table)
    try:
        driver = config.driver_of(kind, table)
    except NotLoadedError as error:
        yield f"{section}.protocol: {error}; meanwhile swath run records the device as it comes"
        return
    except UnknownProtocolError as error:
        yield f"{section}.protocol: {error}"
        return
    if f"{kind}/{name}" in config.not_loaded and config.carrier_of(table) is not None:
        return  # its bytes are in the stream of the other device
    yield from _check_transport(config, section, table, driver)
    if isinstance(table, ScannerConfig) and f"{kind}/{name}" not in config.not_loaded:
        yield from _check_clock(section, table, driver)
    wrong = [*_check_needs(section, table, driver), *_check_options(config, kind, name, table, driver)]
    yield from wrong
    carrier = config.carrier_of(table)  # its files are read too
    tables = [table] if carrier is None else [table, carrier[1]]
    if not wrong and not any(_unreadable(path) for one in tables for path in config.files_of(one).values()):
        settings = config.settings_of(kind, name, table)
        try:
            driver.make_parser(settings)
            if driver.startup is not None:
                driver.startup(settings, StartupOptions())
        except DriverSettingsError as error:
            yield f"{section}: {error}"


def _check_clock(section: str, table: ScannerConfig, driver: Driver) -> Iterator[str]:
    """Check that a scanner's ``clock`` is one that the stamps of its protocol can have."""
    can = ["auto"]
    if driver.past_hour:
        can += ["utc-hour", "free"]
    elif not driver.line_scanner:  # a line scanner latches the pulse, so ``clock`` has nothing to choose
        can += ["ptp-tai", "ptp-utc", "free"]
    if table.clock not in can:
        wanted = " or ".join(f'"{one}"' for one in can)
        yield f'{section}.clock: got "{table.clock}", which {table.protocol} cannot have; want {wanted}'


def _check_forwarding(config: Config, section: str, table: CorrectionsConfig) -> Iterator[str]:
    if table.forward_to is None:
        return
    kind, _, name = table.forward_to.partition(".")
    if kind != "gnss" or name not in config.gnss:
        known = ", ".join(f"gnss.{one}" for one in config.gnss) or "none"
        yield f'{section}.forward_to: got "{table.forward_to}", want a receiver such as gnss.rover; there are: {known}'
    elif config.gnss[name].transport.partition(":")[0] not in ("serial", "tcp"):
        yield f"{section}.forward_to: {table.forward_to} has no port to write to; want a receiver by serial: or tcp:"


def _check_needs(section: str, table: DeviceTable, driver: Driver) -> Iterator[str]:
    for need in driver.needs:
        value: object = table
        for part in need.split("."):
            value = getattr(value, part, None)
        if value is None:
            yield f"{section}.{need}: missing; {driver.protocol} needs it: {_described(type(table), need)}"


def _check_options(config: Config, kind: DeviceKind, name: str, table: DeviceTable, driver: Driver) -> Iterator[str]:
    """Check the keys that only the driver knows: its own table's, or those of the device whose stream it is in."""
    own = getattr(table, "options", {})
    section, given, carrier = f"{kind}.{name}", own, config.carrier_of(table)
    if not own and carrier is not None and driver.options is not None:
        section, given = table.transport.replace(":", ".", 1), getattr(carrier[1], "options", {})
    if driver.options is None:
        if given and driver.protocol != RAW:
            yield f"{section}.options: {driver.protocol} has no keys of its own; remove the table"
        return
    try:
        driver.options.model_validate(given)
    except ValidationError as error:
        for details in error.errors(include_url=False):
            yield describe(details, driver.options, f"{section}.options")


def _described(model: type[BaseModel], key: str) -> str | None:
    """Return the description of a key; ``geometry.file`` refers to a key of an inner table."""
    first, _, rest = key.partition(".")
    field = model.model_fields[first]
    if not rest:
        return field.description
    (inner,) = [one for one in get_args(field.annotation) if isinstance(one, type) and issubclass(one, BaseModel)]
    return _described(inner, rest)


def _check_transport(config: Config, section: str, table: DeviceTable, driver: Driver) -> Iterator[str]:
    allowed = ", ".join(driver.transports)
    try:
        spec = parse_transport(table.transport)
    except ValueError as error:
        yield f"{section}.{error}"
    else:
        tables: dict[str, Mapping[str, DeviceTable]] = {
            "gnss": config.gnss,
            "imu": config.imu,
            "scanner": config.scanner,
            "raw": config.raw,
        }
        carriers = tables.get(spec.kind, {})
        got = f'{section}.transport: got "{table.transport}"'
        if spec.carrier is not None and spec.address not in carriers:
            known = ", ".join(carriers) or "none"
            yield f"{got}, want the name of a [{spec.kind}.<name>]; there are: {known}"
        elif spec.kind == RAW and isinstance(table, GnssConfig | ImuConfig):
            pass  # bytes recorded before there was a driver
        elif spec.kind not in driver.transports:
            yield f"{got}; {driver.protocol} supports: {allowed}"
        elif spec.carrier is not None:
            yield from _check_carrier(section, table, spec, carriers[spec.address])
    if isinstance(table, ScannerConfig) and table.auxiliary:
        try:
            auxiliary = parse_transport(table.auxiliary)
        except ValueError as error:
            yield f"{section}.auxiliary: {error}"
        else:
            if auxiliary.kind != "udp":
                yield f'{section}.auxiliary: got "{table.auxiliary}", want udp:<address>:<port>'


def _check_carrier(section: str, table: DeviceTable, spec: TransportSpec, carrier: DeviceTable) -> Iterator[str]:
    """Check the device whose stream holds another one's bytes: it has a wire of its own, and speaks the protocol."""
    name = f"{spec.kind}.{spec.address}"
    if carrier.transport.partition(":")[0] in ("gnss", "imu", "scanner"):
        yield f'{section}.transport: got "{table.transport}", but [{name}] has no wire of its own; name one that has'
    elif carrier.protocol != table.protocol:
        wanted = f'"{carrier.protocol}" like [{name}], whose stream carries it'
        yield f'{section}.protocol: got "{table.protocol}", want {wanted}'


def check_antennas(section: str, table: GnssConfig) -> Iterator[str]:
    """Check the places of a receiver's two antennas and yield what is wrong."""
    if table.secondary_lever_arm_m is None:
        return
    length_m = float(np.linalg.norm(np.subtract(table.secondary_lever_arm_m, table.lever_arm_m)))
    if length_m < MIN_BASELINE_M:
        yield (
            f"{section}.secondary_lever_arm_m: is {length_m:.2f} m from lever_arm_m; "
            f"want the position of the second antenna, {MIN_BASELINE_M:g} m or more away, or remove the key"
        )


def _check_rotations(section: str, table: DeviceTable) -> Iterator[str]:
    for key in ("rotation_b_imu", "installation"):
        rows = getattr(table, key, None)
        if rows is None:
            continue
        problem = rotation_problem(rows)
        if problem:
            yield f"{section}.{key}: {problem}"


def _check_gimbal(config: Config, name: str, table: ScannerConfig) -> Iterator[str]:
    """Check that the source of each stage's angles exists; whether it delivers angles is found when they are used."""
    sources = [f"gnss/{one}" for one in config.gnss] + [f"imu/{one}" for one in config.imu]
    for number, stage in enumerate(table.gimbal.stages if table.gimbal is not None else []):
        if stage.source is not None and stage.source not in sources:
            key = f"scanner.{name}.gimbal.stages[{number}].source"
            yield f'{key}: got "{stage.source}", want one of: {", ".join(sources) or "none is configured"}'


def _check_calibration(config: Config, name: str, table: ScannerConfig) -> Iterator[str]:
    if table.calibration is None:
        return
    path = config.resolve(table.calibration)
    if _unreadable(path) is None:
        for problem in check_calibration(path, name, table):
            yield f"scanner.{name}.calibration: {path}: {problem}"


def _check_wires(config: Config) -> Iterator[str]:
    """Check that no two sources use one port or device, where each would take bytes of the other."""
    wires: list[tuple[str, TransportSpec]] = list(_wires(config))
    for index, (key, spec) in enumerate(wires):
        for other_key, other in wires[:index]:
            if same_wire(spec, other):
                hint = ", or tell their senders apart by ?source=<address>" if spec.kind == "udp" else ""
                yield f"{other_key} and {key}: both use {_wire_name(spec)}; give each its own{hint}"
                break


def _wires(config: Config) -> Iterator[tuple[str, TransportSpec]]:
    for kind, name, table in config.device_tables():
        for key in ("transport", "auxiliary"):
            text = getattr(table, key, None)
            if text is None:
                continue
            try:
                spec = config.transport(text)
            except ValueError:
                continue  # already a finding
            if spec.carrier is None:
                yield f"{kind}.{name}.{key}", spec


def same_wire(one: TransportSpec, other: TransportSpec) -> bool:
    """Return whether two transports would open the same port or device.

    UDP ports are the same if the port numbers are equal and the addresses (or groups) are equal or either is the
    wildcard, unless ``source`` tells their senders apart; devices, including a serial CAN adapter's, if their real
    paths are equal; a CAN bus if interface and channel are equal.
    """
    if one.kind == "udp" and other.kind == "udp":
        addresses = {_udp_address(one), _udp_address(other)}
        overlap = one.port == other.port and (len(addresses) == 1 or WILDCARD in addresses)
        return overlap and not _told_apart(one, other)
    path, other_path = _device_path(one), _device_path(other)
    if path is not None or other_path is not None:
        return path == other_path
    port, other_port = one.options.get("port"), other.options.get("port")  # set for a CAN bus over UDP
    return one.kind == other.kind and (one.address, port) == (other.address, other_port)


def _told_apart(one: TransportSpec, other: TransportSpec) -> bool:
    """Return whether two transports of a UDP port take different senders, from one socket or from those of a group."""
    sources = {one.options.get("source"), other.options.get("source")}
    groups = {one.options.get("group"), other.options.get("group")}
    one_socket = (one.host, one.options.get("interface")) == (other.host, other.options.get("interface"))
    return None not in sources and len(sources) == 2 and len(groups) == 1 and (None not in groups or one_socket)


def _udp_address(spec: TransportSpec) -> str:
    return spec.options.get("group", spec.host)


def _device_path(spec: TransportSpec) -> str | None:
    """Return the real path of a device file, with symbolic links resolved; None if the transport is not a
    device file.
    """
    path = spec.channel if spec.kind == "can" else spec.address
    is_path = spec.kind == "serial" or (spec.kind == "can" and path.startswith("/"))
    return os.path.realpath(path) if is_path else None


def _wire_name(spec: TransportSpec) -> str:
    if spec.kind == "udp":
        return f"UDP port {spec.port}"
    if spec.kind == "ntrip":
        return f"the mountpoint {spec.address}"
    if spec.kind == "tcp":
        return f"the TCP port {spec.address}"
    path = _device_path(spec)
    return f"the device {path}" if path else f"the CAN bus {spec.address}"


def check_calibration(path: Path, scanner: str, table: ScannerConfig) -> Iterator[str]:
    """Check a calibration file for the scanner of this name; yield lines with the fault and a correct value."""
    try:
        document = toml_tables(decoded(path.read_bytes()))
    except UnicodeDecodeError as error:
        yield f"not TOML: {error}"
        return
    except TomlError as error:
        yield str(error)
        return
    header, parameters = document.get("calibration"), document.get("parameters")
    if not isinstance(header, dict) or not isinstance(parameters, dict):
        yield "not a calibration file; want the tables [calibration] and [parameters]"
        return
    yield from _check_header(header, scanner, table)
    for key in NEEDED_PARAMETERS:
        value = parameters.get(key)
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            yield f"parameters.{key}: {'missing' if value is None else 'not a number'}; want a number"


def _check_header(header: Mapping[str, Any], scanner: str, table: ScannerConfig) -> Iterator[str]:
    missing = [key for key in NEEDED_TEXTS if not isinstance(header.get(key), str) or not header[key]]
    for key in missing:
        yield f"calibration.{key}: missing; want text in quotes"
    if "scanner" not in missing and header["scanner"] != scanner:
        yield f'calibration.scanner: got "{header["scanner"]}", want "{scanner}"'
    if "method" not in missing and header["method"] not in METHODS:
        yield f'calibration.method: got "{header["method"]}", want one of {", ".join(METHODS)}'
    version = header.get("conventions", CONVENTIONS_VERSION)
    if version != CONVENTIONS_VERSION:
        yield f"calibration.conventions: got {version}, want {CONVENTIONS_VERSION}"
    for key in ("model", "serial"):
        theirs, ours = header.get(f"scanner_{key}", ""), getattr(table, key)
        if theirs and ours and theirs != ours:
            yield f'calibration.scanner_{key}: got "{theirs}", but {key} of the scanner is "{ours}"'
