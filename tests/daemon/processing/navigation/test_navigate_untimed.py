"""Tests a flight whose inertial unit has no known clock: the trajectory is at the truth at GPS times."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from swath.daemon.processing.navigation.inputs import InputOptions
from swath.daemon.processing.navigation.navigate import NavigationOptions, navigate_session
from swath.georef.timescales import SECOND_NS
from tests.calib.village import HEADER, LINE, LINES
from tests.daemon.short_flight import fly_short

pytestmark = [pytest.mark.xdist_group("kernels"), pytest.mark.slow]

SPEED_MPS = 50.0


def test_samples_timed_by_arrival_cause_no_error_along_the_track(tmp_path: Path) -> None:
    """Three CAN frames at 1 Mbit/s take 0.4 ms, which would shift positions of 1 cm sigma by 2 cm."""
    text = HEADER.format(seed=4, prf_hz=500.0, true="omega_deg = 0.0")
    for name, (x0, y0), (x1, y1), height in LINES[:3]:
        text += LINE.format(name=name, x0=x0, y0=y0, x1=x1, y1=y1, height=height)
    flown = fly_short(tmp_path, text)
    config = flown.changed("untimed.toml", **{"sample_ticks": "# ", "pps_ticks": "# ", 'group = "last"': ""})
    navigated = navigate_session(flown.session(), NavigationOptions(InputOptions(config=config)))
    [leg] = navigated.legs
    offset_s = leg.solved.report.time_offset_s
    assert 3e-4 < offset_s < 5e-4
    found, truth = navigated.trajectory(), flown.truth()
    begin_ns, end_ns = found.span
    inside = (truth.time_ns > begin_ns + 20 * SECOND_NS) & (truth.time_ns < end_ns - 2 * SECOND_NS)
    at_ns = truth.time_ns[inside][::20]
    there, true = found.poses(at_ns), truth.poses(at_ns)
    ahead = true.velocity_e / np.linalg.norm(true.velocity_e, axis=1, keepdims=True)
    off_m = there.position_e - true.position_e
    assert abs((off_m * ahead).sum(axis=1).mean()) < 0.3 * offset_s * SPEED_MPS
    sigma_m = np.sqrt((there.position_sigma_l**2).sum(axis=1).mean())
    assert np.sqrt((off_m**2).sum(axis=1).mean()) < 1.5 * sigma_m
