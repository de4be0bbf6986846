"""The control socket: takes an operator's requests to a running recorder, one line of JSON for each connection.

    {"command": "mark", "text": "line 4 start"}      {"command": "split"}

The thread does a bounded amount of work in each turn and rests between turns, so that neither a flood of connections
nor silent peers slow the recording. Only the recorder's own user and root can connect, and members of its group if
it runs as a service, whose group is its own.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import json
import logging
import os
import select
import socket
import stat
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from swath.daemon.errors import one_line
from swath.daemon.log.directory import CONTROL_LINK
from swath.daemon.log.events import Events, Severity
from swath.daemon.log.format import SessionInfo
from swath.daemon.log.parts import Parts
from swath.daemon.recorder.writer import Recorder, Writing
from swath.daemon.system import name_thread

log = logging.getLogger("swath")

LINE_BYTES = 4096  # of a request, including its end
NOTE_CHARACTERS = 500
PEERS = 8  # at a time; as many more can wait in the kernel
PEER_S = 2.0  # allowed for sending a line
TURN_S = 0.05  # rest after each turn
NOTES_AT_ONCE = 20
NOTES_PER_S = 5.0
SPLITS_AT_ONCE = 3  # a new part costs a few syncs
SPLITS_PER_S = 1.0
IGNORED_REPORT_S = 60.0
LOOK_S = 1.0  # between two checks that the socket is still at its path
_SUN_PATH_BYTES = 107  # unix(7), without the terminating zero


class BadRequestError(Exception):
    """A line is not a valid request; the message is one line that gives the reason."""


def control_place(directory: Path) -> Path:
    """Return the path of the socket: in the unit's runtime directory, or in the log directory if there is no unit."""
    runtime = os.environ.get("RUNTIME_DIRECTORY", "").split(":")[0]
    return Path(runtime) / "control" if runtime else directory / CONTROL_LINK


@contextlib.contextmanager
def socket_address(place: Path) -> Iterator[str]:
    """Give a path as a socket address; a path longer than addresses may be goes through a descriptor of its folder."""
    if len(os.fsencode(place)) <= _SUN_PATH_BYTES:
        yield str(place)
        return
    folder = os.open(place.parent, os.O_PATH | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        yield f"/proc/self/fd/{folder}/{place.name}"
    finally:
        os.close(folder)


def listen(place: Path) -> socket.socket:
    """Return a listening socket for its owner and, in a unit, the unit's group; a dead socket at this path is replaced.

    Raises:
        OSError: another process listens there, another kind of file exists there, or the file system has no sockets.
    """
    folder = os.open(place.parent, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_NONBLOCK | socket.SOCK_CLOEXEC)
    try:
        fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)  # two that start at once must not remove each other's
        _make_way(place)
        os.fchmod(sock.fileno(), 0o600)  # before bind, which creates the file with this mode
        with socket_address(place) as address:
            sock.bind(address)
            if os.environ.get("RUNTIME_DIRECTORY"):  # outside the unit, the group may be everybody's
                os.chmod(address, 0o660)  # not before bind, because the umask would take the group's right away
        sock.listen(PEERS)
    except OSError:
        sock.close()
        raise
    finally:
        os.close(folder)
    return sock


def _make_way(place: Path) -> None:
    """Remove a socket that a dead recorder left."""
    try:
        mode = os.lstat(place).st_mode
    except FileNotFoundError:
        return
    if stat.S_ISSOCK(mode):
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_NONBLOCK) as probe:
            with contextlib.suppress(ConnectionRefusedError), socket_address(place) as address:
                probe.connect(address)
                raise OSError(errno.EADDRINUSE, "another recorder uses it")
    elif not stat.S_ISLNK(mode):
        raise OSError(errno.EEXIST, "the path is taken by something else")
    place.unlink()


def place_link(link: Path, target: Path) -> None:
    """Link a name in the log directory to the socket; raises OSError."""
    if link == target:
        return
    with contextlib.suppress(FileNotFoundError):
        mode = os.lstat(link).st_mode
        if not (stat.S_ISLNK(mode) or stat.S_ISSOCK(mode)):
            raise OSError(errno.EEXIST, f"{link} is taken by something else")
    new = link.with_name(f"{link.name}.new")
    new.unlink(missing_ok=True)
    new.symlink_to(target)
    new.replace(link)


