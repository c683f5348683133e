"""Doing many independent jobs: one after another in this process, or in several local processes."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from typing import Any, TypeVar

from sivo.errors import SivoError

Job = TypeVar("Job")
Result = TypeVar("Result")
Tick = Callable[[], None]  # a job calls it as it goes on; raises KeyboardInterrupt when all is to stop

_ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
_POLL_SECONDS = 0.2

_worker_ticks: Any = None  # set in worker processes
_worker_stop: Any = None


class WorkerDiedError(SivoError):
    """A worker process ended without an answer."""


def run_here(
    work: Callable[[Job, Tick], Result],
    jobs: Sequence[Job],
    on_result: Callable[[Job, Result | Exception], None],
    on_ticks: Callable[[int], None],
) -> None:
    """One job after another; an exception of a job is its result, KeyboardInterrupt ends all."""
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
    """As `run_here`, in `workers` fresh processes with one BLAS thread each; results come as they are ready.

    Args:
        work: a function of a module, since it is sent to the workers by name; so are the jobs and results.
    """
    context = multiprocessing.get_context("spawn")
    ticks, stop = context.Value("q", 0), context.Event()
    told = 0
    before = {name: os.environ.get(name) for name in _ONE_THREAD}
    os.environ.update(dict.fromkeys(_ONE_THREAD, "1"))  # the workers' libraries read it when they load
    try:
        with ProcessPoolExecutor(workers, context, _start_worker, (ticks, stop)) as pool:
            waiting: dict[Future[Result], Job] = {pool.submit(_work, work, job): job for job in jobs}
            try:
                while waiting:
                    done, _ = wait(waiting, timeout=_POLL_SECONDS, return_when=FIRST_COMPLETED)
                    told = _tell(ticks.value, told, on_ticks)
                    for future in done:
                        job = waiting.pop(future)
                        on_result(job, _result(future))
                _tell(ticks.value, told, on_ticks)
            except BaseException:
                stop.set()
                pool.shutdown(wait=True, cancel_futures=True)
                raise
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _result(future: Future[Any]) -> Any:
    """The answer of a job, or the exception that it ended with."""
    try:
        return future.result()
    except BrokenProcessPool:
        return WorkerDiedError("its worker process died (out of memory?); run again with fewer workers")
    except Exception as error:
        return error


def _tell(count: int, told: int, on_ticks: Callable[[int], None]) -> int:
    if count > told:
        on_ticks(count - told)
    return count


def _start_worker(ticks: Any, stop: Any) -> None:
    """In a new worker: leave Ctrl-C to the parent, which passes it on through `stop`."""
    import signal

    import cv2

    global _worker_ticks, _worker_stop
    _worker_ticks, _worker_stop = ticks, stop
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    cv2.setNumThreads(1)


def _work(work: Callable[[Job, Tick], Result], job: Job) -> Result:
    def tick() -> None:
        with _worker_ticks.get_lock():
            _worker_ticks.value += 1
        if _worker_stop.is_set():
            raise KeyboardInterrupt

    return work(job, tick)
