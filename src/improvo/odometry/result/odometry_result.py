"""What the odometry has found: final poses, map points and segments."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable

import numpy as np

from improvo.geometry import se3
from improvo.geometry.alignment import Similarity
from improvo.geometry.camera import Camera
from improvo.odometry.mapping.bundle_adjustment import WindowReport
from improvo.odometry.result.final_view import FinalView
from improvo.odometry.result.map_builder import MapBuilder
from improvo.odometry.result.segments import Segment, SegmentPlacement, extended
from improvo.odometry.result.trajectory_builder import TrajectoryBuilder
from improvo.odometry.verdict.verdict import NOT_JUDGED, Verdict
from improvo.odometry.view import NO_POINT, View
from improvo.types import Float64, SparseMap, Trajectory

_NO_POSE = np.full((4, 4), np.nan)
_NO_POSE.flags.writeable = False  # it is shared


class OdometryResult:
    """Takes over each view when its pose is final, and each segment when it ends.

    Args:
        camera: pinhole camera of the views.
        on_final: called with each final view, in order of becoming final.
    """

    def __init__(self, camera: Camera, on_final: Callable[[FinalView], None] | None = None) -> None:
        self._camera = camera
        self._on_final = on_final
        self._trajectory = TrajectoryBuilder()
        self._map = MapBuilder()
        self._placement = SegmentPlacement()
        self._window_errors: list[float] = []  # pixels, of the running segment
        self._frame_indices: list[int] = []  # of its final views
        self._path, self._last_center = 0.0, np.full(3, np.nan)  # of the running segment, in the shared unit
        self._joined: int | None = None  # the ended segment that the running one goes on
        self._scale_error = 0.0  # relative, between the two
        self.segments: list[Segment] = []

    @property
    def running_segment(self) -> int:
        """Number of the segment that runs, or of the next one."""
        return len(self.segments) if self._joined is None else self._joined

    @property
    def trajectory(self) -> Trajectory:
        """Poses of all final frames, in temporal order."""
        return self._trajectory.build()

    @property
    def map(self) -> SparseMap:
        """Points of the finished segments."""
        return self._map.build()

    def begin_segment(self) -> None:
        """A map has started. If the running segment had begun already, it is undone and begins again."""
        self._joined = None
        if self.segments:
            self._placement.begin_next()
        self._window_errors = []

    @property
    def placement(self) -> Similarity:
        """From the running segment's own world to the shared one."""
        return self._placement.similarity

    def join(self, number: int, shared_from_own: Similarity, scale_error: float) -> None:
        """The running segment lies in the world of an ended one, and goes on with it under its number.

        Args:
            number: of the ended segment.
            shared_from_own: from the running segment's own world to the shared one.
            scale_error: standard error of its scale, relative.

        Raises:
            RuntimeError: views of the running segment are final already.
        """
        if self._frame_indices:
            raise RuntimeError("a segment with final views cannot be joined with another one")
        self._joined, self._scale_error = number, scale_error
        self._placement.join(shared_from_own)

    def add_window(self, report: WindowReport) -> None:
        """A window of the running segment was adjusted."""
        self._window_errors.append(report.mean_error)

    def give_up(self, views: Iterable[View]) -> None:
        """These views stay without a pose."""
        for view in views:
            view.cam_from_world = None
            view.points[:] = NO_POINT
            self._emit(view, _NO_POSE, -1)

    def finalise(self, view: View, cam_from_world: Float64, xyz: Float64) -> None:
        """The pose of a view is final.

        Args:
            view: of the running segment.
            cam_from_world: (4, 4) its pose.
            xyz: (P, 3) points of the running segment.
        """
        rows = view.observed
        points = view.points[rows]
        points_cam = se3.transform(cam_from_world, xyz[points])
        errors = np.linalg.norm(self._camera.project(points_cam) - view.keypoints[rows], axis=1)
        self._map.add(points, errors)
        world_from_cam = self._placement.place(cam_from_world, points_cam[:, 2])
        step = float(np.linalg.norm(world_from_cam[:3, 3] - self._last_center)) if self._frame_indices else 0.0
        self._path, self._last_center = self._path + step, world_from_cam[:3, 3]
        self._frame_indices.append(view.frame_index)
        self._emit(view, world_from_cam, self.running_segment)

    def end_segment(self, xyz: Float64, reason: str, verdict: Verdict | None = None) -> Segment | None:
        """The running segment is over; all its views are final. One without any view leaves nothing.

        Args:
            xyz: (P, 3) its points.
            reason: why it ended, in a few words.
            verdict: whether its path is believed; None where nobody judged it.

        Returns:
            The segment; None where it left nothing.
        """
        if not self._frame_indices:
            self._joined = None
            return None
        self._map.end_segment(xyz, self._placement.similarity, self.running_segment)
        errors = np.array(self._window_errors)
        segment = Segment(
            number=self.running_segment,
            first=min(self._frame_indices),
            last=max(self._frame_indices),
            frames=len(self._frame_indices),
            mean_error=float(np.nanmean(errors)) if np.isfinite(errors).any() else float("nan"),
            reason=reason,
            verdict=verdict or Verdict(NOT_JUDGED),
            path=self._path,
        )
        if self._joined is None:
            self.segments.append(segment)
        else:
            segment = extended(self.segments[self._joined], segment, self._scale_error)
            self.segments[self._joined] = segment
        self._window_errors, self._frame_indices, self._joined = [], [], None
        self._path = 0.0
        return segment

    def with_running(
        self, posed: Iterable[tuple[View, Float64]], without_pose: Iterable[View], xyz: Float64 | None = None
    ) -> OdometryResult:
        """What the result would be if the sequence ended now; this one stays as it is.

        Args:
            posed: the running segment's views that are not final, with their poses (4, 4).
            without_pose: views that have no pose yet.
            xyz: (P, 3) points of the running segment; None while there is none.
        """
        xyz = np.zeros((0, 3)) if xyz is None else xyz
        other = copy.copy(self)
        other._on_final = None
        other._trajectory, other._map = self._trajectory.copy(), self._map.copy()
        other._placement = copy.copy(self._placement)
        other._frame_indices, other.segments = list(self._frame_indices), list(self.segments)
        for view, cam_from_world in posed:
            other.finalise(view, cam_from_world, xyz)
        for view in without_pose:
            other._emit(view, _NO_POSE, -1)
        other.end_segment(xyz, "")
        return other

    def _emit(self, view: View, world_from_cam: Float64, segment: int) -> None:
        self._trajectory.add(view.frame_index, view.time, world_from_cam, segment)
        if self._on_final is None:
            return
        self._on_final(
            FinalView(
                frame_index=view.frame_index,
                time=view.time,
                segment=segment,
                world_from_cam=world_from_cam,
                keypoints=view.keypoints,
                tracks=view.tracks,
                points=np.where(view.points >= 0, view.points + self._map.first_id, NO_POINT),
                weights=view.weights,
            )
        )
