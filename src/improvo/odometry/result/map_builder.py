"""The sparse map of all segments: map points with how often and how well the final views observed them."""

from __future__ import annotations

import numpy as np

from improvo.geometry.alignment import Similarity
from improvo.types import Float64, Int64, SparseMap


class MapBuilder:
    """Collects the points of finished segments, and the errors of the running segment's points.

    Attributes:
        first_id: the id in the whole map of the running segment's point 0.
    """

    def __init__(self) -> None:
        self.first_id = 0
        self._finished: list[SparseMap] = []
        self._begin()

    def add(self, points: Int64, errors: Float64) -> None:
        """A final view observes map points (N,), each at most once, with these errors (N,) in pixels."""
        if len(points) == 0:
            return
        self._grow(int(points.max()) + 1)
        self._count[points] += 1
        self._total[points] += errors
        self._worst[points] = np.maximum(self._worst[points], errors)

    def end_segment(self, xyz: Float64, placement: Similarity, number: int) -> None:
        """The running segment is over; the next point of the map is the first of another segment.

        Args:
            xyz: (P, 3) all its points, also those that no final view observes, in its own world.
            placement: carries them into the shared world.
            number: of the segment.
        """
        self._finished.append(self._running(xyz, placement, number))
        self.first_id += len(xyz)
        self._begin()

    def build(self) -> SparseMap:
        """The points of the finished segments."""
        if not self._finished:
            nothing, none = np.zeros(0, np.int64), np.zeros(0)
            return SparseMap(nothing, np.zeros((0, 3)), nothing, none, none, nothing)
        parts = self._finished
        names = [name for name in SparseMap.__dataclass_fields__ if name != "rgb"]
        return SparseMap(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})

    def copy(self) -> MapBuilder:
        """Another one in the same state."""
        other = MapBuilder()
        other.first_id, other._finished = self.first_id, list(self._finished)
        other._count, other._total, other._worst = self._count.copy(), self._total.copy(), self._worst.copy()
        return other

    def _begin(self) -> None:
        self._count = np.zeros(0, np.int64)
        self._total, self._worst = np.zeros(0), np.zeros(0)

    def _grow(self, size: int) -> None:
        if size > len(self._count):
            extra = max(size, 2 * len(self._count)) - len(self._count)
            self._count = np.concatenate([self._count, np.zeros(extra, np.int64)])
            self._total = np.concatenate([self._total, np.zeros(extra)])
            self._worst = np.concatenate([self._worst, np.zeros(extra)])

    def _running(self, xyz: Float64, placement: Similarity, number: int) -> SparseMap:
        self._grow(len(xyz))
        ids = np.flatnonzero(self._count[: len(xyz)])
        count = self._count[ids]
        return SparseMap(
            ids=ids + self.first_id,
            xyz=placement.apply(xyz[ids]),
            observations=count,
            mean_error=self._total[ids] / count,
            max_error=self._worst[ids],
            segment=np.full(len(ids), number),
        )
