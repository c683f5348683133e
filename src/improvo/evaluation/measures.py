"""What one image pair says about a frontend: repeatability, matching precision, error of the estimated pose."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from improvo.geometry.camera import Camera
from improvo.geometry.depth_sampling import depth_at
from improvo.geometry.se3 import inverse, rotation_angle_deg, transform
from improvo.types import Float32, Float64, Int64


@dataclass(frozen=True)
class PairGeometry:
    """The truth about one image pair."""

    camera: Camera  # pinhole, of both images
    b_from_a: Float64  # (4, 4) true motion from the camera of image A to that of image B
    depth_a: Float32  # (H, W) metres, NaN where missing; may be smaller than the image
    depth_b: Float32 | None  # where there is one, it tells which points of A are hidden in B
    sampling: str = "bilinear"
    edge: float = 0.05  # relative depth difference that makes a discontinuity

    def points_a(self, keypoints: Float32) -> Float64:
        """3D points (N, 3) in the camera of A at keypoints (N, 2) of A; NaN where there is no trusted depth."""
        depth = depth_at(self.in_map(keypoints, self.depth_a), self.depth_a, self.sampling, self.edge)
        return self.camera.unproject(keypoints.astype(np.float64), depth)

    def in_map(self, keypoints: Float32, depth: Float32) -> Float32:
        """Keypoints (N, 2) of the image as pixels of its depth map: pixel edges map to pixel edges."""
        height, width = depth.shape
        if (width, height) == (self.camera.width, self.camera.height):
            return keypoints
        scale = np.array([width / self.camera.width, height / self.camera.height], np.float32)
        return ((keypoints + 0.5) * scale - 0.5).astype(np.float32)

    def project_to_b(self, points_a: Float64) -> tuple[Float64, Float64]:
        """True pixels (N, 2) in B of points (N, 3) in A, and their depth (N,) there; pixels NaN behind the camera."""
        points_b = transform(self.b_from_a, points_a)
        z = points_b[:, 2]
        front = z > 1e-6
        pixels = self.camera.project(np.where(front[:, None], points_b, [0.0, 0.0, 1.0]))
        return np.where(front[:, None], pixels, np.nan), z


@dataclass(frozen=True)
class PoseError:
    """How far an estimated camera is from the true one; inf where no pose was found."""

    rotation_deg: float
    translation_m: float

    @classmethod
    def of_failure(cls) -> PoseError:
        """A missing pose is an error larger than every threshold."""
        return cls(float("inf"), float("inf"))

    @classmethod
    def between(cls, truth: Float64, estimate: Float64) -> PoseError:
        """Of two cam_from_world (4, 4): the angle between them, and the distance of the camera centres.

        Rounded to 1e-9, so that a pose which is 5 degrees off by construction is not "< 5" by a rounding error.
        """
        difference = truth @ inverse(estimate)  # translation: the estimated centre, seen from the true camera
        angle, distance = rotation_angle_deg(difference[:3, :3]), np.linalg.norm(difference[:3, 3])
        return cls(round(float(angle), 9), round(float(distance), 9))


def right_matches(geometry: PairGeometry, points_a: Float64, pixels_b: Float64, max_error: float) -> NDArray[np.bool_]:
    """Whether matches (N,) are right: the point of A lands, by true pose and depth, near its match in B.

    Args:
        geometry: of the pair.
        points_a: (N, 3) in the camera of A; matches without trusted depth are left out before the call.
        pixels_b: (N, 2) where they were matched in B.
        max_error: pixels; right is strictly below.
    """
    projected, _ = geometry.project_to_b(points_a)
    return np.asarray(np.linalg.norm(projected - pixels_b, axis=1) < max_error)


def repeated_keypoints(
    geometry: PairGeometry, keypoints_a: Float32, keypoints_b: Float32, max_error: float, hidden: float = 0.1
) -> tuple[int, int]:
    """How many keypoints of A are visible in B, and how many of those have a keypoint of B within `max_error` px.

    A keypoint of A counts as visible if it has trusted depth, lands inside B, and is not hidden there: where B has a
    depth map, the depth at that place must be known and agree within `hidden` (relative).

    Args:
        geometry: of the pair.
        keypoints_a, keypoints_b: (N, 2) and (M, 2) pixels.
        max_error: pixels; repeated is strictly below.
        hidden: relative difference of depth beyond which a point is hidden.

    Returns:
        (visible, repeated)
    """
    points = geometry.points_a(keypoints_a)
    points = points[np.isfinite(points[:, 2])]
    pixels, z = geometry.project_to_b(points)
    camera = geometry.camera
    inside = (pixels >= 0).all(axis=1) & (pixels[:, 0] <= camera.width - 1) & (pixels[:, 1] <= camera.height - 1)
    pixels, z = pixels[inside], z[inside]
    if geometry.depth_b is not None and len(pixels):
        places = geometry.in_map(pixels.astype(np.float32), geometry.depth_b)
        seen = depth_at(places, geometry.depth_b, geometry.sampling, geometry.edge)
        pixels = pixels[np.abs(seen - z) <= hidden * z]  # NaN, a hole of B, is not counted
    if len(pixels) == 0 or len(keypoints_b) == 0:
        return len(pixels), 0
    distance = squared_distances(pixels, keypoints_b.astype(np.float64)).min(axis=1)
    return len(pixels), int((distance < max_error**2).sum())


def squared_distances(a: Float64, b: Float64) -> Float64:
    """Squared distances (N, M) between points (N, 2) and (M, 2)."""
    dx, dy = a[:, None, 0] - b[None, :, 0], a[:, None, 1] - b[None, :, 1]
    return dx * dx + dy * dy


def relative_motion(world_from_cam: Float64, pairs: Int64) -> Float64:
    """True b_from_a (K, 4, 4) of frame pairs (K, 2)."""
    return inverse(world_from_cam[pairs[:, 1]]) @ world_from_cam[pairs[:, 0]]
