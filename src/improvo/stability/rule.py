"""Which tracks are stable: the paper's rule on the re-projection errors of every link a track had.

A track's point is solved robustly with the final poses held, so that a link that slid, or jumped to something else,
shows its whole error instead of pulling the point between the two (docs/labels.md has the comparison).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from improvo.geometry.settings import TriangulationSettings
from improvo.stability.settings import LabelSettings
from improvo.types import Float64, Int64, Tracks

IGNORE, UNSTABLE, STABLE = 0, 1, 2
STABILITY_NAMES = ("ignore", "unstable", "stable")  # by code


@dataclass(frozen=True)
class TrackLabels:
    """One row per track, in the order of the tracks' first rows; `errors` has one row per observation."""

    track: Int64  # (T,) track id
    point: Int64  # (T,) map point that owns the track, -1 where none does
    segment: Int64  # (T,) segment whose poses the errors are measured under, -1 where no pose saw the track
    xyz: Float64  # (T, 3) in that segment's world; NaN with fewer than two observations
    observations: Int64  # (T,) T_j: observations by cameras of that segment
    mean_error: Float64  # (T,) pixels; NaN without a point
    max_error: Float64  # (T,) pixels
    stability: NDArray[np.int8]  # (T,) IGNORE, UNSTABLE or STABLE
    parallax_deg: Float64  # (T,) largest angle between two rays from the point to cameras that saw it
    withheld: NDArray[np.bool_]  # (T,) the quality gate took its label away (`improvo.labeling.quality`); here none
    errors: Float64  # (M,) pixels, per observation; NaN where it has none

    def __len__(self) -> int:
        return len(self.track)

    def counts(self) -> dict[str, int]:
        """Number of tracks per label, and of labels withheld."""
        by_code = np.bincount(self.stability, minlength=len(STABILITY_NAMES))
        names = {name: int(by_code[code]) for code, name in enumerate(STABILITY_NAMES)}
        return {**names, "withheld": int(self.withheld.sum())}


def classify(observations: Int64, mean_error: Float64, max_error: Float64, settings: LabelSettings) -> NDArray[np.int8]:
    """The rule alone (paper, eq. stability).

    Args:
        observations: (T,) number of observations T_j of each track.
        mean_error: (T,) pixels; NaN for a track without a point.
        max_error: (T,) pixels.
        settings: the three thresholds.

    Returns:
        (T,) STABLE, UNSTABLE or IGNORE.
    """
    long_enough = observations >= settings.min_observations
    stable = long_enough & (mean_error <= settings.stable_mean_error)
    unstable = long_enough & ~stable & (max_error >= settings.unstable_max_error)
    return np.where(stable, STABLE, np.where(unstable, UNSTABLE, IGNORE)).astype(np.int8)


