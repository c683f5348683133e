"""Small parts of compiled kernels: the projection of a point, its residual, and Huber's loss of that.

Each becomes part of its callers, in the solver and in the triangulation.
"""
# mypy: disable-error-code="no-untyped-def,no-untyped-call"

from __future__ import annotations

import math

from improvo.compiled import inlined
from improvo.geometry.camera import MIN_DEPTH


@inlined
def point_in_camera(pose, point):
    """R X + t as three numbers."""
    return (
        pose[0, 0] * point[0] + pose[0, 1] * point[1] + pose[0, 2] * point[2] + pose[0, 3],
        pose[1, 0] * point[0] + pose[1, 1] * point[1] + pose[1, 2] * point[2] + pose[1, 3],
        pose[2, 0] * point[0] + pose[2, 1] * point[1] + pose[2, 2] * point[2] + pose[2, 3],
    )


@inlined
def inverse_depth(z):
    """1 / Z, kept finite near the plane of the camera as in the reference objective."""
    if abs(z) >= MIN_DEPTH:
        return 1.0 / z
    return -1.0 / MIN_DEPTH if z < 0.0 else 1.0 / MIN_DEPTH


@inlined
def residual(keypoint, x, y, scale, fx, fy, cx, cy):
    """Projection minus keypoint, in pixels, of a point at (x, y) in the camera; `scale` is its inverse depth."""
    return fx * (x * scale) + cx - keypoint[0], fy * (y * scale) + cy - keypoint[1]


@inlined
def huber(squared_norm, width):
    """rho(s) and its slope rho'(s)."""
    if squared_norm <= width * width:
        return squared_norm, 1.0
    norm = math.sqrt(squared_norm)
    return 2.0 * width * norm - width * width, width / norm
