"""Matches and poses against a fixed run of the odometry, on a scene whose depth is exact."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from evaluation_scene import CAMERA, PlaneFeatures, PlaneSequence
from improvo.errors import ConfigError, InputError
from improvo.evaluation.pose.pairs import overlapping
from improvo.evaluation.pose.self_truth import (
    FixedRun,
    PairScores,
    SelfTruthSettings,
    choose_pairs,
    compare,
    compare_gaps,
    score_pairs,
)
from improvo.types import Float32

SETTINGS = SelfTruthSettings(pairs=12, resamples=300, shuffles=3)
SCALE = 0.37  # a run has its own unit


def fixed_run(frames: int = 20, half: bool = False) -> FixedRun:
    """The true poses and depth, in the unit of some run; depth of the left edge is unknown."""
    scene = PlaneSequence(frames)
    poses = scene.poses.copy()
    poses[:, :3, 3] *= SCALE

    def depth(frame: int) -> Float32:
        exact = scene.depth(frame)
        assert exact is not None
        found = SCALE * exact
        found[:, :10] = 0.0
        if half:  # a pixel of the map covers four of the image
            inverse = 1 / found[:, 10:].reshape(CAMERA.height // 2, 2, -1, 2)
            found = np.zeros((CAMERA.height // 2, CAMERA.width // 2), np.float32)
            found[:, 5:] = 1 / inverse.mean(axis=(1, 3))
        return found.astype(np.float32)

    segment = np.zeros(frames, np.int64)
    return FixedRun(CAMERA, poses, segment, np.ones(frames, np.bool_), depth)


def scores(run: FixedRun, gap: int = 5, settings: SelfTruthSettings = SETTINGS, **frontend: Any) -> PairScores:
    scene, source = PlaneSequence(len(run.segment)), PlaneFeatures(**frontend)
    pairs = choose_pairs(run, gap, settings.pairs)
    return score_pairs(run, lambda frame: source.features(scene, scene[frame]), pairs, settings)


@pytest.mark.parametrize("half", [False, True])
def test_a_perfect_frontend_is_right_and_a_shuffled_or_blind_one_is_not(half: bool) -> None:
    run = fixed_run(half=half)
    perfect = scores(run).means()
    assert perfect == {
        "right_3px": 1.0,
        "right_8px": 1.0,
        "rotation_opencv": 1.0,
        "translation_opencv": 1.0,
        "rotation_poselib": 1.0,
        "translation_poselib": 1.0,
    }
    shuffled = scores(run, shuffled=True).means()
    assert shuffled["right_8px"] < 0.1
    assert shuffled["translation_poselib"] == 0.0
    assert set(scores(run, blind=True).means().values()) == {0.0}


def test_the_share_of_right_matches_orders_frontends_by_their_noise() -> None:
    run = fixed_run()
    levels = [scores(run, noise=noise).means() for noise in (0.5, 2.0, 5.0)]
    for name in ("right_3px", "right_8px"):
        in_order = [level[name] for level in levels]
        assert in_order == sorted(in_order, reverse=True)
    assert levels[1]["right_8px"] > levels[1]["right_3px"]


def test_differences_are_taken_pair_by_pair() -> None:
    run = fixed_run()
    good, bad = scores(run, noise=1.0), scores(run, noise=4.0)
    same = compare(good, good, SETTINGS)
    assert all(row["difference"] == 0.0 and row["interval"] == [0.0, 0.0] for row in same.values())
    worse = compare(good, bad, SETTINGS)
    for name in ("right_3px", "right_8px"):
        assert worse[name]["interval"][0] <= worse[name]["difference"] <= worse[name]["interval"][1] < 0
        assert worse[name]["second"] - worse[name]["first"] == pytest.approx(worse[name]["difference"])
    wide = [scores(run, gap=8, noise=noise) for noise in (1.0, 4.0)]
    both = compare_gaps([good, wide[0]], [bad, wide[1]], SETTINGS)
    mean = np.mean([compare(*pair, SETTINGS)["right_3px"]["difference"] for pair in ((good, bad), tuple(wide))])
    assert both["right_3px"]["difference"] == pytest.approx(mean)
    with pytest.raises(InputError, match="same pairs"):
        compare(good, wide[1], SETTINGS)


def test_pairs_stay_within_a_segment_and_start_at_depth() -> None:
    run = fixed_run()
    segment = np.repeat([0, 1], 10)
    poses = run.world_from_cam.copy()
    poses[3] = np.nan
    has_depth = np.arange(20) % 2 == 0
    damaged = replace(run, segment=segment, world_from_cam=poses, has_depth=has_depth)
    pairs = choose_pairs(damaged, 3, 100)
    assert pairs[:, 0].tolist() == [2, 4, 6, 10, 12, 14, 16]
    assert (pairs[:, 1] - pairs[:, 0] == 3).all()
    assert len(choose_pairs(run, 3, 5)) == 5
    assert choose_pairs(run, 30, 5).shape == (0, 2)
    with pytest.raises(InputError, match="no pair"):
        scores(run, gap=30)


def test_unknown_depth_counts_for_nobody_and_few_matches_for_none_right() -> None:
    run = fixed_run()
    whole = scores(run)
    nothing = replace(run, depth=lambda frame: np.zeros((CAMERA.height, CAMERA.width), np.float32))
    assert set(scores(nothing).means().values()) == {0.0}
    assert scores(nothing).matches.tolist() == [0] * len(whole.matches)
    many = replace(SETTINGS, min_matches=10_000)
    assert scores(run, settings=many).means()["right_8px"] == 0.0
    with pytest.raises(ConfigError):
        SelfTruthSettings(shuffles=0)


@pytest.mark.parametrize(
    ("count", "gap", "spacing", "together"),
    [(100, 30, 10, 3), (100, 30, 1, 13), (100, 5, 10, 1), (6, 30, 1, 1), (1, 30, 1, 1), (0, 30, 1, 1)],
)
def test_pairs_that_look_at_the_same_frames_are_drawn_together(
    count: int, gap: int, spacing: int, together: int
) -> None:
    first = spacing * np.arange(count)
    assert overlapping(np.stack([first, first + gap], axis=1)) == together
