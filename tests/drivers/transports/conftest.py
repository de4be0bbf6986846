"""Fixtures that tests of several transports use."""

from __future__ import annotations

import os
from collections.abc import Iterator

import pytest


@pytest.fixture
def one_processor() -> Iterator[None]:
    """Keep a test on one processor: loopback keeps the order of datagrams only if their sender stays on one."""
    allowed = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {max(allowed)})
    yield
    os.sched_setaffinity(0, allowed)
