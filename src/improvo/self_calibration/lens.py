"""The camera that is looked for, as six numbers: focal lengths, principal point, two radial distortion coefficients."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from improvo.geometry.camera import MIN_DEPTH, Camera
from improvo.types import Float64

NAMES = ("fx", "fy", "cx", "cy", "k1", "k2")
MODELS = ("brown", "fisheye")
_DISTORTED = 0.01  # of the radius at the corners; less needs no other model
_TABLE = 4096  # radii at which the distortion is looked up before it is refined
_WIDEST = {"brown": np.radians(70.0), "fisheye": np.radians(85.0)}  # between a ray and the optical axis


@dataclass(frozen=True)
class Lens:
    """Six numbers, and what they mean: `brown` (radius of X/Z, Y/Z) or `fisheye` (Kannala-Brandt, angle of the ray)."""

    values: Float64  # (6,) in the order of `NAMES`; pixels, and coefficients without unit
    model: str
    width: int
    height: int

    @property
    def camera(self) -> Camera:
        """The camera that the rest of the package takes.

        Raises:
            InputError: no camera has such numbers.
        """
        fx, fy, cx, cy, k1, k2 = self.values.tolist()
        return Camera(self.width, self.height, fx, fy, cx, cy, (k1, k2, 0.0, 0.0), self.model)

    @property
    def fov(self) -> float:
        """Degrees that the picture sees across its middle, horizontally."""
        left, right = (np.array([[x, self.values[3]]]) for x in (-0.5, self.width - 0.5))
        angles = np.arctan(np.abs(self.rays(np.concatenate([left, right]))[:, 0]))
        return float(np.degrees(angles.sum()))

    @property
    def distorted(self) -> bool:
        """Whether the picture's corners are moved by more than a hundredth."""
        corner = (self.width / 2 / self.values[0]) ** 2 + (self.height / 2 / self.values[1]) ** 2
        return self.model == "fisheye" or abs(float(self._radial(np.array([corner]))[0][0]) - 1.0) > _DISTORTED

    def as_model(self, model: str) -> Lens:
        """About the same lens by another model: same focal lengths and centre, the coefficients that fit best."""
        if model == self.model:
            return self
        corner = self.rays(np.array([[-0.5, -0.5], [self.width - 0.5, self.height - 0.5]]))
        widest = float(np.nanmax(np.append(np.linalg.norm(corner, axis=1), 1e-3)))
        r2 = np.linspace(0.05, 1.0, 40) ** 2 * min(widest, np.tan(_WIDEST[model])) ** 2
        bare = Lens(np.array([*self.values[:4], 0.0, 0.0]), model, self.width, self.height)
        start, _, by_k1, by_k2 = bare._radial(r2)
        r = np.sqrt(r2)  # what counts is where pixels are, the radius times what is fitted
        left = np.stack([by_k1, by_k2], axis=1) * r[:, None]
        k, *_ = np.linalg.lstsq(left, (self._radial(r2)[0] - start) * r, rcond=None)
        return Lens(np.array([*self.values[:4], *k]), model, self.width, self.height)

    def project(self, points_cam: Float64) -> tuple[Float64, Float64, Float64]:
        """Pixels (M, 2) of points (M, 3) in the camera's frame, and how they change.

        Returns:
            Pixels, their derivatives by the points (M, 2, 3), and by the six numbers (M, 2, 6). NaN behind the camera.
        """
        fx, fy, cx, cy, _, _ = self.values
        z = np.where(points_cam[:, 2] > MIN_DEPTH, points_cam[:, 2], np.nan)
        x, y = points_cam[:, 0] / z, points_cam[:, 1] / z
        radial, slope, by_k1, by_k2 = self._radial(x * x + y * y)
        pixels = np.stack([fx * x * radial + cx, fy * y * radial + cy], axis=-1)
        cross = 2.0 * x * y * slope
        u_x, u_y = fx * (radial + 2.0 * x * x * slope), fx * cross
        v_x, v_y = fy * cross, fy * (radial + 2.0 * y * y * slope)
        by_point = np.empty((len(z), 2, 3))
        by_point[:, 0, 0], by_point[:, 0, 1], by_point[:, 0, 2] = u_x / z, u_y / z, -(u_x * x + u_y * y) / z
        by_point[:, 1, 0], by_point[:, 1, 1], by_point[:, 1, 2] = v_x / z, v_y / z, -(v_x * x + v_y * y) / z
        by_value = np.zeros((len(z), 2, 6))
        by_value[:, 0, 0], by_value[:, 1, 1] = x * radial, y * radial
        by_value[:, 0, 2] = by_value[:, 1, 3] = 1.0
        by_value[:, 0, 4], by_value[:, 1, 4] = fx * x * by_k1, fy * y * by_k1
        by_value[:, 0, 5], by_value[:, 1, 5] = fx * x * by_k2, fy * y * by_k2
        return pixels, by_point, by_value

    def rays(self, pixels: Float64) -> Float64:
        """X/Z, Y/Z (N, 2) of pixels (N, 2); NaN where the model has no ray for a pixel."""
        fx, fy, cx, cy, _, _ = self.values
        distorted = (pixels - (cx, cy)) / (fx, fy)
        wanted = np.linalg.norm(distorted, axis=1)
        radius = np.tan(np.linspace(0.0, _WIDEST[self.model], _TABLE))
        reached = radius * self._radial(radius * radius)[0]
        folds = np.flatnonzero(np.diff(reached) <= 0)  # beyond it the polynomial is no lens any more
        valid = len(reached) if len(folds) == 0 else int(folds[0]) + 1
        found = np.interp(wanted, reached[:valid], radius[:valid], right=np.nan)
        for _ in range(3):
            radial, slope, _, _ = self._radial(found * found)
            found = found - (found * radial - wanted) / (radial + 2.0 * found * found * slope)
        return distorted * np.where(wanted > 0, found / np.maximum(wanted, 1e-12), 1.0)[:, None]

    def _radial(self, r2: Float64) -> tuple[Float64, Float64, Float64, Float64]:
        """Distorted over undistorted radius, its derivatives by the squared radius, by k1, and by k2."""
        k1, k2 = self.values[4:]
        if self.model == "brown":
            return 1.0 + r2 * (k1 + r2 * k2), k1 + 2.0 * r2 * k2, r2, r2 * r2
        r = np.sqrt(np.maximum(r2, 1e-16))
        angle = np.arctan(r)
        a2 = angle * angle
        distorted = angle * (1.0 + a2 * (k1 + a2 * k2))
        growth = (1.0 + a2 * (3.0 * k1 + 5.0 * a2 * k2)) / (1.0 + r2)
        slope = (growth * r - distorted) / (2.0 * r * np.maximum(r2, 1e-16))
        return distorted / r, slope, angle * a2 / r, angle * a2 * a2 / r


def lens_with_fov(degrees: float, width: int, height: int, model: str = "brown", k1: float = 0.0) -> Lens:
    """A lens with square pixels and its centre in the middle, that sees so many degrees across.

    Args:
        degrees: horizontally.
        width: pixels.
        height: pixels.
        model: one of `MODELS`.
        k1: radial coefficient.
    """
    radius = np.tan(np.radians(degrees) / 2)
    unit = Lens(np.array([1.0, 1.0, 0.0, 0.0, k1, 0.0]), model, width, height)
    focal = 0.5 * width / float(radius * unit._radial(np.array([radius**2]))[0][0])
    return Lens(np.array([focal, focal, (width - 1) / 2, (height - 1) / 2, k1, 0.0]), model, width, height)
