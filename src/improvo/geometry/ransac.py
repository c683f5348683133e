"""Poses and homographies from matches of which some are wrong: one interface over PoseLib and OpenCV.

PoseLib is the default. It has no packages for some platforms (Linux on ARM among them); there, and wherever it is not
installed, OpenCV's USAC takes its place. Results of the two differ in their last digits, not in what they mean.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from importlib import import_module
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from improvo.errors import installed
from improvo.geometry.camera import Camera
from improvo.types import Float64


@dataclass(frozen=True)
class Ransac:
    """How RANSAC samples, and which matches it accepts."""

    max_error: float  # pixels: reprojection error for a pose or a homography, Sampson distance for a relative pose
    seed: int
    min_iterations: int | None = None  # None: the library's own; OpenCV has no such limit
    max_iterations: int | None = None  # None: the library's own


@dataclass(frozen=True)
class RobustPose:
    """A rigid motion, and the matches that agree with it; none where too few agree."""

    pose: Float64  # (4, 4) cam_from_world, or b_from_a with a translation of length 1
    inliers: NDArray[np.bool_]  # (N,)


@dataclass(frozen=True)
class RobustHomography:
    """A homography, and the matches that agree with it; none where too few agree."""

    b_from_a: Float64  # (3, 3) pixels
    inliers: NDArray[np.bool_]  # (N,)


class RobustSolver(Protocol):
    """A library that estimates from matches with outliers; same input and seed give the same bits."""

    name: str

    def absolute_pose(self, points: Float64, pixels: Float64, camera: Camera, ransac: Ransac) -> RobustPose:
        """As the function of this module."""

    def relative_pose(self, pixels_a: Float64, pixels_b: Float64, camera: Camera, ransac: Ransac) -> RobustPose:
        """As the function of this module."""

    def homography(self, pixels_a: Float64, pixels_b: Float64, ransac: Ransac) -> RobustHomography:
        """As the function of this module."""

    def motions_of_homography(self, b_from_a: Float64, camera: Camera) -> list[Float64]:
        """As the function of this module."""


def poselib_installed() -> bool:
    """Whether PoseLib can be imported here."""
    return installed("poselib")


@cache
def robust_solver(name: str = "") -> RobustSolver:
    """A solver by its name, `poselib` or `opencv`; without a name PoseLib where it is installed, else OpenCV.

    Raises:
        ImportError: PoseLib was asked for and is not installed.
    """
    name = name or ("poselib" if poselib_installed() else "opencv")
    solver: RobustSolver = import_module(f"improvo.geometry.ransac_{name}").SOLVER
    return solver


def absolute_pose(points: Float64, pixels: Float64, camera: Camera, ransac: Ransac) -> RobustPose:
    """The camera's pose from 3D-to-2D matches (P3P).

    Args:
        points: (N, 3) world, at least 4.
        pixels: (N, 2).
        camera: pinhole.
        ransac: sampling and threshold.
    """
    return robust_solver().absolute_pose(points, pixels, camera, ransac)


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
    return robust_solver().relative_pose(pixels_a, pixels_b, camera, ransac)


def homography(pixels_a: Float64, pixels_b: Float64, ransac: Ransac) -> RobustHomography:
    """The homography between two views from 2D-to-2D matches.

    Args:
        pixels_a: (N, 2) pixels in the first view.
        pixels_b: (N, 2) pixels in the second view.
        ransac: sampling and threshold.
    """
    return robust_solver().homography(pixels_a, pixels_b, ransac)


def motions_of_homography(b_from_a: Float64, camera: Camera) -> list[Float64]:
    """The motions (4, 4) b_from_a, with a translation of length 1, that a plane's homography (3, 3) stands for.

    Up to four, of which at most two see the plane in front. None where the homography is a pure rotation.
    """
    return robust_solver().motions_of_homography(b_from_a, camera)
