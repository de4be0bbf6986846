"""Find what gusts did to an aircraft: turn rates above 0.5 Hz, which no two flights over the same lines share.

Slower ones are those of the lines flown and the turns between them: another flight of the same plan has them too.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from swath.georef.timescales.gps_time import SECOND_NS
from swath.georef.trajectory.turn_rates import REACH_STEPS, STEP_NS

FloatArray = NDArray[np.float64]

GUSTS_HZ = (0.5, 2.5)  # faster than what autopilots and pilots steer, slower than what engines shake
ABOVE_HZ = (5.0, 9.5)  # noise and vibration alone
ABOVE_NOISE = 2.0  # rms of the former over that of the latter; noise alone has 0.7, so a ninth of the power is noise


def gusts(told: FloatArray, felt: FloatArray) -> tuple[FloatArray, FloatArray] | None:
    """Return rates (k, 3) of a trajectory and an IMU in the band of gusts, at the lag that suits best.

    A time that is off is judged elsewhere, and named.

    Args:
        told, felt: (m, 3) rad/s over the same steps.

    Returns:
        None where one of them has little but noise there, or does not reach so far: a smoothed or coarse trajectory,
        calm air, a rotor.
    """
    pair = []
    for rates in (told, felt):
        band, noise = _within(rates, GUSTS_HZ), _within(rates, ABOVE_HZ)
        if not (band**2).sum() > ABOVE_NOISE**2 * (noise**2).sum():
            return None
        pair.append(band)
    one, other = pair
    return _lagged(one, other, _best_lag(one, other))


def _best_lag(one: FloatArray, other: FloatArray) -> int:
    """Return by how many steps, at most `REACH_STEPS` and a half of all, the first is to be taken later."""
    spectra = (np.fft.rfft(rates, 2 * len(one), axis=0) for rates in (one, other))
    sums = np.fft.irfft(next(spectra) * np.conj(next(spectra)), 2 * len(one), axis=0).sum(axis=1)
    reach = min(REACH_STEPS, len(one) // 2)
    lags = np.arange(-reach, reach + 1)
    return int(lags[np.argmax(sums[lags])])


def _lagged(one: FloatArray, other: FloatArray, lag: int) -> tuple[FloatArray, FloatArray]:
    count = len(one) - abs(lag)
    return one[max(lag, 0) :][:count], other[max(-lag, 0) :][:count]


def _within(rates: FloatArray, band_hz: tuple[float, float]) -> FloatArray:
    """Return rates (m, 3) with the frequencies of a band alone."""
    spectrum = np.fft.rfft(rates, axis=0)
    hz = np.fft.rfftfreq(len(rates), STEP_NS / SECOND_NS)
    spectrum[(hz < band_hz[0]) | (hz > band_hz[1])] = 0.0
    kept: FloatArray = np.fft.irfft(spectrum, len(rates), axis=0)
    return kept
