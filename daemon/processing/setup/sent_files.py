"""Finds in a log what a scanner itself sends that serves as its ``geometry.file``, where none is configured.

Such a unit may come anywhere in the log, also after returns that need it; the first one counts for the whole log.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from swath.daemon.config.config import Config
from swath.daemon.config.tables import ScannerConfig
from swath.daemon.log.format import source_of_topic
from swath.daemon.log.mcap.chunks import LogBatch
from swath.daemon.log.reader import Session
from swath.drivers.driver import RAW, SentFile, all_drivers


def sent_file_of(table: ScannerConfig) -> SentFile | None:
    """Return what a scanner sends in place of the file; None: its driver takes no such thing, or a file is given."""
    if table.protocol == RAW or (table.geometry is not None and table.geometry.file is not None):
        return None
    driver = all_drivers("scanner").get(table.protocol)
    return None if driver is None else driver.sent_file


class SentFiles:
    """Looks for the files among batches of a log.

    Args:
        config: configuration of the log.
        scanners: names of scanners; empty: all.

    Attributes:
        found: content by the scanner's name.
        missing: names of scanners whose file has not come yet.
    """

    def __init__(self, config: Config, scanners: Sequence[str] = ()) -> None:
        self.found: dict[str, bytes] = {}
        self._wanted: dict[str, SentFile] = {}
        for name, table in config.scanner.items():
            sent = sent_file_of(table) if not scanners or name in scanners else None
            if sent is not None:
                self._wanted[name] = sent

    @property
    def missing(self) -> list[str]:
        """Names of scanners whose file has not come yet."""
        return sorted(self._wanted.keys() - self.found.keys())

    def wants(self, topic: str) -> bool:
        """Return whether a topic is of one of these scanners: its own port or its second one."""
        return self._scanner(topic) in self._wanted

    def take(self, batch: LogBatch) -> None:
        """Look into the next messages."""
        name = self._scanner(batch.channel.topic)
        if name in self._wanted and name not in self.found:
            content = self._wanted[name].find(batch.units)
            if content is not None:
                self.found[name] = content

    def _scanner(self, topic: str) -> str:
        kind, _, rest = (source_of_topic(topic) or "").partition("/")
        return rest.removesuffix("/aux") if kind == "scanner" else ""


def sent_files(session: Session, config: Config | None, scanners: Sequence[str] = ()) -> Mapping[str, bytes]:
    """Return the files that scanners sent anywhere in a log, by the scanner's name.

    The log is read until all are found; without such scanners it is not read at all.
    """
    if config is None:
        return {}
    files = SentFiles(config, scanners)
    if files.missing:
        for batch in session.batches(files.wants, skim=True):
            files.take(batch)
            if not files.missing:
                break
    return files.found


def example_files(config: Config) -> Mapping[str, bytes]:
    """Return files of no device for all scanners that send theirs, to compile loops before there is a log."""
    wanted = {name: sent_file_of(table) for name, table in config.scanner.items()}
    return {name: sent.example() for name, sent in wanted.items() if sent is not None}
