"""Aligning an estimated trajectory with the truth (Umeyama 1991)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from improvo.errors import InputError
from improvo.types import Float64


@dataclass(frozen=True)
class Similarity:
    """x_a = scale * rotation @ x_b + translation."""

    scale: float
    rotation: Float64  # (3, 3)
    translation: Float64  # (3,)

    def apply(self, points: Float64) -> Float64:
        """Points (..., 3) of frame b in frame a."""
        return self.scale * points @ self.rotation.T + self.translation

    def apply_to_poses(self, b_from_cam: Float64) -> Float64:
        """Camera-to-b poses (N, 4, 4) as camera-to-a poses; the cameras keep their own metric."""
        a_from_cam = np.array(b_from_cam)
        a_from_cam[:, :3, :3] = self.rotation @ b_from_cam[:, :3, :3]
        a_from_cam[:, :3, 3] = self.apply(b_from_cam[:, :3, 3])
        return a_from_cam

    def inverse(self) -> Similarity:
        """Frame b from frame a.

        Raises:
            ZeroDivisionError: the scale is 0.
        """
        scale = 1.0 / self.scale
        return Similarity(scale, self.rotation.T, -scale * self.rotation.T @ self.translation)

    def after(self, other: Similarity) -> Similarity:
        """Frame a from frame c, where `other` is frame b from frame c."""
        return Similarity(self.scale * other.scale, self.rotation @ other.rotation, self.apply(other.translation))


def align_points(target: Float64, source: Float64, with_scale: bool) -> Similarity:
    """The similarity (or rigid motion) that carries one set of points onto another, least squares.

    Args:
        target: (N, 3).
        source: (N, 3), row by row the same points in another frame.
        with_scale: find the scale too; else it is 1.

    Raises:
        InputError: fewer than three points, or all of the source on one spot. Where those of the target are, the scale
            found is 0; on one line, the rotation about it is any.
    """
    if len(target) < 3:
        raise InputError(f"alignment needs at least 3 common poses, there are {len(target)}")
    target_mean, source_mean = target.mean(axis=0), source.mean(axis=0)
    target_centred, source_centred = target - target_mean, source - source_mean
    variance = float((source_centred**2).sum() / len(source))
    if variance < 1e-18:
        raise InputError("alignment is undefined: all positions of the estimate coincide")
    u, singular_values, vt = np.linalg.svd(target_centred.T @ source_centred / len(source))
    signs = np.ones(3)
    signs[2] = np.sign(np.linalg.det(u) * np.linalg.det(vt))
    rotation = u @ np.diag(signs) @ vt
    scale = float(singular_values @ signs) / variance if with_scale else 1.0
    return Similarity(scale, rotation, target_mean - scale * rotation @ source_mean)


def path_length(positions: Float64) -> float:
    """From the first of positions (N, 3) along all to the last."""
    return float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum())


def path_lengths(positions: Float64) -> Float64:
    """Distance travelled (N,) up to each of the positions (N, D)."""
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])
