"""The landmarks of a labeled sequence: what training needs of its tables, as arrays that are ready to be drawn from.

A *landmark* is a map point with all of its tracks, or a track without a map point.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from improvo.geometry.camera import Camera
from improvo.labeling.labeled import LabeledSequence
from improvo.stability.grouping import medians, rows_of
from improvo.stability.rule import IGNORE, STABLE, UNSTABLE
from improvo.training.data.wrong_links import largest_step_shares
from improvo.training.settings import LandmarkSettings
from improvo.types import Float32, Float64, Int64

Codes = NDArray[np.int8]


@dataclass(frozen=True)
class Summary:
    """What must be known of every sequence before one is drawn."""

    stable_by_frame: NDArray[np.uint16]  # (F,) observations of stable landmarks
    stable: int  # such observations in all
    unstable: int  # observations of unstable ones

    def useful_frames(self, least: int) -> Int64:
        """Frames whose tracks have at least `least` stable points."""
        return np.flatnonzero(self.stable_by_frame >= least)


@dataclass(frozen=True)
class Landmarks:
    """F frames, M observations sorted by frame, L landmarks."""

    camera: Camera  # of the processed frames
    cam_from_world: Float64  # (F, 4, 4) NaN without a pose
    frame_segment: Int64  # (F,) -1 without a pose
    trusted: NDArray[np.bool_]  # (F,) by the quality gate
    start: Int64  # (F + 1,) first observation of each frame; the last is M
    keypoints: Float32  # (M, 2) pixels of the processed frames
    landmark: NDArray[np.int32]  # (M,) row of the landmark that is observed
    stability: Codes  # (L,) codes of `improvo.stability.rule`
    xyz: Float64  # (L, 3) in the world of its segment
    segment: Int64  # (L,)
    mean_error: Float64  # (L,) pixels, infinite where there is none
    mean_direction: Float64  # (L, 3) unit vectors to the cameras that saw it
    mean_distance: Float64  # (L,) to those

    def __len__(self) -> int:
        return len(self.start) - 1

    @property
    def nbytes(self) -> int:
        """Of all arrays."""
        return sum(getattr(self, field.name).nbytes for field in fields(self) if field.name != "camera")

    def observed(self, frame: int) -> tuple[Int64, Float64]:
        """Landmarks (N,) that tracks observed in a frame, and where (N, 2)."""
        rows = slice(self.start[frame], self.start[frame + 1])
        return self.landmark[rows].astype(np.int64), np.asarray(self.keypoints[rows], np.float64)

    def summary(self) -> Summary:
        """Counted from the observations."""
        codes = self.stability[self.landmark]
        stable = np.bincount(self._frames()[codes == STABLE], minlength=len(self))
        most = np.iinfo(np.uint16).max
        return Summary(
            np.minimum(stable, most).astype(np.uint16), int((codes == STABLE).sum()), int((codes == UNSTABLE).sum())
        )

    def _frames(self) -> Int64:
        """(M,) the frame of each observation."""
        return np.repeat(np.arange(len(self)), np.diff(self.start))


def find_landmarks(sequence: LabeledSequence, settings: LandmarkSettings) -> Landmarks:
    """From the tables of a sequence; `settings` say which tracks are one landmark, and which unstable ones teach."""
    table, points, frames = sequence.tracks, sequence.points, len(sequence.frames)
    order = np.argsort(table.frame, kind="stable")
    start = np.searchsorted(table.frame[order], np.arange(frames + 1))
    order = order[: start[-1]]
    track_of_row = rows_of(points.track, table.track)
    landmark_of_track, stability = _landmarks_of_tracks(sequence, settings)
    unsure = medians(track_of_row, table.error, len(points)) < settings.unstable_median_error
    if settings.unstable_largest_step < 1:
        unsure |= ~(largest_step_shares(sequence) <= settings.unstable_largest_step)
    stability = np.where((stability == UNSTABLE) & unsure, IGNORE, stability).astype(np.int8)
    _, representative, landmark_of_track = np.unique(landmark_of_track, return_index=True, return_inverse=True)
    landmark: Int64 = landmark_of_track[track_of_row[order]]
    xyz, segment = points.xyz[representative], points.segment[representative]
    direction, distance = _viewpoints(sequence, np.repeat(np.arange(frames), np.diff(start)), landmark, xyz, segment)
    return Landmarks(
        camera=sequence.camera,
        cam_from_world=sequence.cam_from_world,
        frame_segment=sequence.frames.segment,
        trusted=sequence.frames.trusted,
        start=start,
        keypoints=table.keypoints[order],
        landmark=landmark.astype(np.int32),
        stability=stability[representative],
        xyz=xyz,
        segment=segment,
        mean_error=np.nan_to_num(points.mean_error[representative].astype(np.float64), nan=np.inf),
        mean_direction=direction,
        mean_distance=distance,
    )


def _landmarks_of_tracks(sequence: LabeledSequence, settings: LandmarkSettings) -> tuple[Int64, Codes]:
    """The landmark (T,) and its stability (T,) for every track.

    Tracks of one map point are one landmark if the stability rule, applied to all of their observations together,
    says stable. Short tracks, which have no label alone, then teach too. Other tracks are landmarks of their own.
    """
    points, rule = sequence.points, sequence.rule
    alone = -1 - np.arange(len(points))
    if not settings.shared:
        return alone, points.stability
    owned = np.flatnonzero(
        (points.point >= 0) & (points.segment >= 0) & ~points.withheld & (points.stability != UNSTABLE)
        & (points.max_error < rule.unstable_max_error)
    )  # fmt: skip
    key = points.point[owned] * (points.segment.max(initial=0) + 1) + points.segment[owned]
    _, group = np.unique(key, return_inverse=True)
    observations = np.bincount(group, points.observations[owned])
    mean_error = np.bincount(group, points.observations[owned] * points.mean_error[owned]) / np.maximum(observations, 1)
    stable = (observations >= rule.min_observations) & (mean_error <= rule.stable_mean_error)
    landmark, stability = alone, points.stability.copy()
    joined = owned[stable[group]]
    landmark[joined], stability[joined] = key[stable[group]], STABLE
    return landmark, stability


def _viewpoints(
    sequence: LabeledSequence, frame: Int64, landmark: Int64, xyz: Float64, segment: Int64
) -> tuple[Float64, Float64]:
    """Mean unit direction (L, 3) from each landmark to the cameras that saw it, and mean distance (L,).

    Args:
        frame, landmark: (M,) of the observations.
        xyz, segment: of the landmarks.
    """
    poses = sequence.cam_from_world
    known = (sequence.frames.segment[frame] == segment[landmark]) & (segment[landmark] >= 0)
    frame, landmark = frame[known], landmark[known]
    rotation, translation = poses[:, :3, :3], poses[:, :3, 3]
    centres = -np.einsum("fji,fj->fi", rotation, translation)
    rays = centres[frame] - xyz[landmark]
    distance = np.linalg.norm(rays, axis=1)
    count = np.maximum(np.bincount(landmark, minlength=len(xyz)), 1)
    unit = rays / np.maximum(distance, 1e-12)[:, None]
    total: Float64 = np.stack([np.bincount(landmark, unit[:, axis], len(count)) for axis in range(3)], axis=1)
    direction: Float64 = total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-12)
    return direction, np.bincount(landmark, distance, len(count)) / count
