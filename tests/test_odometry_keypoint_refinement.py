"""Observations of map points go to where their first picture's patch lies, and back when the pose is forgotten."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from improvo.errors import ConfigError
from improvo.frontend.registry import load_frontend
from improvo.geometry import se3
from improvo.geometry.camera import Camera
from improvo.odometry.point_store import PointStore
from improvo.odometry.refinement.anchors import Anchors
from improvo.odometry.refinement.keypoint_refinement import KeypointRefiner, prepared
from improvo.odometry.refinement.patch_alignment import REACH
from improvo.odometry.settings import OdometrySettings, RefinementSettings
from improvo.odometry.view import View
from improvo.odometry.visual_odometry import VisualOdometry
from improvo.sequences import open_sequence
from improvo.simulation import bundled_sequence
from improvo.types import Float64, Int64, UInt8

CAMERA = Camera(width=200, height=160, fx=180.0, fy=180.0, cx=99.5, cy=79.5)
DEPTH = 3.0  # of a textured wall that faces the first camera
_RNG = np.random.default_rng(8)
_WAVES, _PHASES = _RNG.uniform(-40, 40, (80, 2)), _RNG.uniform(0, 2 * np.pi, 80)  # radians per unit of the wall


def picture(cam_from_world: Float64) -> UInt8:
    """The wall as a camera sees it."""
    y, x = np.mgrid[: CAMERA.height, : CAMERA.width]
    rays = CAMERA.unproject(np.stack([x, y], axis=-1).reshape(-1, 2).astype(np.float64))
    world_from_cam = se3.inverse(cam_from_world)
    directions = rays @ world_from_cam[:3, :3].T
    centre = world_from_cam[:3, 3]
    wall = centre[:2] + directions[:, :2] * ((DEPTH - centre[2]) / directions[:, 2])[:, None]
    values = 120 + 8 * np.cos(wall @ _WAVES.T + _PHASES).sum(axis=1)
    return np.clip(np.rint(values), 0, 255).astype(np.uint8).reshape(y.shape)


def pose(x: float, z: float, turn: float) -> Float64:
    return se3.rigid(se3.so3_exp(np.array([0.0, turn, 0.5 * turn])), np.array([x, 0.1 * x, z]))


POSES = [pose(0.0, 0.0, 0.0), pose(0.1, 0.1, 0.02), pose(0.25, 0.2, -0.05), pose(0.3, -0.3, 0.08)]


def views_with_noise(noise: float) -> tuple[list[View], PointStore, list[Float64]]:
    """Views of points on the wall: keypoints exact in the first, noisy in the others; true pixels of all."""
    store, rng = PointStore(), np.random.default_rng(4)
    pixels = np.stack(np.meshgrid(np.arange(50.0, 151, 10), np.arange(45.0, 116, 10)), axis=-1).reshape(-1, 2)
    ids = store.add(CAMERA.unproject(pixels) * DEPTH, 0)
    views, true = [], []
    for i, cam_from_world in enumerate(POSES):
        exact = CAMERA.project(se3.transform(cam_from_world, store.xyz))
        error = rng.normal(0, noise, exact.shape) if i else np.zeros(exact.shape)
        view = View(i, i / 30, exact + error, np.zeros((len(ids), 4), np.float32), np.ones(len(ids)), ids, ids.copy())
        view.cam_from_world, view.image = cam_from_world, prepared(picture(cam_from_world))
        views.append(view)
        true.append(exact)
    return views, store, true


def observed(views: list[View]) -> list[tuple[View, Int64]]:
    return [(view, view.observed) for view in views]


def test_noisy_keypoints_become_exact_and_those_that_would_go_far_stay() -> None:
    views, store, true = views_with_noise(0.6)
    KeypointRefiner(CAMERA, 1.5).refine(observed(views), store)
    assert (views[0].keypoints == views[0].detected).all()  # the anchors
    for view, exact in zip(views[1:], true[1:], strict=True):
        moved = (view.keypoints != view.detected).any(axis=1)
        assert moved.mean() > 0.6
        assert np.median(np.linalg.norm(view.keypoints - exact, axis=1)[moved]) < 0.1
        assert np.median(np.linalg.norm(view.detected - exact, axis=1)[moved]) > 0.5
        assert np.linalg.norm(view.keypoints - view.detected, axis=1).max() <= 2.0


def test_a_wrong_map_does_not_draw_keypoints_to_its_projections() -> None:
    views, store, true = views_with_noise(0.3)
    store.xyz[:, :2] += 1.2 * DEPTH / CAMERA.fx  # every projection is more than a pixel off
    KeypointRefiner(CAMERA, 1.5).refine(observed(views), store)
    for view, exact in zip(views[1:], true[1:], strict=True):
        moved = (view.keypoints != view.detected).any(axis=1)
        assert np.median(np.linalg.norm(view.keypoints - exact, axis=1)[moved]) < 0.15


def test_a_forgotten_pose_and_a_dropped_point_give_the_detected_keypoints_back() -> None:
    views, store, _ = views_with_noise(0.6)
    refiner = KeypointRefiner(CAMERA, 1.5)
    refiner.refine(observed(views), store)
    views[1].forget_pose()
    assert (views[1].keypoints == views[1].detected).all()
    assert not views[1].refined.any()
    views[2].points[:40] = -1
    refiner.refine(observed([views[2]]), store)
    assert (views[2].keypoints[:40] == views[2].detected[:40]).all()
    assert (views[2].keypoints[40:] != views[2].detected[40:]).any()


def test_a_view_without_a_picture_is_passed_over() -> None:
    views, store, _ = views_with_noise(0.6)
    views[1].image = None
    KeypointRefiner(CAMERA, 1.5).refine(observed(views), store)
    assert (views[1].keypoints == views[1].detected).all()
    assert (views[2].keypoints != views[2].detected).any()


def test_slots_of_points_that_are_gone_are_used_again() -> None:
    anchors, side = Anchors(), 2 * REACH + 1
    last_seen = np.full(60_000, -1, np.int64)
    for frame in range(200):
        points = np.arange(frame * 300, (frame + 1) * 300)
        last_seen[points] = frame
        patches = np.full((300, side, side), frame, np.float32)
        anchors.put(points, frame, patches, np.full((300, 2), 20.25), np.ones(300, bool))
        anchors.forget(last_seen, frame - 5)
    assert len(anchors.patches) <= 4096
    slots = anchors.slots(np.arange(199 * 300, 200 * 300))
    assert (anchors.patches[slots] == 199).all()
    assert len(np.unique(slots)) == 300
    assert (anchors.slots(np.arange(300)) == -1).all()
    assert anchors.frames() == set(range(194, 200))


def test_wrong_settings_are_refused() -> None:
    with pytest.raises(ConfigError):
        RefinementSettings(frontends="some")  # type: ignore[arg-type]


def test_the_odometry_refines_where_the_settings_say_so_and_twice_alike() -> None:
    sequence = open_sequence(bundled_sequence())
    frontend = load_frontend("orb", 400)

    def centres(frontends: str, with_image: bool = True) -> bytes:
        settings = replace(OdometrySettings(), refinement=RefinementSettings(frontends=frontends))  # type: ignore[arg-type]
        odometry = VisualOdometry(frontend, sequence.camera, settings)
        for i in range(40):
            frame = sequence[i]
            odometry.track_features(frontend(frame.image), frame.time, frame.image if with_image else None)
        odometry.finish()
        assert odometry.trajectory.valid.mean() > 0.9
        return odometry.trajectory.camera_centers.tobytes()

    refined = centres("all")
    assert refined == centres("all")
    assert centres("networks") == centres("none")  # ORB is none
    assert refined != centres("none")
    assert centres("all", with_image=False) == centres("none")
