"""Observations of a map point moved to where the patch of its first picture lies, so that all mean one place.

A network's keypoints are about half a pixel off, each in its own way. The patch of the first picture that showed a map
point (its anchor) is warped by the two poses and the point's depth, and aligned with each further picture
(`patch_alignment.py`). The search begins at the point's projection, as in semi-direct odometry (Forster, Pizzoli and
Scaramuzza, 2014). Where it fails, or ends too far from the detected keypoint, that keypoint stays.
"""

from __future__ import annotations

from collections.abc import Iterable

import cv2
import numpy as np

from improvo.geometry import se3
from improvo.geometry.camera import Camera
from improvo.odometry.gates import MEMORY_FRAMES, gate
from improvo.odometry.point_store import PointStore
from improvo.odometry.refinement.anchors import Anchors
from improvo.odometry.refinement.patch_alignment import align, cut_patches, repeated, warps_between
from improvo.odometry.view import View
from improvo.types import Float64, Int64, UInt8

_FORGET_EVERY = 10  # frames
_MAX_MOVE = 4.0 / 3.0  # times the tolerance, from the detected keypoint; one that would go farther stays
_MIN_CORRELATION = 0.8  # of the grey values of both patches
_MAX_DEVIATION = 0.3  # pixels, expected error of the new place
_MAX_AREA_RATIO = 2.5  # between two pictures; beyond it the patch is taken anew from the newer one
_BLUR = 0.8  # pixels: sampling between pixels blurs unevenly, unless the picture is a little blurred before


def prepared(image: UInt8) -> UInt8:
    """A grey picture (H, W) or a blue-green-red one (H, W, 3) as the refinement reads it: grey, a little blurred."""
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    return np.asarray(cv2.GaussianBlur(grey, (0, 0), _BLUR), np.uint8)


class KeypointRefiner:
    """The anchors of one map, and the poses that they were seen from.

    Args:
        camera: pinhole, of all views.
        tolerance: pixels; the search begins within twice that.
    """

    def __init__(self, camera: Camera, tolerance: float) -> None:
        self._camera = camera
        self._focal = np.array([camera.fx, camera.fy])
        self._max_start, self._max_move = gate(tolerance), _MAX_MOVE * tolerance
        self._anchors = Anchors()
        self._poses: dict[int, Float64] = {}  # cam_from_world of the views that anchors were cut from

    def update_poses(self, views: Iterable[View]) -> None:
        """The poses of views may have changed."""
        for view in views:
            if view.cam_from_world is not None and view.image is not None:
                self._poses[view.frame_index] = view.cam_from_world

    def refine(self, observations: Iterable[tuple[View, Int64]], store: PointStore) -> None:
        """Move keypoints that were not moved yet; a point without an anchor gets one.

        Args:
            observations: views with poses, those that are to be anchors first, and rows of keypoints that observe a
                point in them. A view without a picture is passed over.
            store: the points.
        """
        for view, rows in observations:
            if view.image is None or view.cam_from_world is None:
                continue
            self._poses[view.frame_index] = view.cam_from_world
            if view.frame_index % _FORGET_EVERY == 0:
                self._forget(view.frame_index - MEMORY_FRAMES, store)
            dropped = view.refined & (view.points < 0)
            view.keypoints[dropped], view.refined[dropped] = view.detected[dropped], False
            rows = rows[~view.refined[rows]]
            slots = self._anchors.slots(view.points[rows])
            self._anchor(view, rows[slots < 0])
            known = slots >= 0
            rows, slots = rows[known], slots[known]
            usable = self._anchors.usable[slots]
            self._move(view, rows[usable], slots[usable], store)

    def _move(self, view: View, rows: Int64, slots: Int64, store: PointStore) -> None:
        """Keypoints of `view` go to where the patches of the slots lie."""
        assert view.image is not None
        assert view.cam_from_world is not None
        if len(rows) == 0:
            return
        anchors = self._anchors
        xyz = store.xyz[view.points[rows]]
        xyz_cam = se3.transform(view.cam_from_world, xyz)
        frames, of_frame = np.unique(anchors.frame_index[slots], return_inverse=True)
        poses = np.stack([self._poses[frame] for frame in frames.tolist()])
        depth = np.einsum("nj,nj->n", poses[of_frame, 2, :3], xyz) + poses[of_frame, 2, 3]
        rotations = view.cam_from_world[:3, :3] @ poses[:, :3, :3].transpose(0, 2, 1)
        warps, visible = warps_between(rotations[of_frame], xyz_cam, depth, self._focal)
        detected = view.detected[rows]
        xyz_cam[~visible, 2] = 1.0
        projected = self._camera.project(xyz_cam)
        near = visible & (np.linalg.norm(projected - detected, axis=1) < self._max_start)
        starts = np.where(near[:, None], projected, detected)
        limit = self._max_start + self._max_move
        found = align(view.image, starts, anchors.patches[slots], anchors.middles[slots], warps, limit)
        good = (
            visible
            & (found.correlation >= _MIN_CORRELATION)
            & (found.deviation <= _MAX_DEVIATION)
            & (np.linalg.norm(found.places - detected, axis=1) <= self._max_move)
        )
        view.keypoints[rows[good]] = found.places[good]
        view.refined[rows[good]] = True
        area = np.abs(np.linalg.det(warps))
        outgrown = good & ((area > _MAX_AREA_RATIO) | (area < 1.0 / _MAX_AREA_RATIO))
        self._anchor(view, rows[outgrown])

    def _anchor(self, view: View, rows: Int64) -> None:
        """Cut patches around keypoints of `view`; they are where they are."""
        if len(rows) == 0:
            return
        pixels = view.keypoints[rows]
        patches = cut_patches(view.image, pixels)
        self._anchors.put(view.points[rows], view.frame_index, patches, pixels, ~repeated(patches))
        view.refined[rows] = True

    def _forget(self, before: int, store: PointStore) -> None:
        self._anchors.forget(store.last_seen, before)
        in_use = self._anchors.frames()
        self._poses = {frame: pose for frame, pose in self._poses.items() if frame in in_use or frame >= before}
