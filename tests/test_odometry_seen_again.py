"""A leap to a place that only looks the same: nothing but what keyframes should see again tells of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from simulated_features import CAMERA, hand_motion, room

from improvo.geometry import se3
from improvo.odometry.settings import VerdictSettings
from improvo.odometry.verdict.evidence import EvidenceCheck, Spread
from improvo.odometry.verdict.evidence_window import EvidenceKeyframe
from improvo.odometry.verdict.path_error import scale_leverage
from improvo.odometry.verdict.seen_again import SeenAgain, leaps, seen_again
from improvo.odometry.verdict.verdict import DOUBTFUL, RIGHT, Verdict, judge
from improvo.odometry.view import View
from improvo.types import Float64

KEYFRAMES = 30
TRUTH = se3.inverse(hand_motion(KEYFRAMES, step=0.08, turn_deg=0.8))
ALIKE = 40  # points that a wrong place shares with the right one
SEEN = 250  # points of a keyframe, at most


def observed(pose: Float64, xyz: Float64, seed: int) -> tuple[np.ndarray, Float64]:
    """Rows of points (P, 3) in the picture of a camera, and where they are seen, with noise."""
    in_camera = se3.transform(pose, xyz)
    pixels = CAMERA.project(in_camera)
    inside = (pixels > 0).all(axis=1) & (pixels < (CAMERA.width, CAMERA.height)).all(axis=1)
    rows = np.flatnonzero((in_camera[:, 2] > 0.1) & inside)[:SEEN]
    return rows, pixels[rows] + np.random.default_rng(seed).normal(scale=0.3, size=(len(rows), 2))


def map_with_a_leap(cut: int, aside: float = 0.5) -> tuple[Float64, Float64, list[np.ndarray], list[Float64]]:
    """The camera looks at what repeats; from `cut` on, the map has it one repetition aside.

    Returns:
        cam_from_world (N, 4, 4) of the map, its points (P, 3), and by keyframe the points that it observes and where.
        Points before and after the leap are others, but for `ALIKE` that were taken for each other.
    """
    world = room().points
    cam_from_world = TRUTH.copy()
    cam_from_world[cut:, :3, 3] -= np.einsum("nij,j->ni", TRUTH[cut:, :3, :3], (aside, 0.0, 0.0))
    rows_before, _ = observed(TRUTH[max(cut - 1, 0)], world, 0)
    alike = rows_before[:ALIKE]
    points, pixels = [], []
    for i, pose in enumerate(TRUTH):
        rows, seen = observed(pose, world, i)
        points.append(rows if i < cut else rows + len(world))  # taken for what lies one repetition aside
        pixels.append(seen)
    xyz = np.concatenate([world, world + np.array([aside, 0.0, 0.0])])
    for i in range(cut, min(cut + 2, KEYFRAMES)):  # repeated texture: some points of before fit the wrong pose
        in_camera = se3.transform(cam_from_world[i], world[alike])
        points[i] = np.concatenate([points[i], alike])
        pixels[i] = np.concatenate([pixels[i], CAMERA.project(in_camera)])
    return cam_from_world, xyz, points, pixels


def judged(
    cam_from_world: Float64, xyz: Float64, points: list[np.ndarray], pixels: list[Float64]
) -> tuple[Spread, Verdict]:
    check = EvidenceCheck(CAMERA)
    for i, (pose, ids, seen) in enumerate(zip(cam_from_world, points, pixels, strict=True)):
        count = len(ids)
        descriptors = np.zeros((count, 1), np.float32)
        view = View(i, i / 30.0, seen, descriptors, np.ones(count), np.arange(count), ids, keyframe=True)
        check.add(view, pose, xyz)
    spread = check.finish(xyz)
    assert spread is not None
    return spread, judge(spread, VerdictSettings())


def test_a_leap_is_found_by_what_should_be_seen_again_and_makes_a_segment_doubtful() -> None:
    cut = KEYFRAMES // 2
    spread, verdict = judged(*map_with_a_leap(cut))
    assert [gap.frames for gap in spread.leaps] == [(cut - 1, cut)]
    assert spread.leaps[0].share < 0.3
    assert verdict.word == DOUBTFUL
    assert verdict.uncertain == ((cut - 1, cut),)
    assert any("may only look like the one before" in words for words in verdict.evidence)


def test_without_a_leap_most_is_seen_again() -> None:
    spread, verdict = judged(*map_with_a_leap(KEYFRAMES))
    assert spread.leaps == ()
    assert verdict.word == RIGHT
    keyframes = [EvidenceKeyframe(i, TRUTH[i], *_of(i), np.ones(SEEN)) for i in (3, 4)]
    gap = seen_again(keyframes[0], keyframes[1], room().points, CAMERA)
    assert gap.frames == (3, 4)
    assert gap.share > 0.8
    assert 0.5 < gap.parallax_deg < 3.0


def _of(i: int) -> tuple[Float64, np.ndarray]:
    rows, pixels = observed(TRUTH[i], room().points, i)
    return pixels, rows


def test_what_is_not_seen_again_at_the_very_end_moves_too_little_of_the_path_for_a_doubt() -> None:
    spread, verdict = judged(*map_with_a_leap(KEYFRAMES - 1, aside=0.0))
    assert [gap.frames for gap in spread.leaps] == [(KEYFRAMES - 2, KEYFRAMES - 1)]
    assert verdict.word == RIGHT
    assert verdict.uncertain == ((KEYFRAMES - 2, KEYFRAMES - 1),)


def test_a_single_keyframe_that_sees_little_is_no_leap() -> None:
    """Blurred, or in a flash: what was seen before is seen again after it."""
    cam_from_world, xyz, points, pixels = map_with_a_leap(KEYFRAMES)
    points[12], pixels[12] = points[12][:20], pixels[12][:20]
    spread, _ = judged(cam_from_world, xyz, points, pixels)
    assert spread.leaps == ()


def test_where_a_frontend_begins_to_find_three_times_as_many_keypoints_is_no_leap() -> None:
    """A logo that took most of the keypoints is known now: what few there were before are seen again."""
    cam_from_world, xyz, points, pixels = map_with_a_leap(KEYFRAMES)
    for i in range(12):
        few = points[i] % 3 == 0
        points[i], pixels[i] = points[i][few], pixels[i][few]
    spread, _ = judged(cam_from_world, xyz, points, pixels)
    assert spread.leaps == ()


def test_a_gap_is_compared_with_what_is_usual_and_a_few_gaps_tell_nothing() -> None:
    noisy = [SeenAgain((i, i + 1), 100, 40) for i in range(10)]
    assert leaps([*noisy, SeenAgain((10, 11), 100, 20)]) == ()
    found = SeenAgain((10, 11), 100, 12)
    assert leaps([*noisy, found]) == (found,)
    assert leaps([*noisy, SeenAgain((10, 11), 10, 0)]) == ()  # hardly anything was expected
    assert leaps([*noisy[:4], found]) == ()
    photographs = [replace(gap, parallax_deg=11.0) for gap in (*noisy, found)]
    assert leaps(photographs) == ()


@pytest.mark.parametrize("place", [10, 50, 80])
def test_a_change_of_scale_along_a_line_does_what_a_fitted_line_leaves(place: int) -> None:
    """What is left of a hinge at the share p of a line, after the best line, is the root of (p (1 - p))^3 / 3."""
    line = np.linspace(0.0, 1.0, 101)[:, None] * (2.0, 1.0, 0.0)
    p = place / 100.0
    assert scale_leverage(line, [(place, place)])[0] == pytest.approx(
        100.0 * np.sqrt((p * (1 - p)) ** 3 / 3.0), rel=0.06
    )


def test_a_change_of_scale_at_the_ends_or_of_a_path_that_stands_still_does_nothing() -> None:
    path = se3.inverse(TRUTH)[:, :3, 3]
    assert scale_leverage(path, [(0, 0), (KEYFRAMES - 1, KEYFRAMES - 1)]) == pytest.approx([0.0, 0.0], abs=1e-6)
    assert scale_leverage(np.zeros((5, 3)), [(2, 2)]).tolist() == [0.0]
    assert scale_leverage(path, []).shape == (0,)
    long = np.repeat(path, 40, axis=0)  # of a long path only some places are looked at
    assert scale_leverage(long, [(600, 600)]) == pytest.approx(scale_leverage(path, [(15, 15)]), rel=0.1)
    assert scale_leverage(path, [(3, 20)]) == max(scale_leverage(path, [(i, i)]) for i in range(3, 21))
