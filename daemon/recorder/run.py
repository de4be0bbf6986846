"""Runs the recorder's process: signals, clocks, watchdog, repair, and an end that loses no data.

The watchdog is fed while the recorder progresses, and a sentence for people summarises the state. A silent or absent
sensor is an event and part of that sentence, never a reason to restart: a restart would only lose data of the others.
"""

from __future__ import annotations

import asyncio
import contextlib
import gc
import logging
import os
import signal
import time
from collections.abc import Collection, Coroutine, Iterable
from pathlib import Path

from swath.daemon.config import Config
from swath.daemon.errors import ExitCode, UserError
from swath.daemon.log.block_queue import QueueItem
from swath.daemon.log.directory import take_directory
from swath.daemon.log.events import Severity
from swath.daemon.log.host_clock import read_clock_discipline, read_clock_sample
from swath.daemon.log.words import duration_text, source_trouble
from swath.daemon.recorder.assembly import QUEUE_BYTES, Assembly, assemble
from swath.daemon.recorder.control import Control
from swath.daemon.recorder.first_units import judge
from swath.daemon.recorder.journal import threads_text
from swath.daemon.recorder.receivers import Receiver
from swath.daemon.recorder.repair import repair_left_open
from swath.daemon.recorder.service_manager import ServiceManager
from swath.daemon.recorder.writer import WriterHealth, Writing
from swath.daemon.system import lock_memory

PROGRESS_S = 2.0
OPENING_S = 20.0  # a driver may be slow to open: python-can sleeps 2 s for a serial CAN adapter

log = logging.getLogger("swath")

CLOCK_PERIOD_S = 0.1
JUDGE_PERIOD_S = 1.0
STEP_TOLD_NS = 1_000_000
COLLECT_ALL_S = 60.0  # between two full garbage collections; young objects are collected each second
RECEIVERS_END_S = 3.0
WRITER_ENDS_S = 50.0  # the unit allows 70 s for both


class RecorderProcess:
    """Runs an `Assembly` until a signal, for a number of seconds, or until a thread of it has failed."""

    def __init__(self, assembly: Assembly, service: ServiceManager) -> None:
        self._assembly = assembly
        self._service = service
        self._stop = asyncio.Event()
        self._control = Control(assembly, assembly.shared.events)
        self._stuck: list[str] = []
        self._failed = False

    async def run(self, seconds: float | None) -> bool:
        """Start recording, report READY, keep watch, end cleanly.

        Returns:
            Whether all was well at the end: every thread ended as requested, and data was being written.

        Raises:
            UserError: no log can be made in the directory.
        """
        loop = asyncio.get_running_loop()
        for signum in (signal.SIGTERM, signal.SIGINT):
            loop.add_signal_handler(signum, self._stop.set)
        loop.add_signal_handler(signal.SIGHUP, self._assembly.recorder.new_part.set)
        self._start()
        self._service.notify(READY="1", STATUS=self._sentence())
        jobs = {"clock": self._clock(), "watch": self._watch(), "repair": self._repair(), "judge": self._judge()}
        tasks = [asyncio.create_task(self._job(name, job)) for name, job in jobs.items()]
        try:
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(self._stop.wait(), seconds)
        finally:
            self._service.notify(STOPPING="1")
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
            await asyncio.to_thread(self._end)
        return not self._failed and self._assembly.recorder.health.state is Writing.RECORDING

    async def _job(self, name: str, job: Coroutine[object, object, None]) -> None:
        """Run one job beside the recording; a defect in it is posted as an event and does not end the others."""
        try:
            await job
        except Exception as error:
            self._failed = True
            text = f"{name} failed: {type(error).__name__}: {error}"
            self._assembly.shared.events.post(Severity.CRITICAL, "recorder", "job_failed", text)

    def _start(self) -> None:
        assembly = self._assembly
        try:
            assembly.recorder.open_first()
        except OSError as error:
            text = f"session.directory {assembly.parts.directory}: {error.strerror}; a log cannot be created there"
            raise UserError(text, exit_code=ExitCode.IO) from error
        self._sample_clock()
        text = f"session {assembly.info.session_id}, {len(assembly.receivers)} sources, {assembly.info.software}"
        assembly.shared.events.post(Severity.INFO, "recorder", "session_started", text)
        assembly.recorder.start()
        for receiver in assembly.receivers:
            receiver.start()
        self._control.open()
        gc.collect()
        gc.freeze()
        gc.disable()  # a collection stops every thread, so `_watch` runs it each second

    def _end(self) -> None:
        """Stop the receivers first, then the writer with all their data; a thread that does not end is abandoned."""
        assembly = self._assembly
        self._control.close()
        assembly.shared.stop.set()
        deadline_s = time.monotonic() + RECEIVERS_END_S
        for receiver in assembly.receivers:
            receiver.join(max(0.0, deadline_s - time.monotonic()))
        # a receiver whose device is still opening has no data that could be lost
        left = [receiver.source for receiver in assembly.receivers if receiver.is_alive() and not receiver.opening]
        if left:
            text = f"{', '.join(left)} did not end in time; the last units may be missing"
            assembly.shared.events.post(Severity.CRITICAL, "recorder", "stuck", text)
        text = f"session {assembly.info.session_id} ended"
        assembly.shared.events.post(Severity.INFO, "recorder", "session_ended", text)
        assembly.recorder.stop.set()
        assembly.recorder.join(WRITER_ENDS_S)
        if assembly.recorder.is_alive():
            log.critical("recorder stuck: the end of the log cannot be written; run swath recover to complete it")
        failed = any(receiver.failed for receiver in assembly.receivers)
        self._failed |= bool(left) or failed or assembly.recorder.is_alive()

    def _sample_clock(self) -> float:
        """Log the clocks side by side; return the wall clock's offset from host time in nanoseconds."""
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
        """Feed the watchdog while there is progress, and report the state in a sentence."""
        period_s = min(1.0, (self._service.watchdog_s or 4.0) / 4)
        collected_s = time.monotonic()
        while not self._must_end():
            await asyncio.sleep(period_s)
            stuck = stuck_threads(self._assembly.receivers, self._assembly.recorder.health)
            stuck_text = f"STUCK: {', '.join(stuck)}" if stuck else ""
            if a_restart_helps_nobody(stuck, self._assembly.receivers):
                self._service.notify(WATCHDOG="1", STATUS="; ".join(filter(None, [self._sentence(), stuck_text])))
            elif stuck != self._stuck:
                self._service.notify(STATUS=stuck_text)
            if stuck and stuck != self._stuck:
                text = f"no progress in {', '.join(stuck)}"
                self._assembly.shared.events.post(Severity.CRITICAL, "recorder", "stuck", text)
                log.critical("%s", threads_text())  # a restart would destroy this information
            self._stuck = stuck
            if time.monotonic() - collected_s > COLLECT_ALL_S:
                collected_s = time.monotonic()
                gc.collect()
            else:
                gc.collect(1)
        self._failed = True
        self._stop.set()

    def _must_end(self) -> bool:
        """Return whether a thread has died that only a new process can replace.

        Without its writer the process is useless. Without a receiver it continues for the other sources, unless a
        service manager will restart it at once.
        """
        assembly = self._assembly
        dead = any(receiver.failed for receiver in assembly.receivers)
        return not assembly.recorder.is_alive() or (dead and self._service.watchdog_s is not None)

    async def _repair(self) -> None:
        assembly = self._assembly
        parts = assembly.parts

        def is_current(path: Path) -> bool:
            return path.name.startswith(assembly.info.session_id)

        reserve_bytes = int(assembly.config.session.reserve_mb * 1e6)
        await repair_left_open(parts.directory, reserve_bytes, is_current, assembly.shared.events)

    async def _judge(self) -> None:
        """Post an event, once for each device, if the device uses another protocol than the configured one."""
        waiting = self._assembly.first_units
        while waiting:
            await asyncio.sleep(JUDGE_PERIOD_S)
            judged = [(first, kept) for first in waiting if (kept := first.take()) is not None]
            waiting = [first for first in waiting if first not in dict(judged)]
            for first, kept in judged:
                text = await asyncio.to_thread(judge, first.entry, kept)
                if text is not None:
                    events = self._assembly.shared.events
                    events.post(Severity.ERROR, first.entry.source, "wrong_protocol", f"{text}; recording continues")

    def _sentence(self) -> str:
        assembly = self._assembly
        return sentence(assembly.info.session_id, assembly.parts.part, assembly.recorder.health)


