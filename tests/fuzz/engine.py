"""Runs a target on mutated inputs and tells what it cannot stand: an exception, a warning, time, memory.

An input that showed a message, counter or record not seen before joins the seeds, so that mutations go on from there.
Everything follows from the seed: the n-th input of a run is the same on every machine.
"""

from __future__ import annotations

import hashlib
import random
import time
import traceback
import tracemalloc
import warnings
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path

SECONDS_OF_A_CASE = 5.0  # of processor time, for at most `mutation.LARGEST_CASE_BYTES`
LARGEST_CORPUS = 400
PEAK_EVERY = 64  # inputs between two whose memory is measured, which makes them several times slower


class FindingError(AssertionError):
    """What a target did that it must not."""


@dataclass(frozen=True, slots=True)
class Target:
    """Something that reads bytes of others.

    Attributes:
        name: of the command line and of the folder of its inputs.
        seeds: inputs to begin with.
        mutate: another input from one.
        run: reads an input; returns what was seen in it, in words. Raises whatever is wrong.
        endure: takes many inputs in one life; raises `FindingError` where something grows. None: each input is a life.
        peak_bytes: memory that one input of that many bytes may take while it is read.
    """

    name: str
    seeds: list[bytes]
    mutate: Callable[[random.Random, bytes], bytes]
    run: Callable[[bytes], Iterable[str]]
    endure: Callable[[list[bytes]], None] | None = None
    peak_bytes: Callable[[int], int] = lambda size: (8 << 20) + 400 * size


@dataclass(slots=True)
class Report:
    """A run's figures; ``crashes`` by the place where they happened: the input and the traceback."""

    name: str
    executions: int = 0
    seconds: float = 0.0
    corpus: int = 0
    seen: set[str] = field(default_factory=set)
    slowest_s: float = 0.0
    crashes: dict[str, tuple[bytes, str]] = field(default_factory=dict)

    def line(self) -> str:
        """For the eye."""
        rate = self.executions / self.seconds if self.seconds else 0.0
        found = f"{len(self.crashes)} FOUND" if self.crashes else "nothing found"
        return (
            f"{self.name:24s} {self.seconds:6.0f} s {self.executions:9,} inputs {rate:7.0f}/s "
            f"{len(self.seen):5d} things seen, slowest {self.slowest_s * 1e3:.0f} ms: {found}"
        )


def check(target: Target, data: bytes, *, memory: bool = False) -> set[str]:
    """Run one input under all rules.

    Raises:
        Exception: whatever the target raised, a warning too; `FindingError` for time and memory.
    """
    started = time.process_time()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        seen = set(_measured(target, data) if memory else target.run(data))
    took = time.process_time() - started
    if took > SECONDS_OF_A_CASE * (4 if memory else 1):
        raise FindingError(f"{len(data)} bytes took {took:.1f} s")
    return seen


def _measured(target: Target, data: bytes) -> Iterable[str]:
    tracemalloc.start()
    try:
        seen = target.run(data)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    if peak > target.peak_bytes(len(data)):
        raise FindingError(f"{len(data)} bytes took {peak} bytes of memory, more than {target.peak_bytes(len(data))}")
    return seen


def fuzz(target: Target, *, seconds: float, seed: int = 0, executions: int | None = None) -> Report:
    """Run for so many seconds of processor time, which no other work takes from it, or for so many inputs."""
    report = Report(target.name)
    corpus = list(target.seeds) or [b""]
    started = time.process_time()
    for data in corpus:
        _take(target, data, report, memory=False)
    while time.process_time() - started < seconds and (executions is None or report.executions < executions):
        rng = random.Random(f"{target.name}:{seed}:{report.executions}")
        # what was found last leads on
        recent = rng.random() < 0.3
        base = corpus[-1 - rng.randrange(min(8, len(corpus)))] if recent else rng.choice(corpus)
        data = target.mutate(rng, base)
        if _take(target, data, report, memory=report.executions % PEAK_EVERY == PEAK_EVERY - 1):
            corpus.append(data)
            if len(corpus) > LARGEST_CORPUS:
                del corpus[rng.randrange(len(target.seeds), len(corpus) - 1)]
    if target.endure is not None:
        _endure(target, corpus, report, seed)
    report.seconds, report.corpus = time.process_time() - started, len(corpus)
    return report


def _take(target: Target, data: bytes, report: Report, *, memory: bool) -> bool:
    """Whether the input showed something new."""
    report.executions += 1
    started = time.process_time()
    try:
        seen = check(target, data, memory=memory)
    except Exception as error:
        _keep(error, data, report)
        return False
    if not memory:
        report.slowest_s = max(report.slowest_s, time.process_time() - started)
    new = seen - report.seen
    report.seen |= new
    return bool(new)


def _endure(target: Target, corpus: list[bytes], report: Report, seed: int) -> None:
    """A life of many inputs; its last input stands for all where it grows."""
    rng = random.Random(f"{target.name}:{seed}:life")
    cases = [target.mutate(rng, rng.choice(corpus)) for _ in range(300)]
    try:
        assert target.endure is not None
        target.endure(cases)
    except Exception as error:
        _keep(error, cases[-1], report)


def _keep(error: Exception, data: bytes, report: Report) -> None:
    """One input a place; the shortest of those that came."""
    frames = traceback.extract_tb(error.__traceback__)
    last = frames[-1]
    own = [frame for frame in frames if "/site-packages/" not in frame.filename][-1]
    place = f"{type(error).__name__} {Path(own.filename).name}:{own.lineno} {Path(last.filename).name}:{last.lineno}"
    if place not in report.crashes or len(data) < len(report.crashes[place][0]):
        report.crashes[place] = (data, "".join(traceback.format_exception(error)))


def save_crashes(report: Report, folder: Path) -> list[Path]:
    """Write the inputs and their tracebacks to ``folder/<target>/``."""
    paths = []
    for place, (data, text) in report.crashes.items():
        path = folder / report.name / hashlib.sha256(data).hexdigest()[:16]
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
        path.with_suffix(".txt").write_text(f"{place}\n{text}")
        paths.append(path)
    return paths
