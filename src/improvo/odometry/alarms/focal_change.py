"""Did the lens zoom between two frames? Every distance in the picture grows at once, and no motion explains it.

Two views cannot tell a zoom from a step ahead: both move every point along a line through the middle of the picture.
The map can, since a step moves near points more than far ones. So where distances between tracked keypoints change by
more than a few percent in one frame, the pose from map points is found twice, with the camera as it is given and with
the focal length scaled by that change. If the second explains clearly more points, the lens has changed.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from improvo.geometry.camera import Camera
from improvo.geometry.ransac import Ransac, absolute_pose
from improvo.odometry.gates import FEWEST
from improvo.odometry.view import View, common_tracks
from improvo.types import Float64

_SAME_LENS = np.log(1.08)  # change of the focal length that is none; a step ahead rarely changes distances by more
_BETTER = 1.25  # times as many points must fit with the other focal length


class LensWatch:
    """What the lens is now: a change holds for all that follows, until the next one.

    Args:
        camera: as it is given.
        tolerance: pixels; the map allows twice that, but a zoom is told by what lies close.
        seed: of the RANSAC.
    """

    def __init__(self, camera: Camera, tolerance: float, seed: int) -> None:
        self._camera, self._tolerance, self._seed = camera, tolerance, seed
        self.factor = 1.0  # of the focal length now, times that of the camera as given

    def changed(self, before: View, view: View, xyz: Float64) -> bool:
        """Whether the lens changed just before a view.

        Args:
            before: the last view with a pose and points of the map.
            view: the newest, without a pose yet.
            xyz: (P, 3) points of the map.
        """
        if before.frame_index != view.frame_index - 1:
            return False
        change = focal_change(before, view, xyz, self._camera, self._tolerance, self._seed)
        if change == 1.0:
            return False
        self.factor *= change
        if abs(np.log(self.factor)) < _SAME_LENS:
            self.factor = 1.0
        return True


def focal_change(before: View, view: View, xyz: Float64, camera: Camera, tolerance: float, seed: int) -> float:
    """By which factor the focal length changed between two consecutive views; 1 where it did not.

    Args:
        before: with points of the map.
        view: the next one, without a pose yet.
        xyz: (P, 3) points of the map.
        camera: as it is given, of both.
        tolerance: pixels; the map allows twice that, but a zoom is told by what lies close.
        seed: of the RANSAC.
    """
    rows, rows_before = common_tracks(view, before)
    known = before.points[rows_before] >= 0
    rows, rows_before = rows[known], rows_before[known]
    if len(rows) < 2 * FEWEST:
        return 1.0
    factor = _scale(before.keypoints[rows_before], view.keypoints[rows])
    if abs(np.log(factor)) < _SAME_LENS:
        return 1.0
    points, pixels = xyz[before.points[rows_before]], view.keypoints[rows]
    ransac = Ransac(tolerance, seed, min_iterations=100, max_iterations=1000)
    zoomed = replace(camera, fx=camera.fx * factor, fy=camera.fy * factor)
    as_given, changed = (int(absolute_pose(points, pixels, each, ransac).inliers.sum()) for each in (camera, zoomed))
    return factor if changed >= max(_BETTER * as_given, as_given + FEWEST) else 1.0


def _scale(before: Float64, now: Float64) -> float:
    """Median ratio of the distances between matched pixels (N, 2), of pairs that lie well apart."""
    half = len(before) // 2
    order = np.argsort(before[:, 0] + before[:, 1], kind="stable")
    first, second = order[:half], order[half : 2 * half]
    old = np.linalg.norm(before[first] - before[second], axis=1)
    new = np.linalg.norm(now[first] - now[second], axis=1)
    return float(np.median(np.maximum(new, 1e-6) / np.maximum(old, 1e-6)))
