"""Decide the fate of an observation: taken, taken with a larger sigma, refused, or taken against the state.

A χ² gate bounds the innovation of a sound observation. Beyond it either the observation is worse than its sigma or the
state is worse than its covariance, and the two need opposite treatment: an outlier must not move the state, and a state
that has drifted must be moved. The state's share of the innovation's covariance and the innovations before decide which
of the two applies.
"""

from __future__ import annotations

import math

from swath.georef.arrays import FloatArray
from swath.georef.compiled import jit_inline
from swath.georef.navigation.filter.error_model import E_ATTITUDE, E_POSITION, E_VELOCITY, Layout
from swath.georef.navigation.filter.types import (
    ALIKE,
    COUNT,
    LEAPT_NS,
    MEAN,
    NOW,
    SEEN,
    SETTLED_NS,
    SINCE_NS,
    SOUND_NS,
    TAKEN_NS,
    WHITE,
    Model,
    Running,
)
from swath.georef.navigation.inputs import Fate, Kind

_TAKEN, _INFLATED, _REJECTED, _REACQUIRED = (
    int(Fate.TAKEN),
    int(Fate.INFLATED),
    int(Fate.REJECTED),
    int(Fate.REACQUIRED),
)
_POSITION, _VELOCITY, _HEADING = int(Kind.POSITION), int(Kind.VELOCITY), int(Kind.HEADING)
_HEIGHT, _ATTITUDE = int(Kind.HEIGHT), int(Kind.ATTITUDE)

STEADY, FEW = 30.0, 5.0  # observations behind a mean; number from which on it counts
TOLERATED = 1.5  # mean χ² per component that chance may give
PERSISTENT = 0.5  # share of the mean χ² that the mean product of neighbours must exceed to count as correlated
DRIFTED = 10.0  # an innovation's variance over the observation's own
LEAP_NS = 2_500_000_000  # positions farther apart in time than this may differ by the state's drift
PATIENCE = 6  # times `reacquire_ns` for which a leap is taken for a wrong fix
SETTLING = 25.0  # factor on χ² beyond which even a settling state refuses an observation


@jit_inline
def widen(run: Running, kind: int, layout: Layout, nu: FloatArray, m: int) -> bool:
    """Widen the covariance to the size of the innovation; return False if this kind cannot test the state."""
    square = 0.0
    for i in range(m):
        square = max(square, nu[i] * nu[i])
    since_s = max(1e-9 * (run.clock[NOW] - run.refused[TAKEN_NS, kind]), 1.0)
    first = -1
    if kind == _POSITION:
        first = E_POSITION
        for i in range(3):
            run.p[E_VELOCITY + i, E_VELOCITY + i] += square / (since_s * since_s)
    elif kind == _VELOCITY:
        first = E_VELOCITY
    elif kind == _HEADING or kind == _ATTITUDE:
        first = E_ATTITUDE
    elif kind == _HEIGHT and layout.height_bias >= 0:
        run.p[layout.height_bias, layout.height_bias] += square
        return True
    if first < 0:
        return False
    for i in range(3):
        run.p[first + i, first + i] += square
    return True


@jit_inline
def drifted(kind: int, s: FloatArray, noise: FloatArray, m: int) -> bool:
    """Return whether the state's share of an innovation's covariance is large enough to explain a large innovation."""
    if not (kind == _POSITION or kind == _VELOCITY or kind == _HEADING or kind == _ATTITUDE):
        return False
    whole, own = 0.0, 0.0
    for i in range(m):
        whole += s[i, i]
        own += noise[i, i]
    return whole > DRIFTED * own


