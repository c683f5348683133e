"""The recipes start: what they import exists, and their settings are read."""

from __future__ import annotations

import importlib.util
import sys
from argparse import Namespace
from pathlib import Path
from types import ModuleType
from typing import Any

import cv2
import numpy as np
import pytest
import yaml

pytest.importorskip("torch", reason="training needs the extra `train`")

import torch

from improvo import config
from improvo.errors import ConfigError
from improvo.frontend.network import load_network_frontend
from improvo.frontend.registry import load_frontend
from improvo.frontend.runtime_torch import load_network
from improvo.frontend.settings import NetworkOptions
from improvo.frontend.weights_files import DataSource, find_weights, load_weights
from improvo.simulation.causes import Cause
from improvo.training.data.pack import write_pack
from improvo.training.data.pictures import Pictures, Source
from improvo.training.held_settings import HeldSettings
from improvo.training.settings import OdometryTrainingSettings

RECIPES = Path(__file__).parents[1] / "recipes"


def recipe(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"recipe_{name}", RECIPES / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # where dataclasses look up the types of their fields
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("name", sorted(path.stem for path in RECIPES.glob("*.py")))
def test_a_recipe_imports_and_explains_itself(
    name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    if name in ("release", "wheels") and sys.version_info < (3, 11):
        pytest.skip("needs tomllib, of Python 3.11")
    module = recipe(name)
    monkeypatch.setattr("sys.argv", [name, "--help"])
    with pytest.raises(SystemExit) as end:
        module.main()
    assert end.value.code == 0
    assert f"recipes/{name}.py" in capsys.readouterr().out


def test_a_sum_of_weights_is_one_of_all_their_heads_or_says_why_not() -> None:
    without, having = (load_weights(find_weights(name)) for name in ("superpoint-small", "superpoint-vo-small"))
    combined = recipe("combine").combined
    found = combined([("a", having, 0.5), ("b", without, 1.5), ("c", without, -1.0)]).tensors
    first, other = having.tensors["encoder.0.convolution.weight"], without.tensors["encoder.0.convolution.weight"]
    np.testing.assert_allclose(found["encoder.0.convolution.weight"], 0.5 * first + 0.5 * other, atol=1e-6)
    bias = "stability.1.convolution.bias"
    np.testing.assert_allclose(found[bias], having.tensors[bias], rtol=1e-6)
    with pytest.raises(ConfigError, match="is not in the first file"):
        combined([("a", without, 0.5), ("b", having, 0.5)])
    with pytest.raises(ConfigError, match="sum to zero"):
        combined([("a", having, 0.5), ("b", having, -0.5), ("c", without, 1.0)])


@pytest.mark.parametrize("name", ["stability-head", "superpoint-vo"])
def test_settings_of_a_recipe_are_read(name: str) -> None:
    settings = config.load(OdometryTrainingSettings, RECIPES / f"{name}.yaml")
    assert settings != OdometryTrainingSettings()


@pytest.mark.parametrize("tiny", [False, True])
def test_every_job_of_the_plan_has_settings(tiny: bool) -> None:
    plan: dict[str, Any] = yaml.safe_load((RECIPES / "gpu-plan.yaml").read_text())
    for job in plan["jobs"]:
        settings = recipe("gpu_train").settings_of(job, plan, Namespace(tiny=tiny, compile=True))
        assert isinstance(settings, HeldSettings)
        assert settings.compile
        assert settings.views.width == (64 if tiny else 320)


def test_a_small_network_is_taught_by_a_larger_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    coarse = rng.integers(0, 256, (20, 30), dtype=np.uint8)
    scene = cv2.resize(coarse, (300, 200), interpolation=cv2.INTER_NEAREST)
    frames = tuple(np.ascontiguousarray(scene[:120, shift : shift + 160]) for shift in (0, 6, 12, 18))
    licence = DataSource("drawn squares", "CC0 1.0", "nobody")
    pack, output = tmp_path / "pack.zip", tmp_path / "taught.safetensors"
    write_pack(pack, Pictures((Source("squares", frames, ("",) * 4, 1.0),)), [], [licence], quality=95)
    monkeypatch.setattr("sys.argv", ["distil", str(pack), "-o", str(output), "--steps", "40", "--seed", "3"])
    distil = recipe("distil")
    distil.main()

    before, after = load_weights(find_weights("superpoint-small")), load_weights(output)
    changed = {name for name, values in after.tensors.items() if not np.array_equal(values, before.tensors[name])}
    assert {name.split(".convolution")[0].split(".norm")[0] for name in changed} == {
        "encoder.6", "encoder.7", "descriptor.0", "descriptor.1"
    }  # fmt: skip
    assert after.card.training["teachers"] == ["superpoint-vo", "superpoint-small"]
    assert after.card.training["frames"] == 4
    assert licence in after.card.data
    assert not after.card.activation_ranges, "those of the start no longer hold"

    options = Namespace(start="superpoint-small", teachers=["superpoint-vo", "superpoint-small"], frozen_layers=6)
    known = distil.known_frames(frames[:2], load_network(before), options)
    untaught, taught = (
        float(distil.pair_loss(load_network(weights), tuple(known), torch.tensor(distil.SCALE), 6).detach())
        for weights in (before, after)
    )
    assert taught < 0.9 * untaught


def test_a_head_is_taught_to_a_network_without_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(1)
    frames = []
    for _ in range(6):
        plain = np.full((120, 160), 128, np.uint8)
        plain[:, 80:] = cv2.resize(rng.integers(0, 256, (12, 8), dtype=np.uint8), (80, 120))
        frames.append(plain)
    licence = DataSource("drawn halves", "CC0 1.0", "nobody")
    pack, output = tmp_path / "pack.zip", tmp_path / "taught.safetensors"
    write_pack(pack, Pictures((Source("halves", tuple(frames), ("",) * 6, 1.0),)), [], [licence], quality=95)
    monkeypatch.setattr("sys.argv", ["distil_head", str(pack), "-o", str(output), "--steps", "60"])
    recipe("distil_head").main()

    before, after = load_weights(find_weights("superpoint-small")), load_weights(output)
    assert after.architecture.stability
    assert all(np.array_equal(after.tensors[name], values) for name, values in before.tensors.items())
    assert after.card.training["stability_from"] == "superpoint-vo"
    assert licence in after.card.data
    options = NetworkOptions(precision="float32")
    taught, teacher = (load_frontend(name, 200, network=options) for name in (str(output), "superpoint-vo"))
    said, wanted = ([network.stability_map(frame) for frame in frames] for network in (taught, teacher))
    assert np.abs(np.array(said) - wanted).mean() < 0.1


def test_in_rooms_a_head_is_taught_the_mean_of_the_teacher_and_the_truth(tmp_path: Path) -> None:
    picture = np.random.default_rng(2).integers(0, 256, (96, 352), dtype=np.uint8)
    causes = np.zeros(picture.shape, np.uint8)
    causes[:, 176:] = Cause.MOVING
    for kind, image in (("rgb", picture), ("labels", causes)):
        (tmp_path / "room" / kind).mkdir(parents=True)
        cv2.imwrite(str(tmp_path / "room" / kind / "000000.png"), image)
    distil = recipe("distil_head")
    [(shown, unstable)] = distil.rooms_frames(tmp_path)
    np.testing.assert_array_equal(shown, picture)
    np.testing.assert_array_equal(unstable, causes > 0)
    assert [image.shape for image in distil.halved(1, shown, unstable)] == [(48, 176), (96, 352)]

    teacher = load_network_frontend("superpoint-vo", precision="float32")
    network = load_network(load_weights(find_weights("superpoint-vo")))
    alone, with_truth = (distil.known_frame(shown, truth, network, teacher).stable for truth in (None, unstable))
    torch.testing.assert_close(with_truth[..., :22], (alone[..., :22] + 1) / 2)
    torch.testing.assert_close(with_truth[..., 22:], alone[..., 22:] / 2)
