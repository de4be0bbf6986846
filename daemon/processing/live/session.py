"""Runs the live georeferencer: follows a recording, or replays finished logs by the same code, and reports its status.

The messages go in the file's order into a `LogFeed`; the points depend on the log alone. Only the operator's files, and
the chunks that are skipped when this computer is too slow, depend on the wall clock.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from swath.daemon.config.tables import LiveConfig
from swath.daemon.errors import ExitCode, UserError, one_line
from swath.daemon.log.format import SessionInfo
from swath.daemon.log.mcap.chunks import LogBatch
from swath.daemon.log.reader import Session
from swath.daemon.log.session import read_boot_id
from swath.daemon.processing.carried_verdict import calibration_verdicts, verdict_entry
from swath.daemon.processing.landing.checks import Covered
from swath.daemon.processing.landing.command import PAGE, PRINTED, VERDICT, PagePrinter
from swath.daemon.processing.landing.page import landing_page, read_verdict
from swath.daemon.processing.landing.watch import Landing, Places
from swath.daemon.processing.live.files import replace_file
from swath.daemon.processing.live.follow import LiveFollower, LivePart, Skipped
from swath.daemon.processing.live.lines import LINES, LiveLines
from swath.daemon.processing.live.points import PointsFile
from swath.daemon.processing.live.products import LiveProducts, Room
from swath.daemon.processing.live.serve import LiveServer
from swath.daemon.processing.live.status import LiveStatus, is_well, sentence, write_status
from swath.daemon.processing.live.tiles import FOLDER, Placement
from swath.daemon.processing.live.unanswered import UnansweredPulses
from swath.daemon.processing.pages.head import calibrations_words, crs_words
from swath.daemon.processing.points.feed import LogFeed, Placed
from swath.daemon.processing.setup.sent_files import SentFiles
from swath.daemon.processing.setup.setup import Options, Setup, config_in_log
from swath.drivers.scanner.srep.parser import SrepParser
from swath.georef.arrays import StructArray
from swath.georef.georeference import Georeferencer
from swath.georef.timescales.gps_time import SECOND_NS
from swath.georef.trajectory.trajectory import Trajectory

POLL_S = 0.05
SAVE_NS = 100_000_000  # of the log's time, between two looks for what has to be written
PUBLISH_NS = 2 * SECOND_NS
STATUS_S = 1.0
PRINT_WAIT_S = 8.0  # for the page at the end; the service has to end in time
COVERAGE_S = 10.0
COVERAGE_SHARE = 100.0  # times as long as it takes; on large areas the coverage is saved less often
SENT_WAIT_NS = 10_000_000_000  # how long a recording may go on until its scanners have sent their angles

Told = dict[str, Any]


class _SeenPath:
    """A stream's path that remembers its last trajectory."""

    def __init__(self, path: Any) -> None:
        self.trajectory: Trajectory | None = None
        self._path = path

    @property
    def covered_until_ns(self) -> int | None:
        covered: int | None = self._path.covered_until_ns
        return covered

    def add(self, rows: StructArray) -> None:
        self._path.add(rows)

    def update(self) -> Trajectory | None:
        self.trajectory = self._path.update()
        return self.trajectory


