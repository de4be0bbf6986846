"""Messages of receivers that several tests of time scales use."""

from __future__ import annotations

from typing import Any

from swath.georef.records import NamesEdge
from tests.georef.clock_simulation import Sender, utc_tag, week_tag

START = 1_479_297_618  # 2026-11-21T12:00:00Z
UTC = utc_tag(18)


def nmea(delay_s: float = 0.2, jitter_s: float = 0.01, **more: Any) -> list[Sender]:
    """Return senders of RMC and ZDA of one receiver, ZDA 20 ms after RMC."""
    return [
        Sender("RMC", UTC, delay_s=delay_s, jitter_s=jitter_s, **more),
        Sender("ZDA", UTC, delay_s=delay_s + 0.02, jitter_s=jitter_s, **more),
    ]


def tim_tp() -> Sender:
    """Return the sender of the bound message that names the next edge."""
    return Sender("TIM-TP", week_tag(), names_edge=NamesEdge.NEXT, bound=True, delay_s=0.1)
