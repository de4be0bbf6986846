"""Tests what `swath live` follows and skips, and when it reports the end."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from swath.daemon.log.claim import claim
from swath.daemon.log.directory import LOCK
from swath.daemon.log.format import SessionInfo
from swath.daemon.log.mcap.chunks import LogBatch
from swath.daemon.log.mcap.encode import encode_block
from swath.daemon.log.mcap.writer import PartWriter
from swath.daemon.log.parts import RECORDING_SIGN
from swath.daemon.processing.live import follow as live_follow
from swath.daemon.processing.live.follow import LiveFollower, Skipped, cached_from, is_cached
from swath.georef.timescales.gps_time import SECOND_NS
from tests.daemon.builders import INFO, ROVER_CHANNEL, SCANNER_CHANNEL, START_NS

STEP_NS = 250_000_000  # a chunk of each class
Unit = tuple[str, int]


class Recording:
    """A recorder's files written by hand: units contain their own number, one of each class every 250 ms."""

    def __init__(self, folder: Path, info: SessionInfo = INFO) -> None:
        self.folder, self.info = folder, info
        self.number = self.steps = 0
        self.units: list[Unit] = []
        self.writer = self._open()

    def _open(self) -> PartWriter:
        path = self.folder / f"{self.info.session_id}_{self.number}.mcap"
        writer = PartWriter(path, self.info, self.number)
        for channel_id, spec in enumerate((SCANNER_CHANNEL, ROVER_CHANNEL), start=1):
            writer.add_channel(channel_id, spec)
        sign = {"session_id": self.info.session_id, "part": self.number, "path": path.name, "boot_id": "boot"}
        (self.folder / RECORDING_SIGN).write_text(json.dumps(sign))
        return writer

    def go_on(self, seconds: float) -> None:
        for _ in range(round(seconds * 4)):
            time_ns = START_NS + self.steps * STEP_NS
            for channel_id, spec in enumerate((SCANNER_CHANNEL, ROVER_CHANNEL), start=1):
                unit = np.frombuffer(self.steps.to_bytes(8, "little"), np.uint8).reshape(1, 8)
                self.writer.add(encode_block(channel_id, self.steps, np.array([time_ns], dtype=np.int64), unit))
                self.units.append((spec.topic, self.steps))
            self.writer.flush()
            self.steps += 1

    def split(self, *, last: float = 0.0) -> None:
        """Begin the next part before this one is finished; ``last`` gives the seconds that still go into this one."""
        before, self.number = self.writer, self.number + 1
        following = self._open()
        self.go_on(last)
        before.finish()
        self.writer = following

    def stop(self) -> None:
        self.writer.finish()
        (self.folder / RECORDING_SIGN).unlink()

    def of(self, topic: str, first_s: float = 0.0) -> list[Unit]:
        return [unit for unit in self.units if unit[0] == topic and unit[1] >= first_s * 4]


@pytest.fixture
def recording(tmp_path: Path) -> Recording:
    return Recording(tmp_path)


Follow = Callable[..., LiveFollower]


@pytest.fixture
def follow(tmp_path: Path) -> Iterator[Follow]:
    """Return a function that makes followers of the recording."""
    made: list[LiveFollower] = []

    def make(*, from_start: bool = False) -> LiveFollower:
        made.append(LiveFollower(tmp_path, from_start=from_start))
        return made[-1]

    yield make
    for follower in made:
        follower.close()


def units_of(items: Iterator[LogBatch | Skipped]) -> list[Unit]:
    found: list[Unit] = []
    for item in items:
        if isinstance(item, LogBatch):
            found += [(item.channel.topic, int.from_bytes(row.tobytes(), "little")) for row in item.units]
    return found


