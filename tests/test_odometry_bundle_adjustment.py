"""The adjustment of a window: it moves what is free, keeps what is fixed, and drops what does not fit."""

from __future__ import annotations

import numpy as np
import pytest
from simulated_features import CAMERA, hand_motion, observe, room, views_of

from improvo.backend.settings import ObjectiveSettings, SolverSettings
from improvo.geometry import se3
from improvo.odometry.mapping.bundle_adjustment import adjust
from improvo.odometry.point_store import PointStore
from improvo.odometry.view import View

OBJECTIVE = ObjectiveSettings(depth_weight=0.0)
SOLVER = SolverSettings(max_iterations=30)


def true_window(frames: int = 6, noise: float = 0.3) -> tuple[list[View], PointStore]:
    """Views with their true poses, and a point at its true place for every track of two views or more."""
    world, poses = room(), hand_motion(frames, step=0.08)
    views = views_of([observe(world, pose, seed=i, noise=noise) for i, pose in enumerate(poses)])
    store = PointStore()
    point_of_track: dict[int, int] = {}
    for view, pose in zip(views, poses, strict=True):
        view.cam_from_world = se3.inverse(pose)
        pixels = CAMERA.project(se3.transform(view.cam_from_world, world.points))
        in_front = se3.transform(view.cam_from_world, world.points)[:, 2] > 0.1
        pixels[~in_front] = 1e6
        for row, track in enumerate(view.tracks.tolist()):
            if track not in point_of_track:
                nearest = int(np.argmin(((pixels - view.keypoints[row]) ** 2).sum(axis=1)))
                point_of_track[track] = int(store.add(world.points[nearest][None], view.frame_index)[0])
            view.points[row] = point_of_track[track]
    return views, store


def adjusted(views: list[View], store: PointStore, fixed: int, max_error: float | None = 3.0):  # type: ignore[no-untyped-def]
    return adjust(views[fixed:], views[:fixed], store, CAMERA.K, OBJECTIVE, SOLVER, max_error)


def test_perturbed_poses_come_back_and_fixed_ones_stay() -> None:
    views, store = true_window()
    truth = [view.cam_from_world.copy() for view in views if view.cam_from_world is not None]
    rng = np.random.default_rng(0)
    for view in views[2:]:
        jitter = se3.rigid(se3.so3_exp(rng.normal(scale=0.01, size=3)), rng.normal(scale=0.02, size=3))
        assert view.cam_from_world is not None
        view.cam_from_world = jitter @ view.cam_from_world
    report = adjusted(views, store, fixed=2)
    for view, true in zip(views[:2], truth[:2], strict=True):
        assert view.cam_from_world is not None
        assert view.cam_from_world.tobytes() == true.tobytes()
    for view, true in zip(views[2:], truth[2:], strict=True):
        assert view.cam_from_world is not None
        np.testing.assert_allclose(view.cam_from_world, true, atol=0.01)
    assert report.mean_error < 0.6
    assert report.dropped < 0.05 * report.kept


def test_an_observation_that_does_not_fit_loses_its_point() -> None:
    views, store = true_window()
    wrong = views[3].observed[:10]
    views[3].keypoints[wrong] += 25.0
    report = adjusted(views, store, fixed=1)
    assert (views[3].points[wrong] == -1).mean() > 0.8  # points seen twice only may go along with it
    assert report.dropped >= 8


def test_without_a_limit_nothing_is_dropped() -> None:
    views, store = true_window()
    views[3].keypoints[views[3].observed[:10]] += 25.0
    before = [view.points.copy() for view in views]
    report = adjusted(views, store, fixed=1, max_error=None)
    assert report.dropped == 0
    for view, points in zip(views, before, strict=True):
        np.testing.assert_array_equal(view.points, points)


def test_points_that_one_view_sees_or_only_fixed_views_see_are_left_alone() -> None:
    views, store = true_window()
    times = np.bincount(np.concatenate([view.points for view in views]), minlength=store.count)
    free = np.bincount(np.concatenate([view.points for view in views[2:]]), minlength=store.count)
    untouched = (times < 2) | (free < 1)
    assert untouched.any()
    before = store.xyz.copy()
    adjusted(views, store, fixed=2)
    np.testing.assert_array_equal(store.xyz[untouched], before[untouched])
    assert (store.xyz[~untouched] != before[~untouched]).any()


def test_a_window_without_observations_has_no_error() -> None:
    views, store = true_window(2)
    for view in views:
        view.points[:] = -1
    report = adjusted(views, store, fixed=1)
    assert np.isnan(report.mean_error)
    assert (report.kept, report.iterations) == (0, 0)


@pytest.mark.parametrize("count", [1, 2000])
def test_a_point_store_grows_and_keeps_what_it_has(count: int) -> None:
    store = PointStore()
    first = store.add(np.full((3, 3), 7.0), frame_index=4)
    ids = store.add(np.arange(3.0 * count).reshape(count, 3), frame_index=9)
    assert first.tolist() == [0, 1, 2]
    assert ids.tolist() == list(range(3, 3 + count))
    np.testing.assert_array_equal(store.xyz[:3], 7.0)
    assert store.last_seen.tolist() == [4] * 3 + [9] * count
