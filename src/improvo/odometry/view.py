"""A frame as the odometry holds it while anything of it may change, and what two frames have in common."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from improvo.odometry.settings import OdometrySettings
from improvo.types import Float32, Float64, Int64, Mask, UInt8

NO_POINT = -1
_ENOUGH = 50  # keypoints for a RANSAC; with fewer stable ones all are used, since a doubtful pose is better than none


@dataclass(eq=False)
class View:
    """A frame with its features, tracks, map points and pose. Mutable; only the odometry changes it."""

    frame_index: int  # in the processed sequence, 0-based
    time: float
    keypoints: Float64  # (N, 2) pixels
    descriptors: Float32  # (N, D) unit vectors
    weights: Float64  # (N,) w_ij
    tracks: Int64  # (N,) connect-the-dots track of each keypoint
    points: Int64  # (N,) map point of each keypoint, or NO_POINT
    attached: Mask = field(default_factory=lambda: np.zeros(0, bool))  # (N,) moves with the camera: makes no map
    image: UInt8 | None = None  # (H, W) grey, until the view is final; None where keypoints are not refined
    cam_from_world: Float64 | None = None  # (4, 4)
    segment: int = -1  # number of the segment that the pose belongs to; -1 without a pose
    world: int = 0  # number of the map that the pose belongs to; it changes where a segment is started anew, too
    keyframe: bool = False
    final: bool = False
    # Of a keyframe: views that left the window and move along with it until it is final, with cam_from_keyframe.
    non_keyframes: list[tuple[View, Float64]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.detected = self.keypoints.copy()  # (N, 2) pixels, before any refinement (`keypoint_refinement.py`)
        self.refined = np.zeros(len(self.keypoints), bool)
        if len(self.attached) != len(self.keypoints):
            self.attached = np.zeros(len(self.keypoints), bool)

    @property
    def observed(self) -> Int64:
        """Rows of the keypoints that observe a map point."""
        return np.flatnonzero(self.points >= 0)

    def forget_pose(self) -> None:
        """Back to what the view was before it had a pose."""
        self.cam_from_world = None
        self.segment = -1
        self.points[:] = NO_POINT
        self.keypoints[:], self.refined[:] = self.detected, False
        self.keyframe, self.non_keyframes = False, []

    def unposed(self) -> View:
        """Another view of the same frame, as it was before it had a pose."""
        return View(
            frame_index=self.frame_index,
            time=self.time,
            keypoints=self.detected.copy(),
            descriptors=self.descriptors,
            weights=self.weights,
            tracks=self.tracks,
            points=np.full(len(self.points), NO_POINT),
            attached=self.attached.copy(),
            image=self.image,
        )

    def __len__(self) -> int:
        return len(self.keypoints)


def matches_of_world(a: View, b: View, matches: Int64) -> Int64:
    """The matches (K, 2), rows of `a` and of `b`, without those of something attached to the camera."""
    return matches[~(a.attached[matches[:, 0]] | b.attached[matches[:, 1]])]


def common_tracks(a: View, b: View) -> tuple[Int64, Int64]:
    """Rows of `a` and of `b` that belong to the same tracks."""
    _, rows_a, rows_b = np.intersect1d(a.tracks, b.tracks, assume_unique=True, return_indices=True)
    return rows_a.astype(np.int64), rows_b.astype(np.int64)


def ransac_pairs(a: View, b: View, matches: Int64, settings: OdometrySettings) -> Mask:
    """Which matches a RANSAC may use: those whose keypoints are both likely to be stable.

    Args:
        a: the first view.
        b: the second view.
        matches: (K, 2) rows of `a` and of `b`.
        settings: of the odometry; `ransac_gate` is used.

    Returns:
        (K,) mask.
    """
    return ransac_rows(np.minimum(a.weights[matches[:, 0]], b.weights[matches[:, 1]]), settings)


def ransac_rows(weights: Float64, settings: OdometrySettings) -> Mask:
    """(N,) which of the weights w_ij are high enough for a RANSAC; all of them, where those would be too few."""
    stable = weights >= settings.ransac_gate.least_stability
    return stable if stable.sum() >= _ENOUGH else np.ones(len(weights), bool)


def inherit_points(view: View, neighbour: View) -> None:
    """Keypoints of `view` without a point take the point that their track has in `neighbour`."""
    rows, rows_neighbour = common_tracks(view, neighbour)
    free = (view.points[rows] < 0) & ~view.attached[rows]
    view.points[rows[free]] = neighbour.points[rows_neighbour[free]]
    _keep_first_of_each_point(view)


def _keep_first_of_each_point(view: View) -> None:
    """A point is observed once per view."""
    rows = view.observed
    _, first = np.unique(view.points[rows], return_index=True)
    duplicates = np.ones(len(rows), bool)
    duplicates[first] = False
    view.points[rows[duplicates]] = NO_POINT
