"""The recorder's process: one thread a wire, one writer, and this loop for signals, clocks, health and repair."""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
import fcntl
import gc
import importlib.metadata
import os
import platform
import resource
import signal
import time
import uuid
from dataclasses import dataclass, field
from pathlib import Path

from daemon.acquire import PpsReceiver, Receiver, Shared, UnitReceiver, Wire
from daemon.block_queue import BlockQueue, QueueItem
from daemon.channels import ChannelTable, JsonChannel
from daemon.config import Config, DeviceEntry
from daemon.errors import ExitCode, UserError
from daemon.events import Events, Severity
from daemon.health import sentence, stuck_threads
from daemon.host_clock import HostClock, read_clock_discipline, read_clock_sample
from daemon.log.format import SessionInfo
from daemon.parts import Attachment, Parts
from daemon.recorder import Recorder, RecorderSettings, Writing
from daemon.repair import repair_left_open
from daemon.sd_notify import ServiceManager
from daemon.timekeeper import TimeKeeper
from drivers.core.registry import find_driver
from drivers.session import Session
from drivers.transports.uri import TransportSpec, open_transport, parse_pps
from georef.records import NamesEdge

QUEUE_BYTES = 64 * 1024 * 1024  # 2.6 s of 20 000 datagrams of 1206 bytes: longer than a consumer SSD stalls
CLOCK_PERIOD_S = 0.1
STEP_TOLD_NS = 1_000_000

_ENCODINGS = {"serial": "x-swath-serial", "can": "x-swath-can", "udp": "x-swath-udp"}


def read_boot_id() -> str:
    """This boot of the computer; the unit says it in ``SWATH_BOOT_ID``, because its /proc holds processes only."""
    said = os.environ.get("SWATH_BOOT_ID", "")
    return str(uuid.UUID(said)) if said else Path("/proc/sys/kernel/random/boot_id").read_text().strip()


