"""A labeled sequence by frames: the points that a frame shows, and where another frame shows the same ones.

Correspondences are of landmarks (`improvo.training.data.landmarks`).
Beyond the paper, a stable landmark is also known in frames where no track observed it, if its projection is visible.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from improvo.frontend.masking import unmasked
from improvo.geometry.se3 import transform
from improvo.labeling.labeled import LabeledSequence
from improvo.stability.rule import STABLE
from improvo.training.data.landmarks import Codes, Landmarks, Summary, find_landmarks
from improvo.training.settings import LandmarkSettings
from improvo.types import Float64, Int64, Mask, UInt8


@dataclass(frozen=True)
class FramePoints:
    """What is known of one frame, best points first; pixels of the training picture."""

    points: Float64  # (N, 2)
    landmark: Int64  # (N,)
    stability: Codes  # (N,) codes of `improvo.stability.rule`
    seen: NDArray[np.bool_]  # (N,) whether a track observed it in this frame; else only its projection is known


class LabeledFrames:
    """Random access to the frames of one labeled sequence.

    Args:
        sequence: finished labels.
        longer_side: pixels; larger frames are reduced, and points with them.
        settings: what a landmark is.
        landmarks: of the sequence; found from its tables if None.
    """

    def __init__(
        self,
        sequence: LabeledSequence,
        longer_side: int,
        settings: LandmarkSettings,
        landmarks: Landmarks | None = None,
    ) -> None:
        self.sequence, self.settings = sequence, settings
        self.landmarks = landmarks or find_landmarks(sequence, settings)
        camera = self.landmarks.camera
        self.scale = min(1.0, longer_side / max(camera.width, camera.height))
        self.size = round(camera.width * self.scale), round(camera.height * self.scale)  # width, height

    def __len__(self) -> int:
        return len(self.landmarks)

    def picture(self, frame: int) -> UInt8:
        """The grey training picture (H, W)."""
        image = self.sequence.image(frame)
        if (image.shape[1], image.shape[0]) == self.size:
            return image
        return np.asarray(cv2.resize(image, self.size, interpolation=cv2.INTER_AREA), np.uint8)

    def mask(self, frame: int) -> Mask | None:
        """Which pixels of the training picture (H, W) are used; None are all."""
        mask = self.sequence.mask(frame)
        if mask is None:
            return None
        return np.asarray(cv2.resize(mask.astype(np.uint8) * 255, self.size, interpolation=cv2.INTER_AREA) == 255)

    def summary(self) -> Summary:
        """What is known of the sequence without drawing from it."""
        return self.landmarks.summary()

    def points(self, frame: int) -> FramePoints:
        """All points that a frame is known to show: observed ones, and stable landmarks that are visible in it."""
        landmarks = self.landmarks
        landmark, places = landmarks.observed(frame)
        landmark, first = np.unique(landmark, return_index=True)
        places = places[first]
        if self.settings.reprojected:
            places = self._at_projection(frame, landmark, places)
        observed = len(landmark)
        if self.settings.unseen:
            others, projected = self._unseen(frame, landmark)
            landmark, places = np.concatenate([landmark, others]), np.concatenate([places, projected])
        order = np.argsort(landmarks.mean_error[landmark], kind="stable")
        stability = landmarks.stability[landmark[order]]
        return FramePoints(self._to_picture(places[order]), landmark[order], stability, order < observed)

    def _usable(self, frame: int) -> bool:
        return bool(self.landmarks.trusted[frame] and self.landmarks.frame_segment[frame] >= 0)

    def _project(self, frame: int, landmark: Int64) -> tuple[Float64, Float64]:
        """Pixels of the recording (N, 2) and depths (N,); NaN pixels behind the camera."""
        camera_points = transform(self.landmarks.cam_from_world[frame], self.landmarks.xyz[landmark])
        depth = camera_points[:, 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            pixels = self.landmarks.camera.project(camera_points)
        return np.where(depth[:, None] > 0, pixels, np.nan), depth

    def _at_projection(self, frame: int, landmark: Int64, places: Float64) -> Float64:
        """Stable points at the projections of their 3D points, which are the means of all observations."""
        if not self._usable(frame):
            return places
        landmarks = self.landmarks
        moved = landmarks.stability[landmark] == STABLE
        moved &= landmarks.segment[landmark] == landmarks.frame_segment[frame]
        projected, _ = self._project(frame, landmark)
        near = np.linalg.norm(projected - places, axis=1) <= self.settings.largest_correction
        return np.where((moved & near)[:, None], projected, places)

    def _unseen(self, frame: int, observed: Int64) -> tuple[Int64, Float64]:
        """Stable landmarks that no track saw in the frame but that are visible in it, and their pixels."""
        settings, landmarks = self.settings, self.landmarks
        camera = landmarks.camera
        nothing = np.zeros(0, np.int64), np.zeros((0, 2))
        if not self._usable(frame):
            return nothing
        here = (landmarks.stability == STABLE) & (landmarks.segment == landmarks.frame_segment[frame])
        in_frame = np.zeros(len(here), np.bool_)
        in_frame[observed] = True
        rows = np.flatnonzero(here & ~in_frame & np.isfinite(landmarks.xyz).all(axis=1))
        seen = observed[here[observed]]
        if not len(rows) or not len(seen):
            return nothing
        pixels, depth = self._project(frame, rows)
        with np.errstate(invalid="ignore"):
            inside = ((pixels >= 0) & (pixels <= [camera.width - 1, camera.height - 1])).all(axis=1)
        rotation, translation = landmarks.cam_from_world[frame, :3, :3], landmarks.cam_from_world[frame, :3, 3]
        rays = -rotation.T @ translation - landmarks.xyz[rows]
        distance = np.linalg.norm(rays, axis=1)
        cosine = np.einsum("ni,ni->n", rays, landmarks.mean_direction[rows]) / np.maximum(distance, 1e-12)
        ratio = distance / np.maximum(landmarks.mean_distance[rows], 1e-12)
        seen_alike = cosine >= np.cos(np.radians(settings.largest_view_angle_degrees))
        seen_alike &= (ratio <= settings.largest_distance_ratio) & (ratio >= 1 / settings.largest_distance_ratio)
        kept = np.flatnonzero(inside & seen_alike)
        mask = self.sequence.mask(frame)
        if mask is not None:
            kept = kept[unmasked(pixels[kept].astype(np.float32), mask)]
        kept = kept[~self._hidden(frame, seen, pixels[kept], depth[kept])]
        return rows[kept], pixels[kept]

    def _hidden(self, frame: int, seen: Int64, pixels: Float64, depth: Float64) -> NDArray[np.bool_]:
        """(N,) whether a point may be hidden.

        Either an observed point is near it in the image and clearly nearer to the camera, or no observed point is near
        it at all. A person who walks through the picture hides the wall behind and has no stable points.
        """
        from scipy.spatial import cKDTree

        if not len(pixels):
            return np.zeros(0, np.bool_)
        shown, shown_depth = self._project(frame, seen)
        known = np.isfinite(shown).all(axis=1)
        if not known.any():
            return np.ones(len(pixels), np.bool_)
        neighbours = min(4, int(known.sum()))
        distance, nearest = cKDTree(shown[known]).query(pixels, k=neighbours)
        distance, nearest = distance.reshape(len(pixels), -1), nearest.reshape(len(pixels), -1)
        nearer = shown_depth[known][nearest] < (1 - self.settings.occlusion_depth) * depth[:, None]
        close = distance * self.scale <= self.settings.occlusion_pixels
        return np.asarray((nearer & close).any(axis=1) | ~close.any(axis=1))

    def _to_picture(self, pixels: Float64) -> Float64:
        return (pixels + 0.5) * self.scale - 0.5


def common_points(a: FramePoints, b: FramePoints) -> tuple[Int64, Int64]:
    """Rows of `a` and of `b` that are the same stable landmark."""
    stable_a, stable_b = np.flatnonzero(a.stability == STABLE), np.flatnonzero(b.stability == STABLE)
    _, rows_a, rows_b = np.intersect1d(a.landmark[stable_a], b.landmark[stable_b], return_indices=True)
    return stable_a[rows_a], stable_b[rows_b]
