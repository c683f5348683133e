"""The states of whole runs in worlds where two views do not tell all: one plane, turns, stops, mirrors, two scales."""

from __future__ import annotations

from itertools import groupby

import numpy as np
import pytest
from simulated_features import CAMERA, World, error_percent, hand_motion, observe, room, wall

from improvo.geometry import se3
from improvo.odometry.modes.states import TrackingState
from improvo.odometry.visual_odometry import VisualOdometry
from improvo.types import Features, Float64

INITIALISING, PROVISIONAL = TrackingState.INITIALISING, TrackingState.PROVISIONAL
TRACKING, LOST = TrackingState.TRACKING, TrackingState.LOST


def run(features: list[Features]) -> tuple[VisualOdometry, list[TrackingState]]:
    """The finished odometry, and the states that it went through."""
    states = []
    with VisualOdometry(None, CAMERA) as odometry:  # type: ignore[arg-type]
        for number, each in enumerate(features):
            states.append(odometry.track_features(each, number / 30).state)
    return odometry, [state for state, _ in groupby(states)]


def seen(path: Float64, world: World | None = None) -> list[Features]:
    return [observe(world or room(), pose, seed=number) for number, pose in enumerate(path)]


def turned_on_the_spot(pose: Float64, degrees: Float64) -> Float64:
    """The pose (4, 4), turned about its own upright axis by each of some angles (N,)."""
    turns = np.radians(degrees)[:, None] * np.array([0.0, 1.0, 0.0])
    return pose @ se3.rigid(se3.so3_exp(turns), np.zeros((len(turns), 3)))


def errors(odometry: VisualOdometry, path: Float64) -> dict[int, float]:
    """% of the path of each segment of at least 20 frames."""
    estimate, found = odometry.trajectory, {}
    for segment in odometry.segments:
        rows = np.flatnonzero(estimate.segment == segment.number)
        if len(rows) >= 20:
            found[segment.number] = error_percent(estimate.camera_centers[rows], path[rows, :3, 3])
    return found


def test_before_one_plane_a_run_waits_for_a_unique_motion_and_is_right() -> None:
    path = hand_motion(90, step=0.02, turn_deg=0.1)
    path[:, :3, 3] -= path[0, :3, 3]
    odometry, states = run(seen(path, wall()))
    assert states == [INITIALISING, PROVISIONAL, TRACKING] or states == [INITIALISING]
    assert all(error < 3.0 for error in errors(odometry, path).values())


def test_a_camera_that_stands_first_and_in_the_middle_is_never_lost() -> None:
    walk = hand_motion(70, step=0.03)
    path = np.concatenate([np.repeat(walk[:1], 15, axis=0), walk[:30], np.repeat(walk[30:31], 20, axis=0), walk[30:]])
    odometry, states = run(seen(path))
    assert states == [INITIALISING, PROVISIONAL, TRACKING]
    assert errors(odometry, path)[0] < 1.5


def test_a_turn_on_the_spot_and_back_keeps_the_map() -> None:
    walk = hand_motion(70, step=0.03)
    turn = turned_on_the_spot(walk[40], 15.0 * np.sin(np.linspace(0.0, np.pi, 30)))
    path = np.concatenate([walk[:40], turn, walk[40:]])
    odometry, states = run(seen(path))
    assert states == [INITIALISING, PROVISIONAL, TRACKING]
    assert errors(odometry, path)[0] < 1.5


def test_a_turn_away_from_the_map_loses_it_ends_it_and_starts_no_other() -> None:
    walk = hand_motion(40, step=0.03)
    turn = turned_on_the_spot(walk[-1], np.linspace(0.0, 120.0, 20))
    path = np.concatenate([walk, turn, np.repeat(turn[-1:], 20, axis=0)])
    odometry, states = run(seen(path))
    assert states == [INITIALISING, PROVISIONAL, LOST, INITIALISING]
    assert len(odometry.segments) == 1
    assert odometry.segments[0].reason == "lost"
    assert errors(odometry, path)[0] < 1.5


def test_mirrored_pictures_are_lost_and_the_map_is_found_again() -> None:
    path = hand_motion(60, step=0.03)
    features = seen(path)
    for number in range(30, 38):
        pixels = features[number].keypoints * np.float32([-1, 1]) + np.float32([CAMERA.width - 1, 0])
        features[number] = Features(pixels, features[number].descriptors, features[number].scores)
    odometry, states = run(features)
    assert states == [INITIALISING, PROVISIONAL, LOST, PROVISIONAL]
    assert errors(odometry, path)[0] < 1.5


@pytest.mark.parametrize("shared", [0, 8, 16, 30])
def test_two_halves_of_a_walk_whose_scale_few_points_tell_are_right_apart_or_marked(shared: int) -> None:
    """All but a few of the points change behind a door: a path over both halves is right, or it is said where not."""
    path = hand_motion(120, step=0.03)
    before, after = room(seed=1), room(seed=2)
    kept = World(before.points[-300:], before.descriptors[-300:])
    features = []
    for number, pose in enumerate(path):
        plain = observe(before if number < 60 else after, pose, seed=number)
        links = observe(kept, pose, seed=1000 + number, limit=shared)
        both = [
            np.concatenate(pair)
            for pair in zip(*((f.keypoints, f.descriptors, f.scores) for f in (plain, links)), strict=True)
        ]
        features.append(plain if not 55 <= number < 66 or not shared else Features(*both))
    odometry, _ = run(features)
    uncertain = [stretch for segment in odometry.segments for stretch in segment.verdict.uncertain]
    for segment in odometry.segments:
        error = errors(odometry, path).get(segment.number, 0.0)
        assert error < 5.0 or segment.verdict.word == "doubtful" or uncertain, (error, segment)
