"""Writes rows in one loop compiled by numba, with the same result as `ReturnSlots.fill`, which works by columns.

numba comes with ``swath[process]``. The recorder runs without it: this module is imported only where
`DeviceSettings.compiled` is set. Compiling takes about a second for each kind of slots, once where numba may keep it on
disk (beside this file, in the user's cache or in ``NUMBA_CACHE_DIR``), else in every process.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numba
import numpy as np

from swath.drivers.scanner.rows.slots import ReturnSlots
from swath.georef.arrays import StructArray
from swath.georef.records import RETURN_DTYPE, RETURN_FLAG_LAST, RETURN_FLAG_STRONGEST

# A row's last word is written as one number, starting from `slots.common_words`.
_WORDS = RETURN_DTYPE.itemsize // 8
_NUMBER_SHIFT, _COUNT_SHIFT = np.uint64(16), np.uint64(24)
_STRONGEST, _LAST = np.uint64(RETURN_FLAG_STRONGEST << 40), np.uint64(RETURN_FLAG_LAST << 40)
_NO_FLAG, _ONLY = np.uint64(0), _STRONGEST | _LAST
_ONE = np.uint64(1)
_NOT_NUMBERS = ~np.uint64(0xFFFF0000)


def fill(slots: ReturnSlots, table: StructArray) -> int:
    """Write the same rows as `ReturnSlots.fill`, bit for bit."""
    content, rule, width_unit_ns = slots.content[:, slots.others :], slots.rule, slots.pulse_width_unit_ns
    of_pulse = {
        name: np.broadcast_to(made_of(lambda values: values), slots.shape) for name, made_of in slots.per_pulse.items()
    }
    intensity = content["intensity"]
    return _written(
        table,
        table.view(np.uint64).reshape(-1, _WORDS),
        content["range"],
        slots.range_unit_m,
        intensity,
        intensity if width_unit_ns is None else content["pulse_width"],
        np.float32(0) if width_unit_ns is None else width_unit_ns,
        intensity if rule is None else rule.strength(content),
        _NO_FLAG if rule is None else _ONLY,
        _STRONGEST if rule is not None and rule.names_strongest else _NO_FLAG,
        _LAST if rule is not None and rule.names_last else _NO_FLAG,
        slots.pulse_id,
        np.broadcast_to(slots.common & _NOT_NUMBERS, slots.shape),
        of_pulse["host_time_ns"],
        of_pulse["device_time_ns"],
        of_pulse["encoder_rad"],
        of_pulse.get("channel"),
    )


def _rows_written(
    table: Any,
    words: Any,
    ranges: Any,
    range_unit_m: float,
    intensity: Any,
    pulse_width: Any,
    pulse_width_unit_ns: np.float32,
    strength: Any,
    of_an_only_one: np.uint64,
    of_the_strongest: np.uint64,
    of_the_last: np.uint64,
    pulse_id: Any,
    common: Any,
    host_time_ns: Any,
    device_time_ns: Any,
    encoder_rad: Any,
    channel: Any,
) -> int:
    """Write the rows and return their number.

    The slots are (m · n, s), values of pulses (m, n), ``pulse_id`` (m,); ``words`` are the table's words.
    """
    filled = np.uint64(0)  # unsigned, like the pulse: numba checks a signed index for counting from the end
    for i in range(host_time_ns.shape[0]):
        for j in range(host_time_ns.shape[1]):
            pulse = np.uint64(i * host_time_ns.shape[1] + j)
            count, number, best, of_best = np.uint64(0), np.uint64(0), 0, filled
            for slot in range(ranges.shape[1]):
                count += np.uint64(ranges[pulse, slot] != 0)
            if count == 0:
                continue
            last_word = common[i, j] | count << _COUNT_SHIFT
            if channel is not None:
                last_word |= np.uint64(channel[i, j])
            for slot in range(ranges.shape[1]):
                if ranges[pulse, slot] == 0:
                    continue
                number += _ONE
                if number == 1 or strength[pulse, slot] >= strength[pulse, best]:
                    best, of_best = slot, filled
                flags = _NO_FLAG
                if count == 1:
                    flags = of_an_only_one
                elif number == count and of_best == filled:
                    flags = of_the_strongest | of_the_last
                elif number == count:
                    words[of_best, _WORDS - 1] |= of_the_strongest
                    flags = of_the_last
                row = table[filled]
                row["host_time_ns"] = host_time_ns[i, j]
                row["device_time_ns"] = device_time_ns[i, j]
                row["range_m"] = ranges[pulse, slot] * range_unit_m
                row["encoder_rad"] = encoder_rad[i, j]
                row["pulse_id"] = pulse_id[i] + j
                row["intensity"] = intensity[pulse, slot]
                row["pulse_width_ns"] = pulse_width[pulse, slot] * pulse_width_unit_ns
                words[filled, _WORDS - 1] = last_word | number << _NUMBER_SHIFT | flags
                filled += _ONE
    return int(filled)


_njit: Any = numba.njit
_typeof: Any = numba.typeof
_writers: dict[tuple[Any, ...], Callable[..., int]] = {}


def _written(*arguments: Any) -> int:
    """Run `_rows_written`, compiled once for each kind of slots, for any shapes and strides of its arrays."""
    kind = tuple(getattr(argument, "dtype", type(argument)) for argument in arguments)
    writer = _writers.get(kind)
    if writer is None:
        writer = _writers[kind] = _compiled(arguments)
    return writer(*arguments)


def _compiled(arguments: tuple[Any, ...]) -> Callable[..., int]:
    """Compile for arguments of these types, and keep the result on disk where a folder is writable.

    By default numba would compile again for each combination of contiguous, strided and aligned arrays, and batches of
    one packet and of two differ in that.
    """
    table, words, *others = (_typeof(argument) for argument in arguments)
    signature = numba.types.int64(table, words, *(_any_strides(kind) for kind in others))
    compiled: Callable[..., int]
    try:
        compiled = _njit(signature, nogil=True, cache=True)(_rows_written)
    except RuntimeError:  # no folder is writable
        compiled = _njit(signature, nogil=True)(_rows_written)
    return compiled


def _any_strides(kind: Any) -> Any:
    if not isinstance(kind, numba.types.Array):
        return kind
    return numba.types.Array(kind.dtype, kind.ndim, "A", readonly=True, aligned=False)
