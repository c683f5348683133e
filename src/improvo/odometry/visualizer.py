"""How the odometry shows itself: to a visualizer that is handed to it, and that may do nothing."""

from __future__ import annotations

from typing import Protocol

from improvo.geometry.camera import Camera
from improvo.odometry.view import View
from improvo.types import Float64, Frame


class Visualizer(Protocol):
    """What a visualizer is told."""

    def begin(self, camera: Camera) -> None:
        """A run begins."""

    def show(self, frame: Frame, view: View, points: Float64) -> None:
        """A frame was processed; `points` (P, 3) are the running segment's, in its own world as `view`'s pose is."""

    def end(self) -> None:
        """The run is over."""


class NullVisualizer:
    """Nobody looks."""

    def begin(self, camera: Camera) -> None:
        """Nothing."""

    def show(self, frame: Frame, view: View, points: Float64) -> None:
        """Nothing."""

    def end(self) -> None:
        """Nothing."""
