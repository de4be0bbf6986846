"""Assembles a recorder from a configuration: one thread for each wire, one writer, the clocks. It opens nothing."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from swath.daemon.config import Config, DeviceEntry, GnssConfig
from swath.daemon.log.block_queue import BlockQueue
from swath.daemon.log.channels import ChannelTable, JsonChannel
from swath.daemon.log.events import Events, Severity
from swath.daemon.log.format import SessionInfo
from swath.daemon.log.host_clock import HostClock
from swath.daemon.log.parts import Attachment, Parts
from swath.daemon.log.session import make_session_info
from swath.daemon.log.wires import make_wire
from swath.daemon.recorder.corrections import CorrectionsWatch, Relay
from swath.daemon.recorder.first_units import FirstUnits
from swath.daemon.recorder.receivers import PpsReceiver, Receiver, Shared, UnitReceiver, UnitsSeen
from swath.daemon.recorder.timekeeper import TimeKeeper
from swath.daemon.recorder.writer import Recorder, RecorderSettings
from swath.drivers.driver import RAW, find_driver
from swath.drivers.session import Session
from swath.drivers.transports.base import UnitBlock
from swath.drivers.transports.opening import open_pps, open_transport
from swath.drivers.transports.spec import parse_pps
from swath.georef.records import NamesEdge

QUEUE_BYTES = 64 * 1024 * 1024  # 2.6 s at 20 000 datagrams of 1206 bytes per second: longer than a consumer SSD stalls


@dataclass(slots=True)
class Assembly:
    """All parts of a running recorder."""

    config: Config
    clock: HostClock
    info: SessionInfo
    shared: Shared
    parts: Parts
    recorder: Recorder
    timekeeper: TimeKeeper
    clock_channel: JsonChannel
    receivers: list[Receiver] = field(default_factory=list)
    first_units: list[FirstUnits] = field(default_factory=list)
    sessions: dict[str, Session[UnitBlock]] = field(default_factory=dict)
    corrections: dict[str, CorrectionsWatch] = field(default_factory=dict)


def assemble(config: Config, queue_bytes: int = QUEUE_BYTES) -> Assembly:
    """Make all parts of a recorder without opening any device or file."""
    clock = HostClock()
    channels = ChannelTable()
    queue = BlockQueue(queue_bytes)
    events = Events(clock, queue, channels)
    info = make_session_info(config.session.name, clock)
    directory = Path(config.session.directory)
    attachments = [Attachment(*attachment) for attachment in config.attachments()]
    parts = Parts(directory, info, channels, attachments, config.session.compression)
    settings = RecorderSettings(
        split_bytes=int(config.session.split_size_mb * 1e6),
        split_s=config.session.split_minutes * 60,
        fsync_s=config.session.fsync_s,
        reserve_bytes=int(config.session.reserve_mb * 1e6),
    )
    timekeeper = make_timekeeper(config, events, clock.offset_ns)
    watches: dict[str, CorrectionsWatch] = {}
    devices = list(config.devices())
    # the time of a receiver inside an inertial unit shows in the unit's status, which is that of the wire
    receivers = {device.transport.carrier: device.source for device in devices if device.kind == "gnss"}

    def added_status(source: str) -> dict[str, object]:
        if source in watches:
            return watches[source].status()
        return timekeeper.status(receivers.get(source, source), clock.now_ns())

    recorder = Recorder(parts, settings, queue, channels, events, clock, added_status)
    assembly = Assembly(
        config,
        clock,
        info,
        Shared(clock, queue, channels, events),
        parts,
        recorder,
        timekeeper,
        JsonChannel(channels, "clock", "/clock", "swath.Clock"),
        corrections=watches,
    )
    _add_pps(assembly)
    for device in devices:
        inside = [other.source for other in devices if other.transport.carrier == device.source]
        _add_device(assembly, device, inside)
    for receiver in assembly.receivers:
        recorder.add_source(receiver.source)
    for source, (_, error) in config.not_loaded.items():
        events.post(Severity.ERROR, source, "driver_not_loaded", f"{error}; the device is recorded as it comes")
    return assembly


def make_timekeeper(config: Config, events: Events, host_minus_monotonic_ns: int) -> TimeKeeper:
    """Make a clock for each PPS of a configuration, and connect the receivers that name its seconds."""
    keeper = TimeKeeper(events, host_minus_monotonic_ns)
    leap_seconds = {gnss.pps: gnss.leap_seconds for gnss in config.gnss.values() if gnss.leap_seconds is not None}
    for name, pps in config.pps.items():
        keeper.add_pps(f"pps/{name}", leap_seconds.get(name), pps.delay_ns)
    for device in config.devices():
        if device.kind == "gnss" and device.protocol != RAW:
            _add_gnss_time(keeper, device, config.gnss[device.name])
    return keeper


def _add_gnss_time(keeper: TimeKeeper, device: DeviceEntry, gnss: GnssConfig) -> None:
    driver = find_driver("gnss", device.protocol)
    names = None if gnss.names_edge == "auto" else NamesEdge(gnss.names_edge)
    make_parser = driver.make_time_parser or driver.make_parser
    pps_source = f"pps/{gnss.pps}" if gnss.pps else None
    keeper.add_gnss(device.source, pps_source, make_parser(device.settings), names, gnss.leap_seconds)


def _add_pps(assembly: Assembly) -> None:
    for name, pps in assembly.config.pps.items():
        source = f"pps/{name}"
        session = Session(partial(open_pps, parse_pps(pps.source, pps.edge)))
        edge_seen = assembly.timekeeper.edge_seen(source)
        overwrites = not pps.source.startswith("fixed:")
        receiver = PpsReceiver(name, session, assembly.shared, edge_seen, overwrites=overwrites)
        assembly.receivers.append(receiver)


def _add_device(assembly: Assembly, device: DeviceEntry, inside: list[str]) -> None:
    """Add the receiver threads of a device's wires; ``inside`` are the sources whose bytes are in its stream."""
    if device.transport.carrier is not None:
        return  # part of another stream, which is logged
    first_units = FirstUnits(device)
    assembly.first_units.append(first_units)
    units_seen: list[UnitsSeen] = [first_units.add]
    for source in (device.source, *inside):
        if source in assembly.timekeeper.receivers:
            units_seen.append(assembly.timekeeper.units_seen(source))
    if device.kind == "corrections":
        units_seen.append(_watch_corrections(assembly, device).units_seen)
    main = make_wire(device, device.transport, "")
    stopped = assembly.shared.stop.is_set
    session = assembly.sessions[device.source] = Session(lambda: open_transport(device.transport, stopped))
    assembly.receivers.append(UnitReceiver(main, session, assembly.shared, units_seen))
    if device.auxiliary is not None:
        auxiliary = device.auxiliary
        aux_session = Session(lambda: open_transport(auxiliary))
        aux = make_wire(device, auxiliary, "/aux")
        assembly.receivers.append(UnitReceiver(aux, aux_session, assembly.shared))


def _watch_corrections(assembly: Assembly, device: DeviceEntry) -> CorrectionsWatch:
    """Watch a source of corrections and prepare forwarding; receivers come first, so the target's session exists
    already.
    """
    target = assembly.config.corrections[device.name].forward_to
    relay = None
    if target is not None:
        send = assembly.sessions[target.replace(".", "/", 1)].send
        relay = Relay(device.source, target, send, assembly.shared.events, assembly.shared.stop)
    parser = find_driver(device.kind, device.protocol).make_parser(device.settings)
    watch = assembly.corrections[device.source] = CorrectionsWatch(device.source, parser, relay)
    return watch
