"""Runs a recorder: takes the log directory, assembles, records, and hands the directory back."""

from __future__ import annotations

import asyncio
import os
import time
from pathlib import Path

from swath.daemon.config import Config
from swath.daemon.errors import ExitCode
from swath.daemon.log.directory import take_directory
from swath.daemon.recorder.assembly import QUEUE_BYTES, assemble
from swath.daemon.recorder.process import RecorderProcess
from swath.daemon.recorder.service_manager import ServiceManager
from swath.daemon.system import lock_memory


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
