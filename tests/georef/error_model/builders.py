"""Makes small error models."""

from __future__ import annotations

import numpy as np

from swath.georef.error_model.correlation import Correlation
from swath.georef.error_model.model import Unit

NEVER_FADES = Correlation(1.0, 0.999, 0.0, 1e6)
SLOW = tuple(Correlation(1.0, 0.0, 0.0, tau) for tau in (60.0, 60.0, 100.0, 200.0))
SECOND = 1_000_000_000


def unit(
    strip: int = 1, azimuth_deg: float = 75.0, *, start_s: int = 100, scanner: str = "left", height_m: float = 1000.0
) -> Unit:
    """Return a unit of 100 s at 60 m/s along its azimuth, with posts every 5 s and all kinds of errors."""
    rng = np.random.default_rng(strip)
    post_s = np.arange(0, 101, 5)
    azimuth = np.radians(azimuth_deg)
    along = np.array([np.sin(azimuth), np.cos(azimuth), 0.0])
    mixed = rng.standard_normal((6, 6)) * 0.2 + np.eye(6)
    sigma = np.array([0.02, 0.02, 0.03, 5e-5, 5e-5, 1e-4])
    covariance = np.diag(sigma) @ mixed @ mixed.T @ np.diag(sigma)
    calibration = rng.standard_normal((5, 7)) * [0.01, 0.01, 0.01, 1e-4, 1e-4, 2e-4, 0.02]
    return Unit(
        strip,
        scanner,
        start_s * SECOND,
        (start_s + 100) * SECOND,
        azimuth,
        (start_s + post_s).astype(np.int64) * SECOND,
        along * 60.0 * post_s[:, np.newaxis] + [0.0, 0.0, height_m],
        np.repeat(covariance[np.newaxis], len(post_s), axis=0) * (1.0 + 0.02 * post_s)[:, np.newaxis, np.newaxis],
        calibration,
        np.diag([0.005, 0.01, 0.008]) ** 2,
        (NEVER_FADES, Correlation(1.0, 0.0, 0.0, 100.0), NEVER_FADES),
        np.array([0.02, 2e-5, 1e-5]),
    )
