"""Whether a made truth moves as the depth images say.

The points of one image are lifted by its depth, and the pose of another image follows from them. A reconstruction that
bends, or whose scale differs from place to place, has motions of other lengths. A wrong focal length stretches both in
the same way, so that this check does not see it; `TruthQuality.aspect_change` does where it can be seen at all.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from improvo.evaluation.pose.estimators import with_robust_solver
from improvo.evaluation.truth.structure_from_motion import ReconstructedImage
from improvo.geometry.camera import Camera
from improvo.geometry.depth_sampling import depth_at
from improvo.geometry.se3 import inverse, rotation_angle_deg
from improvo.types import Float32, Float64

MAX_PAIRS = 100
MIN_POINTS = 40  # that both images see, with depth in the first
MIN_BASELINE = 0.05  # of the median depth; shorter motions say nothing about length


@dataclass(frozen=True)
class MotionCheck:
    """Motions by depth against those of the reconstruction."""

    pairs: int  # that were long enough to compare
    length_ratio: float  # median length of the motion by depth over that of the reconstruction; 1 where they agree
    rotation_deg: float  # median difference


def check_motion(
    images: tuple[ReconstructedImage, ...],
    camera: Camera,
    depth: Callable[[int], Float32 | None],
    scale: float,
    seed: int = 0,
) -> MotionCheck | None:
    """Compare motions over about a tenth of the images.

    Args:
        images: of the reconstruction.
        camera: of the raw images.
        depth: for an image's place in `images`, its depth (H, W) in metres, NaN where missing; None without one.
        scale: metres per unit of the reconstruction.
        seed: of the solver.

    Returns:
        None where no pair moves enough.
    """
    pinhole = camera.pinhole()
    ratios, angles = [], []
    steps = sorted({max(len(images) // part, 1) for part in (20, 10, 5)})
    per_step = MAX_PAIRS // len(steps)
    for step in steps:
        last = len(images) - step
        for a in np.unique(np.linspace(0, last - 1, min(last, per_step)).round().astype(int)).tolist():
            first, second = images[a], images[a + step]
            true = scaled(second.cam_from_world, scale) @ inverse(scaled(first.cam_from_world, scale))
            length = float(np.linalg.norm(true[:3, 3]))
            _, rows_a, rows_b = np.intersect1d(first.points, second.points, return_indices=True)
            if len(rows_a) < MIN_POINTS or length < MIN_BASELINE * scale * float(np.median(first.depth)):
                continue
            measured = depth(a)
            if measured is None:
                continue
            z = depth_at(first.pixels[rows_a].astype(np.float32), measured)
            known = np.isfinite(z)
            if known.sum() < MIN_POINTS:
                continue
            lifted = pinhole.unproject(undistorted(first.pixels[rows_a][known], camera), z[known])
            pixels = undistorted(second.pixels[rows_b][known], camera)
            found = with_robust_solver(lifted, pixels, pinhole, seed)
            if found is None:
                continue
            own, by_depth = (inverse(motion)[:3, 3] for motion in (true, found.cam_from_world))
            ratios.append(float(own @ by_depth) / length**2)
            angles.append(float(rotation_angle_deg(true[:3, :3].T @ found.cam_from_world[:3, :3])))
    if not ratios:
        return None
    return MotionCheck(len(ratios), float(np.median(ratios)), float(np.median(angles)))


def scaled(cam_from_world: Float64, scale: float) -> Float64:
    """A pose (4, 4) in metres."""
    pose = np.array(cam_from_world)
    pose[:3, 3] *= scale
    return pose


def undistorted(pixels: Float64, camera: Camera) -> Float64:
    """Pixels (N, 2) of the raw image where a pinhole of the same K would have them."""
    if camera.is_pinhole or len(pixels) == 0:
        return pixels
    distortion = np.array(camera.distortion)
    return np.asarray(cv2.undistortPoints(pixels[:, None], camera.K, distortion, P=camera.K), np.float64)[:, 0]
