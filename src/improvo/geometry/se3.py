"""Rigid motions as 4x4 float64 matrices, `a_from_b`: x_a = R x_b + t; leading axes broadcast."""

from __future__ import annotations

import numpy as np

from improvo.types import Float64

_SMALL_ANGLE = 1e-3  # radians; below it, series, whose next term is beyond float64
_ORTHONORMAL = 1e-12  # a matrix that is farther from a rotation is replaced by the nearest one


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
    vector = np.asarray(rotation_vector, np.float64)
    angle = np.linalg.norm(vector, axis=-1, keepdims=True)
    small = angle <= _SMALL_ANGLE
    series = 0.5 - angle**2 / 48 + angle**4 / 3840
    share = np.where(small, series, np.sin(0.5 * angle) / np.where(small, 1.0, angle))
    return rotation_from_quat_xyzw(np.concatenate([share * vector, np.cos(0.5 * angle)], axis=-1))


def so3_log(rotation: Float64) -> Float64:
    """(..., 3, 3) -> (..., 3) axis times angle in radians, at most pi."""
    quat = quat_xyzw_from_rotation(rotation)
    sine = np.linalg.norm(quat[..., :3], axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, quat[..., 3:])
    small = angle <= _SMALL_ANGLE
    series = 2.0 + angle**2 / 12 + 7 * angle**4 / 2880
    return np.where(small, series, angle / np.where(small, 1.0, np.sin(0.5 * angle))) * quat[..., :3]


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
    """(..., 3, 3) -> (..., 4) unit quaternion x, y, z, w with w >= 0.

    Of the four ways to take it from the matrix, the one that divides by the largest number (Shepperd 1978).
    """
    matrix = np.array(rotation, np.float64)
    gram = matrix @ np.swapaxes(matrix, -1, -2)
    skewed = (np.abs(gram - np.eye(3)) > _ORTHONORMAL).any(axis=(-1, -2))
    if skewed.any():
        matrix[skewed] = nearest_rotation(matrix[skewed])
    trace = np.trace(matrix, axis1=-2, axis2=-1)[..., None]
    largest = np.argmax(np.concatenate([np.diagonal(matrix, axis1=-2, axis2=-1), trace], axis=-1), axis=-1)
    quat = np.empty((*matrix.shape[:-2], 4))
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        rows, m = largest == i, matrix[largest == i]
        quat[rows, i] = 1.0 - trace[rows, 0] + 2.0 * m[:, i, i]
        quat[rows, j] = m[:, j, i] + m[:, i, j]
        quat[rows, k] = m[:, k, i] + m[:, i, k]
        quat[rows, 3] = m[:, k, j] - m[:, j, k]
    rows, m = largest == 3, matrix[largest == 3]
    quat[rows, 0] = m[:, 2, 1] - m[:, 1, 2]
    quat[rows, 1] = m[:, 0, 2] - m[:, 2, 0]
    quat[rows, 2] = m[:, 1, 0] - m[:, 0, 1]
    quat[rows, 3] = 1.0 + trace[rows, 0]
    quat /= np.linalg.norm(quat, axis=-1, keepdims=True)
    return np.where(quat[..., 3:] < 0, -quat, quat)


def rotation_from_quat_xyzw(quat_xyzw: Float64) -> Float64:
    """(..., 4) quaternion x, y, z, w of any positive norm -> (..., 3, 3).

    Raises:
        ValueError: a quaternion of norm 0.
    """
    quat = np.asarray(quat_xyzw, np.float64)
    norm = np.linalg.norm(quat, axis=-1, keepdims=True)
    if (norm == 0).any():
        raise ValueError("a quaternion is zero")
    x, y, z, w = np.moveaxis(quat / norm, -1, 0)
    rows = (
        (x * x - y * y - z * z + w * w, 2 * (x * y - z * w), 2 * (x * z + y * w)),
        (2 * (x * y + z * w), -x * x + y * y - z * z + w * w, 2 * (y * z - x * w)),
        (2 * (x * z - y * w), 2 * (y * z + x * w), -x * x - y * y + z * z + w * w),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
