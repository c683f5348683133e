"""The quality gate, which the paper does not have: no labels where the odometry itself is not to be trusted.

A large error says "unstable point" only if the pose is right. A small one says "stable point" only if the camera's
motion could have contradicted it. So five kinds of frames are not trusted: frames without a pose, frames that all their
long tracks fit badly, frames of little parallax, frames before an alarm of the odometry, and frames of a segment whose
verdict is `doubtful`. A track that lives mostly
in such frames keeps its errors, but its label is withheld.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from improvo.stability.grouping import medians, rows_of
from improvo.stability.rule import IGNORE
from improvo.stability.settings import LabelSettings
from improvo.stability.tables import PointsTable, TracksTable
from improvo.types import Int64

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class FrameQuality:
    """Why a frame is not trusted; a frame can have several reasons."""

    no_pose: Mask  # (F,)
    high_error: Mask  # (F,)
    little_parallax: Mask  # (F,)
    contradicted: Mask  # (F,)
    doubtful: Mask  # (F,) the odometry does not believe the path of its segment

    @property
    def trusted(self) -> Mask:
        """(F,) no reason against it."""
        return ~(self.no_pose | self.high_error | self.little_parallax | self.contradicted | self.doubtful)

    def counts(self) -> dict[str, int]:
        """Frames per reason, and in all."""
        reasons = {name: int(getattr(self, name).sum()) for name in self.__dataclass_fields__}
        return {**reasons, "not_trusted": int((~self.trusted).sum())}


def assess_frames(
    tracks: TracksTable,
    points: PointsTable,
    has_pose: Mask,
    contradictions: Int64,
    settings: LabelSettings,
    segment: Int64 | None = None,
    doubtful: Mask | None = None,
) -> FrameQuality:
    """Assess every frame of a finished sequence.

    Args:
        tracks: all observations, with their errors under the final poses.
        points: all tracks.
        has_pose: (F,) whether the odometry gave the frame a pose.
        contradictions: (C,) frames at which the odometry's own check contradicted its map.
        settings: of the labels; `settings.quality` has the limits.
        segment: (F,) final segment of each frame, -1 without a pose. After a contradiction the odometry starts a map
            anew over frames that have misled it once, so all from the segment's first frame on are doubted.
        doubtful: (F,) frames of segments with a doubtful verdict; None: there are none.
    """
    limits = settings.quality
    frames = len(has_pose)
    track_row = rows_of(points.track, tracks.track)
    long_enough = (points.observations >= settings.min_observations)[track_row] & np.isfinite(tracks.error)
    frame = tracks.frame[long_enough]
    error = medians(frame, tracks.error[long_enough], frames)
    parallax = medians(frame, points.parallax_deg[track_row[long_enough]], frames)
    contradicted = np.zeros(frames, np.bool_)
    for alarm in contradictions:
        first = max(alarm - limits.doubted_before_contradiction, 0)
        if segment is not None and segment[alarm] >= 0:
            first = min(first, int(np.argmax(segment == segment[alarm])))
        contradicted[first : alarm + 1] = True
    return FrameQuality(
        no_pose=~np.asarray(has_pose, np.bool_),
        high_error=error > limits.max_median_error,
        little_parallax=parallax < limits.min_median_parallax_deg,
        contradicted=contradicted,
        doubtful=np.zeros(frames, np.bool_) if doubtful is None else doubtful,
    )


def withhold_labels(points: PointsTable, tracks: TracksTable, trusted: Mask, settings: LabelSettings) -> PointsTable:
    """The points, with the labels of tracks that live mostly in frames that are not trusted set to `ignore`.

    Args:
        points: all tracks, with the labels of the rule.
        tracks: all observations.
        trusted: (F,) by frame.
        settings: `settings.quality.min_trusted_share` of a track's observations keep its label.
    """
    track_row = rows_of(points.track, tracks.track)
    used = np.isfinite(tracks.error)
    observed = np.bincount(track_row[used], minlength=len(points))
    believed = np.bincount(track_row[used], weights=trusted[tracks.frame[used]], minlength=len(points))
    doubtful = believed < settings.quality.min_trusted_share * observed
    withheld = doubtful & (points.stability != IGNORE)
    stability = np.where(withheld, IGNORE, points.stability).astype(np.int8)
    return replace(points, stability=stability, withheld=points.withheld | withheld)
