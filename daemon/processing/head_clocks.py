"""Finds what scanners' own time stamps count from, before any return is placed, from samples all over the log.

A job reads its own piece of a log only; so this is settled once, for the whole log, and every job gets the answer.
Scanner heads that report the time themselves (Velodyne's position packets, Hesai's GPS packets) serve as the host's
clock where the log has no receiver.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from swath.daemon.log.chunk_index import SCANNER, ChunkPlace, LogIndex, read_chunks
from swath.daemon.log.format import source_of_topic
from swath.daemon.log.reader import PartDamage
from swath.georef.arrays import BoolArray, StructArray
from swath.georef.records import DEVICE_CLOCK_DTYPE, ChunkBatch, DeviceClockSamples, DeviceStatus, Record, TimeMessage
from swath.georef.stream.clocks import DevicePlan, FrozenClocks, HeadTime, HostClocks
from swath.georef.timescales import (
    SECOND_NS,
    Stamps,
    StampScale,
    gps_ns_from_unix,
    judge,
    table_leap_seconds,
    utc_from_gps,
)
from swath.georef.timescales.coarse import SETTLED_SPAN_NS
from swath.georef.timescales.device_clock import COARSE_MAX_SIGMA_NS
from swath.georef.timescales.stamp_scale import AHEAD_NS, LEAST_SPAN_S

if TYPE_CHECKING:
    from swath.daemon.processing.setup.sources import Sources

LOOKED_AT_BYTES = 96 << 20  # how much of a log's scanner chunks is read, in pieces
PIECES = 12
FOLLOWING_NS = 2 * SECOND_NS
LEAST_SENTENCES_NS = SETTLED_SPAN_NS
HOUR_NS = 3600 * SECOND_NS


def find_stamps(index: LogIndex, sources: Sources, host: HostClocks) -> FrozenClocks:
    """Return the host's clocks together with what each scanner's stamps count from.

    If a head is its own clock, its time messages are fed to that clock here; if it sends none and its stamps are
    configured as UTC or TAI, its stamps are.
    """
    plans = {source: plan for source, plan in host.plan.devices.items() if plan.stamps is not None}
    own = {source for source, plan in plans.items() if plan.clock == source}
    if not plans or (not own and all(plan.stamps is StampScale.FREE for plan in plans.values())):
        return FrozenClocks(host, {source: Stamps(StampScale.FREE, "as configured") for source in plans})
    read = _Reader(sources, plans)
    read.take(index, _pieces(index.scanner_chunks()))
    for source in own:
        for message in read.messages[source]:
            host.add_message(source, message)
    host.update()
    remarks = read.remarks(own) + (host.settle() if own else [])  # a head is the clock if no receiver is
    stamps: dict[str, Stamps] = {}
    heads: dict[str, HeadTime] = {}
    for source, plan in plans.items():
        rows = read.rows(source)
        if source in own and len(rows):
            _tell_by_stamps(source, plan, rows, host)
        found = _judged(plan, rows, host)
        if found is not None:
            stamps[source] = found
        messages = sum(message.valid for message in read.messages[source])
        heads[source] = HeadTime(messages, _trouble(read, source, own=source in own))
    return FrozenClocks(host, stamps, heads, tuple(remarks))


def _pieces(chunks: Sequence[ChunkPlace]) -> list[ChunkPlace]:
    """Return all chunks of a short log; otherwise runs of chunks spread over it, the first and the last included."""
    if sum(chunk.length for chunk in chunks) <= LOOKED_AT_BYTES:
        return list(chunks)
    mean = sum(chunk.length for chunk in chunks) / len(chunks)
    run = max(1, int(LOOKED_AT_BYTES / PIECES / mean))
    starts = np.linspace(0, max(0, len(chunks) - run), PIECES).astype(int).tolist()
    return [chunks[place] for place in sorted({start + step for start in starts for step in range(run)})]


class _Reader:
    """Collects the time messages, status and clock samples of scanners."""

    def __init__(self, sources: Sources, plans: dict[str, DevicePlan]) -> None:
        self.messages: dict[str, list[TimeMessage]] = {source: [] for source in plans}
        self.statuses: dict[str, list[DeviceStatus]] = {source: [] for source in plans}
        self._rows: dict[str, list[StructArray]] = {source: [] for source in plans}
        self._parsers = {source: parser for source, parser in sources.scanner_time_parsers().items() if source in plans}

    def take(self, index: LogIndex, places: Sequence[ChunkPlace]) -> None:
        """Read chunks; damage is not reported here, but when the returns are read."""
        damage: list[PartDamage] = []
        for batch in read_chunks(index, places, lambda topic: topic.startswith(SCANNER), damage):
            source = (source_of_topic(batch.channel.topic) or "").removesuffix("/aux")
            if source in self._parsers:
                units = ChunkBatch(source, batch.log_time_ns, batch.units)
                self._keep(source, self._parsers[source].feed_batch(units))
        for source, parser in self._parsers.items():
            self._keep(source, parser.close())

    def _keep(self, source: str, records: list[Record]) -> None:
        for record in records:
            if isinstance(record, TimeMessage):
                self.messages[source].append(record)
            elif isinstance(record, DeviceStatus):
                self.statuses[source].append(record)
            elif isinstance(record, DeviceClockSamples):
                self._rows[source].append(record.rows)

    def remarks(self, sources: Iterable[str]) -> list[str]:
        """Return remarks about the dates that heads were given."""
        return [line for source in sorted(sources) for line in self._parsers[source].remarks()]

    def rows(self, source: str) -> StructArray:
        """Return all clock samples of a scanner."""
        return np.concatenate(self._rows[source] or [np.empty(0, DEVICE_CLOCK_DTYPE)])


def _trouble(read: _Reader, source: str, *, own: bool) -> str:
    """Return why a head's time messages cannot be used, and the remedy; empty if they can or it sends none.

    Args:
        read: the messages read.
        source: the head.
        own: True if the log has no receiver, so that the head's sentences would be its clock.
    """
    locked = read.rows(source)["locked"]
    if not (locked >= 0).any():
        return ""
    facts = []
    if not (locked == 1).any():
        states = {str(status.values["pps_status"]) for status in read.statuses[source] if "pps_status" in status.values}
        if states == {"absent"}:
            facts.append("reports that no pulse reaches it; wire the receiver's PPS to it")
        else:
            states_text = f" ({', '.join(sorted(states))})" if states else ""
            facts.append(f"reports that it is not locked to its pulse{states_text}; wire a steady PPS to it")
    messages = read.messages[source]
    valid = [message.host_time_ns for message in messages if message.valid]
    if own and not messages:
        facts.append("passes on no NMEA sentence with a time; connect RMC of a receiver with a fix to its input")
    elif own and not valid and any(is_void(status) for status in read.statuses[source]):
        facts.append(
            f"passes on {len(messages):,} sentences, all void (no fix yet); place the receiver's antenna under open "
            "sky, and start recording after its fix"
        )
    elif own and valid and valid[-1] - valid[0] < LEAST_SENTENCES_NS:
        span_s = (valid[-1] - valid[0]) / SECOND_NS
        facts.append(
            f"sends the time over {span_s:.0f} s only; record {LEAST_SENTENCES_NS // SECOND_NS} s of sentences"
        )
    return "; it ".join(facts)


def is_void(status: DeviceStatus) -> bool:
    """Return True if a head reports that its receiver's sentences have no fix."""
    return status.values.get("nmea_valid") is False or status.values.get("gps_status") in ("invalid", "none")


