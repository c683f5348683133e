"""OpenCV's USAC as the robust solver, where PoseLib is not installed.

USAC's own poses are polished once more over their inliers: its essential matrix has no nonlinear refinement, and the
start of a map depends on a good one.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from improvo.geometry import se3
from improvo.geometry.camera import Camera
from improvo.geometry.epipolar import in_front_of_both, sampson_errors, signed_sampson_errors
from improvo.geometry.ransac import Ransac, RobustHomography, RobustPose
from improvo.types import Float64

_MAX_ITERATIONS = 10_000  # where the caller names none; as PoseLib, USAC stops before when it is sure
_CONFIDENCE = 0.9999  # as PoseLib's
_MIN_LENGTH = 1e-6  # of the translation over the distance of a plane; a homography with less is a rotation
_POLISHING_STEPS, _DIFFERENCE = 5, 1e-7  # of the angles (radians) and the direction, for derivatives
_POLISH_ROUNDS = 2  # polishing moves the threshold's edge, and with it the inliers


class OpenCvSolver:
    """See `RobustSolver`."""

    name = "opencv"

    def absolute_pose(self, points: Float64, pixels: Float64, camera: Camera, ransac: Ransac) -> RobustPose:
        """P3P, refined over the inliers by Levenberg-Marquardt."""
        nothing = RobustPose(np.eye(4), np.zeros(len(points), np.bool_))
        if len(points) < 4:
            return nothing
        points, pixels = np.ascontiguousarray(points), np.ascontiguousarray(pixels)
        try:
            found, _, turn, move, _ = cv2.solvePnPRansac(points, pixels, camera.K, None, params=_params(ransac))
        except cv2.error:  # samples that determine no pose
            return nothing
        if not found or not (np.isfinite(turn).all() and np.isfinite(move).all()):
            return nothing
        pose = se3.rigid(se3.so3_exp(turn.ravel()), move.ravel())
        inliers = _reprojected(pose, points, pixels, camera, ransac.max_error)
        for _ in range(_POLISH_ROUNDS):
            if inliers.sum() < 4:
                return nothing
            turn, move = cv2.solvePnPRefineLM(points[inliers], pixels[inliers], camera.K, None, turn, move)
            polished = se3.rigid(se3.so3_exp(turn.ravel()), move.ravel())
            agree = _reprojected(polished, points, pixels, camera, ransac.max_error)
            if not np.isfinite(polished).all() or agree.sum() < inliers.sum():
                break
            pose, inliers = polished, agree
        return RobustPose(pose, inliers)

    def relative_pose(self, pixels_a: Float64, pixels_b: Float64, camera: Camera, ransac: Ransac) -> RobustPose:
        """Five points; the motion is refined over the inliers on Sampson distances."""
        nothing = RobustPose(np.eye(4), np.zeros(len(pixels_a), np.bool_))
        if len(pixels_a) < 5:
            return nothing
        pixels_a, pixels_b = np.ascontiguousarray(pixels_a), np.ascontiguousarray(pixels_b)
        try:
            essential, _ = cv2.findEssentialMat(pixels_a, pixels_b, camera.K, camera.K, None, None, _params(ransac))
        except cv2.error:  # samples that determine no motion
            return nothing
        if essential is None or essential.shape != (3, 3) or not np.isfinite(essential).all():
            return nothing
        pose, inliers = np.eye(4), nothing.inliers
        for motion in _motions_of_essential(essential):
            agree = _agreeing(motion, camera, pixels_a, pixels_b, ransac.max_error)
            if agree.sum() > inliers.sum():
                pose, inliers = motion, agree
        for _ in range(_POLISH_ROUNDS):
            if inliers.sum() < 6:
                break
            polished = _polished(pose, camera, pixels_a[inliers], pixels_b[inliers], ransac.max_error)
            agree = _agreeing(polished, camera, pixels_a, pixels_b, ransac.max_error)
            if agree.sum() < inliers.sum():
                break
            pose, inliers = polished, agree
        return RobustPose(pose, inliers)

    def homography(self, pixels_a: Float64, pixels_b: Float64, ransac: Ransac) -> RobustHomography:
        """Four points, refined over the inliers."""
        nothing = RobustHomography(np.eye(3), np.zeros(len(pixels_a), np.bool_))
        if len(pixels_a) < 4:
            return nothing
        try:
            matrix, mask = cv2.findHomography(
                np.ascontiguousarray(pixels_a), np.ascontiguousarray(pixels_b), _params(ransac)
            )
        except cv2.error:  # samples on a line
            return nothing
        if matrix is None or not np.isfinite(matrix).all():
            return nothing
        return RobustHomography(matrix, mask.ravel().astype(np.bool_))

    def motions_of_homography(self, b_from_a: Float64, camera: Camera) -> list[Float64]:
        """Up to four motions, with a translation of length 1."""
        _, rotations, translations, _ = cv2.decomposeHomographyMat(b_from_a, camera.K)
        motions = []
        for rotation, translation in zip(rotations, translations, strict=True):
            length = float(np.linalg.norm(translation))
            if length >= _MIN_LENGTH:
                motions.append(se3.rigid(rotation, translation.ravel() / length))
        return motions


def _params(ransac: Ransac) -> Any:
    params = cv2.UsacParams()
    params.threshold = ransac.max_error
    params.confidence = _CONFIDENCE
    params.maxIterations = ransac.max_iterations or _MAX_ITERATIONS
    params.randomGeneratorState = ransac.seed % 2**31
    params.isParallel = False
    params.loMethod = cv2.LOCAL_OPTIM_INNER_LO  # with the iterations too: as exact, and four times slower
    return params


def _reprojected(
    pose: Float64, points: Float64, pixels: Float64, camera: Camera, max_error: float
) -> NDArray[np.bool_]:
    """Which points (N,) lie in front of the camera and within the error of their pixels."""
    in_camera = se3.transform(pose, points)
    front = in_camera[:, 2] > 0
    errors = np.full(len(points), np.inf)
    errors[front] = np.linalg.norm(camera.project(in_camera[front]) - pixels[front], axis=1)
    return errors <= max_error


def _motions_of_essential(essential: Float64) -> list[Float64]:
    """The four motions (4, 4) b_from_a, with a translation of length 1, of an essential matrix."""
    first, second, move = cv2.decomposeEssentialMat(essential)
    return [se3.rigid(turn, sign * move.ravel()) for turn in (first, second) for sign in (1.0, -1.0)]


def _agreeing(
    b_from_a: Float64, camera: Camera, pixels_a: Float64, pixels_b: Float64, max_error: float
) -> NDArray[np.bool_]:
    """Which matches (N,) lie within the error of their epipolar lines and in front of both cameras."""
    near = sampson_errors(b_from_a, camera, pixels_a, pixels_b) < max_error
    return near & in_front_of_both(b_from_a, camera, pixels_a, pixels_b)


def _polished(b_from_a: Float64, camera: Camera, pixels_a: Float64, pixels_b: Float64, scale: float) -> Float64:
    """The motion nearby with least Sampson distance: three angles, and two for the direction of the translation.

    Gauss and Newton's method with differences for derivatives, under the loss 2 (sqrt(1 + z) - 1), z = (2 e / scale)².
    """
    motion = b_from_a
    errors = signed_sampson_errors(motion, camera, pixels_a, pixels_b) / (0.5 * scale)
    for _ in range(_POLISHING_STEPS):
        moved = _motions_around(motion)
        beside = [signed_sampson_errors(moved(one), camera, pixels_a, pixels_b) for one in _DIFFERENCE * np.eye(5)]
        slopes = (np.stack(beside, axis=1) / (0.5 * scale) - errors[:, None]) / _DIFFERENCE
        roots = (1.0 + errors**2) ** -0.25  # of the weights of the observations
        step = np.linalg.lstsq(roots[:, None] * slopes, -roots * errors, rcond=None)[0]
        candidate = moved(np.asarray(step, np.float64))
        its_errors = signed_sampson_errors(candidate, camera, pixels_a, pixels_b) / (0.5 * scale)
        if not np.sqrt(1.0 + its_errors**2).sum() < np.sqrt(1.0 + errors**2).sum():
            break
        motion, errors = candidate, its_errors
    return motion


def _motions_around(b_from_a: Float64) -> Callable[[Float64], Float64]:
    """From three angles and two steps of the direction of the translation (5,) to a motion near this one."""
    rotation, direction = b_from_a[:3, :3], b_from_a[:3, 3]
    across = np.linalg.svd(direction[None])[2][1:]  # (2, 3) an orthonormal basis beside the direction

    def moved(step: Float64) -> Float64:
        move = direction + step[3:] @ across
        return se3.rigid(se3.so3_exp(step[:3]) @ rotation, move / np.linalg.norm(move))

    return moved


SOLVER = OpenCvSolver()
