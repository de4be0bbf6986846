"""Rotations that tests of several parts of georef compare with SciPy's."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from swath.georef.arrays import FloatArray


def as_rotation(q: FloatArray) -> Rotation:
    """Return SciPy's rotations of quaternions (n, 4) with the scalar first."""
    return Rotation.from_quat(np.roll(q, -1, axis=-1))
