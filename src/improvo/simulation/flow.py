"""Exact image motion from depth and poses, of the static and the moving parts."""

from __future__ import annotations

import numpy as np

from improvo.geometry.camera import Camera
from improvo.geometry.se3 import inverse, transform
from improvo.types import Float32, Float64, Int64


def pixel_grid(camera: Camera) -> Float64:
    """Pixel coordinates (H, W, 2)."""
    x, y = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    return np.stack([x, y], axis=-1).astype(np.float64)


def image_motion(
    camera: Camera,
    depth: Float32,
    geom: Int64,
    world_from_cam: tuple[Float64, Float64],
    world_from_geom: tuple[Float64, Float64],
    moving: np.ndarray,
) -> Float64:
    """Where the point that each pixel shows goes, minus where it is: (H, W, 2) pixels, 0 where there is no depth.

    Args:
        camera: of both images.
        depth, geom: (H, W) of the first image.
        world_from_cam: of the two images.
        world_from_geom: (G, 4, 4) at the two times.
        moving: (G,) geoms that move.
    """
    pixels = pixel_grid(camera)
    known = np.isfinite(depth)
    points = transform(world_from_cam[0], camera.unproject(pixels, np.where(known, depth, 1.0).astype(np.float64)))
    moved = known & moving[geom]
    if moved.any():
        later_from_world = world_from_geom[1] @ inverse(world_from_geom[0])
        points[moved] = transform(later_from_world[geom[moved]], points[moved][:, None, :])[:, 0]
    target = camera.project(transform(inverse(world_from_cam[1]), points))
    return np.asarray(np.where(known[..., None], target - pixels, 0.0))
