"""Defines a target and the rules for each of its inputs; Hypothesis chooses the inputs and minimises findings.

A path is a seed and a few mutations, each of the seed or of the previous result; every input on it is checked.
Hypothesis draws the seed, the number of mutations, and the key of their random generators, and reduces a failing path
to the fewest mutations. Drawing each decision of a mutation would make an input cost several times as much; drawing a
key for each mutation would repeat most of them, because Hypothesis varies what it has drawn before (decision 0031).
"""

from __future__ import annotations

import random
import time
import traceback
import tracemalloc
import warnings
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import hypothesis
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

SECONDS_OF_AN_INPUT = 5.0  # of processor time, for at most `mutation.LARGEST_CASE_BYTES`
MUTATIONS_OF_A_PATH = 10
FROM_SEED = 0.5  # share of mutations that begin at the seed again; the others continue from the previous one
MEASURED_OF_PATHS = 64  # one path in so many measures its memory, which makes it several times slower
INPUTS_OF_A_LIFE = 300
PATHS_OF_A_ROUND = 100  # between two looks at the clock
SETTINGS = settings(
    database=None,
    deadline=None,
    phases=(Phase.generate, Phase.shrink),
    suppress_health_check=list(HealthCheck),
)


class FindingError(AssertionError):
    """Raised if a target breaks a rule of time, memory or growth."""


@dataclass(frozen=True, slots=True)
class Target:
    """A reader of foreign bytes.

    Attributes:
        name: name on the command line, and of the folder of its inputs.
        seeds: inputs to begin with.
        mutate: makes another input from one.
        run: reads an input and returns its contents in words; any exception is a finding.
        endure: reads many inputs with one object; raises `FindingError` if something grows. None: not tested.
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
    """A run's figures; ``findings`` maps the place of each finding to its input and error."""

    executions: int = 0
    seen: set[str] = field(default_factory=set)
    findings: dict[str, tuple[bytes, Exception]] = field(default_factory=dict)


def check(target: Target, data: bytes, *, memory: bool = False) -> set[str]:
    """Run one input under all rules.

    Raises:
        Exception: whatever the target raised, including warnings; `FindingError` for time and memory.
    """
    started = time.process_time()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        seen = set(_measured(target, data) if memory else target.run(data))
    took = time.process_time() - started
    if took > SECONDS_OF_AN_INPUT * (4 if memory else 1):
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


def inputs_of(target: Target, seed: bytes, key: bytes, length: int) -> Iterator[bytes]:
    """Yield the inputs of a path: mutations of the seed, or of the input before."""
    data = seed
    for number in range(length):
        rng = random.Random(key + bytes([number]))
        # a broken text is refused, whatever else is changed in it
        data = target.mutate(rng, seed if rng.random() < FROM_SEED else data)
        yield data


def fuzz(target: Target, paths: int, *, number: int | None = None, report: Report | None = None) -> Report:
    """Check the inputs of a number of paths; a finding ends the search once its path is minimal.

    Args:
        target: reads the inputs.
        paths: number of paths that Hypothesis makes.
        number: seed of Hypothesis; None: the same paths each time.
        report: figures to which this run adds.
    """
    found = report or Report()

    @settings(SETTINGS, max_examples=paths, derandomize=number is None)
    @given(
        st.sampled_from(target.seeds),
        st.binary(min_size=8, max_size=8),
        st.integers(1, MUTATIONS_OF_A_PATH),
        st.integers(0, MEASURED_OF_PATHS - 1),
    )
    def run(seed: bytes, key: bytes, length: int, turn: int) -> None:
        for data in inputs_of(target, seed, key, length):
            found.executions += 1
            try:
                found.seen |= check(target, data, memory=turn == MEASURED_OF_PATHS - 1)
            except Exception as error:  # any exception of a target is a finding
                _keep(found, data, error)
                raise

    try:
        (run if number is None else hypothesis.seed(number)(run))()
    except Exception:  # the finding again, or a group of several; an error of the engine itself is raised
        if not found.findings:
            raise
    return found


def fuzz_for(target: Target, seconds: float, *, number: int) -> Report:
    """Fuzz for some seconds of processor time, not shortened by other work, then feed many inputs to one object."""
    report, started, turns = Report(), time.process_time(), 0
    while not report.findings and time.process_time() - started < seconds:
        fuzz(target, PATHS_OF_A_ROUND, number=number + turns, report=report)
        turns += 1
    if target.endure is not None:
        rng = random.Random(number)
        cases = [target.mutate(rng, rng.choice(target.seeds)) for _ in range(INPUTS_OF_A_LIFE)]
        try:
            target.endure(cases)
        except Exception as error:  # any exception is a finding; the last input stands for all where something grows
            _keep(report, cases[-1], error)
    return report


def _keep(report: Report, data: bytes, error: Exception) -> None:
    """Keep one input a place, the shortest."""
    own = [frame for frame in traceback.extract_tb(error.__traceback__) if "/site-packages/" not in frame.filename][-1]
    place = f"{type(error).__name__} {Path(own.filename).name}:{own.lineno}"
    if place not in report.findings or len(data) <= len(report.findings[place][0]):
        report.findings[place] = (data, error)
