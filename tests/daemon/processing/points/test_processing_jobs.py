"""Tests jobs: the same bytes in one process, several and a cluster; an index gives each job its chunks."""

from __future__ import annotations

import importlib
import json
import os
import struct
import subprocess
import sys
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from swath.daemon.cli.main import run_app
from swath.daemon.log.chunk_index import OP_CHUNK_INDEX, index_log, read_chunks
from swath.daemon.log.mcap.scan import summary_records
from swath.daemon.log.reader import open_logs
from swath.daemon.processing.georeferencing import run as products
from swath.daemon.processing.points import workers
from swath.daemon.processing.points.jobs import Job, JobResult, SessionPlan, Tell, run_job
from swath.georef.strips import Segment
from tests.daemon.builders import digests
from tests.daemon.commands import ROOT
from tests.daemon.one_line import Flown, fly
from tests.daemon.rig import HANGS_S

pytestmark = [pytest.mark.xdist_group("kernels"), pytest.mark.slow]


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Flown:
    return fly(tmp_path_factory.mktemp("line"))


def halves(flown: Flown, path: Path) -> str:
    """Write a file of two strips."""
    first, last = (int(flown.truth["left.gps_ns"][at]) for at in (0, -1))
    middle = (first + last) // 2
    path.write_text(f"start_gps_ns,end_gps_ns\n{first},{middle}\n{middle},{last}\n")
    return str(path)


@pytest.fixture(scope="module")
def alone(flown: Flown, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, str]]:
    """Return the file of strips, and the digests of what one process makes."""
    output = tmp_path_factory.mktemp("alone")
    strips = Path(halves(flown, output.parent / "halves.csv"))
    assert run_app(flown.arguments(output, "--strips", str(strips))) == 0
    return strips, digests(output)


class TestSameBytes:
    def test_two_processes_give_the_same_bytes(
        self, flown: Flown, alone: tuple[Path, dict[str, str]], tmp_path: Path
    ) -> None:
        strips, expected = alone
        assert run_app(flown.arguments(tmp_path, "--strips", str(strips), "--workers", "2")) == 0
        assert digests(tmp_path) == expected
        assert len(expected) == 6  # two strips, three files of the trajectory, the sidecar

    def test_a_cluster_of_two_gives_the_same_bytes(
        self, flown: Flown, alone: tuple[Path, dict[str, str]], tmp_path: Path
    ) -> None:
        distributed: Any = importlib.import_module("distributed")
        strips, expected = alone
        with distributed.LocalCluster(
            n_workers=2,
            threads_per_worker=1,
            processes=False,  # two workers in threads, which still communicate by TCP
            dashboard_address=None,
            protocol="tcp",
            host="127.0.0.1",
        ) as cluster:
            address = str(cluster.scheduler_address)
            assert run_app(flown.arguments(tmp_path, "--strips", str(strips), "--scheduler", address)) == 0
        assert digests(tmp_path) == expected


class TestIndex:
    def test_a_finished_part_and_one_that_was_cut_off_have_the_same_chunks(self, flown: Flown, tmp_path: Path) -> None:
        whole = index_log(open_logs([flown.log])[0])
        log = flown.copy_of_log(tmp_path)
        log.write_bytes(log.read_bytes()[:-20])  # its footer
        cut = index_log(open_logs([log])[0])
        assert cut.damage
        assert cut.chunks == whole.chunks
        assert whole.damage == []
        assert index_log(open_logs([log])[0], walk=False).chunks == []

    def test_a_wrong_bit_in_the_summary_does_not_change_the_chunks(self, flown: Flown, tmp_path: Path) -> None:
        whole = index_log(open_logs([flown.log])[0])
        log = flown.copy_of_log(tmp_path)
        data = bytearray(log.read_bytes())
        (summary_at,) = struct.unpack_from("<Q", data, len(data) - 28)
        with log.open("rb") as file:
            indexes = [one for one in summary_records(file, summary_at, len(data)) if one.opcode == OP_CHUNK_INDEX]
        data[indexes[3].offset + 9 + 5] ^= 1  # of its first message's time: 18 minutes
        log.write_bytes(data)
        index = index_log(open_logs([log])[0])
        assert index.chunks == whole.chunks
        assert [one.damage.what for one in index.damage] == ["index and footer are missing, cut off or wrong"]

    def test_indexed_chunks_equal_those_of_the_session(self, flown: Flown) -> None:
        session = open_logs([flown.log])[0]
        index = index_log(session)
        wanted = [batch.units.tobytes() for batch in session.batches(lambda topic: topic.startswith("/scanner/"))]
        found = read_chunks(index, index.scanner_chunks(), lambda topic: topic.startswith("/scanner/"), [])
        assert [batch.units.tobytes() for batch in found] == wanted

    def test_between_gives_exactly_the_chunks_with_messages_of_the_span(self, flown: Flown) -> None:
        index = index_log(open_logs([flown.log])[0])
        chunks = index.scanner_chunks()
        start, end = chunks[3].start_ns + 1, chunks[6].start_ns
        assert index.between(start, end) == chunks[3:6]
        assert index.between(start, end + 1) == chunks[3:7]

    def test_a_replaced_file_is_damage(self, flown: Flown, tmp_path: Path) -> None:
        log = flown.copy_of_log(tmp_path)
        index = index_log(open_logs([log])[0])
        log.write_bytes(log.read_bytes()[: index.chunks[4].offset + 7])
        damage: list[object] = []
        list(read_chunks(index, index.chunks[:6], None, damage))  # type: ignore[arg-type]
        assert len(damage) == 2
        assert "no chunk at the place that the index" in str(damage[0])


