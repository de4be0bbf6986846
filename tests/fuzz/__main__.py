"""Runs every fuzzing target for a time; an input that breaks one is minimised and kept in fuzz/crashes.

Hypothesis chooses the inputs. With ``--guided`` libFuzzer chooses them by the code that they reach, through atheris
(Linux on x86-64; ``pip install atheris``), and keeps what it learns under fuzz/corpus. ``--input FILE`` runs one input
again.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import os
import random
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

from tests.fuzz.engine import Target, check, fuzz_for

CRASHES, CORPUS = Path("fuzz/crashes"), Path("fuzz/corpus")
MINIMISING_S, STEP_S = 300, 20  # in all; of a process that looks for one smaller input


def main() -> int:
    """Return 1 when something was found."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("targets", nargs="*", help="all by default")
    parser.add_argument("--seconds", type=float, default=600.0, help="of each target")
    parser.add_argument("--seed", type=int, default=random.SystemRandom().randrange(1, 1 << 31))
    parser.add_argument("--guided", action="store_true", help="by atheris")
    parser.add_argument("--input", type=Path, help="run this input of one target only")
    parser.add_argument("--list", action="store_true")
    parser.add_argument(
        "--libfuzzer",
        nargs=argparse.REMAINDER,
        help="its options; of one target",
    )
    given = parser.parse_args()
    targets = _targets(guided=given.guided)
    if unknown := set(given.targets) - set(targets):
        parser.error(f"no target {min(unknown)}; there are: {', '.join(targets)}")
    names = given.targets or list(targets)
    if given.list:
        print("\n".join(targets))
        return 0
    if given.input is not None:
        check(targets[names[0]](), given.input.read_bytes(), memory=True)
        return 0
    if given.libfuzzer is not None:
        _guided(targets[names[0]](), given.libfuzzer)
    print(f"seed {given.seed}", flush=True)
    search = _guided_in_a_child if given.guided else _by_hypothesis
    return int(sum(search(targets[name], name, given.seconds, given.seed) for name in names) > 0)


def _targets(*, guided: bool) -> dict[str, Callable[[], Target]]:
    """Return all targets; what they run is instrumented while it is imported."""
    if guided:
        import atheris  # type: ignore[import-untyped,import-not-found,unused-ignore]

        with atheris.instrument_imports(include=["swath"]):
            from tests.fuzz.targets import all_targets

            return all_targets()  # this imports the drivers
    from tests.fuzz.targets import all_targets

    return all_targets()


def _by_hypothesis(build: Callable[[], Target], name: str, seconds: float, seed: int) -> bool:
    report = fuzz_for(build(), seconds, number=seed)
    found = f"{len(report.findings)} FOUND" if report.findings else "nothing found"
    print(f"{name:24s} {report.executions:9,} inputs {len(report.seen):5d} things seen: {found}", flush=True)
    for place, (data, error) in report.findings.items():
        path = CRASHES / name / hashlib.sha256(data).hexdigest()[:16]
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
        _tell(name, path, f"{place}: {str(error).partition(chr(10))[0]}")
    return bool(report.findings)


def _tell(name: str, path: Path, what: str) -> None:
    print(f"  {what}\n  again: python -m tests.fuzz {name} --input {path}", flush=True)


def _guided_in_a_child(build: Callable[[], Target], name: str, seconds: float, seed: int) -> bool:
    """Search with libFuzzer, which ends its process, and let it reduce a crashing input."""
    crashes, corpus = CRASHES / name, CORPUS / name
    for folder in (crashes, corpus):
        folder.mkdir(parents=True, exist_ok=True)
    known = set(crashes.iterdir())
    with tempfile.TemporaryDirectory(prefix="swath-fuzz-") as seeds:
        child = os.fork()
        if child == 0:
            target = build()
            for number, data in enumerate(target.seeds):
                Path(seeds, str(number)).write_bytes(data)
            limits = [f"-max_total_time={int(seconds)}", f"-seed={seed}", "-max_len=65536", "-print_final_stats=1"]
            _guided(target, [*limits, f"-artifact_prefix={crashes}/", str(corpus), seeds])
        os.waitpid(child, 0)
    found = sorted(set(crashes.iterdir()) - known)
    for path in found:
        small = path.with_name(f"minimised-{path.name}")
        minimise = ["-minimize_crash=1", f"-max_total_time={STEP_S}", f"-exact_artifact_path={small}", str(path)]
        with contextlib.suppress(subprocess.TimeoutExpired):
            quiet = subprocess.DEVNULL
            subprocess.run([*_command(name), *minimise], stdout=quiet, stderr=quiet, timeout=MINIMISING_S, check=False)
        _tell(name, small if small.exists() else path, "FOUND")
    return bool(found)


def _command(name: str) -> list[str]:
    return [sys.executable, "-m", "tests.fuzz", name, "--libfuzzer"]


def _guided(target: Target, options: list[str]) -> None:
    """Run libFuzzer, whose own mutations and the target's take turns; it runs its first argument again by a shell."""
    import atheris  # type: ignore[import-untyped,import-not-found,unused-ignore]

    def mutate(data: bytes, max_size: int, number: int) -> bytes:
        if number % 4 == 0:
            return bytes(atheris.Mutate(data, max_size))
        return target.mutate(random.Random(number), data)[:max_size]

    atheris.Setup(
        [" ".join(_command(target.name)), *options], lambda data: check(target, data) and None, custom_mutator=mutate
    )
    atheris.Fuzz()


if __name__ == "__main__":
    sys.exit(main())
