"""Mutual nearest neighbours and connect-the-dots tracks (paper, "Point Tracks")."""

from __future__ import annotations

import numpy as np
import pytest

from improvo.tracking.connect import TrackChain
from improvo.tracking.matching import distance_threshold, mutual_nearest_neighbours, without_flow_outliers
from improvo.types import Features


def features(descriptors: np.ndarray) -> Features:
    count = len(descriptors)
    return Features(np.zeros((count, 2), np.float32), descriptors, np.ones(count, np.float32))


def unit(*rows: tuple[float, ...]) -> Features:
    vectors = np.array(rows, np.float32)
    return features(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


def by_definition(a: Features, b: Features) -> list[tuple[int, int]]:
    """The paper's sentence, spelled out."""
    distance = np.linalg.norm(a.descriptors[:, None] - b.descriptors[None], axis=2)
    return [
        (i, int(distance[i].argmin())) for i in range(len(a)) if int(distance[:, distance[i].argmin()].argmin()) == i
    ]


def test_matches_are_the_nearest_of_each_other() -> None:
    rng = np.random.default_rng(0)
    a, b = (unit(*rng.normal(size=(n, 16))) for n in (60, 45))
    assert [tuple(pair) for pair in mutual_nearest_neighbours(a, b).tolist()] == by_definition(a, b)


def test_threshold_is_a_distance_of_unit_descriptors() -> None:
    a = unit((1, 0), (0, 1))
    angle = 2 * np.arcsin(0.35)  # chord 0.7
    near, far = ((np.cos(x), np.sin(x)) for x in (angle - 0.01, angle + 0.01))
    assert len(mutual_nearest_neighbours(a, unit(near), 0.7)) == 1
    assert len(mutual_nearest_neighbours(a, unit(far), 0.7)) == 0
    assert len(mutual_nearest_neighbours(a, unit(far))) == 1


@pytest.mark.parametrize(("differing_bits", "matched"), [(63, True), (64, False)])
def test_binary_threshold_is_the_same_share_of_the_distance_of_unrelated_ones(
    differing_bits: int, matched: bool
) -> None:
    a = np.zeros((1, 32), np.uint8)
    b = np.packbits(np.arange(256) < differing_bits)[None]
    assert (len(mutual_nearest_neighbours(features(a), features(b), 0.7)) == 1) == matched
    assert distance_threshold(features(a), 0.7) ** 2 == pytest.approx(4 * 0.7 / np.sqrt(2) / 2)


def test_nothing_matches_nothing() -> None:
    empty = features(np.zeros((0, 8), np.float32))
    assert mutual_nearest_neighbours(empty, unit((1, 0, 0, 0, 0, 0, 0, 0)), 0.7).shape == (0, 2)
    assert mutual_nearest_neighbours(empty, empty).shape == (0, 2)


def test_tracks_go_on_through_matches_and_begin_where_there_is_none() -> None:
    chain = TrackChain()
    first = chain.start(3)
    second = chain.extend(first, np.array([[0, 1], [2, 0]]), 3)
    third = chain.extend(second, np.array([[1, 0]]), 2)
    assert first.tolist() == [0, 1, 2]
    assert second.tolist() == [2, 0, 3]
    assert third.tolist() == [0, 4]


def test_a_track_that_missed_a_frame_does_not_come_back() -> None:
    chain = TrackChain()
    first = chain.start(1)
    second = chain.extend(first, np.zeros((0, 2), np.int64), 0)
    assert chain.extend(second, np.zeros((0, 2), np.int64), 1).tolist() == [1]


def test_links_far_from_what_all_others_do_are_dropped() -> None:
    rng = np.random.default_rng(1)
    a = rng.uniform(0, 320, (50, 2)).astype(np.float32)
    b = a + np.float32([40, -3]) + rng.uniform(-5, 5, (50, 2)).astype(np.float32)  # the camera turns fast
    b[[4, 17]] += np.float32([60, 0])
    matches = np.stack([np.arange(50), rng.permutation(50)], axis=1)
    shuffled = np.empty_like(b)
    shuffled[matches[:, 1]] = b
    kept = without_flow_outliers(matches, a, shuffled, limit=32.0)
    assert sorted(set(range(50)) - set(kept[:, 0].tolist())) == [4, 17]
    assert len(without_flow_outliers(matches[:0], a, shuffled, limit=32.0)) == 0
