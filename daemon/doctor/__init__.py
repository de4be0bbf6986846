"""Checks this computer for conditions that would cost data, and names a remedy for each.

`examine` runs all checks on this computer; each check is a small function over the files that it is given.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from shutil import disk_usage

from swath.daemon.config import Config
from swath.daemon.doctor import clock, devices, disk, host
from swath.daemon.doctor.finding import Finding, Tree, Verdict
from swath.daemon.log.claim import is_being_written
from swath.daemon.log.directory import nearest_there
from swath.daemon.log.host_clock import read_clock_discipline
from swath.daemon.log.parts import read_sign
from swath.drivers.driver import find_driver, not_loaded
from swath.drivers.transports.can.bitrate import interface_bitrate
from swath.drivers.transports.spec import TransportSpec
from swath.drivers.transports.udp_port import DEFAULT_BUFFER_MB

DEFAULT_DIRECTORY = Path("/var/lib/swath")
DEFAULT_RESERVE_BYTES = 512e6
DEFAULT_SPLIT_BYTES = 2048e6

__all__ = ["Finding", "Tree", "Verdict", "examine"]


def examine(config: Config | None, *, write: bool = True) -> Iterator[Finding]:
    """Run all checks on this computer.

    Args:
        config: the devices connected to it; None runs only the checks that need no configuration.
        write: measure the log directory's disk by writing to it.
    """
    tree = Tree()
    specs = _specs(config)
    yield from host.receive_buffers(tree, _asked_bytes(specs))
    yield from host.dropped_datagrams(tree)
    yield from host.governor(tree)
    yield from host.idle_states(tree)
    yield from host.memory(tree)
    yield from host.modules(tree, needed_modules(config, specs))
    yield from _clock(tree)
    yield from _disk(tree, config, write)
    yield from _devices(tree, config, specs)
    yield from other_drivers(config)


def other_drivers(config: Config | None) -> Iterator[Finding]:
    """Report drivers of other packages that cannot be used: wrong if a configured device needs one."""
    needed = {} if config is None else {protocol: source for source, (protocol, _) in config.not_loaded.items()}
    for one in not_loaded():
        what = f"protocol {one.protocol}: " if one.protocol else ""
        if one.protocol in needed:
            text = f"{what}{one}; {needed[one.protocol]} is recorded as it comes"
            yield Finding("drivers", Verdict.WRONG, text, "swath devices")
        else:
            yield Finding("drivers", Verdict.NOTE, f"{what}{one}", "swath devices")


def _specs(config: Config | None) -> list[TransportSpec]:
    entries = [] if config is None else list(config.devices())
    wires = [spec for entry in entries for spec in (entry.transport, entry.auxiliary) if spec is not None]
    return [spec for spec in wires if spec.carrier is None]


def _asked_bytes(specs: list[TransportSpec]) -> int:
    udp = [int(spec.options.get("buffer_mb", DEFAULT_BUFFER_MB)) for spec in specs if spec.kind == "udp"]
    return max(udp, default=DEFAULT_BUFFER_MB) << 20


def needed_modules(config: Config | None, specs: list[TransportSpec]) -> list[str]:
    """Return the kernel modules that a configuration needs, by the names that modprobe uses."""
    needed = ["can_raw"] if any(spec.kind == "can" and spec.interface == "socketcan" for spec in specs) else []
    paths = [spec.address for spec in specs if spec.kind == "serial"]
    if any(path.startswith("/dev/ttyUSB") for path in paths):
        needed.append("usbserial")
    if any(path.startswith("/dev/ttyACM") for path in paths):
        needed.append("cdc_acm")
    if config is not None and any(pps.source.startswith("/dev/") for pps in config.pps.values()):
        needed.append("pps_core")
    return needed


def highest_bytes_per_s(config: Config | None) -> float:
    """Return the most that the configured devices send: by their drivers, and by the speed of serial ports."""
    if config is None:
        return disk.SCANNER_BYTES_PER_S + disk.OTHER_BYTES_PER_S
    rate = disk.OTHER_BYTES_PER_S  # status, events and PPS
    for entry in config.devices():
        if entry.transport.carrier is not None:
            continue
        usual = disk.SCANNER_BYTES_PER_S if entry.kind == "scanner" else disk.OTHER_BYTES_PER_S
        declared = find_driver(entry.kind, entry.protocol).bytes_per_s
        most = usual if declared is None else declared
        if entry.transport.kind == "serial":
            most = min(most, int(entry.transport.options.get("baud", disk.USUAL_BAUD)) / disk.SERIAL_BITS_A_BYTE)
        rate += most + (disk.AUXILIARY_BYTES_PER_S if entry.auxiliary is not None else 0.0)
    return rate


def _clock(tree: Tree) -> Iterator[Finding]:
    yield from clock.keepers(tree, read_clock_discipline())
    yield from clock.movement(*clock.watch())


def _disk(tree: Tree, config: Config | None, write: bool) -> Iterator[Finding]:
    directory = DEFAULT_DIRECTORY if config is None else Path(config.session.directory)
    reserve = DEFAULT_RESERVE_BYTES if config is None else config.session.reserve_mb * 1e6
    split = DEFAULT_SPLIT_BYTES if config is None else config.session.split_size_mb * 1e6
    rate = highest_bytes_per_s(config)
    there, permitted = nearest_there(directory)
    if not permitted:
        yield from disk.writable(tree, directory, devices.recording_user(tree))
        return
    existing = there if there.is_dir() else there.parent
    yield from disk.file_system(disk.mount_of(tree, existing.resolve()), split)
    yield from disk.writable(tree, directory, devices.recording_user(tree))
    free = disk_usage(existing).free
    yield from disk.room(free, reserve, rate)
    sign = read_sign(directory)
    if not write or (sign is not None and is_being_written(sign.path)) or free < reserve + 2 * disk.TEST_BYTES:
        why = (
            "a recorder is running there"
            if sign is not None
            else "not enough free space"
            if write
            else "switched off by --no-write"
        )
        yield Finding("disk speed", Verdict.NOTE, f"not measured: {why}")
        return
    try:
        yield from disk.speed(*disk.measure(existing), rate)
    except OSError as error:
        yield Finding("disk speed", Verdict.NOTE, f"not measured: {existing}: {error.strerror}", "sudo swath doctor")


def _devices(tree: Tree, config: Config | None, specs: list[TransportSpec]) -> Iterator[Finding]:
    user = devices.recording_user(tree)
    yield from devices.port_grabbers(tree)
    for spec in specs:
        if spec.kind == "serial":
            yield from _device_file(tree, spec.address, user)
            yield from devices.serial_port(tree, spec.address)
        elif spec.kind == "can" and spec.interface == "socketcan":
            wanted = spec.options.get("bitrate")
            bitrate = None if wanted is None else int(wanted)
            yield from devices.can_interface(tree, spec.channel, bitrate, interface_bitrate)
        elif spec.kind == "udp" and "interface" in spec.options:
            yield from devices.network_interface(tree, spec.options["interface"])
        elif spec.kind == "tcp":
            yield from devices.network_host(spec.host, spec.port)
    for pps in {} if config is None else config.pps.values():
        if pps.source.startswith("/dev/"):
            yield from _device_file(tree, pps.source, user)
            yield from devices.pps_device(tree, pps.source, pps.edge)
        elif pps.source.startswith("serial-dcd:"):
            yield from _device_file(tree, pps.source.removeprefix("serial-dcd:"), user)


def _device_file(tree: Tree, path: str, user: devices.User) -> Iterator[Finding]:
    yield from devices.device_file(tree, path, user)
    if tree.at(path).exists():
        yield from devices.device_policy(tree, path)
