"""A serial line: bytes queue up in the sender, travel one after another, and are read now and then."""

from __future__ import annotations

from collections import deque

BITS_PER_BYTE = 10  # 8N1


class SerialLine:
    """From a device to the recorder.

    Args:
        baud: bits a second.
        read_s: from read to read.
        first_read_s: when the recorder reads first.
    """

    def __init__(self, baud: int, read_s: float, first_read_s: float) -> None:
        self._byte_s = BITS_PER_BYTE / baud
        self._read_s, self._first_read_s = read_s, first_read_s
        self._free_s = 0.0
        self._queue: deque[tuple[float, bytes]] = deque()
        self._taken = 0  # bytes of the queue's first message
        self._reads = 0

    def send(self, time_s: float, data: bytes) -> None:
        """Put bytes behind those still waiting, at this time at the earliest."""
        start_s = max(time_s, self._free_s)
        self._free_s = start_s + len(data) * self._byte_s
        self._queue.append((start_s, data))

    def read_until(self, stop_s: float) -> list[tuple[float, bytes]]:
        """The reads before ``stop_s`` that have bytes, each with its time; whatever arrives by then must be sent."""
        reads = []
        while (time_s := self._first_read_s + self._reads * self._read_s) < stop_s:
            self._reads += 1
            data = self._arrived(time_s)
            if data:
                reads.append((time_s, data))
        return reads

    def _arrived(self, time_s: float) -> bytes:
        """Bytes whose last bit is there and that no read has taken."""
        parts = []
        while self._queue and self._queue[0][0] < time_s:
            start_s, data = self._queue[0]
            end = min(int((time_s - start_s) / self._byte_s), len(data))
            parts.append(data[self._taken : end])
            if end < len(data):
                self._taken = end
                break
            self._queue.popleft()
            self._taken = 0
        return b"".join(parts)
