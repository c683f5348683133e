"""The depth map of one frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from improvo.types import Float32, Float64, UInt8


@dataclass(frozen=True)
class DepthMap:
    """Depth of a frame at half resolution, in the unit of the poses.

    A pixel (x, y) of the map covers pixels 2x, 2x+1 and 2y, 2y+1 of the frame; `K` is the map's own.
    """

    depth: Float32  # (h, w) Z in the camera, 0 where unknown
    confidence: Float32  # (h, w) 0 to 1, 0 where unknown
    K: Float64  # (3, 3) pixels of the map
    agreeing: UInt8 | None = None  # (h, w) other frames with the same depth there; None before frames were compared

    @property
    def known(self) -> float:
        """Share of the pixels with a depth."""
        return float((self.depth > 0).mean())

    @property
    def inverse_depth(self) -> Float32:
        """(h, w) 1 / Z, 0 where unknown."""
        known = self.depth > 0
        return np.where(known, 1.0 / np.where(known, self.depth, 1.0), 0.0).astype(np.float32)

    @classmethod
    def empty(cls, height: int, width: int, K: Float64) -> DepthMap:
        """A map that knows nothing."""
        nothing = np.zeros((height, width), np.float32)
        return cls(nothing, nothing.copy(), K)


def half_intrinsics(K: Float64) -> Float64:
    """(3, 3) K of the frame at half its size: pixel edges stay pixel edges."""
    half = np.array(K, np.float64)
    half[:2] *= 0.5
    half[:2, 2] -= 0.25
    return half
