"""Few long jobs, one after another in this process, or in several local processes (on a cluster: `on_ray`)."""

from __future__ import annotations

import multiprocessing
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from typing import Any, TypeVar

from improvo.jobs.workers import POLL_SECONDS, WorkerDiedError, one_thread_each, start_worker, with_errors_sent

Job = TypeVar("Job")
Result = TypeVar("Result")
Tick = Callable[[], None]  # a job calls it as it goes on; raises KeyboardInterrupt when all is to stop

_worker_ticks: Any = None  # set in worker processes
_worker_stop: Any = None


def run_here(
    work: Callable[[Job, Tick], Result],
    jobs: Sequence[Job],
    on_result: Callable[[Job, Result | Exception], None],
    on_ticks: Callable[[int], None],
) -> None:
    """One job after another; an exception of a job is its result, KeyboardInterrupt ends all.

    Args:
        work: does a job.
        jobs: in this order.
        on_result: is given each job with its answer, or the exception that it ended with.
        on_ticks: is told that so many more ticks have come.
    """
    for job in jobs:
        try:
            result: Result | Exception = work(job, lambda: on_ticks(1))
        except Exception as error:
            result = error
        on_result(job, result)


def run_in_processes(
    work: Callable[[Job, Tick], Result],
    jobs: Sequence[Job],
    on_result: Callable[[Job, Result | Exception], None],
    on_ticks: Callable[[int], None],
    workers: int,
) -> None:
    """As `run_here`, in `workers` fresh processes with one core each; results come as they are ready.

    A process that dies is a `WorkerDiedError` of the job that it had; another takes its place for the jobs that wait.

    Args:
        work: a function of a module, since it is sent to the processes by name.
        jobs: picklable, as are the results.
        on_result: is given each job with its answer, or the exception that it ended with.
        on_ticks: is told that so many more ticks have come.
        workers: processes, at most.
    """
    context = multiprocessing.get_context("spawn")
    # No locks: a killed process would keep them. Each counter has one writer at a time.
    stop = context.RawValue("b", 0)
    counters = [context.RawValue("q", 0) for _ in range(min(workers, len(jobs)))]
    waiting = deque(jobs)
    running: dict[Future[Result], tuple[Job, int]] = {}
    told = 0

    def tell() -> None:
        nonlocal told
        count = sum(counter.value for counter in counters)
        if count > told:
            on_ticks(count - told)
            told = count

    with one_thread_each():
        # A pool of one process per place, because a pool is lost as a whole when one of its processes dies.
        pools = [ProcessPoolExecutor(1, context, _start, (counter, stop)) for counter in counters]
        try:
            idle = list(range(len(pools)))
            while waiting or running:
                while waiting and idle:
                    place, job = idle.pop(), waiting.popleft()
                    try:
                        future = pools[place].submit(with_errors_sent, _work, work, job)
                    except BrokenProcessPool:  # it died while it had nothing to do
                        pools[place].shutdown()
                        pools[place] = ProcessPoolExecutor(1, context, _start, (counters[place], stop))
                        future = pools[place].submit(with_errors_sent, _work, work, job)
                    running[future] = job, place
                done, _ = wait(running, timeout=POLL_SECONDS, return_when=FIRST_COMPLETED)
                tell()
                for future in done:
                    job, place = running.pop(future)
                    result = _result(future)
                    if isinstance(result, WorkerDiedError):
                        pools[place].shutdown()
                        pools[place] = ProcessPoolExecutor(1, context, _start, (counters[place], stop))
                    idle.append(place)
                    on_result(job, result)
            tell()
        except BaseException:
            stop.value = 1
            raise
        finally:
            for pool in pools:
                pool.shutdown(wait=True, cancel_futures=True)


def _result(future: Future[Any]) -> Any:
    """The answer of a job, or the exception that it ended with."""
    try:
        return future.result()
    except BrokenProcessPool:
        return WorkerDiedError("its worker process died (out of memory?); run again with fewer workers")
    except Exception as error:
        return error


def _start(ticks: Any, stop: Any) -> None:
    """In a new worker."""
    global _worker_ticks, _worker_stop
    _worker_ticks, _worker_stop = ticks, stop
    start_worker()


def _work(work: Callable[[Job, Tick], Result], job: Job) -> Result:
    def tick() -> None:
        _worker_ticks.value += 1
        if _worker_stop.value:
            raise KeyboardInterrupt

    return work(job, tick)
