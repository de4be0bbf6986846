"""Does jobs: here, in processes of this computer, or on a Dask cluster; the longest first, with the same results."""

from __future__ import annotations

import importlib
import multiprocessing
import pickle
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from typing import Any

from swath.daemon.errors import ExitCode, UserError
from swath.daemon.processing.points.jobs import Job, JobResult, run_job
from swath.drivers.extras import how_to_install

TELL_EVERY_S = 0.2
CONNECT_S = 10
DIED = "the process died, as it does when memory is short"
UNGUARDED = 'want the call in a script under if __name__ == "__main__":, for processes import the script; or one worker'
END_S = 5.0  # for a process to end when it was told to
Progress = Callable[[int], None]  # bytes done so far
Do = Callable[[Any, Job, Progress], JobResult]  # with the plan of its session; is told bytes

_plans: list[Any] = []  # of a worker process
_done: Any = None  # its share of the bytes done


def refuse_in_import() -> None:
    """Refuse to begin anew in a worker process that is only importing the script which began it.

    Raises:
        UserError: this is one.
    """
    if getattr(multiprocessing.current_process(), "_inheriting", False):  # as `multiprocessing.spawn` finds it
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
    """Do all jobs.

    Args:
        plans: of the sessions, `swath.daemon.processing.points.jobs.JobPlan`.
        jobs: in any order.
        workers: processes here; 1: in this one.
        scheduler: address of a Dask scheduler; None: none.
        progress: is told the bytes done.
        do: what is done; a function of a module, for it is named to the processes.

    Returns:
        Results in the order of the jobs. A job whose process died is one that failed.

    Raises:
        JobError: the points of one cannot stand in a file.
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


def _begin(plans: bytes, done: Any, begun: Any) -> None:
    """What a worker process does first; on an interrupt the process that began it ends it."""
    global _plans, _done
    begun.value = True
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    _plans, _done = pickle.loads(plans), done


@contextmanager
def _held_interrupts() -> Iterator[None]:
    """An interrupt waits till the end of the block; processes begun within hold theirs till they release them.

    A process that is begun reads the plans for seconds: one that the interrupt found there would be left behind.
    """
    came: list[int] = []
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # which the processes inherit
    in_main = threading.current_thread() is threading.main_thread()
    before = signal.getsignal(signal.SIGINT)
    if in_main and callable(before):  # another thread may take the signal, and Python hand it to this one
        signal.signal(signal.SIGINT, lambda number, _: came.append(number))
    try:
        yield
    finally:
        if in_main and callable(before):
            signal.signal(signal.SIGINT, before)
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
    if came:
        raise KeyboardInterrupt


def _do(do: Do, job: Job) -> JobResult:
    def tell(size: int) -> None:
        with _done.get_lock():
            _done.value += size

    return do(_plans[job.session], job, tell)


def _in_processes(
    plans: Sequence[Any], jobs: Sequence[Job], order: list[int], workers: int, progress: Progress, do: Do
) -> dict[int, JobResult]:
    context = multiprocessing.get_context("spawn")
    done, begun = context.Value("q", 0), context.Value("b", False)
    before = set(multiprocessing.active_children())
    pool = ProcessPoolExecutor(workers, context, _begin, (pickle.dumps(list(plans)), done, begun))
    results: dict[int, JobResult] = {}
    futures: dict[Future[JobResult], int] = {}
    try:
        with _held_interrupts():
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
            progress(int(done.value))
        if futures and not begun.value:
            raise UserError(f"no worker process could be begun; {UNGUARDED}")
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
            f"--scheduler wants dask and distributed: {how_to_install('cluster')}", ExitCode.USAGE
        ) from None
    try:
        client = distributed.Client(scheduler, timeout=CONNECT_S)
    except (OSError, ValueError) as error:
        raise UserError(f"{scheduler}: no Dask scheduler answers there: {error}", ExitCode.IO) from error
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
            with suppress(Exception):  # what ends the run is told, not that a worker cannot be reached
                client.cancel(list(futures), force=True)
            raise
    return results


def _do_with(do: Do, plans: list[Any], job: Job) -> JobResult:
    return do(plans[job.session], job, lambda size: None)


def _result_of(future: Any, job: Job) -> JobResult:
    """Return what a job on a cluster gave; a job whose worker was lost is one that failed."""
    scheduler = importlib.import_module("distributed.scheduler")
    try:
        result: JobResult = future.result()
    except (scheduler.KilledWorker, CancelledError) as error:
        return _failed(job, f"lost by the cluster: {type(error).__name__}")
    return result
