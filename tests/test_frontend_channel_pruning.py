"""Channels that are always zero: a network computes the same with and without them, and training keeps them at zero."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from improvo.frontend.architecture import Architecture
from improvo.frontend.channel_pruning import with_dead_channels, without_dead_channels
from improvo.frontend.network import NetworkFrontend, prepare
from improvo.frontend.settings import NetworkSettings
from improvo.frontend.weights_files import ModelCard, Weights, load_weights, save_weights
from network_examples import TINY, random_weights

WIDE = dataclasses.replace(TINY, name="wide", encoder=(8, 8, 8, 8, 8, 8, 8, 8))


def picture() -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (48, 64), np.uint8)


def padded(normalisation: str) -> tuple[Weights, Weights]:
    """Weights of the narrow network, and the same function as a wide one."""
    narrow = random_weights(dataclasses.replace(TINY, normalisation=normalisation))
    wide = dataclasses.replace(WIDE, normalisation=normalisation)
    return narrow, Weights(ModelCard(wide, "none"), with_dead_channels(narrow.tensors, wide))


@pytest.mark.parametrize("normalisation", ["none", "before_relu", "after_relu"])
def test_dead_channels_are_found_and_left_out(normalisation: str) -> None:
    narrow, wide = padded(normalisation)
    live = without_dead_channels(wide)
    assert live.architecture.encoder == TINY.encoder
    assert live.architecture.multiplications(480, 640) < 0.7 * wide.architecture.multiplications(480, 640)
    assert live.tensors.keys() == narrow.tensors.keys()
    assert all(np.array_equal(live.tensors[name], values) for name, values in narrow.tensors.items())
    assert without_dead_channels(narrow) is narrow


@pytest.mark.parametrize("runtime", ["openvino", "torch"])
def test_the_wide_network_computes_what_the_narrow_one_does(runtime: str) -> None:
    pytest.importorskip(runtime)
    narrow, wide = padded("before_relu")
    image = prepare(picture())[None, None]
    first, second = (NetworkFrontend(w, NetworkSettings(runtime=runtime)).runtime(image) for w in (narrow, wide))
    for ours, theirs in zip(first, second, strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_torch_computes_the_same_with_the_dead_channels_in_place() -> None:
    torch = pytest.importorskip("torch")
    from improvo.frontend.runtime_torch import load_network

    narrow, wide = padded("before_relu")
    image = torch.from_numpy(prepare(picture())[None, None])
    with torch.inference_mode():
        for ours, theirs in zip(load_network(narrow)(image), load_network(wide)(image), strict=True):
            torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-4)


def test_training_keeps_dead_channels_out_and_saves_the_published_widths(tmp_path: Path, monkeypatch) -> None:
    torch = pytest.importorskip("torch")
    from improvo.training.networks import ARCHITECTURES, first_network
    from improvo.training.settings import HomographiesSettings

    full = Architecture("full", encoder=(8, 8, 8, 8, 8, 8, 8, 8), head=8, descriptor=8)
    monkeypatch.setitem(ARCHITECTURES, "full", full)
    asked = HomographiesSettings(architecture="full", stem_channels=4)
    network = first_network(asked.architecture, 0, None, asked.stem_channels)
    assert network.architecture.encoder == (4, 4, 4, 4, 8, 8, 8, 8)
    tensors = {name: values.numpy() for name, values in network.state_dict().items()}
    published = dataclasses.replace(full, stability=False)
    path = tmp_path / "full.safetensors"
    save_weights(path, with_dead_channels(tensors, published), ModelCard(published, "none"))
    assert load_weights(path).architecture.encoder == full.encoder
    again = first_network("full", 0, path)
    assert again.architecture.encoder == network.architecture.encoder
    for name, values in network.state_dict().items():
        torch.testing.assert_close(again.state_dict()[name], values)
