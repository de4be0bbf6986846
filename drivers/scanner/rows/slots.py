"""Converts slots to rows: datagrams have a fixed number of slots for returns, `ScannerReturns` has a row for each
return.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from swath.georef.arrays import ByteArray, Int64Array, StructArray, UInt64Array
from swath.georef.records import RETURN_DTYPE, RETURN_FLAG_LAST, RETURN_FLAG_STRONGEST

# Slots processed at once: few enough that columns stay in the second-level cache, many enough that NumPy's cost of
# each call is negligible.
BLOCK_SLOTS = 32768

# Work is done column by column, where NumPy is fast, and rows are written once, in 64-bit words: columns of words are
# transposed. `common_words` are the last word of a row, with its fields from the channel on.
_WORDS = RETURN_DTYPE.itemsize // 8

Chosen: TypeAlias = Callable[[NDArray[Any]], NDArray[Any]]
Fill: TypeAlias = "Callable[[ReturnSlots, StructArray], int]"


@cache
def _place(name: str) -> tuple[int, np.dtype[np.void]]:
    """Return the word that contains a field, and the dtype of that word with this field."""
    fields = RETURN_DTYPE.fields
    assert fields is not None
    kind, at = fields[name][:2]
    return at // 8, np.dtype({"names": [name], "formats": [kind], "offsets": [at % 8], "itemsize": 8})


def _column(words: UInt64Array, name: str) -> NDArray[Any]:
    """Return a field of rows whose words are (words, rows)."""
    word, kind = _place(name)
    column: NDArray[Any] = words[word].view(kind)[name]
    return column


@dataclass(frozen=True, slots=True)
class FlagRule:
    """Rule for the flags of a pulse's returns, the nearer first; a single return is both strongest and last.

    Attributes:
        strength: strength of returns (n,), with the fields of `ReturnSlots.content`: the greatest is the strongest;
            those of a pulse are never equal.
        names_strongest: one of several is the strongest return, that of greatest strength.
        names_last: one of several is the last return, the farthest.
    """

    strength: Callable[[StructArray], NDArray[Any]]
    names_strongest: bool
    names_last: bool

    def flags(self, returns: StructArray, number: ByteArray, count: ByteArray, slots: int) -> ByteArray:
        """Return (n,) flags of consecutive returns, from their numbers and the counts of their pulses, which have at
        most so many slots.
        """
        strength = np.ascontiguousarray(self.strength(returns))
        return self._of_pairs(strength, number, count) if slots == 2 else self._of_many(strength, number, count)

    def _of_pairs(self, strength: NDArray[Any], number: ByteArray, count: ByteArray) -> ByteArray:
        # choices are multiplications by 0 or 1: np.where takes ten times as long on conditions that vary often
        second = (number[1:] == 2).view(np.uint8)
        near_strongest = (strength[:-1] > strength[1:]).view(np.uint8) * second
        strongest, last = np.uint8(RETURN_FLAG_STRONGEST * self.names_strongest), np.uint8(RETURN_FLAG_LAST)
        flags: ByteArray = (count == 1) * np.uint8(RETURN_FLAG_STRONGEST | RETURN_FLAG_LAST)
        flags[:-1] += near_strongest * strongest
        flags[1:] += (second - near_strongest) * strongest + second * (last * np.uint8(self.names_last))
        return flags

    def _of_many(self, strength: NDArray[Any], number: ByteArray, count: ByteArray) -> ByteArray:
        firsts = np.flatnonzero(number == 1)
        greatest = np.repeat(np.maximum.reduceat(strength, firsts), count[firsts]) if len(firsts) else strength
        alone = (count == 1).view(np.uint8)
        strongest = alone | (strength == greatest).view(np.uint8) * np.uint8(self.names_strongest)
        last = alone | (number == count).view(np.uint8) * np.uint8(self.names_last)
        flags: ByteArray = strongest * np.uint8(RETURN_FLAG_STRONGEST) + last * np.uint8(RETURN_FLAG_LAST)
        return flags


@dataclass(slots=True)
class ReturnSlots:
    """The slots for returns of consecutive pulses, in the order of emission.

    The pulses are m times n, for example packets and their pulses, so that a value of one dimension need not be
    repeated for all pulses: such arrays are (m, 1) or (1, n), others (m, n).

    Attributes:
        content: (pulses, slots), contiguous, of 4 or 8 bytes, which are gathered at once; fields ``range`` (the
            device's unit, 0 without a return), ``intensity`` and the fields that `rule` and `pulse_width_unit_ns` need.
        range_unit_m: metres of one raw unit.
        common: `common_words` of the pulses, an array of such a shape.
        shape: (m, n).
        pulse_id: (m,) id of the first of n pulses; the others count up from it.
        per_pulse: functions that make the fields of `RETURN_DTYPE` with one value for each pulse from such arrays,
            elementwise; each must first pass its arrays to its argument, which selects the values of the wanted pulses.
        rule: rule for the flags of returns in several slots, beside the common flags; None: no such flags.
        pulse_width_unit_ns: nanoseconds of a unit of the field ``pulse_width``; None: unknown.
        others: slots at the front of each pulse with other content.
    """

    content: StructArray
    range_unit_m: float
    common: UInt64Array
    shape: tuple[int, int]
    pulse_id: Int64Array
    per_pulse: Mapping[str, Callable[[Chosen], NDArray[Any]]]
    rule: FlagRule | None = None
    pulse_width_unit_ns: np.float32 | None = None
    others: int = 0

    def fill(self, table: StructArray) -> int:
        """Write all returns, ordered by pulse, then by slot, to the head of ``table``; return their number.

        Args:
            table: `RETURN_DTYPE`, with at least as many rows as slots.
        """
        slots, content = self.content.shape[1], self.content.reshape(-1)
        there = content["range"] != 0
        if self.others:
            there.reshape(-1, slots)[:, : self.others] = False
        index = np.flatnonzero(there)
        words = np.empty((_WORDS, len(index)), dtype=np.uint64)
        if slots == 1 and len(index) == len(content):
            self._write_all_pulses(words)
            returns = content
        else:
            pulse = index // slots if slots > 1 else index
            self._write_pulses(words, pulse)
            returns = content.take(index)
            if slots > 1:
                self._write_numbers(words, returns, *numbers_of(pulse, slots))
        self._write_returns(words, returns)
        table[: len(index)].view(np.uint64).reshape(-1, _WORDS)[:] = words.T
        return len(index)

    def _write_all_pulses(self, words: UInt64Array) -> None:
        """Write the values common to all returns of a pulse, where every pulse has one return."""
        words[-1].reshape(self.shape)[:] = self.common
        _column(words, "pulse_id").reshape(self.shape)[:] = self.pulse_id[:, np.newaxis] + np.arange(self.shape[1])
        for name, made_of in self.per_pulse.items():
            _column(words, name).reshape(self.shape)[:] = made_of(lambda values: values)

    def _write_pulses(self, words: UInt64Array, pulse: NDArray[np.intp]) -> None:
        """Write the values common to all returns of a pulse for these pulses, in order."""
        m, n = self.shape
        # pulses of a row are neighbours: repeating its value takes half as long as gathering it, unless it has one only
        counts = None if n == 1 else np.diff(pulse.searchsorted(np.arange(m + 1) * n))
        minor = np.zeros_like(pulse) if counts is None else pulse - np.repeat(np.arange(m) * n, counts)

        def of_rows(values: NDArray[Any]) -> NDArray[Any]:
            return values.take(pulse) if counts is None else np.repeat(values, counts)

        def chosen(values: NDArray[Any]) -> NDArray[Any]:
            if values.shape[1] == 1:
                return of_rows(values[:, 0])
            return values[0].take(minor) if len(values) == 1 else values.reshape(-1).take(pulse)

        words[-1] = chosen(self.common)
        np.add(of_rows(self.pulse_id), minor, out=_column(words, "pulse_id").view(np.int64))
        for name, made_of in self.per_pulse.items():
            _column(words, name)[:] = made_of(chosen)

    def _write_numbers(self, words: UInt64Array, returns: StructArray, number: ByteArray, count: ByteArray) -> None:
        """Write the number of each return, the count of its pulse, and the flags that follow from them."""
        # the two bytes after the channel
        words[-1].view("<u2")[1::4] = number | count.astype(np.uint16) << 8
        if self.rule is not None:
            flags = _column(words, "flags")
            flags |= self.rule.flags(returns, number, count, self.content.shape[1] - self.others)

    def _write_returns(self, words: UInt64Array, returns: StructArray) -> None:
        """Write the values of each single return."""
        np.multiply(returns["range"], self.range_unit_m, out=_column(words, "range_m"))
        _column(words, "intensity")[:] = returns["intensity"]
        width = _column(words, "pulse_width_ns")
        if self.pulse_width_unit_ns is None:
            width[:] = 0
        else:
            np.multiply(returns["pulse_width"], self.pulse_width_unit_ns, out=width)


def numbers_of(pulse: NDArray[np.intp], slots: int) -> tuple[ByteArray, ByteArray]:
    """Return return_number and number_of_returns of returns in the order of their pulses; ``slots`` is the maximum of a
    pulse.
    """
    number, count = np.ones((2, len(pulse)), dtype=np.uint8)
    for lag in range(1, slots):
        same = (pulse[lag:] == pulse[:-lag]).view(np.uint8)
        number[lag:] += same
        count[lag:] += same
        count[:-lag] += same
    return number, count


def in_order(one: NDArray[Any], other: NDArray[Any]) -> NDArray[Any]:
    """Return pairs (n, 2), the lesser number first."""
    pairs = np.empty((len(one), 2), dtype=one.dtype)
    np.minimum(one, other, out=pairs[:, 0])
    np.maximum(one, other, out=pairs[:, 1])
    return pairs


def common_words(
    shape: tuple[int, int], channel: ArrayLike = 0, mta_zone: ArrayLike = 0, flags: ArrayLike = 0
) -> UInt64Array:
    """Return the last words of rows of pulses that have one return."""
    rows = np.zeros(shape, dtype=RETURN_DTYPE)
    rows["return_number"] = rows["number_of_returns"] = 1
    rows["channel"], rows["mta_zone"], rows["flags"] = channel, mta_zone, flags
    return rows.view(np.uint64).reshape(*shape, _WORDS)[..., -1]


def returns_table(slots: int) -> StructArray:
    """Return a `RETURN_DTYPE` table for at most ``slots`` returns; rows that are never written take no memory."""
    return np.empty(slots, dtype=RETURN_DTYPE)
