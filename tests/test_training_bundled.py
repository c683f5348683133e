"""The bundled weights: what their cards say, and that their detectors beat the classical ones on drawn shapes."""

from __future__ import annotations

import json

import numpy as np
import pytest

from improvo.frontend.network import load_network_frontend
from improvo.frontend.weights_files import BUNDLED, bundled_names, load_weights
from improvo.training.settings import PhotometricSettings
from improvo.types import Float32, UInt8
from shape_detection import ScoredDetector, classical_detectors, mean_average_precision, shape_tests

NAMES = [name for name in ("superpoint", "superpoint-small") if name in bundled_names()]
LICENCES = {"CC BY 3.0", "CC BY 4.0", "MIT", "CC0 1.0", "Apache-2.0", "Apache-2.0 or MIT"}
FORBIDDEN = ("redkitchen", "hololens", "checkerboard", "kitti")


def network(name: str) -> ScoredDetector:
    frontend = load_network_frontend(name, max_keypoints=100, threshold=0.0, border=0, precision="float32", threads=1)

    def detect(image: UInt8) -> tuple[Float32, Float32]:
        features = frontend(image)
        return features.keypoints, features.scores

    return detect


def test_weights_are_bundled() -> None:
    assert NAMES


@pytest.mark.parametrize("name", NAMES)
def test_cards_name_data_licences_and_figures(name: str) -> None:
    path = BUNDLED / f"{name}.safetensors"
    card = load_weights(path).card
    assert card.architecture.name == name
    assert card.licence == "Apache-2.0"
    assert len(card.commit) == 40
    assert card.training["steps"] > 0
    assert card.training["stability_trained"] is card.architecture.stability is False
    assert {source.licence for source in card.data} <= LICENCES
    assert all(source.attribution for source in card.data)
    assert not [source.name for source in card.data if any(word in source.name for word in FORBIDDEN)]
    assert json.loads(path.with_suffix(".json").read_text())["training"]["steps"] == card.training["steps"]
    assert path.stat().st_size < 7e6


@pytest.mark.parametrize("name", bundled_names())
def test_every_card_tells_the_head_and_licences_that_allow_to_ship(name: str) -> None:
    card = load_weights(BUNDLED / f"{name}.safetensors").card
    assert card.architecture.stability is ("-vo" in name)
    assert card.licence == "Apache-2.0"
    assert {source.licence for source in card.data} <= LICENCES
    assert not [source.name for source in card.data if any(word in source.name for word in FORBIDDEN)]


@pytest.mark.parametrize("name", NAMES)
def test_detectors_beat_the_classical_ones_on_noisy_shapes(name: str) -> None:
    tests = shape_tests(10, seed=2000, noise=PhotometricSettings())
    ours, _ = mean_average_precision(network(name), tests)
    for classical, detect in classical_detectors().items():
        theirs, families = mean_average_precision(detect, tests)
        assert len(families) == 7
        assert 0 < theirs < ours, classical
    assert ours > 0.15


def test_the_small_network_with_a_head_sees_what_the_one_without_sees() -> None:
    plain, headed = (
        load_network_frontend(name, max_keypoints=300) for name in ("superpoint-small", "superpoint-vo-small")
    )
    for test in shape_tests(2, seed=9):
        picture = test.image
        without, with_head = plain(picture), headed(picture)
        assert without.stability is None
        assert with_head.stability is not None
        assert with_head.stability.shape == (len(with_head.keypoints),)
        assert ((with_head.stability >= 0) & (with_head.stability <= 1)).all()
        np.testing.assert_allclose(with_head.keypoints, without.keypoints, atol=1e-3)
        np.testing.assert_allclose(with_head.descriptors, without.descriptors, atol=1e-3)


def test_average_precision_of_known_detections() -> None:
    tests = shape_tests(3, seed=5)

    def perfect(image: UInt8) -> tuple[Float32, Float32]:
        corners = next(test.corners for test in tests if test.image is image)
        return corners, corners[:, 0] + 1

    def half(image: UInt8) -> tuple[Float32, Float32]:
        corners, scores = perfect(image)
        return corners + 50, scores

    assert mean_average_precision(perfect, tests)[0] == pytest.approx(1.0)
    assert mean_average_precision(half, tests)[0] < 0.2
