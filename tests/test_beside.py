"""What the proofs in the virtual machine go by when one fails on a computer that has other work."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.vm import __main__ as proofs
from tests.vm.beside import Moment

SPIN = "import time\nwhile time.process_time() < 0.4: pass\nprint(flush=True); input()"


def test_what_descends_from_this_process_is_its_own_alive_and_ended() -> None:
    before = Moment.here()
    inner = [sys.executable, "-c", SPIN]
    script = f"import subprocess; subprocess.run({inner!r})"
    with subprocess.Popen([sys.executable, "-c", script], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as outer:
        assert outer.stdout is not None
        outer.stdout.readline()
        alive = Moment.here()
        outer.communicate(b"\n")
    ended = Moment.here()
    assert alive.own_s - before.own_s > 0.35
    assert alive.own_s <= ended.own_s + 0.02
    assert ended.busy_s - before.busy_s > 0.35
    assert 0.0 <= before.share_of_others() < 1.0


@pytest.mark.parametrize(
    ("beside", "statuses", "expected"),
    [
        (True, [1, 0], 0),  # once more, and proven
        (True, [1, 1], 1),
        (False, [1], 1),  # others had little: it counts
        (True, [2], 2),  # interrupted
        (False, [0], 0),
    ],
)
def test_what_failed_beside_other_work_runs_once_more(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    beside: bool,
    statuses: list[int],
    expected: int,
) -> None:
    place, ran, left = tmp_path / "beside-others.json", [], iter(statuses)

    def run(paths: list[str]) -> int:
        ran.append(paths)
        return next(left)

    if beside:
        place.write_text(json.dumps({"failed": 2, "error": 1, "paths": ["test_pps.py"]}))
    monkeypatch.setattr(proofs, "BESIDE_OTHERS", place)
    monkeypatch.setattr(proofs, "run", run)
    assert proofs.main() == expected
    assert next(left, None) is None
    assert ran[1:] == [["test_pps.py"]] * (len(statuses) - 1)
    assert capsys.readouterr().out.startswith("beside other work: 2 failed, 1 error; " if len(statuses) > 1 else "")
