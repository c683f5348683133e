"""Relative errors over sub-trajectories (Zhang and Scaramuzza 2018; paper, "VO Trajectory Evaluation", Table 2)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from improvo.geometry.alignment import path_lengths
from improvo.geometry.se3 import inverse, rotation_angle_deg
from improvo.types import Float64, Int64


@dataclass(frozen=True)
class Spread:
    """How a set of errors is distributed."""

    mean: float
    median: float
    rmse: float
    maximum: float

    @classmethod
    def of(cls, values: NDArray[np.floating]) -> Spread:
        """The spread of a non-empty set of values."""
        return cls(
            float(np.mean(values)),
            float(np.median(values)),
            float(np.sqrt(np.mean(np.square(values)))),
            float(np.max(values)),
        )


@dataclass(frozen=True)
class RelativeErrors:
    """Errors over all sub-trajectories of one length; the figures are None where there is no such sub-trajectory."""

    length: float  # seconds, metres, or share of the path
    unit: str  # "s", "m" or "path"
    metres: float | None  # the length in metres where it is a distance
    windows: int
    rotation_deg: Spread | None
    translation_m: Spread | None
    translation_percent: float | None  # mean error over the length (distance) or over the mean path (time), KITTI's t
    no_prediction_rotation_deg: float | None  # mean error of standing still, the paper's "No Prediction"
    no_prediction_translation_m: float | None
    note: str  # why there is nothing to report; empty otherwise


def window_pairs(abscissa: Float64, length: float, tolerance: float, slack: float = np.inf) -> Int64:
    """First and last row (K, 2) of every sub-trajectory of one length.

    From every row, the row whose abscissa is nearest to the start's plus `length`, kept where it is closer than
    `tolerance`; the earlier of two equally near ones. These are the windows of rpg_trajectory_evaluation, which by
    distance are also evo's `--all_pairs`.

    Args:
        abscissa: (N,) time or distance travelled, non-decreasing.
        length: of the window, in the same unit, positive.
        tolerance: in the same unit.
        slack: how far past the last row a window may reach for; by default as far as `tolerance` allows.
    """
    if len(abscissa) < 2:
        return np.zeros((0, 2), np.int64)
    goal = abscissa + length
    after = np.minimum(np.searchsorted(abscissa, goal), len(abscissa) - 1)
    before = np.maximum(after - 1, 0)
    nearest = np.where(goal - abscissa[before] <= np.abs(abscissa[after] - goal), before, after)
    nearest = np.searchsorted(abscissa, abscissa[nearest])  # standing still: the first row at that distance
    start = np.arange(len(abscissa))
    keep = (np.abs(abscissa[nearest] - goal) < tolerance) & (nearest > start) & (goal <= abscissa[-1] + slack)
    return np.stack([start[keep], nearest[keep]], axis=1).astype(np.int64)


def relative_pose_errors(
    truth: Float64, estimate: Float64, pairs: Int64, scale: float = 1.0
) -> tuple[Float64, Float64, Float64]:
    """Rotation in degrees and translation in metres (K,) by which relative motions differ, and the true motions.

    Each sub-trajectory is aligned by its first pose, so that only the motion from first to last counts.

    Args:
        truth: (N, 4, 4) world_from_cam in metres.
        estimate: (N, 4, 4) world_from_cam at any scale.
        pairs: (K, 2) first and last row of each sub-trajectory.
        scale: of the estimate, from the alignment of its segment.

    Returns:
        Rotation errors (K,), translation errors (K,), true relative motions first_from_last (K, 4, 4).
    """
    true_motion = inverse(truth[pairs[:, 0]]) @ truth[pairs[:, 1]]
    estimated_motion = inverse(estimate[pairs[:, 0]]) @ estimate[pairs[:, 1]]
    estimated_motion[:, :3, 3] *= scale
    error = inverse(true_motion) @ estimated_motion
    return rotation_angle_deg(error[:, :3, :3]), np.linalg.norm(error[:, :3, 3], axis=1), true_motion


def relative_errors(
    length: float, unit: str, segments: list[tuple[Float64, Float64, Float64, float]], tolerance: float
) -> RelativeErrors:
    """Errors over all sub-trajectories of one length that lie within one segment.

    Args:
        length: seconds, metres or share of the whole true path, by `unit`.
        unit: "s", "m" or "path".
        segments: for each segment its times (N,), true and estimated world_from_cam (N, 4, 4), and scale.
        tolerance: share of the length by which a window may be shorter or longer.
    """
    travelled = [path_lengths(truth[:, :3, 3]) for _, truth, _, _ in segments]
    whole = float(sum(distance[-1] for distance in travelled)) if travelled else 0.0
    metres = {"s": None, "m": length, "path": length * whole}[unit]
    window = length if metres is None else metres
    rotation, translation, true_rotation, true_translation, paths = [], [], [], [], []
    no_pairs = np.zeros((0, 2), np.int64)
    longest = 0.0
    for (times, truth, estimate, scale), distance in zip(segments, travelled, strict=True):
        abscissa = times if metres is None else distance
        longest = max(longest, float(abscissa[-1] - abscissa[0]))
        # By time, a window that the recording's end cuts short is no window; by distance, rpg counts it.
        slack = 0.5 * float(np.median(np.diff(times))) if metres is None and len(times) > 1 else np.inf
        pairs = window_pairs(abscissa, window, tolerance * window, slack) if window > 0 else no_pairs
        angle, shift, motion = relative_pose_errors(truth, estimate, pairs, scale)
        rotation.append(angle)
        translation.append(shift)
        true_rotation.append(rotation_angle_deg(motion[:, :3, :3]))
        true_translation.append(np.linalg.norm(motion[:, :3, 3], axis=1))
        paths.append(distance[pairs[:, 1]] - distance[pairs[:, 0]])
    windows = sum(map(len, rotation))
    if windows == 0:
        shown = "s" if metres is None else "m"
        note = f"no window of {window:g} {shown}: the longest segment is {longest:.4g} {shown}"
        return RelativeErrors(length, unit, metres, 0, None, None, None, None, None, note)
    angles, shifts, path = map(np.concatenate, (rotation, translation, paths))
    divisor = float(np.mean(path)) if metres is None else metres
    return RelativeErrors(
        length=length,
        unit=unit,
        metres=metres,
        windows=windows,
        rotation_deg=Spread.of(angles),
        translation_m=Spread.of(shifts),
        translation_percent=100.0 * float(np.mean(shifts)) / divisor if divisor > 0 else None,
        no_prediction_rotation_deg=float(np.mean(np.concatenate(true_rotation))),
        no_prediction_translation_m=float(np.mean(np.concatenate(true_translation))),
        note="",
    )
