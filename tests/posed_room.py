"""A posed sequence with exact depth, made in a moment: a textured slanted wall with a smaller panel before it."""

from __future__ import annotations

import cv2
import numpy as np

from improvo.training.data.posed_sequence import PosedSequence, block_inverse_depth
from improvo.types import Float64, UInt8

K = np.array([[150.0, 0.0, 79.5], [0.0, 150.0, 59.5], [0.0, 0.0, 1.0]])
SIZE = (160, 120)
# normal, distance, and whether it is the small panel
_PLANES = ((np.array([0.15, 0.0, 1.0]), 3.0, False), (np.array([0.0, 0.1, 1.0]), 1.8, True))


def posed_room(frames: int = 6, seed: int = 0) -> PosedSequence:
    """A camera that moves sideways and turns a little, a second a frame."""
    rng = np.random.default_rng(seed)
    textures = [_texture(rng) for _ in _PLANES]
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, 0, 3] = 0.12 * np.arange(frames)
    turn = 0.02 * np.arange(frames)
    poses[:, 0, 0] = poses[:, 2, 2] = np.cos(turn)
    poses[:, 0, 2], poses[:, 2, 0] = -np.sin(turn), np.sin(turn)
    shown = [_render(pose, textures) for pose in poses]
    pictures = tuple(picture for picture, _ in shown)
    depths = tuple(block_inverse_depth(depth) for _, depth in shown)
    return PosedSequence(f"room-{seed}", pictures, np.arange(frames, dtype=np.float64), K, poses, depths)


def _render(world_from_cam: Float64, textures: list[UInt8]) -> tuple[UInt8, Float64]:
    """Picture, and depth along the axis."""
    x, y = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(K).T @ world_from_cam[:3, :3].T
    picture, nearest = np.zeros(SIZE[::-1], np.uint8), np.full(SIZE[::-1], np.inf)
    for (normal, distance, small), texture in zip(_PLANES, textures, strict=True):
        depth = (distance - world_from_cam[:3, 3] @ normal) / (rays @ normal)
        points = world_from_cam[:3, 3] + depth[..., None] * rays
        places = ((points[..., :2] + 4) * 90).astype(np.float32)
        hit = (depth < nearest) & (
            ~np.bool_(small) | (np.abs(points[..., :2] - (0.3, 0.0)) < (0.25, 0.35)).all(axis=-1)
        )
        sampled = cv2.remap(texture, places[..., 0], places[..., 1], cv2.INTER_LINEAR)
        picture[hit], nearest[hit] = sampled[hit], depth[hit]
    return picture, nearest


def _texture(rng: np.random.Generator) -> UInt8:
    coarse = cv2.resize(rng.uniform(0, 255, (90, 90)).astype(np.float32), (720, 720), interpolation=cv2.INTER_CUBIC)
    return np.asarray(np.clip(coarse, 0, 255), np.uint8)
