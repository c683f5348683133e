"""Depth of the depth camera, registered to the colour camera."""

from __future__ import annotations

import cv2
import numpy as np

from improvo.geometry.camera import Camera
from improvo.geometry.se3 import inverse, transform
from improvo.geometry.trajectory_files import clean_poses
from improvo.types import Float32, Float64


def register_depth(depth: Float32, depth_camera: Camera, camera: Camera, cam_from_depth: Float64) -> Float32:
    """Depth (h, w) of the pinhole `depth_camera` as depth (H, W) in metres of the pinhole `camera`, NaN where unseen.

    If both cameras are at the same position, each pixel looks up its own ray. Otherwise each point is projected and
    covers as many pixels as its own pixel has in the other camera; the nearest point wins.
    """
    if np.allclose(cam_from_depth, np.eye(4), atol=1e-6):
        x, y = np.meshgrid(np.arange(camera.width, dtype=np.float64), np.arange(camera.height, dtype=np.float64))
        pixels = depth_camera.project(camera.unproject(np.stack([x, y], axis=-1))).astype(np.float32)
        return np.asarray(
            cv2.remap(
                depth,
                np.ascontiguousarray(pixels[..., 0]),
                np.ascontiguousarray(pixels[..., 1]),
                cv2.INTER_NEAREST,
                borderMode=cv2.BORDER_CONSTANT,
                borderValue=np.nan,
            )
        )
    rows, columns = np.nonzero(np.isfinite(depth))
    pixels = np.stack([columns, rows], axis=-1)
    points = transform(
        cam_from_depth, depth_camera.unproject(pixels.astype(np.float64), np.asarray(depth[rows, columns], np.float64))
    )
    points = points[points[:, 2] > 1e-3]
    # painted from far to near, so that the nearest remains
    points = points[np.argsort(-points[:, 2], kind="stable")]
    where = camera.project(points)
    reach = max(1, int(np.ceil(max(camera.fx / depth_camera.fx, camera.fy / depth_camera.fy))))
    corner = np.rint(where - (reach - 1) / 2).astype(np.int64)
    result = np.full((camera.height, camera.width), np.nan, np.float32)
    nearest = np.full(result.shape, np.inf)
    for step in np.ndindex(reach, reach):
        u, v = corner[:, 0] + step[0], corner[:, 1] + step[1]
        inside = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
        np.minimum.at(nearest, (v[inside], u[inside]), points[inside, 2])
    seen = np.isfinite(nearest)
    result[seen] = nearest[seen]
    return result


def relative_extrinsics(base_from_colour: Float64, base_from_depth: Float64) -> tuple[Float64, Float64]:
    """base_from_colour and colour_from_depth (4, 4) as ScanNet stores its extrinsics; identities where it has none."""
    poses, not_finite, not_rigid = clean_poses(np.stack([base_from_colour, base_from_depth]))
    if len(not_finite) or len(not_rigid):
        return np.eye(4), np.eye(4)
    return poses[0], inverse(poses[0]) @ poses[1]


def intrinsics_of(matrix: Float64) -> tuple[float, float, float, float]:
    """fx, fy, cx, cy of an intrinsic matrix, 3x3 or 4x4."""
    return float(matrix[0, 0]), float(matrix[1, 1]), float(matrix[0, 2]), float(matrix[1, 2])
