"""Pictures of a textured box room seen by a moving camera: a real image sequence in a second, without a renderer."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from simulated_features import hand_motion

from improvo.geometry import se3
from improvo.geometry.camera import Camera
from improvo.types import Float64, UInt8

CAMERA = Camera(320, 240, 260.0, 260.0, 159.5, 119.5)

# corner, and the two edges, of each wall of a room around the camera (metres)
_WALLS = (
    ((-3.0, -1.5, 2.5), (6.0, 0.0, 0.0), (0.0, 3.0, 0.0)),
    ((3.0, -1.5, 2.5), (0.0, 0.0, -6.0), (0.0, 3.0, 0.0)),
    ((-3.0, -1.5, -3.5), (0.0, 0.0, 6.0), (0.0, 3.0, 0.0)),
    ((-3.0, 1.5, 2.5), (6.0, 0.0, 0.0), (0.0, 0.0, -6.0)),
    ((-0.6, 0.2, 1.2), (0.9, 0.0, 0.2), (0.0, 0.8, 0.0)),
)
_TEXTURE = 512  # pixels per side


def write_walk(folder: Path, frames: int, seed: int = 0) -> Path:
    """An image folder with camera.yaml."""
    folder.mkdir(parents=True)
    rng = np.random.default_rng(seed)
    textures = [_texture(rng) for _ in _WALLS]
    for i, world_from_cam in enumerate(hand_motion(frames, step=0.025)):
        cv2.imwrite(str(folder / f"{i:06d}.png"), render(se3.inverse(world_from_cam), textures))
    (folder / "camera.yaml").write_text(
        f"width: {CAMERA.width}\nheight: {CAMERA.height}\nfx: {CAMERA.fx}\nfy: {CAMERA.fy}\n"
        f"cx: {CAMERA.cx}\ncy: {CAMERA.cy}\ndistortion: []\nfps: 30\n"
    )
    return folder


def render(cam_from_world: Float64, textures: list[UInt8]) -> UInt8:
    """Each pixel's ray meets the nearest wall; its texture is sampled there."""
    return render_with_depth(cam_from_world, textures)[0]


def render_with_depth(cam_from_world: Float64, textures: list[UInt8]) -> tuple[UInt8, Float64]:
    """As `render`, and the depth Z (H, W) of each pixel in metres, inf where there is no wall."""
    columns, rows = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
    rays_cam = CAMERA.unproject(np.stack([columns, rows], axis=-1).astype(np.float64))
    world_from_cam = se3.inverse(cam_from_world)
    rays = rays_cam @ world_from_cam[:3, :3].T
    centre = world_from_cam[:3, 3]
    image = np.full((CAMERA.height, CAMERA.width), 90, np.uint8)
    nearest = np.full(image.shape, np.inf)
    for (corner, along, down), texture in zip(_WALLS, textures, strict=True):
        basis = np.stack([along, down, np.cross(along, down)], axis=1)
        origin = np.linalg.solve(basis, centre - corner)
        direction = rays @ np.linalg.inv(basis).T
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = -origin[2] / direction[..., 2]
        hit = origin[:2] + distance[..., None] * direction[..., :2]
        inside = (distance > 0.05) & (distance < nearest) & ((hit > 0) & (hit < 1)).all(axis=-1)
        sampled = cv2.remap(texture, *(hit * (_TEXTURE - 1)).astype(np.float32).transpose(2, 0, 1), cv2.INTER_LINEAR)
        image[inside] = sampled[inside]
        nearest[inside] = distance[inside]
    return cv2.GaussianBlur(image, (3, 3), 0.6), nearest


def _texture(rng: np.random.Generator) -> UInt8:
    """Random rectangles of random brightness: many corners, none alike."""
    texture = np.full((_TEXTURE, _TEXTURE), 128, np.uint8)
    for _ in range(260):
        x, y, width, height = (*rng.integers(0, _TEXTURE, 2).tolist(), *rng.integers(10, 70, 2).tolist())
        cv2.rectangle(texture, (x, y), (x + width, y + height), int(rng.integers(20, 236)), -1)
    return texture