def counts(plan: SessionPlan, job: Job, tell: Tell) -> JobResult:
    """Return the result of a job that does nothing."""
    tell(5)
    return JobResult(job.session, job.segment.strip, 0, 0)


class TestWorkers:
    def jobs(self, count: int) -> list[Job]:
        """Return jobs without data."""
        return [Job(0, Segment(number, 0, 1), []) for number in range(count)]

    def test_results_come_in_the_order_of_the_jobs(self) -> None:
        told: list[int] = []
        results = workers.run_jobs([None], self.jobs(4), workers=1, scheduler=None, progress=told.append, do=counts)
        assert [result.strip for result in results] == [0, 1, 2, 3]
        assert told == [5, 10, 15, 20]

    def test_a_killed_process_gives_a_failed_strip(self) -> None:
        results = workers.run_jobs([None], self.jobs(2), workers=2, scheduler=None, progress=lambda done: None, do=dies)
        assert [bool(result.failed) for result in results] == [True, True]
        assert "memory" in results[0].failed

    @pytest.mark.parametrize("guarded", [False, True])
    def test_a_script_without_a_main_guard_is_refused(self, tmp_path: Path, guarded: bool) -> None:
        """Spawned processes import the script again, which would start further ones."""
        script = tmp_path / "script.py"
        call = "run_jobs([None], jobs, workers=2, scheduler=None, progress=lambda done: None, do=counts)"
        script.write_text(
            "from swath.daemon.processing.points.jobs import Job, JobResult\n"
            "from swath.daemon.processing.points.workers import run_jobs\n"
            "from swath.georef.strips import Segment\n"
            "def counts(plan, job, tell):\n"
            "    return JobResult(job.session, job.segment.strip, 0, 0)\n"
            "jobs = [Job(0, Segment(number, 0, 1), []) for number in range(2)]\n"
            + ('if __name__ == "__main__":\n' if guarded else "if True:\n")
            + f"    print(len({call}), 'results')\n"
        )
        ended = subprocess.run(
            [sys.executable, str(script)],
            cwd=ROOT,
            env=os.environ | {"PYTHONPATH": str(ROOT)},
            capture_output=True,
            text=True,
            timeout=HANGS_S,
            check=False,
        )
        if guarded:
            assert ended.stdout == "2 results\n"
            return
        assert ended.returncode == 1
        last = ended.stderr.strip().splitlines()[-1]
        assert 'no worker process could start; put the call in the script under if __name__ == "__main__":' in last
        assert "called while a worker process imports the script" in ended.stderr
        assert "memory" not in ended.stderr


def dies(plan: SessionPlan, job: Job, tell: Tell) -> JobResult:
    os._exit(9)


def test_a_strip_that_failed_makes_the_products_partial(
    flown: Flown, alone: tuple[Path, dict[str, str]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:

    def second_fails(plan: SessionPlan, job: Job, tell: Tell) -> JobResult:
        if job.segment.strip == 2:
            assert job.path is not None
            job.path.write_bytes(b"half a file")
            return workers._failed(job, "the process died")
        return run_job(plan, job, tell)

    monkeypatch.setattr(products, "run_jobs", partial(workers.run_jobs, do=second_fails))
    assert run_app(flown.arguments(tmp_path, "--strips", str(alone[0]))) == 1
    told = json.loads((tmp_path / f"{flown.name}.json").read_text())
    assert not told["complete"]
    assert told["holes"] == ["strip 2: the process died"]
    assert told["strips"][1]["file"] is None
    names = [path.name for path in tmp_path.glob("*.laz")]
    assert names == [f"{flown.name}_strip01.laz"]
