"""From slots to rows: datagrams keep a fixed number of places for returns, `ScannerReturns` has a row a return."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from georef.records import RETURN_DTYPE, StructArray

# Slots worked on at once: so few that columns stay in the second-level cache, so many that what NumPy spends on each
# call does not count.
BLOCK_SLOTS = 32768

# Work is done column by column, where NumPy is quick, and rows are written once, in 64-bit words: columns of words are
# transposed. `common_words` are the last of a row, its fields from the channel on.
_WORDS = RETURN_DTYPE.itemsize // 8


@cache
def _place(name: str) -> tuple[int, np.dtype[np.void]]:
    """The word a field is in, and that word as a table of this field."""
    kind, at = RETURN_DTYPE.fields[name][:2]  # type: ignore[index]
    return at // 8, np.dtype({"names": [name], "formats": [kind], "offsets": [at % 8], "itemsize": 8})


def _column(words: NDArray[np.uint64], name: str) -> NDArray[Any]:
    """A field of rows whose words are (words, rows)."""
    word, kind = _place(name)
    column: NDArray[Any] = words[word].view(kind)[name]
    return column


@dataclass(slots=True)
class ReturnSlots:
    """The places for returns of consecutive pulses, in the order of emission.

    The pulses are m times n, for example packets and their pulses, so that what only one of the two tells need not be
    spread over all pulses: such arrays are (m, 1) or (1, n), others (m, n). Arrays of slots have one row for all
    pulses' first slots, one for their second …: long rows are what NumPy is quick with.

    Attributes:
        range_raw: (slots, pulses), the device's unit, 0 = no return, first return first.
        range_unit_m: metres of one raw unit.
        intensity: (slots, pulses).
        common: `common_words` of the pulses, an array as those of ``per_pulse``.
        shape: (m, n).
        per_pulse: fields of `RETURN_DTYPE` that are the pulse's, each the sum of these arrays.
        per_slot: further fields of the return itself, each (slots, pulses).
    """

    range_raw: NDArray[Any]
    range_unit_m: float
    intensity: NDArray[Any]
    common: NDArray[np.uint64]
    shape: tuple[int, int]
    per_pulse: Mapping[str, tuple[NDArray[Any], ...]]
    per_slot: Mapping[str, NDArray[Any]]

    def fill(self, table: StructArray) -> int:
        """Write the returns there are, ordered by pulse, then by slot, to the head of ``table``; returns their number.

        Args:
            table: `RETURN_DTYPE`, at least as many rows as there are slots.
        """
        slots, pulses = self.range_raw.shape
        there = np.empty((pulses, slots), dtype=np.bool_)
        np.not_equal(self.range_raw, 0, out=there.T)
        index = np.flatnonzero(there)
        words = np.empty((_WORDS, len(index)), dtype=np.uint64)
        if slots == 1 and len(index) == pulses:
            self._write_all_pulses(words)
            self._write_slots(words, slice(None))
        else:
            pulse, place = index, index
            if slots > 1:
                pulse = index // slots
                place = (index - pulse * slots) * pulses + pulse
            self._write_pulses(words, pulse)
            self._write_slots(words, place)
            if slots > 1:  # the two bytes after the channel's
                words[-1].view("<u2")[1::4] = _numbers(self.range_raw != 0).reshape(-1)[place]
        table[: len(index)].view(np.uint64).reshape(-1, _WORDS)[:] = words.T
        return len(index)

    def _write_all_pulses(self, words: NDArray[np.uint64]) -> None:
        """What all returns of a pulse have in common, where every pulse has one."""
        words[-1].reshape(self.shape)[:] = self.common
        for name, parts in self.per_pulse.items():
            _column(words, name).reshape(self.shape)[:] = sum(parts[1:], start=parts[0])

    def _write_pulses(self, words: NDArray[np.uint64], pulse: NDArray[np.intp]) -> None:
        """The same of these pulses."""
        n = self.shape[1]
        major = pulse // n
        minor = pulse - major * n

        def chosen(values: NDArray[Any]) -> NDArray[Any]:
            if values.shape[1] == 1:
                return values[:, 0].take(major)
            return values[0].take(minor) if len(values) == 1 else values.reshape(-1).take(pulse)

        words[-1] = chosen(self.common)
        for name, parts in self.per_pulse.items():
            _column(words, name)[:] = sum(map(chosen, parts[1:]), start=chosen(parts[0]))

    def _write_slots(self, words: NDArray[np.uint64], place: NDArray[np.intp] | slice) -> None:
        """What is the return's own, of the slots at these places."""
        np.multiply(self.range_raw.reshape(-1)[place], self.range_unit_m, out=_column(words, "range_m"))
        _column(words, "intensity")[:] = self.intensity.reshape(-1)[place]
        if "pulse_width_ns" not in self.per_slot:
            _column(words, "pulse_width_ns")[:] = 0
        for name, values in self.per_slot.items():
            _column(words, name)[:] = values.reshape(-1)[place]


def _numbers(there: NDArray[np.bool_]) -> NDArray[np.uint16]:
    """return_number and, in the high byte, number_of_returns of slots (slots, pulses)."""
    numbers = np.empty(there.shape, dtype=np.uint16)
    count = np.zeros(there.shape[1], dtype=np.uint16)
    for slot, number in zip(there, numbers, strict=True):
        count += slot
        number[:] = count
    numbers |= count << 8
    return numbers


def common_words(
    shape: tuple[int, int], channel: ArrayLike = 0, mta_zone: ArrayLike = 0, flags: ArrayLike = 0
) -> NDArray[np.uint64]:
    """Last words of the rows of pulses that have one return."""
    rows = np.zeros(shape, dtype=RETURN_DTYPE)
    rows["return_number"] = rows["number_of_returns"] = 1
    rows["channel"], rows["mta_zone"], rows["flags"] = channel, mta_zone, flags
    return rows.view(np.uint64).reshape(*shape, _WORDS)[..., -1]


def returns_table(slots: int) -> StructArray:
    """A `RETURN_DTYPE` table for at most so many returns; what is not written to takes no memory."""
    return np.empty(slots, dtype=RETURN_DTYPE)
