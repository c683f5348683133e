"""The map of descriptors in closed form: what it does to them, and what it leaves alone."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from posed_room import posed_room

from improvo.errors import ConfigError, InputError
from improvo.frontend.network import NetworkFrontend
from improvo.frontend.settings import NetworkSettings
from improvo.frontend.weights_files import find_weights, load_weights
from improvo.tracking.matching import mutual_nearest_neighbours
from improvo.training.stages.descriptor_metric import MetricSettings, Scatter, found_again, with_descriptor_map
from improvo.types import Features

pytest.importorskip("torch")
from improvo.training.metric_training import train_metric

START = find_weights("superpoint-small")
FEW = MetricSettings(pairs=40, max_keypoints=200)


def _seen(places: np.ndarray, rng: np.random.Generator) -> Features:
    """Places (N, 16) as a camera sees them: eight numbers that stay, eight that change from frame to frame."""
    descriptors = places + np.r_[np.full(8, 0.05), np.full(8, 0.8)] * rng.standard_normal(places.shape)
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    keypoints = 20.0 * np.stack(np.unravel_index(np.arange(len(places)), (20, 10)), axis=1)
    return Features(keypoints.astype(np.float32), descriptors.astype(np.float32), np.ones(len(places), np.float32))


def _mapped(features: Features, matrix: np.ndarray) -> Features:
    descriptors = features.descriptors @ matrix
    descriptors = descriptors / np.linalg.norm(descriptors, axis=1, keepdims=True)
    return replace(features, descriptors=descriptors.astype(np.float32))


def _right(a: Features, b: Features) -> int:
    matches = mutual_nearest_neighbours(a, b)
    return int((matches[:, 0] == matches[:, 1]).sum())


def test_what_changes_between_frames_counts_less_after_the_map() -> None:
    rng = np.random.default_rng(0)
    scatter, same = Scatter(16), np.stack([np.arange(200)] * 2, axis=1)
    for _ in range(5):
        places = rng.standard_normal((200, 16))
        scatter.add(_seen(places, rng), _seen(places, rng), same, 8.0)
    assert scatter.count == 1000
    matrix = scatter.map(0.03)
    weight = np.linalg.norm(matrix, axis=0)
    assert weight[:8].min() > 2 * weight[8:].max()
    places = rng.standard_normal((200, 16))
    a, b = _seen(places, rng), _seen(places, rng)
    assert _right(_mapped(a, matrix), _mapped(b, matrix)) > 1.2 * _right(a, b)
    np.testing.assert_allclose(scatter.map(1.0), np.eye(16), atol=1e-9)


def test_too_few_correspondences_make_no_map() -> None:
    rng = np.random.default_rng(0)
    scatter, places = Scatter(16), rng.standard_normal((63, 16))
    features = _seen(np.resize(places, (200, 16)), rng)
    scatter.add(features, features, np.stack([np.arange(63)] * 2, axis=1), 8.0)
    with pytest.raises(InputError, match="63 keypoints were found again in another frame where 64 are needed"):
        scatter.map(0.03)


def test_keypoints_are_found_again_where_they_are_mutually_nearest_and_near() -> None:
    keypoints_b = np.array([[10, 10], [30, 10], [50, 10]], np.float32)
    places = np.array([[11, 10], [12, 10], [33, 10], [50, 12], [49, 10]], np.float64)
    shown = np.array([True, True, True, True, False])
    # the second is nearer to the first keypoint's place only, the third too far, the last one hidden
    assert found_again(keypoints_b, places, shown, 3.0).tolist() == [[0, 0], [3, 2]]
    assert found_again(keypoints_b, places, np.zeros(5, np.bool_), 3.0).shape == (0, 2)


def test_the_map_becomes_part_of_the_descriptor_head_and_of_nothing_else() -> None:
    rng = np.random.default_rng(1)
    weights = load_weights(START)
    matrix = np.eye(128) + 0.05 * rng.standard_normal((128, 128))
    mapped = with_descriptor_map(weights, matrix)
    changed = {name for name, values in weights.tensors.items() if not np.array_equal(values, mapped.tensors[name])}
    assert changed == {"descriptor.1.convolution.weight", "descriptor.1.convolution.bias"}
    picture = posed_room(1).pictures[0]
    before, after = (NetworkFrontend(each, NetworkSettings(precision="float32"))(picture) for each in (weights, mapped))
    np.testing.assert_array_equal(before.keypoints, after.keypoints)
    cosine = (_mapped(before, matrix.T).descriptors * after.descriptors).sum(axis=1)
    assert len(cosine) > 20
    assert cosine.min() > 0.995  # the cells that a keypoint lies between are mapped one by one


def test_a_room_maps_the_descriptors_and_keeps_all_else(tmp_path: Path) -> None:
    posed = [posed_room(6, 0), replace(posed_room(6, 1), weight=0.5)]
    first = train_metric(posed, FEW, tmp_path / "a", START)
    assert first["step"] == 40
    assert first["correspondences"] > 512
    train_metric(posed, FEW, tmp_path / "b", START)
    assert (tmp_path / "a/weights.safetensors").read_bytes() == (tmp_path / "b/weights.safetensors").read_bytes()
    control = train_metric(posed, replace(FEW, two_frames=False), tmp_path / "control", START)
    assert control["step"] == 24  # two views of every frame
    start, made, by_views = (
        load_weights(path)
        for path in (START, tmp_path / "a/weights.safetensors", tmp_path / "control/weights.safetensors")
    )
    for weights in (made, by_views):
        changed = {name for name, values in start.tensors.items() if not np.array_equal(values, weights.tensors[name])}
        assert changed == {"descriptor.1.convolution.weight", "descriptor.1.convolution.bias"}
        assert weights.card.activation_ranges == start.card.activation_ranges
        assert {source.name for source in weights.card.data} >= {"room-0", "room-1"}
        assert weights.card.training["metric"]["start"] == "superpoint-small.safetensors"
    assert not np.array_equal(*(w.tensors["descriptor.1.convolution.weight"] for w in (made, by_views)))
    with pytest.raises(ConfigError, match="pairs"):
        train_metric(posed, replace(FEW, pairs=41), tmp_path / "a", START)


def test_no_keypoint_of_a_masked_half_teaches(tmp_path: Path) -> None:
    room = posed_room(6, 0)
    mask = np.ones(room.pictures[0].shape, np.bool_)
    mask[:, 16:] = False
    masked = replace(room, masks=(mask,) * 6)
    whole = train_metric([room], replace(FEW, pairs=30), tmp_path / "whole", START)
    with pytest.raises(InputError, match="keypoints were found again"):
        train_metric([masked], replace(FEW, pairs=30), tmp_path / "masked", START)
    assert whole["correspondences"] > 512


def test_frames_that_share_nothing_are_one_clear_error(tmp_path: Path) -> None:
    room = posed_room(2, 0)
    unseen = replace(room, inverse_depth=tuple(np.zeros_like(values) for values in room.inverse_depth))
    with pytest.raises(InputError, match="0 keypoints were found again"):
        train_metric([unseen], FEW, tmp_path, START)


@pytest.mark.parametrize(
    "values", [{"shrinkage": 0.0}, {"shrinkage": 1.5}, {"pairs": 0}, {"max_keypoints": 10}, {"right_px": 0.0}]
)
def test_settings_out_of_range_are_refused(values: dict[str, float]) -> None:
    with pytest.raises(ConfigError, match=next(iter(values))):
        MetricSettings(**values)  # type: ignore[arg-type]
