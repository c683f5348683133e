"""Rows of two lists of time stamps that belong together."""

from __future__ import annotations

import numpy as np

from improvo.geometry.se3 import rigid, so3_exp, so3_log
from improvo.types import Float64, Int64, Trajectory

SAME_TIME = 1e-4  # seconds; stamps this close are the same time, rounded
MAX_DIFFERENCE = 0.02  # seconds; TUM's associate.py
MAX_GAP = 0.1  # seconds between two poses that may be interpolated


def nearest(times: Float64, other: Float64, max_difference: float = MAX_DIFFERENCE) -> Int64:
    """(N,) for each of `times` the row of the increasing `other` nearest to it, -1 where none is near enough."""
    if len(other) == 0:
        return np.full(len(times), -1, np.int64)
    right = np.clip(np.searchsorted(other, times), 1, max(len(other) - 1, 1))
    left = right - 1
    right = np.minimum(right, len(other) - 1)
    row = np.where(np.abs(other[left] - times) <= np.abs(other[right] - times), left, right)
    return np.where(np.abs(other[row] - times) <= max_difference, row, -1).astype(np.int64)


def poses_at(trajectory: Trajectory, times: Float64) -> Trajectory:
    """The trajectory at these times: the row of the same time, else interpolated, else NaN.

    Neighbours up to `MAX_GAP` apart are interpolated (slerp and straight lines); if they are farther apart, the nearest
    row is used if it is within `MAX_DIFFERENCE`.
    """
    known = np.flatnonzero(trajectory.valid)
    stamps, poses = trajectory.times[known], trajectory.world_from_cam[known]
    result = np.full((len(times), 4, 4), np.nan)
    segment = np.full(len(times), -1, np.int64)
    row = nearest(times, stamps)
    found = row >= 0
    result[found], segment[found] = poses[row[found]], trajectory.segment[known][row[found]]
    if len(stamps) > 1:
        right = np.clip(np.searchsorted(stamps, times), 1, len(stamps) - 1)
        left = right - 1
        between = (times > stamps[left]) & (times < stamps[right]) & (stamps[right] - stamps[left] <= MAX_GAP)
        between &= np.minimum(times - stamps[left], stamps[right] - times) > SAME_TIME
        between &= trajectory.segment[known][left] == trajectory.segment[known][right]
        if between.any():
            share = ((times - stamps[left]) / (stamps[right] - stamps[left]))[between, None]
            first, last = poses[left[between]], poses[right[between]]
            turn = so3_log(np.swapaxes(first[:, :3, :3], -1, -2) @ last[:, :3, :3])
            rotation = first[:, :3, :3] @ so3_exp(share * turn)
            position = (1 - share) * first[:, :3, 3] + share * last[:, :3, 3]
            result[between] = rigid(rotation, position)
            segment[between] = trajectory.segment[known][left[between]]
    return Trajectory(np.asarray(times, np.float64), result, segment)
