"""Many small tasks on all cores: one process per core, one BLAS thread in each."""

from __future__ import annotations

import multiprocessing
import os
import sys
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from typing import Any, TypeVar

from improvo.errors import ImprovoError

Task = TypeVar("Task")
Result = TypeVar("Result")

_THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


def available_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class Workers:
    """Worker processes, started when first needed and kept for all rounds of tasks.

    Args:
        count: processes; with 1 everything runs in this process.
        progress: whether to show a progress bar on stderr.
    """

    def __init__(self, count: int = 1, progress: bool = False) -> None:
        self._count = count
        self._progress = progress
        self._pool: ProcessPoolExecutor | None = None

    def __enter__(self) -> Workers:
        return self

    def __exit__(self, *_: object) -> None:
        if self._pool is not None:
            self._pool.shutdown(wait=True, cancel_futures=True)

    def run(self, function: Callable[[Task], Result], tasks: Iterable[Task], label: str) -> Iterator[Result]:
        """Results in the order of the tasks.

        Args:
            function: importable by name, since worker processes start afresh.
            tasks: picklable.
            label: of the progress bar.

        Raises:
            ImprovoError: what the function raised, with its message.
        """
        from tqdm import tqdm

        queue = list(tasks)
        with tqdm(
            total=len(queue), desc=label, unit="task", file=sys.stderr, disable=not self._progress, leave=False
        ) as bar:
            if self._count <= 1 or len(queue) <= 1:
                for task in queue:
                    yield function(task)
                    bar.update()
                return
            for future in [self._started().submit(_guarded, function, task) for task in queue]:
                result, message = future.result()
                if message is not None:
                    raise ImprovoError(message)
                yield result
                bar.update()

    def _started(self) -> ProcessPoolExecutor:
        if self._pool is None:
            # Started anew and not forked: threads of BLAS and inference runtimes do not survive a fork.
            context = multiprocessing.get_context("spawn")
            self._pool = ProcessPoolExecutor(self._count, context, initializer=_start_worker)
        return self._pool


def _guarded(function: Callable[[Any], Any], task: Any) -> tuple[Any, str | None]:
    """The result, or the message of an error that the user can mend; not every exception survives pickling."""
    try:
        return function(task), None
    except ImprovoError as error:
        return None, str(error)


def _start_worker() -> None:
    for name in _THREAD_VARIABLES:  # read when BLAS is imported, which is later than this
        os.environ[name] = "1"
    import cv2

    cv2.setNumThreads(1)
