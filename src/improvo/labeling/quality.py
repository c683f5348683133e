"""A second opinion on the labels, which the paper does not have: none where the odometry itself is not to be trusted.

A large error says "unstable point" only if the pose is right, and a small one says "stable point" only if the camera's
motion could have contradicted it. So frames without a pose, frames that all their long tracks fit badly, frames before
an alarm of the odometry, and frames of pure rotation are not trusted, and a track that lives mostly in such frames
keeps its errors but loses its label.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from improvo.stability.grouping import rows_of
from improvo.stability.rule import IGNORE
from improvo.stability.settings import LabelSettings
from improvo.stability.tables import PointsTable, TracksTable
from improvo.types import Float64, Int64

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class FrameTrust:
    """Why a frame is not trusted; a frame can have several reasons."""

    no_pose: Mask  # (F,)
    high_error: Mask  # (F,)
    little_parallax: Mask  # (F,)
    contradicted: Mask  # (F,)

    @property
    def trusted(self) -> Mask:
        """(F,) no reason against it."""
        return ~(self.no_pose | self.high_error | self.little_parallax | self.contradicted)

    def counts(self) -> dict[str, int]:
        """Frames per reason, and in all."""
        reasons = {name: int(getattr(self, name).sum()) for name in self.__dataclass_fields__}
        return {**reasons, "not_trusted": int((~self.trusted).sum())}


def judge_frames(
    tracks: TracksTable,
    points: PointsTable,
    has_pose: Mask,
    contradictions: Int64,
    settings: LabelSettings,
    segment: Int64 | None = None,
) -> FrameTrust:
    """Judge every frame of a finished sequence.

    Args:
        has_pose: (F,) whether the odometry gave the frame a pose.
        contradictions: positions at which the odometry's own check contradicted its map.
        segment: (F,) final segment of each frame, -1 without a pose. After a contradiction the odometry starts a map
            anew over frames that have misled it once, so all from the segment's first frame on are doubted.
    """
    rule = settings.second_opinion
    frames = len(has_pose)
    track_row = rows_of(points.track, tracks.track)
    long_enough = (points.observations >= settings.min_observations)[track_row] & np.isfinite(tracks.error)
    frame = tracks.frame[long_enough]
    error = _median_by(frame, tracks.error[long_enough].astype(np.float64), frames)
    parallax = _median_by(frame, points.parallax_deg[track_row[long_enough]].astype(np.float64), frames)
    contradicted = np.zeros(frames, np.bool_)
    for position in contradictions:
        first = max(position - rule.doubted_before_contradiction, 0)
        if segment is not None and segment[position] >= 0:
            first = min(first, int(np.argmax(segment == segment[position])))
        contradicted[first : position + 1] = True
    return FrameTrust(
        no_pose=~np.asarray(has_pose, np.bool_),
        high_error=error > rule.max_median_error,
        little_parallax=parallax < rule.min_median_parallax_deg,
        contradicted=contradicted,
    )


def withhold_labels(points: PointsTable, tracks: TracksTable, trusted: Mask, settings: LabelSettings) -> PointsTable:
    """The points with the labels of tracks that live mostly in frames that are not trusted set to `ignore`."""
    track_row = rows_of(points.track, tracks.track)
    used = np.isfinite(tracks.error)
    observed = np.bincount(track_row[used], minlength=len(points))
    believed = np.bincount(track_row[used], weights=trusted[tracks.frame[used]], minlength=len(points))
    doubtful = believed < settings.second_opinion.min_trusted_share * observed
    withheld = doubtful & (points.stability != IGNORE)
    stability = np.where(withheld, IGNORE, points.stability).astype(np.int8)
    return replace(points, stability=stability, withheld=points.withheld | withheld)


def _median_by(group: Int64, values: Float64, groups: int) -> Float64:
    """Median of the values of each group, NaN for an empty one."""
    order = np.lexsort((values, group))
    ends = np.searchsorted(group[order], np.arange(groups), side="right")
    starts = np.searchsorted(group[order], np.arange(groups), side="left")
    middle = np.minimum((starts + ends) // 2, max(len(values) - 1, 0))
    if not len(values):
        return np.full(groups, np.nan)
    return np.where(ends > starts, values[order][middle], np.nan)
