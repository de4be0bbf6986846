"""``python -m tests.fuzz``: every target for so long, a line each; inputs that broke one are kept under fuzz/crashes.

With atheris there (Linux, Python 3.11 to 3.13; ``pip install atheris``) ``--guided`` lets it choose inputs by the code
they reach. ``--input FILE`` runs one input of a target again.
"""

from __future__ import annotations

import argparse
import os
import random
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

from tests.fuzz.engine import Report, Target, check, fuzz, save_crashes

CRASHES = Path("fuzz/crashes")


def main() -> int:
    """1 when something was found."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("targets", nargs="*", help="all by default")
    parser.add_argument("--seconds", type=float, default=600.0, help="of each target")
    parser.add_argument("--seed", type=int, default=random.SystemRandom().randrange(1 << 31))
    parser.add_argument("--guided", action="store_true", help="by atheris")
    parser.add_argument("--input", type=Path, help="run this input only")
    parser.add_argument("--list", action="store_true")
    given = parser.parse_args()
    targets = _targets(guided=given.guided)
    if unknown := set(given.targets) - set(targets):
        parser.error(f"no target {min(unknown)}; there are: {', '.join(targets)}")
    names = given.targets or list(targets)
    if given.list:
        print("\n".join(targets))
        return 0
    if given.input is not None:
        check(targets[names[0]](), given.input.read_bytes())
        return 0
    print(f"seed {given.seed}", flush=True)
    found = 0
    for name in names:
        if given.guided:
            found += _guided_in_a_child(targets[name], name, given.seconds, given.seed)
        else:
            found += _mutated(targets[name](), given.seconds, given.seed)
    return int(found > 0)


def _targets(*, guided: bool) -> dict[str, Callable[[], Target]]:
    """All targets; what they run is instrumented while it is imported."""
    if guided:
        import atheris  # type: ignore[import-untyped,import-not-found,unused-ignore]

        with atheris.instrument_imports(include=["swath"]):
            from tests.fuzz.targets import all_targets

            return all_targets()  # imports the drivers
    from tests.fuzz.targets import all_targets

    return all_targets()


def _mutated(target: Target, seconds: float, seed: int) -> int:
    report: Report = fuzz(target, seconds=seconds, seed=seed)
    print(report.line(), flush=True)
    for path in save_crashes(report, CRASHES):
        print(f"  {path}: {path.with_suffix('.txt').read_text().splitlines()[0]}", flush=True)
    return len(report.crashes)


def _guided_in_a_child(build: Callable[[], Target], name: str, seconds: float, seed: int) -> int:
    """libFuzzer ends its process, so each target has one."""
    child = os.fork()
    if child == 0:
        _guided(build, name, seconds, seed)
    return int(os.waitpid(child, 0)[1] != 0)


def _guided(build: Callable[[], Target], name: str, seconds: float, seed: int) -> None:
    import atheris  # type: ignore[import-untyped,import-not-found,unused-ignore]

    target = build()
    crashes = CRASHES / name
    crashes.mkdir(parents=True, exist_ok=True)
    corpus = Path(tempfile.mkdtemp(prefix="swath-fuzz-"))
    for number, data in enumerate(target.seeds):
        (corpus / str(number)).write_bytes(data)

    def mutate(data: bytes, max_size: int, number: int) -> bytes:
        return target.mutate(random.Random(number), data)[:max_size]

    def run(data: bytes) -> None:
        check(target, data)

    options = [
        f"-max_total_time={int(seconds)}",
        f"-seed={seed % (1 << 31) or 1}",
        "-max_len=65536",
        "-print_final_stats=1",
    ]
    atheris.Setup([name, *options, f"-artifact_prefix={crashes}/", str(corpus)], run, custom_mutator=mutate)
    atheris.Fuzz()


if __name__ == "__main__":
    sys.exit(main())
