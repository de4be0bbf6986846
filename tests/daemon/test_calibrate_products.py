"""What stands in the head of a calibration file."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np

from daemon.processing.calibrate_products import _header, trajectory_says
from daemon.processing.calibrate_run import Calibrated
from daemon.processing.carried_verdict import Carried
from daemon.processing.navigation_verdict import Level


def session(installation: str, **serials: str) -> Any:
    scanner = {name: SimpleNamespace(model="SIM", serial=serial) for name, serial in serials.items()}
    config = SimpleNamespace(scanner=scanner, profile=SimpleNamespace(installation=installation))
    return SimpleNamespace(setup=SimpleNamespace(config=config, scanners=sorted(scanner)))


def test_a_scanner_that_the_first_session_lacks_has_the_head_of_its_own() -> None:
    found = SimpleNamespace(parameters=np.zeros(3))
    adjusted = SimpleNamespace(calibrations={"left": found, "right": found}, variance_factor=1.0, redundancy=9)
    kept = SimpleNamespace(logged=[session("D-ABCD", left="L1"), session("D-ABCD", left="L1", right="R1")])
    features = SimpleNamespace(planes=[], ties=[])
    done = cast(Calibrated, SimpleNamespace(adjusted=adjusted, kept=kept, features=features))
    assert [_header(done, name, []).scanner_serial for name in ("left", "right")] == ["L1", "R1"]


def test_what_was_judged_of_the_trajectory_speaks_against_the_calibration_before_all_else() -> None:
    bad, care = trajectory_says([Carried(Level.UNUSABLE, "lever arm"), Carried(Level.CARE, "few fixes")])
    assert (bad.what, bad.unusable, bad.excess) == ("lever arm", True, np.inf)
    assert (care.what, care.unusable) == ("few fixes", False)
