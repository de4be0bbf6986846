"""Sends a flight of the virtual aircraft over wires in real time: ptys, python-can, UDP and the PPS FIFO.

Faults of the wires are units among the others, with outputs of their own: an unplugged wire, a stepped wall clock.
"""

from __future__ import annotations

import heapq
import socket
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path

from swath.daemon.config import Config
from swath.daemon.errors import ExitCode, UserError
from swath.daemon.replay.units import close_outputs, output_makers
from swath.daemon.replay.wire_player import Output, PlayReport, TimedUnit, play
from swath.daemon.simulate.ahead import FlightFacts

CAN_GROUP = "239.74.163.2"
_CLOCK, _PLUG = "wall clock", "plug of "
_OUT, _IN = b"\0", b"\1"


# ---------------------------------------------------------------------------------------------- separate wires


def free_ports(count: int) -> list[int]:
    """Return UDP ports that are free at the moment."""
    sockets = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(count)]
    for sock in sockets:
        sock.bind(("127.0.0.1", 0))
    ports = [int(sock.getsockname()[1]) for sock in sockets]
    for sock in sockets:
        sock.close()
    return ports


def own_wires(folder: Path, sources: Iterable[str], baud: Mapping[str, int]) -> dict[str, str]:
    """Return transports and PPS sources that no other program uses: ptys and FIFOs in a folder, free UDP ports.

    Args:
        folder: of the ptys and FIFOs.
        sources: of the flight.
        baud: of serial sources; it does not limit the data rate.
    """
    names = list(sources)
    wires = {}
    for name, port in zip(names, free_ports(len(names)), strict=True):
        file = folder / name.replace("/", "-")
        wires[name] = {
            "pps": f"fixed:{file}",
            "gnss": f"serial:{file}?baud={baud.get(name, 115_200)}",
            "imu": f"can:udp_multicast:{CAN_GROUP}?port={port}",
            "scanner": f"udp:127.0.0.1:{port}",
        }[name.partition("/")[0]]
    return wires


# ---------------------------------------------------------------------------------------------- outputs


class WallClock(Output):
    """Steps this computer's wall clock: it takes steps in nanoseconds as data; closing it takes all steps back.

    Attributes:
        stepped_ns: all steps so far.

    Raises:
        UserError: this user may not set the clock.
    """

    def __init__(self) -> None:
        self.stepped_ns = 0
        try:
            self._step(0)
        except PermissionError as error:
            text = "--set-clock: this user may not set the clock; run as root or with CAP_SYS_TIME"
            raise UserError(text, ExitCode.USAGE) from error

    def send(self, data: bytes, due_realtime_ns: int) -> bool:
        """Step the clock now."""
        self._step(int(data))
        return True

    def close(self) -> None:
        """Take all steps back."""
        if self.stepped_ns:
            self._step(-self.stepped_ns)

    def _step(self, step_ns: int) -> None:
        time.clock_settime_ns(time.CLOCK_REALTIME, time.clock_gettime_ns(time.CLOCK_REALTIME) + step_ns)
        self.stepped_ns += step_ns


class _SteppedEdges(Output):
    """PPS edges stamped by a wall clock that has been stepped since they were planned."""

    def __init__(self, output: Output, clock: WallClock) -> None:
        self._output, self._clock = output, clock

    def send(self, data: bytes, due_realtime_ns: int) -> bool:
        return self._output.send(data, due_realtime_ns + self._clock.stepped_ns)

    def has_reader(self) -> bool:
        return self._output.has_reader()

    def close(self) -> None:
        self._output.close()


class _Pulled(Output):
    """An output whose plug can be pulled."""

    def __init__(self, make: Callable[[], Output]) -> None:
        self._make = make
        self._output: Output | None = make()

    def set(self, plugged: bool) -> None:
        """Put the plug in if ``plugged``, else pull it; raises TransportError."""
        if plugged and self._output is None:
            self._output = self._make()
        elif not plugged and self._output is not None:
            self._output.close()
            self._output = None

    def send(self, data: bytes, due_realtime_ns: int) -> bool:
        return self._output is not None and self._output.send(data, due_realtime_ns)

    def has_reader(self) -> bool:
        return self._output is not None and self._output.has_reader()

    def close(self) -> None:
        self.set(False)


class _Plug(Output):
    """The plug of an output; the data sent to it put the plug in or pull it."""

    def __init__(self, output: _Pulled) -> None:
        self._output = output

    def send(self, data: bytes, due_realtime_ns: int) -> bool:
        self._output.set(data == _IN)
        return True

    def close(self) -> None:
        return None


def check_steps(facts: FlightFacts, *, set_clock: bool) -> None:
    """Refuse to step this computer's wall clock without permission; raises UserError."""
    if facts.wall_steps and not set_clock:
        steps = ", ".join(f"{step_s:+g} s at {at_s:g} s" for at_s, step_s in facts.wall_steps)
        text = f"fault clock_step would step this computer's wall clock ({steps}); allow it with --set-clock, as root"
        raise UserError(text, ExitCode.USAGE)


def open_wires(config: Config, facts: FlightFacts) -> tuple[dict[str, Output], dict[str, Output]]:
    """Open the outputs of a configuration for a flight, and the outputs that apply its faults.

    Returns:
        Outputs by source, and those of plugs and of the wall clock; close all of them with `close_outputs`.

    Raises:
        UserError: the flight steps the wall clock, and this user may not.
        TransportError: an output cannot be made; those already made are closed.
    """
    outputs: dict[str, Output] = {}
    clock = WallClock() if facts.wall_steps else None
    others: dict[str, Output] = {} if clock is None else {_CLOCK: clock}
    pulled = {source for source, _, _ in facts.unplugged}
    try:
        for source, make in output_makers(config, with_pps=True).items():
            output = outputs[source] = _Pulled(make) if source in pulled else make()
            if isinstance(output, _Pulled):
                others[_PLUG + source] = _Plug(output)
            if source.startswith("pps/") and clock is not None:
                outputs[source] = _SteppedEdges(output, clock)
    except OSError:
        close_outputs(others)
        close_outputs(outputs)
        raise
    return outputs, others


# ---------------------------------------------------------------------------------------------- flying


def fly_on_wires(
    units: Iterable[TimedUnit],
    facts: FlightFacts,
    outputs: Mapping[str, Output],
    others: Mapping[str, Output],
    *,
    progress: Callable[[float, PlayReport], None] | None = None,
    stopped: Callable[[], bool] = lambda: False,
) -> PlayReport:
    """Send every unit when it is due, and apply the plan's faults to the wires.

    Args:
        units: of the flight, in order of time.
        facts: of the flight.
        outputs, others: of `open_wires`.
        progress, stopped: as of `swath.daemon.replay.wire_player.play`.
    """
    merged = heapq.merge(units, _events(facts), key=lambda unit: unit.time_ns)
    return play(merged, {**outputs, **others}, progress=progress, stopped=stopped)


def _events(facts: FlightFacts) -> Iterator[TimedUnit]:
    """Return the faults of the wires as units, in order of time."""
    events = [
        TimedUnit(round(at_s * 1e9), _CLOCK, str(round(step_s * 1e9)).encode()) for at_s, step_s in facts.wall_steps
    ]
    for source, from_s, to_s in facts.unplugged:
        events.append(TimedUnit(round(from_s * 1e9), _PLUG + source, _OUT))
        events.append(TimedUnit(round(to_s * 1e9), _PLUG + source, _IN))
    return iter(sorted(events, key=lambda event: event.time_ns))
