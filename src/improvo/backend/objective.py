"""The objective of the paper, written for readers. The compiled solver is tested against it.

    Omega = sum_ij w_ij rho(e_ij^2 + d(Z_ij))                                     (paper, eq. ba-obj)

e_ij^2 + d(Z_ij) is the squared norm of one residual vector per observation, in this order:

    u - u_ij, v - v_ij                pixels, eq. reprojection
    max(0, Z - depth_max)             eq. depth_regularization, times sqrt(depth_weight)
    min(0, Z - depth_min)

rho is the Huber loss of that squared norm: Ceres calls it HuberLoss, and w_ij ScaledLoss (Ceres reports half of the
sum). A point behind the camera keeps its mirrored projection, as in the paper's equations. Only the depth term
penalises it, so callers drop points that end up there. The projection is undefined in the plane of the camera; within
MIN_DEPTH of that plane, the depth is replaced by MIN_DEPTH on the same side.
"""

from __future__ import annotations

import numpy as np

from improvo.backend.problem import BundleProblem
from improvo.backend.settings import ObjectiveSettings
from improvo.geometry.camera import MIN_DEPTH
from improvo.types import Float64


def points_in_cameras(problem: BundleProblem, cam_from_world: Float64, points: Float64) -> Float64:
    """R_i X_j + t_i of every observation (O, 3).

    Args:
        problem: its observations, weights and K; its own poses and points are not used.
        cam_from_world: (N, 4, 4) poses.
        points: (M, 3) world.
    """
    pose = cam_from_world[problem.camera_index]
    return np.einsum("oij,oj->oi", pose[:, :3, :3], points[problem.point_index]) + pose[:, :3, 3]


def away_from_zero(depth: Float64) -> Float64:
    """The depth, moved to at least MIN_DEPTH from zero on its own side (zero counts as in front)."""
    side = np.where(depth < 0, -1.0, 1.0)
    return np.where(np.abs(depth) < MIN_DEPTH, side * MIN_DEPTH, depth)


def residuals(
    problem: BundleProblem, objective: ObjectiveSettings, cam_from_world: Float64, points: Float64
) -> Float64:
    """(O, 4) residual vectors; the squared norm of a row is e_ij^2 + d(Z_ij).

    Args:
        problem: its observations, weights and K; its own poses and points are not used.
        objective: its constants.
        cam_from_world: (N, 4, 4) poses.
        points: (M, 3) world.
    """
    K = problem.K
    x, y, z = points_in_cameras(problem, cam_from_world, points).T
    z_safe = away_from_zero(z)
    scale = np.sqrt(objective.depth_weight)
    return np.stack(
        [
            K[0, 0] * x / z_safe + K[0, 2] - problem.keypoints[:, 0],
            K[1, 1] * y / z_safe + K[1, 2] - problem.keypoints[:, 1],
            scale * np.maximum(z - objective.depth_max, 0.0),
            scale * np.minimum(z - objective.depth_min, 0.0),
        ],
        axis=1,
    )


def huber(squared_norm: Float64, width: float) -> Float64:
    """rho(s): s up to width^2, then 2 width sqrt(s) - width^2, which continues it with equal slope."""
    s = np.asarray(squared_norm, np.float64)
    return np.where(s <= width**2, s, 2 * width * np.sqrt(np.maximum(s, 0.0)) - width**2)


def huber_slope(squared_norm: Float64, width: float) -> Float64:
    """rho'(s), by which least squares re-weights the observation."""
    s = np.asarray(squared_norm, np.float64)
    return np.where(s <= width**2, 1.0, width / np.sqrt(np.maximum(s, width**2)))


def cost(problem: BundleProblem, objective: ObjectiveSettings, cam_from_world: Float64, points: Float64) -> float:
    """The objective Omega.

    Args:
        problem: its observations, weights and K; its own poses and points are not used.
        objective: its constants.
        cam_from_world: (N, 4, 4) poses.
        points: (M, 3) world.
    """
    squared_norm = (residuals(problem, objective, cam_from_world, points) ** 2).sum(axis=1)
    return float(problem.weights @ huber(squared_norm, objective.huber_width))


def reprojection_errors(problem: BundleProblem, cam_from_world: Float64, points: Float64) -> Float64:
    """e_ij of every observation (O,), pixels.

    Args:
        problem: its observations, weights and K; its own poses and points are not used.
        cam_from_world: (N, 4, 4) poses.
        points: (M, 3) world.
    """
    return np.hypot(*residuals(problem, ObjectiveSettings(depth_weight=0.0), cam_from_world, points)[:, :2].T)
