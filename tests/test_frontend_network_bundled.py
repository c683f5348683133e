"""The weights that come with the package: their card, and the conventions on a drawn picture with real responses."""

from __future__ import annotations

import dataclasses
import json

import cv2
import numpy as np
import pytest

from improvo.frontend.network import NetworkFrontend
from improvo.frontend.runtime_openvino import loses_large_products
from improvo.frontend.settings import NetworkSettings
from improvo.frontend.weights_files import BUNDLED, bundled_names, find_weights, load_weights
from improvo.types import Float32, UInt8

SETTINGS = NetworkSettings(max_keypoints=150, precision="float32")
pytestmark = pytest.mark.skipif(not bundled_names(), reason=f"no weights are bundled yet in {BUNDLED}")


@pytest.fixture(scope="module", params=bundled_names())
def frontend(request) -> NetworkFrontend:
    return NetworkFrontend(load_weights(find_weights(request.param)), SETTINGS, name=request.param)


@pytest.fixture(scope="module")
def drawings() -> list[UInt8]:
    return [drawing(seed) for seed in range(5)]


def drawing(seed: int) -> UInt8:
    """Bright and dark quadrilaterals on grey, 245 x 330 (height x width), smoothed and a little noisy."""
    random = np.random.default_rng(seed)
    image = np.full((245, 330), 120, np.uint8)
    for x in range(40, 320, 60):
        for y in range(40, 230, 55):
            angles = np.sort(random.uniform(0, 2 * np.pi) + np.array([0, 1.5, 3.1, 4.6]))
            corners = np.stack([x + 20 * np.cos(angles), y + 18 * np.sin(angles)], axis=1)
            cv2.fillPoly(image, [corners.astype(np.int32)], int(random.choice([20, 50, 200, 235])))
    noise = random.normal(0, 3, image.shape)
    return np.clip(cv2.GaussianBlur(image, (0, 0), 0.7) + noise, 0, 255).astype(np.uint8)


def agreement(pairs: list[tuple[Float32, Float32]], tolerance: float) -> tuple[float, Float32]:
    """Share of expected keypoints with a found one within the tolerance, and the mean (x, y) from one to the other.

    Args:
        pairs: found and expected keypoints of each picture.
    """
    offsets, expected_count = [], 0
    for found, expected in pairs:
        distances = np.linalg.norm(found[:, None] - expected, axis=2)
        near = distances.min(axis=0) <= tolerance
        offsets.append(found[distances.argmin(axis=0)[near]] - expected[near])
        expected_count += len(expected)
    together = np.concatenate(offsets)
    return len(together) / expected_count, together.mean(axis=0)


def test_the_card_names_licence_and_data(frontend):
    card = frontend.weights.card
    assert card.licence == "Apache-2.0"
    assert card.data
    assert all(source.name and source.licence for source in card.data)
    assert card.training
    assert card.metrics
    beside = json.loads((BUNDLED / f"{frontend.name}.json").read_text())
    assert beside["architecture"]["encoder"] == list(card.architecture.encoder)


@pytest.mark.parametrize(("shift", "least"), [((1, 0), 0.75), ((3, 6), 0.6), ((8, 16), 0.9)])
def test_shifting_the_picture_shifts_the_keypoints(frontend, drawings, shift, least):
    pairs = []
    for picture in drawings:
        expected = frontend(picture[shift[1] :, shift[0] :]).keypoints + shift
        inside = ((expected > 20) & (expected < [310, 225])).all(axis=1)
        assert inside.sum() > 20
        pairs.append((frontend(picture).keypoints, expected[inside]))
    share, offset = agreement(pairs, tolerance=3)
    assert share > least
    assert np.abs(offset).max() < 0.4  # a convention that is off by a pixel would show as 1, or by half a pixel as 0.5


@pytest.mark.parametrize("axis", [0, 1])
def test_flipping_the_picture_mirrors_the_keypoints(frontend, drawings, axis):
    pairs = []
    for picture in drawings:
        expected = frontend(picture).keypoints.copy()
        expected[:, 1 - axis] = picture.shape[axis] - 1 - expected[:, 1 - axis]
        pairs.append((frontend(np.ascontiguousarray(np.flip(picture, axis))).keypoints, expected))
    share, offset = agreement(pairs, tolerance=3)
    assert share > 0.6
    # mirroring doubles an offset: half a pixel of convention would show as 1; a little is what training has left
    assert np.abs(offset).max() < 0.6


def test_enlarging_the_picture_carries_the_keypoints(frontend, drawings):
    pairs = []
    for picture in drawings:
        large = cv2.resize(picture, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC)
        pairs.append((frontend(large).keypoints, 2 * frontend(picture).keypoints + 0.5))
    share, offset = agreement(pairs, tolerance=4)
    assert share > 0.3
    assert np.abs(offset).max() < 0.5


def test_int8_finds_nearly_the_same(frontend, drawings):
    weights = frontend.weights
    if not weights.card.activation_ranges:
        pytest.skip("these weights are not calibrated for int8")
    whole = dataclasses.replace(SETTINGS, subpixel_radius=0, corner_radius=0)
    exact, rounded = (
        NetworkFrontend(weights, dataclasses.replace(whole, precision=precision)) for precision in ("float32", "int8")
    )
    for picture in drawings[:2]:
        float32, int8 = exact(picture), rounded(picture)
        rows, columns = np.nonzero((int8.keypoints[:, None] == float32.keypoints).all(axis=2))
        narrow = loses_large_products()  # processors without VNNI: weights are rounded to half as many values
        assert len(rows) > (0.8 if narrow else 0.85) * len(float32)
        cosine = (int8.descriptors[rows] * float32.descriptors[columns]).sum(axis=1)
        assert np.median(cosine) > (0.997 if narrow else 0.999)
