"""What the odometry has found so far: final poses, segments, map points, and what went wrong where."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from improvo.geometry import se3
from improvo.geometry.alignment import Similarity
from improvo.geometry.camera import Camera
from improvo.odometry.local_map import LocalMap
from improvo.odometry.view import View
from improvo.odometry.window import WindowReport
from improvo.types import Float64, Int64, SparseMap, Trajectory


@dataclass(frozen=True)
class FinalView:
    """A frame that nothing can change any more."""

    frame_index: int  # in the processed sequence
    time: float  # seconds
    segment: int  # -1 without a pose
    world_from_cam: Float64  # (4, 4), NaN without a pose
    keypoints: Float64  # (N, 2) pixels
    tracks: Int64  # (N,) connect-the-dots track
    points: Int64  # (N,) map point, -1 for none
    weights: Float64  # (N,) w_ij


@dataclass(frozen=True)
class Segment:
    """A stretch of frames that share a world frame and a scale."""

    number: int
    first: int  # positions of its first and last frame
    last: int
    frames: int  # with a pose
    mean_error: float  # pixels, mean of the window errors
    reason: str  # why it ended


@dataclass(frozen=True)
class Event:
    """Something the user should know about a frame."""

    frame_index: int
    kind: str
    detail: str


@dataclass
class _Accumulated:
    """Errors of a segment's points over the views that became final."""

    count: Int64 = field(default_factory=lambda: np.zeros(0, np.int64))
    total: Float64 = field(default_factory=lambda: np.zeros(0))
    worst: Float64 = field(default_factory=lambda: np.zeros(0))

    def grow(self, size: int) -> None:
        if size > len(self.count):
            extra = max(size, 2 * len(self.count)) - len(self.count)
            self.count = np.concatenate([self.count, np.zeros(extra, np.int64)])
            self.total = np.concatenate([self.total, np.zeros(extra)])
            self.worst = np.concatenate([self.worst, np.zeros(extra)])

    def add(self, points: Int64, errors: Float64) -> None:
        self.count[points] += 1
        self.total[points] += errors
        self.worst[points] = np.maximum(self.worst[points], errors)


