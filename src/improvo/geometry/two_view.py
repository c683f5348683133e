"""Two-view geometry, and pose from 3D-to-2D matches: the only place that calls PoseLib and does epipolar maths."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import poselib
from numpy.typing import NDArray

from improvo.geometry import se3
from improvo.geometry.camera import Camera
from improvo.types import Float64

_MIN_LENGTH = 1e-6  # of the translation over the distance of a plane; a homography with less is a rotation


@dataclass(frozen=True)
class Ransac:
    """How PoseLib's LO-RANSAC samples, and which matches it accepts."""

    max_error: float  # pixels: reprojection error for a pose or a homography, Sampson distance for a relative pose
    seed: int
    min_iterations: int | None = None  # None: PoseLib's own
    max_iterations: int | None = None  # None: PoseLib's own

    def _options(self, error_name: str) -> dict[str, Any]:
        options = {
            error_name: self.max_error,
            "min_iterations": self.min_iterations,
            "max_iterations": self.max_iterations,
            "seed": self.seed,
        }
        return {name: value for name, value in options.items() if value is not None}


@dataclass(frozen=True)
class RobustPose:
    """A rigid motion, and the matches that agree with it."""

    pose: Float64  # (4, 4) cam_from_world, or b_from_a with a translation of length 1
    inliers: NDArray[np.bool_]  # (N,)


@dataclass(frozen=True)
class RobustHomography:
    """A homography, and the matches that agree with it."""

    b_from_a: Float64  # (3, 3) pixels
    inliers: NDArray[np.bool_]  # (N,)


def absolute_pose(points: Float64, pixels: Float64, camera: Camera, ransac: Ransac) -> RobustPose:
    """The camera's pose from 3D-to-2D matches (P3P).

    Args:
        points: (N, 3) world, at least 4.
        pixels: (N, 2).
        camera: pinhole.
        ransac: sampling and threshold.
    """
    pose, report = poselib.estimate_absolute_pose(
        pixels, points, _described(camera), ransac._options("max_reproj_error"), {}
    )
    return _robust_pose(pose, report)


def relative_pose(pixels_a: Float64, pixels_b: Float64, camera: Camera, ransac: Ransac) -> RobustPose:
    """The motion between two views of one camera from 2D-to-2D matches (five-point algorithm).

    Args:
        pixels_a: (N, 2) pixels in the first view.
        pixels_b: (N, 2) pixels in the second view.
        camera: pinhole, of both.
        ransac: sampling and threshold.

    Returns:
        b_from_a. Inliers also lie in front of both cameras.
    """
    shape = _described(camera)
    options = ransac._options("max_epipolar_error")
    pose, report = poselib.estimate_relative_pose(pixels_a, pixels_b, shape, shape, options, {})
    return _robust_pose(pose, report)


def homography(pixels_a: Float64, pixels_b: Float64, ransac: Ransac) -> RobustHomography:
    """The homography between two views from 2D-to-2D matches.

    Args:
        pixels_a: (N, 2) pixels in the first view.
        pixels_b: (N, 2) pixels in the second view.
        ransac: sampling and threshold.
    """
    matrix, report = poselib.estimate_homography(pixels_a, pixels_b, ransac._options("max_reproj_error"))
    return RobustHomography(np.asarray(matrix), np.asarray(report["inliers"], np.bool_))


def motions_of_homography(b_from_a: Float64, camera: Camera) -> list[Float64]:
    """The motions (4, 4) b_from_a, with a translation of length 1, that a plane's homography (3, 3) stands for.

    Up to four, of which at most two see the plane in front. None where the homography is a pure rotation.
    """
    normalised = np.linalg.inv(camera.K) @ b_from_a @ camera.K
    motions = []
    for pose in poselib.motion_from_homography(normalised)[0]:
        length = float(np.linalg.norm(pose.t))
        if length >= _MIN_LENGTH:
            motions.append(se3.rigid(pose.R, pose.t / length))
    return motions


