"""Training and the loop at a location: they go on on another machine."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from rendered_walk import write_walk

pytest.importorskip("torch", reason="training needs the extra `train`")

from improvement_example import SETTINGS, FakeTraining
from improvement_example import run as improve
from improvo.cli.main import main
from improvo.locations import local_folder, publish
from labeled_scene import write_labeled_scene
from location_places import cache, forget, fsspec, memory, names, s3, upload

__all__ = ["cache", "memory", "s3"]  # fixtures


def check_training(url: str, tmp_path: Path, cache: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A training that was stopped goes on elsewhere, and ends with the weights of one that was not."""
    store = write_labeled_scene(tmp_path / "labels")
    upload(store, f"{url}/labels")
    words = ["train", "odometry", f"{url}/labels", "--from", "superpoint-small", "--batch-size", "2"]
    words += ["--workers", "0", "--threads", "1"]
    words += ["--set", "views.height=48", "--set", "views.width=64", "--set", "optimiser.decay_steps=1"]
    assert main([*words, "--steps", "2", "-o", f"{url}/network"]) == 0
    assert f"{url}/network/weights.safetensors" in capsys.readouterr().out
    assert {"weights.safetensors", "weights.json", "metrics.jsonl", "checkpoint.pt"} <= names(f"{url}/network")
    assert not any("landmarks" in name for name in names(f"{url}/labels"))
    forget(cache)
    assert main([*words, "--steps", "4", "-o", f"{url}/network"]) == 0
    assert main([*words, "--steps", "2", "-o", str(tmp_path / "local")]) == 0
    assert main([*words, "--steps", "4", "-o", str(tmp_path / "local")]) == 0
    system, root = fsspec.core.url_to_fs(f"{url}/network")
    trained = system.cat_file(f"{root}/metrics.jsonl").decode().splitlines()
    assert [line.split(",")[0] for line in trained] == ['{"step": 2', '{"step": 4']
    assert len((tmp_path / "local" / "metrics.jsonl").read_text().splitlines()) == len(trained)


def test_training_in_memory(memory: str, tmp_path: Path, cache: Path, capsys: pytest.CaptureFixture[str]) -> None:
    check_training(memory, tmp_path, cache, capsys)


def test_training_on_s3(s3: str, tmp_path: Path, cache: Path, capsys: pytest.CaptureFixture[str]) -> None:
    check_training(s3, tmp_path, cache, capsys)


def test_a_loop_goes_on_elsewhere(memory: str, tmp_path: Path, cache: Path) -> None:
    walk = write_walk(tmp_path / "room", frames=30, seed=3)
    settings = replace(SETTINGS, frontend=replace(SETTINGS.frontend, name="superpoint-small"))
    first, second = FakeTraining(), FakeTraining()
    improve(local_folder(f"{memory}/better"), [walk], first, rounds=1, settings=settings)
    publish(local_folder(f"{memory}/better"))
    weights = fsspec.filesystem("memory").cat_file("/bucket/work/better/weights.safetensors")
    forget(cache)
    result = improve(local_folder(f"{memory}/better"), [walk], second, rounds=1, settings=settings)
    assert (len(first.calls), len(second.calls)) == (1, 0)
    assert result.weights.read_bytes() == weights