class LiveSession:
    """One recording and its points.

    Attributes:
        now_ns: host time up to which the log has been read; a live session uses the clock instead.
        verdict: verdict on the calibrations, for the status.
        lines: the state of the lines.
        landing: the verdict before landing.
        folder: of its files.
        printer: writes the verdict's page.
        log_state: what is known of the log: ``part``, ``damaged_chunks``, ``live_skipped_s``.
    """

    def __init__(
        self,
        setup: Setup,
        info: SessionInfo,
        folder: Path,
        live: LiveConfig,
        points: Path | None,
        *,
        beside_recorder: bool = False,
        accept_verdict: bool = False,
        server: LiveServer | None = None,
    ) -> None:
        """Prepare a session.

        ``points`` is the file for all points, for comparisons; None: no such file.

        Raises:
            OSError: a file cannot be written; UserError: there is no source of a trajectory.
        """
        self.info = info
        source = "navigated" if setup.sources.ins_source is None else "ins"
        self.verdict = verdict_entry(list(calibration_verdicts(setup, source)), accepted=accept_verdict)
        self.now_ns = self._saved_ns = self._published_ns = 0
        self._stream = setup.live_stream(info)
        self._path = _SeenPath(self._stream.path)
        self._stream.path = self._path
        tables = setup.config.tables
        head = {
            "aircraft": tables.profile.aircraft,
            "author": tables.profile.operator,
            "crs": "" if setup.mapping is None else crs_words(setup.mapping.description()),
            "calibrations": calibrations_words(setup.calibrations),
        }
        self.landing = Landing(info, folder, tables.plan, list(tables.corrections), self.verdict, head)
        self.lines = LiveLines(setup, self._stream, folder, self.landing.facts)
        self._feed = LogFeed(setup, self._stream, self.lines)
        self.lines.parser = self._feed.parser
        if setup.sources.ins_source is None and self._feed.navigator is None:
            raise UserError(
                f"{info.session_id}: the configuration has neither a device with an INS solution nor both an IMU and "
                "a receiver, and without a trajectory there are no live products; add these devices, or georeference "
                "after the recording",
                ExitCode.USAGE,
            )
        reserve_bytes = int(setup.config.session.reserve_mb * 1e6)
        about = setup.options.crs or setup.config.output.crs or "EPSG:4978 (no [output] crs)"
        self.products = LiveProducts(folder, live, setup.mapping, reserve_bytes, about, self._gps_from_host, server)
        self.status = LiveStatus(setup, self._stream, self.products, self._feed.fixes)
        self.log_state: Told = {}
        self.folder, self.printer = folder, PagePrinter(folder)
        (folder / PRINTED).unlink(missing_ok=True)  # of a recording before
        self._ask_for_unanswered()
        self.points: PointsFile | None = None
        if points is not None:
            room = Room(points.parent, 2 * reserve_bytes) if beside_recorder else None
            self.points = PointsFile(points, self._stream.scanners, room)
        self._is_own = info.boot_id == read_boot_id()

    def _ask_for_unanswered(self) -> None:
        """Let the parsers that can tell pulses without a return do so, for the map."""
        for name in self._stream.scanners:
            chain, parser = self._stream.chain(name), self._feed.parser(f"scanner/{name}")
            if isinstance(parser, SrepParser) and isinstance(chain.georeferencer, Georeferencer):
                self.products.unanswered[name] = UnansweredPulses(chain.georeferencer)
                parser.unanswered, chain.unanswered = True, self.products.unanswered[name].take_pulses

    def take(self, batch: LogBatch, *, live: bool) -> None:
        """Take the next messages."""
        self.now_ns = max(self.now_ns, int(batch.log_time_ns[-1]))
        self.status.note_batch(batch, self.host_now_ns(live=live))
        self.landing.note_batch(batch)
        if batch.channel.chunk_class == "scanner":
            self.products.map.cutter.note_laser(int(batch.log_time_ns[0]), int(batch.log_time_ns[-1]))
        placed = self._feed.take(batch)
        self.status.navigation = None if self._feed.navigator is None else self._feed.navigator.state
        if placed:
            self._give(placed, live=live)
        self.products.take_pose(self._path.trajectory, self.now_ns)
        if self.now_ns >= self._saved_ns + SAVE_NS:
            self._saved_ns = self.now_ns
            self.products.save_map({"session_id": self.info.session_id}, self.now_ns)
            self._save_lines()
            self._tell()
            if self.landing.is_due(self.now_ns):
                self._save_verdict(live=live)

    def _save_verdict(self, *, live: bool, last: bool = False) -> None:
        """Write the verdict before landing, unless free space is low."""
        if not self.products.room.is_enough:
            return
        found = self._covered()
        is_asked = self.landing.is_asked
        lines, comparison = self.lines, self.products.map.comparison
        verdict = self.landing.verdict(
            lines.watch, lines.plan, lines.trouble, found, comparison.total.numbers(), self.log_state
        )
        try:
            if is_asked or last:
                self.landing.save_flown()
            self.landing.save(verdict, self.now_ns)
        except OSError as error:
            self.products.trouble = f"{VERDICT}: {error.strerror or error}: the verdict is not written"
            return
        if is_asked and live:
            self.printer.ask()

    def print_verdict(self, *, live: bool) -> None:
        """Write the page of the last verdict, and its PDF if the operator has asked for it during the flight."""
        if not self.products.room.is_enough:
            return
        with contextlib.suppress(UserError, OSError):  # there is none, as products.trouble says
            replace_file(self.folder / PAGE, landing_page(self.folder, read_verdict(self.folder)).encode())
        if live and self.printer.has_printed:
            self.printer.ask(predict=False)  # a prediction takes longer than the service may
            if not self.printer.finish(PRINT_WAIT_S):
                (self.folder / PRINTED).unlink(missing_ok=True)  # it is of an earlier verdict

    def _covered(self) -> Covered | None:
        """Return how the area is covered; None: nothing is known of it."""
        frame, grid = self.products.frame, self.products.map.grid
        places = None
        if frame is not None:
            placement = Placement.of(self.products.placement())
            places = Places(frame.of_geodetic, None if placement is None else placement.geodetic)
        try:
            return self.landing.look((grid.cell_m, grid.take_unseen()), self.lines.watch, self.lines.plan, places)
        except ValueError:  # the area lies beyond the mapping frame
            return None

    def _tell(self) -> None:
        """Give the status in a sentence, every other second of the log's time."""
        if self.now_ns < self._published_ns + PUBLISH_NS:
            return
        passed_s, self._published_ns = (self.now_ns - self._published_ns) / SECOND_NS, self.now_ns
        found = {"state": "following", "session_id": self.info.session_id, "verdict": self.verdict}
        found |= self.status.brief(self.now_ns, passed_s) | self.lines.plain_status()
        self.products.publish_status(one_line(sentence(found)), well=is_well(found), log_time_ns=self.now_ns)

    def _save_lines(self, *, last: bool = False) -> None:
        """Write the state of the lines, unless free space is low."""
        if self.products.room.is_enough:
            try:
                self.lines.save(self.now_ns, last=last)
            except OSError as error:
                self.products.trouble = f"{LINES}: {error.strerror or error}: the lines are not written"

    def _gps_from_host(self, host_ns: int) -> int | None:
        """Return the GPS time of a host time by the clock of the first scanner that has one; None: there is none."""
        host = self._stream.clocks.host
        for name in self._stream.scanners:
            device = host.plan.devices.get(f"scanner/{name}")
            if device is not None:
                gps_ns, sigma_ns = host.gps_from_host(device.clock, np.array([host_ns]))
                if np.isfinite(sigma_ns[0]):
                    return int(gps_ns[0])
        return None

    def host_now_ns(self, *, live: bool) -> int:
        """Return the session's host time; if another computer recorded it, the time of the last message read."""
        if live and self._is_own:
            return time.monotonic_ns() + self.info.realtime_ns - self.info.monotonic_ns
        return self.now_ns

    def _give(self, placed: Placed, *, live: bool) -> None:
        for name, points in placed:
            if self.points is not None:
                self.points.add(name, points)
            self.products.take(name, points, self._path.trajectory, self.now_ns)
            self.status.note_points(name, points.time_ns, self.host_now_ns(live=live))

    def close(self, *, live: bool) -> None:
        """Flush the points that still wait at the log's end, and close the files."""
        self._give(self._feed.close(), live=live)
        self.look_for_room()
        self.products.map.end()
        self.products.save_map({"session_id": self.info.session_id}, self.now_ns, last=True)
        self._save_lines(last=True)
        self._save_verdict(live=live, last=True)
        self.print_verdict(live=live)
        self.products.close()
        if self.points is not None:
            self.points.close()

    def look_for_room(self) -> None:
        """Check for free space; call once a second."""
        self.products.look_for_room()
        self.printer.look()
        if self.points is not None:
            self.points.look_for_room()


