"""The trajectory protocol: association by time, alignment, ATE, relative errors (Zhang and Scaramuzza 2018).

Segments of an estimate do not share a world or a scale, so each is aligned on its own, and no sub-trajectory
reaches from one into another. That makes short segments easy: always read the errors beside the number of segments
and the share of frames that have a pose.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from improvo.errors import InputError
from improvo.evaluation.settings import TrajectorySettings
from improvo.evaluation.trajectory.relative import RelativeErrors, Spread, relative_errors
from improvo.geometry.alignment import Similarity, align_points, path_lengths
from improvo.geometry.se3 import rotation_angle_deg
from improvo.geometry.trajectory_files import clean_poses
from improvo.sequences.association import nearest
from improvo.types import Float64, Int64, Trajectory

CLOCK_DIGITS = 1e-9  # seconds, rounding of a difference of time stamps


@dataclass(frozen=True)
class SegmentErrors:
    """Absolute errors of one segment of the estimate."""

    segment: int
    poses: int  # with a true pose at their time
    seconds: float
    path_m: float  # true path over these poses
    scale: float | None  # of the alignment; None where the segment could not be aligned
    ate_m: Spread | None  # absolute trajectory error: distance of the positions after alignment
    ate_percent: float | None  # its rmse as a share of the true path
    rotation_deg: Spread | None  # orientation error after alignment
    note: str  # why the segment has no errors; empty otherwise


@dataclass(frozen=True)
class TrajectoryErrors:
    """How far an estimated trajectory is from the truth."""

    alignment: str
    estimate_poses: int  # valid poses of the estimate
    truth_poses: int  # valid poses of the truth
    poses: int  # of both at a common time
    invalid_truth: tuple[float, ...]  # times of true poses that are NaN or not rigid, left out
    path_m: float  # true path over the evaluated poses, all segments
    ate_m: Spread | None  # over the poses of all aligned segments
    ate_percent: float | None  # its rmse as a share of path_m
    rotation_deg: Spread | None
    segments: tuple[SegmentErrors, ...]
    relative: tuple[RelativeErrors, ...]  # by time, then by distance, then by share of the path


def clean_truth(truth: Trajectory) -> tuple[Trajectory, NDArray[np.bool_]]:
    """The truth with rotations projected to SO(3), and a mask (N,) of the rows that are NaN or not rigid, now NaN."""
    poses = clean_poses(truth.world_from_cam)[0]
    unusable = np.asarray(~np.isfinite(poses).all(axis=(1, 2)))
    return Trajectory(truth.times, poses, np.where(unusable, -1, truth.segment)), unusable


def associate(first: Float64, second: Float64, max_difference: float) -> Int64:
    """Rows (K, 2) of two lists of times that belong together: mutually nearest and at most `max_difference` apart.

    Args:
        first, second: seconds, (N,) and (M,), increasing.
    """
    to_second, to_first = (nearest(a, b, max_difference + CLOCK_DIGITS) for a, b in ((first, second), (second, first)))
    rows = np.flatnonzero(to_second >= 0)
    rows = rows[to_first[to_second[rows]] == rows]
    return np.stack([rows, to_second[rows]], axis=1).astype(np.int64)


def align(truth: Float64, estimate: Float64, alignment: str) -> Similarity:
    """The motion that carries estimated camera centres onto true ones.

    Args:
        truth: (N, 3) true camera centres.
        estimate: (N, 3) estimated ones.
        alignment: `sim3`, `se3` or `none` (identity).

    Raises:
        InputError: fewer than three poses, or positions that leave the scale or rotation undefined.
    """
    if alignment == "none":
        return Similarity(1.0, np.eye(3), np.zeros(3))
    if len(truth) >= 3 and np.ptp(truth, axis=0).max() < 1e-9:
        raise InputError("alignment is undefined: all positions of the truth coincide")
    return align_points(truth, estimate, with_scale=alignment == "sim3")


@dataclass(frozen=True)
class AlignedSegment:
    """Poses of one segment that have a true pose at their time, and the scale that carries them onto it."""

    segment: int
    rows: Int64  # (N,) of the estimate
    times: Float64  # (N,) seconds, of the truth
    truth: Float64  # (N, 4, 4) world_from_cam, metres
    estimate: Float64  # (N, 4, 4) world_from_cam as estimated, not aligned
    motion: Similarity | None  # None where it could not be aligned
    note: str  # why not

    def errors(self) -> tuple[Float64, Float64]:
        """Distance in metres and angle in degrees (N,) between aligned and true poses."""
        assert self.motion is not None
        aligned = self.motion.apply_to_poses(self.estimate)
        distance = np.linalg.norm(aligned[:, :3, 3] - self.truth[:, :3, 3], axis=1)
        return distance, rotation_angle_deg(np.swapaxes(self.truth[:, :3, :3], 1, 2) @ aligned[:, :3, :3])

    def summary(self) -> SegmentErrors:
        """Absolute errors of this segment."""
        path, seconds = float(path_lengths(self.truth[:, :3, 3])[-1]), float(self.times[-1] - self.times[0])
        if self.motion is None:
            return SegmentErrors(self.segment, len(self.times), seconds, path, None, None, None, None, self.note)
        distance, angle = self.errors()
        ate = Spread.of(distance)
        percent = 100.0 * ate.rmse / path if path > 0 else None
        return SegmentErrors(
            self.segment, len(self.times), seconds, path, self.motion.scale, ate, percent, Spread.of(angle), ""
        )


def evaluate_trajectory(
    estimate: Trajectory,
    truth: Trajectory,
    settings: TrajectorySettings | None = None,
    names: tuple[str, str] = ("the estimate", "the truth"),
) -> TrajectoryErrors:
    """Hold an estimate against the truth.

    Args:
        estimate: poses at any scale; each of its segments is aligned on its own.
        truth: poses in metres.
        settings: alignment and window lengths.
        names: of the two, for messages.

    Raises:
        InputError: no valid pose in one of them, or no common time.
    """
    settings = settings or TrajectorySettings()
    clean, unusable = clean_truth(truth)
    segments = aligned_segments(estimate, clean, settings, names)
    aligned = [segment for segment in segments if segment.motion is not None]
    total = total_errors(aligned)
    return TrajectoryErrors(
        alignment=settings.alignment,
        estimate_poses=int(estimate.valid.sum()),
        truth_poses=int(clean.valid.sum()),
        poses=sum(len(segment.times) for segment in segments),
        invalid_truth=tuple(float(time) for time in truth.times[unusable]),
        path_m=total.path_m,
        ate_m=total.ate_m,
        ate_percent=total.ate_percent,
        rotation_deg=total.rotation_deg,
        segments=tuple(segment.summary() for segment in segments),
        relative=errors_over_windows(aligned, settings),
    )


@dataclass(frozen=True)
class TotalErrors:
    """Absolute errors over the poses of several aligned segments."""

    path_m: float  # true
    ate_m: Spread | None  # None without a segment
    ate_percent: float | None  # its rmse as a share of the path
    rotation_deg: Spread | None


def total_errors(aligned: list[AlignedSegment]) -> TotalErrors:
    """Over the poses of all these segments, which all have a motion."""
    if not aligned:
        return TotalErrors(0.0, None, None, None)
    path = sum(float(path_lengths(segment.truth[:, :3, 3])[-1]) for segment in aligned)
    distances, angles = zip(*(segment.errors() for segment in aligned), strict=True)
    ate = Spread.of(np.concatenate(distances))
    return TotalErrors(path, ate, 100.0 * ate.rmse / path if path > 0 else None, Spread.of(np.concatenate(angles)))


def aligned_segments(
    estimate: Trajectory,
    truth: Trajectory,
    settings: TrajectorySettings,
    names: tuple[str, str] = ("the estimate", "the truth"),
) -> list[AlignedSegment]:
    """Associate by time and align every segment of the estimate on its own.

    Args:
        truth: after `clean_truth`.

    Raises:
        InputError: no valid pose in one of them, or no common time.
    """
    for trajectory, name in ((estimate, names[0]), (truth, names[1])):
        if not trajectory.valid.any():
            raise InputError(f"{name}: has no valid pose among {len(trajectory)}; check the file")
    estimate_rows, truth_rows = np.flatnonzero(estimate.valid), np.flatnonzero(truth.valid)
    pairs = associate(estimate.times[estimate_rows], truth.times[truth_rows], settings.max_time_difference)
    if len(pairs) == 0:
        raise InputError(_no_common_time(estimate, truth, settings.max_time_difference, names))
    estimate_rows, truth_rows = estimate_rows[pairs[:, 0]], truth_rows[pairs[:, 1]]
    segments = []
    for segment in np.unique(estimate.segment[estimate_rows]):
        chosen = estimate.segment[estimate_rows] == segment
        true_poses = truth.world_from_cam[truth_rows[chosen]]
        poses = estimate.world_from_cam[estimate_rows[chosen]]
        motion, note = None, ""
        try:
            motion = align(true_poses[:, :3, 3], poses[:, :3, 3], settings.alignment)
        except InputError as error:
            note = str(error)
        times = truth.times[truth_rows[chosen]]
        segments.append(AlignedSegment(int(segment), estimate_rows[chosen], times, true_poses, poses, motion, note))
    return segments


def errors_over_windows(aligned: list[AlignedSegment], settings: TrajectorySettings) -> tuple[RelativeErrors, ...]:
    """Relative errors over all windows of aligned segments: by time, by distance, by share of their whole path."""
    windows = [(length, "s") for length in settings.time_windows]
    windows += [(length, "m") for length in settings.distance_windows]
    windows += [(length, "path") for length in settings.path_fractions]
    segments = [(s.times, s.truth, s.estimate, s.motion.scale) for s in aligned if s.motion is not None]
    return tuple(relative_errors(length, unit, segments, settings.window_tolerance) for length, unit in windows)


def _no_common_time(estimate: Trajectory, truth: Trajectory, max_difference: float, names: tuple[str, str]) -> str:
    spans = [f"{t.times[t.valid][0]:.3f} to {t.times[t.valid][-1]:.3f} s" for t in (estimate, truth)]
    return (
        f"{names[0]} and {names[1]} have no common time: {spans[0]} against {spans[1]}, "
        f"none within {max_difference:g} s; check the time stamps or raise --max-time-difference"
    )
