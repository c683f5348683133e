"""The end of a segment that was lost, and where a later view sees it again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from improvo.geometry import se3
from improvo.geometry.a_contrario import SIGNIFICANT, disc_probability, log10_false_alarms
from improvo.geometry.alignment import Similarity
from improvo.geometry.camera import Camera
from improvo.geometry.ransac import Ransac, absolute_pose
from improvo.odometry.gates import FEWEST
from improvo.odometry.mapping.camera_path import CameraPath
from improvo.odometry.view import View
from improvo.tracking.matching import match_units
from improvo.types import Float32, Float64, Int64

_MOST_POINTS = 4000  # the newest; more cost time


@dataclass(frozen=True)
class Sighting:
    """A view with a pose in its own map and in a former one.

    Attributes:
        frame_index: of the view.
        former_from_new: from the world of the view's own map to that of the former one.
        scale_error: standard error of the logarithm of its scale.
        center: (3,) of the camera, in the world of the view's own map.
        former_pose: (4, 4) former_from_cam.
        depth: median distance of the former points from the camera, former units.
        inliers: points of the former map found.
    """

    frame_index: int
    former_from_new: Similarity
    scale_error: float
    center: Float64
    former_pose: Float64
    depth: float
    inliers: int


class FormerMap:
    """Points of a segment that has ended, as its last views saw them.

    Args:
        number: of the segment.
        shared_from_own: from the segment's own world to the one that all segments are placed in.
        views: the last ones, in temporal order; each point takes the descriptor of the newest view that saw it.
        xyz: (P, 3) points of the segment, in its own world.
        camera: pinhole camera of the views.
        descriptor_distance: the matching threshold on unit descriptors.
        max_error: pixels, of a point that is found again.
        seed: of RANSAC.
    """

    def __init__(
        self,
        number: int,
        shared_from_own: Similarity,
        views: Sequence[View],
        xyz: Float64,
        camera: Camera,
        descriptor_distance: float,
        max_error: float,
        seed: int,
    ) -> None:
        self.number, self.shared_from_own = number, shared_from_own
        self.last_frame = max((view.frame_index for view in views), default=-1)
        self.camera_path = CameraPath.of(views).placed(shared_from_own)  # in the world that all segments are placed in
        self._camera = camera
        self._descriptor_distance = descriptor_distance
        self._ransac = Ransac(max_error, seed, min_iterations=100, max_iterations=2000)
        points, descriptors = _newest(views)
        self._xyz: Float64 = xyz[points]
        self._descriptors = descriptors

    def sighting(self, view: View, xyz: Float64) -> Sighting | None:
        """The view's pose in this map, if more of its points are found than chance would give, and the scale between.

        Args:
            view: with a pose and points of its own map.
            xyz: (P, 3) points of that map.
        """
        assert view.cam_from_world is not None
        matches = match_units(self._descriptors, view.descriptors, self._descriptor_distance)
        if len(matches) < FEWEST:
            return None
        former, rows = matches.T
        found = absolute_pose(self._xyz[former], view.keypoints[rows], self._camera, self._ransac)
        inliers = int(found.inliers.sum())
        chance = disc_probability(self._camera.width, self._camera.height, self._ransac.max_error)
        if log10_false_alarms(len(matches), inliers, chance, sample=3, models=4) > SIGNIFICANT:  # P3P
            return None
        both = found.inliers & (view.points[rows] >= 0)
        if both.sum() < FEWEST:
            return None
        in_former = se3.transform(found.pose, self._xyz[former[both]])[:, 2]
        in_new = se3.transform(view.cam_from_world, xyz[view.points[rows[both]]])[:, 2]
        front = (in_former > 0) & (in_new > 0)
        if front.sum() < FEWEST:
            return None
        logs = np.log(in_former[front] / in_new[front])
        log_scale = float(np.median(logs))
        deviation = 1.4826 * float(np.median(np.abs(logs - log_scale)))
        former_pose, own_pose = se3.inverse(found.pose), se3.inverse(view.cam_from_world)
        scale = float(np.exp(log_scale))
        rotation = former_pose[:3, :3] @ own_pose[:3, :3].T
        translation = former_pose[:3, 3] - scale * rotation @ own_pose[:3, 3]
        return Sighting(
            frame_index=view.frame_index,
            former_from_new=Similarity(scale, rotation, translation),
            scale_error=1.2533 * deviation / float(np.sqrt(front.sum())),
            center=own_pose[:3, 3],
            former_pose=former_pose,
            depth=float(np.median(in_former[front])),
            inliers=inliers,
        )


def _newest(views: Sequence[View]) -> tuple[Int64, Float32]:
    """Points (N,) that the views observe, each once, with the descriptors (N, D) of the newest observation."""
    points = np.concatenate([view.points[view.observed] for view in reversed(views)])
    descriptors = np.concatenate([view.descriptors[view.observed] for view in reversed(views)])
    _, first = np.unique(points, return_index=True)
    first = np.sort(first)[:_MOST_POINTS]
    return points[first], descriptors[first]
