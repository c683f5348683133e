"""Anchors: the patch of each map point in the first picture that showed it, which later observations are aligned to."""

from __future__ import annotations

import numpy as np

from improvo.odometry.refinement.patch_alignment import REACH, patch_middles
from improvo.types import Float32, Float64, Int64, Mask

_FIRST = 1024  # slots; they double


class Anchors:
    """Patches in slots, at most one for each map point; slots of points that are not seen any more are used again."""

    def __init__(self) -> None:
        side = 2 * REACH + 1
        self.patches: Float32 = np.zeros((0, side, side), np.float32)  # by slot, as all of these
        self.middles: Float64 = np.zeros((0, 2))  # x, y of the point within its patch
        self.frame_index: Int64 = np.zeros(0, np.int64)  # of the view that the patch was cut from
        self.usable: Mask = np.zeros(0, bool)  # its place is not ambiguous
        self._point: Int64 = np.zeros(0, np.int64)  # the slot's map point, -1 where the slot is free
        self._slot_of_point: Int64 = np.full(_FIRST, -1, np.int64)

    def slots(self, points: Int64) -> Int64:
        """The slots (N,) of map points (N,); -1 where a point has none."""
        if len(points) and points.max() >= len(self._slot_of_point):
            more = max(int(points.max()) + 1, 2 * len(self._slot_of_point)) - len(self._slot_of_point)
            self._slot_of_point = np.concatenate([self._slot_of_point, np.full(more, -1, np.int64)])
        return np.asarray(self._slot_of_point[points])

    def put(self, points: Int64, frame_index: int, patches: Float32, pixels: Float64, usable: Mask) -> None:
        """New patches of map points, in place of those that they had.

        Args:
            points: (N,) each once.
            frame_index: of the view.
            patches: (N, S, S) cut around the pixels.
            pixels: (N, 2) of the points in that view.
            usable: (N,) whether each is to be aligned to.
        """
        slots = self.slots(points)
        new = slots < 0
        slots[new] = self._free_slots(int(new.sum()))
        self._slot_of_point[points], self._point[slots] = slots, points
        self.patches[slots], self.middles[slots] = patches, patch_middles(pixels)
        self.frame_index[slots], self.usable[slots] = frame_index, usable

    def forget(self, last_seen: Int64, before: int) -> None:
        """Free the slots of points that were last seen in a frame before this one.

        Args:
            last_seen: (P,) frame index by map point; -1 for one that no view has been remembered with.
            before: a frame index.
        """
        taken = np.flatnonzero(self._point >= 0)
        seen = last_seen[self._point[taken]]
        over = taken[(seen >= 0) & (seen < before) & (self.frame_index[taken] < before)]
        self._slot_of_point[self._point[over]] = -1
        self._point[over] = -1

    def frames(self) -> set[int]:
        """Indices of the views that patches in use were cut from."""
        return set(np.unique(self.frame_index[self._point >= 0]).tolist())

    def _free_slots(self, count: int) -> Int64:
        free = np.flatnonzero(self._point < 0)
        if len(free) < count:
            self._grow(max(count - len(free), len(self._point), _FIRST))
            free = np.flatnonzero(self._point < 0)
        return free[:count]

    def _grow(self, more: int) -> None:
        self.patches = np.concatenate([self.patches, np.zeros((more, *self.patches.shape[1:]), np.float32)])
        self.middles = np.concatenate([self.middles, np.zeros((more, 2))])
        self.frame_index = np.concatenate([self.frame_index, np.full(more, -1, np.int64)])
        self.usable = np.concatenate([self.usable, np.zeros(more, bool)])
        self._point = np.concatenate([self._point, np.full(more, -1, np.int64)])
