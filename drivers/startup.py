"""Start-up messages: what a device is asked for before a survey, and how its answers are told from its data.

A protocol file builds the messages and knows the answers; whoever holds the wire sends them. No I/O here.
"""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

from swath.drivers.parser import DeviceSettings

DEFAULT_RATE_HZ = 5
MAX_REPLY_BYTES = 4096  # of a command line's reply; Septentrio's longest command has 2000


class Answer(NamedTuple):
    """What a device said to a message; ``text`` is its reason, where it gives one."""

    accepted: bool
    text: str = ""


class AnswerListener(ABC):
    """Finds the answer to one message among everything a device sends after it."""

    @abstractmethod
    def hear(self, data: bytes) -> Answer | None:
        """Take one read; the answer once it is complete."""

    def close(self) -> Answer | None:
        """Nothing more will come: the answer in what was held back."""
        return None


class PhraseListener(AnswerListener):
    """For command lines: the answer is a phrase that binary data does not hold.

    Args:
        accepted: what the device says when it does as asked.
        refused: what it says else; the first group is its reason.
    """

    def __init__(self, accepted: re.Pattern[bytes], refused: re.Pattern[bytes]) -> None:
        self._accepted = accepted
        self._refused = refused
        self._heard = b""

    def hear(self, data: bytes) -> Answer | None:
        """Take one read; the first phrase that is complete."""
        heard = self._heard + data
        self._heard = heard[-MAX_REPLY_BYTES:]
        accepted, refused = self._accepted.search(heard), self._refused.search(heard)
        if refused is not None and (accepted is None or refused.start() < accepted.start()):
            return Answer(False, refused[1].decode("ascii", "replace").strip())
        return Answer(True) if accepted is not None else None


@dataclass(frozen=True, slots=True)
class StartupMessage:
    """One message and how to know its answer.

    Attributes:
        lines: for the eye; the first says what it is, the others what is in it.
        data: the bytes on the wire.
        listen: makes a listener for the answer to this sending.
        baud: the device speaks at this rate once it has accepted; None: as before.
        last: keeps what the others set; sent behind them all, and only when each was accepted.
    """

    lines: tuple[str, ...]
    data: bytes
    listen: Callable[[], AnswerListener]
    baud: int | None = None
    last: bool = False


@dataclass(frozen=True, slots=True)
class StartupOptions:
    """What of a set-up is said when it is asked for, not in the configuration.

    Attributes:
        save: let the device keep its settings without power.
        baud: change the line to this rate; None: it runs at the right one.
    """

    save: bool = False
    baud: int | None = None


@dataclass(frozen=True, slots=True)
class SetupKeys:
    """The table ``setup`` of a receiver's configuration.

    Attributes:
        port: the receiver's own name of the port that is wired to this computer; None: the protocol's default.
        rate_hz: of positions and velocities.
        raw: raw measurements and ephemerides too.
    """

    port: str | None
    rate_hz: int
    raw: bool


def read_setup(settings: DeviceSettings) -> SetupKeys:
    """Return the table, its defaults filled in."""
    table: Mapping[str, Any] = settings.config.get("setup") or {}
    return SetupKeys(table.get("port"), int(table.get("rate_hz", DEFAULT_RATE_HZ)), bool(table.get("raw", True)))
