"""Runs jobs here, in processes of this computer, or on a Dask cluster; the longest first, with the same results."""

from __future__ import annotations

import importlib
import multiprocessing
import pickle
import signal
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from typing import Any

from swath.daemon.errors import ExitCode, UserError
from swath.daemon.processing.compiling import mark_compiling, tell_of_workers
from swath.daemon.processing.points.jobs import Job, JobResult, run_job
from swath.daemon.system import held_interrupts
from swath.drivers.extras import how_to_install

TELL_EVERY_S = 0.2
CONNECT_S = 10
DIED = "the process died, possibly because memory ran out"
UNGUARDED = (
    'put the call in the script under if __name__ == "__main__":, because worker processes import the script; or use '
    "one worker"
)
END_S = 5.0  # for a process to end after it was terminated
Progress = Callable[[int], None]  # bytes done so far
Do = Callable[[Any, Job, Progress], JobResult]  # takes the plan of its session and a function for the bytes done

_plans: list[Any] = []  # in a worker process
_done: Any = None  # in a worker process: the shared count of bytes done


def refuse_in_import() -> None:
    """Refuse to start workers in a worker process that is only importing the main script.

    Raises:
        UserError: this process is such a worker.
    """
    if getattr(multiprocessing.current_process(), "_inheriting", False):  # `multiprocessing.spawn` uses the same flag
        raise UserError(f"called while a worker process imports the script: {UNGUARDED}")


def run_jobs(
    plans: Sequence[Any],
    jobs: Sequence[Job],
    *,
    workers: int,
    scheduler: str | None,
    progress: Progress,
    do: Do = run_job,
) -> list[JobResult]:
    """Run all jobs and return their results.

    Args:
        plans: plans of the sessions, `swath.daemon.processing.points.jobs.JobPlan`.
        jobs: jobs in any order.
        workers: number of processes on this computer; 1: this process.
        scheduler: address of a Dask scheduler; None: no cluster.
        progress: called with the bytes done.
        do: function that does a job; of a module, because processes find it by name.

    Returns:
        Results in the order of the jobs. A job whose process died is one that failed.

    Raises:
        JobError: points of a job cannot be stored in a file.
        OSError: reading or writing failed.
        UserError: there is no such scheduler, or a script that is only being imported calls this.
    """
    refuse_in_import()
    order = sorted(range(len(jobs)), key=lambda number: (-jobs[number].size, number))
    if scheduler is not None:
        results = _on_cluster(plans, jobs, order, scheduler, progress, do)
    elif workers <= 1:
        results = _here(plans, jobs, order, progress, do)
    else:
        results = _in_processes(plans, jobs, order, min(workers, len(jobs)), progress, do)
    return [results[number] for number in range(len(jobs))]


def _here(
    plans: Sequence[Any], jobs: Sequence[Job], order: list[int], progress: Progress, do: Do
) -> dict[int, JobResult]:
    done = 0

    def tell(size: int) -> None:
        nonlocal done
        done += size
        progress(done)

    return {number: do(plans[jobs[number].session], jobs[number], tell) for number in order}


def _failed(job: Job, why: str) -> JobResult:
    return JobResult(job.session, job.segment.strip, job.segment.start_ns, job.segment.end_ns, failed=why)


# ---------------------------------------------------------------------- processes of this computer


def _begin(plans: bytes, done: Any, begun: Any, compiling: Any) -> None:
    """Initialise a worker process; on an interrupt, the parent process ends it."""
    global _plans, _done
    begun.value = True
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    mark_compiling(compiling)
    _plans, _done = pickle.loads(plans), done


def _do(do: Do, job: Job) -> JobResult:
    def tell(size: int) -> None:
        with _done.get_lock():
            _done.value += size

    return do(_plans[job.session], job, tell)


def _in_processes(
    plans: Sequence[Any], jobs: Sequence[Job], order: list[int], workers: int, progress: Progress, do: Do
) -> dict[int, JobResult]:
    context = multiprocessing.get_context("spawn")
    done, begun, compiling = context.Value("q", 0), context.Value("b", False), context.Value("d", 0.0)
    before = set(multiprocessing.active_children())
    pool = ProcessPoolExecutor(workers, context, _begin, (pickle.dumps(list(plans)), done, begun, compiling))
    results: dict[int, JobResult] = {}
    futures: dict[Future[JobResult], int] = {}
    try:
        with held_interrupts():
            for number in order:
                try:
                    futures[pool.submit(_do, do, jobs[number])] = number
                except BrokenProcessPool:
                    results[number] = _failed(jobs[number], DIED)
        pending: set[Future[JobResult]] = set(futures)
        while pending:
            finished, pending = wait(pending, TELL_EVERY_S, FIRST_COMPLETED)
            for future in finished:
                number = futures[future]
                try:
                    results[number] = future.result()
                except BrokenProcessPool:
                    results[number] = _failed(jobs[number], DIED)
            if compiling.value:
                tell_of_workers(compiling.value)
            progress(int(done.value))
        if futures and not begun.value:
            raise UserError(f"no worker process could start; {UNGUARDED}")
    except BaseException:
        pool.shutdown(wait=False, cancel_futures=True)
        ours = set(multiprocessing.active_children()) - before
        for process in ours:
            process.terminate()
        for process in ours:
            process.join(END_S)
        raise
    pool.shutdown()
    return results


# ---------------------------------------------------------------------- a Dask cluster


def _on_cluster(
    plans: Sequence[Any], jobs: Sequence[Job], order: list[int], scheduler: str, progress: Progress, do: Do
) -> dict[int, JobResult]:
    try:
        distributed: Any = importlib.import_module("distributed")
    except ImportError:
        raise UserError(
            f"--scheduler needs dask and distributed: {how_to_install('cluster')}", ExitCode.USAGE
        ) from None
    try:
        client = distributed.Client(scheduler, timeout=CONNECT_S)
    except (OSError, ValueError) as error:
        raise UserError(f"{scheduler}: no Dask scheduler answers: {error}", ExitCode.IO) from error
    results: dict[int, JobResult] = {}
    done = 0
    with client:
        shared = client.scatter(list(plans), broadcast=True, hash=False)
        futures = {
            client.submit(_do_with, do, shared, jobs[number], pure=False, priority=-rank): number
            for rank, number in enumerate(order)
        }
        try:
            for future in distributed.as_completed(list(futures)):
                number = futures[future]
                results[number] = _result_of(future, jobs[number])
                done += jobs[number].size
                progress(done)
        except BaseException:
            with suppress(Exception):  # report the error that ends the run, not an unreachable worker
                client.cancel(list(futures), force=True)
            raise
    return results


def _do_with(do: Do, plans: list[Any], job: Job) -> JobResult:
    return do(plans[job.session], job, lambda size: None)


def _result_of(future: Any, job: Job) -> JobResult:
    """Return the result of a job on a cluster; a job whose worker was lost has failed."""
    scheduler = importlib.import_module("distributed.scheduler")
    try:
        result: JobResult = future.result()
    except (scheduler.KilledWorker, CancelledError) as error:
        return _failed(job, f"the cluster lost the task: {type(error).__name__}")
    return result
