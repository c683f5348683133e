"""Epipolar maths of two views of one camera, and what a pure rotation leaves unexplained."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from improvo.geometry import se3
from improvo.geometry.camera import Camera
from improvo.types import Float64


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
    """Sampson distance in pixels (N,) of matches to a relative pose; arguments as `signed_sampson_errors`."""
    return np.abs(signed_sampson_errors(b_from_a, camera, pixels_a, pixels_b))


def signed_sampson_errors(b_from_a: Float64, camera: Camera, pixels_a: Float64, pixels_b: Float64) -> Float64:
    """Sampson distance in pixels (N,) of matches to a relative pose, with the sign of the epipolar equation.

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
    return focal * algebraic / np.sqrt(np.maximum(slope, 1e-18))


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


def in_front_of_both(b_from_a: Float64, camera: Camera, pixels_a: Float64, pixels_b: Float64) -> NDArray[np.bool_]:
    """Whether the rays of each match (N,) come nearest to each other in front of both cameras.

    Args:
        b_from_a: (4, 4).
        camera: pinhole, of both views.
        pixels_a: (N, 2) pixels in the first view.
        pixels_b: (N, 2) pixels in the second view.
    """
    rays_a, rays_b = camera.unproject(pixels_a) @ b_from_a[:3, :3].T, camera.unproject(pixels_b)
    move = b_from_a[:3, 3]
    normals = np.cross(rays_a, rays_b)  # depth_a ray_a + move = depth_b ray_b, times one ray and the other
    depth_a = (np.cross(move, rays_b) * -normals).sum(axis=1)
    depth_b = (np.cross(rays_a, move) * normals).sum(axis=1)
    return (depth_a > 0) & (depth_b > 0)


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
