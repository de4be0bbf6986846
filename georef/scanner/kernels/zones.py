"""Pulses in air: find the earlier emission of an echo, return by return in the order of their records."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from swath.georef.arrays import FloatArray, Int64Array
from swath.georef.compiled import jit_cached, jit_inline

LIGHT_MPS = 299_792_458.0
GAP, AMBIGUOUS, NO_RETURN = -1, -2, -3  # in place of a zone
MEDIAN_OF, ONE_IN = 15, 4  # accepted returns in the median, of which one in four is used
BRIDGED = 4  # neighbours at most this far apart determine pulses without a return between them
DATAGRAM_BITS = 16  # of a pulse_id: the place in its datagram
SEGMENT = 1 << 20  # step in the ordinals of pulses after a break
FLATTEST_COS = 0.1  # limit for beams that look sideways or up, which no line scanner's ground returns do
STEPS = 256  # single steps after which the shortest and longest of them begin to be forgotten

# Columns of `pulses`, one row per known emission
ORDINAL, TICKS, PULSE_ID, CHANNEL = range(4)
# State of the pulse train
LAST_ORDINAL, LAST_TICKS, LAST_ID, PERIOD, LEAST, MOST, OLD_LEAST, OLD_MOST, SINGLES, COMPLETE = range(10)
STATE_SIZE = 10


@jit_inline
def ticks_of(time_ns: int, tick_hz: int) -> int:
    """Return the counter for a time that is floor(ticks · 10⁹ / tick_hz)."""
    seconds = time_ns // 1_000_000_000
    return seconds * tick_hz + ((time_ns - seconds * 1_000_000_000) * tick_hz + 999_999_999) // 1_000_000_000


@jit_inline
def note_step(state: Int64Array, ticks: int) -> None:
    """Record the time between two successive pulses: the extremes of the last few hundred."""
    state[PERIOD] = ticks
    state[LEAST], state[MOST] = min(state[LEAST], ticks), max(state[MOST], ticks)
    state[SINGLES] += 1
    if state[SINGLES] == STEPS:
        state[OLD_LEAST], state[OLD_MOST] = state[LEAST], state[MOST]
        state[LEAST], state[MOST], state[SINGLES] = ticks, ticks, 0


@jit_inline
def next_ordinal(state: Int64Array, pulse_id: Any, ticks: int) -> int:
    """Return the number of a pulse in the train; after a break it continues far ahead.

    Within a datagram the pulse_id counts. The datagram before ended with a pulse that may have had no return: the time
    gives the number of pulses in between, and has to be near a whole number of periods; if rows exist for every pulse,
    there were none in between.
    """
    last: int = state[LAST_ORDINAL]
    fresh = last + SEGMENT
    passed = ticks - state[LAST_TICKS]
    if last < 0 or passed <= 0:
        return fresh
    ahead = (pulse_id >> DATAGRAM_BITS) - (state[LAST_ID] >> DATAGRAM_BITS)
    if ahead == 0 and pulse_id > state[LAST_ID]:
        steps: int = pulse_id - state[LAST_ID]
        if steps == 1:
            note_step(state, passed)
        elif state[PERIOD] == 0:
            state[PERIOD] = passed // steps
        return last + steps
    place = pulse_id & ((1 << DATAGRAM_BITS) - 1)
    if state[COMPLETE] and ahead == 1 and place == 0:
        if state[PERIOD] == 0 or passed < 2 * state[PERIOD]:
            state[PERIOD] = passed  # without the laser's pauses
        return last + 1
    if ahead != 1 or state[PERIOD] == 0 or passed > (SEGMENT // 2) * state[PERIOD]:
        return fresh
    steps = math.floor(passed / state[PERIOD] + 0.5)
    if steps <= place or abs(passed - steps * state[PERIOD]) > max(state[PERIOD] // 4, steps):
        return fresh
    return last + steps


@jit_inline
def median_of(sorted_m: FloatArray, count: int) -> float:
    """Return the median of the first ``count`` values, which are in rising order."""
    median: float = sorted_m[count // 2]
    return median


@jit_inline
def push(sorted_m: FloatArray, ring_m: FloatArray, counts: Int64Array, value: float) -> None:
    """Insert a value into the running median's window, removing the oldest.

    ``counts`` holds the number of values, the position in the ring, and the values still to skip.
    """
    counts[2] -= 1
    if counts[2] > 0:
        return
    counts[2] = ONE_IN
    count, at = counts[0], counts[1]
    if count == MEDIAN_OF:
        place = np.searchsorted(sorted_m[:count], ring_m[at])
        for k in range(place, count - 1):
            sorted_m[k] = sorted_m[k + 1]
        count -= 1
    place = np.searchsorted(sorted_m[:count], value)
    for k in range(count, place, -1):
        sorted_m[k] = sorted_m[k - 1]
    sorted_m[place] = value
    ring_m[at] = value
    counts[0], counts[1] = count + 1, (at + 1) % MEDIAN_OF


@jit_inline
def even(state: Int64Array) -> bool:
    """Return whether pulses are evenly spaced: the times between two of them are then known to the tick."""
    widest = max(state[MOST], state[OLD_MOST])
    return bool(widest > 0 and widest - min(state[LEAST], state[OLD_LEAST]) <= 1)


@jit_inline
def add_pulse(
    pulses: Int64Array, angles_rad: FloatArray, known: int, state: Int64Array, ordinal: int, ticks: int, row: Any
) -> int:
    """Append an emission, and before it known ones without a return; return the number of known emissions.

    Between evenly spaced pulses ticks are exact, and the encoder deviates from the line by θ̈ t²/8 over a time t: 3
    µrad if two pulses at 100 kHz enclose a missing one of a ±30° sine at 50 Hz.
    """
    pulse_id, channel = np.int64(row.pulse_id), np.int64(row.channel)
    place = pulse_id & ((1 << DATAGRAM_BITS) - 1)
    before = known - 1
    steps = ordinal - state[LAST_ORDINAL]
    apart = ticks - state[LAST_TICKS]
    if known and 1 < steps <= BRIDGED and apart % steps == 0 and even(state) and pulses[before, CHANNEL] == channel:
        for k in range(1, steps):
            pulses[known, ORDINAL] = state[LAST_ORDINAL] + k
            pulses[known, TICKS] = state[LAST_TICKS] + k * (apart // steps)
            pulses[known, PULSE_ID] = pulse_id - (steps - k) if place >= steps - k else state[LAST_ID] + k
            pulses[known, CHANNEL] = channel
            angles_rad[known] = angles_rad[before] + k / steps * (row.encoder_rad - angles_rad[before])
            known += 1
    pulses[known, ORDINAL], pulses[known, TICKS] = ordinal, ticks
    pulses[known, PULSE_ID], pulses[known, CHANNEL] = pulse_id, channel
    angles_rad[known] = row.encoder_rad
    state[LAST_ORDINAL], state[LAST_TICKS], state[LAST_ID] = ordinal, ticks, pulse_id
    return known + 1


@jit_inline
def nearest_emission(
    pulses: Int64Array,
    angles_rad: FloatArray,
    known: int,
    apparent_m: float,
    expected_m: float,
    slanted: bool,
    scale: tuple[float, int],
) -> tuple[int, float]:
    """Return the emission with the range nearest to the expected one, and the excess of that range.

    The search goes back from the record's own emission, whose range is the shortest, until the range is longer than
    expected.

    Args:
        expected_m, slanted: the range; whether it is that at scan angle 0.
        scale: metres per tick; the longest time of flight in ticks.
    """
    best, best_miss = -1, math.inf
    ticks, ordinal = pulses[known - 1, TICKS], pulses[known - 1, ORDINAL]
    for at in range(known - 1, -1, -1):
        passed = ticks - pulses[at, TICKS]
        if passed > scale[1] or ordinal - pulses[at, ORDINAL] > SEGMENT // 2:
            break
        expected = expected_m / max(math.cos(angles_rad[at]), FLATTEST_COS) if slanted else expected_m
        miss = apparent_m + passed * scale[0] - expected
        if abs(miss) < abs(best_miss):
            best, best_miss = at, miss
        if miss > 0.0:
            break
    return best, best_miss


@jit_inline
def verdict(miss_m: float, period_m: float, margin: float, zone: int, apparent_m: float, blind_m: float) -> int:
    """Return the zone, or the code of the reason without one."""
    if abs(miss_m) > 0.5 * period_m:
        return GAP  # the expected emission is unknown
    if abs(miss_m) > (0.5 - margin) * period_m or (zone > 0 and apparent_m < blind_m):
        return AMBIGUOUS
    return zone


@jit_cached
def resolve_zones(
    rows: Any,
    predicted_m: FloatArray,
    pulses: Int64Array,
    angles_rad: FloatArray,
    known: int,
    state: Int64Array,
    median: tuple[FloatArray, FloatArray, Int64Array],
    tick_hz: int,
    scale: tuple[float, int],
    limits: tuple[float, float, float],
    slanted: bool,
    found: Int64Array,
    whole_m: FloatArray,
    angle_rad: FloatArray,
) -> int:
    """Find the emission of each return; see `swath.georef.scanner.ranging.ZoneResolver`.

    Args:
        rows: (n,) `RETURN_DTYPE`, in the order of their records.
        predicted_m: (n,) expected range at each row, nan if not given; or empty.
        pulses, angles_rad: (known + BRIDGED n, 4) emissions, the first ``known`` filled in; their encoder readings.
        state, median: kept from call to call; the median's values in order, as they came, their counts.
        scale: metres per tick; the longest time of flight in ticks.
        limits: expected range at first, nan: none; share of a zone beside its edges; blind range.
        slanted: ranges grow with 1/cos of the encoder's angle.
        found: (n, 5) gets zone (or the reason without one), ordinal, ticks, pulse_id and channel of the emission.
        whole_m, angle_rad: (n,) get its range and encoder reading.

    Returns:
        The number of known emissions.
    """
    first_m, margin, blind_m = limits
    sorted_m, ring_m, counts = median
    for i in range(len(rows)):
        row = rows[i]
        ticks, pulse_id = ticks_of(row.device_time_ns, tick_hz), np.int64(row.pulse_id)
        if known == 0 or pulse_id != state[LAST_ID] or ticks != state[LAST_TICKS]:
            ordinal = next_ordinal(state, pulse_id, ticks)
            known = add_pulse(pulses, angles_rad, known, state, ordinal, ticks, row)
        found[i, 0] = NO_RETURN
        if not row.range_m > 0.0 or row.number_of_returns == 0:
            continue
        expected = predicted_m[i] if len(predicted_m) else math.nan
        told = not math.isnan(expected)
        if not told:
            expected = median_of(sorted_m, counts[0]) if counts[0] else first_m
        found[i, 0] = AMBIGUOUS
        if math.isnan(expected):
            continue
        apparent, by_cosine = row.range_m, slanted and not told
        best, miss = nearest_emission(pulses, angles_rad, known, apparent, expected, by_cosine, scale)
        zone = state[LAST_ORDINAL] - pulses[best, ORDINAL]
        found[i, 0] = verdict(miss, state[PERIOD] * scale[0], margin, zone, apparent, blind_m)
        found[i, 1], found[i, 2] = pulses[best, ORDINAL], pulses[best, TICKS]
        found[i, 3], found[i, 4] = pulses[best, PULSE_ID], pulses[best, CHANNEL]
        whole_m[i] = apparent + (ticks - pulses[best, TICKS]) * scale[0]
        angle_rad[i] = angles_rad[best]
        if found[i, 0] >= 0:
            push(sorted_m, ring_m, counts, whole_m[i] * math.cos(angle_rad[i]) if slanted else whole_m[i])
    return known