@dataclass(slots=True)
class _Peer:
    """A connection whose line has not arrived yet."""

    sock: socket.socket
    until_s: float
    received: bytes = b""


@dataclass(slots=True)
class _Allowance:
    """Limits requests: ``most`` at once, and ``per_s`` per second over a longer time."""

    most: float
    per_s: float
    left: float = field(init=False)
    at_s: float = field(default_factory=time.monotonic)

    def __post_init__(self) -> None:
        self.left = self.most

    def take(self) -> bool:
        """Return True and count one request if another is allowed now."""
        now_s = time.monotonic()
        self.left = min(self.most, self.left + (now_s - self.at_s) * self.per_s)
        self.at_s = now_s
        if self.left < 1.0:
            return False
        self.left -= 1.0
        return True


class Recording(Protocol):
    """The parts of a running recorder that an operator's requests reach."""

    @property
    def info(self) -> SessionInfo: ...

    @property
    def parts(self) -> Parts: ...

    @property
    def recorder(self) -> Recorder: ...


class Control(threading.Thread):
    """Takes requests from an operator; a defect here ends only this thread.

    Attributes:
        ignored: number of connections without a valid request: too long, too late, not understood.
    """

    def __init__(self, recording: Recording, events: Events) -> None:
        super().__init__(name="control", daemon=True)
        directory = recording.parts.directory
        self.place = control_place(directory)
        self.ignored = 0
        self._link = directory / CONTROL_LINK
        self._recording = recording
        self._events = events
        self._end = threading.Event()
        self._sock: socket.socket | None = None
        self._inode: tuple[int, int] | None = None
        self._peers: list[_Peer] = []
        self._notes = _Allowance(NOTES_AT_ONCE, NOTES_PER_S)
        self._splits = _Allowance(SPLITS_AT_ONCE, SPLITS_PER_S)
        self._reported_ignored = (0, 0.0)  # count, CLOCK_MONOTONIC
        self._look_s = 0.0  # CLOCK_MONOTONIC of the next check

    # ------------------------------------------------------------------ start and end

    def open(self) -> None:
        """Begin to listen; if that fails, post an event, and the recording continues without a control socket."""
        try:
            self._listen()
        except OSError as error:
            text = f"no control socket at {self.place}: {error.strerror or error}; swath mark and split do not work"
            self._events.post(Severity.WARNING, "recorder", "control_absent", text)
        if self._sock is not None:
            self.start()

    def _listen(self) -> None:
        self._sock = listen(self.place)
        found = os.stat(self.place)
        self._inode = found.st_dev, found.st_ino
        place_link(self._link, self.place)

    def _come_back(self, now_s: float) -> None:
        """Listen again if the socket was removed, and restore its link, for example when the log directory is back."""
        if now_s < self._look_s:
            return
        self._look_s = now_s + LOOK_S
        with contextlib.suppress(OSError):
            if not os.path.lexists(self.place):
                gone = self._sock
                self._listen()
                if gone is not None:
                    gone.close()
            elif not os.path.lexists(self._link):
                place_link(self._link, self.place)

    def close(self) -> None:
        """Stop listening and remove everything that others could take for a running recorder."""
        self._end.set()
        if self._sock is not None:
            self.join(1.0)
            self._sock.close()
        with contextlib.suppress(OSError):
            found = os.lstat(self.place)
            if (found.st_dev, found.st_ino) == self._inode:
                self.place.unlink()
        with contextlib.suppress(OSError):
            if self._link.is_symlink() and self._link.readlink() == self.place and self._inode is not None:
                self._link.unlink()

    def run(self) -> None:
        """Handle connections, turn by turn, until the end."""
        name_thread("control")
        try:
            while not self._end.is_set():
                self._turn()
                self._end.wait(TURN_S)
        except Exception as error:
            text = f"the control socket failed, recording continues: {type(error).__name__}: {error}"
            self._events.post(Severity.ERROR, "recorder", "control_failed", text)
        finally:
            for peer in self._peers:
                peer.sock.close()
            if self._sock is not None:  # later connections are refused at once instead of waiting for an answer
                self._sock.close()

    # ------------------------------------------------------------------ one turn

    def _turn(self) -> None:
        """Wait, then accept at most `PEERS` connections and read once from each."""
        assert self._sock is not None
        listening = [self._sock] if len(self._peers) < PEERS else []
        ready, _, _ = select.select([*listening, *(peer.sock for peer in self._peers)], [], [], 0.5)
        if self._sock in ready:
            self._accept()
        now_s = time.monotonic()
        self._peers = [peer for peer in self._peers if not self._is_done(peer, peer.sock in ready, now_s)]
        self._tell_ignored(now_s)
        self._come_back(now_s)

    def _accept(self) -> None:
        assert self._sock is not None
        while len(self._peers) < PEERS:
            try:
                sock, _ = self._sock.accept()
            except OSError:  # no more connections, already closed, or no descriptor left
                return
            sock.setblocking(False)
            self._peers.append(_Peer(sock, time.monotonic() + PEER_S))

    def _is_done(self, peer: _Peer, ready: bool, now_s: float) -> bool:
        """Read from a peer and return whether the connection is finished, answered or not."""
        try:
            if ready:
                got = peer.sock.recv(LINE_BYTES - len(peer.received))
                peer.received += got
                if b"\n" in got:
                    self._answer(peer)
                elif got and len(peer.received) < LINE_BYTES:
                    return False
                else:
                    self.ignored += 1
            elif now_s < peer.until_s:
                return False
            else:
                self.ignored += 1
        except OSError:
            self.ignored += 1
        peer.sock.close()
        return True

    def _answer(self, peer: _Peer) -> None:
        try:
            answer = {"ok": True} | self._do(_parse(peer.received.partition(b"\n")[0]))
        except BadRequestError as error:
            self.ignored += 1
            answer = {"ok": False, "error": str(error)}
        peer.sock.send(json.dumps(answer).encode() + b"\n")

    def _tell_ignored(self, now_s: float) -> None:
        reported, reported_s = self._reported_ignored
        if self.ignored > reported and now_s - reported_s > IGNORED_REPORT_S:
            self._reported_ignored = self.ignored, now_s
            text = f"{self.ignored - reported} connections to the control socket sent no valid request"
            self._events.post(Severity.WARNING, "recorder", "control_ignored", text)

    # ------------------------------------------------------------------ requests

    def _do(self, request: dict[str, object]) -> dict[str, object]:
        health = self._recording.recorder.health
        recording = health.state is Writing.RECORDING
        answer: dict[str, object] = {
            "session_id": self._recording.info.session_id,
            "part": self._recording.parts.part,
            "recording": recording,
            "reason": health.reason if not recording else "",
        }
        match request.get("command"):
            case "mark":
                return answer | self._mark(request.get("text"))
            case "split":
                self._split()
                return answer
        raise BadRequestError("unknown command; this recorder accepts mark and split")

    def _mark(self, text: object) -> dict[str, object]:
        note = one_line(text).strip() if isinstance(text, str) else ""
        if not note or len(note) > NOTE_CHARACTERS:
            raise BadRequestError(f"a note needs 1 to {NOTE_CHARACTERS} characters")
        if not self._notes.take():
            raise BadRequestError(f"too many notes; at most {NOTES_PER_S:g} per second are accepted")
        event = self._events.post(Severity.INFO, "operator", "mark", note)
        return {"time_ns": event.time_ns, "text": note}

    def _split(self) -> None:
        recorder = self._recording.recorder
        if recorder.health.state is not Writing.RECORDING:
            raise BadRequestError(f"no recording is running: {recorder.health.reason}")
        if not self._splits.take():
            raise BadRequestError(f"too many new parts; at most {SPLITS_PER_S:g} per second is begun")
        recorder.new_part.set()


def _parse(line: bytes) -> dict[str, object]:
    try:
        request = json.loads(line)
    except (ValueError, RecursionError):
        request = None
    if not isinstance(request, dict):
        raise BadRequestError("a request must be one JSON object on one line")
    return request
