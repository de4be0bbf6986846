"""From slots to rows: datagrams keep a fixed number of places for returns, `ScannerReturns` has a row a return."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from georef.records import RETURN_DTYPE, StructArray

BLOCK_SLOTS = 32768  # slots worked on at once, so that the temporaries stay in the processor's second-level cache


@dataclass(frozen=True, slots=True)
class BeamColumns:
    """Columns of beams that are fired together, as the pulses of `ReturnSlots`: column by column, beam by beam.

    Attributes:
        beams: of a column.
        first_pulse_id: (columns,) of each column's first beam.
        per_column: further fields of `RETURN_DTYPE` that are the column's, each (columns,).
        chosen: (pulses,) which of the columns' beams the slots are of; None: all, in order.
    """

    beams: int
    first_pulse_id: NDArray[Any]
    per_column: dict[str, NDArray[Any]]
    chosen: NDArray[np.intp] | None = None

    def fill(self, rows: StructArray, pulse: NDArray[np.intp]) -> None:
        """Write what columns and beams say of the returns of these pulses; the beam is the channel."""
        place = pulse if self.chosen is None else self.chosen[pulse]
        column = place // self.beams
        beam = place - column * self.beams
        rows["channel"] = beam
        rows["pulse_id"] = self.first_pulse_id[column] + beam
        for name, values in self.per_column.items():
            rows[name] = values[column]


@dataclass(slots=True)
class ReturnSlots:
    """The places for returns of consecutive pulses, in the order of emission.

    Attributes:
        range_raw: (pulses, slots), the device's unit, 0 = no return, first return first.
        range_unit_m: metres of one raw unit.
        intensity: (pulses, slots).
        per_pulse: fields of `RETURN_DTYPE` that are the pulse's, each (pulses,) or one number for all.
        per_slot: further fields of the return itself, each (pulses, slots).
        columns: what columns of beams say of their pulses, in place of `per_pulse`.
    """

    range_raw: NDArray[Any]
    range_unit_m: float
    intensity: NDArray[Any]
    per_pulse: dict[str, NDArray[Any] | int]
    per_slot: dict[str, NDArray[Any]]
    columns: BeamColumns | None = None

    def fill(self, table: StructArray) -> int:
        """Write the returns there are, ordered by pulse, then by slot, to the head of ``table``; returns their number.

        Args:
            table: `RETURN_DTYPE`, at least as many rows as there are slots.
        """
        pulses, slots = self.range_raw.shape
        raw = self.range_raw.reshape(-1)
        index = np.flatnonzero(raw)
        all_there = len(index) == len(raw)
        rows = table[: len(index)]
        rows["range_m"] = (raw if all_there else raw[index]) * self.range_unit_m
        intensity = self.intensity.reshape(-1)
        rows["intensity"] = intensity if all_there else intensity[index]
        for name, values in self.per_slot.items():
            flat = values.reshape(-1)
            rows[name] = flat if all_there else flat[index]
        pulse = index if slots == 1 else index // slots
        whole = all_there and slots == 1
        for name, per_pulse in self.per_pulse.items():
            scalar = isinstance(per_pulse, int) or whole
            rows[name] = per_pulse if scalar else per_pulse[pulse]  # type: ignore[index]
        if self.columns is not None:
            self.columns.fill(rows, pulse)
        self._number(rows, index, pulse, pulses, slots)
        return len(index)

    def _number(
        self, rows: StructArray, index: NDArray[np.intp], pulse: NDArray[np.intp], pulses: int, slots: int
    ) -> None:
        """Fill return_number and number_of_returns by counting the slots that hold a return."""
        if slots == 1:
            rows["return_number"] = 1
            rows["number_of_returns"] = 1
            return
        number = np.empty((pulses, slots), dtype=np.uint8)
        count = np.zeros(pulses, dtype=np.uint8)
        for slot in range(slots):
            count += self.range_raw[:, slot] != 0
            number[:, slot] = count
        rows["return_number"] = number.reshape(-1)[index]
        rows["number_of_returns"] = count[pulse]


def returns_table(slots: int) -> StructArray:
    """A `RETURN_DTYPE` table for at most so many returns; what is not written to takes no memory."""
    return np.empty(slots, dtype=RETURN_DTYPE)
