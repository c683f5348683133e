"""Who does many long jobs: this process, local processes, or a Ray cluster; a job whose worker dies is done again."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from improvo.errors import ConfigError
from improvo.jobs.on_ray import run_on_ray
from improvo.jobs.processes import Job, Result, Tick, run_here, run_in_processes
from improvo.jobs.workers import WorkerDiedError

TRIES = 3  # of a job whose worker dies, in all; then that is its result


@dataclass(frozen=True)
class Crew:
    """The same for all steps of a command.

    Args:
        workers: jobs at a time, a process with one core for each. If None, one after another in this process, which
            uses what cores are free, or with `ray` as many as the cluster has cores.
        ray: address of a Ray cluster, see `improvo.jobs.on_ray`.

    Raises:
        ConfigError: fewer than one worker.
    """

    workers: int | None = None
    ray: str | None = None

    def __post_init__(self) -> None:
        if self.workers is not None and self.workers < 1:
            raise ConfigError(f"workers: must be at least 1, not {self.workers}")

    def do(
        self,
        work: Callable[[Job, Tick], Result],
        jobs: Sequence[Job],
        on_result: Callable[[Job, Result | Exception], None],
        on_ticks: Callable[[int], None],
        gpus: int = 0,
    ) -> None:
        """Do all jobs; an exception of a job is its result.

        Args:
            work, jobs, on_result, on_ticks: see `run_in_processes`.
            gpus: that a job needs to itself, on a cluster.

        Raises:
            MissingExtraError: Ray is not installed.
            InputError: there is no cluster at the address, or none of its nodes has as many GPUs.
        """
        tries = 1
        waiting = list(jobs)
        while waiting:
            again: list[Job] = []

            def take(job: Job, result: Result | Exception, tries: int = tries, again: list[Job] = again) -> None:
                if isinstance(result, WorkerDiedError) and tries < TRIES:
                    again.append(job)
                else:
                    on_result(job, result)

            if self.ray is not None:
                run_on_ray(work, waiting, take, on_ticks, self.ray, self.workers, gpus)
            elif self.workers is None or (len(jobs) == 1 and self.workers > 1):
                run_here(work, waiting, take, on_ticks)
            else:
                run_in_processes(work, waiting, take, on_ticks, min(self.workers, len(waiting)))
            waiting, tries = again, tries + 1

    def results(
        self,
        work: Callable[[Job, Tick], Result],
        jobs: Sequence[Job],
        on_ticks: Callable[[int], None] = lambda count: None,
        gpus: int = 0,
    ) -> list[Result]:
        """The results of all jobs, in their order.

        Raises:
            Exception: what the first job that failed raised, once all have ended.
        """
        numbered = list(enumerate(jobs))
        found: dict[int, Any] = {}
        self.do(_Numbered(work), numbered, lambda job, result: found.__setitem__(job[0], result), on_ticks, gpus)
        for number, _ in numbered:
            if isinstance(found[number], Exception):
                raise found[number]
        return [found[number] for number, _ in numbered]


@dataclass(frozen=True)
class _Numbered:
    """Work on jobs that carry their number."""

    work: Callable[[Any, Tick], Any]

    def __call__(self, job: tuple[int, Any], tick: Tick) -> Any:
        return self.work(job[1], tick)