@jit_inline
def noise_factor(run: Running, kind: int, white: FloatArray, chi2: float, m: int, limit: float) -> float:
    """Return the factor that the latest innovations of a kind imply for this one, and add this one to them.

    Two means are kept over about `STEADY` observations: χ² per component, and the product of neighbours. Innovations
    that are too large and uncorrelated mean that observations are worse than their sigmas; too large and correlated,
    that the state is worse than its covariance.

    Returns:
        Factor on the covariance of the observation; 0: the state is the cause.
    """
    lately = run.lately
    mean, count, alike = lately[MEAN, kind], lately[SEEN, kind], lately[ALIKE, kind]
    weight, bounded, product = 1.0 / min(count + 1.0, STEADY), min(chi2, limit), 0.0
    shrunk = math.sqrt(bounded / chi2) if bounded < chi2 else 1.0
    for i in range(m):
        product += shrunk * white[i] * lately[WHITE + i, kind]
        lately[WHITE + i, kind] = shrunk * white[i]
    lately[SEEN, kind] = count + 1.0
    lately[MEAN, kind] += weight * (bounded / m - mean)
    lately[ALIKE, kind] += weight * (product / m - alike)
    if mean <= TOLERATED or count < FEW:
        return 1.0
    return 0.0 if alike > PERSISTENT * mean else mean


@jit_inline
def settling(run: Running, model: Model, kind: int, lost: bool, chi2: float, m: int) -> bool:
    """Return whether the state has drifted more than predicted, or began with such an error, and is still settling.

    Settling lasts `reacquire_ns`, because velocity and attitude, corrected by a wrong covariance, take that long.
    During it observations are taken unchanged; the smoother spreads the drift over the time without them.
    """
    if lost and chi2 > model.rules.gate[m]:
        run.refused[SETTLED_NS, kind] = run.clock[NOW] + model.reacquire_ns
    return bool(run.clock[NOW] < run.refused[SETTLED_NS, kind])


@jit_inline
def still_away(run: Running, model: Model, kind: int, chi2: float, m: int) -> bool:
    """Return whether positions that leapt away are still beyond the gate, however uncertain the state has become.

    Without velocities the state is less certain after a few seconds than the positions, and would be blamed for the
    leap.
    """
    since = run.refused[LEAPT_NS, kind]
    if kind != _POSITION or since == 0 or chi2 <= model.rules.gate[m]:
        return False
    return bool(run.clock[NOW] - since <= PATIENCE * model.reacquire_ns)


@jit_inline
def leapt(run: Running, model: Model, kind: int, settles: bool, chi2: float, m: int) -> bool:
    """Return whether positions stay far off after a leap, from within the gate, between one epoch and the next.

    A wrong fix behaves like this. A state that is worse than its covariance leaves the gate slowly, and a state that
    was known little better than the positions is itself the cause. A leap that lasts longer than a wrong fix may is
    judged like any other observation.
    """
    refused, now, gate = run.refused, run.clock[NOW], model.rules.gate[m]
    if kind != _POSITION:
        return False
    if settles or chi2 <= gate * model.rules.reject:
        refused[LEAPT_NS, kind] = 0
        refused[SOUND_NS, kind] = now if chi2 <= gate else 0
        return False
    if refused[SOUND_NS, kind] > 0 and now - refused[SOUND_NS, kind] <= LEAP_NS:
        refused[LEAPT_NS, kind] = now
    refused[SOUND_NS, kind] = 0
    since = refused[LEAPT_NS, kind]
    return bool(since > 0 and now - since <= PATIENCE * model.reacquire_ns)


@jit_inline
def judge(run: Running, model: Model, kind: int, settles: bool, chi2: float, m: int) -> int:
    """Return the fate of an innovation by its χ² and by the number of refusals of its kind before it."""
    gate = model.rules.gate[m]
    refused = run.refused
    if chi2 <= gate * model.rules.reject * (SETTLING if settles else 1.0):
        refused[COUNT, kind], refused[TAKEN_NS, kind] = 0, run.clock[NOW]
        if chi2 <= gate:
            return _TAKEN
        return _REACQUIRED if settles else _INFLATED
    if refused[COUNT, kind] == 0:
        refused[SINCE_NS, kind] = run.clock[NOW]
    refused[COUNT, kind] += 1
    long = run.clock[NOW] - refused[SINCE_NS, kind] >= model.reacquire_ns
    if not long or refused[COUNT, kind] <= model.reacquire_after:
        return _REJECTED
    if not widen(run, kind, model.layout, run.small[0], m):
        return _REJECTED
    refused[COUNT, kind], refused[TAKEN_NS, kind] = 0, run.clock[NOW]
    refused[SETTLED_NS, kind] = run.clock[NOW] + model.reacquire_ns
    return _REACQUIRED
