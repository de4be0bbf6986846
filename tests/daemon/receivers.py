"""Simulates receivers at the far end of a pty or a UDP port, obedient or not."""

from __future__ import annotations

import os
import select
import socket
import termios
import threading
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

from pyubx2 import SET, UBXMessage, UBXReader

Reply = Callable[[bytes], bytes]


class Receiver:
    """A serial device that accepts commands at its own rate, answers them, and sends data all the time.

    Args:
        split: cuts one whole command off the front of what came; (command, rest), or None.
        reply: returns the answer to a command.
        chatter: what it sends between its answers.
        speed: its rate (termios constant); None: any. ``reply`` may change it.
    """

    def __init__(
        self, split: Callable[[bytes], tuple[bytes, bytes] | None], reply: Reply, chatter: bytes, speed: int | None
    ) -> None:
        self.split, self.reply, self.chatter, self.speed = split, reply, chatter, speed
        self.commands: list[bytes] = []
        self.main, secondary = os.openpty()
        tty.setraw(secondary)
        self.path = os.ttyname(secondary)
        self._secondary = secondary  # kept open, so that the line survives when no one else has it open
        os.set_blocking(self.main, False)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        held, said = b"", 0
        while not self._stop.is_set():
            if select.select([self.main], [], [], 0.02)[0]:
                data = os.read(self.main, 4096)
                held = held + data if self._in_tune() else b""
                while (cut := self.split(held)) is not None:
                    command, held = cut
                    self.commands.append(command)
                    self._say(self.chatter[:700] + self.reply(command) + self.chatter[:300])
            elif self.chatter:
                self._say(self.chatter[said : said + 200])
                said = (said + 200) % len(self.chatter)

    def _in_tune(self) -> bool:
        return self.speed is None or termios.tcgetattr(self.main)[4] == self.speed

    def _say(self, data: bytes) -> None:
        with suppress(BlockingIOError):
            os.write(self.main, data if self._in_tune() else bytes(byte ^ 0xA5 for byte in data))

    def close(self) -> None:
        """Unplug the device."""
        self._stop.set()
        self._thread.join()
        os.close(self.main)
        os.close(self._secondary)


@contextmanager
def receiver(
    split: Callable[[bytes], tuple[bytes, bytes] | None],
    reply: Reply,
    chatter: bytes = b"",
    speed: int | None = None,
) -> Iterator[Receiver]:
    """Provide a serial device while the block runs."""
    device = Receiver(split, reply, chatter, speed)
    try:
        yield device
    finally:
        device.close()


def split_lines(data: bytes) -> tuple[bytes, bytes] | None:
    """Split a command line off the buffer."""
    line, end, rest = data.partition(b"\r\n")
    return (line, rest) if end else None


def split_ubx(data: bytes) -> tuple[bytes, bytes] | None:
    """Split a UBX frame off the buffer."""
    length = 8 + int.from_bytes(data[4:6], "little") if len(data) >= 6 else 8
    return (data[:length], data[length:]) if len(data) >= length else None


def ubx_acknowledges(refuses: str = "", silent: str = "") -> Reply:
    """Return a reply that acknowledges each UBX-CFG-VALSET with UBX-ACK-ACK, encoded by pyubx2.

    A command that sets a key with `refuses` in its name gets -NAK, with `silent` nothing.
    """

    def reply(command: bytes) -> bytes:
        keys = " ".join(vars(UBXReader.parse(command, msgmode=SET)))
        if silent and silent in keys:
            return b""
        kind = "ACK-NAK" if refuses and refuses in keys else "ACK-ACK"
        said: bytes = UBXMessage("ACK", kind, 0, clsID=0x06, msgID=0x8A).serialize()
        return said

    return reply


def novatel_replies(refuses: bytes = b"nothing") -> Reply:
    """Reply as a recorded receiver did: ``<OK`` and the prompt."""
    return lambda line: b"\r\n<ERROR:Invalid Message ID\r\n[COM1]" if refuses in line else b"\r\n<OK\r\n[COM1]"


def septentrio_replies(refuses: bytes = b"nothing") -> Reply:
    """Reply as the PolaRx5TR reference guide states (3.1.3)."""

    def reply(line: bytes) -> bytes:
        name = line.split(b",")[0]
        if refuses in line:
            return b"$R? " + name + b": Argument 'Stream' is invalid!\r\nCOM1>"
        return b"$R: " + line + b"\r\n  " + line[3:] + b"\r\nCOM1>"

    return reply


@contextmanager
def udp_receiver(port: int, reply: Reply) -> Iterator[list[bytes]]:
    """Provide a network device at 127.0.0.2 that replies to every command; yield the commands it received."""
    commands: list[bytes] = []
    stop = threading.Event()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.2", port))
        sock.settimeout(0.05)

        def run() -> None:
            while not stop.is_set():
                with suppress(TimeoutError):
                    data, peer = sock.recvfrom(4096)
                    commands.append(data.removesuffix(b"\r\n"))
                    sock.sendto(reply(commands[-1]), peer)

        thread = threading.Thread(target=run)
        thread.start()
        try:
            yield commands
        finally:
            stop.set()
            thread.join()
