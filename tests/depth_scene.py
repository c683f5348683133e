"""Pictures of textured planes with their exact depth: what a plane sweep is judged against."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from improvo.geometry import se3
from improvo.geometry.camera import Camera
from improvo.types import Float32, Float64, UInt8

CAMERA = Camera(320, 240, 260.0, 260.0, 159.5, 119.5)
_TEXTURE = 1024  # pixels per side


@dataclass(frozen=True)
class Plane:
    """A textured parallelogram."""

    corner: tuple[float, float, float]
    along: tuple[float, float, float]
    down: tuple[float, float, float]
    texture: UInt8


def textured(seed: int) -> UInt8:
    """Noise at several scales: texture at every distance."""
    rng = np.random.default_rng(seed)
    total = np.zeros((_TEXTURE, _TEXTURE))
    for cells in (32, 96, 256, 512):
        noise = rng.normal(size=(cells, cells)).astype(np.float32)
        total += cv2.resize(noise, (_TEXTURE, _TEXTURE), interpolation=cv2.INTER_CUBIC)
    return np.clip(128 + 30 * total, 0, 255).astype(np.uint8)


def plain() -> UInt8:
    """A wall without texture."""
    return np.full((_TEXTURE, _TEXTURE), 140, np.uint8)


def wall(depth: float, texture: UInt8, half_width: float = 6.0, middle: float = 0.0) -> Plane:
    """A wall that faces the first camera."""
    return Plane((middle - half_width, -half_width, depth), (2 * half_width, 0, 0), (0, 2 * half_width, 0), texture)


def render(planes: list[Plane], cam_from_world: Float64, camera: Camera = CAMERA) -> tuple[UInt8, Float32]:
    """The grey picture and the depth (0 where there is nothing)."""
    columns, rows = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    rays_cam = camera.unproject(np.stack([columns, rows], axis=-1).astype(np.float64))
    world_from_cam = se3.inverse(cam_from_world)
    rays, centre = rays_cam @ world_from_cam[:3, :3].T, world_from_cam[:3, 3]
    image = np.full((camera.height, camera.width), 90, np.uint8)
    depth = np.full(image.shape, np.inf)
    for plane in planes:
        along, down = np.array(plane.along), np.array(plane.down)
        basis = np.stack([along, down, np.cross(along, down)], axis=1)
        origin = np.linalg.solve(basis, centre - plane.corner)
        direction = rays @ np.linalg.inv(basis).T
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = -origin[2] / direction[..., 2]
        hit = origin[:2] + distance[..., None] * direction[..., :2]
        shown = (distance > 0.05) & (distance < depth) & ((hit > 0) & (hit < 1)).all(axis=-1)
        places = (np.where(shown[..., None], hit, 0) * (_TEXTURE - 1)).astype(np.float32)
        sampled = cv2.remap(plane.texture, places[..., 0], places[..., 1], cv2.INTER_LINEAR)
        image[shown], depth[shown] = sampled[shown], distance[shown]
    return image, np.where(np.isfinite(depth), depth, 0).astype(np.float32)


def sideways(frames: int, step: float) -> Float64:
    """(N, 4, 4) cam_from_world of a camera that moves to the right, with a small turn and rise."""
    moved = np.arange(frames) - (frames - 1) / 2
    centres = np.stack([step * moved, 0.2 * step * moved, 0.1 * step * moved], axis=1)
    turns = np.stack([0 * moved, 0.002 * moved, 0.001 * moved], axis=1)
    return se3.inverse(se3.rigid(se3.so3_exp(turns), centres))


def halved(depth: Float32) -> Float32:
    """The depth at the pixels of a map of half the size."""
    return np.asarray((depth[0::2, 0::2] + depth[1::2, 0::2] + depth[0::2, 1::2] + depth[1::2, 1::2]) / 4)
