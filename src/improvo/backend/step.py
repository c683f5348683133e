"""Taking a step: the left perturbation of the poses, and the decrease that the linear model predicts."""
# mypy: disable-error-code="no-untyped-def,no-untyped-call"

from __future__ import annotations

import math

from improvo.backend.linearise import evaluate
from improvo.compiled import compiled


@compiled
def try_step(constants, observations, system, damping, min_diagonal, poses, points, new_poses, new_points):
    """Write the state after the step; its cost, and the decrease of half the cost that the linear model promises."""
    _apply_step(observations, system, poses, points, new_poses, new_points)
    return evaluate(constants, observations, new_poses, new_points), _predicted_decrease(system, damping, min_diagonal)


@compiled
def _apply_step(observations, system, poses, points, new_poses, new_points):
    """new = exp(w) pose + v for the free cameras, point + dX for the points; the rest is copied."""
    new_poses[:] = poses
    for number in range(len(observations.camera_of_free)):
        camera = observations.camera_of_free[number]
        _perturb(poses[camera], system.camera_step[number], new_poses[camera])
    for j in range(len(points)):
        for i in range(3):
            new_points[j, i] = points[j, i] + system.point_step[j, i]


@compiled
def _perturb(pose, step, new_pose):
    """Rotate R and t by the unit quaternion of w, re-normalise R by Gram-Schmidt, add v."""
    wx, wy, wz = step[3], step[4], step[5]
    angle = math.sqrt(wx * wx + wy * wy + wz * wz)
    share = math.sin(0.5 * angle) / angle if angle > 1e-12 else 0.5
    qw, qx, qy, qz = math.cos(0.5 * angle), share * wx, share * wy, share * wz
    e00, e01, e02 = 1.0 - 2.0 * (qy * qy + qz * qz), 2.0 * (qx * qy - qz * qw), 2.0 * (qx * qz + qy * qw)
    e10, e11, e12 = 2.0 * (qx * qy + qz * qw), 1.0 - 2.0 * (qx * qx + qz * qz), 2.0 * (qy * qz - qx * qw)
    e20, e21, e22 = 2.0 * (qx * qz - qy * qw), 2.0 * (qy * qz + qx * qw), 1.0 - 2.0 * (qx * qx + qy * qy)
    for k in range(4):
        p0, p1, p2 = pose[0, k], pose[1, k], pose[2, k]
        new_pose[0, k] = e00 * p0 + e01 * p1 + e02 * p2
        new_pose[1, k] = e10 * p0 + e11 * p1 + e12 * p2
        new_pose[2, k] = e20 * p0 + e21 * p1 + e22 * p2
    for i in range(3):
        new_pose[i, 3] += step[i]
    _orthonormalise(new_pose)


@compiled
def _orthonormalise(pose):
    """Rows of R back to unit length and right angles, so that rounding never adds up over many steps."""
    a, b, c = pose[0, :3], pose[1, :3], pose[2, :3]
    norm = math.sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2])
    for k in range(3):
        a[k] /= norm
    along = a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
    for k in range(3):
        b[k] -= along * a[k]
    norm = math.sqrt(b[0] * b[0] + b[1] * b[1] + b[2] * b[2])
    for k in range(3):
        b[k] /= norm
    c[0] = a[1] * b[2] - a[2] * b[1]
    c[1] = a[2] * b[0] - a[0] * b[2]
    c[2] = a[0] * b[1] - a[1] * b[0]


@compiled
def _predicted_decrease(system, damping, min_diagonal):
    """Half of (damping * step^T D step - gradient^T step): the decrease of half the objective, were it quadratic."""
    total = 0.0
    for camera in range(len(system.camera_step)):
        for i in range(6):
            step = system.camera_step[camera, i]
            diagonal = max(system.camera_hessian[camera, i, i], min_diagonal)
            total += step * (damping * diagonal * step - system.camera_gradient[camera, i])
    for j in range(len(system.point_step)):
        for i in range(3):
            step = system.point_step[j, i]
            entry = 0 if i == 0 else (3 if i == 1 else 5)
            diagonal = max(system.point_hessian[j, entry], min_diagonal)
            total += step * (damping * diagonal * step - system.point_gradient[j, i])
    return 0.5 * total
