"""PoseLib's LO-RANSAC: the default robust solver, and the only place that calls PoseLib."""

from __future__ import annotations

from typing import Any

import numpy as np
import poselib

from improvo.geometry import se3
from improvo.geometry.camera import Camera
from improvo.geometry.ransac import Ransac, RobustHomography, RobustPose
from improvo.types import Float64

_MIN_LENGTH = 1e-6  # of the translation over the distance of a plane; a homography with less is a rotation


class PoseLibSolver:
    """See `RobustSolver`."""

    name = "poselib"

    def absolute_pose(self, points: Float64, pixels: Float64, camera: Camera, ransac: Ransac) -> RobustPose:
        """P3P, refined over the inliers."""
        if len(points) < 4:
            return RobustPose(np.eye(4), np.zeros(len(points), np.bool_))
        options = _options(ransac, "max_reproj_error")
        return _robust_pose(*poselib.estimate_absolute_pose(pixels, points, _described(camera), options, {}))

    def relative_pose(self, pixels_a: Float64, pixels_b: Float64, camera: Camera, ransac: Ransac) -> RobustPose:
        """Five points, refined over the inliers."""
        if len(pixels_a) < 5:
            return RobustPose(np.eye(4), np.zeros(len(pixels_a), np.bool_))
        shape, options = _described(camera), _options(ransac, "max_epipolar_error")
        return _robust_pose(*poselib.estimate_relative_pose(pixels_a, pixels_b, shape, shape, options, {}))

    def homography(self, pixels_a: Float64, pixels_b: Float64, ransac: Ransac) -> RobustHomography:
        """Four points, refined over the inliers."""
        if len(pixels_a) < 4:
            return RobustHomography(np.eye(3), np.zeros(len(pixels_a), np.bool_))
        matrix, report = poselib.estimate_homography(pixels_a, pixels_b, _options(ransac, "max_reproj_error"))
        return RobustHomography(np.asarray(matrix), np.asarray(report["inliers"], np.bool_))

    def motions_of_homography(self, b_from_a: Float64, camera: Camera) -> list[Float64]:
        """Up to four motions, with a translation of length 1."""
        normalised = np.linalg.inv(camera.K) @ b_from_a @ camera.K
        motions = []
        for pose in poselib.motion_from_homography(normalised)[0]:
            length = float(np.linalg.norm(pose.t))
            if length >= _MIN_LENGTH:
                motions.append(se3.rigid(pose.R, pose.t / length))
        return motions


def _options(ransac: Ransac, error_name: str) -> dict[str, Any]:
    options = {
        error_name: ransac.max_error,
        "min_iterations": ransac.min_iterations,
        "max_iterations": ransac.max_iterations,
        "seed": ransac.seed,
    }
    return {name: value for name, value in options.items() if value is not None}


def _described(camera: Camera) -> dict[str, Any]:
    """The camera as PoseLib wants it."""
    return {
        "model": "PINHOLE",
        "width": camera.width,
        "height": camera.height,
        "params": [camera.fx, camera.fy, camera.cx, camera.cy],
    }


def _robust_pose(pose: Any, report: dict[str, Any]) -> RobustPose:
    motion = se3.rigid(np.asarray(pose.R), np.asarray(pose.t).ravel())
    return RobustPose(motion, np.asarray(report["inliers"], np.bool_))


SOLVER = PoseLibSolver()
