"""Does the map still agree with the pictures? An independent two-view check, and what it answers.

A wrong map can fit its own tracks well: it chose them, and lets go of what does not fit. Two views matched afresh
and their own essential matrix know nothing of the map; where both are sure and disagree, the map is wrong.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import poselib

from sivo.geometry import se3
from sivo.geometry.camera import Camera
from sivo.odometry.local_map import poselib_camera
from sivo.odometry.settings import OdometrySettings
from sivo.odometry.view import View, trusted_matches
from sivo.types import Float64, Int64

_FEATURES = 600  # the strongest of each view; all of them would only cost time


@dataclass(frozen=True)
class Agreement:
    """Matches of two views that fit the map's relative pose, against those that fit their own essential matrix."""

    map_inliers: int
    own_inliers: int
    matches: int


class HealthCheck:
    """Compares the map with two-view geometry every few frames, and says when it contradicts the map.

    Measured on five real sequences with three frontends: over three checks a right map keeps at least 90 % of the
    inliers, a mirrored or otherwise wrong one at most 80 % (docs/odometry.md).
    """

    def __init__(self, camera: Camera, settings: OdometrySettings, descriptor_distance: float) -> None:
        self._camera = camera
        self._settings = settings
        self._descriptor_distance = descriptor_distance
        self._rounds: deque[Int64] = deque(maxlen=settings.health.rounds)  # of (gaps, 2) map and own inliers

    def contradicts(self, view: View, earlier: Mapping[int, View]) -> bool:
        """Whether the last checks together say that the map is wrong.

        Args:
            view: the newest view with a pose.
            earlier: recent views with poses by position.
        """
        settings = self._settings.health
        if view.position % settings.interval:
            return False
        counts = np.zeros((len(settings.gaps), 2), np.int64)
        for row, gap in enumerate(settings.gaps):
            if view.position - gap not in earlier:
                continue
            found = agreement(
                earlier[view.position - gap], view, self._camera, self._descriptor_distance, self._settings
            )
            if found.own_inliers >= max(settings.min_inliers, settings.min_inlier_share * found.matches):
                counts[row] = found.map_inliers, found.own_inliers
        self._rounds.append(counts)
        if len(self._rounds) < settings.rounds:
            return False
        map_inliers, own_inliers = np.sum(self._rounds, axis=(0, 1))
        enough = own_inliers >= settings.min_evidence
        return bool(enough and map_inliers < settings.min_agreement * own_inliers)


def agreement(a: View, b: View, camera: Camera, descriptor_distance: float, settings: OdometrySettings) -> Agreement:
    """Match two views with poses afresh, and count."""
    epipolar_error = settings.health.epipolar_error
    assert a.cam_from_world is not None
    assert b.cam_from_world is not None
    rows_a, rows_b = trusted_matches(a, b, descriptor_distance, settings.trust, _FEATURES)
    if len(rows_a) < 8:
        return Agreement(0, 0, len(rows_a))
    pixels_a, pixels_b = a.keypoints[rows_a], b.keypoints[rows_b]
    shape = poselib_camera(camera)
    _, report = poselib.estimate_relative_pose(
        pixels_a,
        pixels_b,
        shape,
        shape,
        {"max_epipolar_error": epipolar_error, "min_iterations": 100, "max_iterations": 1000, "seed": settings.seed},
    )
    b_from_a = b.cam_from_world @ se3.inverse(a.cam_from_world)
    errors = epipolar_errors(b_from_a, camera, pixels_a, pixels_b)
    fits = int((errors < epipolar_error).sum())
    return Agreement(fits, int(report["num_inliers"]), len(rows_a))


def epipolar_errors(b_from_a: Float64, camera: Camera, pixels_a: Float64, pixels_b: Float64) -> Float64:
    """Sampson distance in pixels (N,) of matches to a relative pose."""
    x, y, z = b_from_a[:3, 3]
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    rays_a, rays_b = camera.unproject(pixels_a), camera.unproject(pixels_b)
    lines_b = rays_a @ (cross @ b_from_a[:3, :3]).T
    lines_a = rays_b @ (cross @ b_from_a[:3, :3])
    algebraic = (rays_b * lines_b).sum(axis=1)
    slope = (lines_b[:, :2] ** 2).sum(axis=1) + (lines_a[:, :2] ** 2).sum(axis=1)
    focal = np.sqrt(camera.fx * camera.fy)
    return focal * np.abs(algebraic) / np.sqrt(np.maximum(slope, 1e-18))
