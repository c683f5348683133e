"""Starting a map: what starts one, what must not, and what a failed start leaves behind."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from simulated_features import CAMERA, World, error_percent, hand_motion, nothing_to_see, observe, room, views_of, wall

from improvo.geometry import se3
from improvo.odometry.gates import MEMORY_FRAMES
from improvo.odometry.mapping.initial_pair import InitFailure, InitialPair, initial_pair
from improvo.odometry.mapping.local_map import LocalMap
from improvo.odometry.mapping.start import start_map
from improvo.odometry.settings import OdometrySettings, WindowSettings
from improvo.odometry.view import View
from improvo.types import Float64

SETTINGS = OdometrySettings()


def moving(frames: int, seed: int = 0) -> Float64:
    return hand_motion(frames, step=0.05, seed=seed)


def walk(world: World, world_from_cam: Float64, noise: float = 0.4) -> list[View]:
    return views_of([observe(world, pose, seed=i, noise=noise, limit=800) for i, pose in enumerate(world_from_cam)])


def sideways(frames: int, step: float = 0.03) -> Float64:
    """A camera before a wall at z = 3 that moves along it."""
    centers = np.stack([step * np.arange(frames), np.zeros(frames), np.zeros(frames)], axis=1)
    return se3.rigid(np.repeat(np.eye(3)[None], frames, axis=0), centers)


def turning(frames: int) -> Float64:
    poses = hand_motion(frames, turn_deg=1.0)
    poses[:, :3, 3] = poses[0, :3, 3]
    return poses


def pair_of(views: list[View], settings: OdometrySettings = SETTINGS) -> InitialPair | InitFailure:
    return initial_pair(views[0], views[-1], CAMERA, settings, descriptor_distance=0.7)


def started(views: list[View], settings: OdometrySettings = SETTINGS) -> LocalMap:
    result = start_map(views, CAMERA, settings, descriptor_distance=0.7)
    assert isinstance(result, LocalMap), result.reason
    return result


def centers(views: list[View]) -> Float64:
    return np.array([se3.inverse(view.cam_from_world)[:3, 3] for view in views if view.cam_from_world is not None])


def test_a_walk_starts_a_map_with_a_pose_for_every_buffered_view() -> None:
    truth = moving(20)
    views = walk(room(), truth)
    local_map = started(views)
    assert all(view.cam_from_world is not None for view in views)
    assert error_percent(centers(views), truth[:, :3, 3]) < 1.5
    assert local_map.store.count > 200


def test_the_world_is_the_first_camera_and_the_median_depth_in_it_is_one() -> None:
    views = walk(room(), moving(20))
    local_map = started(views)
    np.testing.assert_allclose(views[0].cam_from_world, np.eye(4), atol=1e-12)
    depths = local_map.store.xyz[views[0].points[views[0].observed], 2]
    assert np.median(depths) == pytest.approx(1.0)


def test_the_memory_of_a_new_map_is_that_of_its_last_frames_in_their_order() -> None:
    truth = np.concatenate([np.repeat(moving(1), 70, axis=0), moving(30)])
    views = walk(room(), truth)
    local_map = started(views)
    assert [view.frame_index for view in local_map.history] == [view.frame_index for view in views[-MEMORY_FRAMES:]]
    newest = views[-1]
    assert (local_map.store.last_seen[newest.points[newest.observed]] == newest.frame_index).all()


def test_a_pure_rotation_starts_nothing_and_leaves_nothing() -> None:
    views = walk(room(), turning(20))
    failure = start_map(views, CAMERA, SETTINGS, descriptor_distance=0.7)
    assert isinstance(failure, InitFailure)
    assert "parallax" in failure.reason
    assert all(view.cam_from_world is None and (view.points == -1).all() for view in views)


def test_a_rotation_with_noise_is_still_a_rotation() -> None:
    found = pair_of(walk(room(), turning(12), noise=0.8))
    assert isinstance(found, InitFailure)
    assert "parallax" in found.reason


def test_a_still_camera_starts_nothing() -> None:
    failure = start_map(walk(room(), np.repeat(hand_motion(1), 10, axis=0)), CAMERA, SETTINGS, 0.7)
    assert isinstance(failure, InitFailure)


def test_views_without_common_tracks_start_nothing() -> None:
    views = views_of([nothing_to_see(0), nothing_to_see(1)])
    failure = start_map(views, CAMERA, SETTINGS, descriptor_distance=0.7)
    assert failure == InitFailure("too few tracks")


def test_before_a_single_plane_the_motion_is_right_or_refused() -> None:
    """A homography stands for two motions; only one that is far better supported than the other may start a map."""
    truth = sideways(30)
    truth[:, :3, :3] = se3.so3_exp(np.radians(0.3) * np.arange(30)[:, None] * [0.0, 1.0, 0.0])
    expected = se3.inverse(truth[-1]) @ truth[0]
    direction = expected[:3, 3] / np.linalg.norm(expected[:3, 3])
    accepted = 0
    for tilt in (-0.4, -0.2, 0.0, 0.2, 0.4, 0.6):
        found = pair_of(walk(wall(count=4000, tilt=tilt), truth))
        if isinstance(found, InitFailure):
            continue
        accepted += 1
        assert se3.rotation_angle_deg(found.b_from_a[:3, :3].T @ expected[:3, :3]) < 1.0
        assert found.b_from_a[:3, 3] @ direction > np.cos(np.radians(8.0))
        assert (found.xyz[:, 2] > 0).all()
    assert accepted >= 2, "hardly any plane starts a map"


def test_a_map_never_starts_mirrored() -> None:
    """The depths of the start are those of the scene, not of its mirror image at the plane of the cameras' motion."""
    for seed in range(4):
        truth = moving(20, seed)
        world = room(seed)
        views = walk(world, truth)
        local_map = started(views)
        similarity = se3.inverse(truth[0])
        scale = np.linalg.norm(truth[-1, :3, 3] - truth[0, :3, 3]) / np.linalg.norm(centers(views)[-1])
        for view, pose in ((views[0], truth[0]), (views[-1], truth[-1])):
            rows = view.observed
            estimated = local_map.store.xyz[view.points[rows]] * scale
            true = se3.transform(similarity, world.points)
            pixels = CAMERA.project(se3.transform(se3.inverse(pose), world.points))
            nearest = np.array([np.argmin(((pixels - keypoint) ** 2).sum(axis=1)) for keypoint in view.keypoints[rows]])
            ratio = np.linalg.norm(estimated, axis=1) / np.linalg.norm(true[nearest], axis=1)
            assert np.median(np.abs(ratio - 1.0)) < 0.1


