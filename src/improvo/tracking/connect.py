"""Connect-the-dots: matches of consecutive frames chained into tracks (paper, "Point Tracks")."""

from __future__ import annotations

import numpy as np

from improvo.types import Int64


class TrackChain:
    """Gives every keypoint of every frame its track id.

    A keypoint that matches a keypoint of the previous frame continues its track; any other begins a new track. Ids
    increase and are never reused, so an interrupted track continues under a new id.
    """

    def __init__(self) -> None:
        self._next_track = 0

    def start(self, count: int) -> Int64:
        """Track ids (count,) of keypoints that begin new tracks, as all of the first frame do.

        Args:
            count: keypoints.
        """
        ids = np.arange(self._next_track, self._next_track + count, dtype=np.int64)
        self._next_track += count
        return ids

    def extend(self, previous_tracks: Int64, matches: Int64, count: int) -> Int64:
        """Track ids (count,) of a frame's keypoints.

        Args:
            previous_tracks: (N,) ids of the previous frame's keypoints.
            matches: (K, 2) index pairs, previous frame and this one.
            count: keypoints of this frame; those without a match begin new tracks.
        """
        tracks = np.full(count, -1, np.int64)
        tracks[matches[:, 1]] = previous_tracks[matches[:, 0]]
        new = tracks < 0
        tracks[new] = self.start(int(new.sum()))
        return tracks
