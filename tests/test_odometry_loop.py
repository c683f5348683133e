"""The odometry on simulated features: what it recovers, and that it says so when it cannot."""

from __future__ import annotations

import gc
import weakref

import numpy as np
import pytest
from simulated_features import CAMERA, error_percent, hand_motion, nothing_to_see, observe, room

from improvo.geometry import se3
from improvo.odometry.result.final_view import FinalView
from improvo.odometry.settings import OdometrySettings, RansacGateSettings
from improvo.odometry.view import View
from improvo.odometry.visual_odometry import VisualOdometry
from improvo.types import Features, Float64


class _NoFrontend:
    name = "simulated"

    def __call__(self, image: object) -> Features:
        raise AssertionError("the tests hand over features")


def track(features: list[Features], settings: OdometrySettings | None = None) -> tuple[VisualOdometry, list[FinalView]]:
    """Run the odometry over features at 30 Hz."""
    final: list[FinalView] = []
    odometry = VisualOdometry(_NoFrontend(), CAMERA, settings, on_final=final.append)
    for i, each in enumerate(features):
        odometry.track_features(each, i / 30.0)
    odometry.finish()
    return odometry, final


def views(world_from_cam: Float64, seed: int = 0) -> list[Features]:
    world = room(seed)
    return [observe(world, pose, seed=i) for i, pose in enumerate(world_from_cam)]


@pytest.fixture(scope="module")
def walk() -> tuple[Float64, list[Features]]:
    world_from_cam = hand_motion(90)
    return world_from_cam, views(world_from_cam)


@pytest.fixture(scope="module")
def walked(walk: tuple[Float64, list[Features]]) -> tuple[VisualOdometry, list[FinalView]]:
    return track(walk[1])


def test_robust_mode_recovers_a_walk_in_one_segment(
    walk: tuple[Float64, list[Features]], walked: tuple[VisualOdometry, list[FinalView]]
) -> None:
    truth, odometry = walk[0], walked[0]
    trajectory = odometry.trajectory
    assert trajectory.valid.all()
    assert set(trajectory.segment) == {0}
    assert error_percent(trajectory.camera_centers, truth[:, :3, 3]) < 0.5
    assert len(odometry.map) > 300
    assert np.median(odometry.map.mean_error) < 1.0


def test_world_is_the_first_camera_and_its_median_depth_about_one(
    walked: tuple[VisualOdometry, list[FinalView]],
) -> None:
    odometry, final = walked
    first = odometry.trajectory.world_from_cam[0]
    np.testing.assert_allclose(first, np.eye(4), atol=0.02)
    of_first = next(view for view in final if view.frame_index == 0)
    xyz = dict(zip(odometry.map.ids.tolist(), odometry.map.xyz, strict=True))
    depths = [xyz[point][2] for point in of_first.points.tolist() if point in xyz]
    assert np.median(depths) == pytest.approx(1.0, abs=0.1)


def test_every_frame_becomes_final_exactly_once(walked: tuple[VisualOdometry, list[FinalView]]) -> None:
    _, final = walked
    assert sorted(view.frame_index for view in final) == list(range(90))


def test_final_poses_are_the_ones_of_the_trajectory(walked: tuple[VisualOdometry, list[FinalView]]) -> None:
    odometry, final = walked
    for view in final:
        np.testing.assert_array_equal(view.world_from_cam, odometry.trajectory.world_from_cam[view.frame_index])


def test_poses_become_final_while_the_sequence_runs(walk: tuple[Float64, list[Features]]) -> None:
    features = walk[1] + views(hand_motion(200)[90:])
    emitted: list[int] = []
    odometry = VisualOdometry(_NoFrontend(), CAMERA, on_final=lambda view: emitted.append(view.frame_index))
    for i, each in enumerate(features[:170]):
        odometry.track_features(each, i / 30.0)
    assert len(emitted) > 20, "nothing became final before the end"


def test_same_input_and_seed_give_the_same_bytes(
    walk: tuple[Float64, list[Features]], walked: tuple[VisualOdometry, list[FinalView]]
) -> None:
    first, second = walked[0], track(walk[1])[0]
    assert first.trajectory.world_from_cam.tobytes() == second.trajectory.world_from_cam.tobytes()
    assert first.map.xyz.tobytes() == second.map.xyz.tobytes()


def test_pure_rotation_never_starts_a_map_and_says_why() -> None:
    world_from_cam = hand_motion(60, turn_deg=1.0)
    world_from_cam[:, :3, 3] = world_from_cam[0, :3, 3]
    odometry, _ = track(views(world_from_cam))
    assert not odometry.trajectory.valid.any()
    assert any(event.kind == "initialising" and "parallax" in event.detail for event in odometry.events)


