"""Makes the error model of a flight from samples of its returns and from the trajectory's joint covariance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from swath.georef.arrays import FloatArray, Int64Array
from swath.georef.error_model.accuracy import principal_root
from swath.georef.error_model.correlation import Correlation, Fitted, fit
from swath.georef.error_model.model import GROUP_OF, GROUPS, OFFSETS, offset_columns, path_axes, post_roots
from swath.georef.timescales import SECOND_NS

LASTS = Correlation(1.0, 0.999, 0.0, 1e6)  # over any distance in a strip
LEAST_UNMODELLED_M = 1e-4  # a sigma below which it is left out
RANK = 1e-6  # of offsets that a strip's narrow view does not tell apart
BINS = 100
MOST_PAIRS = 60_000


@dataclass(frozen=True, eq=False)
class Sample:
    """Returns that stand for all those of a unit, n of them; vectors in m.

    Attributes:
        points_m: (n, 3).
        position_m: (n, 3) of the body at their emission.
        calibration_m: (n, q, 3) effect on the point of one sigma of each independent error of the calibration.
        noise_m: (n, e, 3) effect of one sigma of each of a return's own errors: range, angles.
    """

    points_m: FloatArray
    position_m: FloatArray
    calibration_m: FloatArray
    noise_m: FloatArray

    @property
    def beam_m(self) -> FloatArray:
        """Beams (n, 3) from the body to the points."""
        return self.points_m - self.position_m


def offsets_of(sample: Sample, azimuth_rad: float) -> tuple[FloatArray, FloatArray]:
    """Return offsets (q, 7) by each of the calibration's errors, and what they leave (n, q, 3), by least squares.

    The angles weigh as the metres that they make at the mean range; of offsets that the returns do not tell apart, the
    smallest are taken.
    """
    beam = sample.beam_m
    scale = np.ones(OFFSETS)
    scale[3:6] = 1.0 / float(np.linalg.norm(beam, axis=1).mean())
    columns = offset_columns(beam, azimuth_rad)
    design = (columns * scale).reshape(-1, OFFSETS)
    effects = sample.calibration_m.transpose(0, 2, 1).reshape(len(design), -1)
    found = np.linalg.lstsq(design, effects, rcond=RANK)[0].T * scale
    return found, sample.calibration_m - np.einsum("nij,qj->nqi", columns, found)


def unmodelled_of(
    sample: Sample, left_m: FloatArray, azimuth_rad: float
) -> tuple[FloatArray, tuple[Correlation, Correlation, Correlation]]:
    """Return the covariance (3, 3) in the path system of what offsets leave, and its correlations along u, v, w.

    Args:
        sample: of the unit.
        left_m: (n, q, 3) effects that the offsets leave.
        azimuth_rad: of the path.

    What the offsets leave depends on the beam's direction across the path: it lasts along the path and fades across it.
    """
    axes = path_axes(azimuth_rad)
    left = left_m @ axes
    covariance = np.einsum("nqi,nqj->ij", left, left) / max(len(left), 1)
    if np.trace(covariance) < LEAST_UNMODELLED_M**2:
        return np.zeros((3, 3)), (LASTS, LASTS, LASTS)
    rng = np.random.default_rng(0)
    i, j = rng.integers(0, len(left), (2, MOST_PAIRS))
    across = sample.beam_m @ axes[:, 1]
    apart = np.abs(across[i] - across[j])
    whiten = np.linalg.pinv(principal_root(covariance), rcond=1e-3, hermitian=True)
    white = left @ whiten
    shared = np.einsum("nqi,nqi->n", white[i], white[j]) / max(
        float(np.einsum("nqi,nqi->", white, white)) / len(left), 1e-30
    )
    lag, mean = _binned(apart, shared)
    return covariance, (LASTS, fit(lag, mean, smooth=True).correlation if len(lag) > 1 else LASTS, LASTS)


def noise_of(sample: Sample, azimuth_rad: float) -> FloatArray:
    """Return sigmas (3,) of single returns: along the beam (m), and at right angles to it across and along (rad)."""
    beam = sample.beam_m
    far = np.linalg.norm(beam, axis=1)
    unit = beam / far[:, np.newaxis]
    forward = path_axes(azimuth_rad)[:, 0] - unit * (unit @ path_axes(azimuth_rad)[:, 0])[:, np.newaxis]
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    side = np.cross(unit, forward)
    square = [np.square(np.einsum("nei,ni->ne", sample.noise_m, axis)).sum(axis=1) for axis in (unit, side, forward)]
    return np.sqrt([square[0].mean(), (square[1] / far**2).mean(), (square[2] / far**2).mean()])


def correlations_in_time(
    time_ns: Int64Array, covariance: FloatArray, azimuth_rad: FloatArray, noise: FloatArray
) -> list[Fitted]:
    """Fit the correlation in time of each of `GROUPS` to a joint covariance.

    Args:
        time_ns: (k,) GPS times, rising.
        azimuth_rad: (k,) of the path at these times.
        noise: of a return, along the beam (m) and across (rad), …: errors smaller than it need no exact fit.
        covariance: (6k, 6k) of position in m and small turns about m's axes, of each time after the other.
    """
    count = len(time_ns)
    blocks = covariance.reshape(count, 6, count, 6).transpose(0, 2, 1, 3)
    root = post_roots(blocks[np.arange(count), np.arange(count)], azimuth_rad)
    white = np.linalg.pinv(root, rcond=1e-6)
    i, j = np.triu_indices(count, 1)
    crossed = np.einsum("pab,pbc,pdc->pad", white[i], blocks[i, j], white[j])
    lag_s = (time_ns[j] - time_ns[i]) / SECOND_NS
    fitted = []
    for group in range(len(GROUPS)):
        components = [component for component, of in enumerate(GROUP_OF) if of == group]
        mean = np.mean([crossed[:, component, component] for component in components], axis=0)
        sigma = float(np.sqrt(np.mean([blocks[k, k, c, c] for k in range(count) for c in components])))
        near_one = min(1.0, (noise[int(components[0] >= 3)] / max(sigma, 1e-12)) ** 2)
        fitted.append(fit(*_binned(lag_s, mean), near_one=near_one))
    return fitted


def _binned(lag: FloatArray, value: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return mean lags and values of bins that become wider with the lag."""
    some = lag > 0.0
    lag, value = lag[some], value[some]
    if not len(lag):
        return np.zeros(0), np.zeros(0)
    edges = np.unique(np.quantile(lag, np.linspace(0.0, 1.0, BINS) ** 2))
    place = np.clip(np.searchsorted(edges, lag, side="right") - 1, 0, len(edges) - 1)
    count = np.bincount(place).astype(np.float64)
    there = count > 0
    return np.bincount(place, lag)[there] / count[there], np.bincount(place, value)[there] / count[there]


