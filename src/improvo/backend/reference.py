"""A slow, plain solver that the tests compare the fast one with: dense normal equations, numeric derivatives, NumPy.

The equation of the objective is not here but in `objective.py`.
"""

from __future__ import annotations

import numpy as np

from improvo.backend.objective import cost, huber_slope, residuals
from improvo.backend.problem import BundleProblem
from improvo.backend.settings import ObjectiveSettings
from improvo.geometry import se3
from improvo.types import Float64

_DIFFERENCE = 1e-6  # step of the central differences, radians and map units


def perturb(problem: BundleProblem, cam_from_world: Float64, points: Float64, step: Float64) -> tuple[Float64, Float64]:
    """Poses and points after a step. A pose is perturbed from the left: R, t become exp(w) R, exp(w) t + v.

    Args:
        problem: its observations, and what is fixed.
        cam_from_world: (N, 4, 4) poses.
        points: (M, 3) world.
        step: (6 F + 3 P,) (v, w) of each free camera, then the move of each free point.
    """
    free_cameras = ~np.asarray(problem.fixed_cameras, np.bool_)
    free_points = problem.free_points
    camera_step = step[: 6 * free_cameras.sum()].reshape(-1, 6)
    new_poses, new_points = np.array(cam_from_world, np.float64), np.array(points, np.float64)
    delta = se3.rigid(se3.so3_exp(camera_step[:, 3:]), camera_step[:, :3])
    new_poses[free_cameras] = delta @ new_poses[free_cameras]
    new_points[free_points] += step[6 * free_cameras.sum() :].reshape(-1, 3)
    return new_poses, new_points


def jacobian(problem: BundleProblem, objective: ObjectiveSettings, cam_from_world: Float64, points: Float64) -> Float64:
    """(4 O, 6 F + 3 P) central differences of the residuals by the step of `perturb`.

    Args:
        problem: its observations, and what is fixed.
        objective: its constants.
        cam_from_world: (N, 4, 4) poses.
        points: (M, 3) world.
    """
    size = 6 * int((~np.asarray(problem.fixed_cameras, np.bool_)).sum()) + 3 * int(problem.free_points.sum())
    columns = np.empty((4 * len(problem.camera_index), size))
    for k in range(size):
        step = np.zeros(size)
        step[k] = _DIFFERENCE
        ahead = residuals(problem, objective, *perturb(problem, cam_from_world, points, step))
        behind = residuals(problem, objective, *perturb(problem, cam_from_world, points, -step))
        columns[:, k] = (ahead - behind).ravel() / (2 * _DIFFERENCE)
    return columns


def normal_equations(
    problem: BundleProblem, objective: ObjectiveSettings, cam_from_world: Float64, points: Float64
) -> tuple[Float64, Float64]:
    """Gauss-Newton Hessian and gradient of half the objective, the Huber loss as re-weighting.

    Args:
        problem: its observations, and what is fixed.
        objective: its constants.
        cam_from_world: (N, 4, 4) poses.
        points: (M, 3) world.
    """
    residual = residuals(problem, objective, cam_from_world, points)
    weight = problem.weights * huber_slope((residual**2).sum(axis=1), objective.huber_width)
    J = jacobian(problem, objective, cam_from_world, points)
    weighted = np.repeat(weight, 4)[:, None] * J
    return J.T @ weighted, weighted.T @ residual.ravel()


def solve_dense(
    problem: BundleProblem, objective: ObjectiveSettings, iterations: int = 50
) -> tuple[Float64, Float64, float]:
    """Levenberg-Marquardt with the simplest damping there is: (poses, points, cost).

    Args:
        problem: where it starts, too.
        objective: its constants.
        iterations: steps, at most.
    """
    poses, points = np.array(problem.cam_from_world), np.array(problem.points)
    best, damping = cost(problem, objective, poses, points), 1e-4
    for _ in range(iterations):
        H, g = normal_equations(problem, objective, poses, points)
        diagonal = np.diag(np.maximum(np.diag(H), 1e-6))
        while damping < 1e12:
            step = np.linalg.solve(H + damping * diagonal, -g).astype(np.float64)
            new_poses, new_points = perturb(problem, poses, points, step)
            new_cost = cost(problem, objective, new_poses, new_points)
            if new_cost < best:
                break
            damping *= 10
        else:
            break
        poses, points, best, damping = new_poses, new_points, new_cost, damping / 10
    return poses, points, best
