"""Computes a flight in a separate process, some seconds ahead of the process that uses its units.

Compiled kernels hold the interpreter for long; in the same process, units would be sent late.
"""

from __future__ import annotations

import multiprocessing
import queue
import signal
import threading
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from multiprocessing.connection import Connection

from swath.daemon.errors import ExitCode, UserError
from swath.daemon.replay.wire_player import TimedUnit
from swath.daemon.simulate.flight import Flight

AHEAD_S = 5.0  # of flight in the queue, at most
BATCH_S = 0.1
END_S = 5.0

_Batch = list[tuple[int, str, bytes]]
MakeFlight = Callable[[], "tuple[Flight, dict[str, bytes]]"]


@dataclass(frozen=True, slots=True)
class FlightFacts:
    """The facts of a flight that are known before it begins.

    Attributes:
        duration_s, sources, wall_steps, unplugged: as of `swath.daemon.simulate.flight.Flight`.
        files: content of the files beside the flight, by name.
    """

    duration_s: float
    sources: tuple[str, ...]
    wall_steps: tuple[tuple[float, float], ...]
    unplugged: tuple[tuple[str, float, float], ...]
    files: dict[str, bytes] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class _Failed:
    """The reason why the flight cannot be made; without an exit code it is a defect of the program."""

    text: str
    exit_code: ExitCode | None = None


_Word = FlightFacts | _Failed | _Batch | None


class Ahead:
    """Makes a flight in another process, which starts at once; `facts` waits until the flight is ready.

    Args:
        make: called in the other process, gives the flight and its files: a function of a module, or a `partial` of
            one.
    """

    def __init__(self, make: MakeFlight) -> None:
        context = multiprocessing.get_context("spawn")
        receiving, sending = context.Pipe(duplex=False)
        self._process = context.Process(target=_make_ahead, args=(make, sending), daemon=True)
        handler = signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches both; this process ends the other
        try:
            self._process.start()
        finally:
            signal.signal(signal.SIGINT, handler)
        sending.close()
        self._words: queue.Queue[_Word] = queue.Queue(round(AHEAD_S / BATCH_S))
        self._stop = threading.Event()
        self._facts: FlightFacts | None = None
        threading.Thread(target=self._receive, args=(receiving,), daemon=True).start()

    @property
    def facts(self) -> FlightFacts:
        """The facts that are known before the flight begins.

        Raises:
            UserError: the plan cannot be flown.
        """
        if self._facts is None:
            word = self._take()
            assert isinstance(word, FlightFacts)
            self._facts = word
        return self._facts

    def units(self) -> Iterator[TimedUnit]:
        """Yield all units; their time is the true time since the start."""
        assert self.facts
        while (word := self._take()) is not None:
            assert isinstance(word, list)
            for unit in word:
                yield TimedUnit(*unit)

    def close(self) -> None:
        """Terminate the other process, whatever it is doing."""
        self._stop.set()
        self._process.terminate()
        self._process.join(END_S)

    def _take(self) -> _Word:
        word = self._words.get()
        if isinstance(word, _Failed):
            if word.exit_code is None:
                raise RuntimeError(word.text)
            raise UserError(word.text, word.exit_code)
        return word

    def _receive(self, receiving: Connection) -> None:
        word: _Word = []
        while word is not None and not isinstance(word, _Failed):
            try:
                word = receiving.recv()
            except (EOFError, OSError):
                word = _Failed("the process that computes the flight has ended unexpectedly")
            while not self._stop.is_set():
                try:
                    self._words.put(word, timeout=0.2)
                except queue.Full:
                    continue
                break
        receiving.close()


def _make_ahead(make: MakeFlight, sending: Connection) -> None:
    """Run the other process: send the facts, then batch after batch, then None."""
    try:
        flight, files = make()
        plugs, steps = tuple(flight.unplugged), tuple(flight.wall_steps)
        sending.send(FlightFacts(flight.duration_s, flight.sources, steps, plugs, files))
        for batch in _batches(flight):
            sending.send(batch)
        sending.send(None)
    except BrokenPipeError:
        return  # the receiving process has closed the pipe
    except UserError as error:
        sending.send(_Failed(error.message, error.exit_code))
    except Exception:  # top level of a process: the receiving process reports the defect
        sending.send(_Failed(traceback.format_exc()))


def _batches(flight: Flight) -> Iterator[_Batch]:
    batch: _Batch = []
    due_s = BATCH_S
    for unit in flight.units():
        if unit.time_s >= due_s:
            yield batch
            batch, due_s = [], unit.time_s + BATCH_S
        batch.append((round(unit.time_s * 1e9), unit.source, unit.data))
    yield batch