class TestFollowing:
    def test_every_unit_is_given_once_in_order_over_all_parts(self, recording: Recording, follow: Follow) -> None:
        follower = follow()
        seen = []
        for _ in range(3):
            for _ in range(4):
                recording.go_on(1.0)
                seen += units_of(follower.poll())
            recording.split()
        recording.go_on(1.0)
        recording.stop()
        while not follower.ended:
            seen += units_of(follower.poll())
        assert seen == recording.units
        assert follower.ended == "the recording has ended"
        assert (follower.skipped_ns, follower.damaged) == (0, 0)

    def test_a_part_being_finished_is_read_to_its_end(self, recording: Recording, follow: Follow) -> None:
        """The next part exists already, but the last chunks of this one are not written."""
        follower = follow()
        recording.go_on(1.0)
        seen = units_of(follower.poll())
        before, recording.number = recording.writer, recording.number + 1
        following = recording._open()
        for _ in range(5):
            seen += units_of(follower.poll())
        recording.go_on(1.0)
        before.finish()
        recording.writer = following
        recording.go_on(1.0)
        seen += units_of(follower.poll())
        assert seen == recording.units

    def test_waits_for_a_recording_that_has_not_begun(self, tmp_path: Path, follow: Follow) -> None:
        follower = follow()
        assert units_of(follower.poll()) == []
        assert follower.ended == ""
        recording = Recording(tmp_path)
        recording.go_on(1.0)
        assert units_of(follower.poll()) == recording.units

    @pytest.mark.parametrize("is_whole", [True, False])
    def test_a_recorder_whose_disk_is_full_goes_on_in_a_new_part(
        self, recording: Recording, follow: Follow, monkeypatch: pytest.MonkeyPatch, is_whole: bool
    ) -> None:
        """While it waits for space it holds its directory's lock, and no part grows; its end may be missing."""
        monkeypatch.setattr(live_follow, "GONE_S", 0.0)
        with (recording.folder / LOCK).open("w") as lock:
            assert claim(lock.fileno())
            follower = follow()
            recording.go_on(1.0)
            seen = units_of(follower.poll())
            recording.stop() if is_whole else recording.writer.close()
            for _ in range(3):
                seen += units_of(follower.poll())
            assert follower.ended == ""
            recording.number += 1
            recording.writer = recording._open()
            recording.go_on(1.0)
            seen += units_of(follower.poll())
            recording.stop()
        seen += units_of(follower.poll())
        assert seen == recording.units
        assert follower.ended == "the recording has ended"

    def test_a_killed_recorder_is_distinguished_from_a_finished_one(
        self, recording: Recording, follow: Follow, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(live_follow, "GONE_S", 0.0)
        follower = follow()
        recording.go_on(1.0)
        seen = units_of(follower.poll())
        assert follower.ended == "", "the writer holds its claim"
        recording.go_on(1.0)
        recording.writer.close()
        for _ in range(3):
            seen += units_of(follower.poll())
        assert seen == recording.units
        assert follower.ended == "the recorder stopped without closing its log"


class TestSkipping:
    def test_more_than_five_seconds_behind_scanner_data_is_skipped_to_the_end(
        self, recording: Recording, follow: Follow
    ) -> None:
        follower = follow()
        recording.go_on(2.0)
        units_of(follower.poll())
        recording.go_on(8.0)
        items = list(follower.poll())
        assert units_of(iter(items)) == recording.of("/gnss/rover/raw", 2.0)
        [skipped] = [item for item in items if isinstance(item, Skipped)]
        assert skipped == Skipped(START_NS + 2 * SECOND_NS, START_NS + 10 * SECOND_NS - STEP_NS)
        assert follower.skipped_ns == 8 * SECOND_NS - STEP_NS
        recording.go_on(1.0)
        assert units_of(follower.poll()) == recording.units[-8:]

    def test_a_delay_of_five_seconds_is_caught_up(self, recording: Recording, follow: Follow) -> None:
        follower = follow()
        recording.go_on(0.5)
        seen = units_of(follower.poll())
        recording.go_on(5.0)
        assert seen + units_of(follower.poll()) == recording.units
        assert follower.skipped_ns == 0

    def test_a_late_start_reads_the_last_minutes_without_scanners(self, recording: Recording, follow: Follow) -> None:
        recording.go_on(100.0)
        recording.split()
        recording.go_on(60.0)
        follower = follow()
        first_s = 160.0 - STEP_NS / SECOND_NS - live_follow.WARM_NS / SECOND_NS
        assert units_of(follower.poll()) == recording.of("/gnss/rover/raw", first_s), "of the part before too"
        assert follower.skipped_ns == 0
        recording.go_on(1.0)
        assert units_of(follower.poll()) == recording.units[-8:]

    def test_only_the_last_two_minutes_of_a_long_log_are_read(self, recording: Recording, follow: Follow) -> None:
        recording.go_on(200.0)
        follower = follow()
        seen = units_of(follower.poll())
        assert seen == recording.of("/gnss/rover/raw", 200.0 - STEP_NS / SECOND_NS - live_follow.WARM_NS / SECOND_NS)

    def test_from_start_reads_everything(self, recording: Recording, follow: Follow) -> None:
        recording.go_on(40.0)
        recording.split()
        recording.go_on(30.0)
        follower = follow(from_start=True)
        assert units_of(follower.poll()) == recording.units
        recording.go_on(8.0)
        assert [unit for unit in units_of(follower.poll()) if unit[0] == SCANNER_CHANNEL.topic] == [], (
            "caught up by then"
        )

    def test_data_outside_the_page_cache_are_not_read(
        self, recording: Recording, follow: Follow, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        recording.go_on(1.0)
        follower = follow()
        units_of(follower.poll())
        recording.go_on(8.0)
        asked: list[int] = []

        def no(fd: int, at: int, length: int) -> bool:
            asked.append(at)
            return False

        monkeypatch.setattr(live_follow, "is_cached", no)
        assert units_of(follower.poll()) == []
        assert len(asked) == 32, "scanners' chunks are passed over without asking"
        assert follower.skipped_ns == 8 * SECOND_NS - STEP_NS


class TestPageCache:
    def test_written_data_are_cached_and_dropped_data_are_not(self, tmp_path: Path) -> None:
        path = tmp_path / "file"
        path.write_bytes(os.urandom(20 << 20))
        with path.open("rb") as file:
            fd = file.fileno()
            os.fsync(fd)
            assert is_cached(fd, 12_345, 15 << 20)
            assert cached_from(fd, 20 << 20) == 0
            os.posix_fadvise(fd, 0, 10 << 20, os.POSIX_FADV_DONTNEED)
            assert is_cached(fd, 11 << 20, 9 << 20)
            if is_cached(fd, 0, 4096):
                pytest.skip("a file system that keeps everything in memory")
            assert cached_from(fd, 20 << 20) == 12 << 20
            assert not is_cached(fd, 0, 20 << 20)

    def test_an_unknown_file_counts_as_not_cached(self, tmp_path: Path) -> None:
        assert not is_cached(-1, 0, 10)
