"""The flight that tests of the public interface read, and the examples of the documentation."""

from __future__ import annotations

import math
import re
from pathlib import Path

from tests.daemon.short_flight import Flown, fly_short, two_lines

ROOT = Path(__file__).resolve().parents[2]
_BLOCK = re.compile(r"^```python( norun)?\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def fly(folder: Path, seconds: float = math.inf) -> Flown:
    """Fly two lines with a receiver, an IMU and a scanner; the receiver has two antennas and stamps marks."""
    return fly_short(
        folder,
        two_lines("library", half_m=250.0, gnss="ins = true\nsecondary_lever_arm_m = [0.1, 1.15, -1.2]", prf_hz=1000),
        seconds,
    )


def examples(page: str) -> list[tuple[str, bool]]:
    """Return the Python blocks of a page, and whether each can run on a short flight."""
    return [(code, not norun) for norun, code in _BLOCK.findall((ROOT / page).read_text())]
