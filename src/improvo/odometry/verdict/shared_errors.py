"""What neighbours in the picture are off by together: a map that follows a crowd fits it only so well.

The noise of keypoints is each one's own. Where a map follows several motions at once, whole parts of the picture are
off by the same: each person who walks by, each wall. So the variance of the residuals within a
keyframe and a cell of the picture is parted into what the cell's observations share and what is their own, by the
products of its pairs (the intraclass correlation, Fisher 1925). It needs no idea of how exact the keypoints are, which
differs between frontends.
"""

from __future__ import annotations

import numpy as np

from improvo.geometry.camera import Camera
from improvo.odometry.gates import FEWEST
from improvo.odometry.verdict.evidence_window import EvidenceWindow

_COLUMNS, _ROWS = 16, 12  # cells of the picture: about as large as a person's trunk or arm
_OUTLIER = 5.0  # times the median error: an observation so far off says nothing of its neighbours


def shared_error(window: EvidenceWindow, camera: Camera) -> float:
    """Pixels, standard deviation of one coordinate, that the observations of one cell and keyframe have in common.

    Args:
        window: of keyframes.
        camera: pinhole, of all.

    Returns:
        0 where neighbours are off independently of each other, or where there are too few of them.
    """
    residuals, rows = window.residuals(camera)
    errors = np.linalg.norm(residuals, axis=1)
    use = errors <= _OUTLIER * (np.median(errors) if len(errors) else 0.0)
    residuals, rows = residuals[use], rows[use]
    size = np.array([_COLUMNS / camera.width, _ROWS / camera.height])
    column, row = np.clip(window.keypoints[rows] * size, 0, (_COLUMNS - 1, _ROWS - 1)).astype(np.int64).T
    _, cell, count = np.unique(
        (window.camera[rows] * _ROWS + row) * _COLUMNS + column, return_inverse=True, return_counts=True
    )
    several = count > 1
    if count[several].sum() < FEWEST:
        return 0.0
    sums = np.stack([np.bincount(cell, residuals[:, axis]) for axis in (0, 1)], axis=1)
    squares = np.bincount(cell, (residuals**2).sum(axis=1))
    # mean product of two different observations of a cell, which weighs with its observations
    products = ((sums**2).sum(axis=1) - squares)[several] / (count[several] - 1)
    shared = products.sum() / count[several].sum()
    return float(np.sqrt(max(0.5 * shared, 0.0)))
