"""The vertical direction of a map, and the part of it that an overhead picture shows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from improvo.types import Float64

_LEVEL_PRIOR = 0.005  # how strongly "cameras are held upright" counts against "cameras are held level"


@dataclass(frozen=True)
class Overhead:
    """Axes of a picture from above: `right` and `forward` span the ground."""

    right: Float64  # (3,) unit vector in the world
    forward: Float64  # (3,)
    down: Float64  # (3,)

    def project(self, xyz: Float64) -> Float64:
        """(..., 3) world -> (..., 2) right and forward."""
        return np.stack([xyz @ self.right, xyz @ self.forward], axis=-1)


def overhead_axes(world_from_cam: Float64) -> Overhead:
    """The ground plane, found from the cameras (N, 4, 4); the first camera looks up in the picture.

    People hold cameras level: the image's x axis stays horizontal even if the camera looks down. So the vertical
    direction is orthogonal to all x axes. If the camera did not turn, the mean of the image's y axes decides between
    the remaining directions.
    """
    x_axes, y_axes = world_from_cam[:, :3, 0], world_from_cam[:, :3, 1]
    spread = x_axes.T @ x_axes / len(x_axes)
    down = np.linalg.solve(spread + _LEVEL_PRIOR * np.eye(3), y_axes.mean(axis=0))
    down /= np.linalg.norm(down)
    for ahead in (world_from_cam[0, :3, 2], -y_axes[0], np.eye(3)[0], np.eye(3)[1]):
        forward = ahead - (ahead @ down) * down
        if np.linalg.norm(forward) > 0.2:  # else the camera looks along the vertical
            break
    forward /= np.linalg.norm(forward)
    return Overhead(np.cross(down, forward), forward, down)


def robust_limits(path: Float64, points: Float64, margin: float = 0.06) -> tuple[Float64, Float64]:
    """Lower and upper corner (2,) of what to show: all of `path` (N, 2), and `points` (P, 2) but for a few far ones."""
    low, high = path.min(axis=0), path.max(axis=0)
    if len(points):
        centre = np.median(path, axis=0)
        near = np.quantile(np.linalg.norm(points - centre, axis=1), 0.9)
        kept = points[np.linalg.norm(points - centre, axis=1) <= max(near, 1.2 * np.ptp(path, axis=0).max())]
        if len(kept):
            low = np.minimum(low, np.quantile(kept, 0.01, axis=0))
            high = np.maximum(high, np.quantile(kept, 0.99, axis=0))
    size = float(max((high - low).max(), 1e-9))
    low, high = low - margin * size, high + margin * size
    narrow = np.maximum(0.0, 0.35 * size - (high - low)) / 2  # no picture thinner than about a third
    return low - narrow, high + narrow
