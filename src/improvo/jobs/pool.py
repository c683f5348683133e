"""Many short tasks on all cores: worker processes that are kept for all rounds of tasks."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from types import TracebackType
from typing import TypeVar

from improvo.jobs.workers import WorkerDiedError, one_thread_each, start_worker, with_errors_sent
from improvo.terminal import progress

Task = TypeVar("Task")
Result = TypeVar("Result")


class Workers:
    """Worker processes, started when first needed and kept for all rounds of tasks; use as a context manager.

    An exception within the block ends the processes at once.

    Args:
        count: processes; with 1 everything runs in this process.
        progress: whether to show progress on stderr.
    """

    def __init__(self, count: int = 1, progress: bool = False) -> None:
        self._count = count
        self._progress = progress
        self._pool: ProcessPoolExecutor | None = None
        # Started anew and not forked: threads of BLAS and inference runtimes do not survive a fork.
        self._context = multiprocessing.get_context("spawn")
        self._end = self._context.RawValue("b", 0)

    def __enter__(self) -> Workers:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._pool is not None:
            self._end.value = int(kind is not None)
            self._pool.shutdown(wait=True, cancel_futures=True)

    def run(self, function: Callable[[Task], Result], tasks: Iterable[Task], label: str) -> Iterator[Result]:
        """Results in the order of the tasks.

        Args:
            function: of a module, since it is sent to the processes by name.
            tasks: picklable.
            label: of the progress bar.

        Raises:
            Exception: what the function raised for the first task that failed.
            WorkerDiedError: a process ended without an answer.
        """
        queue = list(tasks)
        with progress(label, "task", len(queue), self._progress) as shown:
            if self._count <= 1 or len(queue) <= 1:
                for task in queue:
                    yield function(task)
                    shown.advance()
                return
            died = WorkerDiedError(f"{label}: a worker process died (out of memory?); run again with fewer workers")
            try:
                with one_thread_each():  # submitting starts the processes
                    futures = [self._started().submit(with_errors_sent, function, task) for task in queue]
            except BrokenProcessPool:  # between two rounds
                raise died from None
            for future in futures:
                try:
                    result = future.result()
                except BrokenProcessPool:
                    raise died from None
                yield result
                shown.advance()

    def _started(self) -> ProcessPoolExecutor:
        if self._pool is None:
            self._pool = ProcessPoolExecutor(self._count, self._context, start_worker, (self._end,))
        return self._pool
