"""Tests noiseless flights of every kind of scanner, georeferenced with true trajectory and calibration.

Every return is within 1 mm plus half of the packet's quanta (range, angle, time) projected to the ground. Each kind is
flown once without air and once with it, where ranges refer to vacuum and beams are bent.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from swath.daemon.config import parse_config
from swath.daemon.processing.setup.models import make_motion
from swath.daemon.processing.setup.setup import Options, Setup
from swath.georef.arrays import ByteArray, FloatArray
from swath.georef.points import Points
from swath.sim.companions import config_text, default_wires
from tests.builders import (
    EVERY_ERROR,
    LOW_AND_SLOW,
    ROUND_ERRORS,
    SIDEWAYS,
    SPINNING_ERRORS,
    SREP_24_BIT,
    TURNED,
    Flown,
    bound,
    fly_and_decode,
    vlp16_quanta,
)
from tests.daemon.processing.builders import IBRC, true_trajectory

pytestmark = pytest.mark.xdist_group("proof")

FACETS = [{"index": 0, "tilt_deg": 0.03}, {"index": 1, "tilt_deg": -0.02}, {"index": 3, "tilt_deg": 0.01}]
STEADY = EVERY_ERROR | {"torsion_us2": 0.0}
NO_LATENCY = {"encoder_latency_us": 0.0, "torsion_us2": 0.0}
AIR = {"ranges": "vacuum", "refraction": "spherical"}


@dataclass(frozen=True)
class Case:
    """A kind of scanner: its table in the plan, and the quanta of its packets."""

    scanner: dict[str, Any]
    low: bool = False
    quanta: dict[str, float] | None = None
    stop_s: float = 15.5


CASES = {
    "sine": Case({"motion": "sine", "true": EVERY_ERROR, "installation": TURNED, "ibrc": IBRC}),
    "triangle": Case({"motion": "triangle", "true": EVERY_ERROR | NO_LATENCY}),
    "polygon": Case({"kind": "polygon", "facets": 4, "half_angle_deg": 35.0, "true": STEADY, "facet": FACETS}),
    "monogon": Case({"kind": "monogon", "half_angle_deg": 50.0, "scan_hz": 60.0, "true": STEADY}),
    "nutating": Case({"kind": "nutating", "nutation_deg": 7.0, "scan_hz": 30.0, "true": ROUND_ERRORS}),
    "risley": Case(
        {"kind": "risley", "wedge_deg": [10.0, 12.0], "prism_ratio": -0.75, "scan_hz": 40.0, "true": ROUND_ERRORS}
    ),
    "vlp16": Case({"kind": "vlp16", "dual_return": False}, low=True, stop_s=1.3),
    "vlp16 dual": Case({"kind": "vlp16", "dual_return": True}, low=True, stop_s=1.3),
    "os1": Case({"kind": "os1", "serial": "1"}, low=True, stop_s=1.3),
    "rosette": Case({"kind": "rosette", "prf_hz": 25_000.0, "half_angle_deg": 35.0}, low=True, stop_s=1.3),
}
AHEAD_DOWN = [[0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0]]  # x down, z forward
LOW_HEAD = {
    "scan_hz": 10.0,
    "true": SPINNING_ERRORS,
    "installation": SIDEWAYS,
    "range_min_m": 1.0,
    "range_max_m": 130.0,
    "reference_range_m": 60.0,
}


def fly(folder: Path, case: Case, atmosphere: dict[str, str]) -> Flown:
    """Fly the case through some air."""
    changes: dict[str, Any] = {"scanner": {"left": case.scanner | (LOW_HEAD if case.low else {})}}
    if case.scanner.get("kind") == "rosette":
        no_encoder = {"scan_angle_offset_deg": 0.0, "encoder_latency_us": 0.0}
        changes["scanner"]["left"] |= {"true": SPINNING_ERRORS | no_encoder, "installation": AHEAD_DOWN}
    changes |= {"atmosphere": atmosphere} | (LOW_AND_SLOW if case.low else {})
    return fly_and_decode(folder, changes, case.stop_s)


def georeferenced(flown: Flown, folder: Path) -> tuple[Points, ByteArray]:
    """Georeference with the configuration of the flight and the true calibration."""
    for name, data in flown.files.items():
        (folder / name).write_bytes(data)
    text = config_text(flown.plan, default_wires(flown.plan), ".").partition("[output]")[0]  # points stay in e
    text = text.replace("range_max_m = 130.0", "range_max_m = 200.0")  # the gate allows for no errors of range
    config = parse_config(text, folder / "swath.toml")
    attachments = {f"geometry/{name}": data for name, data in flown.files.items() if name == "left.json"}
    calibration = flown.files["left.true.toml"].decode()
    attachments["calibration/left.toml"] = calibration.encode()
    setup = Setup(
        config, attachments, Options(calibrations={"left": (calibration, "left.true.toml")}, uncertainty=False)
    )
    time_ns = flown.plan.start_gps_ns + np.rint(flown.time_s * 1e9).astype(np.int64)
    georeferencer = setup.georeferencer("left")
    motion = make_motion(config.scanner["left"], georeferencer.model)
    if motion is not None:
        pieces = [motion.feed(flown.rows, time_ns), motion.flush()]
        _, _, rate, acceleration = (np.concatenate(column) for column in zip(*pieces, strict=True))
        given = georeferencer.encoder_motion
        given.rate, given.acceleration = rate, acceleration
    points, fate = georeferencer.georeference(flown.rows, time_ns, true_trajectory(flown))
    return points, fate


def limits_of(case: Case, flown: Flown) -> FloatArray:
    """Return 1 mm plus half of each quantum projected to the ground."""
    kind = case.scanner.get("kind")
    if kind == "vlp16":
        groups = 6 if case.scanner["dual_return"] else 12
        angle = np.radians(0.01) * vlp16_quanta(flown.truth["left.pulse"], groups=groups)
        return bound(flown, range_quantum_m=0.002, angle_quantum_rad=angle, time_quantum_s=1e-6)
    if kind == "os1":
        return bound(flown, range_quantum_m=0.001, angle_quantum_rad=0.0, time_quantum_s=1e-9)
    if kind == "rosette":  # the diagonal of a cube of 1 mm; times of a packet's pulses are between those of its ends
        return bound(flown, range_quantum_m=3**0.5 * 0.001, angle_quantum_rad=0.0, time_quantum_s=1e-7)
    return bound(flown, **SREP_24_BIT)


@pytest.mark.slow
@pytest.mark.parametrize("air", ["off", "on"])
@pytest.mark.parametrize("name", CASES)
def test_every_return_is_placed_where_the_simulated_beam_hit(tmp_path: Path, name: str, air: str) -> None:
    case = CASES[name]
    flown = fly(tmp_path, case, AIR if air == "on" else {})
    points, fate = georeferenced(flown, tmp_path)
    assert (fate == 0).all(), np.bincount(fate)
    missed = np.linalg.norm(points.points_map - flown.truth["left.point_e"], axis=1)
    limits = limits_of(case, flown)
    assert (missed <= limits).all(), (missed.max(), np.argmax(missed - limits))
    if not case.low:
        assert missed.max() <= 2e-3