def rotation_residuals(camera: Camera, pixels_a: Float64, pixels_b: Float64) -> Float64:
    """Pixels (N,) that the best pure rotation of the camera leaves unexplained; robust to moderate outliers.

    Args:
        camera: pinhole, of both views.
        pixels_a: (N, 2) pixels in the first view.
        pixels_b: (N, 2) pixels in the second view.
    """
    rays_a, rays_b = camera.unproject(pixels_a), camera.unproject(pixels_b)
    rays_a /= np.linalg.norm(rays_a, axis=1, keepdims=True)
    rays_b /= np.linalg.norm(rays_b, axis=1, keepdims=True)
    weights = np.ones(len(rays_a))
    residuals = weights
    for _ in range(8):
        b_from_a = se3.nearest_rotation((rays_b * weights[:, None]).T @ rays_a)
        turned = rays_a @ b_from_a.T
        turned[:, 2] = np.maximum(turned[:, 2], 1e-3)
        residuals = np.linalg.norm(camera.project(turned) - pixels_b, axis=1)
        weights = 1.0 / np.maximum(residuals, 1.0)
    return residuals


def sampson_errors(b_from_a: Float64, camera: Camera, pixels_a: Float64, pixels_b: Float64) -> Float64:
    """Sampson distance in pixels (N,) of matches to a relative pose.

    Args:
        b_from_a: (4, 4).
        camera: pinhole, of both views.
        pixels_a: (N, 2) pixels in the first view.
        pixels_b: (N, 2) pixels in the second view.
    """
    essential = skew(b_from_a[:3, 3]) @ b_from_a[:3, :3]
    rays_a, rays_b = camera.unproject(pixels_a), camera.unproject(pixels_b)
    lines_b = rays_a @ essential.T
    lines_a = rays_b @ essential
    algebraic = (rays_b * lines_b).sum(axis=1)
    slope = (lines_b[:, :2] ** 2).sum(axis=1) + (lines_a[:, :2] ** 2).sum(axis=1)
    focal = np.sqrt(camera.fx * camera.fy)
    return focal * np.abs(algebraic) / np.sqrt(np.maximum(slope, 1e-18))


def half_line_distances(b_from_a: Float64, camera: Camera, pixels_a: Float64, pixels_b: Float64) -> Float64:
    """Pixels (N,) between a match in the second view and where its point can be seen there at any depth.

    That is the half of the epipolar line that begins where the point would be at infinity. So a match on the line but
    beyond infinity, with a negative depth, is as far off as it is from there.

    Args:
        b_from_a: (4, 4).
        camera: pinhole, of both views.
        pixels_a: (N, 2) pixels in the first view.
        pixels_b: (N, 2) pixels in the second view.
    """
    far = camera.unproject(pixels_a) @ b_from_a[:3, :3].T
    far /= np.maximum(far[:, 2:], 1e-6)
    t = b_from_a[:3, 3]
    nearer = np.stack([camera.fx * (t[0] - far[:, 0] * t[2]), camera.fy * (t[1] - far[:, 1] * t[2])], axis=1)
    nearer /= np.maximum(np.linalg.norm(nearer, axis=1, keepdims=True), 1e-12)
    offset = pixels_b - camera.project(far)
    along = (offset * nearer).sum(axis=1)
    across = np.abs(offset[:, 0] * nearer[:, 1] - offset[:, 1] * nearer[:, 0])
    distances: Float64 = np.where(along >= 0, across, np.linalg.norm(offset, axis=1))
    return distances


def epipolar_lines(b_from_a: Float64, camera: Camera, pixels_a: Float64) -> Float64:
    """Lines (N, 3) in the second view on which the pixels of the first lie: u x + v y + w = 0 in pixels.

    Args:
        b_from_a: (4, 4).
        camera: pinhole, of both views.
        pixels_a: (N, 2) pixels in the first view.
    """
    inverse_k = np.linalg.inv(camera.K)
    fundamental = inverse_k.T @ skew(b_from_a[:3, 3]) @ b_from_a[:3, :3] @ inverse_k
    return np.column_stack([pixels_a, np.ones(len(pixels_a))]) @ fundamental.T


def skew(vector: Float64) -> Float64:
    """[v], the matrix (3, 3) with [v] x = v × x."""
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


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