class Journal:
    """Collects what becomes final.

    A new segment has its own world and scale. So that a picture of all of them can be read, it is placed where the
    camera was last, at the scale that keeps the median depth; that placement is a guess and is flagged as a new
    segment everywhere.

    Args:
        camera: of the frames.
        on_final: called with each final view, in order of becoming final.
    """

    def __init__(self, camera: Camera, on_final: Callable[[FinalView], None] | None = None) -> None:
        self._camera = camera
        self._on_final = on_final
        self._poses: dict[int, tuple[float, Float64, int]] = {}
        self._points: list[SparseMap] = []
        self._points_before = 0
        self._accumulated = _Accumulated()
        self._placement = Similarity(1.0, np.eye(3), np.zeros(3))
        self._last_pose = np.eye(4)  # world_from_cam of the last final view
        self._last_depth = 1.0  # median depth there, in the world's unit
        self._errors: list[float] = []
        self._frame_indices: list[int] = []
        self._last_refusal = ""
        self.segments: list[Segment] = []
        self.events: list[Event] = []

    def started(self, views: Sequence[View]) -> None:
        """A segment begins with these views."""
        if self.segments:
            rotation, translation = self._last_pose[:3, :3], self._last_pose[:3, 3]
            self._placement = Similarity(self._last_depth, rotation, translation)
            self._note(views[0], "segment", f"segment {len(self.segments) + 1} starts: own scale, placed by guess")
        self._last_refusal = ""

    def tracked(self, report: WindowReport) -> None:
        """A view has a pose (not final yet), and this is how its window fits."""
        self._errors.append(report.mean_error)

    def refused(self, view: View, reason: str) -> None:
        """The map cannot start yet."""
        if reason != self._last_refusal:
            self._note(view, "initialising", reason)
            self._last_refusal = reason

    def lost(self, view: View, inliers: int) -> None:
        """A view has no pose."""
        self._note(view, "lost", f"only {inliers} points of the map found")

    def contradicted(self, view: View, answer: str) -> None:
        """Fresh two-view geometry says that the map is wrong."""
        self._note(view, "contradiction", f"two-view geometry contradicts the map; {answer}")

    def restarted(self) -> None:
        """The segment that had begun is undone."""
        self._errors = []

    def give_up(self, views: Sequence[View]) -> None:
        """These views stay without a pose."""
        for view in views:
            view.cam_from_world = None
            view.points[:] = -1
            self._emit(view, np.full((4, 4), np.nan), -1)

    def finalise(self, view: View, local_map: LocalMap) -> None:
        """The view's pose is final."""
        assert view.cam_from_world is not None
        rows = view.observed
        points = view.points[rows]
        points_cam = se3.transform(view.cam_from_world, local_map.store.xyz[points])
        errors = np.linalg.norm(self._camera.project(points_cam) - view.keypoints[rows], axis=1)
        self._accumulated.grow(local_map.store.count)
        self._accumulated.add(points, errors)
        world_from_cam = self._placement.apply_to_poses(se3.inverse(view.cam_from_world)[None])[0]
        self._last_pose = world_from_cam
        if len(points_cam):
            self._last_depth = float(np.median(points_cam[:, 2])) * self._placement.scale
        self._frame_indices.append(view.frame_index)
        self._emit(view, world_from_cam, len(self.segments))

    def ended(self, local_map: LocalMap, reason: str) -> None:
        """The running segment is over; all its views were finalised."""
        self._accumulated.grow(local_map.store.count)
        count = self._accumulated.count[: local_map.store.count]
        ids = np.flatnonzero(count)
        self._points.append(
            SparseMap(
                ids=ids + self._points_before,
                xyz=self._placement.apply(local_map.store.xyz[ids]),
                observations=count[ids],
                mean_error=self._accumulated.total[ids] / count[ids],
                max_error=self._accumulated.worst[ids],
                segment=np.full(len(ids), len(self.segments)),
            )
        )
        self._points_before += local_map.store.count
        self._accumulated = _Accumulated()
        errors = np.array(self._errors)
        self.segments.append(
            Segment(
                number=len(self.segments),
                first=min(self._frame_indices),
                last=max(self._frame_indices),
                frames=len(self._frame_indices),
                mean_error=float(np.nanmean(errors)) if np.isfinite(errors).any() else 0.0,
                reason=reason,
            )
        )
        self._errors, self._frame_indices = [], []

    @property
    def trajectory(self) -> Trajectory:
        """Poses of all final frames, in temporal order."""
        positions = sorted(self._poses)
        return Trajectory(
            times=np.array([self._poses[i][0] for i in positions]),
            world_from_cam=np.array([self._poses[i][1] for i in positions]).reshape(-1, 4, 4),
            segment=np.array([self._poses[i][2] for i in positions], np.int64),
        )

    @property
    def map(self) -> SparseMap:
        """Points of the finished segments."""
        parts = self._points
        if not parts:
            nothing, none = np.zeros(0, np.int64), np.zeros(0)
            return SparseMap(nothing, np.zeros((0, 3)), nothing, none, none, nothing)
        return SparseMap(
            **{name: np.concatenate([getattr(part, name) for part in parts]) for name in SparseMap.__dataclass_fields__}
        )

    def _emit(self, view: View, world_from_cam: Float64, segment: int) -> None:
        self._poses[view.frame_index] = (view.time, world_from_cam, segment)
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
                points=np.where(view.points >= 0, view.points + self._points_before, -1),
                weights=view.weights,
            )
        )

    def _note(self, view: View, kind: str, detail: str) -> None:
        self.events.append(Event(view.frame_index, kind, detail))
