"""Counts scanner messages that gave no returns: damaged, not understood, or missing from the scanner's own sequence."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

from swath.drivers.guard import DRIVER_FAULT
from swath.drivers.parser import Parser

BAD_CHECKSUM = "bad_checksum"
SEQUENCE_GAP = "sequence_gap"
FOREIGN = ("bad_length", "bad_magic")  # from another sender on this port
OTHER_HEADS = ("wrong_product", "wrong_serial", "other_head")
WITHOUT_RETURNS = ("bad_gps", "bad_nmea", "bad_position", "bad_sample")
WHY = {
    BAD_CHECKSUM: "a wrong checksum",
    "bad_version": "a version of the protocol that this program does not read",
    "bad_length": "a length that the protocol does not have",
    "bad_magic": "no sign of the protocol",
    "wrong_product": "they are of another model than that of the configured protocol",
    "wrong_serial": "they are of another head than that of geometry.file",
    "other_head": "they are of another head on the same hub",
    DRIVER_FAULT: "their driver, which is not Swath's own, failed on them; `swath info` says how",
}


class Undecoded:
    """Counts the messages that parsers refused, but for those in the margin around a piece of a log.

    Attributes:
        counts: by scanner, number of refused messages by reason.
    """

    def __init__(self, parsers: Mapping[str, Parser]) -> None:
        self.counts: dict[str, Counter[str]] = {name: Counter() for name in parsers}
        self._parsers = parsers
        self._before = {name: refused_by(parser) for name, parser in parsers.items()}

    def note(self, *, own: bool) -> None:
        """Take up the parsers' counters after messages of the piece itself (``own``) or of its margin."""
        for name, parser in self._parsers.items():
            now = refused_by(parser)
            if own:
                self.counts[name] += now - self._before[name]
            self._before[name] = now


def refused_by(parser: Parser) -> Counter[str]:
    """Return how many messages a parser has refused so far, by reason."""
    counters = parser.counters
    found = Counter(
        {
            code: count
            for code, count in counters.errors.items()
            if code.startswith("bad_") or code in (SEQUENCE_GAP, DRIVER_FAULT, *OTHER_HEADS)
        }
    )
    found[BAD_CHECKSUM] = counters.bad_checksums
    return +found


def undecoded_lines(log: str, undecoded: Mapping[str, Mapping[str, int]]) -> tuple[list[str], list[str]]:
    """Return two lists of lines: what is missing from the products, and what is only a warning.

    Args:
        log: its name, for the lines.
        undecoded: by scanner, counts of messages by reason.
    """
    holes: list[str] = []
    warnings: list[str] = []
    for scanner, counts in sorted(undecoded.items()):
        for reason, count in sorted(counts.items()):
            if reason == SEQUENCE_GAP:
                if len(counts) == 1:  # what was refused is missing from the sequence too
                    warnings.append(
                        f"{log}: {count:,} messages of scanner/{scanner} did not arrive, by their sequence numbers"
                    )
                continue
            why = WHY.get(reason, reason.replace("_", " "))
            line = f"{log}: {count:,} messages of scanner/{scanner} were not read: {why}"
            (warnings if reason in (*FOREIGN, *OTHER_HEADS, *WITHOUT_RETURNS) else holes).append(line)
    return holes, warnings
