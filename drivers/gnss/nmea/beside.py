"""Fixes of the NMEA sentences in a stream of another protocol."""

from __future__ import annotations

from swath.drivers.framing.framer import Frame
from swath.drivers.gnss.nmea.parser import POSITION_SENTENCES, NmeaDecoder
from swath.drivers.parser import DeviceSettings, ParserCounters
from swath.georef.records import GnssFix, Record

FORGET_AFTER_SENTENCES = 100  # positions in NMEA since the latest own one; at 20 Hz, GGA, GNS and RMC make 60 a second
_POSITIONS = frozenset(name.encode() for name in POSITION_SENTENCES)


class NmeaFixes:
    """Decodes the NMEA of a stream whose receiver sends no position in its own protocol.

    The rule uses the order of messages only: as long as no position has come in the own protocol, the first fix waits
    for the second one; later, sentences count again where `FORGET_AFTER_SENTENCES` of them have come since the latest
    own position. A stream without a frame of the own protocol is one of NMEA: its sentences are left to that parser.

    Args:
        settings: of the receiver.
        counters: the parser's counters; errors of sentences count while sentences are used.
    """

    def __init__(self, settings: DeviceSettings, counters: ParserCounters) -> None:
        self._settings = settings
        self._counters = counters
        self._own = ParserCounters()
        self._decoder = NmeaDecoder(settings, self._own)
        self._sentences_since: int | None = None  # since the latest own position; None: there was none
        self._first: GnssFix | None = None
        self._used = False
        self._has_own = False  # whether a frame of the own protocol has come

    def own_frame(self) -> None:
        """Note a frame of the receiver's own protocol."""
        self._has_own = True

    def own_position(self) -> None:
        """Note a position in the receiver's own protocol."""
        if self._sentences_since is None or self._used:
            self._own = ParserCounters()
            self._decoder = NmeaDecoder(self._settings, self._own)
        self._sentences_since, self._first, self._used = 0, None, False

    def add(self, frame: Frame) -> list[GnssFix]:
        """Take a sentence; return the fixes that it completed, if they are used."""
        if not self._has_own:
            return []
        if self._sentences_since is not None:
            self._sentences_since += frame.data[3:6] in _POSITIONS
            if self._sentences_since < FORGET_AFTER_SENTENCES:
                return []
            self._used, self._sentences_since = True, None
        return self._given(self._decoder.decode([frame]))

    def close(self) -> list[GnssFix]:
        """Return the fixes held back at the end of the stream."""
        if self._sentences_since is not None:
            return []
        found = self._given(self._decoder.close())
        return [self._first, *found] if self._first is not None else found

    def _given(self, records: list[Record]) -> list[GnssFix]:
        fixes = [record for record in records if isinstance(record, GnssFix)]
        if not self._used and fixes:
            if self._first is not None or len(fixes) > 1:
                fixes = [self._first, *fixes] if self._first is not None else fixes
                self._used, self._first = True, None
            else:
                self._first, fixes = fixes[0], []
        if self._used:
            self._counters.bad_messages += self._own.bad_messages
            self._counters.errors.update(self._own.errors)
            self._own.bad_messages = 0
            self._own.errors.clear()
        return fixes
