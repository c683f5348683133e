"""How the odometry shows itself: to a visualizer that is handed to it, a null object where nobody looks."""

from __future__ import annotations

from typing import Protocol

from improvo.geometry.camera import Camera
from improvo.odometry.view import View
from improvo.types import Float64, Frame


class Visualizer(Protocol):
    """What a visualizer is told. It must not change what it is shown."""

    def begin(self, camera: Camera) -> None:
        """A run begins."""

    def show(self, frame: Frame, view: View, points: Float64) -> None:
        """A frame was processed.

        Args:
            frame: its image.
            view: its keypoints, tracks and pose. Poses belong together only where `view.world` is the same.
            points: (P, 3) map points, in the world of the view's pose.
        """

    def end(self) -> None:
        """The run is over."""


class NullVisualizer:
    """Shows nothing."""

    def begin(self, camera: Camera) -> None:
        """Nothing to do."""

    def show(self, frame: Frame, view: View, points: Float64) -> None:
        """Nothing to do."""

    def end(self) -> None:
        """Nothing to do."""
