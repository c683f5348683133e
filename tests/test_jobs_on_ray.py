"""Jobs on a Ray cluster: as in local processes, and the labels are the same bytes."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
from rendered_walk import write_walk

from improvo.cli.main import main
from improvo.errors import InputError, MissingExtraError
from improvo.jobs.on_ray import gpus_of, run_on_ray
from improvo.jobs.processes import Tick
from improvo.jobs.workers import WorkerDiedError


def halve(number: int, tick: Tick) -> tuple[int, str | None, str]:
    for _ in range(number):
        tick()
    if number % 2:
        raise ValueError(f"{number} is odd")
    return number // 2, os.environ.get("OMP_NUM_THREADS"), os.getcwd()


def die_on_one(number: int, tick: Tick) -> int:
    if number == 1:
        os._exit(1)
    return number


def tick_until_stopped(number: int, tick: Tick) -> None:
    while True:
        tick()
        time.sleep(0.01)


@pytest.fixture(scope="module")
def cluster():
    """One local cluster for all tests: it takes long to start."""
    ray = pytest.importorskip("ray", reason="Ray is not installed: pip install 'improvo[ray]'")
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    python_path = os.pathsep.join([str(Path(__file__).parent), *filter(None, sys.path)])
    ray.init(
        address="local",
        num_cpus=2,
        include_dashboard=False,
        log_to_driver=False,
        runtime_env={"env_vars": {"PYTHONPATH": python_path}},
    )
    yield ray
    ray.shutdown()


def run(work, jobs, workers=None):
    results, ticks = {}, []
    run_on_ray(work, jobs, results.__setitem__, ticks.append, "local", workers)
    return results, sum(ticks)


def test_results_errors_and_ticks_come_back_and_paths_mean_the_same(cluster):
    results, ticks = run(halve, [4, 3, 10])
    assert results[4] == (2, "1", os.getcwd())
    assert results[10][0] == 5
    assert type(results[3]) is ValueError
    assert str(results[3]) == "3 is odd"
    assert ticks == 17


def test_a_worker_that_dies_spoils_no_other_job(cluster):
    results, _ = run(die_on_one, [1, 2, 3, 4], workers=2)
    died = results.pop(1)
    assert isinstance(died, WorkerDiedError)
    assert "\n" not in str(died)
    assert results == {2: 2, 3: 3, 4: 4}


def test_an_interrupt_cancels_what_runs(cluster):
    def interrupt(count: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_on_ray(tick_until_stopped, [1, 2, 3], lambda job, result: None, interrupt, "local")
    assert run(die_on_one, [2])[0] == {2: 2}  # needs a core that is free again


def test_labels_are_those_of_one_process(cluster, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    walks = [write_walk(Path(name), frames=16, seed=seed) for seed, name in enumerate(("kitchen", "hall"))]
    options = ["--frontend", "orb", "--max-keypoints", "200", "--set", "labels.min_observations=6"]
    options += ["--set", "labels.quality.enabled=false"]
    here = ["label", *map(str, walks), "nowhere", *options]
    assert main([*here, "-o", "here"]) == 0
    assert main([*here, "-o", "there", "--ray", "local"]) == 0  # relative paths
    assert "2 of 3 sequences labelled" in capsys.readouterr().out
    for name in ("tracks.parquet", "points.parquet", "frames.parquet", "trajectory.txt"):
        for walk in ("kitchen", "hall"):
            assert (tmp_path / "there" / walk / name).read_bytes() == (tmp_path / "here" / walk / name).read_bytes()


def test_a_worker_that_is_killed_in_the_middle_changes_nothing(cluster, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    walks = [write_walk(Path(name), frames=40, seed=seed) for seed, name in enumerate(("kitchen", "hall"))]
    words = ["label", *map(str, walks), "--frontend", "orb", "--max-keypoints", "200"]
    words += ["--set", "labels.min_observations=6", "--set", "labels.quality.enabled=false"]
    assert main([*words, "-o", "here"]) == 0
    killed: list[int] = []

    def kill() -> None:
        ends = time.monotonic() + 300
        while not killed and time.monotonic() < ends:
            for lock in Path(tmp_path, "there").glob(".*.lock"):
                name = lock.name.removeprefix(".").removesuffix(".lock")
                started = list(Path(tmp_path, "there", f".{name}.partial").glob(".tracks*"))
                with contextlib.suppress(OSError, ValueError):
                    process = json.loads(lock.read_text())["process"]
                    if started and process != os.getpid():
                        os.kill(process, signal.SIGKILL)
                        killed.append(process)
                        return
            time.sleep(0.005)

    killer = threading.Thread(target=kill)
    killer.start()
    assert main([*words, "-o", "there", "--ray", "local", "--workers", "2"]) == 0
    killer.join()
    assert len(killed) == 1
    assert "2 of 2 sequences labelled" in capsys.readouterr().out
    for name in ("tracks.parquet", "points.parquet", "frames.parquet", "trajectory.txt"):
        for walk in ("kitchen", "hall"):
            assert (tmp_path / "there" / walk / name).read_bytes() == (tmp_path / "here" / walk / name).read_bytes()


def test_a_loop_on_the_cluster_keeps_what_the_local_one_keeps(cluster, tmp_path):
    pytest.importorskip("torch", reason="training needs the extra `train`")
    from improvement_example import FakeTraining
    from improvement_example import run as improve
    from test_improvement_loop import results as outcome

    walks = [write_walk(tmp_path / name, frames=30, seed=seed) for seed, name in enumerate(("kitchen", "hall"), 3)]
    here = improve(tmp_path / "here", walks, FakeTraining(), rounds=1)
    there = improve(tmp_path / "there", walks, FakeTraining(), rounds=1, ray="local", workers=2)
    assert here.best == there.best
    expected, found = outcome(tmp_path / "here"), outcome(tmp_path / "there")
    assert found.keys() == expected.keys()
    assert [name for name in found if found[name] != expected[name]] == []


def test_gpus_that_are_not_there_are_said(cluster):
    assert gpus_of("local") == 0
    with pytest.raises(InputError, match="no node with a GPU"):
        run_on_ray(halve, [2], lambda job, result: None, lambda count: None, "local", gpus=1)


def test_no_ray_and_no_cluster_are_one_line_errors(monkeypatch):
    def attempt(address: str) -> None:
        run_on_ray(halve, [1], lambda job, result: None, lambda count: None, address)

    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    monkeypatch.setitem(sys.modules, "ray", SimpleNamespace(is_initialized=lambda: False))
    with pytest.raises(InputError, match=f"no Ray cluster at {address}"):
        attempt(address)
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'improvo\[ray\]'"):
        attempt(address)
