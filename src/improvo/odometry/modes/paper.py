"""Mode `paper`: the paper's own scheme and nothing else ("Camera Pose and Point Depth Initialization").

Connect-the-dots tracks are the points; a new pose is the previous pose, a new depth is 1, and bundle adjustment with
the depth regulariser over the last N_last = 30 consecutive poses does the rest. The two-view check only watches: where
it contradicts the map, an event says so, and the odometry goes on.
"""

from __future__ import annotations

import numpy as np

from improvo.backend.settings import SolverSettings
from improvo.geometry import se3
from improvo.geometry.camera import Camera
from improvo.odometry.alarms.two_view_check import TwoViewCheck
from improvo.odometry.gates import FEWEST
from improvo.odometry.mapping.bundle_adjustment import adjust
from improvo.odometry.mapping.local_map import LocalMap
from improvo.odometry.modes.mapper import Mapper
from improvo.odometry.modes.states import TrackingState
from improvo.odometry.result.events import EventLog
from improvo.odometry.result.odometry_result import OdometryResult
from improvo.odometry.settings import OdometrySettings
from improvo.odometry.view import NO_POINT, View, inherit_points
from improvo.types import Float64

SOLVER = SolverSettings(max_iterations=100, relative_decrease=1e-6)  # the paper's 100, and hardly ever less


class PaperMapper(Mapper):
    """Gives each view a pose as the paper does; a view that leaves the window is final."""

    def __init__(
        self,
        camera: Camera,
        settings: OdometrySettings,
        descriptor_distance: float,
        result: OdometryResult,
        events: EventLog,
    ) -> None:
        super().__init__(camera, settings, descriptor_distance, result, events)
        self._window: list[View] = []

    @property
    def state(self) -> TrackingState:
        """TRACKING from the first frame on: every frame has a pose, and the map is never taken back."""
        return TrackingState.INITIALISING if self._map is None else TrackingState.TRACKING

    def track(self, view: View) -> None:
        """Previous pose, unit depths, bundle adjustment over the window."""
        if self._map is not None and not self._continue(view):
            self._events.lost(view.frame_index, len(view.observed))
            view.forget_pose()
            self._end_segment("lost")
        if self._map is None:
            self._map = self._begin_segment(view)
        view.segment = view.world = self._result.running_segment
        self._window.append(view)
        self._add_points_at_unit_depth(view, self._map)
        report = adjust(
            self._window[1:],
            self._window[:1],
            self._map.store,
            self._camera.K,
            self._settings.paper_objective,
            SOLVER,
            max_error=None,
        )
        self._result.add_window(report)
        if self._two_view_check.contradicts(view, {earlier.frame_index: earlier for earlier in self._window}):
            self._events.contradicted(view.frame_index, "the mode `paper` goes on all the same")
        if len(self._window) > self._settings.window.paper_poses:
            self._finalise(self._window.pop(0), self._map)

    def finish(self) -> None:
        """The sequence is over: everything is final."""
        self._end_segment("end of the sequence")

    def so_far(self) -> OdometryResult:
        """The result as it would be if the sequence ended here."""
        if self._map is None:
            return self._result.with_running([], [])
        posed = [(view, view.cam_from_world) for view in self._window if view.cam_from_world is not None]
        return self._result.with_running(posed, [], self._map.store.xyz)

    def _begin_segment(self, view: View) -> LocalMap:
        """A world of its own, with nothing known of the one before."""
        self._two_view_check = TwoViewCheck(self._camera, self._settings, self._descriptor_distance)
        self._events.segment_started(view.frame_index, self._result.running_segment)
        self._result.begin_segment()
        view.cam_from_world = np.eye(4)
        return LocalMap(self._camera, self._settings, self._descriptor_distance)

    def _continue(self, view: View) -> bool:
        """The pose of the previous view, if enough tracks go on."""
        previous = self._window[-1]
        inherit_points(view, previous)
        if len(view.observed) < FEWEST:
            return False
        assert previous.cam_from_world is not None
        view.cam_from_world = previous.cam_from_world.copy()
        return True

    def _add_points_at_unit_depth(self, view: View, local_map: LocalMap) -> None:
        assert view.cam_from_world is not None
        new = view.points == NO_POINT
        xyz: Float64 = self._camera.unproject(view.keypoints[new], 1.0)
        world_from_cam = se3.inverse(view.cam_from_world)
        view.points[new] = local_map.store.add(se3.transform(world_from_cam, xyz), view.frame_index)

    def _end_segment(self, reason: str) -> None:
        if self._map is None:
            return
        for view in self._window:
            self._finalise(view, self._map)
        self._result.end_segment(self._map.store.xyz, reason)
        self._map, self._window = None, []

    def _finalise(self, view: View, local_map: LocalMap) -> None:
        assert view.cam_from_world is not None
        self._result.finalise(view, view.cam_from_world, local_map.store.xyz)
