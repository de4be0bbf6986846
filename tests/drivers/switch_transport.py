"""Provides a transport with switches that make it fail, for tests of what is built on transports."""

from __future__ import annotations

import time

import numpy as np

from swath.drivers.transports.base import Transport, TransportError, UnitBlock


class SwitchTransport(Transport):
    """A transport that gives one unit per call: its number in four bytes.

    Attributes:
        refuse_open: True if opening fails.
        drop_every: each n-th unit is dropped by the kernel, and counted; 0: none.
        raise_after: the device disappears after so many units; None: never.
        stall_s: seconds that every receive takes, whatever was asked.
        silent: True if nothing comes.
    """

    def __init__(self) -> None:
        super().__init__()
        self.refuse_open = False
        self.drop_every = 0
        self.raise_after: int | None = None
        self.stall_s = 0.0
        self.silent = False
        self.is_open = False
        self.closings = 0
        self.sent: list[bytes] = []
        self._number = 0

    def open(self) -> None:
        if self.refuse_open:
            raise TransportError("switch: there is no device")
        self.is_open = True

    def receive(self, timeout_s: float) -> list[UnitBlock]:
        if not self.is_open:
            raise TransportError("switch: is closed")
        time.sleep(self.stall_s)
        if self.raise_after is not None and self._number >= self.raise_after:
            raise TransportError("switch: has gone")
        if self.silent:
            return []
        self._number += 1
        if self.drop_every and self._number % self.drop_every == 0:
            self.counters.lost_kernel += 1
            return []
        unit = np.frombuffer(self._number.to_bytes(4, "big"), np.uint8)
        return [UnitBlock(unit[np.newaxis, :])]

    def send(self, data: bytes) -> None:
        if not self.is_open:
            raise TransportError("switch: is closed")
        self.sent.append(data)

    def close(self) -> None:
        self.closings += self.is_open
        self.is_open = False
