"""Runs ``swath run`` with a small queue or a built-in defect: python -m tests.daemon.special_recorder KIND CONFIG."""

from __future__ import annotations

import logging
import sys
import time
from pathlib import Path
from typing import NoReturn
from unittest.mock import patch

from swath.daemon.config import load_config
from swath.daemon.log.account import Account
from swath.daemon.log.host_clock import StampConverter
from swath.daemon.recorder.assembly import QUEUE_BYTES
from swath.daemon.recorder.run import record

SMALL_QUEUE_BYTES = 300_000
_started_s = time.monotonic()


def _defect(*unused: object) -> NoReturn:
    raise RuntimeError("a defect")


def main(kind: str, config: Path) -> int:
    """Record with the defect, which shows once the recorder has been READY for a while."""
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    if kind == "broken-writer":
        whole = Account.statuses

        def statuses(self: Account, common: dict[str, object]) -> dict[str, dict[str, object]]:
            return whole(self, common) if time.monotonic() < _started_s + 3.0 else _defect()

        patch.object(Account, "statuses", statuses).start()
    elif kind == "broken-receiver":
        patch.object(StampConverter, "stamp", _defect).start()
    return int(record(load_config(config), queue_bytes=SMALL_QUEUE_BYTES if kind == "small-queue" else QUEUE_BYTES))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], Path(sys.argv[2])))
