"""The folder of a training: one process at a time, rows of metrics that survive a full disk, processes that share."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

torch = pytest.importorskip("torch", reason="training needs the extra `train`")

from improvo.cli.main import main  # noqa: E402
from improvo.errors import OutputError  # noqa: E402
from improvo.folder_lock import LOCK, holder_of, locked  # noqa: E402
from improvo.frontend.weights_files import load_weights  # noqa: E402
from improvo.training.distributed import Process  # noqa: E402
from improvo.training.metrics import METRICS, append_metrics, keep_metrics, read_metrics  # noqa: E402

SHAPES = ["--batch-size", "2", "--workers", "0", "--threads", "1", "--architecture", "superpoint-small"]
SHAPES += ["--set", "views.height=48", "--set", "views.width=64", "--set", "optimiser.log_every=2"]
HOLD = """
import sys, time
from pathlib import Path
from improvo.folder_lock import locked
with locked(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(60)
"""

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="no fcntl")


@pytest.fixture
def holder(tmp_path: Path) -> subprocess.Popen[str]:
    """A process that works in the folder `tmp_path`."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(tmp_path)], stdout=subprocess.PIPE, text=True, env=environment
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "held\n"
    yield process
    process.kill()
    process.wait()


def test_a_second_process_is_told_who_is_at_work(tmp_path: Path, holder: subprocess.Popen[str]) -> None:
    who = rf"process {holder.pid} on .* \(since 2.* is at work there"
    with pytest.raises(OutputError, match=who), locked(tmp_path):
        pass


def test_a_dead_process_holds_no_lock(tmp_path: Path, holder: subprocess.Popen[str]) -> None:
    holder.kill()
    holder.wait()
    assert f"process {holder.pid} on" in holder_of(tmp_path / LOCK)
    with locked(tmp_path):
        content = json.loads((tmp_path / LOCK).read_text())
        assert content["process"] == os.getpid()
    assert not (tmp_path / LOCK).exists()


def test_a_block_within_a_block_goes_on_and_another_thread_does_not(tmp_path: Path) -> None:
    refused: list[str] = []

    def other() -> None:
        try:
            with locked(tmp_path):
                pass
        except OutputError as error:
            refused.append(str(error))

    with locked(tmp_path):
        with locked(tmp_path):
            pass
        thread = threading.Thread(target=other)
        thread.start()
        thread.join()
    assert "another thread" in refused[0]
    with locked(tmp_path):
        pass


def test_two_trainings_in_one_folder_do_not_mix(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    command = ["train", "shapes", "-o", str(out), *SHAPES]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "OMP_NUM_THREADS": "1"}
    first = subprocess.Popen(
        [sys.executable, "-m", "improvo", *command, "--steps", "100000"], env=environment,
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    try:
        while not (out / METRICS).is_file():
            assert first.poll() is None
            time.sleep(0.05)
        assert main([*command, "--steps", "4"]) == 2
        assert f"process {first.pid}" in capsys.readouterr().err
    finally:
        first.kill()
        first.wait()
    assert main([*command, "--steps", "4"]) == 0
    assert [row["step"] for row in read_metrics(out / METRICS)] == [
        2,
        4,
    ]  # nothing is left of the one without checkpoint


def test_half_a_row_is_left_out_and_training_goes_on(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    for folder in (whole, cut):
        assert main(["train", "shapes", "-o", str(folder), *SHAPES, "--steps", "4"]) == 0
    with (cut / METRICS).open("a") as stream:
        stream.write('{"step": 6, "loss": 0.')  # a full disk
    for folder in (whole, cut):
        assert main(["train", "shapes", "-o", str(folder), *SHAPES, "--steps", "8"]) == 0
    losses = [[(row["step"], row["loss"]) for row in read_metrics(folder / METRICS)] for folder in (whole, cut)]
    assert losses[0] == losses[1]
    assert [step for step, _ in losses[0]] == [2, 4, 6, 8]
    for line in (cut / METRICS).read_text().splitlines():
        json.loads(line)
    a, b = (load_weights(folder / "weights.safetensors").tensors for folder in (whole, cut))
    assert all((a[name] == b[name]).all() for name in a)


def test_a_finished_folder_with_damaged_metrics_ends_well(tmp_path: Path) -> None:
    command = ["train", "shapes", "-o", str(tmp_path), *SHAPES, "--steps", "2"]
    assert main(command) == 0
    (tmp_path / METRICS).write_text('{"step"')
    assert main(command) == 0


def test_rows_of_metrics(tmp_path: Path) -> None:
    path = tmp_path / METRICS
    assert read_metrics(path) == []
    for step in (1, 2, 3):
        append_metrics(path, {"step": step, "loss": 1.5})
    with path.open("a") as stream:
        stream.write("[" * 100_000 + '\n[1, 2]\n{"loss": 3}\n{"step": 4, "lo')
    assert [row["step"] for row in read_metrics(path)] == [1, 2, 3]
    keep_metrics(path, 2)
    assert path.read_text() == '{"step": 1, "loss": 1.5}\n{"step": 2, "loss": 1.5}\n'
    with pytest.raises(OutputError, match="make room"):
        append_metrics(tmp_path / "nowhere" / METRICS, {"step": 1})


def test_processes_divide_a_batch(monkeypatch: pytest.MonkeyPatch) -> None:
    assert Process.current() == Process(0, 1)
    parts = [Process(rank, 3).part_of(8) for rank in range(3)]
    assert sorted(number for part in parts for number in part) == list(range(8))
    monkeypatch.setenv("RANK", "2")
    monkeypatch.setenv("WORLD_SIZE", "4")
    assert Process.current() == Process(2, 4)
    assert not Process.current().leads
