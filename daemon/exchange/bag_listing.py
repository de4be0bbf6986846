"""Lists what of a bag `swath import` reads, and proposes a configuration for it."""

from __future__ import annotations

import itertools
import re
import shlex
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from swath.daemon.devices.identify import Recognised, recognise
from swath.daemon.errors import one_line
from swath.daemon.exchange.bags import WIRES, WORDS
from swath.daemon.exchange.record_facts import RecordFacts, facts_of
from swath.daemon.exchange.tables import RECORDS
from swath.drivers.captures.base import CapturedUnit, CaptureTally, until_damage
from swath.drivers.captures.opening import open_bag
from swath.drivers.captures.rosbag.messages import SECOND, BagTopic, Carries
from swath.drivers.driver import KINDS, RAW, all_drivers
from swath.drivers.parser import DeviceKind
from swath.georef.records import ChunkBatch
from swath.georef.timescales import SECOND_NS

if TYPE_CHECKING:
    from swath.drivers.captures.rosbag.bag import Bag

_TRIED_UNITS, _TRIED_BYTES = 2000, 2_000_000
_KINDS: dict[Carries, tuple[DeviceKind, ...]] = {
    "datagrams": ("scanner",),
    "bytes": ("gnss", "imu", "corrections", "scanner"),
    "can": ("imu",),
}
_DEVICES = {"gnss": "a receiver", "imu": "an inertial unit", "scanner": "a scanner", "raw": "a device"}
_PORTS = {"velodyne": (2368, 8308), "hesai": (2368, 10110), "robosense": (6699, 7788), "ouster": (7502, 7503)}
_OTHER_PORTS = (9000, 9500)
_NEEDED = {  # lines for the keys that a driver requires
    "installation": "installation = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]  # change: rotation from its axes to the body",
    "mirror_factor": "mirror_factor = 2.0  # change: 2 for a flat mirror, 1 for a monogon",
    "geometry.file": 'geometry = {{ file = "{name}.file" }}  # change: the head\'s own file, which the bag may lack',
    "tick_hz": "tick_hz = 1000000.0  # change: rate of its counter",
}
_MAX_NAME = 40
_IMU, _ODOMETRY = "sensor_msgs/msg/Imu", "nav_msgs/msg/Odometry"
_APART_NS = 10 * SECOND_NS  # a clock that is set well, and a recorder that is not late, differ by less


@dataclass(slots=True)
class ListedTopic:
    """A topic of a bag, with what its units are.

    Attributes:
        topic: as the bag has it.
        span_ns: times of its first and last message; None without any.
        read: its first units were read.
        offset_ns: first unit's own time less the bag's time of its message; None: its units have no times of their own.
        kind, protocol: of the device whose protocol most of the first units are; None and "" if none is recognised.
        others: protocols whose heads send the same; only the user knows which it is.
        source: of the proposed configuration; "" if it has none for this topic.
        damage: what is wrong with its first messages; "" if nothing is.
        facts: of decoded values; None for others.
    """

    topic: BagTopic
    span_ns: tuple[int, int] | None
    read: bool = False
    offset_ns: int | None = None
    kind: DeviceKind | None = None
    protocol: str = ""
    others: list[str] = field(default_factory=list)
    source: str = ""
    damage: str = ""
    facts: RecordFacts | None = None

    def words(self) -> str:
        """Say in a few words what becomes of the topic."""
        if self.topic.raw is None:
            return self.topic.why
        what = WORDS[self.topic.raw.carries] + (" of the second port" if self.topic.second else "")
        if self.damage:
            return f"{what}; {self.damage}"
        if not self.read:
            return f"{what}; none in this bag"
        if self.facts is not None:
            apart = _apart_words(self.offset_ns or 0)
            return f"{what} of {_DEVICES[self.kind or 'raw']}{apart}{self.facts.text}"
        meant = " or ".join([self.protocol, *self.others])
        device = f"of {self.kind} {meant}" if self.protocol else "of a device that is not recognised"
        if self.offset_ns is None:
            return f"{what} {device}, with the times of the bag"
        return f"{what} {device}, with their own times{_apart_words(self.offset_ns)}"


def _apart_words(offset_ns: int) -> str:
    """Return words on how far units' own times are from the bag's; empty if they are near."""
    if abs(offset_ns) <= _APART_NS:
        return ""
    where = "after" if offset_ns > 0 else "before"
    return f", {abs(offset_ns) / SECOND_NS:,.0f} s {where} those of the bag"


