"""A zoom in one frame is told from a step ahead, ends the segment, and what follows is said to be doubtful."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from simulated_features import CAMERA, hand_motion, observe, room

from improvo.geometry import se3
from improvo.odometry.alarms.focal_change import focal_change
from improvo.odometry.settings import OdometrySettings
from improvo.odometry.view import View
from improvo.odometry.visual_odometry import VisualOdometry
from improvo.types import Features, Float64


def two_views(b_from_a: Float64, factor: float) -> tuple[View, View, Float64]:
    """Consecutive views of points at depths 1.5 to 6; the second with another focal length."""
    rng = np.random.default_rng(5)
    pixels = rng.uniform((0, 0), (CAMERA.width, CAMERA.height), (150, 2))
    xyz = CAMERA.unproject(pixels, rng.uniform(1.5, 6.0, 150))
    zoomed = replace(CAMERA, fx=factor * CAMERA.fx, fy=factor * CAMERA.fy)
    after = zoomed.project(se3.transform(b_from_a, xyz)) + rng.normal(scale=0.4, size=pixels.shape)
    rows, nothing = np.arange(150), np.full(150, -1, np.int64)
    parts = (np.zeros((150, 8), np.float32), np.ones(150), rows)
    return View(0, 0.0, pixels, *parts, rows.copy()), View(1, 0.03, after, *parts, nothing), xyz


@pytest.mark.parametrize("factor", [1.5, 1.2, 0.7])
def test_a_zoom_is_found_with_its_factor(factor: float) -> None:
    before, view, xyz = two_views(se3.rigid(se3.so3_exp(np.array([0.0, 0.01, 0.0])), np.array([0.02, 0, 0])), factor)
    assert focal_change(before, view, xyz, CAMERA, 3.0, 0) == pytest.approx(factor, rel=0.03)


@pytest.mark.parametrize("step", [(0.0, 0.0, -0.5), (0.0, 0.0, 0.4), (0.3, 0.0, 0.0), (0.0, 0.0, 0.0)])
def test_a_step_ahead_is_no_zoom(step: tuple[float, float, float]) -> None:
    before, view, xyz = two_views(se3.rigid(np.eye(3), np.array(step)), 1.0)
    assert focal_change(before, view, xyz, CAMERA, 3.0, 0) == 1.0


def tracked(factors: list[float]) -> VisualOdometry:
    """Odometry over a walk whose picture is enlarged about its middle by a factor for each frame."""
    odometry = VisualOdometry(None, CAMERA, OdometrySettings())  # type: ignore[arg-type]
    world, path = room(), hand_motion(len(factors), step=0.03)
    centre = np.array([CAMERA.cx, CAMERA.cy])
    for number, (pose, factor) in enumerate(zip(path, factors, strict=True)):
        seen = observe(world, pose, seed=number)
        pixels = (centre + factor * (seen.keypoints - centre)).astype(np.float32)
        inside = ((pixels > 0) & (pixels < (CAMERA.width, CAMERA.height))).all(axis=1)
        odometry.track_features(Features(pixels, seen.descriptors, seen.scores).take(inside), number / 30)
    odometry.finish()
    return odometry


def test_a_zoom_ends_the_segment_and_the_next_is_doubtful_until_the_lens_is_back() -> None:
    odometry = tracked([1.0] * 30 + [1.4] * 30 + [1.0] * 30)
    said = [event for event in odometry.events if event.kind == "focal length"]
    assert [segment.first for segment in odometry.segments] == [0, 30, 60]
    assert odometry.segments[0].reason == "the focal length changed"
    assert [event.frame_index for event in said] == [30, 30, 60]
    assert "1.4" in said[1].detail
    assert "doubtful" in said[1].detail


def test_a_walk_without_a_zoom_says_nothing() -> None:
    assert not [event for event in tracked([1.0] * 60).events if event.kind == "focal length"]
