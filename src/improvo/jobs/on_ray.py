"""Few long jobs on a Ray cluster.

The jobs name files and folders, so every node must see them under the same paths (a shared file system), and have the
same version of this package installed.
"""

from __future__ import annotations

import os
import socket
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any

from improvo.errors import InputError, first_line, imported
from improvo.jobs.processes import Job, Result, Tick
from improvo.jobs.workers import ONE_THREAD, POLL_SECONDS, WorkerDiedError, with_errors_sent

_WAITING_PER_CORE = 2  # jobs handed to the cluster ahead of their turn
_CANCEL_SECONDS = 10.0
_PROBE_SECONDS = 5.0


def run_on_ray(
    work: Callable[[Job, Tick], Result],
    jobs: Sequence[Job],
    on_result: Callable[[Job, Result | Exception], None],
    on_ticks: Callable[[int], None],
    address: str,
    workers: int | None = None,
    gpus: int = 0,
) -> None:
    """As `run_in_processes`, on a Ray cluster, one core and one BLAS thread for each job.

    A worker or node that dies is a `WorkerDiedError` of the job that it had; the rest goes on. An interrupt here
    cancels what runs there.

    Args:
        work: a function of a module that the nodes have, since it is sent to them by name.
        jobs: picklable, as are the results.
        on_result: is given each job with its answer, or the exception that it ended with.
        on_ticks: is told that so many more ticks have come.
        address: of the cluster (`host:6379`, `auto`, `ray://host:10001`), or `local` to start one on this machine.
        workers: jobs at a time, at most; as many as the cluster has cores for if None.
        gpus: that each job has to itself.

    Raises:
        MissingExtraError: Ray is not installed.
        InputError: there is no cluster at the address, or it has fewer GPUs.
    """
    ray = _imported()

    with _connected(ray, address):
        resources = ray.cluster_resources()
        if resources.get("GPU", 0) < gpus:
            raise InputError(f"the Ray cluster at {address} has no node with a GPU; ask for the CPU instead")
        counter = ray.remote(num_cpus=0, max_restarts=3)(_Counter).remote()
        task = ray.remote(num_cpus=1, num_gpus=gpus, max_retries=0)(_work)
        most = workers or _WAITING_PER_CORE * max(int(resources.get("CPU", 1)), 1)
        waiting, told = deque(jobs), 0
        running: dict[Any, Job] = {}
        try:
            while waiting or running:
                while waiting and len(running) < most:
                    job = waiting.popleft()
                    running[task.remote(work, job, counter, os.getcwd())] = job
                done, _ = ray.wait(list(running), timeout=POLL_SECONDS)
                told = _tell(ray, counter, told, on_ticks)
                for reference in done:
                    on_result(running.pop(reference), _result(ray, reference))
            _tell(ray, counter, told, on_ticks)
        except BaseException:
            _cancel(ray, list(running))
            raise


def gpus_of(address: str) -> int:
    """How many GPUs a cluster has.

    Raises:
        MissingExtraError, InputError: see `run_on_ray`.
    """
    ray = _imported()
    with _connected(ray, address):
        return int(ray.cluster_resources().get("GPU", 0))


def _imported() -> Any:
    return imported("ray", "work on a Ray cluster", "ray")


class _Counter:
    """An actor: how often all jobs ticked. Where its node dies, it begins anew on another."""

    def __init__(self) -> None:
        self._count = 0

    def add(self, count: int) -> None:
        self._count += count

    def count(self) -> int:
        return self._count


def _work(work: Callable[[Job, Tick], Result], job: Job, counter: Any, folder: str) -> Result:
    """On a node: paths mean what they mean to the caller; ticks are told now and then."""
    import platform
    import time

    import cv2

    try:
        os.chdir(folder)
    except OSError:
        raise InputError(f"{folder}: is not there on {platform.node()}; all nodes need the same files") from None
    cv2.setNumThreads(1)
    untold, last = 0, time.monotonic()

    def tick() -> None:
        nonlocal untold, last
        untold += 1
        if time.monotonic() - last > POLL_SECONDS:
            counter.add.remote(untold)
            untold, last = 0, time.monotonic()

    try:
        return with_errors_sent(work, job, tick)
    finally:
        import ray

        with suppress(ray.exceptions.RayError):  # the counter's node died: progress is not worth a job
            ray.get(counter.add.remote(untold))


def _result(ray: Any, reference: Any) -> Any:
    """The answer of a job, or the exception that it ended with."""
    try:
        return ray.get(reference)
    except ray.exceptions.RayTaskError as error:
        cause = error.cause
        return cause if isinstance(cause, Exception) else error
    except ray.exceptions.RayError as error:
        return WorkerDiedError(f"its Ray worker died ({type(error).__name__}: {first_line(error)}); run again")


def _cancel(ray: Any, references: list[Any]) -> None:
    """Ends what runs; with its process what heeds no interrupt, as where Ray was started with them ignored."""
    for force in (False, True):
        for reference in references:
            ray.cancel(reference, force=force)
        if references:
            _, references = ray.wait(references, num_returns=len(references), timeout=_CANCEL_SECONDS)


def _tell(ray: Any, counter: Any, told: int, on_ticks: Callable[[int], None]) -> int:
    """Tell what has come since `told` ticks; returns how many have come."""
    try:
        count: int = ray.get(counter.count.remote())
    except ray.exceptions.RayError:  # its node died, and another does not have it yet
        return told
    new = count - told if count >= told else count  # it began anew elsewhere
    if new:
        on_ticks(new)
    return count


@contextmanager
def _connected(ray: Any, address: str) -> Iterator[None]:
    """A connection for the jobs; one that the caller already has is used, and left as it is."""
    if ray.is_initialized():
        yield
        return
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # a cluster started here reports to nobody
    host, colon, port = address.removeprefix("ray://").rpartition(":")
    try:
        if colon and port.isdecimal():  # Ray itself would try for minutes, and end the process
            socket.create_connection((host, int(port)), _PROBE_SECONDS).close()
        ray.init(address=address, runtime_env={"env_vars": ONE_THREAD}, log_to_driver=False, logging_level="ERROR")
    except (ConnectionError, ValueError, RuntimeError, OSError) as error:
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
        raise InputError(f"no Ray cluster at {address} ({reason}); give the address that `ray status` uses") from None
    try:
        yield
    finally:
        ray.shutdown()
