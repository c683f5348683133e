"""Mode `robust`: a two-view start, PnP, lost points found again, and a window of recent frames and keyframes."""

from __future__ import annotations

import numpy as np

from improvo.geometry import se3
from improvo.geometry.camera import Camera
from improvo.odometry.health import HealthCheck
from improvo.odometry.initial_pair import InitFailure
from improvo.odometry.journal import Journal
from improvo.odometry.local_map import LocalMap
from improvo.odometry.settings import OdometrySettings
from improvo.odometry.start import start_map
from improvo.odometry.view import NO_POINT, View, common_tracks
from improvo.odometry.window import WindowReport, adjust


class RobustMapper:
    """Gives each view a pose; a view leaves as final when nothing can change it any more."""

    def __init__(
        self, camera: Camera, settings: OdometrySettings, descriptor_distance: float, journal: Journal
    ) -> None:
        self._camera = camera
        self._settings = settings
        self._descriptor_distance = descriptor_distance
        self._journal = journal
        self._map: LocalMap | None = None
        self._buffer: list[View] = []  # views before the map starts, or since the camera was lost
        self._recent: list[View] = []  # last consecutive views, free
        self._keyframes: list[View] = []  # older keyframes: free ones at the end, fixed ones before them
        self._last_keyframe: View | None = None
        self._cooldown = 0  # frames to wait before the next try to start
        self._failures = 0  # costly ones since the last start
        self._health = HealthCheck(camera, settings, descriptor_distance)
        self._provisional: list[View] = []  # all views of a map that may still be started anew; nothing of it is final

    def track(self, view: View) -> None:
        """Pose of the next view, as far as it can be had."""
        if self._map is None:
            self._try_to_start(view)
        else:
            self._advance(view)

    def finish(self) -> None:
        """The sequence is over: everything is final."""
        self._end_segment("end of the sequence")
        self._journal.give_up(self._buffer)
        self._buffer = []

    @property
    def local_map(self) -> LocalMap | None:
        """The map of the running segment; None while there is none."""
        return self._map

    def _advance(self, view: View) -> None:
        """One frame: localise, triangulate, adjust the window, slide it."""
        assert self._map is not None
        inliers, _ = self._map.localise(view, self._recent[-1])
        if view.cam_from_world is None:
            self._lose(view, inliers)
            return
        self._recover_buffer(view)
        self._recent.append(view)
        self._choose_keyframe(view)
        self._map.triangulate(view, [*self._free_keyframes(), *self._recent[:-1]])
        report = self._adjust_window()
        self._map.remember(view)
        self._journal.tracked(report)
        if self._health.contradicts(view, {v.frame_index: v for v in self._map.history}):
            self._answer_contradiction(view)
            return
        self._grow_up(view)
        self._slide()

    def _adjust_window(self) -> WindowReport:
        assert self._map is not None
        window = self._settings.window
        free = [*self._free_keyframes(), *self._recent]
        fixed = self._keyframes[: -window.keyframes][-window.fixed :]
        if not fixed:  # the gauge: the first view stays
            fixed, free = free[:1], free[1:]
        return adjust(
            free,
            fixed,
            self._map.store,
            self._camera.K,
            self._settings.objective,
            self._settings.solver,
            window.max_error,
        )

    def _answer_contradiction(self, view: View) -> None:
        """A young map is started anew over all its frames; an old one ends, and the next takes its last frames."""
        if self._provisional:
            self._journal.contradicted(view, "the map is started anew")
            self._journal.restarted()
            self._buffer = [*self._provisional, view]
            self._clear()
        else:
            self._journal.contradicted(view, "the segment ends")
            doubtful, self._recent = self._recent, []
            self._end_segment("contradicted by two-view geometry")
            self._buffer = doubtful
        self._forget(self._buffer)
        self._start_now(view)

    def _clear(self) -> None:
        """No map."""
        self._map, self._last_keyframe = None, None
        self._recent, self._keyframes, self._provisional = [], [], []
        self._cooldown, self._failures = 0, 0

    @staticmethod
    def _forget(views: list[View]) -> None:
        """Views as before they were localised."""
        for view in views:
            view.cam_from_world = None
            view.points[:] = NO_POINT
            view.keyframe, view.non_keyframes = False, []

    def _grow_up(self, view: View) -> None:
        """A young map keeps all its views; one that nothing contradicted for long enough is trusted."""
        if self._provisional:
            self._provisional.append(view)
            if len(self._provisional) > self._settings.health.provisional_frames:
                self._provisional = []

    def _free_keyframes(self) -> list[View]:
        return self._keyframes[-self._settings.window.keyframes :]

    def _choose_keyframe(self, view: View) -> None:
        """A keyframe where the picture moved enough since the last one, or its points are running out."""
        window, last = self._settings.window, self._last_keyframe
        if last is not None:
            rows, rows_last = common_tracks(view, last)
            shared_points = np.isin(last.points[last.observed], view.points[view.observed])
            moved = np.linalg.norm(view.keypoints[rows] - last.keypoints[rows_last], axis=1)
            few_shared = len(shared_points) == 0 or shared_points.mean() < window.keyframe_shared
            far = len(moved) == 0 or np.median(moved) > window.keyframe_motion * self._camera.width
            long_ago = view.frame_index - last.frame_index >= window.keyframe_interval
            if not (few_shared or far or long_ago):
                return
        view.keyframe = True
        self._last_keyframe = view

    def _slide(self) -> None:
        """Views over the window's length leave it: keyframes stay as context, others follow their keyframe."""
        window = self._settings.window
        while len(self._recent) > window.recent:
            view = self._recent.pop(0)
            if view.keyframe:
                self._keyframes.append(view)
            else:
                keyframe = self._keyframes[-1]
                assert view.cam_from_world is not None
                assert keyframe.cam_from_world is not None
                keyframe.non_keyframes.append((view, view.cam_from_world @ se3.inverse(keyframe.cam_from_world)))
        if self._provisional:
            return
        for keyframe in self._keyframes[: -window.keyframes]:
            if not keyframe.final:
                self._finalise(keyframe)
        del self._keyframes[: -(window.keyframes + window.fixed)]

    def _finalise(self, keyframe: View) -> None:
        """The keyframe's pose is final, and with it those of its non-keyframes."""
        assert self._map is not None
        assert keyframe.cam_from_world is not None
        keyframe.final = True
        self._journal.finalise(keyframe, self._map)
        for view, view_from_keyframe in keyframe.non_keyframes:
            view.cam_from_world = view_from_keyframe @ keyframe.cam_from_world
            self._journal.finalise(view, self._map)
        keyframe.non_keyframes = []

    def _lose(self, view: View, inliers: int) -> None:
        """A frame without a pose; too many of them end the segment, and they begin the next."""
        self._buffer.append(view)
        self._journal.lost(view, inliers)
        if len(self._buffer) > self._settings.loss.max_lost_frames:
            self._end_segment("lost")

    def _recover_buffer(self, view: View) -> None:
        """Frames lost just before `view` get their pose backwards from it."""
        assert self._map is not None
        neighbour, recovered = view, []
        for lost in reversed(self._buffer):
            self._map.localise(lost, neighbour)
            if lost.cam_from_world is not None:
                neighbour = lost
                recovered.append(lost)
            else:
                self._journal.give_up([lost])
        self._recent.extend(reversed(recovered))
        self._buffer = []

    def _try_to_start(self, view: View) -> None:
        self._buffer.append(view)
        self._cooldown -= 1
        if len(self._buffer) > self._settings.start.max_buffered:
            self._journal.give_up([self._buffer.pop(0)])
        if len(self._buffer) >= 2 and self._cooldown <= 0:
            self._start_now(view)

    def _start_now(self, view: View) -> None:
        started = start_map(self._buffer, self._camera, self._settings, self._descriptor_distance)
        if isinstance(started, InitFailure):
            self._journal.refused(view, started.reason)
            if started.costly:
                self._failures += 1
                self._cooldown = min(3 * 2 ** (self._failures - 1), self._settings.start.max_cooldown)
            return
        self._map = started
        self._journal.started(self._buffer)
        self._recent = [v for v in self._buffer if v.cam_from_world is not None]
        self._journal.give_up([v for v in self._buffer if v.cam_from_world is None])
        self._buffer = []
        self._provisional = list(self._recent)
        self._health = HealthCheck(self._camera, self._settings, self._descriptor_distance)
        for buffered in self._recent:
            self._choose_keyframe(buffered)
        self._slide()

    def _end_segment(self, reason: str) -> None:
        """Everything of the running segment is final."""
        if self._map is None:
            return
        for keyframe in self._keyframes:
            if not keyframe.final:
                self._finalise(keyframe)
        for view in self._recent:
            self._journal.finalise(view, self._map)
        self._journal.ended(self._map, reason)
        self._clear()
