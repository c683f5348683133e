"""The weights that come with the package: their card, and the conventions on a drawn picture with real responses."""

from __future__ import annotations

import dataclasses
import json

import cv2
import numpy as np
import pytest

from sivo.frontend.network import NetworkFrontend
from sivo.frontend.settings import NetworkSettings
from sivo.frontend.weights import BUNDLED, bundled_names, find_weights, load_weights
from sivo.types import Float32, UInt8

SETTINGS = NetworkSettings(max_keypoints=150, precision="float32")
pytestmark = pytest.mark.skipif(not bundled_names(), reason=f"no weights are bundled yet in {BUNDLED}")


@pytest.fixture(scope="module", params=bundled_names())
def frontend(request) -> NetworkFrontend:
    return NetworkFrontend(load_weights(find_weights(request.param)), SETTINGS, name=request.param)


@pytest.fixture(scope="module")
def drawing() -> UInt8:
    """Bright and dark quadrilaterals on grey, 245 x 330 (height x width), smoothed and a little noisy."""
    random = np.random.default_rng(4)
    image = np.full((245, 330), 120, np.uint8)
    for x in range(40, 320, 60):
        for y in range(40, 230, 55):
            angles = np.sort(random.uniform(0, 2 * np.pi) + np.array([0, 1.5, 3.1, 4.6]))
            corners = np.stack([x + 20 * np.cos(angles), y + 18 * np.sin(angles)], axis=1)
            cv2.fillPoly(image, [corners.astype(np.int32)], int(random.choice([20, 50, 200, 235])))
    noise = random.normal(0, 3, image.shape)
    return np.clip(cv2.GaussianBlur(image, (0, 0), 0.7) + noise, 0, 255).astype(np.uint8)


def share_found(keypoints: Float32, expected: Float32, tolerance: float) -> float:
    """How many of the expected keypoints have one within the tolerance."""
    distances = np.linalg.norm(keypoints[:, None] - expected, axis=2)
    return float((distances.min(axis=0) <= tolerance).mean())


def test_the_card_names_licence_and_data(frontend):
    card = frontend.weights.card
    assert card.licence == "Apache-2.0"
    assert card.data
    assert all(source.name and source.licence for source in card.data)
    assert card.training
    assert card.metrics
    beside = json.loads((BUNDLED / f"{frontend.name}.json").read_text())
    assert beside["architecture"]["encoder"] == list(card.architecture.encoder)


@pytest.mark.parametrize("shift", [(1, 0), (3, 6), (8, 16)])
def test_shifting_the_picture_shifts_the_keypoints(frontend, drawing, shift):
    x, y = shift
    first, second = drawing[: 245 - y, : 330 - x], drawing[y:, x:]
    expected = frontend(second).keypoints + shift
    inside = ((expected > 12) & (expected < [330 - x - 12, 245 - y - 12])).all(axis=1)
    assert inside.sum() > 40
    assert share_found(frontend(first).keypoints, expected[inside], 1.0) > 0.8


@pytest.mark.parametrize("axis", [0, 1])
def test_flipping_the_picture_mirrors_the_keypoints(frontend, drawing, axis):
    expected = frontend(drawing).keypoints.copy()
    expected[:, 1 - axis] = drawing.shape[axis] - 1 - expected[:, 1 - axis]
    flipped = frontend(np.ascontiguousarray(np.flip(drawing, axis))).keypoints
    assert share_found(flipped, expected, 1.5) > 0.7
    near = np.linalg.norm(flipped[:, None] - expected, axis=2)
    pairs = near.min(axis=1) <= 2
    offset = (flipped[pairs] - expected[near.argmin(axis=1)[pairs]]).mean(axis=0)
    assert np.abs(offset).max() < 0.35  # a convention off by one pixel would show as 1, by half a pixel as 0.5


def test_enlarging_the_picture_carries_the_keypoints(frontend, drawing):
    large = cv2.resize(drawing, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC)
    found, expected = frontend(large).keypoints, 2 * frontend(drawing).keypoints + 0.5
    near = np.linalg.norm(found[:, None] - expected, axis=2)
    pairs = near.min(axis=1) <= 4
    assert pairs.mean() > 0.5
    offset = np.median(found[pairs] - expected[near.argmin(axis=1)[pairs]], axis=0)
    assert np.abs(offset).max() < 1.0


def test_int8_finds_nearly_the_same(frontend, drawing):
    weights = frontend.weights
    if not weights.card.activation_ranges:
        pytest.skip("these weights are not calibrated for int8")
    int8 = NetworkFrontend(weights, dataclasses.replace(SETTINGS, precision="int8"))(drawing)
    float32 = frontend(drawing)
    assert share_found(int8.keypoints, float32.keypoints, 1.0) > 0.85
    both = np.linalg.norm(int8.keypoints[:, None] - float32.keypoints, axis=2)
    rows, columns = np.nonzero(both == 0)
    cosine = (int8.descriptors[rows] * float32.descriptors[columns]).sum(axis=1)
    assert len(rows) > 50
    assert np.median(cosine) > 0.99