@dataclass(slots=True)
class BagListing:
    """Lists the topics of a bag.

    Attributes:
        path, kind: of the bag; "ROS 1" or "ROS 2".
        topics: all, by name.
        finished: False if its recorder was stopped before it wrote the index; what precedes that is listed.
        sections: text of the proposed configuration's sections.
    """

    path: Path
    kind: str
    topics: list[ListedTopic]
    finished: bool = True
    sections: list[str] = field(default_factory=list)

    def configuration(self) -> str:
        """Return the proposed configuration; "" if nothing of the bag can be imported."""
        if not self.sections:
            return ""
        name = _name(self.path.name.partition(".")[0])
        return f'[session]\nname = "{name}"\ndirectory = "logs"\n\n' + "\n".join(self.sections)

    def options(self) -> list[str]:
        """Return the options by which `swath import` reads the bag with this configuration."""
        return [
            f"--source {shlex.quote(f'{one.source}:{one.topic.name}={self.path}')}" for one in self.topics if one.source
        ]

    def text(self) -> str:
        """Return the list, as comments, and the configuration."""
        total = sum(one.topic.count for one in self.topics if not one.topic.name.endswith(SECOND))
        lines = [f"# {one_line(str(self.path))}: {self.kind} bag, {total} messages of {_topics(len(self.topics))}"]
        if not self.finished:
            lines[0] += "; it has no index, because its recorder was stopped"
        for one in self.topics:
            when = f" from {_utc(one.span_ns[0])} to {_utc(one.span_ns[1])}" if one.span_ns else ""
            lines += [one_line(f"#   {one.topic.name} ({one.topic.kind}): {one.topic.count} messages{when}")]
            lines += [one_line(f"#       {one.words()}")]
        options = self.options()
        if options:
            lines += ["#", "# Save this as CONFIG, change what the comments name, and import the bag with:"]
            lines += [" \\\n#       ".join(["#   swath import CONFIG -o DIR", *map(one_line, options)])]
        return "\n".join(lines) + "\n" + ("\n" + self.configuration() if options else "")

    def plain(self) -> dict[str, Any]:
        """Return the list as plain values for ``--json``."""
        return {
            "file": str(self.path),
            "kind": self.kind,
            "finished": self.finished,
            "topics": [
                {
                    "topic": one.topic.name,
                    "type": one.topic.kind,
                    "messages": one.topic.count,
                    "first_ns": one.span_ns[0] if one.span_ns else None,
                    "last_ns": one.span_ns[1] if one.span_ns else None,
                    "carries": one.topic.raw.carries if one.topic.raw is not None else None,
                    "own_times": one.offset_ns is not None if one.read else None,
                    "offset_ns": one.offset_ns,
                    "protocol": one.protocol or None,
                    "source": one.source or None,
                    "note": one.words(),
                }
                for one in self.topics
            ],
            "configuration": self.configuration(),
        }


def list_bag(path: Path) -> BagListing:
    """Read a bag's topics and the first units of each.

    Raises:
        TransportError: it cannot be read.
    """
    with open_bag(path) as bag:
        topics = [_listed(bag, topic) for topic in sorted(bag.topics.values(), key=lambda topic: topic.name)]
        topics = [one for one in topics if one.read or not one.topic.name.endswith(SECOND)]
        listing = BagListing(path, bag.kind, topics, bag.finished)
    listing.sections = _Proposal(topics).sections()
    return listing


def _listed(bag: Bag, topic: BagTopic) -> ListedTopic:
    listed = ListedTopic(topic, bag.span_ns(topic.name))
    if topic.raw is None or not topic.count:
        return listed
    tally = CaptureTally()
    taken = _first_units(until_damage(bag.units([topic.name], tally), tally), topic.name)
    batches = [_batch(length, list(run)) for length, run in itertools.groupby(taken, key=lambda unit: len(unit.data))]
    listed.read = bool(batches)
    if not batches:
        listed.damage = tally.first_damage
        return listed
    listed.offset_ns = bag.offsets_ns.get(topic.name)
    if topic.raw.carries == "records":
        listed.kind = next(kind for kind in KINDS if kind == topic.raw.device)
        listed.protocol, listed.facts = RECORDS, facts_of(taken)
        return listed
    found: list[tuple[Recognised, DeviceKind]] = []
    for kind in _KINDS[topic.raw.carries]:
        one = recognise(kind, _transport(topic.raw.carries, "probe", 0), batches)
        wires = WIRES["datagrams" if kind == "scanner" else topic.raw.carries]
        if one is not None and set(all_drivers(kind)[one.protocols[0]].transports) & set(wires):
            found.append((one, kind))
    if found:
        best, listed.kind = max(found, key=lambda pair: (pair[0].records, pair[0].messages))
        listed.protocol, *listed.others = best.protocols
    return listed


def _first_units(units: Iterator[CapturedUnit], name: str) -> list[CapturedUnit]:
    """Return the first units of a topic."""
    taken: list[CapturedUnit] = []
    size = 0
    for unit in itertools.islice(units, _TRIED_UNITS):
        if unit.channel == name and unit.data:
            taken.append(unit)
            size += len(unit.data)
        if size > _TRIED_BYTES:
            break
    return taken


def _batch(length: int, run: list[CapturedUnit]) -> ChunkBatch:
    times = np.array([unit.time_ns for unit in run], np.int64)
    rows = np.frombuffer(b"".join(unit.data for unit in run), np.uint8).reshape(len(run), length)
    return ChunkBatch("bag", times, rows)


