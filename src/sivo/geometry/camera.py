"""Pinhole camera with optional Brown-Conrady distortion, OpenCV's conventions."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sivo.errors import InputError
from sivo.types import Float64


@dataclass(frozen=True)
class Camera:
    """Intrinsics in pixels; the centre of the top-left pixel is (0, 0)."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()  # OpenCV order k1, k2, p1, p2[, k3[, k4, k5, k6]]; () is a pure pinhole

    def __post_init__(self) -> None:
        numbers = (self.fx, self.fy, self.cx, self.cy, *self.distortion)
        if not np.isfinite(numbers).all() or min(self.fx, self.fy) <= 0 or min(self.width, self.height) < 1:
            raise InputError(
                f"camera {self.width}x{self.height} fx={self.fx} fy={self.fy}: sizes and focal lengths must be positive"
            )

    @property
    def K(self) -> Float64:  # noqa: N802 - the field's name for it
        """(3, 3) intrinsic matrix."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def is_pinhole(self) -> bool:
        """Whether there is no distortion left."""
        return not any(self.distortion)

    def resized(self, width: int, height: int) -> Camera:
        """The camera of the same picture at another size: pixel edges map to pixel edges."""
        scale_x, scale_y = width / self.width, height / self.height
        return replace(
            self,
            width=width,
            height=height,
            fx=self.fx * scale_x,
            fy=self.fy * scale_y,
            cx=(self.cx + 0.5) * scale_x - 0.5,
            cy=(self.cy + 0.5) * scale_y - 0.5,
        )

    def project(self, points_cam: Float64) -> Float64:
        """Points (..., 3) in the camera frame -> pixels (..., 2), paper eq. (projection); the pinhole part only."""
        z = points_cam[..., 2]
        return np.stack(
            [self.fx * points_cam[..., 0] / z + self.cx, self.fy * points_cam[..., 1] / z + self.cy], axis=-1
        )

    def unproject(self, pixels: Float64, depth: Float64 | float = 1.0) -> Float64:
        """Pixels (..., 2) at depth Z (...) -> points (..., 3) in the camera frame; the pinhole part only."""
        z = np.broadcast_to(np.asarray(depth, np.float64), pixels.shape[:-1])
        x = (pixels[..., 0] - self.cx) / self.fx * z
        y = (pixels[..., 1] - self.cy) / self.fy * z
        return np.stack([x, y, z], axis=-1)