def _judged(plan: DevicePlan, rows: StructArray, host: HostClocks) -> Stamps | None:
    """Return what stamps count from; None if the head itself reports whether it is locked, or the time is not known."""
    assert plan.stamps is not None
    says = (rows["locked"] >= 0) | (rows["pps_time_ns"] >= 0)
    brief = False
    if plan.past_utc_hour and plan.stamps is StampScale.AUTO:
        rows, brief = _before_it_says(rows, says)
        says = says[:0]
    if plan.stamps is StampScale.AUTO and (says.any() or not len(rows)):
        return None
    gps_ns, sigma_ns = host.gps_from_host(plan.clock, rows["host_time_ns"])
    sigma_ns = np.where(sigma_ns <= COARSE_MAX_SIGMA_NS, sigma_ns, np.inf)
    leap = host.by_source[plan.clock].leap_seconds_at(int(gps_ns[-1])) if len(gps_ns) else 0
    found = judge(rows["device_time_ns"], gps_ns, sigma_ns, leap, past_hour=plan.past_utc_hour, wanted=plan.stamps)
    return found if found is None else replace(found, brief=brief)


def _before_it_says(rows: StructArray, says: BoolArray) -> tuple[StructArray, bool]:
    """Return the rows before a head reports whether it is locked, and whether these rows are few.

    Few rows prove nothing by themselves. If the head is locked as soon as it reports and its stamps go on without a
    jump, the rows that follow are used too: a clock that the pulse set in between would have jumped.
    """
    host_ns, before = rows["host_time_ns"], ~says
    if not before.any() or np.ptp(host_ns[before]) >= LEAST_SPAN_S * SECOND_NS:
        return rows[before], False
    following = says & (host_ns <= host_ns[before].max() + FOLLOWING_NS)
    if not following.any() or (rows["locked"][following] != 1).any():
        return rows[before], True
    late_ns = host_ns - rows["device_time_ns"]
    late_ns = (late_ns - late_ns[following][0] + HOUR_NS // 2) % HOUR_NS - HOUR_NS // 2
    early = before & (host_ns < host_ns[following].min())  # a chunk's returns may be read before its position packets
    goes_on = not early.any() or abs(late_ns[early].min() - late_ns[following].min()) <= AHEAD_NS
    return rows[before | following] if goes_on else rows[early], True


def _tell_by_stamps(source: str, plan: DevicePlan, rows: StructArray, host: HostClocks) -> None:
    """Set a head's own clock by its stamps if they are configured as TAI or UTC and nothing else sets it.

    For stamps that count from the full hour, the log's wall clock gives the hour; it must be right to half an hour.
    """
    host_ns = rows["host_time_ns"]
    _, sigma_ns = host.gps_from_host(source, host_ns[-1:])
    if plan.stamps in (StampScale.AUTO, StampScale.FREE) or sigma_ns[0] <= COARSE_MAX_SIGMA_NS:
        return
    rows = rows[:: max(1, len(rows) // 200)]
    device_ns, host_ns = rows["device_time_ns"], rows["host_time_ns"]
    leap = _leap_at(int(host_ns[0]))
    if plan.stamps is StampScale.TAI:
        gps_ns = gps_ns_from_unix(0, 0) + device_ns - 19 * SECOND_NS
    elif plan.stamps is StampScale.UTC:
        gps_ns = gps_ns_from_unix(0, leap) + device_ns
    else:
        wall_ns = host_ns + gps_ns_from_unix(0, leap)
        beside = (device_ns + leap * SECOND_NS - wall_ns + HOUR_NS // 2) % HOUR_NS - HOUR_NS // 2
        gps_ns = wall_ns + beside
    host.add_coarse(source, host_ns, np.asarray(gps_ns, np.int64))


def _leap_at(unix_ns: int) -> int:
    date, _ = utc_from_gps(gps_ns_from_unix(unix_ns, 0), 0)
    return table_leap_seconds(date)[0]


def stamp_lines(clocks: FrozenClocks) -> list[str]:
    """Return one line for the user per scanner whose stamps or sentences give the time: which, and why.

    Stamps that span less than a second before the head reports its lock get no line.
    """
    host = clocks.host
    own = [source for source, plan in host.plan.devices.items() if plan.clock == source]
    lines = [
        f"{source}: the log has no receiver, so GPS time comes from {_own_words(clocks, source)}, with "
        f"{host.by_source[source].leap_seconds_at(near_ns)} leap seconds"
        for source in sorted(own)
        if (near_ns := host.by_source[source].coarse_gps_ns()) is not None
    ]
    return lines + [
        f"{source}: its stamps are read as {found.scale.value}: {found.text}"
        for source, found in sorted(clocks.stamps.items())
        if found.scale is not StampScale.FREE and not found.brief
    ]


def _own_words(clocks: FrozenClocks, source: str) -> str:
    """Return words for which data of a head is its clock."""
    head, found = clocks.heads.get(source), clocks.stamps.get(source)
    if head is not None and head.messages:
        return "the head's own sentences and stamps"
    if found is not None and found.scale is StampScale.HOUR:
        return "the head's own stamps, as configured, and the hour by the recording computer's clock"
    return "the head's own stamps, as configured"
