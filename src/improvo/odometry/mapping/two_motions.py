"""Are there two motions in the matches of two views? Then one of them is not the camera's, and which is not said.

A person who fills the picture, or a train beside the train, moves as rigidly as the world does. RANSAC takes the motion
with more matches. So a second motion is searched among the matches that are far off the first, with an essential matrix
of its own. It counts if chance does not give such an agreement, and if it is spread over the picture as the first is.
"""

from __future__ import annotations

import numpy as np

from improvo.geometry.a_contrario import SIGNIFICANT, line_probability, log10_false_alarms
from improvo.geometry.camera import Camera
from improvo.geometry.epipolar import sampson_errors
from improvo.geometry.ransac import Ransac, relative_pose
from improvo.odometry.gates import FAR
from improvo.types import Float64, Int64

_LEAST_SPREAD = 0.3  # cells of the picture that the one has, as a share of those of the other
_COLUMNS, _ROWS = 8, 6  # cells of the picture


def has_second_motion(
    first: Float64, camera: Camera, pixels_a: Float64, pixels_b: Float64, ransac: Ransac, least_spread: float
) -> bool:
    """Whether matches that are far off a motion agree on another one.

    Args:
        first: (4, 4) b_from_a of the motion with most matches.
        camera: pinhole, of both views.
        pixels_a: (N, 2) pixels in the first view.
        pixels_b: (N, 2) pixels in the second view.
        ransac: sampling and threshold of the second motion.
        least_spread: cells of the picture that the second motion has, as a share of those of the first.
    """
    errors = sampson_errors(first, camera, pixels_a, pixels_b)
    off = np.flatnonzero(errors > FAR * ransac.max_error)
    if len(off) < 8:
        return False
    second = relative_pose(pixels_a[off], pixels_b[off], camera, ransac)
    chance = line_probability(camera.width, camera.height, ransac.max_error)
    if log10_false_alarms(len(off), int(second.inliers.sum()), chance, sample=5, models=10) > SIGNIFICANT:
        return False
    own = errors <= ransac.max_error
    return spread(camera, pixels_b[off[second.inliers]]) >= least_spread * spread(camera, pixels_b[own])


def holds_beside(errors: Float64, errors_other: Float64, pixels: Float64, camera: Camera, tolerance: float) -> bool:
    """Whether two motions stand beside each other: each is supported by matches that are far off the other one.

    Args:
        errors: (N,) pixels, of all matches to the first motion.
        errors_other: (N,) of all matches to the second. Neither motion may come from matches that were chosen because
            they are far off the other.
        pixels: (N, 2) of the matches in one of the views.
        camera: gives the size of the picture.
        tolerance: pixels.
    """
    chance = line_probability(camera.width, camera.height, tolerance)
    cells = []
    for own, other in ((errors, errors_other), (errors_other, errors)):
        off = other > FAR * tolerance
        supporting = off & (own <= tolerance)
        if log10_false_alarms(int(off.sum()), int(supporting.sum()), chance, sample=0) > SIGNIFICANT:
            return False
        cells.append(spread(camera, pixels[supporting]))
    return min(cells) >= _LEAST_SPREAD * max(cells)


def spread(camera: Camera, pixels: Float64) -> int:
    """Cells of the picture that have any of the pixels (N, 2)."""
    scale = np.array([_COLUMNS / camera.width, _ROWS / camera.height])
    cells: Int64 = np.clip(pixels * scale, 0, (_COLUMNS - 1, _ROWS - 1)).astype(np.int64)
    return len(np.unique(cells[:, 1] * _COLUMNS + cells[:, 0]))
