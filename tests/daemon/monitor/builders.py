"""A monitor for tests, which looks when it is told to."""

from __future__ import annotations

from pathlib import Path

from swath.daemon.monitor.display import Monitor, follower_of, news


class Looking(Monitor):
    """A monitor that looks at its log when it is told to."""

    def __init__(self, directory: Path, *, decode: bool = True) -> None:
        super().__init__(directory, decode=decode)
        self._follower = follower_of(directory)

    def poll(self) -> None:
        """Look at the log."""
        for found in news(self._follower):
            assert found.item is not None
            self.take(found.item)

    def close(self) -> None:
        """Close the log."""
        self._follower.close()