def turned_to_map(covariance_l: FloatArray, rot_m_from_l: FloatArray) -> FloatArray:
    """Return covariances (…, 6, 6) of position and small turns in l as those in m."""
    turn = np.zeros((6, 6))
    turn[:3, :3] = turn[3:, 3:] = rot_m_from_l
    turned: FloatArray = turn @ covariance_l @ turn.T
    return turned


def joint_turned(covariance_l: FloatArray, rot_m_from_l: FloatArray) -> FloatArray:
    """Return a joint covariance (6k, 6k) in l as that in m."""
    count = len(covariance_l) // 6
    blocks = covariance_l.reshape(count, 6, count, 6).transpose(0, 2, 1, 3)
    turned: FloatArray = turned_to_map(blocks, rot_m_from_l).transpose(0, 2, 1, 3).reshape(6 * count, 6 * count)
    return turned


def azimuth_of(position_m: FloatArray) -> float:
    """Return the azimuth of a path's positions (k, 3), from its first to its last, clockwise from northing, rad."""
    east, north = (position_m[-1] - position_m[0])[:2]
    return float(np.arctan2(east, north))


def exponentials(tau_s: Sequence[float]) -> list[Correlation]:
    """Return the correlations of Gauss–Markov errors with e-folding times, s, by `GROUPS`."""
    return [Correlation(1.0, 0.0, 0.0, float(tau)) for tau in tau_s]
