"""The jackknife over picture and points: noise, something carried, and a scale that nothing determines."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from simulated_features import CAMERA, hand_motion, room

from improvo.geometry import se3
from improvo.odometry.settings import VerdictSettings
from improvo.odometry.verdict.evidence import PARTS, EvidenceCheck, Spread
from improvo.odometry.verdict.path_error import error_percent
from improvo.odometry.verdict.verdict import DOUBTFUL, RIGHT, estimated_error, judge
from improvo.odometry.view import View
from improvo.types import Float64

KEYFRAMES = 30
TRUTH = se3.inverse(hand_motion(KEYFRAMES, step=0.08, turn_deg=0.8))


def spread_of(
    cam_from_world: Float64,
    xyz: Float64,
    noise: float = 0.3,
    kept: int = 250,
    seen: np.ndarray | None = None,
    shift: Float64 | None = None,
    swaying: float = 0.0,
) -> Spread:
    """The spread of a path over points that are where the map says, seen with noise.

    Args:
        seen: (N, P) whether a point may be seen by a keyframe; None: all.
        shift: (N, 2) pixels that what lies in the upper left quarter is off by.
        swaying: pixels (standard deviation) that everything within a block of 40 x 40 pixels is off by together.
    """
    check = EvidenceCheck(CAMERA)
    rng = np.random.default_rng(0)
    for i, pose in enumerate(cam_from_world):
        in_camera = se3.transform(pose, xyz)
        pixels = CAMERA.project(in_camera)
        inside = (pixels > 0).all(axis=1) & (pixels < (CAMERA.width, CAMERA.height)).all(axis=1)
        rows = np.flatnonzero((in_camera[:, 2] > 0.1) & inside & (True if seen is None else seen[i]))[:kept]
        keypoints = pixels[rows] + rng.normal(scale=noise, size=(len(rows), 2))
        if shift is not None:
            keypoints[(keypoints < (CAMERA.width / 2, CAMERA.height / 2)).all(axis=1)] += shift[i]
        block = (keypoints // 40.0).astype(np.int64)
        keypoints += np.random.default_rng(i).normal(scale=swaying, size=(6, 8, 2))[block[:, 1] % 6, block[:, 0] % 8]
        count = len(rows)
        view = View(
            i,
            i / 30.0,
            keypoints,
            np.zeros((count, 1), np.float32),
            np.ones(count),
            np.arange(count),
            rows,
            keyframe=True,
        )
        check.add(view, pose, xyz)
    spread = check.finish(xyz)
    assert spread is not None
    return spread


def test_parts_of_good_evidence_agree() -> None:
    spread = spread_of(TRUTH, room().points)
    assert spread.error_percent.shape == (len(PARTS),)
    assert spread.error_percent.max() < 0.5
    assert np.abs(spread.scale_steps).max() < 0.03
    assert 0.25 < spread.noise_px < 0.35
    verdict = judge(spread, VerdictSettings())
    assert verdict.word == RIGHT
    assert verdict.error_percent < 2.0
    assert verdict.uncertain == ()


def test_more_noise_and_fewer_points_spread_the_paths() -> None:
    good, noisy, few = (spread_of(TRUTH, room().points, *each) for each in ((0.3, 250), (2.0, 250), (0.3, 25)))
    assert noisy.error_percent.mean() > 3.0 * good.error_percent.mean()
    assert few.error_percent.mean() > 2.0 * good.error_percent.mean()
    assert 1.7 < noisy.noise_px < 2.3


def test_a_quarter_of_the_picture_that_says_otherwise_spreads_the_paths_that_have_it() -> None:
    drift = np.linspace(0.0, 8.0, KEYFRAMES)[:, None] * (1.0, 0.0)
    right, spread = spread_of(TRUTH, room().points), spread_of(TRUTH, room().points, shift=drift)
    assert spread.error_percent.argmin() == 0  # without the upper left
    assert spread.error_percent[1:].min() > 2.0 * spread.error_percent[0]
    assert spread.error_percent.max() > 3.0 * right.error_percent.max()


def test_the_noise_of_keypoints_is_their_own_and_a_crowd_is_shared_by_neighbours() -> None:
    """Noise alone, however large, leaves the estimate; the same noise in blocks of the picture raises it."""
    own, shared = spread_of(TRUTH, room().points, noise=0.45), spread_of(TRUTH, room().points, noise=0.3, swaying=0.35)
    assert own.shared_px < 0.1
    assert 0.2 < shared.shared_px < 0.4
    assert shared.noise_px < 0.0016 * CAMERA.width  # not unusual by itself
    plain = estimated_error(replace(shared, shared_px=0.0))
    few_views = replace(shared, views_per_point=4.0)
    assert estimated_error(few_views) == pytest.approx(plain * (shared.shared_px / (0.0007 * CAMERA.width)) ** 3)
    assert estimated_error(shared) < estimated_error(few_views)  # each point is averaged over about 14 keyframes
    assert "parts of the picture are off by" in judge(shared, VerdictSettings()).evidence[0]


def test_views_of_a_point_are_counted_over_the_whole_segment() -> None:
    world = room().points
    once = np.zeros((KEYFRAMES, len(world)), bool)
    for i in range(KEYFRAMES):
        once[i, i // 3 :: KEYFRAMES // 3] = True  # each point by three keyframes in a row
    assert spread_of(TRUTH, world, seen=once).views_per_point == pytest.approx(3.0, rel=0.1)
    assert spread_of(TRUTH, world).views_per_point > 10.0


def two_scales(shared: int) -> tuple[Float64, Float64, np.ndarray]:
    """A map whose second half is half as large again; so many points are seen on both sides of the change.

    Returns:
        cam_from_world (N, 4, 4), points (P, 3), and which keyframe may see which (N, P).
    """
    cut = KEYFRAMES // 2
    centre = se3.inverse(TRUTH[cut])[:3, 3]
    first, second = room(1).points[:1500], room(2).points[:1500]
    cam_from_world = TRUTH.copy()
    centers = centre + 1.5 * (se3.inverse(TRUTH[cut:])[:, :3, 3] - centre)
    cam_from_world[cut:, :3, 3] = -np.einsum("nij,nj->ni", TRUTH[cut:, :3, :3], centers)
    both = se3.transform(
        se3.inverse(TRUTH[cut]), np.array([[0.3 * i - 0.6, 0.1 * i, 4.0] for i in range(shared)]).reshape(-1, 3)
    )
    xyz = np.concatenate([first, centre + 1.5 * (second - centre), both.reshape(-1, 3)])
    before = np.arange(KEYFRAMES)[:, None] < cut
    point = np.arange(len(xyz))[None]
    return cam_from_world, xyz, np.where(point < 1500, before, np.where(point < 3000, ~before, True))


def test_a_scale_that_few_points_carry_on_is_marked_and_not_smoothed_over() -> None:
    cam_from_world, xyz, seen = two_scales(shared=5)
    verdict = judge(spread_of(cam_from_world, xyz, seen=seen), VerdictSettings())
    assert len(verdict.uncertain) == 1
    first, last = verdict.uncertain[0]
    assert first < KEYFRAMES // 2 <= last
    assert verdict.error_percent > 4.0


def test_a_gap_that_no_point_bridges_makes_a_segment_doubtful_where_much_lies_on_both_sides() -> None:
    cam_from_world, xyz, seen = two_scales(shared=0)
    verdict = judge(spread_of(cam_from_world, xyz, seen=seen), VerdictSettings())
    cut = KEYFRAMES // 2
    assert verdict.word == DOUBTFUL
    assert any(f"nothing tells the scale between frames {cut - 1} and {cut}" in words for words in verdict.evidence)
    ((first, last),) = verdict.uncertain
    assert first < cut <= last
    # of 30 keyframes, the last one alone lies beyond the gap
    late = np.ones((KEYFRAMES, len(xyz)), bool)
    late[:-1, : len(xyz) // 2], late[-1, len(xyz) // 2 :] = False, False
    spread = spread_of(TRUTH, room().points, seen=late[:, : len(room().points)])
    assert judge(spread, VerdictSettings()).uncertain[-1][-1] == KEYFRAMES - 1
    assert estimated_error(spread) < verdict.error_percent / 3.0


def test_parts_that_disagree_about_the_scale_make_a_segment_doubtful() -> None:
    cam_from_world, xyz, seen = two_scales(shared=10)
    verdict = judge(spread_of(cam_from_world, xyz, noise=1.5, seen=seen), VerdictSettings())
    assert verdict.word == DOUBTFUL
    assert any("the scale" in words for words in verdict.evidence)


def test_three_keyframes_are_the_least_and_two_are_not_judged() -> None:
    xyz = room().points
    assert np.isfinite(spread_of(TRUTH[:3], xyz).error_percent).all()
    check = EvidenceCheck(CAMERA)
    assert check.finish(xyz) is None


def test_the_same_evidence_gives_the_same_bytes() -> None:
    a, b = (spread_of(TRUTH, room().points) for _ in range(2))
    assert a.error_percent.tobytes() == b.error_percent.tobytes()
    assert a.scale_steps.tobytes() == b.scale_steps.tobytes()


def test_a_path_that_is_another_only_in_place_and_scale_has_no_error() -> None:
    path = se3.inverse(TRUTH)[:, :3, 3]
    assert error_percent(3.0 * path + (1.0, 2.0, 3.0), path) < 1e-9
    bent = path + np.linspace(0.0, 1.0, KEYFRAMES)[:, None] ** 2 * (0.0, 1.0, 0.0)
    assert error_percent(bent, path) > 0.5


@pytest.mark.parametrize("where", [0.0, 3.0, 1e5])
def test_a_path_against_one_that_stands_still_has_no_small_error(where: float) -> None:
    """Sim3 shrinks any path onto one spot, where it is off by nothing: that is no agreement."""
    path = se3.inverse(TRUTH)[:, :3, 3]
    still = np.full_like(path, where) + 1e-16 * path
    assert error_percent(path, still) == error_percent(still, path) == error_percent(still, still) == np.inf
    spread = spread_of(np.broadcast_to(TRUTH[0], (4, 4, 4)), room().points)
    assert np.isinf(spread.error_percent).all()
    verdict = judge(spread, VerdictSettings())
    assert verdict.word == DOUBTFUL
    assert any("stays on one spot" in words for words in verdict.evidence)
    assert verdict.report()["error_percent"] is None
