"""Compiling every kernel that a run uses before its first frame, so that the first frames do not look stuck."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from improvo.backend.compile import compile_kernels, kernels_are_cached
from improvo.compiled import all_cached
from improvo.frontend import corners
from improvo.odometry import projection_search
from improvo.tracking import matching

_OTHER_KERNELS = (matching.nearest_both_ways, projection_search.best_in_radius, corners.move_to_corners)


def compile_odometry(progress: Callable[[str], None] | None = None) -> None:
    """Run every compiled kernel of a run once: of the frontend, of matching, of the search and of the backend.

    Args:
        progress: is told once, in a few words, if something has to be compiled; that takes seconds, once per
            installation.
    """
    if progress is not None and not (kernels_are_cached() and all_cached(_OTHER_KERNELS)):
        progress("compiling the odometry (once, about 20 s)")
    compile_kernels()
    descriptors = np.eye(4, dtype=np.float32)
    keypoints = 10.0 * np.arange(8.0).reshape(4, 2)
    matching.match_units(descriptors, descriptors)
    projection_search.match_by_projection(keypoints, descriptors, keypoints, descriptors, radius=2.0, max_distance=0.7)
    corners.refine_to_corners(np.zeros((80, 80), np.float32), keypoints.astype(np.float32), radius=2)