class Live:
    """Follows one recording in a directory until it ends.

    Args:
        directory: directory of the log.
        live: settings of the operator's files.
        tell: called with the status each second, with its ``sentence``.
        prepare: called with the recording's setup before the first of its messages is taken, to compile what it needs.
        accept_verdict: accept an unusable calibration.
        server: serves what live.mcap gets; None: nobody.
    """

    def __init__(
        self,
        directory: Path,
        live: LiveConfig,
        tell: Callable[[Told], None],
        *,
        from_start: bool = False,
        points: Path | None = None,
        prepare: Callable[[Setup], None] | None = None,
        accept_verdict: bool = False,
        server: LiveServer | None = None,
    ) -> None:
        self._accept_verdict, self._server = accept_verdict, server
        self._directory, self._live, self._tell, self._points = directory, live, tell, points
        self._prepare = prepare
        self._follower = LiveFollower(directory, from_start=from_start)
        self._session: LiveSession | None = None
        self._sent: SentFiles | None = None
        self._held: list[LogBatch] = []
        self._told_s = self._covered_s = -COVERAGE_S
        self._coverage_s = COVERAGE_S
        self._trouble = ""

    def run(self, stopped: Callable[[], bool]) -> Told:
        """Run until the recording ends or ``stopped`` returns True; return the last status.

        Raises:
            UserError: the recording's configuration cannot be used, or no file can be written.
        """
        try:
            while not stopped() and not self._follower.ended:
                for item in self._follower.poll():
                    self._take(item)
                    self._look_at_clock()
                    if stopped():
                        break
                self._look_at_clock()
                if not self._follower.ended:
                    time.sleep(POLL_S)
            return self._end()
        finally:
            self._follower.close()

    def _take(self, item: LogBatch | Skipped) -> None:
        part = self._follower.part
        if isinstance(item, Skipped) or part is None:
            return  # the gap looks like a hole in the log to the stream; the follower counts it
        if self._session is not None:
            self._session.take(item, live=True)
            return
        if self._sent is None:
            self._sent = SentFiles(config_in_log(part.attachments))
        self._held.append(item)
        self._sent.take(item)
        waited_ns = int(item.log_time_ns[-1]) - int(self._held[0].log_time_ns[0])
        if not self._sent.missing or waited_ns > SENT_WAIT_NS:
            self._begin(part, self._sent.found)

    def _begin(self, part: LivePart, sent: Mapping[str, bytes]) -> None:
        """Begin the session with the messages that waited for what the scanners send."""
        setup = Setup.of_log(part.attachments, Options(uncertainty=False), sent)
        if self._prepare is not None:
            self._prepare(setup)
        self._session = made_session(
            setup,
            part.info,
            self._directory / FOLDER,
            self._live,
            self._points,
            beside_recorder=True,
            accept_verdict=self._accept_verdict,
            server=self._server,
        )
        held, self._held = self._held, []
        for batch in held:
            self._session.take(batch, live=True)

    def _look_at_clock(self) -> None:
        """Report the status once a second, and save the coverage now and then."""
        now_s = time.monotonic()
        if now_s - self._told_s < STATUS_S:
            return
        self._told_s = now_s
        if self._session is not None:
            self._session.log_state = self._log_state()
            self._session.look_for_room()
            if now_s - self._covered_s > self._coverage_s:
                self._covered_s = now_s
                self._session.products.save_coverage(self._about())
                self._coverage_s = max(COVERAGE_S, COVERAGE_SHARE * (time.monotonic() - now_s))
        waiting = "waiting for a recording to begin"
        if self._held and self._sent is not None:
            waiting = f"waiting for the angles of scanner {', '.join(self._sent.missing)}"
        self._say("following" if self._session is not None else waiting)

    def _log_state(self) -> Told:
        follower = self._follower
        damaged = follower.damaged + (follower.part.damaged if follower.part else 0)
        part = None if follower.part is None else follower.part.number
        return {"part": part, "damaged_chunks": damaged, "live_skipped_s": follower.skipped_ns * 1e-9}

    def _about(self) -> Told:
        part = self._follower.part
        return {} if part is None else {"session_id": part.info.session_id, "part": part.number}

    def _say(self, state: str) -> Told:
        found: Told = {"state": state, "directory": str(self._directory), **self._about()}
        if self._session is not None:
            now_ns = self._session.host_now_ns(live=True)
            found |= {"time_ns": now_ns, "verdict": self._session.verdict}
            found |= self._session.status.plain(self._follower, now_ns) | self._session.lines.plain_status()
            if self._session.points is not None and self._session.points.trouble:
                found["points_file"] = self._session.points.trouble
        found["sentence"] = one_line(sentence(found))
        if self._session is not None:
            with contextlib.suppress(OSError):  # the sentence is reported all the same
                write_status(self._directory / FOLDER, found)
        self._tell(found)
        return found

    def _end(self) -> Told:
        part = self._follower.part
        if self._held and part is not None and self._sent is not None:
            self._begin(part, self._sent.found)
        if self._session is not None:
            self._session.log_state = self._log_state()
            self._session.close(live=True)
            self._session.products.save_coverage(self._about())
        found = self._say(f"ended ({self._follower.ended or 'stopped'})")
        if self._session is not None:
            self._session.products.export_coverage()  # last: it takes long on large areas
        return found


