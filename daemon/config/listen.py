"""Reads the address and port at which the console listens."""

from __future__ import annotations

import ipaddress
from dataclasses import dataclass

EXAMPLES = "127.0.0.1:8470 or 0.0.0.0:8470"


@dataclass(frozen=True, slots=True)
class Place:
    """An address of this computer and a TCP port."""

    address: str
    port: int

    @property
    def is_local(self) -> bool:
        """True if only this computer reaches it."""
        return ipaddress.ip_address(self.address).is_loopback

    @property
    def host(self) -> str:
        """The address as a URL writes it."""
        return f"[{self.address}]" if ":" in self.address else self.address

    @property
    def url(self) -> str:
        """The first page's address, on this computer."""
        return f"http{'' if self.is_local else 's'}://{self.host}:{self.port}/"


def parse_listen(text: str) -> Place:
    """Return address and port of ``ADDRESS:PORT``.

    Raises:
        ValueError: it is neither; a name is none, because it may lead anywhere.
    """
    address, _, port = text.rpartition(":")
    try:
        place = Place(str(ipaddress.ip_address(address.strip("[]"))), int(port))
    except ValueError:
        place = Place("", 0)
    if not 1 <= place.port <= 65535:
        raise ValueError(f"got {text!r}, want an address of this computer and a port, such as {EXAMPLES}")
    return place


def listen_text(text: str) -> str:
    """Return the text unchanged; raises ValueError if it is no address and port."""
    parse_listen(text)
    return text
