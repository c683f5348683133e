"""The trajectory of a run, from poses that become final in any order."""

from __future__ import annotations

import numpy as np

from improvo.types import Float64, Trajectory


class TrajectoryBuilder:
    """Collects poses in any order."""

    def __init__(self) -> None:
        self._poses: dict[int, tuple[float, Float64, int]] = {}

    def add(self, frame_index: int, time: float, world_from_cam: Float64, segment: int) -> None:
        """The pose of one frame.

        Args:
            frame_index: of the processed sequence.
            time: seconds.
            world_from_cam: (4, 4), NaN for a frame without a pose.
            segment: its number, -1 for a frame without a pose.
        """
        self._poses[frame_index] = (time, world_from_cam, segment)

    def build(self) -> Trajectory:
        """All of them in temporal order."""
        poses = [self._poses[frame_index] for frame_index in sorted(self._poses)]
        return Trajectory(
            times=np.array([time for time, _, _ in poses]),
            world_from_cam=np.array([pose for _, pose, _ in poses]).reshape(-1, 4, 4),
            segment=np.array([segment for _, _, segment in poses], np.int64),
        )

    def copy(self) -> TrajectoryBuilder:
        """Another one in the same state."""
        other = TrajectoryBuilder()
        other._poses = dict(self._poses)
        return other
