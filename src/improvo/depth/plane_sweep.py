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
from improvo.types import Float64


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
    inverse_depths = np.linspace(1 / near_far[1], 1 / near_far[0], settings.planes)
    sums, inverse_spread = reference.window_sums()
    volume = np.full((settings.planes, height, width), -1, np.float32)
    sweep(
        reference.values(),
        sums,
        inverse_spread,
        np.stack([other.packed for other in others]),
        K @ other_from_frame[:, :3, :3] @ np.linalg.inv(K),
        other_from_frame[:, :3, 3] @ K.T,
        inverse_depths,
        max(min(2, len(others)), (len(others) + 1) // 2),  # half of them, but two where there are two
        volume,
    )
    found = DepthMap.empty(height, width, K)
    pick(
        volume,
        inverse_spread,
        inverse_depths,
        np.float32(1 / (WINDOW * WINDOW * LEVELS * settings.min_texture)),
        np.float32(settings.min_score),
        np.float32(settings.max_second),
        found.depth,
        found.confidence,
    )
    return found
