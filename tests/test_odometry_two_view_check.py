"""The two-view check: silent on a right map, loud on a wrong one that fits its own tracks."""

from __future__ import annotations

import numpy as np
import pytest
from simulated_features import CAMERA, hand_motion, observe, room, views_of

from improvo.geometry import se3
from improvo.odometry.alarms.two_view_check import TwoViewCheck
from improvo.odometry.settings import OdometrySettings
from improvo.odometry.view import View
from improvo.tracking.matching import unit_descriptors
from improvo.types import Float64


def alarms(estimate: Float64, truth: Float64, tracked: bool = True) -> list[int]:
    """Positions at which the check speaks, for views of `truth` that the map believes to be at `estimate`.

    Args:
        estimate: (N, 4, 4) world_from_cam of the map.
        truth: (N, 4, 4) true world_from_cam.
        tracked: whether tracks lead from each view to every other; else no match is a track.
    """
    world = room()
    check = TwoViewCheck(CAMERA, OdometrySettings(), descriptor_distance=0.7)
    earlier: dict[int, View] = {}
    said = []
    for position, (believed, true) in enumerate(zip(estimate, truth, strict=True)):
        features = observe(world, true, seed=position)
        nothing = np.full(len(features), -1, np.int64)
        view = View(
            frame_index=position,
            time=position / 30.0,
            keypoints=features.keypoints.astype(np.float64),
            descriptors=unit_descriptors(features),
            weights=np.ones(len(features)),
            tracks=nothing if tracked else 1000 * position + np.arange(len(features)),
            points=nothing.copy(),
            cam_from_world=se3.inverse(believed),
        )
        if check.contradicts(view, earlier):
            said.append(position)
        earlier[position] = view
    return said


def test_a_right_map_is_never_contradicted() -> None:
    truth = hand_motion(60)
    assert alarms(truth, truth) == []


def test_scale_and_world_frame_are_free() -> None:
    truth = hand_motion(40)
    moved = se3.rigid(se3.so3_exp(np.array([0.4, -0.3, 1.0])), np.array([5.0, 2.0, -1.0])) @ truth
    moved[:, :3, 3] *= 3.0
    moved[:, :3, 3] -= 2.0 * moved[0, :3, 3]
    assert alarms(moved, truth) == []


def test_a_wrong_direction_of_motion_is_contradicted() -> None:
    truth = hand_motion(40, step=0.06)
    wrong = truth.copy()
    wrong[:, 1, 3] += 0.08 * np.arange(40)  # the map believes in a climb that was not there
    assert alarms(wrong, truth), "a map that climbs while the camera walks was believed"


def test_a_wrong_turn_is_contradicted() -> None:
    truth = hand_motion(40)
    extra = se3.rigid(se3.so3_exp(np.radians(1.5) * np.arange(40)[:, None] * [0.0, 0.0, 1.0]), np.zeros((40, 3)))
    assert alarms(truth @ extra, truth)


def test_a_fresh_pose_that_turned_far_otherwise_decides_only_with_tracks() -> None:
    """Repeated texture gives such poses, and tracks from frame to frame would have noticed the turn."""
    truth = hand_motion(40, step=0.06)
    turned = truth.copy()
    turned[:, :3, :3] = turned[:, :3, :3] @ se3.so3_exp(np.arange(40)[:, None] * np.array([0.0, 0.05, 0.0]))
    assert alarms(truth, turned, tracked=False) == []
    assert alarms(truth, turned)


@pytest.mark.parametrize("tracked", [False, True])
def test_tracks_decide_between_the_map_and_matches_of_repeated_texture(tracked: bool) -> None:
    """Most matches agree on another motion than the map does; it is believed only where tracks confirm them."""
    believed = hand_motion(40, step=0.06)
    other = believed.copy()
    other[:, 1, 3] += 0.08 * np.arange(40)
    right = views_of([observe(room(0), pose, seed=i, limit=100) for i, pose in enumerate(believed)])
    wrong = views_of([observe(room(1), pose, seed=i, limit=300) for i, pose in enumerate(other)])
    check = TwoViewCheck(CAMERA, OdometrySettings(), descriptor_distance=0.7)
    earlier: dict[int, View] = {}
    said = []
    for position, (a, b) in enumerate(zip(right, wrong, strict=True)):
        tracks = 10_000 + (b.tracks if tracked else 1000 * position + np.arange(len(b)))
        view = View(
            frame_index=position,
            time=position / 30.0,
            keypoints=np.concatenate([a.keypoints, b.keypoints]),
            descriptors=np.concatenate([a.descriptors, b.descriptors]),
            weights=np.ones(len(a) + len(b)),
            tracks=np.concatenate([a.tracks, tracks]),
            points=np.full(len(a) + len(b), -1, np.int64),
            cam_from_world=se3.inverse(believed[position]),
        )
        if check.contradicts(view, earlier):
            said.append(position)
        earlier[position] = view
    assert bool(said) == tracked
