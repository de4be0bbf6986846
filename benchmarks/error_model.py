"""Measure how fast the error model answers on one core, beside a copy of the points.

python -m benchmarks.error_model [--points 500000] [--repeats 5]

Figures are answers a second of this process's own CPU time, medians over the repeats, for a model of ten strips with
posts every 5 s and sixteen errors of the calibration. The limits are those of the product: two million points and half
a million pairs a second.
"""

from __future__ import annotations

import argparse

import numpy as np

from benchmarks.cpu_time import cpu_seconds
from swath.georef.error_model.correlation import Correlation
from swath.georef.error_model.model import GROUPS, ErrorModel, Unit, path_axes
from swath.georef.timescales import SECOND_NS

STRIPS, STRIP_S, POST_S, ERRORS = 10, 100, 5, 16
POINTS_PER_S, PAIRS_PER_S = 2e6, 0.5e6


def made(strip: int) -> Unit:
    """Return a strip of 100 s at 60 m/s, to the east or the west."""
    rng, begin = np.random.default_rng(strip), strip * 200
    post_s = np.arange(0, STRIP_S + 1, POST_S)
    azimuth = np.pi / 2 * (1 if strip % 2 else -1)
    sigma = np.array([0.02, 0.02, 0.03, 1e-4, 1e-4, 2e-4])
    covariance = np.repeat(np.diag(sigma**2)[np.newaxis], len(post_s), axis=0)
    position = path_axes(azimuth)[:, 0] * 60.0 * post_s[:, np.newaxis] + [0.0, 200.0 * strip, 800.0]
    calibration = rng.standard_normal((ERRORS, 7)) * [0.01, 0.01, 0.01, 1e-4, 1e-4, 2e-4, 0.02]
    same = Correlation(1.0, 0.5, 0.0, 100.0)
    return Unit(
        strip,
        "left",
        begin * SECOND_NS,
        (begin + STRIP_S) * SECOND_NS,
        azimuth,
        (begin + post_s).astype(np.int64) * SECOND_NS,
        position,
        covariance,
        calibration,
        np.diag([0.005, 0.01, 0.008]) ** 2,
        (same, same, same),
        np.array([0.02, 2e-5, 1e-5]),
    )


def main() -> None:
    """Measure, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--points", type=int, default=500_000)
    parser.add_argument("--repeats", type=int, default=5)
    given, _ = parser.parse_known_args()
    fades = made(0).unmodelled_correlation[0]
    model, count = ErrorModel([made(strip) for strip in range(STRIPS)], [fades] * len(GROUPS)), given.points
    rng = np.random.default_rng(1)
    unit, other = rng.integers(0, STRIPS, (2, count))
    starts = np.array([one.start_ns for one in model.units])
    time_ns, other_ns = starts[unit] + rng.integers(0, STRIP_S * SECOND_NS, count), starts[other] + SECOND_NS
    places, others = rng.uniform(-2000.0, 2000.0, (2, count, 3)) * [1.0, 1.0, 0.02]
    figures = (
        ("points: 3 × 3 covariance", POINTS_PER_S, lambda: model.covariance(places, time_ns, unit)),
        (
            "pairs: 3 × 3 cross-covariance",
            PAIRS_PER_S,
            lambda: model.cross_covariance(places, time_ns, unit, others, other_ns, other),
        ),
        ("copy of the points", None, lambda: places.copy()),
    )
    for name, limit, work in figures:
        rate = count / cpu_seconds(work, given.repeats)
        verdict = "" if limit is None else f"   limit {limit / 1e6:.1f}: {'kept' if rate >= limit else 'MISSED'}"
        print(f"{name:32} {rate / 1e6:8.2f} M/s{verdict}")


if __name__ == "__main__":
    main()
