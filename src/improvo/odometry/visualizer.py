"""How the odometry shows itself: to a viewer that is handed to it, and that may do nothing."""

from __future__ import annotations

from typing import Protocol

from improvo.geometry.camera import Camera
from improvo.odometry.view import View
from improvo.types import Float64, Frame


class Viewer(Protocol):
    """What a viewer is told."""

    def begin(self, camera: Camera) -> None:
        """A run begins."""

    def show(self, frame: Frame, view: View, points: Float64) -> None:
        """A frame was processed; `points` (P, 3) are the running segment's, in its own world as `view`'s pose is."""

    def end(self) -> None:
        """The run is over."""


class NullViewer:
    """Nobody looks."""

    def begin(self, camera: Camera) -> None:
        """Nothing."""

    def show(self, frame: Frame, view: View, points: Float64) -> None:
        """Nothing."""

    def end(self) -> None:
        """Nothing."""
