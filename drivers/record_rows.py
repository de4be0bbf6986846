"""Rows of array records: collected one message at a time and joined with their neighbours."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

from swath.georef.records import IMU_DTYPE, INS_DTYPE, ImuSamples, InsSolution, Record

_SENT = [name for name in IMU_DTYPE.names or () if name != "time_sigma_s"]
_SENT_DTYPE = np.dtype([(name, IMU_DTYPE[name]) for name in _SENT], align=True)


class Row(NamedTuple):
    """One row of an array record, its fields in the order of the record's dtype; of samples without ``time_sigma_s``,
    which is then 0.
    """

    record: type[ImuSamples] | type[InsSolution]
    values: tuple[Any, ...]


def join_rows(items: Iterable[Record | Row], wanted: tuple[type, ...] | None = None) -> list[Record]:
    """Return the records of the wanted types (None: all) in order; neighbouring rows of one kind become one array."""
    records: list[Record] = []
    run: list[Row] = []
    for item in items:
        if wanted is not None and (item.record if isinstance(item, Row) else type(item)) not in wanted:
            continue
        if run and not (isinstance(item, Row) and item.record is run[0].record):
            records.append(_array(run))
            run = []
        if isinstance(item, Row):
            run.append(item)
        else:
            records.append(item)
    return [*records, _array(run)] if run else records


def _array(run: list[Row]) -> Record:
    """Convert rows of one kind to one record."""
    values: list[Any] = [row.values for row in run]
    if run[0].record is ImuSamples:
        rows = np.zeros(len(values), IMU_DTYPE)
        rows[_SENT] = np.array(values, dtype=_SENT_DTYPE)
        return ImuSamples(rows)
    return InsSolution(np.array(values, dtype=INS_DTYPE))
