"""NMEA 2000 fast packets: messages of up to 223 bytes in up to 32 frames of one identifier.

The first data byte of each frame is ``sequence << 5 | frame``: the sequence number (0 … 7) is that of the message, by
source and PGN, so that messages of many sources may be interleaved. Frame 0 goes on with the length in bytes and six
bytes of the message, each other frame with seven; the last is filled up (canboat, docs: "fast packet").
"""

from __future__ import annotations

from dataclasses import dataclass

LARGEST_MESSAGE_BYTES = 223
FIRST_BYTES = 6  # of the message in frame 0
TIMEOUT_NS = 750_000_000  # the longest pause between frames of one message


@dataclass(slots=True)
class _Open:
    """A message under way; ``data`` None: it is lost and its remaining frames are let go."""

    length: int
    next_frame: int
    host_time_ns: int
    data: bytearray | None


class FastPackets:
    """Puts the fast packets of one PGN together; at most one message a source and sequence number is held.

    Attributes:
        incomplete: messages lost for a missing, repeated or late frame, or the end of the stream.
        bad_length: first frames that announce more than 223 bytes, or none.
    """

    def __init__(self) -> None:
        self.incomplete = 0
        self.bad_length = 0
        self._open: dict[tuple[int, int], _Open] = {}  # by source and sequence number: 256 · 8 at most

    def take(self, source: int, host_time_ns: int, data: bytes) -> bytes | None:
        """Take the data bytes of a frame; return the message it completes."""
        if not data:
            self.bad_length += 1
            return None
        key, frame = (source, data[0] >> 5), data[0] & 0x1F
        if frame == 0:
            return self._begin(key, host_time_ns, data)
        message = self._open.get(key)
        if message is None or (message.data is None and frame < message.next_frame):
            self._lose(key, frame, host_time_ns)  # its first frame never came
            return None
        if message.data is None:
            message.next_frame = frame + 1
            return None
        late = host_time_ns - message.host_time_ns > TIMEOUT_NS
        if frame != message.next_frame or late:
            self._lose(key, frame, host_time_ns)
            return None
        message.data += data[1:]
        message.next_frame, message.host_time_ns = frame + 1, host_time_ns
        if len(message.data) < message.length and len(data) < 8:  # only the last frame may be short
            self._lose(key, frame, host_time_ns)
            return None
        return self._completed(key, message)

    def close(self) -> None:
        """Count what the end of the stream leaves unfinished."""
        self.incomplete += sum(message.data is not None for message in self._open.values())
        self._open.clear()

    def _begin(self, key: tuple[int, int], host_time_ns: int, data: bytes) -> bytes | None:
        """Frame 0: a message of the same number that is still open is lost."""
        before = self._open.pop(key, None)
        if before is not None and before.data is not None:
            self.incomplete += 1
        length = data[1] if len(data) > 1 else 0
        if not 0 < length <= LARGEST_MESSAGE_BYTES:
            self.bad_length += 1
            self._open[key] = _Open(0, 1, host_time_ns, None)
            return None
        message = _Open(length, 1, host_time_ns, bytearray(data[2 : 2 + FIRST_BYTES]))
        self._open[key] = message
        return self._completed(key, message)

    def _completed(self, key: tuple[int, int], message: _Open) -> bytes | None:
        """The message when all its bytes are there."""
        if message.data is None or len(message.data) < message.length:
            return None
        del self._open[key]
        return bytes(message.data[: message.length])

    def _lose(self, key: tuple[int, int], frame: int, host_time_ns: int) -> None:
        """Count a lost message and let its remaining frames go."""
        self.incomplete += 1
        self._open[key] = _Open(0, frame + 1, host_time_ns, None)
