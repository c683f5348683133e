"""What several frames agree on: a pixel keeps its depth where other frames' maps have the same surface there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from improvo.depth.agreement_kernels import compare
from improvo.depth.depth_map import DepthMap
from improvo.depth.settings import AgreementSettings
from improvo.types import Float64


def agreed_depth(
    depth_map: DepthMap, others: Sequence[DepthMap], other_from_frame: Float64, settings: AgreementSettings
) -> DepthMap:
    """The map with the pixels that at least `settings.least` others agree on, each the mean over those that do.

    A depth agrees if it is the same to `settings.tolerance` where the pixel's point falls in the other map. The mean is
    that of inverse depths, weighted with the confidences. A pixel is dropped as well where too many others see through
    its point.

    Args:
        depth_map: of the frame, straight from the sweep.
        others: N maps of other frames of the same size and `K`.
        other_from_frame: (N, 4, 4).
        settings: the rules.
    """
    agreeing = np.zeros(depth_map.depth.shape, np.uint8)
    contradicting = np.zeros_like(agreeing)
    mean = depth_map.depth.copy()  # where nobody is asked, a depth stays as it is
    if others:
        K = depth_map.K
        compare(
            depth_map.depth,
            depth_map.confidence,
            np.stack([other.depth for other in others]),
            np.stack([other.confidence for other in others]),
            np.ascontiguousarray(other_from_frame),
            (K[0, 0], K[1, 1], K[0, 2], K[1, 2]),
            settings.tolerance,
            agreeing,
            contradicting,
            mean,
        )
    keep = (agreeing >= settings.least) & (contradicting <= settings.max_contradicting * agreeing)
    keep &= depth_map.depth > 0
    return replace(
        depth_map,
        depth=np.where(keep, mean, 0).astype(np.float32),
        confidence=np.where(keep, depth_map.confidence, 0).astype(np.float32),
        agreeing=np.where(keep, agreeing, 0).astype(np.uint8),
    )