class _Proposal:
    """Proposes the sections of a configuration for the topics of a bag, and names the source of each topic."""

    def __init__(self, topics: Iterable[ListedTopic]) -> None:
        self._topics = [one for one in topics if one.read]
        self._names: set[str] = set()
        self._ports: set[int] = set()

    def sections(self) -> list[str]:
        """Return the text of each section."""
        sections: list[str] = []
        self._join_odometry()
        second = [one for one in self._topics if one.topic.second]
        for one in self._topics:
            if one.topic.second or one.source or not self._is_proposed(one):
                continue
            mate = next((other for other in second if _same_head(one, other)), None)
            if mate is not None:
                second.remove(mate)
            sections += self._section(one, mate)
        return sections

    def _is_proposed(self, one: ListedTopic) -> bool:
        """Return whether a topic gets a section: decoded points do where the bag has no packets of a scanner."""
        if one.facts is None or one.kind != "scanner":
            return one.facts is None or one.facts.usable
        return not any(other.kind == "scanner" and other.facts is None for other in self._topics)

    def _join_odometry(self) -> None:
        """Give attitudes to the first inertial unit of the same bag, which has the name of its topic."""
        samples = [one for one in self._topics if one.topic.kind == _IMU and self._is_proposed(one)]
        for one in self._topics:
            if samples and one.topic.kind == _ODOMETRY:
                one.source = f"imu/{_name(samples[0].topic.name)}"

    def _section(self, one: ListedTopic, mate: ListedTopic | None) -> Iterator[str]:
        """Yield the section of a topic's device, and that of a device inside its stream."""
        assert one.topic.raw is not None
        name = self._name_of(one.topic.name)
        kind = one.kind or "raw"
        as_datagrams = kind == "scanner" or one.facts is not None
        carries: Carries = "datagrams" if as_datagrams else one.topic.raw.carries
        first, second = _PORTS.get(one.protocol.partition("-")[0], _OTHER_PORTS)
        lines = [f"[{kind}.{name}]", f'transport = "{_transport(carries, name, self._port(carries, first))}"']
        if mate is not None and kind == "scanner":
            lines.append(f'auxiliary = "{_transport(carries, name, self._port(carries, second))}"')
            mate.kind, mate.protocol, mate.source = one.kind, one.protocol, f"scanner/{name}/aux"
        others = f"  # or {', '.join(one.others)}: the packets do not tell" if one.others else ""
        lines.append(f'protocol = "{one.protocol or RAW}"{others}')
        one.source = f"{kind}/{name}"
        if one.kind:
            driver = all_drivers(one.kind)[one.protocol]
            lines += [_NEEDED.get(key, f"# {key} = …").format(name=name) for key in driver.needs]
        lines += one.facts.lines if one.facts is not None else []
        yield "\n".join(lines) + "\n"
        if one.facts is not None:
            return
        for inside in ("gnss", "imu"):
            other = all_drivers(inside).get(one.protocol) if inside != one.kind else None
            if other is not None and one.kind in other.transports:
                yield f'[{inside}.{name}]\ntransport = "{one.kind}:{name}"\nprotocol = "{one.protocol}"\n'

    def _name_of(self, topic: str) -> str:
        base = _name(topic)
        names = itertools.chain([base], (f"{base}-{number}" for number in itertools.count(2)))
        name = next(name for name in names if name not in self._names)
        self._names.add(name)
        return name

    def _port(self, carries: Carries, first: int) -> int:
        if carries != "datagrams":
            return 0
        port = next(number for number in itertools.count(first) if number not in self._ports)
        self._ports.add(port)
        return port


def _transport(carries: Carries, name: str, port: int) -> str:
    """Return a wire that such units may have come over; an import needs none of its parts."""
    wires = {
        "datagrams": f"udp:0.0.0.0:{port}",
        "bytes": f"serial:/dev/{name}?baud=115200",
        "can": f"can:socketcan:{name}?bitrate=500000",
        "records": f"udp:0.0.0.0:{port}",
    }
    return wires[carries]


def _same_head(one: ListedTopic, second: ListedTopic) -> bool:
    """Return whether a topic of second ports is that of a scanner's topic: equal types, or topics beside each other."""
    assert one.topic.raw is not None
    assert second.topic.raw is not None
    if one.kind != "scanner" or one.topic.raw.protocols != second.topic.raw.protocols:
        return False
    apart = one.topic.name + SECOND != second.topic.name and second.topic.name.endswith(SECOND)
    return not apart and one.topic.name.rpartition("/")[0] == second.topic.name.rpartition("/")[0]


def _name(text: str) -> str:
    """Return a text as a name of the configuration."""
    return re.sub(r"[^A-Za-z0-9]+", "_", text).strip("_")[-_MAX_NAME:] or "bag"


def _topics(count: int) -> str:
    return "1 topic" if count == 1 else f"{count} topics"


def _utc(time_ns: int) -> str:
    seconds, rest_ns = divmod(time_ns, SECOND_NS)
    try:
        return f"{datetime.fromtimestamp(seconds, UTC):%Y-%m-%d %H:%M:%S}.{rest_ns // 10**6:03d} UTC"
    except (ValueError, OverflowError):
        return f"{time_ns} ns"
