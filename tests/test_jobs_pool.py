"""Many short tasks: results in order, the first error as it was raised, and processes that do not outlive the block."""

from __future__ import annotations

import os
import threading
import time

import pytest

from improvo.errors import ConfigError, ImprovoError, MissingExtraError
from improvo.jobs.pool import Workers
from improvo.jobs.workers import ONE_THREAD, WorkerDiedError


def square(number: int) -> int:
    return number * number


def settings(number: int) -> tuple[int, set[str | None]]:
    return os.getpid(), {os.environ.get(name) for name in ONE_THREAD}


class UnpicklableError(Exception):
    def __init__(self, first: str, second: str) -> None:
        super().__init__(f"{first}{second}")


def fail(number: int) -> int:
    if number == 1:
        raise ConfigError("one is no number")
    if number == 2:
        raise MissingExtraError("drawing", "plots")  # which pickle does not give back
    if number == 3:
        raise UnpicklableError("th", "ree")
    if number == 4:
        os._exit(1)
    return number


def fail_or_last(seconds: float) -> None:
    if not seconds:
        raise ConfigError("failed")
    time.sleep(seconds)


@pytest.mark.parametrize("count", [1, 2])
def test_results_come_in_the_order_of_the_tasks(count: int) -> None:
    with Workers(count) as workers:
        for _ in range(2):
            assert list(workers.run(square, range(7), "squares")) == [n * n for n in range(7)]
        assert list(workers.run(square, [], "nothing")) == []


def test_each_process_has_one_thread_and_is_kept_for_the_next_round(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    with Workers(2) as workers:
        rounds = [list(workers.run(settings, range(8), "settings")) for _ in range(2)]
    processes = {process for results in rounds for process, _ in results}
    assert len(processes) <= 2
    assert os.getpid() not in processes
    assert all(threads == {"1"} for results in rounds for _, threads in results)
    assert os.environ["OMP_NUM_THREADS"] == "3"


@pytest.mark.parametrize(
    ("task", "kind", "words"),
    [
        (1, ConfigError, "^one is no number$"),
        (2, ImprovoError, r"pip install 'improvo\[plots\]'"),
        (3, RuntimeError, "UnpicklableError: three"),
        (4, WorkerDiedError, "tasks: a worker process died"),
    ],
)
def test_an_error_of_a_task_arrives(task: int, kind: type[Exception], words: str) -> None:
    with Workers(2) as workers, pytest.raises(kind, match=words):
        list(workers.run(fail, [0, task], "tasks"))


def die_afterwards(number: int) -> int:
    if number == 0:
        threading.Timer(0.2, os._exit, (9,)).start()
    return number


def test_a_process_that_dies_between_two_rounds_is_one_line() -> None:
    with Workers(2) as workers:
        assert list(workers.run(die_afterwards, [0, 1, 2], "first")) == [0, 1, 2]
        time.sleep(0.8)
        with pytest.raises(WorkerDiedError, match="second: a worker process died"):
            list(workers.run(die_afterwards, [3, 4], "second"))


def test_an_error_ends_the_other_tasks_at_once() -> None:
    began = time.monotonic()

    def run() -> None:
        with Workers(2) as workers:
            list(workers.run(fail_or_last, [0.0, 60.0], "tasks"))

    with pytest.raises(ConfigError, match="failed"):
        run()
    assert time.monotonic() - began < 30
