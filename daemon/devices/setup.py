"""Sends the devices the messages they need before a survey, and reads their answer to each.

It listens as `swath.aio` does, and sends one message at a time, the next only after the answer to the one before. After
a missing answer nothing more is sent over that wire, since a late answer would be taken as that to another message.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Collection, Iterable
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Any, Self

from swath.daemon.config import Config, DeviceEntry
from swath.daemon.devices.listening import Listening
from swath.daemon.errors import ExitCode, UserError, one_line
from swath.drivers.driver import RAW, find_driver
from swath.drivers.startup import Answer, StartupMessage, StartupOptions
from swath.drivers.transports.base import TransportError
from swath.drivers.transports.spec import TransportSpec
from swath.georef.records import ChunkBatch

SLICE_S = 0.1
SETTLE_S = 0.3  # time for a device to change its baud rate


class Outcome(StrEnum):
    """The outcome of a message to a device."""

    PLANNED = "planned"
    ACCEPTED = "accepted"
    REFUSED = "refused"
    NO_ANSWER = "no answer"
    NOT_SENT = "not sent"


@dataclass(slots=True)
class Step:
    """One message, its outcome, and the device's answer."""

    message: StartupMessage
    outcome: Outcome = Outcome.PLANNED
    answer: str = ""

    def plain(self) -> dict[str, Any]:
        """Return the step as plain values, the form of ``--json``."""
        return {
            "lines": list(self.message.lines),
            "hex": self.message.data.hex(),
            "outcome": str(self.outcome),
            "answer": self.answer,
        }


@dataclass(slots=True)
class DeviceSetup:
    """One device and its messages.

    Attributes:
        source: ``kind/name``.
        transport: as configured; ``gnss:<name>`` or ``imu:<name>`` if its bytes are part of that device's stream.
        steps: its messages; empty if it needs none.
        problem: why nothing can be sent to it, or what went wrong; one line.
    """

    source: str
    protocol: str
    transport: str
    steps: list[Step] = field(default_factory=list)
    problem: str = ""

    @property
    def ok(self) -> bool:
        """True if nothing has gone wrong so far."""
        return not self.problem and all(step.outcome in (Outcome.PLANNED, Outcome.ACCEPTED) for step in self.steps)

    def plain(self) -> dict[str, Any]:
        """Return the device's setup as plain values, the form of ``--json``."""
        return {
            "source": self.source,
            "protocol": self.protocol,
            "transport": self.transport,
            "messages": [step.plain() for step in self.steps],
            "problem": self.problem,
            "ok": self.ok,
        }


@dataclass(slots=True)
class WireSetup:
    """One wire and the devices that are set up over it: a receiver and the IMUs inside its stream.

    Attributes:
        device: whose wire it is.
        present_baud: the device's baud rate before it is set to the configured one; None if it is that one already.
    """

    device: DeviceEntry
    devices: list[DeviceSetup] = field(default_factory=list)
    present_baud: int | None = None

    def steps(self) -> list[Step]:
        """Return all messages in the order in which they are sent."""
        steps = [step for device in self.devices for step in device.steps]
        return sorted(steps, key=lambda step: step.message.last)


