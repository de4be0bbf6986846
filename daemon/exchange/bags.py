"""Assigns the topics of a bag to the devices of a configuration, as the user named them or by what they carry."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from swath.daemon.errors import UserError
from swath.daemon.exchange.captures import Capture
from swath.daemon.exchange.routes import Port, Routes
from swath.daemon.exchange.tables import RECORDS
from swath.drivers.captures.opening import open_bag
from swath.drivers.captures.rosbag.messages import SECOND, BagTopic, Carries

WIRES: dict[Carries, tuple[str, ...]] = {  # kinds of transport whose units a topic's units can be
    "datagrams": ("udp",),
    "bytes": ("serial", "tcp", "udp", "ntrip"),
    "can": ("can",),
    "records": ("udp", "tcp", "serial"),
}
WORDS: dict[Carries, str] = {
    "datagrams": "datagrams",
    "bytes": "pieces of a byte stream",
    "can": "CAN frames",
    "records": "decoded values",
}


def _fits(topic: BagTopic, port: Port) -> bool:
    if topic.raw is None or port.kind not in WIRES[topic.raw.carries]:
        return False
    if topic.raw.carries != "records":
        return port.protocol != RECORDS
    return port.protocol == RECORDS and port.source.startswith(f"{topic.raw.device}/") and not port.is_aux


def _expects(port: Port, topic: BagTopic) -> bool:
    """Return whether a topic's messages are those of a port's protocol, so that nobody has to name them."""
    if topic.raw is None or topic.raw.named or not _fits(topic, port):
        return False
    protocol = port.channel.metadata.get("protocol", "")
    right = not topic.raw.protocols or protocol.startswith(topic.raw.protocols)
    return right and port.source.endswith("/aux") == topic.second


@dataclass(slots=True)
class _Chosen:
    """Names the topics of a bag that become sources.

    Attributes:
        topics: all topics of the bag, by name.
        ports: ports by topic, as named.
        whole: the bag was given without a source too.
    """

    topics: dict[str, BagTopic]
    ports: dict[str, Port] = field(default_factory=dict)
    whole: bool = False


class BagChoice:
    """Collects the bags of a command line, each with the ports of its topics."""

    def __init__(self, routes: Routes) -> None:
        self._routes = routes
        self._bags: dict[Path, _Chosen] = {}

    def add(self, path: Path) -> None:
        """Take a bag whose topics find their devices themselves; raises TransportError."""
        self._of(path).whole = True

    def name(self, path: Path, port: Port, selector: str) -> None:
        """Take one topic of a bag for a port: that of the selector, or the only one that fits.

        Raises:
            UserError: the bag has no such topic, or it does not fit.
            TransportError: the bag cannot be read.
        """
        chosen = self._of(path)
        if not selector:
            found = [topic for topic in chosen.topics.values() if _fits(topic, port)]
            found = [topic for topic in found if _expects(port, topic)] or found
            if len(found) != 1:
                there = ", ".join(topic.name for topic in found) or "none"
                raise UserError(f"{path}: topics that fit {port.source}: {there}; want {_option(port, path, found)}")
            [topic] = found
        else:
            name = selector if selector.startswith("/") or selector in chosen.topics else f"/{selector}"
            topic = self._fitting(path, chosen, port, name)
        before = chosen.ports.setdefault(topic.name, port)
        if before is not port:
            raise UserError(f"{path}: {topic.name} is named for {before.source} and {port.source}; want one of them")

    def _fitting(self, path: Path, chosen: _Chosen, port: Port, name: str) -> BagTopic:
        topic = chosen.topics.get(name)
        if topic is None:
            there = ", ".join(one.name for one in chosen.topics.values() if one.raw is not None) or "none"
            raise UserError(f"{path}: has no topic {name}; of those with a device's bytes there are: {there}")
        if topic.raw is None:
            raise UserError(f"{path}: {name} ({topic.kind}) cannot be imported: {topic.why}")
        if not _fits(topic, port):
            held = WORDS[topic.raw.carries]
            if topic.raw.carries == "records" or port.protocol == RECORDS:
                wanted = f'[{topic.raw.device or port.source.partition("/")[0]}.…] of protocol "{RECORDS}"'
                also = "" if topic.raw.carries == "records" else "; only decoded values belong to it"
                raise UserError(f"{path}: {name} holds {held}, want a source {wanted}{also}")
            raise UserError(f"{path}: {name} holds {held}, but {port.source} uses {port.kind} in this configuration")
        return topic

    def _of(self, path: Path) -> _Chosen:
        if path not in self._bags:
            with open_bag(path) as bag:
                self._bags[path] = _Chosen(bag.topics)
        return self._bags[path]

    def captures(self) -> list[Capture]:
        """Return the bags with the ports of their topics.

        Raises:
            UserError: a line for each device that several topics may belong to, or topic that several devices may.
        """
        wrong: list[str] = []
        for path, chosen in self._bags.items():
            if chosen.whole:
                wrong += self._assign(path, chosen)
        if wrong:
            raise UserError("\n".join(wrong))
        return [_capture(path, chosen) for path, chosen in self._bags.items()]

    def _assign(self, path: Path, chosen: _Chosen) -> list[str]:
        """Give each topic to the only port that expects it; return a line for each that cannot be decided."""
        ports = [port for port in self._routes.ports.values() if port not in chosen.ports.values()]
        topics = [topic for topic in chosen.topics.values() if topic.name not in chosen.ports and topic.count]
        wrong: list[str] = []
        claims: dict[str, list[BagTopic]] = {}
        for topic in topics:
            found = [port for port in ports if _expects(port, topic)]
            if len(found) > 1:
                which = " or ".join(port.source for port in found)
                wrong.append(f"{path}: {topic.name} may belong to {which}; want {_option(found[0], path, [topic])}")
            elif found:
                claims.setdefault(found[0].source, []).append(topic)
        for source, claiming in claims.items():
            port = self._routes.ports[source]
            if len(claiming) > 1:
                names = " and ".join(topic.name for topic in claiming)
                wrong.append(f"{path}: {names} may belong to {source}; want {_option(port, path, claiming)}")
            else:
                chosen.ports[claiming[0].name] = port
        return wrong


def _option(port: Port, path: Path, topics: list[BagTopic]) -> str:
    return f"--source {port.source}:{topics[0].name if topics else '/topic'}={path}"


def _capture(path: Path, chosen: _Chosen) -> Capture:
    capture = Capture(path, "bag", topics=chosen.ports)
    for topic in chosen.topics.values():
        if topic.raw is None:
            capture.tally.passed["messages that hold no bytes of a device"] += topic.count
        elif topic.count and topic.name not in chosen.ports and not topic.name.endswith(SECOND):
            capture.passed[f"topic {topic.name}"] += topic.count
    return capture
