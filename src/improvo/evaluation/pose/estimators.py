"""Pose from 3D-to-2D matches: the paper's solver, and robust ones.

Whether the solver is robust moves Table 1 more than which frontend is: OpenCV's default stops after 100 RANSAC
iterations, which at 15 % inliers almost never succeeds. A claim about a frontend names the solver.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from improvo.errors import ConfigError
from improvo.geometry.camera import Camera
from improvo.geometry.ransac import Ransac, poselib_installed, robust_solver
from improvo.geometry.se3 import rigid, so3_exp
from improvo.types import Float64

REPROJECTION_ERROR = 8.0  # pixels, inlier threshold: the default of OpenCV, for both solvers


@dataclass(frozen=True)
class PoseEstimate:
    """A camera pose and the matches that agree with it."""

    cam_from_world: Float64  # (4, 4)
    inliers: NDArray[np.bool_]  # (N,)


Estimator = Callable[[Float64, Float64, Camera, int], PoseEstimate | None]


def with_opencv(points: Float64, pixels: Float64, camera: Camera, seed: int) -> PoseEstimate | None:
    """OpenCV's `solvePnPRansac` with its defaults, as the paper uses it (100 iterations, 8 px, 0.99 confidence).

    Args:
        points: (N, 3) in the world.
        pixels: (N, 2).
        camera: pinhole.
        seed: not used; OpenCV's sampling has a fixed one.

    Returns:
        None where OpenCV finds no pose.
    """
    import cv2

    if len(points) < 4:
        return None
    try:
        found, rotation_vector, translation, inliers = cv2.solvePnPRansac(
            np.ascontiguousarray(points), np.ascontiguousarray(pixels), camera.K, None
        )
    except cv2.error:  # degenerate samples: some configurations raise instead of returning False
        return None
    if not found or inliers is None or not (np.isfinite(rotation_vector).all() and np.isfinite(translation).all()):
        return None
    mask = np.zeros(len(points), np.bool_)
    mask[inliers.ravel()] = True
    return PoseEstimate(rigid(so3_exp(rotation_vector.ravel()), translation.ravel()), mask)


def with_poselib(points: Float64, pixels: Float64, camera: Camera, seed: int) -> PoseEstimate | None:
    """PoseLib's LO-RANSAC (P3P, local optimisation) with the same inlier threshold and enough iterations.

    Args and returns as `with_opencv`; `seed` is that of its sampling.

    Raises:
        ConfigError: PoseLib is not installed.
    """
    if not poselib_installed():
        raise ConfigError("estimator poselib: PoseLib is not installed here; pip install poselib, or choose usac")
    return _robust(points, pixels, camera, seed, "poselib")


def with_usac(points: Float64, pixels: Float64, camera: Camera, seed: int) -> PoseEstimate | None:
    """OpenCV's USAC, what the odometry uses where PoseLib is not installed; as `with_poselib`."""
    return _robust(points, pixels, camera, seed, "opencv")


def with_robust_solver(points: Float64, pixels: Float64, camera: Camera, seed: int) -> PoseEstimate | None:
    """The robust solver that the odometry uses here: PoseLib where it is installed, else OpenCV's USAC."""
    return _robust(points, pixels, camera, seed, "")


def _robust(points: Float64, pixels: Float64, camera: Camera, seed: int, solver: str) -> PoseEstimate | None:
    if len(points) < 4:
        return None
    ransac = Ransac(REPROJECTION_ERROR, seed, max_iterations=10_000)
    found = robust_solver(solver).absolute_pose(points, pixels, camera, ransac)
    if not np.isfinite(found.pose).all() or found.inliers.sum() < 4:
        return None
    return PoseEstimate(found.pose, found.inliers)


ESTIMATORS: dict[str, Estimator] = {"opencv": with_opencv, "poselib": with_poselib, "usac": with_usac}