def stuck_threads(receivers: Iterable[Receiver], writer: WriterHealth, now_ns: int | None = None) -> list[str]:
    """Return the names of the threads that have not made progress within `PROGRESS_S`; an empty list means healthy."""
    now = time.monotonic_ns() if now_ns is None else now_ns
    limit = now - int(PROGRESS_S * 1e9)
    opening_limit = now - int(OPENING_S * 1e9)
    stuck = [
        receiver.source
        for receiver in receivers
        if receiver.came_back_ns < (opening_limit if receiver.opening else limit)
    ]
    # Statuses are a second apart: the last one may be a second old, and the next one has two more to reach the disk.
    if writer.status_ns < limit - int(1e9):
        stuck.append("writer")
    return stuck


def a_restart_helps_nobody(stuck: Collection[str], receivers: Iterable[Receiver]) -> bool:
    """Return True if every stuck source is still opening: it has no data to lose, and a restart would not open it
    sooner.
    """
    return {receiver.source for receiver in receivers if receiver.opening}.issuperset(stuck)


def sentence(session_id: str, part: int, writer: WriterHealth) -> str:
    """Return the sentence that the operator reads in ``systemctl status``."""
    if writer.state is not Writing.RECORDING:
        return f"NOT RECORDING: {writer.reason}"
    troubles = [text for source, status in writer.statuses.items() if (text := source_trouble(source, status))]
    sources = len(writer.statuses)
    state = "; ".join(troubles) if troubles else f"all {sources} sources deliver data" if sources else "starting"
    room = f"{writer.free_bytes / 1e9:.1f} GB free"
    if writer.bytes_per_s > 0:
        left_s = max(0, writer.free_bytes - writer.reserve_bytes) / writer.bytes_per_s
        room += f" ({duration_text(left_s)})"
    return f"recording {session_id} part {part}: {state}; {room}"


def record(config: Config, seconds: float | None = None, queue_bytes: int = QUEUE_BYTES) -> ExitCode:
    """Record until SIGTERM, SIGINT or for ``seconds``.

    Raises:
        UserError: the log directory cannot be used.
    """
    directory = Path(config.session.directory)
    lock = take_directory(directory)
    try:
        assembly = assemble(config, queue_bytes)
        while (directory / f"{assembly.info.session_id}_0.mcap").exists():  # restarted within the second
            time.sleep(0.05)
            assembly = assemble(config, queue_bytes)
        assembly.parts.lock = lock
        lock_memory()
        whole = asyncio.run(RecorderProcess(assembly, ServiceManager()).run(seconds))
        return ExitCode.OK if whole else ExitCode.PROBLEM
    finally:
        os.close(lock)
