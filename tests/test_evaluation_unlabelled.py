"""Matches that survive without ground truth: what is right is counted, what is chance is not."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from rendered_walk import write_walk
from simulated_features import CAMERA, hand_motion, nothing_to_see, observe, room

from improvo.errors import ConfigError
from improvo.evaluation.pose.unlabelled import agreeing_matches, spread_pairs, surviving_matches, usable_gaps
from improvo.evaluation.settings import SurvivalSettings
from improvo.frontend.registry import load_frontend
from improvo.sequences import open_sequence
from improvo.types import Features

SETTINGS = SurvivalSettings()


def views(frames: int = 40) -> list[Features]:
    world = room()
    return [observe(world, pose, seed) for seed, pose in enumerate(hand_motion(frames))]


def test_right_matches_survive_and_wrong_ones_do_not() -> None:
    a, b = views()[0], views()[20]
    matches, agreeing = agreeing_matches(a, b, CAMERA, SETTINGS)
    assert matches > 150
    shared = agreeing
    # half of the descriptors of B change places: their matches are wrong from then on
    order = np.arange(len(b))
    order[::2] = np.roll(order[::2], 1)
    mixed = Features(b.keypoints, b.descriptors[order], b.scores)
    _, agreeing = agreeing_matches(a, mixed, CAMERA, SETTINGS)
    assert 0.4 * shared < agreeing < 0.6 * shared


def test_chance_counts_as_none() -> None:
    for seed in range(5):
        matches, agreeing = agreeing_matches(nothing_to_see(seed), nothing_to_see(seed + 10), CAMERA, SETTINGS)
        assert matches > 30
        assert agreeing == 0
    few = nothing_to_see(0).take(np.arange(3))
    assert agreeing_matches(few, few, CAMERA, SETTINGS) == (3, 0)


def test_gaps_fit_the_recording_or_give_way() -> None:
    assert usable_gaps([200, 20], SETTINGS) == (30, 60, 90)
    assert usable_gaps([75], SETTINGS) == (30, 60)
    assert usable_gaps([28], SETTINGS) == (7, 14, 21)
    assert usable_gaps([], SETTINGS) == ()


@pytest.mark.parametrize(("frames", "gap", "count", "expected"), [(100, 30, 50, 50), (45, 30, 50, 15), (20, 30, 50, 0)])
def test_pairs_are_spread_over_the_recording(frames: int, gap: int, count: int, expected: int) -> None:
    pairs = spread_pairs(frames, gap, count)
    assert len(pairs) == len(set(pairs[:, 0])) == expected
    assert (pairs[:, 1] - pairs[:, 0] == gap).all()
    if expected:
        assert pairs[0, 0] == 0
        assert pairs[-1, 1] == frames - 1


def test_a_recording_is_counted_pair_by_pair(tmp_path: Path) -> None:
    walk = write_walk(tmp_path / "walk", frames=14)
    cv2.imwrite(str(walk / "000003.png"), np.zeros((240, 320), np.uint8))
    (walk / "000005.png").write_bytes(b"no picture")
    ticks: list[None] = []
    sequence = open_sequence(walk)
    first, second = surviving_matches(
        sequence, load_frontend("orb", 300, opencv_defaults=True), (4, 8), SETTINGS, lambda: ticks.append(None)
    )
    assert (first.gap, second.gap) == (4, 8)
    assert len(ticks) == len(first.pairs) + len(second.pairs)
    assert 5 not in first.pairs  # cannot be read
    assert len(first.pairs) == 8
    dark = (first.pairs == 3).any(axis=1)
    assert dark.sum() == 1
    assert (first.agreeing[dark] == 0).all()
    assert (first.agreeing[~dark] > 50).all()
    assert (first.agreeing <= first.matches).all()
    assert (first.matches <= first.keypoints).all()
    assert first.agreeing[~dark].mean() > second.agreeing[(second.pairs != 3).all(axis=1)].mean()


def test_impossible_settings_are_refused() -> None:
    for wrong in ({"gaps": (0,)}, {"gaps": (3, 3)}, {"pairs": 0}, {"max_epipolar_error": 0.0}):
        with pytest.raises(ConfigError):
            SurvivalSettings(**wrong)
