"""Input and output of the solver: plain arrays, checked once."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from improvo.types import Float64, Int64


@dataclass(frozen=True)
class BundleProblem:
    """Poses, points and what was seen of them (paper, "Optimization Variables"), one row per observation.

    Raises:
        ValueError: shapes that do not fit each other, indices out of range, numbers that are not finite, a K with skew.
    """

    cam_from_world: Float64  # (N, 4, 4) where the solver starts
    points: Float64  # (M, 3) world, where the solver starts
    camera_index: Int64  # (O,) row of cam_from_world
    point_index: Int64  # (O,) row of points
    keypoints: Float64  # (O, 2) pixels
    weights: Float64  # (O,) w_ij in [0, 1]
    K: Float64  # (3, 3)
    fixed_cameras: NDArray[np.bool_]  # (N,) poses that stay as they are; their observations count
    fixed_points: NDArray[np.bool_] | None = None  # (M,) points that stay as they are; None: all are free

    def __post_init__(self) -> None:
        cameras, points, observations = len(self.cam_from_world), len(self.points), len(self.camera_index)
        shapes = {
            "cam_from_world": (cameras, 4, 4),
            "points": (points, 3),
            "camera_index": (observations,),
            "point_index": (observations,),
            "keypoints": (observations, 2),
            "weights": (observations,),
            "K": (3, 3),
            "fixed_cameras": (cameras,),
            "fixed_points": (points,),
        }
        for name, shape in shapes.items():
            value = getattr(self, name)
            if value is None:
                continue
            if np.shape(value) != shape:
                raise ValueError(f"BundleProblem.{name}: shape {np.shape(value)}, expected {shape}")
            if np.asarray(value).dtype.kind == "f" and not np.isfinite(value).all():
                raise ValueError(f"BundleProblem.{name}: holds values that are not finite")
        for name, count in (("camera_index", cameras), ("point_index", points)):
            index = getattr(self, name)
            if observations and not 0 <= index.min() <= index.max() < count:
                raise ValueError(f"BundleProblem.{name}: refers to rows outside 0..{count - 1}")
        if observations and self.weights.min() < 0:
            raise ValueError("BundleProblem.weights: must not be negative")
        if self.K[0, 1] != 0 or self.K[1, 0] != 0 or not np.array_equal(self.K[2], (0, 0, 1)):
            raise ValueError("BundleProblem.K: must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]")

    @property
    def free_points(self) -> NDArray[np.bool_]:
        """(M,) whether the point is optimised."""
        if self.fixed_points is None:
            return np.ones(len(self.points), np.bool_)
        return ~np.asarray(self.fixed_points, np.bool_)


@dataclass(frozen=True)
class BundleResult:
    """The solution, with the figures that a caller needs to judge it."""

    cam_from_world: Float64  # (N, 4, 4)
    points: Float64  # (M, 3)
    errors: Float64  # (O,) reprojection error e_ij in pixels, in the order of the problem's observations
    depths: Float64  # (O,) Z_ij; not positive: the point is behind that camera
    cost: float  # the objective Omega at the end
    initial_cost: float
    iterations: int  # steps tried
    converged: bool  # stopped because steps no longer changed the cost, not by the iteration limit
    seconds: dict[str, float] = field(default_factory=dict)  # per part, where asked for