def made_session(
    setup: Setup,
    info: SessionInfo,
    folder: Path,
    live: LiveConfig,
    points: Path | None,
    *,
    beside_recorder: bool = False,
    accept_verdict: bool = False,
    server: LiveServer | None = None,
) -> LiveSession:
    """Return a session; refuse with `UserError` a folder that cannot be written to."""
    try:
        session = LiveSession(
            setup,
            info,
            folder,
            live,
            points,
            beside_recorder=beside_recorder,
            accept_verdict=accept_verdict,
            server=server,
        )
        session.look_for_room()
        return session
    except OSError as error:
        text = f"{error.filename or folder}: {error.strerror or error}; swath live writes its products there"
        raise UserError(one_line(text), ExitCode.IO) from error


def replay(
    session: Session,
    setup: Setup,
    folder: Path,
    live: LiveConfig,
    points: Path | None,
    tell: Callable[[int], None] | None = None,
    batches: Iterable[LogBatch] | None = None,
    *,
    accept_verdict: bool = False,
    server: LiveServer | None = None,
) -> Told:
    """Run a session over a finished log at full speed; return the last status, which is also written to ``folder``.

    Args:
        session: session from `open_logs`.
        points: file for all points; None: no such file.
        tell: called with the log time reached.
        batches: batches instead of the session's own, cut differently.
        accept_verdict: accept an unusable calibration.
        server: serves what live.mcap gets; None: nobody.

    Raises:
        UserError: no file can be written.
    """
    run = made_session(setup, session.info, folder, live, points, accept_verdict=accept_verdict, server=server)
    try:
        for batch in session.batches() if batches is None else batches:
            run.take(batch, live=False)
            if tell is not None:
                tell(run.now_ns)
        run.log_state = {"part": session.parts[-1].number, "damaged_chunks": len(session.damage)}
        run.close(live=False)
        about = {"session_id": session.session_id, "part": session.parts[-1].number}
        run.products.save_coverage(about)
        run.products.export_coverage()
        found: Told = {"state": "replayed", **about, "time_ns": run.now_ns, "verdict": run.verdict}
        found |= run.status.plain(None, run.now_ns) | run.lines.plain_status()
        found["damaged_chunks"] = len(session.damage)
        found["sentence"] = one_line(sentence(found))
        write_status(folder, found)
    except OSError as error:
        raise UserError(one_line(f"{error.filename or folder}: {error.strerror or error}"), ExitCode.IO) from error
    return found
