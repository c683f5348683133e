"""Segments: stretches of frames with a world and a scale of their own, and where each is placed among the others."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from improvo.geometry import se3
from improvo.geometry.alignment import Similarity
from improvo.odometry.verdict.verdict import NOT_JUDGED, Verdict, joined
from improvo.types import Float64


@dataclass(frozen=True)
class Segment:
    """A stretch of frames that share a world frame and a scale."""

    number: int
    first: int  # frame_index of its first frame with a pose
    last: int  # frame_index of its last one
    frames: int  # with a pose
    mean_error: float  # pixels, mean over its window adjustments; NaN where no window was adjusted
    reason: str  # why it ended
    verdict: Verdict = field(default_factory=lambda: Verdict(NOT_JUDGED))  # whether its path is believed
    path: float = 0.0  # its length, in the unit that all segments are placed in


def extended(segment: Segment, by: Segment, scale_error: float) -> Segment:
    """A segment together with a later stretch `by` of the same world."""
    frames = segment.frames + by.frames
    errors = np.array([segment.mean_error, by.mean_error])
    known = np.isfinite(errors)
    weights = np.array([segment.frames, by.frames])[known]
    return Segment(
        number=segment.number,
        first=min(segment.first, by.first),
        last=max(segment.last, by.last),
        frames=frames,
        mean_error=float(np.average(errors[known], weights=weights)) if known.any() else float("nan"),
        reason=by.reason,
        verdict=joined(segment.verdict, by.verdict, scale_error, (segment.path, by.path)),
        path=segment.path + by.path,
    )


class SegmentPlacement:
    """Puts the worlds of all segments into one, so that a picture of them can be read.

    A new segment begins where the camera was last, at the scale that keeps the median depth. That is a guess, and it
    is flagged as a new segment everywhere.
    """

    def __init__(self) -> None:
        self.similarity = Similarity(1.0, np.eye(3), np.zeros(3))  # from the running segment's world to the shared one
        self._last_pose = np.eye(4)  # world_from_cam of the last placed view
        self._last_depth = 1.0  # median depth there, in the shared world's unit

    def begin_next(self) -> None:
        """Another segment begins at a guess; what is placed from now on belongs to it."""
        self.similarity = Similarity(self._last_depth, self._last_pose[:3, :3], self._last_pose[:3, 3])

    def join(self, similarity: Similarity) -> None:
        """The segment that begins lies in the world of an ended one; nothing of it has been placed yet."""
        self.similarity = similarity

    def place(self, cam_from_world: Float64, depths: Float64) -> Float64:
        """World_from_cam (4, 4) in the shared world.

        Args:
            cam_from_world: (4, 4) in the segment's own world.
            depths: (N,) of the map points that the view observes, in the segment's own unit; may be empty. Those of
                points behind the camera, which are not positive, tell nothing.
        """
        world_from_cam = self.similarity.apply_to_poses(se3.inverse(cam_from_world)[None])[0]
        self._last_pose = world_from_cam
        in_front = depths[depths > 0]
        if len(in_front):
            self._last_depth = float(np.median(in_front)) * self.similarity.scale
        return world_from_cam
