"""Reads the events in the service's journal, for tests without a process."""

from __future__ import annotations

from typing import NamedTuple

import pytest

from swath.daemon.log.events import Severity


class Said(NamedTuple):
    """An event as one line of the journal."""

    severity: Severity
    source: str
    code: str
    text: str


def journal_of(caplog: pytest.LogCaptureFixture) -> list[Said]:
    """Return the events since the test began, in order; those of severity info only if the test set that level."""
    found = []
    for record in caplog.records:
        if (record.name, record.msg) == ("swath", "%s %s: %s") and isinstance(record.args, tuple):
            source, code, text = map(str, record.args)
            found.append(Said(Severity(record.levelname.lower()), source, code, text))
    return found
