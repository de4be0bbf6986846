"""Growing blocks for the filter's output: a path row per sample, a node and its components, the fates of rows."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from swath.georef.arrays import Int64Array, StructArray
from swath.georef.navigation.filter.error_model import MOVED, Layout
from swath.georef.navigation.filter.strapdown import STATE_SIZE
from swath.georef.navigation.filter.types import (
    CHI2,
    INFLATION,
    LOG_DET,
    NODE,
    OUT,
    SCALAR,
    TOLD_SIZE,
    Nodes,
    Path,
    Rows,
    Told,
)
from swath.georef.navigation.inputs import INNOVATION_DTYPE, OBSERVATION_DTYPE, Fate

PATH_ROWS = 4096
BLOCK_NODES = 1024
LATEST_ROWS = 1000


class Storage:
    """The place of a run's arrays: memory, unless the caller provides another one (files, for a long flight)."""

    def empty(self, shape: tuple[int, ...], dtype: Any) -> NDArray[Any]:
        """Return an array with undefined contents."""
        return np.empty(shape, dtype)

    def rest(self) -> None:
        """Free memory that can be read again; called now and then, between pieces of work."""


IN_MEMORY = Storage()


class PathStore:
    """Blocks of path rows; the clock's OUT counts within the last.

    Args:
        clock: the filter's.
        storage: where blocks are kept.
        expected: the number of rows to come, if known: they become one block.
    """

    def __init__(self, clock: Int64Array, storage: Storage, expected: int = 0) -> None:
        self._clock, self._storage, self._expected = clock, storage, expected
        self._full: list[Path] = []
        self._block = _path(0, IN_MEMORY)

    def room(self, rows: int) -> Path:
        """Return a block with room for this many more rows."""
        if len(self._block.time_ns) - int(self._clock[OUT]) < rows:
            self._full.append(_cut(self._block, int(self._clock[OUT])))
            self._block = _path(max(rows, PATH_ROWS, self._expected), self._storage)
            self._expected = 0
            self._clock[OUT] = 0
        return self._block

    def whole(self) -> Path:
        """Return all rows so far."""
        parts = [part for part in [*self._full, _cut(self._block, int(self._clock[OUT]))] if len(part.time_ns)]
        if len(parts) == 1:
            return parts[0]
        if not parts:
            return _path(0, IN_MEMORY)
        return Path._make(np.concatenate(columns) for columns in zip(*parts, strict=True))

    def taken(self) -> Path:
        """Return all rows so far, and drop them."""
        whole = Path._make(column.copy() for column in self.whole())
        self._full.clear()
        self._clock[OUT] = 0
        return whole


class NodeStore:
    """Blocks of nodes; the clock's NODE and SCALAR count within the last.

    Attributes:
        kept: False: blocks are dropped, for a filter whose path is not smoothed.
    """

    def __init__(self, clock: Int64Array, layout: Layout, storage: Storage, *, kept: bool = True) -> None:
        self._clock, self._layout, self._storage, self.kept = clock, layout, storage, kept
        self._full: list[Nodes] = []
        self._block = _nodes(0, 0, layout, IN_MEMORY)

    def room(self, nodes: int, components: int) -> Nodes:
        """Return a block with room for this many more nodes and components."""
        if not self.kept:
            self._clock[NODE] = self._clock[SCALAR] = 0
        free = len(self._block.time_ns) - int(self._clock[NODE])
        if free < nodes or len(self._block.h) - int(self._clock[SCALAR]) < components:
            if self.kept:
                self._full.append(self._used())
            self._block = _nodes(max(nodes, BLOCK_NODES), max(components, 3 * BLOCK_NODES), self._layout, self._storage)
            self._clock[NODE] = self._clock[SCALAR] = 0
        return self._block

    def blocks(self) -> list[Nodes]:
        """Return all blocks so far, in order; `first` counts within each block."""
        return [block for block in [*self._full, self._used()] if len(block.time_ns)]

    def _used(self) -> Nodes:
        nodes, components = int(self._clock[NODE]), int(self._clock[SCALAR])
        cut = [column[:nodes] for column in self._block[:7]] + [column[:components] for column in self._block[7:]]
        return Nodes._make(cut)


