"""The colours of the map points: those of the recording's pictures where the points are seen."""

from __future__ import annotations

import numpy as np

from improvo.errors import InputError
from improvo.odometry.result.final_view import FinalView
from improvo.sequences import Sequence
from improvo.types import Float32, Int64, UInt8

UNKNOWN = 128  # grey level of a point that no picture gave a colour
_EVERY = 4  # frames; only these are read once more, and nearly every point is seen in one of them


class PointColours:
    """Remembers where each map point can be seen, and reads its colour from the recording at the end."""

    def __init__(self) -> None:
        self._frame = np.full(1024, -1)  # of each point, by id
        self._pixel = np.zeros((1024, 2), np.float32)

    def add(self, view: FinalView) -> None:
        """A frame became final (in any order)."""
        if view.frame_index % _EVERY:
            return
        rows = np.flatnonzero(view.points >= 0)
        ids = view.points[rows]
        self._grow(int(ids.max(initial=-1)) + 1)
        new = self._frame[ids] < 0
        self._frame[ids[new]] = view.frame_index
        self._pixel[ids[new]] = view.keypoints[rows[new]]

    def read(self, sequence: Sequence, source_index: list[int], ids: Int64) -> UInt8 | None:
        """RGB (P, 3) of the points with these ids (P,); None where the recording cannot be read again, as it is live.

        Args:
            sequence: the recording.
            source_index: of each processed frame.
            ids: of map points.
        """
        if sequence.length is None:
            return None
        self._grow(int(ids.max(initial=-1)) + 1)
        frame, pixel = self._frame[ids], self._pixel[ids]
        rgb = np.full((len(ids), 3), UNKNOWN, np.uint8)
        for number in np.unique(frame[frame >= 0]).tolist():
            row = int(np.searchsorted(sequence.indices, source_index[number]))
            try:
                picture = sequence.colour(row)
            except InputError:  # it could be read a moment ago; its points stay grey
                continue
            here = np.flatnonzero(frame == number)
            rgb[here] = _sampled(picture, pixel[here])
        return rgb

    def _grow(self, size: int) -> None:
        if size > len(self._frame):
            more = max(size, 2 * len(self._frame)) - len(self._frame)
            self._frame = np.concatenate([self._frame, np.full(more, -1)])
            self._pixel = np.concatenate([self._pixel, np.zeros((more, 2), np.float32)])


def _sampled(picture: UInt8, pixels: Float32) -> UInt8:
    """RGB (N, 3) of a BGR picture at pixels (N, 2)."""
    height, width = picture.shape[:2]
    x, y = np.rint(pixels).astype(np.int64).T
    return np.ascontiguousarray(picture[np.clip(y, 0, height - 1), np.clip(x, 0, width - 1), ::-1])
