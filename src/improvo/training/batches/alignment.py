"""Correspondences by depth, moved to where the pictures agree.

Depth and poses of an odometry put a point some pixels beside its place in a frame two seconds later. A patch about the
point in one picture, seen as the surface is seen in the other (an affine map, from the depth), is laid over the other
picture by Gauss-Newton steps (Baker and Matthews, inverse compositional), first in the halved pictures. The places at
which patches agree then tell by how much the motion between the two frames is off; by the motion so corrected those
that went to something else are found, and the points whose patches tell nothing are moved too.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from improvo.geometry import se3
from improvo.training.batches.picture_store import PictureStore
from improvo.training.batches.posed_frames import PosedFrames
from improvo.training.held_settings import AlignmentSettings
from improvo.types import Float64, Int64

_LARGEST_STEP = 2.0  # pixels of the level
_SHRINKS_AT_MOST = 0.2  # determinant of a local warp; beyond it, and its inverse, patches cannot be compared
_MOTION_STEPS = 6


class Aligned(NamedTuple):
    """Places (P, N, 2) of frames b that show what places of frames a show."""

    places: Tensor  # (P, N, 2) pixels
    certain: Tensor  # (P, N) bool: the patches agree there, and the motion of the pair explains it
    contradicted: Tensor  # (P, N) bool: the patches agree at a place that the motion does not explain


class _Patches(NamedTuple):
    """Patches of frames a on a level, ready to be laid over frames b."""

    grey: Tensor  # (P, N, K) about their mean
    slopes: Tensor  # (P, N, K, 2) by pixels of b, about their mean
    inverse_hessian: Tensor  # (P, N, 2, 2)
    texture: Tensor  # (P, N) the weaker gradient in a, root mean square


def aligned(
    store: PictureStore, frames: PosedFrames, rows: Int64, in_a: Tensor, inverse: Tensor, settings: AlignmentSettings
) -> Aligned:
    """Move correspondences to where the pictures agree.

    Args:
        store: its first pictures are those of `frames`.
        frames: poses and depths.
        rows: (P, 2) frames a, b.
        in_a: (P, N, 2) pixels of a.
        inverse: (P, N) inverse depth in a; 0 where unknown.
        settings: all numbers.
    """
    carried = frames.carry(rows, in_a, inverse)
    warp = frames.local_warps(rows, in_a, inverse)
    determinant = warp[..., 0, 0] * warp[..., 1, 1] - warp[..., 0, 1] * warp[..., 1, 0]
    seen = carried.ahead & (determinant > _SHRINKS_AT_MOST) & (determinant < 1 / _SHRINKS_AT_MOST)
    warp = torch.where(seen[..., None, None], warp, torch.eye(2, device=warp.device))
    start = torch.where(seen[..., None], carried.places, 0.0)
    places, score, texture = start, torch.zeros_like(inverse), torch.zeros_like(inverse)
    for level in (1, 0):
        places, score, texture = _laid_over(store, rows, in_a, places, warp, level, settings)
    moved = (places - start).norm(dim=-1)
    agree = seen & (score >= settings.least_score) & (texture >= settings.least_texture)
    agree &= moved <= settings.most_moved
    corrected, explained = _same_motion(frames, rows, in_a, inverse, places, agree, settings)
    enough = explained.sum(dim=1, keepdim=True) >= settings.least_together
    certain = enough & explained
    usual = torch.where(enough[..., None], corrected, carried.places)
    return Aligned(torch.where(certain[..., None], places, usual), certain, enough & agree & ~explained)


def _laid_over(
    store: PictureStore,
    rows: Int64,
    in_a: Tensor,
    places: Tensor,
    warp: Tensor,
    level: int,
    settings: AlignmentSettings,
) -> tuple[Tensor, Tensor, Tensor]:
    """Places (P, N, 2) in b after the steps on one level, their scores and the texture of the patches (P, N)."""
    side = torch.arange(-settings.radius, settings.radius + 1, dtype=torch.float32, device=in_a.device)
    offsets = torch.stack(torch.meshgrid(side, side, indexing="xy"), dim=-1).reshape(-1, 2)
    patches = _patches(store, rows[:, 0], store.on_level(rows[:, 0], in_a, level), warp, level, settings)
    about = offsets @ warp.transpose(-1, -2)  # (P, N, K, 2) in b
    where = store.on_level(rows[:, 1], places, level)
    own = patches.grey.square().sum(dim=-1)
    score = torch.zeros_like(own)
    for step in range(settings.steps + 1):
        found = store.grey(rows[:, 1], where[:, :, None] + about, level)
        found = found - found.mean(dim=-1, keepdim=True)
        other = found.square().sum(dim=-1)
        scale = torch.rsqrt((own * other).clamp(min=1e-6))
        score = (patches.grey * found).sum(dim=-1) * scale
        if step == settings.steps:
            break
        error = found * (own * scale)[..., None] - patches.grey
        gradient = (patches.slopes * error[..., None]).sum(dim=2)
        change = (patches.inverse_hessian @ gradient[..., None])[..., 0]
        where = where - change.clamp(-_LARGEST_STEP, _LARGEST_STEP)
    return store.off_level(rows[:, 1], where, level), score, patches.texture


def _patches(
    store: PictureStore, rows: Int64, middles: Tensor, warp: Tensor, level: int, settings: AlignmentSettings
) -> _Patches:
    reach = settings.radius + 1
    side = torch.arange(-reach, reach + 1, dtype=torch.float32, device=middles.device)
    offsets = torch.stack(torch.meshgrid(side, side, indexing="xy"), dim=-1).reshape(-1, 2)
    width = 2 * reach + 1
    grey = store.grey(rows, middles[:, :, None] + offsets, level).unflatten(-1, (width, width))
    to_right = 0.5 * (grey[..., 1:-1, 2:] - grey[..., 1:-1, :-2]).flatten(-2)
    downwards = 0.5 * (grey[..., 2:, 1:-1] - grey[..., :-2, 1:-1]).flatten(-2)
    own = grey[..., 1:-1, 1:-1].flatten(-2)
    gradient = torch.stack([to_right, downwards], dim=-1)  # (P, N, K, 2) by pixels of a
    second = (gradient.transpose(-1, -2) @ gradient) / gradient.shape[2]
    middle, difference = 0.5 * (second[..., 0, 0] + second[..., 1, 1]), 0.5 * (second[..., 0, 0] - second[..., 1, 1])
    weaker = middle - torch.sqrt(difference.square() + second[..., 0, 1].square())
    slopes = gradient @ torch.linalg.inv(warp)
    slopes = slopes - slopes.mean(dim=2, keepdim=True)
    hessian = slopes.transpose(-1, -2) @ slopes
    inverse = torch.linalg.inv(hessian + 1e-2 * torch.eye(2, device=middles.device))
    return _Patches(own - own.mean(dim=-1, keepdim=True), slopes, inverse, weaker.clamp(min=0).sqrt())


def _same_motion(
    frames: PosedFrames,
    rows: Int64,
    in_a: Tensor,
    inverse: Tensor,
    places: Tensor,
    agree: Tensor,
    settings: AlignmentSettings,
) -> tuple[Tensor, Tensor]:
    """Places by the motions that explain most of those that agree, and which of those (P, N) they explain."""
    motion = frames.b_from_a(rows)
    known = inverse.cpu().numpy().astype(np.float64)
    pixels = in_a.cpu().numpy().astype(np.float64)
    wanted, used = places.cpu().numpy().astype(np.float64), agree.cpu().numpy()
    for pair, (a, b) in enumerate(rows):
        chosen = used[pair] & (known[pair] > 0)
        if chosen.sum() >= settings.least_together:
            rays = np.column_stack([pixels[pair, chosen], np.ones(chosen.sum())]) @ np.linalg.inv(frames.K[a]).T
            points = rays / known[pair, chosen, None]
            motion[pair] = _refined(motion[pair], points, wanted[pair, chosen], frames.K[b], settings.same_motion)
    corrected = frames.carry(rows, in_a, inverse, motion).places
    return corrected, agree & ((corrected - places).norm(dim=-1) < settings.same_motion)


def _refined(b_from_a: Float64, points: Float64, pixels: Float64, K: Float64, scale: float) -> Float64:
    """The motion whose projections of points (N, 3) of a lie nearest to pixels (N, 2) of b, outliers weighing less."""
    for _ in range(_MOTION_STEPS):
        x, y, z = se3.transform(b_from_a, points).T
        z = np.maximum(z, 1e-6)
        u, v = x / z, y / z
        error = np.stack([K[0, 0] * u + K[0, 2], K[1, 1] * v + K[1, 2]], axis=1) - pixels
        weight = 1 / (1 + (error**2).sum(axis=1) / (0.5 * scale) ** 2)  # Cauchy's
        zero = np.zeros_like(u)
        by_motion = np.stack(
            [
                np.stack([1 / z, zero, -u / z, -u * v, 1 + u * u, -v], axis=1) * K[0, 0],
                np.stack([zero, 1 / z, -v / z, -1 - v * v, u * v, u], axis=1) * K[1, 1],
            ],
            axis=1,
        )  # (N, 2, 6)
        normal = np.einsum("nki,n,nkj->ij", by_motion, weight, by_motion)
        right = np.einsum("nki,n,nk->i", by_motion, weight, error)
        step = np.linalg.solve(normal + 1e-9 * np.trace(normal) * np.eye(6), -right)
        b_from_a = se3.rigid(se3.so3_exp(step[3:]), step[:3]) @ b_from_a
    return b_from_a
