"""Finer depth than the planes of the sweep: slanted surfaces, and steps to where the pictures agree best.

The sweep compares windows as if every surface faced the camera. Here each pixel of a window lies at its own depth, on
the plane through the known pixels around it, so that slanted surfaces are matched as they are; a Gauss-Newton step on
the normalised windows of the better half of the neighbours then moves the depth of each pixel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from improvo.depth.depth_map import DepthMap
from improvo.depth.prepared_image import PreparedImage
from improvo.depth.refine_kernels import fit_surfaces, measure, move
from improvo.depth.settings import RefineSettings
from improvo.types import Float64


def refine_depth(
    depth_map: DepthMap,
    reference: PreparedImage,
    others: Sequence[PreparedImage],
    other_from_frame: Float64,
    settings: RefineSettings,
) -> DepthMap:
    """The depth map with finer depths; a pixel that too few neighbours show, or match, becomes unknown.

    Args:
        depth_map: of the frame, from the sweep.
        reference: the frame.
        others: N neighbours.
        other_from_frame: (N, 4, 4).
        settings: of the refinement.
    """
    if settings.steps == 0 or depth_map.known == 0:
        return depth_map
    K, (width, height) = depth_map.K, reference.size
    A = K @ other_from_frame[:, :3, :3] @ np.linalg.inv(K)
    b = other_from_frame[:, :3, 3] @ K.T
    values = reference.grey.astype(np.float32)
    inverse_depth = depth_map.inverse_depth.astype(np.float64)
    fitted = np.zeros_like(inverse_depth)
    scores, ups, downs = (np.zeros((len(others), height, width), np.float32) for _ in range(3))
    mean_score = np.zeros((height, width), np.float32)
    for _ in range(settings.steps):
        fit_surfaces(inverse_depth, settings.same_surface, fitted)
        for n, other in enumerate(others):
            measure(values, other.packed, A[n], b[n], fitted, scores[n], ups[n], downs[n])
        move(fitted, scores, ups, downs, (len(others) + 1) // 2, settings.max_step, inverse_depth, mean_score)
    keep = (inverse_depth > 0) & (mean_score >= settings.min_score)
    depth = np.where(keep, 1 / np.where(keep, inverse_depth, 1), 0).astype(np.float32)
    return replace(depth_map, depth=depth, confidence=np.where(keep, depth_map.confidence, 0).astype(np.float32))
