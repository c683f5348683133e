"""Worlds that must not get a path, or not there: mirrored, standing, turning, empty; and that good ones still do."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from simulated_features import CAMERA, error_percent, hand_motion, nothing_to_see, observe, room

from improvo.geometry import se3
from improvo.odometry.settings import OdometrySettings
from improvo.odometry.visual_odometry import VisualOdometry
from improvo.types import Features, Float64

Spoil = Callable[[Features, int], Features]


def mirrored(features: Features, _: int) -> Features:
    """Left and right change places; the descriptors are so good that every match still is found."""
    pixels = features.keypoints * np.float32([-1, 1]) + np.float32([CAMERA.width - 1, 0])
    return Features(pixels, features.descriptors, features.scores)


def scattered(features: Features, number: int) -> Features:
    """Right descriptors at wrong places: one in forty keypoints stays where it belongs."""
    rng = np.random.default_rng(number)
    pixels = features.keypoints.copy()
    moved = rng.random(len(pixels)) > 0.025
    pixels[moved] = rng.uniform((0, 0), (CAMERA.width, CAMERA.height), (int(moved.sum()), 2))
    return Features(pixels, features.descriptors, features.scores)


def empty(_: Features, number: int) -> Features:
    """Keypoints of noise."""
    return nothing_to_see(number)


def tracked(path: Float64, spoil: Spoil | None = None, spoilt: range = range(0)) -> VisualOdometry:
    odometry, world = VisualOdometry(None, CAMERA, OdometrySettings()), room()  # type: ignore[arg-type]
    for number, pose in enumerate(path):
        features = observe(world, pose, seed=number)
        if spoil is not None and number in spoilt:
            features = spoil(features, number)
        odometry.track_features(features, number / 30)
    odometry.finish()
    return odometry


@pytest.mark.parametrize("spoil", [mirrored, scattered, empty])
def test_a_spoilt_stretch_gets_no_poses_and_the_rest_stays_right(spoil: Spoil) -> None:
    path = hand_motion(60, step=0.03)
    spoilt = range(30, 38)
    odometry = tracked(path, spoil, spoilt)
    has_pose = odometry.trajectory.valid
    assert not has_pose[30:38].any()
    assert has_pose[:30].all()
    assert has_pose[38:].all()
    for segment in odometry.segments:
        rows = np.flatnonzero(odometry.trajectory.segment == segment.number)
        assert error_percent(odometry.trajectory.camera_centers[rows], path[rows, :3, 3]) < 1.5


@pytest.mark.parametrize("turn_deg", [0.0, 0.5])
def test_a_camera_that_stands_or_only_turns_gets_no_path(turn_deg: float) -> None:
    turns = np.arange(50)[:, None] * np.radians([0.2, turn_deg, 0.1]) * (turn_deg > 0)
    odometry = tracked(se3.rigid(se3.so3_exp(turns), np.tile([0.0, 0.0, -1.0], (50, 1))))
    assert not odometry.trajectory.valid.any()
    assert {event.kind for event in odometry.events} == {"initialising"}


def test_a_stop_in_the_middle_of_a_walk_keeps_the_segment() -> None:
    walk = hand_motion(50, step=0.03)
    path = np.concatenate([walk[:25], np.repeat(walk[25:26], 30, axis=0), walk[25:]])
    odometry = tracked(path)
    assert len(odometry.segments) == 1
    assert odometry.trajectory.valid.all()
    assert error_percent(odometry.trajectory.camera_centers, path[:, :3, 3]) < 1.5
