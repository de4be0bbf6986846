"""Runs the suite of `tests.arm64.suite` with the emulated Python: ``python -m tests.arm64 [more for pytest]``."""

from __future__ import annotations

import os
import sys

import pytest

from tests.arm64.suite import TAKEN

if __name__ == "__main__":
    if os.uname().machine != "aarch64":
        sys.exit("swath: this Python is none for ARM64: make test-arm64")
    chosen = ["-p", "no:cacheprovider", "-p", "tests.arm64.leaving_out", "-m", "not long and not alone and not peers"]
    sys.exit(pytest.main([*chosen, *sys.argv[1:], *TAKEN]))
