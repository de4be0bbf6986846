"""Start-up messages: requests to a device before a survey, and how its answers are separated from its data.

A protocol file builds the messages and knows the answers; the owner of the transport sends them. No I/O here.
"""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

from swath.drivers.parser import DeviceSettings

DEFAULT_RATE_HZ = 5
MAX_REPLY_BYTES = 4096  # longest reply of a command line; Septentrio's longest command has 2000


class Answer(NamedTuple):
    """A device's answer to a message; ``text`` is its reason, where it gives one."""

    accepted: bool
    text: str = ""


class AnswerListener(ABC):
    """Finds the answer to one message in the data that a device sends after it."""

    @abstractmethod
    def hear(self, data: bytes) -> Answer | None:
        """Take one read; return the answer once it is complete."""

    def close(self) -> Answer | None:
        """Return the answer in the data held back, at the end of the data."""
        return None


class PhraseListener(AnswerListener):
    """Finds the answer of a command line: a phrase that binary data does not contain.

    Args:
        accepted: the device's reply to a command that it executes.
        refused: its reply to any other command; the first group is its reason.
    """

    def __init__(self, accepted: re.Pattern[bytes], refused: re.Pattern[bytes]) -> None:
        self._accepted = accepted
        self._refused = refused
        self._heard = b""

    def hear(self, data: bytes) -> Answer | None:
        """Take one read; return the answer of the first complete phrase."""
        heard = self._heard + data
        self._heard = heard[-MAX_REPLY_BYTES:]
        accepted, refused = self._accepted.search(heard), self._refused.search(heard)
        if refused is not None and (accepted is None or refused.start() < accepted.start()):
            return Answer(False, refused[1].decode("ascii", "replace").strip())
        return Answer(True) if accepted is not None else None


@dataclass(frozen=True, slots=True)
class StartupMessage:
    """One message and the means to recognise its answer.

    Attributes:
        lines: description for the user; the first line names the message, the others list its content.
        data: the bytes on the wire.
        listen: makes a listener for the answer to this sending.
        baud: line rate of the device once it has accepted; None: unchanged.
        last: True for the message that saves the settings; it is sent after all others, only if each was accepted.
    """

    lines: tuple[str, ...]
    data: bytes
    listen: Callable[[], AnswerListener]
    baud: int | None = None
    last: bool = False


@dataclass(frozen=True, slots=True)
class StartupOptions:
    """Options of a set-up that the caller gives, not the configuration.

    Attributes:
        save: make the device keep its settings without power.
        baud: change the line to this rate; None: keep the present rate.
    """

    save: bool = False
    baud: int | None = None


@dataclass(frozen=True, slots=True)
class SetupKeys:
    """Holds the table ``setup`` of a receiver's configuration.

    Attributes:
        port: the receiver's own name for the port wired to this computer; None: the protocol's default.
        rate_hz: rate of positions and velocities.
        raw: whether to send raw measurements and ephemerides too.
    """

    port: str | None
    rate_hz: int
    raw: bool


def read_setup(settings: DeviceSettings) -> SetupKeys:
    """Read the table ``setup`` and fill in its defaults."""
    table: Mapping[str, Any] = settings.config.get("setup") or {}
    return SetupKeys(table.get("port"), int(table.get("rate_hz", DEFAULT_RATE_HZ)), bool(table.get("raw", True)))
