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
from improvo.jobs.crew import Crew
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


def tick_for_ever(number: int, tick: Tick) -> None:
    """Heeds no interrupt."""
    while True:
        with contextlib.suppress(KeyboardInterrupt):
            tick()
            time.sleep(0.01)


class DyingCounter:
    """As the actor that counts ticks, on a node that dies."""

    def add(self, count: int) -> None:
        os._exit(1)

    def count(self) -> int:
        return 0


def wait_for_word(folder: Path, tick: Tick) -> str:
    """Says which node it is on, and waits."""
    import ray

    node = ray.get_runtime_context().get_node_id()
    with (folder / "nodes").open("a") as file:
        file.write(f"{node}\n")
    while not (folder.parent / "word").exists():
        time.sleep(0.05)
    return node


@pytest.fixture(scope="module")
def nodes():
    """Two nodes on this machine, for all tests: they take long to start."""
    pytest.importorskip("ray", reason="Ray is not installed: pip install 'improvo[ray]'")
    from ray.cluster_utils import Cluster

    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    cluster.add_node(num_cpus=1)
    yield cluster
    cluster.shutdown()


@pytest.fixture(scope="module")
def cluster(nodes):
    """A connection to them, which the commands use."""
    import ray

    python_path = os.pathsep.join([str(Path(__file__).parent), *filter(None, sys.path)])
    ray.init(
        address=nodes.address,
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


def test_a_job_is_worth_more_than_its_ticks(cluster, monkeypatch):
    monkeypatch.setattr("improvo.jobs.on_ray._Counter", DyingCounter)
    results, _ = run(halve, [4])
    assert results[4][0] == 2


def test_a_node_that_dies_costs_what_it_had_in_work(nodes, cluster, tmp_path):
    third = nodes.add_node(num_cpus=1)
    folders = [tmp_path / name for name in "abc"]
    for folder in folders:
        folder.mkdir()

    def end_node() -> None:
        ends = time.monotonic() + 600
        while len(list(tmp_path.glob("*/nodes"))) < 3 and time.monotonic() < ends:
            time.sleep(0.05)
        nodes.remove_node(third, allow_graceful=False)
        (tmp_path / "word").touch()

    killer = threading.Thread(target=end_node)
    killer.start()
    found = Crew(workers=3, ray="local").results(wait_for_word, folders)
    killer.join()
    tried = [(folder / "nodes").read_text().split() for folder in folders]
    assert sorted(map(len, tried)) == [1, 1, 2]
    assert found == [nodes_of_it[-1] for nodes_of_it in tried]
    assert third.node_id in {tries[0] for tries in tried}


@pytest.mark.parametrize("work", [tick_until_stopped, tick_for_ever])
def test_an_interrupt_cancels_what_runs(cluster, monkeypatch, work):
    monkeypatch.setattr("improvo.jobs.on_ray._CANCEL_SECONDS", 3.0)

    def interrupt(count: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_on_ray(work, [1, 2, 3], lambda job, result: None, interrupt, "local")
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


class Killer(threading.Thread):
    """Ends the first worker process that is in the middle of labelling below a folder, with SIGKILL."""

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self._folder = folder
        self.killed: list[int] = []

    def run(self) -> None:
        ends = time.monotonic() + 600
        while not self.killed and time.monotonic() < ends:
            for lock in self._folder.rglob(".*.lock"):
                name = lock.name.removeprefix(".").removesuffix(".lock")
                started = list((lock.parent / f".{name}.partial").glob(".tracks*"))
                with contextlib.suppress(OSError, ValueError):
                    process = json.loads(lock.read_text())["process"]
                    if started and process != os.getpid():
                        os.kill(process, signal.SIGKILL)
                        self.killed.append(process)
                        return
            time.sleep(0.005)


def test_a_worker_that_is_killed_in_the_middle_changes_nothing(cluster, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    walks = [write_walk(Path(name), frames=40, seed=seed) for seed, name in enumerate(("kitchen", "hall"))]
    words = ["label", *map(str, walks), "--frontend", "orb", "--max-keypoints", "200"]
    words += ["--set", "labels.min_observations=6", "--set", "labels.quality.enabled=false"]
    assert main([*words, "-o", "here"]) == 0
    killer = Killer(tmp_path / "there")
    killer.start()
    assert main([*words, "-o", "there", "--ray", "local", "--workers", "2"]) == 0
    killer.join()
    assert len(killer.killed) == 1
    assert "2 of 2 sequences labelled" in capsys.readouterr().out
    for name in ("tracks.parquet", "points.parquet", "frames.parquet", "trajectory.txt"):
        for walk in ("kitchen", "hall"):
            assert (tmp_path / "there" / walk / name).read_bytes() == (tmp_path / "here" / walk / name).read_bytes()


def test_a_loop_on_the_cluster_keeps_what_the_local_one_keeps_though_a_worker_is_killed(cluster, tmp_path):
    pytest.importorskip("torch", reason="training needs the extra `train`")
    from improvement_example import FakeTraining
    from improvement_example import run as improve
    from test_improvement_loop import results as outcome

    walks = [write_walk(tmp_path / name, frames=24, seed=seed) for seed, name in enumerate(("kitchen", "hall"), 3)]
    here = improve(tmp_path / "here", walks, FakeTraining(), rounds=1)
    killer = Killer(tmp_path / "there")
    killer.start()
    there = improve(tmp_path / "there", walks, FakeTraining(), rounds=1, ray="local", workers=2)
    killer.join()
    assert len(killer.killed) == 1
    assert here.best == there.best == 1
    expected, found = outcome(tmp_path / "here"), outcome(tmp_path / "there")
    assert found.keys() == expected.keys()
    assert len([name for name in found if name.endswith(".parquet")]) >= 9
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
