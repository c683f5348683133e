"""The quality gate, which the paper does not have: no labels where the odometry itself is not to be trusted.

A large error says "unstable point" only if the pose is right. A small one says "stable point" only if the camera's
motion could have contradicted it. So five kinds of frames are not trusted: frames without a pose, frames that all their
long tracks fit badly, frames of little parallax, frames before an alarm of the odometry, and frames of a segment whose
verdict is `doubtful`. A track that lives mostly in such frames keeps its errors, but its label is withheld.

Observations are looked at a part at a time, so that memory does not grow with them; a number for each frame and for
each track is kept.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from improvo.odometry.settings import TrackingLossSettings
from improvo.stability.grouping import medians, rows_of
from improvo.stability.rule import IGNORE
from improvo.stability.settings import LabelSettings
from improvo.stability.tables import Observations, PointsTable
from improvo.types import Float32, Float64, Int64

Mask = NDArray[np.bool_]
_LONGEST_LOSS = TrackingLossSettings().max_lost_frames


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


@dataclass(frozen=True)
class TrackFacts:
    """What the gate must know of every track, sorted by track."""

    track: Int64  # (T,)
    long_enough: Mask  # (T,) for a label
    parallax_deg: Float32  # (T,)

    @staticmethod
    def of(parts: Iterable[PointsTable], settings: LabelSettings) -> TrackFacts:
        """From the points, in any order."""
        columns = [(p.track, p.observations >= settings.min_observations, p.parallax_deg) for p in parts]
        nothing = np.zeros(0, np.int64), np.zeros(0, np.bool_), np.zeros(0, np.float32)
        track, long_enough, parallax = (np.concatenate(part) for part in zip(nothing, *columns, strict=True))
        order = np.argsort(track, kind="stable")
        return TrackFacts(track[order], long_enough[order], parallax[order])

    def rows(self, track: Int64) -> Int64:
        """The row of each of these tracks."""
        return rows_of(self.track, track)


def frame_medians(observations: Observations, facts: TrackFacts, frames: range) -> tuple[Float64, Float64]:
    """Median error in pixels and median parallax in degrees of the long tracks in each of `frames`; NaN without any.

    Args:
        observations: all of those frames.
        facts: of their tracks.
        frames: in order.
    """
    row = facts.rows(observations.track)
    used = facts.long_enough[row] & np.isfinite(observations.error)
    frame = observations.frame[used] - frames.start
    error = medians(frame, observations.error[used], len(frames))
    return error, medians(frame, facts.parallax_deg[row[used]], len(frames))


def assess_frames(
    median_error: Float64,
    median_parallax_deg: Float64,
    has_pose: Mask,
    contradictions: Int64,
    settings: LabelSettings,
    segment: Int64 | None = None,
    doubtful: Mask | None = None,
) -> FrameQuality:
    """Assess every frame of a finished sequence.

    Args:
        median_error, median_parallax_deg: (F,) see `frame_medians`.
        has_pose: (F,) whether the odometry gave the frame a pose.
        contradictions: (C,) frames at which the odometry's own check contradicted its map.
        settings: of the labels; `settings.quality` has the limits.
        segment: (F,) final segment of each frame, -1 without a pose. After a contradiction the odometry starts a map
            anew over frames that have misled it once, so all of its map's frames up to there are doubted.
        doubtful: (F,) frames of segments with a doubtful verdict; None: there are none.
    """
    limits = settings.quality
    contradicted = np.zeros(len(has_pose), np.bool_)
    for alarm in contradictions:
        first = max(alarm - limits.doubted_before_contradiction, 0)
        if segment is not None and segment[alarm] >= 0:
            first = min(first, _first_of_map(segment, int(alarm)))
        contradicted[first : alarm + 1] = True
    return FrameQuality(
        no_pose=~np.asarray(has_pose, np.bool_),
        high_error=median_error > limits.max_median_error,
        little_parallax=median_parallax_deg < limits.min_median_parallax_deg,
        contradicted=contradicted,
        doubtful=np.zeros_like(contradicted) if doubtful is None else doubtful,
    )


def _first_of_map(segment: Int64, frame: int) -> int:
    """The first frame of the map that a frame lies in.

    Joined maps are one segment. Between them lie frames of others, or more without a pose than a map survives.
    """
    first = frame
    for earlier in range(frame - 1, -1, -1):
        if segment[earlier] == segment[frame]:
            first = earlier
        elif segment[earlier] >= 0 or first - earlier > _LONGEST_LOSS:
            break
    return first


def doubtful_tracks(parts: Iterable[Observations], facts: TrackFacts, trusted: Mask, settings: LabelSettings) -> Mask:
    """(T,) which tracks live mostly in frames that are not trusted.

    Args:
        parts: all observations, in any order.
        facts: of the tracks.
        trusted: (F,) by frame.
        settings: `settings.quality.min_trusted_share` of a track's observations keep its label.
    """
    observed, believed = (np.zeros(len(facts.track), np.int32) for _ in range(2))
    for part in parts:
        used = np.isfinite(part.error)
        row, frame = facts.rows(part.track[used]), part.frame[used]
        np.add.at(observed, row, 1)
        np.add.at(believed, row[trusted[frame]], 1)
    return np.asarray(believed < settings.quality.min_trusted_share * observed)


def withhold_labels(points: PointsTable, doubtful: Mask) -> PointsTable:
    """The points, with the labels of doubtful tracks (N,) set to `ignore`."""
    withheld = doubtful & (points.stability != IGNORE)
    stability = np.where(withheld, IGNORE, points.stability).astype(np.int8)
    return replace(points, stability=stability, withheld=points.withheld | withheld)
