"""Mode `paper`: the paper's own scheme and nothing else ("Camera Pose and Point Depth Initialization").

Connect-the-dots tracks are the points; a new pose is the previous pose, a new depth is 1, and bundle adjustment with
the depth regulariser over the last 30 consecutive poses does the rest. It is only watched: where two-view geometry
contradicts it, the journal says so.
"""

from __future__ import annotations

import numpy as np

from improvo.geometry import se3
from improvo.geometry.camera import Camera
from improvo.odometry.health import HealthCheck
from improvo.odometry.journal import Journal
from improvo.odometry.local_map import LocalMap
from improvo.odometry.settings import OdometrySettings
from improvo.odometry.view import View, inherit_points
from improvo.odometry.window import adjust
from improvo.types import Float64


class PaperMapper:
    """Gives each view a pose as the paper does; a view that leaves the window is final."""

    def __init__(
        self, camera: Camera, settings: OdometrySettings, descriptor_distance: float, journal: Journal
    ) -> None:
        self._camera = camera
        self._settings = settings
        self._descriptor_distance = descriptor_distance
        self._journal = journal
        self._map: LocalMap | None = None
        self._window: list[View] = []
        self._health = HealthCheck(camera, settings, descriptor_distance)

    @property
    def local_map(self) -> LocalMap | None:
        """The map of the running segment; None before the first frame."""
        return self._map

    def track(self, view: View) -> None:
        """Previous pose, unit depths, bundle adjustment over the window."""
        if self._map is not None and not self._continue(view):
            self._journal.lost(view, len(view.observed))
            self._end_segment("lost")
        if self._map is None:
            self._map = LocalMap(self._camera, self._settings, self._descriptor_distance)
            self._journal.started([view])
            view.cam_from_world = np.eye(4)
        self._window.append(view)
        self._add_points_at_unit_depth(view)
        report = adjust(
            self._window[1:],
            self._window[:1],
            self._map.store,
            self._camera.K,
            self._settings.paper_objective,
            self._settings.paper_solver,
            max_error=None,
        )
        self._journal.tracked(report)
        if self._health.contradicts(view, {earlier.frame_index: earlier for earlier in self._window}):
            self._journal.contradicted(view, "the mode `paper` goes on all the same")
        if len(self._window) > self._settings.window.paper_poses:
            self._journal.finalise(self._window.pop(0), self._map)

    def finish(self) -> None:
        """The sequence is over: everything is final."""
        self._end_segment("end of the sequence")

    def _continue(self, view: View) -> bool:
        """The pose of the previous view, if enough tracks go on."""
        inherit_points(view, self._window[-1])
        if len(view.observed) < self._settings.loss.min_inliers:
            view.points[:] = -1
            return False
        assert self._window[-1].cam_from_world is not None
        view.cam_from_world = self._window[-1].cam_from_world.copy()
        return True

    def _add_points_at_unit_depth(self, view: View) -> None:
        assert self._map is not None
        assert view.cam_from_world is not None
        new = view.points < 0
        xyz: Float64 = self._camera.unproject(view.keypoints[new], 1.0)
        view.points[new] = self._map.store.add(se3.transform(se3.inverse(view.cam_from_world), xyz), view.frame_index)

    def _end_segment(self, reason: str) -> None:
        if self._map is None:
            return
        for view in self._window:
            self._journal.finalise(view, self._map)
        self._journal.ended(self._map, reason)
        self._map, self._window = None, []
