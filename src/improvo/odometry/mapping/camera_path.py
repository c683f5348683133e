"""How a camera moved through a map, and whether it can have come from another one within the time between them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from improvo.geometry import se3
from improvo.geometry.alignment import Similarity
from improvo.odometry.view import View
from improvo.types import Float64

_FASTER = 3.0  # times the fastest motion before and after a gap; a camera is often lost because it moves fast


@dataclass(frozen=True)
class CameraPath:
    """Where a camera was, and when.

    Attributes:
        clocks: (N, 2) number of each frame and its time in seconds, rising. Where frames were left out the time tells
            how long the camera moved, and where times are wrong the number.
        centers: (N, 3) of the camera.
    """

    clocks: Float64
    centers: Float64

    @classmethod
    def of(cls, views: Iterable[View]) -> CameraPath:
        """That of views in temporal order; those without a pose are left out."""
        posed = [(view, view.cam_from_world) for view in views if view.cam_from_world is not None]
        clocks = np.array([[view.frame_index, view.time] for view, _ in posed], np.float64).reshape(-1, 2)
        centers = np.array([se3.inverse(pose)[:3, 3] for _, pose in posed], np.float64).reshape(-1, 3)
        return cls(clocks, centers)

    def placed(self, other_from_own: Similarity) -> CameraPath:
        """The same in another world."""
        return replace(self, centers=other_from_own.apply(self.centers))

    @property
    def fastest(self) -> Float64:
        """(2,) largest distance between two successive views, per frame and per second; 0 of less than two views."""
        if len(self.centers) < 2:
            return np.zeros(2)
        distances = np.linalg.norm(np.diff(self.centers, axis=0), axis=1)
        passed = np.diff(self.clocks, axis=0)
        speeds = np.divide(distances[:, None], passed, out=np.zeros_like(passed), where=passed > 0)
        largest: Float64 = speeds.max(axis=0)
        return largest

    def is_leap_from(self, before: CameraPath, slack: float) -> bool:
        """Whether the camera would have moved much faster from the end of one path to the start of this one.

        Args:
            before: in the same world.
            slack: what places may be off by.
        """
        if not len(self.centers) or not len(before.centers):
            return False
        passed = np.maximum(self.clocks[0] - before.clocks[-1], 0.0)
        most = _FASTER * float((np.maximum(self.fastest, before.fastest) * passed).max())
        return float(np.linalg.norm(self.centers[0] - before.centers[-1])) > most + slack
