"""The loop with the real training, in six steps: nothing gets better, but all of it happens, and survives a kill."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rendered_walk import write_walk

from improvo.cli.main import main
from improvo.frontend.network import load_network_frontend
from improvo.frontend.weights_files import load_weights, save_weights

COMMAND = [
    *("--frontend", "superpoint-small", "--max-keypoints", "250", "--steps", "6", "--batch-size", "2"),
    *("--set", "labels.min_observations=6", "--set", "validation.gaps=[4,8]", "--set", "validation.matches.pairs=4"),
    *("--set", "validation.min_pairs=2", "--set", "split.share=0.3", "--set", "validation.calibration_images=2"),
    *("--set", "held.views.height=120", "--set", "held.views.width=160", "--control", "--rounds", "1"),
    *("--set", "odometry.start.min_points=20"),  # the room is mostly one wall
    *("--set", "held.optimiser.checkpoint_minutes=0", "--set", "held.optimiser.log_every=1"),
    *("--threads", "1"),
]


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="needs kill -9")
def test_a_round_is_the_same_after_a_kill(tmp_path: Path) -> None:
    walk = write_walk(tmp_path / "room", frames=40, seed=3)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "OMP_NUM_THREADS": "1"}

    def start(out: Path) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", "improvo", "improve", str(walk), "-o", str(out), *COMMAND]
        return subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    calm, killed = tmp_path / "calm", tmp_path / "killed"
    assert start(calm).wait() == 0
    process = start(killed)
    while not (killed / "round-1" / "training" / "checkpoint.pt").is_file():
        assert process.poll() is None
        time.sleep(0.01)
    process.kill()
    process.wait()
    assert start(killed).wait() == 0

    trained = load_weights(calm / "round-1" / "weights.safetensors")
    assert trained.architecture.stability == load_weights(calm / "start" / "weights.safetensors").architecture.stability
    assert trained.card.activation_ranges
    start_weights = load_weights(calm / "start" / "weights.safetensors")
    assert any(not np.array_equal(trained.tensors[name], start_weights.tensors[name]) for name in start_weights.tensors)
    for name in ("round-1/weights.safetensors", "control-1/weights.safetensors", "weights.safetensors"):
        ours, theirs = load_weights(killed / name), load_weights(calm / name)
        assert ours.tensors.keys() == theirs.tensors.keys()
        for key, tensor in ours.tensors.items():
            np.testing.assert_array_equal(tensor, theirs.tensors[key])
    for part in ("training", "held-back"):
        path = Path("reference", "room", f"depth-{part}.zip")
        assert (killed / path).read_bytes() == (calm / path).read_bytes()
    assert not (calm / "start" / "labels").exists()  # whole frames need none
    assert not list(killed.rglob("*.partial*"))
    assert load_network_frontend(calm / "round-1" / "weights.safetensors").runtime.name == "openvino-int8"


def test_weights_that_a_kill_left_behind_their_checkpoint_are_written_again(tmp_path: Path) -> None:
    command = ["train", "shapes", "-o", str(tmp_path), "--steps", "4", "--batch-size", "2", "--threads", "1"]
    command += ["--set", "optimiser.workers=0", "--set", "optimiser.log_every=2", "--set", "views.height=48"]
    assert main(command) == 0
    weights = tmp_path / "weights.safetensors"
    whole = load_weights(weights)
    for old in (None, 2):  # never written, or of an earlier checkpoint
        weights.unlink()
        if old:
            card = replace(whole.card, training={**whole.card.training, "steps": old})
            save_weights(weights, {name: 0 * tensor for name, tensor in whole.tensors.items()}, card)
        assert main(command) == 0
        again = load_weights(weights)
        assert again.card.training["steps"] == 4
        assert all(np.array_equal(again.tensors[name], tensor) for name, tensor in whole.tensors.items())


@pytest.mark.skipif(sys.platform != "linux", reason="needs a limit on the size of files")
def test_a_checkpoint_that_finds_the_disk_full_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    import resource

    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, before[1]))
    try:
        command = ["train", "shapes", "-o", str(tmp_path), "--steps", "1", "--batch-size", "1", "--threads", "1"]
        assert main([*command, "--set", "optimiser.workers=0", "--set", "views.height=48"]) == 2
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    message = capsys.readouterr().err.strip().splitlines()[-1]
    assert message.startswith("improvo: ")
    assert "checkpoint.pt: cannot be written (is the disk full?" in message
    assert not list(tmp_path.glob("*.partial*"))
