"""Training that is held to what the start says of pictures of other places."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="training needs the extra `train`")

from posed_room import posed_room  # noqa: E402

from improvo.frontend.network import NetworkFrontend  # noqa: E402
from improvo.frontend.runtime_torch import load_network  # noqa: E402
from improvo.frontend.settings import NetworkSettings  # noqa: E402
from improvo.frontend.weights_files import Weights, find_weights, load_weights  # noqa: E402
from improvo.improvement.settings import ImproveSettings  # noqa: E402
from improvo.training.batches.elsewhere import BUNDLED_SOURCE, HeldElsewhere, bundled_pictures  # noqa: E402
from improvo.training.data.pictures import Pictures  # noqa: E402
from improvo.training.held_settings import ElsewhereSettings, HeldSettings  # noqa: E402
from improvo.training.held_training import train_held  # noqa: E402
from improvo.training.stages.held import HeldStage  # noqa: E402
from test_training_held import SMALL, photographs  # noqa: E402
from training_examples import stopped_after  # noqa: E402

START = find_weights("superpoint-small")
HOLDING = replace(SMALL, elsewhere=ElsewhereSettings(weight=1.0), frozen_layers=4, fixed_statistics=True)


class NoBatches:
    """Batches with nothing in them."""

    def __len__(self) -> int:
        return 3

    def __getitem__(self, step: int) -> dict[str, Any]:
        return {}


def held_elsewhere(settings: HeldSettings, stability: Weights | None = None) -> HeldElsewhere:
    parent = load_weights(START)
    pictures, cpu = bundled_pictures()[::13], torch.device("cpu")
    return HeldElsewhere(NoBatches(), pictures, parent, stability, settings, cpu, torch.float32)


def trained(settings: HeldSettings, output: Path) -> Weights:
    train_held(Pictures((photographs(),)), [posed_room()], settings, output, START, progress=False)
    return load_weights(output / "weights.safetensors")


def test_the_package_has_pictures_of_other_places() -> None:
    pictures = bundled_pictures()
    assert len(pictures) == 39
    assert {picture.shape for picture in pictures} == {(240, 320)}
    assert all(picture.std() > 15 for picture in pictures)
    assert ImproveSettings().held.elsewhere.weight > 0


@pytest.mark.parametrize("frozen", [0, 4])
def test_the_start_is_where_it_is_held_and_anything_else_is_not(frozen: int) -> None:
    settings = replace(HOLDING, frozen_layers=frozen, elsewhere=ElsewhereSettings(weight=1.0, pictures=2, points=100))
    batches = held_elsewhere(settings)
    batch = batches[1]
    assert batch["elsewhere_points"].shape == (2, 100, 2)
    assert batch["elsewhere_descriptors"].shape == (2, 100, 128)
    assert all(torch.equal(batches[1][name], values) for name, values in batch.items())
    stage = HeldStage(load_network(load_weights(START)), settings).eval()
    with torch.no_grad():
        assert float(stage._elsewhere(batch)) < 1e-4
        stage.network.descriptor[1].convolution.weight += 0.05
        assert float(stage._elsewhere(batch)) > 0.01


def test_stability_is_held_too_where_there_is_a_teacher_of_it() -> None:
    vo = load_weights(find_weights("superpoint-vo-small"))
    batch = held_elsewhere(HOLDING, vo)[0]
    assert batch["elsewhere_stability"].shape == (1, 2, 30, 40)
    assert "elsewhere_stability" not in held_elsewhere(HOLDING)[0]


def test_descriptors_of_other_places_move_less_where_they_are_held(tmp_path: Path) -> None:
    picture = bundled_pictures()[4]
    faster = replace(HOLDING, optimiser=replace(SMALL.optimiser, learning_rate=2e-3))
    places = []
    for weight in (0.0, 20.0):
        weights = trained(replace(faster, elsewhere=ElsewhereSettings(weight=weight)), tmp_path / str(weight))
        named = BUNDLED_SOURCE in weights.card.data
        assert named == (weight > 0)
        with torch.no_grad():
            network = load_network(weights)
            seen = torch.from_numpy(picture[None, None].astype(np.float32) / 255)
            places.append(torch.nn.functional.normalize(network.descriptor(network.encode(seen)), dim=1))
    with torch.no_grad():
        network = load_network(load_weights(START))
        before = torch.nn.functional.normalize(network.descriptor(network.encode(seen)), dim=1)
    free, held = (float((1 - (each * before).sum(dim=1)).mean()) for each in places)
    assert held < 0.7 * free


def test_a_killed_training_that_is_held_elsewhere_ends_with_the_same_weights(tmp_path: Path) -> None:
    whole = trained(HOLDING, tmp_path / "whole")
    with stopped_after(7):
        trained(HOLDING, tmp_path / "parts")
    parts = trained(HOLDING, tmp_path / "parts")
    assert all(np.array_equal(whole.tensors[name], parts.tensors[name]) for name in whole.tensors)
    assert whole.card.training["settings"]["elsewhere"]["weight"] == 1.0
    assert len(NetworkFrontend(whole, NetworkSettings(precision="float32"))(bundled_pictures()[0]).keypoints) > 50