def test_dark_frames_in_the_buffer_stay_without_a_pose() -> None:
    truth = moving(24)
    features = [observe(room(), pose, seed=i) for i, pose in enumerate(truth)]
    views = views_of(features)
    dark = views_of([nothing_to_see(5), nothing_to_see(6)], first=24)
    buffer = [*views[:2], *dark, *views[2:]]
    started(buffer)
    assert all(view.cam_from_world is None and (view.points == -1).all() for view in dark)
    assert all(view.cam_from_world is not None for view in views)


def test_the_start_adjusts_no_more_views_than_the_window_has(monkeypatch: pytest.MonkeyPatch) -> None:
    from improvo.odometry.mapping import start

    sizes: list[tuple[int, int]] = []
    adjust = start.adjust

    def recorded(free: list[View], fixed: list[View], *rest: object) -> object:
        sizes.append((len(free), len(fixed)))
        return adjust(free, fixed, *rest)  # type: ignore[arg-type]

    monkeypatch.setattr(start, "adjust", recorded)
    settings = replace(SETTINGS, window=WindowSettings(recent=4))
    started(walk(room(), moving(20)), settings)
    between = sizes[1:-1]  # the first is the pair alone, the last all views together
    assert max(free for free, _ in between) == 4
    assert max(fixed for _, fixed in between) == 1 + 8  # the gauge, and twice as many older views


def test_the_same_buffer_gives_the_same_bits() -> None:
    first, second = walk(room(), moving(15)), walk(room(), moving(15))
    assert started(first).store.xyz.tobytes() == started(second).store.xyz.tobytes()


def test_a_tolerance_within_which_a_rotation_explains_the_matches_starts_nothing() -> None:
    views = walk(room(), moving(20))
    assert isinstance(pair_of(views), InitialPair)
    generous = replace(SETTINGS, tolerance=50.0)
    assert pair_of(views, generous) == InitFailure("too little parallax: a rotation explains the motion")


def test_repeated_texture_that_looks_like_a_motion_starts_nothing_where_tracks_only_turn() -> None:
    """Most matches are one repetition off and say that the camera moved; what was tracked says that it turned."""
    turned, moved = turning(4)[[0, -1]], moving(12)[[0, -1]]
    moved[0] = turned[0]
    turned_views = views_of([observe(room(0), pose, seed=i, limit=120) for i, pose in enumerate(turned)])
    moved_views = views_of([observe(room(1), pose, seed=i, limit=400) for i, pose in enumerate(moved)])
    for tracked, word in ((False, InitFailure), (True, InitialPair)):
        views = []
        for i, (a, b) in enumerate(zip(turned_views, moved_views, strict=True)):
            tracks = b.tracks if tracked else 1000 * i + np.arange(len(b))
            views.append(
                View(
                    frame_index=i,
                    time=i / 30.0,
                    keypoints=np.concatenate([a.keypoints, b.keypoints]),
                    descriptors=np.concatenate([a.descriptors, b.descriptors]),
                    weights=np.ones(len(a) + len(b)),
                    tracks=np.concatenate([a.tracks, 10_000 + tracks]),
                    points=np.full(len(a) + len(b), -1, np.int64),
                )
            )
        result = pair_of(views)
        assert isinstance(result, word), result
        if isinstance(result, InitFailure):
            assert result.reason == "too little parallax: a rotation explains the tracks"
