"""Compiling every kernel that a run uses before its first frame, so that the first frames do not look stuck."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from improvo.backend.compile import compile_kernels, kernels_are_cached
from improvo.compiled import all_cached
from improvo.frontend import corners
from improvo.odometry.mapping import projection_search
from improvo.odometry.refinement import patch_alignment
from improvo.tracking import matching

_OTHER_KERNELS = (
    matching.nearest_both_ways,
    projection_search.best_in_radius,
    corners.move_to_corners,
    patch_alignment.cut_patches,
    patch_alignment.repeated,
    patch_alignment.align_patches,
)


def compile_odometry(progress: Callable[[str], None] | None = None) -> None:
    """Run every compiled kernel of a run once: of the frontend, of matching, of the search and of the backend.

    Args:
        progress: is told once, in a few words, if something has to be compiled; that takes seconds, once per
            installation.
    """
    if progress is not None and not (kernels_are_cached() and all_cached(_OTHER_KERNELS)):
        progress("compiling the odometry (once, about 20 s)")
    compile_kernels()
    _compile_matching()
    _compile_corners()
    _compile_refinement()


def _compile_matching() -> None:
    """Of frames, and of projected map points: float32 descriptors, float64 pixels."""
    descriptors = np.eye(4, dtype=np.float32)
    pixels = np.arange(8.0).reshape(4, 2)
    matching.match_units(descriptors, descriptors)
    projection_search.match_by_projection(pixels, descriptors, pixels, descriptors, radius=2.0, max_distance=0.7)


def _compile_corners() -> None:
    """What moves a network's keypoints to corners: a float32 image and float32 pixels."""
    corners.refine_to_corners(np.zeros((40, 40), np.float32), np.full((1, 2), 20.0, np.float32), radius=2)


def _compile_refinement() -> None:
    """What aligns patches: an image of bytes and float64 pixels."""
    image, pixels = np.zeros((40, 40), np.uint8), np.full((1, 2), 20.0)
    patches = patch_alignment.cut_patches(image, pixels)
    patch_alignment.repeated(patches)
    middles = patch_alignment.patch_middles(pixels)
    patch_alignment.align(image, pixels, patches, middles, np.eye(2)[None], max_move=1.0)
