"""What every worker process is started with: one thread, no Ctrl-C of its own, an end when its parent dies."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing.connection import wait
from typing import Any, ParamSpec, TypeVar

from improvo.errors import ImprovoError

Result = TypeVar("Result")
Arguments = ParamSpec("Arguments")

ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")
POLL_SECONDS = 0.2
_KILLED = 1  # exit status


class WorkerDiedError(ImprovoError):
    """A worker process ended without an answer."""


def available_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def thread_limit() -> int:
    """How many threads may work at a time in this process, by `OMP_NUM_THREADS`: one in a worker; 0 for no limit."""
    said = os.environ.get("OMP_NUM_THREADS", "").split(",")[0].strip()
    return int(said) if said.isdecimal() else 0


def has_one_core() -> bool:
    """Whether a second thread would only take the processor away from the first."""
    return thread_limit() == 1 or available_cores() == 1


@contextmanager
def one_thread_each() -> Iterator[None]:
    """For the processes that start meanwhile: libraries read the number of their threads when they load."""
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ.update(ONE_THREAD)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def start_worker(end: Any = None) -> None:
    """The first thing in a new worker process.

    Args:
        end: a shared value; the process ends at once when it is set. None: only when the parent dies.
    """
    import cv2

    for name in ("SIGINT", "SIGHUP"):  # the parent gets it too, and tells the workers
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), signal.SIG_IGN)
    cv2.setNumThreads(1)
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_end_with, args=(parent.sentinel, end), daemon=True, name="watch parent").start()


def _end_with(parent: int, end: Any) -> None:
    """End this process when the parent has died, or `end` is set. Files that it is writing have temporary names."""
    while not wait([parent], None if end is None else POLL_SECONDS):
        if end.value:
            break
    os._exit(_KILLED)


def with_errors_sent(
    function: Callable[Arguments, Result], *arguments: Arguments.args, **options: Arguments.kwargs
) -> Result:
    """Call a function in a worker; an exception that would be lost on its way to the parent is told in words.

    Raises:
        Exception: what the function raised. Where pickle does not give it back, an `ImprovoError` with the same message
            for one of ours, a `RuntimeError` for any other.
    """
    try:
        return function(*arguments, **options)
    except Exception as error:
        try:
            pickle.loads(pickle.dumps(error))
        except Exception:
            if isinstance(error, ImprovoError):
                raise ImprovoError(str(error)) from None
            raise RuntimeError(f"{type(error).__name__}: {error}") from None
        raise
