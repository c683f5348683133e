"""Jobs here and in worker processes: the same results, errors kept apart, ticks counted, stoppable."""

from __future__ import annotations

import os

import pytest

from improvo.jobs.processes import Tick, WorkerDiedError, run_here, run_in_processes


def halve(number: int, tick: Tick) -> tuple[int, str | None]:
    for _ in range(number):
        tick()
    if number % 2:
        raise ValueError(f"{number} is odd")
    return number // 2, os.environ.get("OMP_NUM_THREADS")


def die(number: int, tick: Tick) -> int:
    os._exit(1)


def count_until_stopped(number: int, tick: Tick) -> str:
    try:
        while True:
            tick()
    except KeyboardInterrupt:
        return "stopped"


def run(work, jobs, workers):
    results, ticks = {}, []
    arguments = (work, jobs, results.__setitem__, ticks.append)
    if workers:
        run_in_processes(*arguments, workers)
    else:
        run_here(*arguments)
    return results, sum(ticks)


@pytest.mark.parametrize("workers", [0, 2])
def test_results_and_errors_reach_their_jobs(workers, monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    results, ticks = run(halve, [4, 3, 10], workers)
    assert results[4] == (2, "1" if workers else "3")
    assert results[10][0] == 5
    assert str(results[3]) == "3 is odd"
    assert ticks == 17
    assert os.environ["OMP_NUM_THREADS"] == "3"


def test_a_worker_that_dies_is_an_error_of_its_job():
    results, _ = run(die, [1], 1)
    assert isinstance(results[1], WorkerDiedError)


def test_an_interrupt_stops_the_workers():
    def interrupt(count: int) -> None:
        if count:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_in_processes(count_until_stopped, [1, 2, 3, 4], lambda job, result: None, interrupt, 2)


def die_on_one(number: int, tick: Tick) -> int:
    if number == 1:
        os._exit(1)
    return number


def test_the_jobs_of_other_workers_survive_one_that_dies():
    results, _ = run(die_on_one, [1, 2, 3, 4, 5], 2)
    assert isinstance(results.pop(1), WorkerDiedError)
    assert results == {2: 2, 3: 3, 4: 4, 5: 5}