class RowQueue:
    """Observations that wait for samples, and the fates of those that no longer wait.

    Args:
        kept: False: only about the latest `LATEST_ROWS` fates are kept, for a filter that runs without end.

    Attributes:
        fates: number of rows by kind and fate, all of them counted.
    """

    def __init__(self, *, kept: bool = True) -> None:
        self._waiting = np.zeros(0, OBSERVATION_DTYPE)
        self._told: list[StructArray] = []
        self._kept = kept
        self.fates: Counter[tuple[int, int]] = Counter()

    def add(self, rows: StructArray, not_before_ns: int) -> None:
        """Insert rows into the queue by time; mark those before the filter's time as outside."""
        late = rows["time_ns"] < not_before_ns
        self.refuse(rows[late])
        both = np.concatenate([self._waiting, rows[~late]])
        self._waiting = both[np.lexsort((both["antenna"], both["kind"], both["time_ns"]))]

    def until(self, time_ns: int) -> StructArray:
        """Remove the rows up to a time from the queue and return them."""
        count = int(np.searchsorted(self._waiting["time_ns"], time_ns, side="right"))
        due, self._waiting = self._waiting[:count], self._waiting[count:]
        return due

    def refuse(self, rows: StructArray) -> None:
        """Mark rows as outside."""
        if len(rows):
            told = told_of(len(rows))
            told.fate[:] = Fate.OUTSIDE
            told.dimension[:] = 0
            told.figures[:] = np.nan
            self.tell(rows, told)

    def tell(self, rows: StructArray, told: Told) -> None:
        """Record the fates of rows."""
        said = np.zeros(len(rows), INNOVATION_DTYPE)
        for name in ("time_ns", "kind", "fix_type", "satellites", "antenna"):
            said[name] = rows[name]
        said["fate"], said["dimension"] = told.fate, told.dimension
        figures = told.figures
        said["value"], said["sigma"], said["normalised"] = figures[:, :3], figures[:, 3:6], figures[:, 6:9]
        for name, column in (("chi2", CHI2), ("log_det", LOG_DET), ("inflation", INFLATION)):
            said[name] = figures[:, column]
        self._told.append(said)
        pairs, times = np.unique(said[["kind", "fate"]], return_counts=True)
        self.fates.update(dict(zip(pairs.tolist(), times.tolist(), strict=True)))
        if not self._kept and len(self._told) > LATEST_ROWS:
            self._told = [np.concatenate(self._told)[-LATEST_ROWS:]]

    def close(self) -> None:
        """Mark all waiting rows as outside, as no more samples come."""
        waiting, self._waiting = self._waiting, self._waiting[:0]
        self.refuse(waiting)

    def innovations(self) -> StructArray:
        """Return the fates of all rows so far (as far as they are kept), by time."""
        if not self._told:
            return np.zeros(0, INNOVATION_DTYPE)
        whole = np.concatenate(self._told)
        self._told = [whole]
        return whole[np.argsort(whole["time_ns"], kind="stable")]


def columns_of(rows: StructArray) -> Rows:
    """Return observations as compiled loops take them."""
    what = np.stack([rows[name] for name in ("kind", "fix_type", "satellites", "antenna")], axis=1)
    figures = np.concatenate([rows["value"], rows["sigma"], rows["correlation"]], axis=1)
    return Rows(np.ascontiguousarray(rows["time_ns"]), what, figures)


def told_of(rows: int) -> Told:
    """Return room for the fates of rows."""
    return Told(np.empty(rows, np.uint8), np.empty(rows, np.uint8), np.empty((rows, TOLD_SIZE)))


def _path(rows: int, storage: Storage) -> Path:
    return Path(
        storage.empty((rows,), np.int64),
        storage.empty((rows, 10), np.float64),
        storage.empty((rows, 9), np.float32),
        storage.empty((rows,), np.bool_),
    )


def _cut(path: Path, rows: int) -> Path:
    return Path._make(column[:rows] for column in path)


def _nodes(nodes: int, components: int, layout: Layout, storage: Storage) -> Nodes:
    size = layout.size
    return Nodes(
        storage.empty((nodes,), np.int64),
        storage.empty((nodes, 10), np.float64),
        storage.empty((nodes, STATE_SIZE), np.float64),
        storage.empty((nodes, size * (size + 1) // 2), np.float64),
        storage.empty((nodes, MOVED, layout.core), np.float64),
        storage.empty((nodes, size), np.float64),
        storage.empty((nodes,), np.int64),
        storage.empty((components, size), np.float64),
        storage.empty((components, size), np.float64),
        storage.empty((components, 2), np.float64),
    )
