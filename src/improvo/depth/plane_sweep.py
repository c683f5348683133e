"""Plane sweep: depth of one frame from its chosen neighbours.

Each plane at a constant depth of the frame carries the neighbours' pictures into it; the depth of a pixel is where the
7 x 7 windows around it agree best (zero-mean normalised cross-correlation, the better half of the neighbours).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from improvo.depth.depth_map import DepthMap
from improvo.depth.prepared_image import PreparedImage
from improvo.depth.settings import SweepSettings
from improvo.depth.sweep_kernels import LEVELS, WINDOW, pick, sweep
from improvo.types import Float32, Float64


def sweep_prepared(
    reference: PreparedImage,
    others: Sequence[PreparedImage],
    other_from_frame: Float64,
    K: Float64,
    near_far: tuple[float, float],
    settings: SweepSettings,
) -> DepthMap:
    """The depth map of a frame, from neighbours with known poses.

    Args:
        reference: the frame.
        others: N neighbours.
        other_from_frame: (N, 4, 4) their poses relative to the frame.
        K: (3, 3) of the prepared images.
        near_far: depths of the last and the first plane.
        settings: of the sweep.
    """
    width, height = reference.size
    near, far = near_far
    inverse_depths = np.linspace(1 / far, 1 / near, settings.planes)
    volume = sweep_volume(reference, others, other_from_frame, K, inverse_depths)
    result = DepthMap.empty(height, width, K)
    weakest = np.float32(1 / (WINDOW * WINDOW * LEVELS * settings.min_texture))
    pick(
        volume, reference.inverse_spread, inverse_depths, weakest, np.float32(settings.min_score),
        np.float32(settings.max_second), result.depth, result.confidence,
    )  # fmt: skip
    return result


def sweep_volume(
    reference: PreparedImage,
    others: Sequence[PreparedImage],
    other_from_frame: Float64,
    K: Float64,
    inverse_depths: Float64,
) -> Float32:
    """(D, h, w) mean ZNCC over the better half of the neighbours, -1 where unknown."""
    width, height = reference.size
    volume = np.full((len(inverse_depths), height, width), -1, np.float32)
    A = K @ other_from_frame[:, :3, :3] @ np.linalg.inv(K)
    b = other_from_frame[:, :3, 3] @ K.T
    packed = np.stack([other.packed for other in others])
    sweep(
        reference.values, reference.sums, reference.inverse_spread, packed, A, b, inverse_depths,
        (len(others) + 1) // 2, volume,
    )  # fmt: skip
    return volume
