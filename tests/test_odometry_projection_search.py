"""Search by projection against an oracle that tries every pair."""

from __future__ import annotations

import numpy as np
import pytest

from improvo.odometry.mapping.projection_search import match_by_projection
from improvo.types import Float32, Float64


def unit(rng: np.random.Generator, count: int) -> Float32:
    vectors = rng.normal(size=(count, 8))
    return (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).astype(np.float32)


def every_pair(
    projections: Float64, of_points: Float32, keypoints: Float64, of_keypoints: Float32, radius: float, limit: float
) -> set[tuple[int, int]]:
    """Each point takes its most similar keypoint within the radius; a keypoint keeps the most similar of its points."""
    chosen: dict[int, tuple[float, int]] = {}
    for p in range(len(projections)):
        near = np.flatnonzero(((keypoints - projections[p]) ** 2).sum(axis=1) <= radius**2)
        if len(near) == 0:
            continue
        similarity = of_keypoints[near].astype(np.float64) @ of_points[p].astype(np.float64)
        best = int(near[np.argmax(similarity)])
        value = float(similarity.max())
        if 2.0 - 2.0 * value <= limit**2 and value > chosen.get(best, (-2.0, -1))[0]:
            chosen[best] = (value, p)
    return {(p, keypoint) for keypoint, (_, p) in chosen.items()}


@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize("radius", [0.5, 4.0, 30.0, 1000.0])
def test_it_finds_what_trying_every_pair_finds(seed: int, radius: float) -> None:
    rng = np.random.default_rng(seed)
    projections = rng.uniform(0.0, 100.0, (60, 2))
    keypoints = np.concatenate([projections[:40] + rng.normal(scale=2.0, size=(40, 2)), rng.uniform(0, 100, (30, 2))])
    of_points, of_keypoints = unit(rng, 60), unit(rng, 70)
    of_keypoints[:40] = of_points[:40] + 0.2 * of_keypoints[:40]
    of_keypoints /= np.linalg.norm(of_keypoints, axis=1, keepdims=True)
    found = match_by_projection(projections, of_points, keypoints, of_keypoints, radius, 1.0)
    expected = every_pair(projections, of_points, keypoints, of_keypoints, radius, 1.0)
    assert {(int(p), int(k)) for p, k in found} == expected


def test_two_points_never_share_a_keypoint() -> None:
    rng = np.random.default_rng(0)
    descriptors = np.repeat(unit(rng, 1), 5, axis=0)
    spot = np.full((5, 2), 10.0)
    found = match_by_projection(spot, descriptors, spot[:2], descriptors[:2], radius=3.0, max_distance=0.7)
    assert len(found) == 1


def test_projections_beyond_all_keypoints_find_nothing() -> None:
    descriptors = unit(np.random.default_rng(0), 1)
    for x, y in ((-500.0, 10.0), (500.0, 10.0), (10.0, -500.0), (10.0, 500.0)):
        found = match_by_projection(
            np.array([[x, y]]), descriptors, np.array([[10.0, 10.0]]), descriptors, radius=5.0, max_distance=0.7
        )
        assert len(found) == 0


def test_nothing_to_search_for_and_nowhere_to_search() -> None:
    descriptors = unit(np.random.default_rng(0), 2)
    spots, none = np.full((2, 2), 5.0), np.zeros((0, 2))
    assert match_by_projection(none, descriptors[:0], spots, descriptors, 5.0, 0.7).shape == (0, 2)
    assert match_by_projection(spots, descriptors, none, descriptors[:0], 5.0, 0.7).shape == (0, 2)