class Line:
    """A wire that `Listening` keeps open, for one message at a time and its answer; an asynchronous context manager.

    Args:
        device: whose wire it is; its bytes are not decoded.
        baud: its baud rate at first; None uses the configured one.
    """

    def __init__(self, device: DeviceEntry, baud: int | None) -> None:
        self._device = replace(device, protocol=RAW, auxiliary=None)
        self._listening = self._at(baud)

    def _at(self, baud: int | None) -> Listening:
        spec = self._device.transport
        if baud is not None:
            spec = replace(spec, options={**spec.options, "baud": str(baud)})
        return Listening([replace(self._device, transport=spec)], {})

    async def __aenter__(self) -> Self:
        """Open the wire.

        Raises:
            TransportError: it cannot be opened.
        """
        await self._open()
        return self

    async def __aexit__(self, *_: object) -> None:
        """Release the wire."""
        await self._listening.__aexit__()

    async def _open(self) -> None:
        await self._listening.__aenter__()
        try:
            await self._listening.tried()
            self._check()
        except BaseException:
            await self._listening.__aexit__()
            raise

    def _check(self) -> None:
        """Raise `TransportError` if the device has gone; the wire would be opened again, but the device may be new."""
        if reason := self._listening.listeners[self._device.source].session.last_error:
            raise TransportError(reason)

    async def ask(self, message: StartupMessage, timeout_s: float) -> Answer | None:
        """Send a message and wait for its answer; return None if there was none.

        A message that changes the baud rate is sent again at the new rate, and the second answer counts, since an
        answer during the change may be lost.

        Raises:
            TransportError: the device has gone.
        """
        answer = await self._ask(message, timeout_s)
        if message.baud is None or (answer is not None and not answer.accepted):
            return answer
        await self._listening.__aexit__()
        await asyncio.sleep(SETTLE_S)
        self._listening = self._at(message.baud)
        await self._open()
        return await self._ask(message, timeout_s)

    async def _ask(self, message: StartupMessage, timeout_s: float) -> Answer | None:
        listener, loop = message.listen(), asyncio.get_running_loop()
        asked_ns = self._listening.clock.now_ns()
        await self._listening.send(self._device.source, message.data)
        deadline_s = loop.time() + timeout_s
        while (left_s := deadline_s - loop.time()) > 0:
            self._check()
            for units in await self._heard(min(SLICE_S, left_s)):
                if units.host_time_ns[0] < asked_ns:  # no answer to this message
                    continue
                answer = listener.hear(units.units.tobytes())
                if answer is not None:
                    return answer
        return listener.close()

    async def _heard(self, seconds: float) -> list[ChunkBatch]:
        """Return the units of the next reading; none: nothing came in so many seconds."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                batch = await self._listening.take()
            if batch is not None:
                return batch.units
        return []


def plan_setup(
    config: Config, only: Collection[str] = (), *, save: bool = False, present_baud: int | None = None
) -> list[WireSetup]:
    """Plan the messages, wire by wire, without sending anything.

    Args:
        config: the configuration.
        only: sources (``gnss/rover``); empty for all.
        save: make the devices keep the settings without power.
        present_baud: the present baud rate of the one device that is asked for.

    Raises:
        UserError: a source does not exist, or a rate is given for more or less than one serial device.
    """
    entries = {entry.source: entry for entry in config.devices()}
    if unknown := [source for source in only if source not in entries]:
        raise UserError(f"no device {unknown[0]}; there are: {', '.join(entries) or 'none'}", ExitCode.USAGE)
    wires: dict[str, WireSetup] = {}
    for entry in entries.values():
        if not only or entry.source in only:
            carrier = entries[entry.transport.carrier or entry.source]
            wire = wires.setdefault(carrier.source, WireSetup(carrier))
            _add_device(wire, entry, carrier, StartupOptions(save, present_baud and _configured_baud(carrier)))
    if present_baud is not None:
        _change_rate(wires, present_baud)
    return list(wires.values())


def _configured_baud(entry: DeviceEntry) -> int | None:
    baud = entry.transport.options.get("baud")
    return int(baud) if baud is not None and entry.transport.kind == "serial" else None


def _change_rate(wires: dict[str, WireSetup], present_baud: int) -> None:
    """Set the present baud rate of the one wire whose device is set to another rate."""
    changing = [
        (source, wire) for source, wire in wires.items() if any(step.message.baud is not None for step in wire.steps())
    ]
    if len(changing) != 1:
        names = ", ".join(source for source, _ in changing)
        found = f"there are: {names}; choose one with --device" if changing else "no device has a baud rate to set"
        raise UserError(f"--from-baud needs exactly one serial device with ?baud=…; {found}", ExitCode.USAGE)
    changing[0][1].present_baud = present_baud


def _add_device(wire: WireSetup, entry: DeviceEntry, carrier: DeviceEntry, options: StartupOptions) -> None:
    device = DeviceSetup(entry.source, entry.protocol, entry.transport.text)
    wire.devices.append(device)
    startup = find_driver(entry.kind, entry.protocol).startup
    if startup is None:
        return
    known = {step.message.data for step in wire.steps()}
    device.steps = [Step(message) for message in startup(entry.settings, options) if message.data not in known]
    device.problem = _why_not_sent(wire.device.transport)


def _why_not_sent(spec: TransportSpec) -> str:
    """Return why nothing can be sent over a transport; return "" if it can.

    A UDP device needs a source address and no group: with a group, a datagram would go to the group, not to the device.
    """
    if spec.kind in ("serial", "tcp") or (
        spec.kind == "udp" and "source" in spec.options and "group" not in spec.options
    ):
        return ""
    hint = "; add ?source=<its address> and remove group" if spec.kind == "udp" else ""
    return f"{spec.text} cannot send{hint}"


def apply_setup(wire: WireSetup, timeout_s: float) -> None:
    """Send a wire's messages and keep the devices' answers in its steps."""
    steps = wire.steps()
    if steps and not any(device.problem for device in wire.devices):
        try:
            asyncio.run(_send_all(wire, steps, timeout_s))
        except TransportError as error:
            for device in wire.devices:
                device.problem = str(error) if device.steps else ""
    for step in steps:
        if step.outcome is Outcome.PLANNED:
            step.outcome = Outcome.NOT_SENT


async def _send_all(wire: WireSetup, steps: list[Step], timeout_s: float) -> None:
    async with Line(wire.device, wire.present_baud) as line:
        for step in steps:
            if step.message.last and not _all_accepted(steps):
                step.outcome, step.answer = Outcome.NOT_SENT, "the device did not accept every message"
                continue
            step.outcome = Outcome.NO_ANSWER  # kept if no answer arrives
            answer = await line.ask(step.message, timeout_s)
            if answer is None:
                return
            step.outcome = Outcome.ACCEPTED if answer.accepted else Outcome.REFUSED
            step.answer = one_line(answer.text)
            if step.message.baud is not None and not answer.accepted:
                return


def _all_accepted(steps: Iterable[Step]) -> bool:
    return all(step.outcome is Outcome.ACCEPTED for step in steps if not step.message.last)
