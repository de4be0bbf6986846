"""Whether two calibrations of a scanner were made with the same of all that is not compared: values that were held,
tables, settings of the atmosphere. Where these differ, angles do, too, and nothing has moved."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from swath.georef.scanner.calibration import PARAMETERS, BeamCorrection, Calibration

LIKE = 1.0 / 3.0  # of a sigma: what differs by less adds a twentieth to the expected square
DISTANCE_M = 500.0  # at which metres are told from angles
METRE = 1.0 / DISTANCE_M
TURNS = {  # radians at most, or about, that an angle found with a unit (SI) more of a parameter may differ by; else 1
    "range_offset_m": METRE,
    "lever_arm_x_m": METRE,
    "lever_arm_y_m": METRE,
    "lever_arm_z_m": METRE,
    "encoder_latency_s": 600.0,  # a mirror's rate
    "torsion_s2": 1e5,  # its acceleration
}
NO_BEAM = BeamCorrection()


def difference_between(one: Calibration, other: Calibration, sigma_rad: float) -> str:
    """What differs by more than a part of the sigma of the angles that are compared, in words; empty: nothing does.

    What both estimated differs as its sigmas say, and the angles' sigmas have it. What a file leaves unsaid is none.
    """
    return next(_differences(one, other, LIKE * sigma_rad), "")


def _differences(one: Calibration, other: Calibration, limit_rad: float) -> Iterator[str]:
    for word, first, second in (
        ("mirror_factor", one.mirror_factor, other.mirror_factor),
        ("ranges", one.ranges, other.ranges),
        ("refraction", one.refraction, other.refraction),
    ):
        if first is not None and second is not None and first != second:
            yield f"{word} is {first} and {second}"
    for index, parameter in enumerate(PARAMETERS):
        values = float(one.parameters[index]), float(other.parameters[index])
        estimated = bool(one.sigmas[index] > 0.0) + bool(other.sigmas[index] > 0.0)
        if estimated < 2 and abs(values[1] - values[0]) * TURNS.get(parameter.name, 1.0) > limit_rad:
            held = "held in one" if estimated else "held"
            yield f"{parameter.key}, {held}, is {values[0] / parameter.factor:g} and {values[1] / parameter.factor:g}"
    for word, apart_rad in (
        ("range corrections by intensity", METRE * _ibrc_apart_m(one, other)),
        ("range offsets by return, zone or rate", METRE * _offsets_apart_m(one, other)),
        ("tilts of facets", _facets_apart_rad(one, other)),
        ("corrections of beams", _beams_apart_rad(one, other)),
    ):
        if apart_rad > limit_rad:
            yield f"{word} differ"


def _ibrc_apart_m(one: Calibration, other: Calibration) -> float:
    """The most that corrections by intensity differ by; no table corrects nothing."""
    tables = [table for table in (one.ibrc, other.ibrc) if table is not None]
    if not tables:
        return 0.0
    at = np.unique(np.concatenate([nodes for nodes, _ in tables]))
    first, second = (np.zeros(len(at)) if each.ibrc is None else np.interp(at, *each.ibrc) for each in (one, other))
    return float(np.abs(second - first).max())


def _offsets_apart_m(one: Calibration, other: Calibration) -> float:
    first, second = (
        {(offset.return_slot, offset.mta_zone, offset.prf_hz): offset.offset_m for offset in each.range_offsets}
        for each in (one, other)
    )
    return max((abs(first.get(key, 0.0) - second.get(key, 0.0)) for key in {*first, *second}), default=0.0)


def _facets_apart_rad(one: Calibration, other: Calibration) -> float:
    first, second = one.facet_tilt_rad, other.facet_tilt_rad
    return max((abs(first.get(key, 0.0) - second.get(key, 0.0)) for key in {*first, *second}), default=0.0)


def _beams_apart_rad(one: Calibration, other: Calibration) -> float:
    apart = 0.0
    for channel in {*one.beams, *other.beams}:
        first, second = (each.beams.get(channel, NO_BEAM) for each in (one, other))
        turned = math.hypot(first.azimuth_rad - second.azimuth_rad, first.elevation_rad - second.elevation_rad)
        apart = max(apart, turned, METRE * abs(first.range_m - second.range_m))
    return apart
