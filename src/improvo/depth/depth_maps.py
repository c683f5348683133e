"""The depth maps of a whole sequence, one after the other, with a bounded window of frames in memory."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from improvo.depth.agreement import agreed_depth
from improvo.depth.depth_map import DepthMap, half_intrinsics
from improvo.depth.frame_depth import frame_depth
from improvo.depth.prepared_image import PreparedImage, prepare_image
from improvo.depth.settings import DepthSettings
from improvo.geometry import se3
from improvo.types import Float64, Int64, UInt8

Range = tuple[float, float, float]


def depth_maps(
    image: Callable[[int], UInt8],
    cam_from_world: Float64,
    segment: Int64,
    K: Float64,
    ranges: Callable[[int], Range | None],
    settings: DepthSettings | None = None,
) -> Iterator[tuple[int, DepthMap]]:
    """Yield each frame with a pose and its depth map, of what several frames agree on.

    At most `4 * reach` frames and maps are held, whatever the length of the sequence.

    Args:
        image: the grey image (H, W) of a frame; asked once for each frame with a pose, in order.
        cam_from_world: (N, 4, 4) float64 poses, NaN where there is none.
        segment: (N,) int64; only frames of the same segment are compared, for each has its own scale.
        K: (3, 3) float64 of the images.
        ranges: nearest, median and farthest depth of a frame, as `range_of_depths` makes them; None where they are to
            be searched for.
        settings: all numbers.
    """
    window = _Window(image, cam_from_world, segment, half_intrinsics(K), ranges, settings or DepthSettings())
    for frame in window.frames.tolist():
        yield frame, window.agreed(frame)


class _Window:
    """Prepared images and unchecked depth maps around the frame that is asked for; frames are asked for in order."""

    def __init__(
        self,
        image: Callable[[int], UInt8],
        cam_from_world: Float64,
        segment: Int64,
        K: Float64,
        ranges: Callable[[int], Range | None],
        settings: DepthSettings,
    ) -> None:
        self._image, self._poses, self._segment, self._K = image, cam_from_world, segment, K
        self._ranges, self._settings = ranges, settings
        self.frames = np.flatnonzero(np.isfinite(cam_from_world).all(axis=(1, 2)))
        self._prepared: dict[int, PreparedImage] = {}
        self._swept: dict[int, tuple[DepthMap, list[int]]] = {}

    def agreed(self, frame: int) -> DepthMap:
        """The frame's map, compared with those of its neighbours."""
        reach = self._settings.reach
        for other in self._between(frame, frame + reach):
            if other not in self._swept:
                self._swept[other] = self._sweep(other)
        depth_map, rows = self._swept[frame]
        known = [row for row in rows if self._swept[row][0].known > 0]
        other_from_frame = self._poses[known] @ se3.inverse(self._poses[frame])
        result = agreed_depth(
            depth_map, [self._swept[row][0] for row in known], other_from_frame, self._settings.agreement
        )
        for past in [row for row in self._swept if row <= frame - reach]:
            del self._swept[past]
        return result

    def _sweep(self, frame: int) -> tuple[DepthMap, list[int]]:
        reach = self._settings.reach
        around = self._between(frame - reach, frame + reach)
        for row in around:
            if row not in self._prepared:
                self._prepared[row] = prepare_image(self._image(row))
        candidates = [row for row in around if self._segment[row] == self._segment[frame]]
        found = frame_depth(
            self._prepared.__getitem__,
            self._poses,
            self._K,
            frame,
            candidates,
            self._ranges(frame),
            self._settings,
        )
        for past in [row for row in self._prepared if row <= frame - reach]:
            del self._prepared[past]
        return found

    def _between(self, first: int, last: int) -> list[int]:
        """Frames with a pose, both ends included."""
        low, high = np.searchsorted(self.frames, (first, last + 1))
        return [int(row) for row in self.frames[low:high]]
