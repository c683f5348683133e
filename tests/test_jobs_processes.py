"""Jobs here and in worker processes: the same results, errors kept apart, ticks counted, stoppable."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from improvo.errors import ConfigError, ImprovoError, MissingExtraError
from improvo.jobs.crew import TRIES, Crew
from improvo.jobs.processes import Tick, run_here, run_in_processes
from improvo.jobs.workers import WorkerDiedError


def halve(number: int, tick: Tick) -> tuple[int, str | None]:
    for _ in range(number):
        tick()
    if number % 2:
        raise ValueError(f"{number} is odd")
    return number // 2, os.environ.get("OMP_NUM_THREADS")


def die(number: int, tick: Tick) -> int:
    os._exit(1)


def die_twice(folder: Path, tick: Tick) -> int:
    tries = len(list(folder.iterdir()))
    if tries < 2:
        (folder / str(tries)).touch()
        os._exit(1)
    return tries


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


def lack(number: int, tick: Tick) -> int:
    raise MissingExtraError("drawing", "plots")  # which pickle does not give back


def test_an_error_that_pickle_loses_is_told_in_words():
    results, _ = run(lack, [1], 1)
    assert type(results[1]) is ImprovoError
    assert "pip install 'improvo[plots]'" in str(results[1])


def die_afterwards(number: int, tick: Tick) -> int:
    if number == 0:
        threading.Timer(0.2, os._exit, (9,)).start()
    return number


def test_a_process_that_dies_while_it_has_nothing_to_do_is_replaced() -> None:
    """As the system ends the largest one where memory is short."""
    results: list[object] = []

    def slowly(number: int, result: object) -> None:
        results.append(result)
        time.sleep(0.8)

    run_in_processes(die_afterwards, [0, 1, 2], slowly, lambda count: None, 1)
    assert results == [0, 1, 2]


def last_for_minutes(folder: str, tick: Tick = lambda: None) -> None:
    Path(folder, str(os.getpid())).touch()
    time.sleep(300)


PARENT = """
import sys
from test_jobs_processes import last_for_minutes
from improvo.jobs.pool import Workers
from improvo.jobs.crew import TRIES, Crew
from improvo.jobs.processes import run_in_processes
if __name__ == "__main__":
    if sys.argv[1] == "processes":
        run_in_processes(last_for_minutes, [sys.argv[2]] * 2, print, print, 2)
    with Workers(2) as workers:
        list(workers.run(last_for_minutes, [sys.argv[2]] * 2, "tasks"))
"""


def alive(process: int) -> bool:
    """Whether it runs; one that ended and waits for its parent to ask does not."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


@pytest.mark.skipif(sys.platform != "linux", reason="looks for processes in /proc")
@pytest.mark.parametrize("kind", ["processes", "pool"])
def test_workers_end_when_their_parent_is_killed(kind, tmp_path):
    script = tmp_path / "parent.py"
    script.write_text(PARENT)
    (tmp_path / "pids").mkdir()
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(Path(__file__).parent), *sys.path])}
    parent = subprocess.Popen([sys.executable, str(script), kind, str(tmp_path / "pids")], env=environment)
    deadline = time.monotonic() + 60
    while len(list((tmp_path / "pids").iterdir())) < 2 and time.monotonic() < deadline:
        time.sleep(0.05)
    workers = [int(path.name) for path in (tmp_path / "pids").iterdir()]
    assert len(workers) == 2
    assert all(alive(worker) for worker in workers)
    parent.send_signal(signal.SIGKILL)
    parent.wait()
    while any(alive(worker) for worker in workers) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not any(alive(worker) for worker in workers)


def test_a_crew_gives_results_in_order_and_the_first_error():
    ticks = []
    assert [number for number, _ in Crew().results(halve, [8, 2, 4], ticks.append)] == [4, 1, 2]
    assert sum(ticks) == 14
    assert Crew(2).results(halve, [6, 2]) == [(3, "1"), (1, "1")]
    assert Crew(1).results(halve, [6]) == [(3, "1")]  # one worker has one core, too
    with pytest.raises(ValueError, match="3 is odd"):
        Crew().results(halve, [2, 3, 5])
    assert Crew().results(halve, []) == []
    with pytest.raises(ConfigError, match="at least 1, not 0"):
        Crew(0)


def test_a_job_whose_worker_dies_is_done_again_and_then_set_aside(tmp_path):
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
    assert Crew(2).results(die_twice, [tmp_path / "a", tmp_path / "b"]) == [2, 2]
    results = {}
    Crew(2).do(die, [1, 2], results.__setitem__, lambda count: None)
    assert {type(result) for result in results.values()} == {WorkerDiedError}
    assert TRIES == 3
