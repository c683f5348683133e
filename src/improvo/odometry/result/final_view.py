"""A frame as the odometry leaves it, when nothing can change it any more."""

from __future__ import annotations

from dataclasses import dataclass

from improvo.types import Float64, Int64


@dataclass(frozen=True)
class FinalView:
    """A frame that nothing can change any more."""

    frame_index: int
    time: float  # seconds
    segment: int  # -1 without a pose
    world_from_cam: Float64  # (4, 4), NaN without a pose
    keypoints: Float64  # (N, 2) pixels
    tracks: Int64  # (N,) connect-the-dots track
    points: Int64  # (N,) id of the map point, -1 for none
    weights: Float64  # (N,) w_ij
