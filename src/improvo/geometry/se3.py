"""Rigid motions as 4x4 float64 matrices, `a_from_b`: x_a = R x_b + t; leading axes broadcast."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from improvo.types import Float64


def rigid(rotation: Float64, translation: Float64) -> Float64:
    """(..., 4, 4) from rotation (..., 3, 3) and translation (..., 3)."""
    a_from_b = np.zeros((*np.shape(translation)[:-1], 4, 4))
    a_from_b[..., :3, :3] = rotation
    a_from_b[..., :3, 3] = translation
    a_from_b[..., 3, 3] = 1.0
    return a_from_b


def inverse(a_from_b: Float64) -> Float64:
    """(..., 4, 4) b_from_a."""
    rotation_t = np.swapaxes(a_from_b[..., :3, :3], -1, -2)
    return rigid(rotation_t, -(rotation_t @ a_from_b[..., :3, 3:])[..., 0])


def transform(a_from_b: Float64, points_b: Float64) -> Float64:
    """Points (..., N, 3) of frame b in frame a."""
    return points_b @ np.swapaxes(a_from_b[..., :3, :3], -1, -2) + a_from_b[..., None, :3, 3]


def so3_exp(rotation_vector: Float64) -> Float64:
    """(..., 3) axis times angle in radians -> (..., 3, 3)."""
    flat = np.reshape(rotation_vector, (-1, 3))
    return Rotation.from_rotvec(flat).as_matrix().reshape(*np.shape(rotation_vector)[:-1], 3, 3)


def rotation_angle_deg(rotation: Float64) -> Float64:
    """Rotation angle in degrees, exact near zero and near 180 (no arccos)."""
    skew = rotation - np.swapaxes(rotation, -1, -2)
    sine = 0.5 * np.sqrt(skew[..., 2, 1] ** 2 + skew[..., 0, 2] ** 2 + skew[..., 1, 0] ** 2)
    cosine = 0.5 * (np.trace(rotation, axis1=-2, axis2=-1) - 1.0)
    return np.degrees(np.arctan2(sine, cosine))


def nearest_rotation(matrix: Float64) -> Float64:
    """The rotation (..., 3, 3) nearest to a matrix in the Frobenius norm."""
    u, _, vt = np.linalg.svd(matrix)
    u[..., :, 2] *= np.sign(np.linalg.det(u @ vt))[..., None]
    return u @ vt


def quat_xyzw_from_rotation(rotation: Float64) -> Float64:
    """(..., 3, 3) -> (..., 4) unit quaternion x, y, z, w with w >= 0."""
    flat = np.reshape(rotation, (-1, 3, 3))
    return Rotation.from_matrix(flat).as_quat(canonical=True).reshape(*np.shape(rotation)[:-2], 4)


def rotation_from_quat_xyzw(quat_xyzw: Float64) -> Float64:
    """(..., 4) quaternion x, y, z, w of any positive norm -> (..., 3, 3)."""
    flat = np.reshape(quat_xyzw, (-1, 4))
    return Rotation.from_quat(flat).as_matrix().reshape(*np.shape(quat_xyzw)[:-1], 3, 3)
