"""Pairs of views of one picture, with exact correspondences: the batches of `improvo train homographies`."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from improvo.training.augmentation.photometric import augment
from improvo.training.augmentation.views import cell_centres, inside, random_view, warp_image, warp_points
from improvo.training.batches.seeded import Batch, SeededBatches
from improvo.training.data.pictures import Pictures
from improvo.training.data.point_labels import PointLabels, label_cells
from improvo.training.settings import HINGE, HomographiesSettings
from improvo.types import Float32, Float64, Int64, UInt8


@dataclass(frozen=True)
class View:
    """One picture seen through a homography and another light."""

    image: UInt8  # (H, W)
    cells: Int64  # (Hc, Wc) see `label_cells`
    keypoints: Float64  # (N, 2) accepted labels inside the view, pixels
    view_from_picture: Float64  # (3, 3)


class PairBatches(SeededBatches):
    """Batches of (2B) images, first the a views, then the b views.

    A batch has `images` (2B, 1, H, W) uint8, `cells` (2B, Hc, Wc) int64, `points_a` and `points_b` (B, N, 2) float32
    pixels that show the same place, and `valid` (B, N) bool.

    Args:
        pictures: of all sources.
        labels: keypoints of every picture of every source.
        settings: of the stage.
    """

    def __init__(self, pictures: Pictures, labels: list[list[PointLabels]], settings: HomographiesSettings) -> None:
        super().__init__(settings)
        self.pictures, self.labels, self.settings = pictures, labels, settings

    def __getitem__(self, step: int) -> Batch:
        pairs = [self.pair(rng) for rng in self.generators(step)]
        a, b, points = [p[0] for p in pairs], [p[1] for p in pairs], [p[2] for p in pairs]
        return {
            "images": np.stack([view.image for view in a + b])[:, None],
            "cells": np.stack([view.cells for view in a + b]),
            "points_a": np.stack([p[0] for p in points]),
            "points_b": np.stack([p[1] for p in points]),
            "valid": np.stack([p[2] for p in points]),
        }

    def pair(self, rng: np.random.Generator) -> tuple[View, View, tuple[Float32, Float32, np.ndarray]]:
        """Two views, and places in the first, in the second, and whether both show them."""
        source_index, index_a = self.pictures.draw(rng)
        source = self.pictures.sources[source_index]
        index_b = self._partner(rng, source_index, index_a)
        b_from_a = source.homography(index_a, index_b)
        height, width = source.pictures[index_a].shape
        view_a = self._view(rng, source_index, index_a, None)
        middle = np.array([[(self.settings.views.width - 1) / 2, (self.settings.views.height - 1) / 2]])
        centre = warp_points(b_from_a @ np.linalg.inv(view_a.view_from_picture), middle)[0]
        if not inside(centre, width, height):
            index_b, b_from_a = index_a, np.eye(3)
            centre = warp_points(np.linalg.inv(view_a.view_from_picture), middle)[0]
        view_b = self._view(rng, source_index, index_b, centre)
        H = view_b.view_from_picture @ b_from_a @ np.linalg.inv(view_a.view_from_picture)
        return view_a, view_b, self._points(rng, view_a, view_b, H, (width, height))

    def _partner(self, rng: np.random.Generator, source_index: int, index: int) -> int:
        """Another picture of a camera that only turned, for half of such pairs; else the same picture."""
        source = self.pictures.sources[source_index]
        if source.rotating is None or rng.uniform() < 0.5:
            return index
        return int(np.clip(index + rng.integers(-8, 9), 0, len(source.pictures) - 1))

    def _view(self, rng: np.random.Generator, source: int, index: int, centre: Float64 | None) -> View:
        settings = self.settings
        width, height = settings.views.width, settings.views.height
        picture, labels = self.pictures.sources[source].pictures[index], self.labels[source][index]
        H = random_view(rng, settings.views, (picture.shape[1], picture.shape[0]), centre)
        image = augment(warp_image(picture, H, width, height), rng, settings.photometric)
        visible = cv2.warpPerspective(np.ones_like(picture), H, (width, height), flags=cv2.INTER_NEAREST) > 0
        points = warp_points(H, labels.points)
        cells = label_cells(points, labels.agreement, visible, width, height, settings.adaptation)
        accepted = (labels.agreement >= settings.adaptation.accepted) & inside(points, width, height)
        return View(image, cells, points[accepted], H)

    def _points(
        self, rng: np.random.Generator, a: View, b: View, b_from_a: Float64, picture_size: tuple[int, int]
    ) -> tuple[Float32, Float32, np.ndarray]:
        """Half at keypoints of view a, the rest anywhere; for the hinge loss the centres of all cells."""
        settings = self.settings
        width, height = settings.views.width, settings.views.height
        if settings.descriptor_loss == HINGE:
            points_a = cell_centres(width, height)
        else:
            points_a = rng.uniform((0, 0), (width - 1, height - 1), (settings.points, 2)).astype(np.float32)
            chosen = rng.permutation(len(a.keypoints))[: settings.points // 2]
            points_a[: len(chosen)] = a.keypoints[chosen]
        points_b = warp_points(b_from_a, points_a)
        shown_a = warp_points(np.linalg.inv(a.view_from_picture), points_a)
        shown_b = warp_points(np.linalg.inv(b.view_from_picture), points_b)
        valid = inside(points_b, width, height) & inside(shown_a, *picture_size) & inside(shown_b, *picture_size)
        return points_a, np.where(valid[:, None], points_b, 0).astype(np.float32), valid
