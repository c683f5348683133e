"""Weights in the layouts of other programs: their names and shapes, and the same maps as ours to a stated tolerance."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from improvo.cli.main import main
from improvo.frontend.architecture import ARCHITECTURES, Architecture
from improvo.frontend.network import NetworkFrontend
from improvo.frontend.settings import NetworkSettings
from improvo.frontend.weights_files import find_weights, load_weights, save_weights
from network_examples import random_weights

torch = pytest.importorskip("torch", reason="needs torch: pip install 'improvo[train]'")
SCORES, DESCRIPTORS = 2e-6, 5e-6  # largest difference to ours in float32: of the heat map, of unit descriptors

ENCODER = ["1a", "1b", "2a", "2b", "3a", "3b", "4a", "4b"]
ORIGINAL = {f"conv{name}.{part}" for name in (*ENCODER, "Pa", "Pb", "Da", "Db") for part in ("weight", "bias")}
BLOCKS = [f"{stage}.{i}.{half}" for stage, n in (("backbone", 4),) for i in range(n) for half in (0, 1)]
BLOCKS += [f"{head}.{i}" for head in ("detector", "descriptor") for i in (0, 1)]
NORM = ("weight", "bias", "running_mean", "running_var", "num_batches_tracked")
RPAUTRAT = {f"{block}.conv.{part}" for block in BLOCKS for part in ("weight", "bias")}
RPAUTRAT |= {f"{block}.bn.{part}" for block in BLOCKS for part in NORM}


def original(tensors, image):
    """The forward pass of the original release, on its names."""
    functional = torch.nn.functional

    def layer(x, name):
        weight = tensors[f"conv{name}.weight"]
        return functional.conv2d(x, weight, tensors[f"conv{name}.bias"], padding=weight.shape[-1] // 2)

    x = image
    for position, name in enumerate(ENCODER):
        x = functional.relu(layer(x, name))
        x = functional.max_pool2d(x, 2) if position in (1, 3, 5) else x
    return [layer(functional.relu(layer(x, f"{head}a")), f"{head}b") for head in "PD"]


def rpautrat(tensors, image):
    """The same with a batch norm after every ReLU, and after the last convolution of a head."""
    functional = torch.nn.functional

    def layer(x, name, relu=True):
        weight = tensors[f"{name}.conv.weight"]
        x = functional.conv2d(x, weight, tensors[f"{name}.conv.bias"], padding=weight.shape[-1] // 2)
        x = functional.relu(x) if relu else x
        mean, var, gamma, beta = (tensors[f"{name}.bn.{part}"] for part in (*NORM[2:4], *NORM[:2]))
        return functional.batch_norm(x, mean, var, gamma, beta, eps=1e-3)

    x = image
    for position, name in enumerate(BLOCKS[:8]):
        x = layer(x, name)
        x = functional.max_pool2d(x, 2) if position in (1, 3, 5) else x
    return [layer(layer(x, f"{head}.0"), f"{head}.1", relu=False) for head in ("detector", "descriptor")]


def same_maps(weights_file, tensors, forward):
    """Hold another program's maps against those of our frontend in float32."""
    frontend = NetworkFrontend(load_weights(weights_file), NetworkSettings(precision="float32"))
    image = torch.rand((1, 1, 48, 64), generator=torch.Generator().manual_seed(1))
    maps = frontend.runtime(image.numpy())
    with torch.no_grad():
        logits, cells = forward(tensors, image)
    heat = torch.nn.functional.pixel_shuffle(torch.softmax(logits, 1)[:, :64], 8)[:, 0].numpy()
    np.testing.assert_allclose(heat, maps.heat, atol=SCORES)
    theirs = torch.nn.functional.normalize(cells, dim=1).permute(0, 2, 3, 1).numpy()
    ours = maps.descriptors / np.linalg.norm(maps.descriptors, axis=-1, keepdims=True)
    width = ours.shape[-1]
    np.testing.assert_allclose(theirs[..., :width], ours, atol=DESCRIPTORS)
    assert not theirs[..., width:].any()


