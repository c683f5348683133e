"""The points of a map while it grows."""

from __future__ import annotations

import numpy as np

from improvo.types import Float64, Int64


class PointStore:
    """Map points by id; grows, never reuses an id."""

    def __init__(self) -> None:
        self._xyz = np.zeros((1024, 3))
        self._last_seen = np.full(1024, -1, np.int64)
        self.count = 0

    @property
    def xyz(self) -> Float64:
        """(P, 3) world; the array may be written to."""
        return self._xyz[: self.count]

    @property
    def last_seen(self) -> Int64:
        """(P,) frame_index of the last view that observed each point; the array may be written to."""
        return self._last_seen[: self.count]

    def add(self, xyz: Float64, frame_index: int) -> Int64:
        """New points (N, 3), seen at `frame_index`; returns their ids (N,)."""
        ids = np.arange(self.count, self.count + len(xyz), dtype=np.int64)
        needed = self.count + len(xyz)
        if needed > len(self._xyz):
            capacity = max(needed, 2 * len(self._xyz))
            self._xyz = np.concatenate([self.xyz, np.zeros((capacity - self.count, 3))])
            self._last_seen = np.concatenate([self.last_seen, np.full(capacity - self.count, -1, np.int64)])
        self.count = needed
        self._xyz[ids] = xyz
        self._last_seen[ids] = frame_index
        return ids
