"""What the two modes have in common: a mapper gives each view a pose."""

from __future__ import annotations

from abc import ABC, abstractmethod

from improvo.geometry.camera import Camera
from improvo.odometry.mapping.local_map import LocalMap
from improvo.odometry.modes.states import TrackingState
from improvo.odometry.result.events import EventLog
from improvo.odometry.result.odometry_result import OdometryResult
from improvo.odometry.settings import OdometrySettings
from improvo.odometry.view import View
from improvo.types import Mask


class Mapper(ABC):
    """Gives each view a pose, and hands it to the result when nothing can change it any more.

    Args:
        camera: pinhole camera of the views.
        settings: of the odometry.
        descriptor_distance: the matching threshold on unit descriptors of this frontend.
        result: takes over what is final.
        events: is told what went wrong.
    """

    def __init__(
        self,
        camera: Camera,
        settings: OdometrySettings,
        descriptor_distance: float,
        result: OdometryResult,
        events: EventLog,
    ) -> None:
        self._camera = camera
        self._settings = settings
        self._descriptor_distance = descriptor_distance
        self._result = result
        self._events = events
        self._map: LocalMap | None = None  # of the running segment

    @property
    def local_map(self) -> LocalMap | None:
        """The map of the running segment; None while there is none."""
        return self._map

    @property
    @abstractmethod
    def state(self) -> TrackingState:
        """What the mapper is doing."""

    def dispensable_pixels(self, view: View) -> Mask | None:
        """(H, W) what need have no keypoints, since it moves with the camera; None where few of a view's are there."""
        return None

    @abstractmethod
    def track(self, view: View) -> None:
        """The next view; it has a pose afterwards, if there is one."""

    @abstractmethod
    def finish(self) -> None:
        """The sequence is over: everything is final."""

    @abstractmethod
    def so_far(self) -> OdometryResult:
        """The result as it would be if the sequence ended here."""