@pytest.mark.parametrize("name", ["superpoint-vo", "superpoint-small"])
@pytest.mark.parametrize(
    ("layout", "names", "forward"), [("original", ORIGINAL, original), ("rpautrat", RPAUTRAT, rpautrat)]
)
def test_bundled_weights_compute_the_same_elsewhere(name, layout, names, forward, tmp_path: Path, capsys):
    target = tmp_path / "other.pth"
    assert main(["weights", "export", name, "--layout", layout, "-o", str(target)]) == 0
    shown = capsys.readouterr().out
    assert "does not fit" in shown
    assert ("left out" in shown) == load_weights(find_weights(name)).architecture.stability
    assert ("the last 128 of them 0" in shown) == (name == "superpoint-small")
    tensors = torch.load(target, weights_only=True)
    assert set(tensors) == names
    full = [
        tuple(values.shape) for key, values in tensors.items() if key in ("convDb.weight", "descriptor.1.conv.weight")
    ]
    assert full == [(256, 256, 1, 1)]
    same_maps(find_weights(name), tensors, forward)
    card = json.loads(target.with_suffix(".json").read_text())
    assert card["licence"]
    assert card["layout"] == layout
    assert main(["weights", "export", name, "--layout", layout, "-o", str(target)]) == 2  # never over a file
    assert "exists already" in capsys.readouterr().err


@pytest.mark.parametrize("epsilon", [1e-3, 1e-5])
def test_batch_norm_after_the_relu_travels_as_it_is(epsilon, tmp_path: Path, capsys):
    narrow = Architecture("narrow", (4, 4, 4, 4, 6, 6, 8, 8), 12, 16, False, "after_relu", epsilon)
    weights = random_weights(narrow, contrast=5)
    save_weights(tmp_path / "ours.safetensors", weights.tensors, weights.card)
    words = ["weights", "export", str(tmp_path / "ours.safetensors"), "--layout"]
    assert main([*words, "rpautrat", "-o", str(tmp_path / "theirs.safetensors")]) == 0
    from safetensors.torch import load_file

    same_maps(tmp_path / "ours.safetensors", load_file(tmp_path / "theirs.safetensors"), rpautrat)
    for layout in ("original", "transformers"):
        assert main([*words, layout, "-o", str(tmp_path / "no.pth")]) == 2
        assert "--layout rpautrat" in capsys.readouterr().err
    assert not list(tmp_path.glob("no*"))


def test_a_network_that_a_layout_cannot_hold_is_one_line(tmp_path: Path, capsys):
    wide = replace(ARCHITECTURES["superpoint-small"], name="wide", descriptor=300)
    odd = replace(ARCHITECTURES["superpoint-small"], name="odd", encoder=(32, 30, 32, 32, 64, 64, 64, 64))
    for architecture, layout, target, message in (
        (wide, "original", "out.pth", "exceed"),
        (wide, "rpautrat", "out.pth", "exceed"),
        (odd, "transformers", "out", "one width for each pair"),
        (odd, "original", "out.bin", "name it .pth or .safetensors"),
        (odd, "original", "absent/out.pth", "make it first"),
    ):
        weights = random_weights(architecture)
        file = tmp_path / "ours" / f"{architecture.name}.safetensors"
        file.parent.mkdir(exist_ok=True)
        save_weights(file, weights.tensors, weights.card)
        assert main(["weights", "export", str(file), "--layout", layout, "-o", str(tmp_path / target)]) == 2
        shown = capsys.readouterr()
        assert message in shown.err
        assert len(shown.err.splitlines()) == 1
        assert shown.out == ""
    assert [path.name for path in tmp_path.iterdir()] == ["ours"]


def test_the_folder_for_transformers_keeps_the_widths(tmp_path: Path):
    assert main(["weights", "export", "superpoint-small", "--layout", "transformers", "-o", str(tmp_path / "out")]) == 0
    settings = json.loads((tmp_path / "out" / "config.json").read_text())
    assert settings["encoder_hidden_sizes"] == [32, 32, 64, 64]
    assert settings["descriptor_decoder_dim"] == 128
    transformers = pytest.importorskip("transformers", reason="needs the consumer: pip install transformers")
    model, info = transformers.SuperPointForKeypointDetection.from_pretrained(
        tmp_path / "out", output_loading_info=True
    )
    assert not any(info.values())
    image = (np.random.default_rng(0).random((96, 128)) * 255).astype(np.uint8)
    processor = transformers.AutoImageProcessor.from_pretrained(tmp_path / "out")
    with torch.no_grad():
        found = model(**processor(np.stack([image] * 3, axis=-1), return_tensors="pt"))
    settings = NetworkSettings(precision="float32", corner_radius=0, subpixel_radius=0, max_keypoints=5000)
    heat = NetworkFrontend(load_weights(find_weights("superpoint-small")), settings).heat_map(image)
    pixels = np.rint(found.keypoints[0].numpy() * [128, 96]).astype(int)
    assert len(pixels) > 50
    np.testing.assert_allclose(
        found.scores[0].numpy(), heat[pixels[:, 1], pixels[:, 0]], atol=1e-4
    )  # their grey differs
