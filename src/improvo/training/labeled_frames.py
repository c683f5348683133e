"""A labeled sequence by frames: the points that a frame shows, and where another frame shows the same ones.

A *landmark* is a map point with all of its tracks, or a track without a map point. Correspondences are of landmarks.
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
from improvo.stability.grouping import medians, rows_of
from improvo.stability.rule import IGNORE, STABLE, UNSTABLE
from improvo.training.settings import LandmarkSettings
from improvo.training.wrong_links import largest_step_shares
from improvo.types import Float32, Float64, Int64, Mask, UInt8

Codes = NDArray[np.int8]


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
    """

    def __init__(self, sequence: LabeledSequence, longer_side: int, settings: LandmarkSettings) -> None:
        self.sequence, self.settings = sequence, settings
        camera = sequence.camera
        self.scale = min(1.0, longer_side / max(camera.width, camera.height))
        self.size = round(camera.width * self.scale), round(camera.height * self.scale)  # width, height
        frames = sequence.frames
        self._poses = sequence.cam_from_world
        self._usable = frames.trusted & (frames.segment >= 0)
        self._index_observations()
        self._mean_direction, self._mean_distance = self._viewpoints()

    def __len__(self) -> int:
        return len(self.sequence.frames)

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

    def useful_frames(self, least: int) -> Int64:
        """Frames whose tracks have at least `least` stable points."""
        stable = self._stability[self._landmark] == STABLE
        frame = np.repeat(np.arange(len(self)), np.diff(self._start))
        return np.flatnonzero(np.bincount(frame[stable], minlength=len(self)) >= least)

    def points(self, frame: int) -> FramePoints:
        """All points that a frame is known to show: observed ones, and stable landmarks that are visible in it."""
        rows = slice(self._start[frame], self._start[frame + 1])
        landmark, places = self._landmark[rows], self._keypoints[rows].astype(np.float64)
        landmark, first = np.unique(landmark, return_index=True)
        places = places[first]
        if self.settings.reprojected:
            places = self._at_projection(frame, landmark, places)
        observed = len(landmark)
        if self.settings.unseen:
            others, projected = self._unseen(frame, landmark)
            landmark, places = np.concatenate([landmark, others]), np.concatenate([places, projected])
        order = np.argsort(self._mean_error[landmark], kind="stable")
        stability = self._stability[landmark[order]]
        return FramePoints(self._to_picture(places[order]), landmark[order], stability, order < observed)

    def taught_stability(self) -> tuple[int, int]:
        """How many observations of stable, and of unstable points there are."""
        codes = self._stability[self._landmark]
        return int((codes == STABLE).sum()), int((codes == UNSTABLE).sum())

    def _index_observations(self) -> None:
        """Observations sorted by frame, and the landmark that each of them is of."""
        table, points = self.sequence.tracks, self.sequence.points
        order = np.argsort(table.frame, kind="stable")
        self._start = np.searchsorted(table.frame[order], np.arange(len(self) + 1))
        self._keypoints: Float32 = table.keypoints[order]
        track_of_row = rows_of(points.track, table.track)
        track = track_of_row[order]
        landmark_of_track, stability = self._landmarks_of_tracks()
        unsure = medians(track_of_row, table.error, len(points)) < self.settings.unstable_median_error
        if self.settings.unstable_largest_step < 1:
            unsure |= ~(largest_step_shares(self.sequence) <= self.settings.unstable_largest_step)
        stability = np.where((stability == UNSTABLE) & unsure, IGNORE, stability).astype(np.int8)
        _, representative, landmark_of_track = np.unique(landmark_of_track, return_index=True, return_inverse=True)
        self._landmark: Int64 = landmark_of_track[track]
        self._stability: Codes = stability[representative]
        self._xyz, self._segment = points.xyz[representative], points.segment[representative]
        self._mean_error = np.nan_to_num(points.mean_error[representative].astype(np.float64), nan=np.inf)

    def _landmarks_of_tracks(self) -> tuple[Int64, Codes]:
        """The landmark (T,) and its stability (T,) for every track.

        Tracks of one map point are one landmark if the stability rule, applied to all of their observations together,
        says stable. Short tracks, which have no label alone, then teach too. Other tracks are landmarks of their own.
        """
        points, rule = self.sequence.points, self.sequence.rule
        alone = -1 - np.arange(len(points))
        if not self.settings.shared:
            return alone, points.stability
        owned = np.flatnonzero(
            (points.point >= 0) & (points.segment >= 0) & ~points.withheld & (points.stability != UNSTABLE)
            & (points.max_error < rule.unstable_max_error)
        )  # fmt: skip
        key = points.point[owned] * (points.segment.max(initial=0) + 1) + points.segment[owned]
        _, group = np.unique(key, return_inverse=True)
        observations = np.bincount(group, points.observations[owned])
        mean_error = np.bincount(group, points.observations[owned] * points.mean_error[owned]) / np.maximum(
            observations, 1
        )
        stable = (observations >= rule.min_observations) & (mean_error <= rule.stable_mean_error)
        landmark, stability = alone, points.stability.copy()
        joined = owned[stable[group]]
        landmark[joined], stability[joined] = key[stable[group]], STABLE
        return landmark, stability

    def _viewpoints(self) -> tuple[Float64, Float64]:
        """Mean unit direction (L, 3) from each landmark to the cameras that saw it, and mean distance (L,)."""
        frame = np.repeat(np.arange(len(self)), np.diff(self._start))
        known = (self.sequence.frames.segment[frame] == self._segment[self._landmark]) & (
            self._segment[self._landmark] >= 0
        )
        frame, landmark = frame[known], self._landmark[known]
        rotation, translation = self._poses[:, :3, :3], self._poses[:, :3, 3]
        centres = -np.einsum("fji,fj->fi", rotation, translation)
        rays = centres[frame] - self._xyz[landmark]
        distance = np.linalg.norm(rays, axis=1)
        count = np.maximum(np.bincount(landmark, minlength=len(self._xyz)), 1)
        unit = rays / np.maximum(distance, 1e-12)[:, None]
        total: Float64 = np.stack([np.bincount(landmark, unit[:, axis], len(count)) for axis in range(3)], axis=1)
        direction: Float64 = total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-12)
        return direction, np.bincount(landmark, distance, len(count)) / count

    def _project(self, frame: int, landmark: Int64) -> tuple[Float64, Float64]:
        """Pixels of the recording (N, 2) and depths (N,); NaN pixels behind the camera."""
        camera_points = transform(self._poses[frame], self._xyz[landmark])
        depth = camera_points[:, 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            pixels = self.sequence.camera.project(camera_points)
        return np.where(depth[:, None] > 0, pixels, np.nan), depth

    def _at_projection(self, frame: int, landmark: Int64, places: Float64) -> Float64:
        """Stable points at the projections of their 3D points, which are the means of all observations."""
        if not self._usable[frame]:
            return places
        moved = (self._stability[landmark] == STABLE) & (self._segment[landmark] == self.sequence.frames.segment[frame])
        projected, _ = self._project(frame, landmark)
        near = np.linalg.norm(projected - places, axis=1) <= self.settings.largest_correction
        return np.where((moved & near)[:, None], projected, places)

    def _unseen(self, frame: int, observed: Int64) -> tuple[Int64, Float64]:
        """Stable landmarks that no track saw in the frame but that are visible in it, and their pixels."""
        settings, camera = self.settings, self.sequence.camera
        nothing = np.zeros(0, np.int64), np.zeros((0, 2))
        if not self._usable[frame]:
            return nothing
        here = (self._stability == STABLE) & (self._segment == self.sequence.frames.segment[frame])
        in_frame = np.zeros(len(here), np.bool_)
        in_frame[observed] = True
        rows = np.flatnonzero(here & ~in_frame & np.isfinite(self._xyz).all(axis=1))
        seen = observed[here[observed]]
        if not len(rows) or not len(seen):
            return nothing
        pixels, depth = self._project(frame, rows)
        with np.errstate(invalid="ignore"):
            inside = ((pixels >= 0) & (pixels <= [camera.width - 1, camera.height - 1])).all(axis=1)
        rotation, translation = self._poses[frame, :3, :3], self._poses[frame, :3, 3]
        rays = -rotation.T @ translation - self._xyz[rows]
        distance = np.linalg.norm(rays, axis=1)
        cosine = np.einsum("ni,ni->n", rays, self._mean_direction[rows]) / np.maximum(distance, 1e-12)
        ratio = distance / np.maximum(self._mean_distance[rows], 1e-12)
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
