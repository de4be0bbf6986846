"""The queue between receive threads, which put blocks in, and the writer thread, which takes them; it blocks no
receiver.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field

from swath.daemon.log.mcap.encode import EncodedBlock


@dataclass(frozen=True, slots=True)
class SourceCount:
    """A receiver's cumulative account up to and including the block that it travels with."""

    units: int = 0
    bytes: int = 0
    lost_kernel: int = 0
    lost_queue: int = 0
    stamp_ambiguous: int = 0
    last_unit_ns: int | None = None
    receive_buffer_bytes: int = 0
    state: str = "opening"
    trouble: Mapping[str, int | str] = field(default_factory=dict)  # error counts of the wire itself, where not zero


@dataclass(frozen=True, slots=True)
class QueueItem:
    """A block of messages, the account of the receiver that sends it, or both."""

    source: str
    block: EncodedBlock | None = None
    count: SourceCount | None = None


class BlockQueue:
    """A first-in, first-out queue bounded in bytes; it refuses a block that does not fit, and the caller counts the
    loss.
    """

    def __init__(self, capacity_bytes: int) -> None:
        self._capacity = capacity_bytes
        self._items: deque[QueueItem] = deque()
        self._bytes = 0
        self._high_water = 0
        self._lock = threading.Lock()

    def put(self, item: QueueItem, *, always: bool = False) -> bool:
        """Add an item; return False if its block does not fit.

        Items without a block always fit; so do items that are put with ``always``, such as events.
        """
        size = len(item.block.data) if item.block is not None else 0
        with self._lock:
            if not always and size and self._bytes + size > self._capacity:
                return False
            self._items.append(item)
            self._bytes += size
            self._high_water = max(self._high_water, self._bytes)
        return True

    def take_all(self) -> list[QueueItem]:
        """Remove and return all items, in order."""
        with self._lock:
            items = list(self._items)
            self._items.clear()
            self._bytes = 0
        return items

    def pop_high_water(self) -> int:
        """Return the largest number of bytes held since the last call."""
        with self._lock:
            high_water, self._high_water = self._high_water, self._bytes
        return high_water
