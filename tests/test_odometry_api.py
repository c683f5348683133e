"""`VisualOdometry` as a program uses it: a context manager, read-only frames, results at any time."""

from __future__ import annotations

from dataclasses import FrozenInstanceError
from pathlib import Path

import numpy as np
import pytest
from rendered_walk import write_walk
from simulated_features import CAMERA, hand_motion, observe, room

from improvo.frontend.registry import load_frontend
from improvo.odometry.modes.states import TrackingState
from improvo.odometry.settings import OdometrySettings
from improvo.odometry.visual_odometry import VisualOdometry
from improvo.sequences import open_sequence
from improvo.types import Features


def _no_frontend(image: object) -> Features:
    raise AssertionError("the tests hand over features")


@pytest.fixture(scope="module")
def seen() -> list[Features]:
    world = room()
    return [observe(world, pose, seed=i) for i, pose in enumerate(hand_motion(70, step=0.03))]


def test_the_first_example_of_the_readme(tmp_path: Path) -> None:
    sequence = open_sequence(write_walk(tmp_path / "walk", frames=20))
    with VisualOdometry(load_frontend("orb"), sequence.camera) as odometry:
        for frame in sequence:
            tracked = odometry.track(frame)
        assert len(odometry.map) > 50, "the map can be looked at before the end"
    assert tracked.frame_index == 19
    assert odometry.trajectory.camera_centers.shape == (20, 3)
    assert odometry.trajectory.valid.all()
    assert len(odometry.map.xyz) > 50


@pytest.mark.parametrize("mode", ["robust", "paper"])
def test_results_hold_every_frame_at_any_time(seen: list[Features], mode: str) -> None:
    odometry = VisualOdometry(_no_frontend, CAMERA, OdometrySettings(mode=mode))
    assert len(odometry.trajectory) == 0
    assert odometry.pose is None
    assert odometry.state is TrackingState.INITIALISING
    for i, features in enumerate(seen):
        odometry.track_features(features, i / 30.0)
        if i in (3, 40, 69):
            assert len(odometry.trajectory) == i + 1
    before, map_before = odometry.trajectory, odometry.map
    odometry.finish()
    np.testing.assert_array_equal(before.world_from_cam, odometry.trajectory.world_from_cam)
    np.testing.assert_array_equal(map_before.xyz, odometry.map.xyz)
    np.testing.assert_array_equal(map_before.mean_error, odometry.map.mean_error)


def test_looking_changes_nothing(seen: list[Features]) -> None:
    results = []
    for look in (False, True):
        with VisualOdometry(_no_frontend, CAMERA) as odometry:
            for i, features in enumerate(seen[:60]):
                odometry.track_features(features, i / 30.0)
                if look:
                    _ = odometry.trajectory, odometry.map, odometry.pose
        results.append((odometry.trajectory.world_from_cam.tobytes(), odometry.map.xyz.tobytes()))
    assert results[0] == results[1]


def test_a_tracked_frame_cannot_be_written_to(seen: list[Features]) -> None:
    odometry = VisualOdometry(_no_frontend, CAMERA)
    frames = [odometry.track_features(features, i / 30.0) for i, features in enumerate(seen[:40])]
    last = frames[-1]
    assert last.cam_from_world is not None
    with pytest.raises(FrozenInstanceError):
        last.segment = 7  # type: ignore[misc]
    with pytest.raises(ValueError, match="read-only"):
        last.cam_from_world[0, 0] = 2.0
    np.testing.assert_array_equal(odometry.pose, last.cam_from_world)


def test_after_the_end_more_frames_are_refused(seen: list[Features]) -> None:
    with VisualOdometry(_no_frontend, CAMERA) as odometry:
        for i, features in enumerate(seen[:30]):
            odometry.track_features(features, i / 30.0)
    odometry.finish()  # again; does nothing
    assert len(odometry.segments) == 1
    with pytest.raises(RuntimeError, match="finished"):
        odometry.track_features(seen[30], 1.0)


def test_an_error_within_the_block_leaves_what_was_tracked(seen: list[Features]) -> None:
    odometry = VisualOdometry(_no_frontend, CAMERA)

    def fail() -> None:
        with odometry:
            for i, features in enumerate(seen[:40]):
                odometry.track_features(features, i / 30.0)
            raise ValueError("the camera was unplugged")

    with pytest.raises(ValueError, match="unplugged"):
        fail()
    assert odometry.trajectory.valid.all()
    assert len(odometry.map) > 100