def make_session_info(name: str, clock: HostClock) -> SessionInfo:
    """Name a session by its start and this boot of the computer."""
    boot_id = read_boot_id()
    start = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime(clock.realtime_ns // 1_000_000_000))
    return SessionInfo(
        session_id=f"{name}-{start}-{boot_id[:4]}",
        software=f"swath {importlib.metadata.version('swath')}",
        host=platform.node(),
        boot_id=boot_id,
        realtime_ns=clock.realtime_ns,
        monotonic_ns=clock.monotonic_ns,
    )


def take_directory(directory: Path) -> int:
    """Create the log directory if need be and lock it; returns the lock's descriptor, which must stay open.

    Raises:
        UserError: it cannot be written, or another recorder is at work in it.
    """
    try:
        directory.mkdir(parents=True, exist_ok=True)
        lock = os.open(directory / ".swath.lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o640)
    except OSError as error:
        text = f"session.directory {directory}: {error.strerror}; give a directory that user {os.getuid()} may write"
        raise UserError(text, exit_code=ExitCode.IO) from error
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        os.close(lock)
        text = f"session.directory {directory}: another recorder is at work there; stop it or give another directory"
        raise UserError(text, exit_code=ExitCode.IO) from error
    return lock


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


def assemble(config: Config) -> Assembly:
    """Make everything, open nothing."""
    clock = HostClock()
    channels = ChannelTable()
    queue = BlockQueue(QUEUE_BYTES)
    events = Events(clock, queue, channels)
    info = make_session_info(config.session.name, clock)
    attachments = [Attachment(*attachment) for attachment in config.attachments()]
    parts = Parts(Path(config.session.directory), info, channels, attachments, config.session.compression)
    settings = RecorderSettings(
        split_bytes=int(config.session.split_size_mb * 1e6),
        split_s=config.session.split_minutes * 60,
        fsync_s=config.session.fsync_s,
        reserve_bytes=int(config.session.reserve_mb * 1e6),
    )
    timekeeper = TimeKeeper(events, clock.offset_ns)
    recorder = Recorder(
        parts, settings, queue, channels, events, clock, lambda source: timekeeper.status(source, clock.now_ns())
    )
    assembly = Assembly(
        config,
        clock,
        info,
        Shared(clock, queue, channels, events),
        parts,
        recorder,
        timekeeper,
        JsonChannel(channels, "clock", "/clock", "swath.Clock"),
    )
    _add_pps(assembly)
    for device in config.devices():
        _add_device(assembly, device)
    for receiver in assembly.receivers:
        recorder.add_source(receiver.source)
    return assembly


def _add_pps(assembly: Assembly) -> None:
    leap_of = {gnss.pps: gnss.leap_seconds for gnss in assembly.config.gnss.values() if gnss.pps}
    for name, pps in assembly.config.pps.items():
        source = f"pps/{name}"
        assembly.timekeeper.add_pps(source, leap_of.get(name), pps.delay_ns)
        session = Session(lambda pps=pps: parse_pps(pps.source, edge=pps.edge))  # type: ignore[misc]
        receiver = PpsReceiver(name, session, assembly.shared, assembly.timekeeper.edge_seen(source))
        assembly.receivers.append(receiver)


def _add_device(assembly: Assembly, device: DeviceEntry) -> None:
    if device.transport is None or device.transport.kind == "gnss":
        return  # inside another stream: logged there
    units_seen = None
    if device.kind == "gnss":
        _add_gnss_time(assembly, device)
        units_seen = assembly.timekeeper.units_seen(device.source)
    main = _wire(device, device.transport, "")
    session = Session(lambda: open_transport(device.transport))
    assembly.receivers.append(UnitReceiver(main, session, assembly.shared, units_seen))
    if device.auxiliary is not None:
        auxiliary = device.auxiliary
        aux_session = Session(lambda: open_transport(auxiliary))
        aux = _wire(device, auxiliary, "/aux")
        assembly.receivers.append(UnitReceiver(aux, aux_session, assembly.shared))


def _add_gnss_time(assembly: Assembly, device: DeviceEntry) -> None:
    driver = find_driver("gnss", device.protocol)
    gnss = assembly.config.gnss[device.name]
    names = None if gnss.names_edge == "auto" else NamesEdge(gnss.names_edge)
    make_parser = driver.make_time_parser or driver.make_parser
    pps_source = f"pps/{gnss.pps}" if gnss.pps else None
    parser = make_parser(device.settings)
    assembly.timekeeper.add_gnss(device.source, pps_source, parser, names, gnss.leap_seconds)


def _wire(device: DeviceEntry, transport: TransportSpec, suffix: str) -> Wire:
    metadata = {"protocol": device.protocol, "transport": transport.text}
    if transport.kind == "udp":
        metadata["port"] = str(transport.port)
    if "dbc" in device.files:
        metadata["dbc"] = f"dbc/{device.files['dbc'].name}"
    return Wire(
        source=f"{device.source}{suffix}",
        topic=f"/{device.source}{suffix}/raw",
        encoding=_ENCODINGS[transport.kind],
        chunk_class="scanner" if device.kind == "scanner" else "other",
        metadata=metadata,
    )


def lock_memory() -> None:
    """Keep pages that are in use in memory, where the unit grants it without limit (mlockall(2), on fault)."""
    if resource.getrlimit(resource.RLIMIT_MEMLOCK)[0] != resource.RLIM_INFINITY:
        return
    current, future, on_fault = 1, 2, 4
    ctypes.CDLL(None, use_errno=True).mlockall(current | future | on_fault)


class RecorderProcess:
    """Runs an `Assembly` until a signal, or for a number of seconds."""

    def __init__(self, assembly: Assembly, service: ServiceManager) -> None:
        self._assembly = assembly
        self._service = service
        self._stop = asyncio.Event()
        self._stuck: list[str] = []

    async def run(self, seconds: float | None) -> None:
        """Start recording, say READY, keep watch, end cleanly."""
        loop = asyncio.get_running_loop()
        for signum in (signal.SIGTERM, signal.SIGINT):
            loop.add_signal_handler(signum, self._stop.set)
        loop.add_signal_handler(signal.SIGHUP, self._assembly.recorder.new_part.set)
        self._start()
        self._service.notify(READY="1", STATUS=self._sentence())
        tasks = [asyncio.create_task(job) for job in (self._clock(), self._watch(), self._repair())]
        try:
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(self._stop.wait(), seconds)
        finally:
            self._service.notify(STOPPING="1")
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
            await asyncio.to_thread(self._end)

    def _start(self) -> None:
        assembly = self._assembly
        self._sample_clock()
        assembly.recorder.start()
        for receiver in assembly.receivers:
            receiver.start()
        text = f"session {assembly.info.session_id}, {len(assembly.receivers)} sources, {assembly.info.software}"
        assembly.shared.events.post(Severity.INFO, "recorder", "session_started", text)
        gc.collect()
        gc.freeze()

    def _end(self) -> None:
        assembly = self._assembly
        assembly.shared.stop.set()
        for receiver in assembly.receivers:
            receiver.join(timeout=3.0)
        text = f"session {assembly.info.session_id} ended"
        assembly.shared.events.post(Severity.INFO, "recorder", "session_ended", text)
        assembly.recorder.stop.set()
        assembly.recorder.join(timeout=60.0)

    def _sample_clock(self) -> float:
        """Log the clocks side by side; returns the wall clock's offset from host time in nanoseconds."""
        assembly = self._assembly
        discipline = read_clock_discipline()
        sample = read_clock_sample(discipline)
        host_ns = int(sample["monotonic_ns"]) + assembly.clock.offset_ns
        realtime_ns = int(sample["realtime_ns"])
        assembly.timekeeper.clock_sample(sample, discipline)
        block = assembly.clock_channel.encode(host_ns, dict(sample))
        assembly.shared.queue.put(QueueItem("clock", block), always=True)
        return realtime_ns - host_ns

    async def _clock(self) -> None:
        offset_ns = self._sample_clock()
        while True:
            await asyncio.sleep(CLOCK_PERIOD_S)
            now_ns = self._sample_clock()
            if abs(now_ns - offset_ns) > STEP_TOLD_NS:
                text = f"the wall clock was stepped by {(now_ns - offset_ns) * 1e-9:+.6f} s; log times are not affected"
                self._assembly.shared.events.post(Severity.WARNING, "clock", "wall_clock_stepped", text)
            offset_ns = now_ns

    async def _watch(self) -> None:
        """Feed the watchdog while there is progress; say in a sentence what is going on."""
        period_s = min(1.0, (self._service.watchdog_s or 4.0) / 4)
        while True:
            await asyncio.sleep(period_s)
            stuck = stuck_threads(self._assembly.receivers, self._assembly.recorder.health)
            if not stuck:
                self._service.notify(WATCHDOG="1", STATUS=self._sentence())
            elif stuck != self._stuck:
                self._service.notify(STATUS=f"STUCK: {', '.join(stuck)}")
                text = f"no progress in {', '.join(stuck)}"
                self._assembly.shared.events.post(Severity.CRITICAL, "recorder", "stuck", text)
            self._stuck = stuck
            gc.collect(1)

    async def _repair(self) -> None:
        assembly = self._assembly
        parts = assembly.parts

        def is_current(path: Path) -> bool:
            return path.name.startswith(assembly.info.session_id)

        reserve_bytes = int(assembly.config.session.reserve_mb * 1e6)
        await repair_left_open(parts.directory, reserve_bytes, is_current, assembly.shared.events)

    def _sentence(self) -> str:
        assembly = self._assembly
        return sentence(assembly.info.session_id, assembly.parts.part, assembly.recorder.health)


def record(config: Config, seconds: float | None = None) -> ExitCode:
    """Record until SIGTERM, SIGINT or for ``seconds``.

    Raises:
        UserError: the log directory cannot be used.
    """
    lock = take_directory(Path(config.session.directory))
    try:
        assembly = assemble(config)
        try:
            assembly.recorder.open_first()
        except OSError as error:
            text = f"session.directory {config.session.directory}: {error.strerror}; cannot create a log there"
            raise UserError(text, exit_code=ExitCode.IO) from error
        lock_memory()
        asyncio.run(_run(assembly, seconds))
        recording = assembly.recorder.health.state is Writing.RECORDING
        return ExitCode.OK if recording else ExitCode.PROBLEM
    finally:
        os.close(lock)


async def _run(assembly: Assembly, seconds: float | None) -> None:
    await RecorderProcess(assembly, ServiceManager()).run(seconds)