def label_stability(
    tracks: Tracks,
    cam_from_world: Float64,
    segment: Int64,
    K: Float64,
    settings: LabelSettings | None = None,
    point: Int64 | None = None,
) -> TrackLabels:
    """Label whole tracks under final poses; any subset of tracks gives the same labels as all at once.

    Args:
        tracks: complete tracks, sorted by track, then frame, with every link they had.
        cam_from_world: (F, 4, 4) final poses by `tracks.frame`; NaN where there is none.
        segment: (F,) segment of each pose, -1 where there is none; a track is judged in the one that saw most of it.
        K: (3, 3).
        settings: the rule, and how a track's point is found.
        point: (T,) map point of each track in the order in which the tracks appear, -1 where none; for the record.

    Returns:
        Labels. A point behind one of the cameras that saw it is never called stable.

    Raises:
        ValueError: rows that are not sorted, arrays of shapes that do not fit each other, or frames without a row of
            poses.
    """
    from improvo.geometry.triangulation import triangulate_tracks

    _check(tracks, cam_from_world, segment, K)
    settings = settings or LabelSettings()
    first = np.flatnonzero(np.diff(tracks.track, prepend=np.iinfo(np.int64).min)) if len(tracks) else np.zeros(0, int)
    row_track = np.repeat(np.arange(len(first)), np.diff(first, append=len(tracks)))
    count = len(first)
    if point is not None and np.shape(point) != (count,):
        raise ValueError(f"point: shape {np.shape(point)}, expected {(count,)}")

    home = _home_segment(np.asarray(segment)[tracks.frame], row_track, count)
    rows = np.flatnonzero((segment[tracks.frame] == home[row_track]) & (home[row_track] >= 0))
    used = row_track[rows]
    observations = np.bincount(used, minlength=count).astype(np.int64)
    offsets = np.concatenate([[0], np.cumsum(observations)])
    keypoints = tracks.keypoints[rows].astype(np.float64)
    solved = triangulate_tracks(
        keypoints,
        tracks.frame[rows],
        offsets,
        cam_from_world,
        K,
        TriangulationSettings(loss=settings.loss, loss_width=settings.loss_width),
    )
    errors = np.full(len(tracks), np.nan)
    errors[rows] = solved.errors
    mean_error, max_error = _mean_and_max(solved.errors, used, observations)

    stability = classify(observations, mean_error, max_error, settings)
    stability[(stability == STABLE) & ~solved.in_front] = IGNORE
    return TrackLabels(
        track=tracks.track[first],
        point=np.full(count, -1, np.int64) if point is None else np.asarray(point, np.int64),
        segment=home,
        xyz=solved.points,
        observations=observations,
        mean_error=mean_error,
        max_error=max_error,
        stability=stability,
        parallax_deg=solved.parallax_deg,
        withheld=np.zeros(count, np.bool_),
        errors=errors,
    )


def _check(tracks: Tracks, cam_from_world: Float64, segment: Int64, K: Float64) -> None:
    """Refuse arrays that would give labels, and wrong ones."""
    rows, frames = len(tracks), len(cam_from_world)
    shapes = {
        "tracks.track": (np.shape(tracks.track), (rows,)),
        "tracks.keypoints": (np.shape(tracks.keypoints), (rows, 2)),
        "tracks.weight": (np.shape(tracks.weight), (rows,)),
        "cam_from_world": (np.shape(cam_from_world), (frames, 4, 4)),
        "segment": (np.shape(segment), (frames,)),
        "K": (np.shape(K), (3, 3)),
    }
    for name, (shape, wanted) in shapes.items():
        if shape != wanted:
            raise ValueError(f"{name}: shape {shape}, expected {wanted}")
    if rows and not 0 <= tracks.frame.min() <= tracks.frame.max() < frames:
        raise ValueError(f"tracks.frame: refers to rows outside 0..{frames - 1} of cam_from_world")
    step = np.diff(tracks.track)
    if (step < 0).any() or (np.diff(tracks.frame)[step == 0] <= 0).any():
        raise ValueError("tracks: rows must be sorted by track, then frame, each frame once; sort them")


def _home_segment(row_segment: Int64, row_track: Int64, count: int) -> Int64:
    """The segment that saw most of each track, the earlier one of equals; -1 where no pose did."""
    home = np.full(count, -1, np.int64)
    if not len(row_segment):
        return home
    most = np.zeros(count, np.int64)
    for number in np.unique(row_segment[row_segment >= 0]):
        seen = np.bincount(row_track[row_segment == number], minlength=count)
        home[seen > most] = number
        most = np.maximum(most, seen)
    return home


def _mean_and_max(errors: Float64, track: Int64, observations: Int64) -> tuple[Float64, Float64]:
    """Per track, NaN for a track without errors."""
    known = np.isfinite(errors)
    total = np.bincount(track[known], weights=errors[known], minlength=len(observations))
    number = np.bincount(track[known], minlength=len(observations))
    largest = np.full(len(observations), -np.inf)
    np.maximum.at(largest, track[known], errors[known])
    empty = number == 0
    return np.where(empty, np.nan, total / np.maximum(number, 1)), np.where(empty, np.nan, largest)
