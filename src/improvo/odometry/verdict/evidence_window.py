"""A window of keyframes with everything that they observed, for looking at the evidence again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from improvo.backend.problem import BundleProblem
from improvo.geometry.camera import Camera
from improvo.types import Float64, Int64, Mask


@dataclass(frozen=True)
class EvidenceKeyframe:
    """A final keyframe with what it observed."""

    frame_index: int
    cam_from_world: Float64  # (4, 4)
    keypoints: Float64  # (N, 2)
    points: Int64  # (N,)
    weights: Float64  # (N,)


@dataclass(frozen=True)
class EvidenceWindow:
    """All observations of a window's keyframes."""

    cam_from_world: Float64  # (W, 4, 4)
    ids: Int64  # (M,) map points, increasing
    xyz: Float64  # (M, 3)
    camera: Int64  # (O,)
    point: Int64  # (O,) row of ids
    keypoints: Float64  # (O, 2)
    weights: Float64  # (O,)

    @property
    def newest(self) -> Int64:
        """Rows of the points that the last keyframe observes."""
        return self.point[self.camera == len(self.cam_from_world) - 1]

    def __len__(self) -> int:
        return len(self.cam_from_world)

    @classmethod
    def of(cls, keyframes: Sequence[EvidenceKeyframe], xyz: Float64) -> EvidenceWindow:
        """The window of some keyframes; xyz (P, 3) are all points of the map."""
        ids, point = np.unique(np.concatenate([keyframe.points for keyframe in keyframes]), return_inverse=True)
        return cls(
            cam_from_world=np.stack([keyframe.cam_from_world for keyframe in keyframes]),
            ids=ids,
            xyz=xyz[ids],
            camera=np.repeat(np.arange(len(keyframes)), [len(keyframe.points) for keyframe in keyframes]),
            point=point.astype(np.int64),
            keypoints=np.concatenate([keyframe.keypoints for keyframe in keyframes]),
            weights=np.concatenate([keyframe.weights for keyframe in keyframes]),
        )

    def problem(self, mask: Mask, K: Float64, keypoints: Float64 | None = None) -> tuple[BundleProblem, Int64]:
        """The bundle adjustment of a part (O,) of the observations, and the rows of the points that it has.

        Args:
            mask: (O,) which observations.
            K: (3, 3) intrinsic matrix.
            keypoints: (O, 2) in place of those observed.
        """
        rows, index = np.unique(self.point[mask], return_inverse=True)
        pixels = self.keypoints if keypoints is None else keypoints
        problem = BundleProblem(
            cam_from_world=self.cam_from_world,
            points=self.xyz[rows],
            camera_index=self.camera[mask],
            point_index=index.astype(np.int64),
            keypoints=pixels[mask],
            weights=self.weights[mask],
            K=K,
            fixed_cameras=np.arange(len(self)) == 0,
        )
        return problem, rows

    def seen_at_least(self, times: int, mask: Mask | None = None) -> Mask:
        """(O,) observations, of a part (O,), of points that this part observes so often."""
        mask = np.ones(len(self.point), np.bool_) if mask is None else mask
        return np.asarray(mask & (np.bincount(self.point[mask], minlength=len(self.ids)) >= times)[self.point])

    def residuals(self, camera: Camera) -> tuple[Float64, Int64]:
        """Pixels (F, 2) that what lies in front of its camera is off, and which observations (F,) these are."""
        in_camera = np.einsum("oij,oj->oi", self.cam_from_world[self.camera, :3, :3], self.xyz[self.point])
        in_camera += self.cam_from_world[self.camera, :3, 3]
        front = np.flatnonzero(in_camera[:, 2] > 0)
        return np.asarray(camera.project(in_camera[front]) - self.keypoints[front]), front

    def across(self) -> Int64:
        """(W - 1,) points that are seen before and after each gap between two keyframes.

        Two observations fix no depth and a scale needs one, so a point counts with three.
        """
        count = len(self)
        first, last = np.full(len(self.ids), count), np.full(len(self.ids), -1)
        np.minimum.at(first, self.point, self.camera)
        np.maximum.at(last, self.point, self.camera)
        known = np.bincount(self.point, minlength=len(self.ids)) >= min(3, count)
        begins, ends = (np.bincount(edge[known], minlength=count) for edge in (first, last))
        return np.asarray((np.cumsum(begins) - np.cumsum(ends))[:-1], np.int64)
