"""Two processes that train together, as `torchrun` starts them: the steps of one with the whole batch."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch", reason="training needs the extra `train`")

from improvo.frontend.weights_files import find_weights, load_weights
from labeled_scene import write_labeled_scene

WORDS = ["--from", "superpoint-small", "--workers", "0", "--threads", "1"]
VALUES = (
    "views.height=48", "views.width=64", "optimiser.decay_steps=1", "optimiser.warmup_steps=0",
    "optimiser.precision=float32", "optimiser.log_every=2",
)  # fmt: skip


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_labeled_scene(tmp_path_factory.mktemp("scene") / "labels")


def train(store: Path, output: Path, processes: int, batch_size: int, steps: int) -> None:
    """One training by so many processes."""
    command = [sys.executable, "-m", "improvo", "train", "odometry", str(store), "-o", str(output), *WORDS]
    command += ["--batch-size", str(batch_size), "--steps", str(steps)]
    command += [word for value in VALUES for word in ("--set", value)]
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    meeting = {"WORLD_SIZE": str(processes), "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port)}
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "OMP_NUM_THREADS": "1", **meeting}
    running = [
        subprocess.Popen(command, env={**environment, "RANK": str(rank)}, stdout=subprocess.DEVNULL)
        for rank in range(processes)
    ]
    assert [process.wait(timeout=600) for process in running] == [0] * processes


def vector(weights: Path) -> np.ndarray:
    """All numbers of a network, but the stability head's, which begins anew."""
    tensors = load_weights(weights).tensors
    kept = [value.ravel() for name, value in sorted(tensors.items()) if not name.startswith("stability")]
    return np.concatenate(kept).astype(np.float64)


def test_two_processes_take_the_steps_of_one(store: Path, tmp_path: Path) -> None:
    train(store, tmp_path / "one", processes=1, batch_size=4, steps=2)
    train(store, tmp_path / "two", processes=2, batch_size=4, steps=2)
    train(store, tmp_path / "half", processes=1, batch_size=2, steps=2)
    start = vector(find_weights("superpoint-small"))
    one, two, half = (vector(tmp_path / name / "weights.safetensors") for name in ("one", "two", "half"))
    way = np.linalg.norm(one - start)
    assert np.linalg.norm(two - one) < 0.02 * way
    assert np.linalg.norm(half - one) > 0.2 * way


def test_two_processes_that_were_stopped_go_on_exactly(store: Path, tmp_path: Path) -> None:
    train(store, tmp_path / "stopped", processes=2, batch_size=2, steps=2)
    train(store, tmp_path / "stopped", processes=2, batch_size=2, steps=4)
    train(store, tmp_path / "straight", processes=2, batch_size=2, steps=4)
    stopped, straight = (load_weights(tmp_path / name / "weights.safetensors") for name in ("stopped", "straight"))
    assert all(np.array_equal(stopped.tensors[name], value) for name, value in straight.tensors.items())