def test_a_still_camera_never_starts_a_map() -> None:
    world_from_cam = np.repeat(hand_motion(1), 40, axis=0)
    odometry, _ = track(views(world_from_cam))
    assert not odometry.trajectory.valid.any()


def test_waiting_frames_get_their_pose_once_the_camera_moves() -> None:
    world_from_cam = hand_motion(70)
    still = np.repeat(world_from_cam[:1], 20, axis=0)
    truth = np.concatenate([still, world_from_cam])
    odometry, _ = track(views(truth))
    assert odometry.trajectory.valid.all()
    assert error_percent(odometry.trajectory.camera_centers, truth[:, :3, 3]) < 0.7


def test_a_short_blackout_is_bridged_within_the_segment(walk: tuple[Float64, list[Features]]) -> None:
    truth, features = walk
    dark = [*features[:60], *(nothing_to_see(i) for i in range(4)), *features[64:]]
    odometry, _ = track(dark)
    trajectory = odometry.trajectory
    assert np.flatnonzero(~trajectory.valid).tolist() == [60, 61, 62, 63]
    assert set(trajectory.segment[trajectory.valid]) == {0}
    rows = trajectory.valid
    assert error_percent(trajectory.camera_centers[rows], truth[rows, :3, 3]) < 0.7
    assert sum(event.kind == "lost" for event in odometry.events) == 4


def test_a_cut_to_another_place_ends_the_segment_and_starts_another() -> None:
    here, there = hand_motion(50, seed=1), hand_motion(60, seed=2)
    features = views(here, seed=0) + [observe(room(7), pose, seed=500 + i) for i, pose in enumerate(there)]
    odometry, _ = track(features)
    trajectory = odometry.trajectory
    assert len(odometry.segments) == 2
    assert odometry.segments[0].last < 50 <= odometry.segments[1].first
    assert set(trajectory.segment[trajectory.valid]) == {0, 1}
    assert odometry.segments[0].reason == "lost"
    assert any(event.kind == "segment" for event in odometry.events)
    for number, truth, offset in ((0, here, 0), (1, there, 50)):
        rows = np.flatnonzero(trajectory.segment == number)
        assert error_percent(trajectory.camera_centers[rows], truth[rows - offset, :3, 3]) < 1.0


def test_frames_without_any_keypoint_are_lost_not_fatal(walk: tuple[Float64, list[Features]]) -> None:
    nothing = walk[1][0].take(np.zeros(0, np.int64))
    odometry, _ = track([nothing, *walk[1][:40], nothing, *walk[1][41:60]])
    lost = np.flatnonzero(~odometry.trajectory.valid).tolist()
    assert 41 in lost
    assert odometry.trajectory.valid.sum() >= 58


def test_a_crowd_that_fills_the_picture_does_not_become_the_world_where_stability_is_known() -> None:
    truth = hand_motion(60)
    sway = 0.4 * np.sin(np.arange(60) / 10.0)
    away = se3.rigid(np.eye(3), np.stack([0 * sway, sway, 0 * sway], axis=1))  # how the crowd moves
    static = [observe(room(0), pose, seed=i, limit=200) for i, pose in enumerate(truth)]
    crowd = [observe(room(1), pose, seed=100 + i, limit=300) for i, pose in enumerate(se3.inverse(away) @ truth)]
    features = [_together(a, b, (0.9, 0.1)) for a, b in zip(static, crowd, strict=True)]

    def error(settings: OdometrySettings) -> float:
        trajectory = track(features, settings)[0].trajectory
        assert trajectory.valid.all()
        return error_percent(trajectory.camera_centers, truth[:, :3, 3])

    assert error(OdometrySettings()) < 1.0
    no_gate = OdometrySettings(ransac_gate=RansacGateSettings(least_stability=0.0))
    assert error(no_gate) > 5.0, "the weights alone are enough"


def _together(first: Features, second: Features, stability: tuple[float, float]) -> Features:
    """The features of both, each with its stability."""
    known = np.repeat(np.float32(stability), (len(first), len(second)))
    joined = {
        name: np.concatenate([getattr(first, name), getattr(second, name)])
        for name in ("keypoints", "descriptors", "scores")
    }
    return Features(**joined, stability=known)


def test_memory_holds_no_more_views_than_the_window(walk: tuple[Float64, list[Features]]) -> None:
    features = walk[1] + views(hand_motion(240)[90:])
    odometry = VisualOdometry(_NoFrontend(), CAMERA)
    seen: list[weakref.ref[View]] = []
    alive = []
    for i, each in enumerate(features):
        odometry.track_features(each, i / 30.0)
        assert odometry.newest_view is not None
        seen.append(weakref.ref(odometry.newest_view))
        if i in (150, 239):
            gc.collect()
            alive.append(sum(view() is not None for view in seen))
    assert alive[1] <= alive[0] + 20
    assert alive[1] < 150
