"""Pinhole camera with an optional distortion, OpenCV's conventions."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from improvo.errors import InputError
from improvo.types import Float64

MIN_DEPTH = 1e-6  # map units; nearer to the plane of the camera a projection has no value

# distortion model -> the numbers of coefficients it may have
DISTORTION_MODELS = {"brown": (0, 4, 5, 8), "fisheye": (4,), "fov": (1,)}


@dataclass(frozen=True)
class Camera:
    """Intrinsics in pixels; the centre of the top-left pixel is (0, 0).

    Raises:
        InputError: numbers that are not finite or positive, an unknown distortion model, or wrong coefficients.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()  # OpenCV order k1, k2, p1, p2[, k3[, k4, k5, k6]]; () is a pure pinhole
    distortion_model: str = "brown"  # or "fisheye" (Kannala-Brandt k1..k4), "fov" (Devernay-Faugeras w)

    def __post_init__(self) -> None:
        object.__setattr__(self, "distortion", tuple(self.distortion))  # from JSON it is a list, never equal to a tuple
        counts = DISTORTION_MODELS.get(self.distortion_model)
        if counts is None:
            known = ", ".join(DISTORTION_MODELS)
            raise InputError(f"camera: unknown distortion model {self.distortion_model!r}; known: {known}")
        if self.distortion and len(self.distortion) not in counts:
            raise InputError(
                f"camera: the {self.distortion_model} model has {' or '.join(map(str, counts))} distortion "
                f"coefficients, not {len(self.distortion)}"
            )
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
        return self.distortion_model != "fisheye" and not any(self.distortion)

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

    def pinhole(self) -> Camera:
        """The same K and size without distortion."""
        return replace(self, distortion=(), distortion_model="brown")

    def distort(self, rays: Float64) -> Float64:
        """Undistorted image coordinates (..., 2) = X/Z, Y/Z -> distorted ones (..., 2), before K is applied.

        Sources: Brown-Conrady and Kannala-Brandt as in OpenCV's calib3d, FOV as in Devernay and Faugeras 2001.
        """
        if self.is_pinhole:
            return np.array(rays, np.float64)
        x, y = rays[..., 0], rays[..., 1]
        r2 = x * x + y * y
        if self.distortion_model == "brown":
            k1, k2, p1, p2, k3, k4, k5, k6 = (*self.distortion, 0.0, 0.0, 0.0, 0.0)[:8]
            radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
            return np.stack(
                [
                    x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
                    y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
                ],
                axis=-1,
            )
        r = np.sqrt(np.maximum(r2, 1e-24))
        if self.distortion_model == "fisheye":
            k1, k2, k3, k4 = self.distortion or (0.0, 0.0, 0.0, 0.0)
            theta = np.arctan(r)
            t2 = theta * theta
            r_distorted = theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
        else:
            omega = self.distortion[0]
            r_distorted = np.arctan(2 * r * np.tan(omega / 2)) / omega
        return rays * (r_distorted / r)[..., None]

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
