"""Rough air: how it moves the aircraft about its path and its attitude.

Each axis is white noise through three filters: one falls beyond the scale of gusts as gusts do (Dryden's form,
MIL-F-8785C 3.7.1), one removes what an autopilot corrects, and one removes what inertia absorbs. The sizes are those of
the aircraft's motion, not of the gusts; moderate and severe relate to light about as in 3.7.2 there.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.signal import butter, sosfilt

from swath.georef.arrays import FloatArray
from swath.sim.clocks import generator
from swath.sim.flight.smoothing import STEP_S

INTENSITY = {"none": 0.0, "light": 1.0, "moderate": 2.5, "severe": 5.0}
VELOCITY_RMS_MPS = {"east": 0.2, "north": 0.2, "up": 0.3}  # in light turbulence
ANGLE_RMS_DEG = {"roll": 0.5, "pitch": 0.25, "heading": 0.2}

# order, corner in Hz and kind of consecutive Butterworth filters
PATH_FILTERS = ((2, 0.05, "highpass"), (2, 0.10, "lowpass"), (4, 0.6, "lowpass"))
ANGLE_FILTERS = ((2, 0.05, "highpass"), (1, 0.20, "lowpass"), (4, 0.8, "lowpass"))

_SETTLED_S = 120.0  # time after which the filters have settled


def displacement_m(intensity: str, seed: int, count: int) -> FloatArray:
    """Return (count, 3) displacements east, north, up from the path at knots `STEP_S` apart."""
    sections = _sections(PATH_FILTERS)
    per_step = float(np.linalg.norm(np.diff(_response(sections), prepend=0.0))) / STEP_S
    return INTENSITY[intensity] / per_step * _axes(VELOCITY_RMS_MPS, sections, seed, count)


def angles_rad(intensity: str, seed: int, count: int) -> FloatArray:
    """Return (count, 3) deviations of roll, pitch, heading from those of the path at knots `STEP_S` apart."""
    sections = _sections(ANGLE_FILTERS)
    scale = INTENSITY[intensity] / float(np.linalg.norm(_response(sections)))
    return scale * np.radians(_axes(ANGLE_RMS_DEG, sections, seed, count))


def _sections(filters: tuple[tuple[int, float, str], ...]) -> FloatArray:
    made = [butter(order, corner, btype=kind, fs=1.0 / STEP_S, output="sos") for order, corner, kind in filters]
    return np.concatenate(made)


def _response(sections: FloatArray) -> FloatArray:
    """Return the response to one impulse; its norm is the standard deviation of filtered white noise."""
    impulse = np.zeros(round(_SETTLED_S / STEP_S))
    impulse[0] = 1.0
    response: FloatArray = sosfilt(sections, impulse)
    return response


def _axes(rms: Mapping[str, float], sections: FloatArray, seed: int, count: int) -> FloatArray:
    """Return (count, axes) filtered white noise of each axis, which has this rms before the filters."""
    settling = round(_SETTLED_S / STEP_S)
    axes = [generator(seed, "turbulence", name).standard_normal(settling + count) for name in rms]
    filtered: FloatArray = sosfilt(sections, np.stack(axes, axis=-1), axis=0)[settling:]
    filtered *= np.array(list(rms.values()))
    return filtered
