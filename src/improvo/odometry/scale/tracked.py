"""A finished run as the sources of scale see it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from improvo.geometry import se3
from improvo.geometry.camera import Camera
from improvo.odometry.run.run_odometry import RunSummary
from improvo.sequences import Sequence
from improvo.stability.tables import POINTS_FILE, TRACKS_FILE, read_points, read_tracks
from improvo.types import Float32, Float64, Int64, Trajectory

_MAX_ERROR = 2.0  # pixels, mean over a track
_MIN_PARALLAX_DEG = 1.0


@dataclass(frozen=True)
class WellKnown:
    """Observations of tracks whose 3D point is well known, one row each, sorted by frame."""

    frame: Int64  # (M,)
    keypoints: Float32  # (M, 2) pixels
    xyz: Float64  # (M, 3) world
    segment: Int64  # (M,)


class TrackedRun:
    """What a run knows of frames and points.

    Args:
        sequence: its frames.
        summary: of the run.
    """

    def __init__(self, sequence: Sequence, summary: RunSummary) -> None:
        self.sequence = sequence
        self.folder: Path = summary.folder
        self.trajectory: Trajectory = summary.trajectory
        self.source_index = np.array(summary.report["frames"]["source_index"], np.int64)  # of each frame
        self.camera: Camera = sequence.camera

    @cached_property
    def cam_from_world(self) -> Float64:
        """(N, 4, 4), NaN where there is no pose."""
        poses = np.full((len(self.trajectory), 4, 4), np.nan)
        valid = self.trajectory.valid
        poses[valid] = se3.inverse(self.trajectory.world_from_cam[valid])
        return poses

    @cached_property
    def segments(self) -> list[int]:
        """Numbers of the segments, in order."""
        return [int(number) for number in np.unique(self.trajectory.segment) if number >= 0]

    def frames(self, segment: int) -> Int64:
        """Frames with a pose in a segment."""
        return np.flatnonzero((self.trajectory.segment == segment) & self.trajectory.valid)

    def row(self, frame: int) -> int:
        """The row of a frame in the sequence."""
        return int(np.searchsorted(self.sequence.indices, self.source_index[frame]))

    @cached_property
    def known(self) -> WellKnown:
        """Observations of well known points by frames of the same segment."""
        points, tracks = read_points(self.folder / POINTS_FILE), read_tracks(self.folder / TRACKS_FILE)
        good = (points.mean_error < _MAX_ERROR) & (points.parallax_deg > _MIN_PARALLAX_DEG)
        good &= np.isfinite(points.xyz).all(axis=1)
        ids, xyz, segment = points.track[good], points.xyz[good], points.segment[good]
        if len(ids) == 0:
            nothing = np.zeros(0, np.int64)
            return WellKnown(nothing, np.zeros((0, 2), np.float32), np.zeros((0, 3)), nothing)
        row = np.minimum(np.searchsorted(ids, tracks.track), len(ids) - 1)
        seen = (ids[row] == tracks.track) & (self.trajectory.segment[tracks.frame] == segment[row])
        rows = np.flatnonzero(seen)
        rows = rows[np.argsort(tracks.frame[rows], kind="stable")]
        return WellKnown(tracks.frame[rows], tracks.keypoints[rows], xyz[row[rows]], segment[row[rows]])

    def seen_by(self, frame: int) -> slice:
        """Rows of `known` of one frame."""
        first, last = np.searchsorted(self.known.frame, (frame, frame + 1))
        return slice(int(first), int(last))
