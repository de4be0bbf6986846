"""The proofs, with pytest's options:  python -m tests.vm -m "not long"

A proof that failed while others had the computer's processors says nothing of the program: where all that failed did,
their files run once more, and count then.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

from tests.vm.machine import BESIDE_OTHERS

HERE = Path(__file__).resolve().parent
FAILED = 1  # pytest.ExitCode.TESTS_FAILED


def run(paths: list[str]) -> int:
    """Its exit status."""
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "-n", "0", "-v", *sys.argv[1:], *paths]
    return subprocess.run(command, check=False).returncode


def main() -> int:
    """0: all are proven."""
    status = run([str(HERE)])
    if status != FAILED or not BESIDE_OTHERS.exists():
        return status
    told = json.loads(BESIDE_OTHERS.read_text())
    sys.stdout.write(f"beside other work: {told['failed']} failed, {told['error']} error; once more {told['paths']}\n")
    sys.stdout.flush()
    return run(told["paths"])


if __name__ == "__main__":
    sys.exit(main())
