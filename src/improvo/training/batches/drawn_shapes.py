"""Drawn shapes as training data: a source among photographs, and the batches of `improvo train shapes`."""

from __future__ import annotations

import cv2
import numpy as np

from improvo.training.augmentation.photometric import augment
from improvo.training.augmentation.views import random_view, warp_image, warp_points
from improvo.training.batches.seeded import Batch, SeededBatches
from improvo.training.data.pictures import Source
from improvo.training.data.point_labels import PointLabels, label_cells
from improvo.training.data.shapes import FAMILIES, draw_shape
from improvo.training.settings import AdaptationSettings, ShapesSettings

SIZE = (320, 240)  # width, height of the drawn pictures
_EXACT = AdaptationSettings()  # a drawn corner is a label whatever share of views would be asked for


def shape_source(count: int, seed: int, weight: float) -> tuple[Source, list[PointLabels]]:
    """Drawn pictures, families in turn, with their exact corners as labels that every view agrees on.

    Args:
        count: of pictures.
        seed: of the drawings.
        weight: how often the source is drawn from, relative to the others.
    """
    families = list(FAMILIES)
    pictures, labels = [], []
    for index in range(count):
        image, points = draw_shape(np.random.default_rng([seed, index]), families[index % len(families)], *SIZE)
        pictures.append(image)
        labels.append(PointLabels(points, np.ones(len(points), np.float32)))
    names = tuple(f"{families[index % len(families)]}-{index}" for index in range(count))
    return Source("shapes", tuple(pictures), names, weight), labels


class ShapeBatches(SeededBatches):
    """Batches of freshly drawn shapes: `images` (B, 1, H, W) uint8 and `cells` (B, Hc, Wc) int64."""

    def __init__(self, settings: ShapesSettings) -> None:
        super().__init__(settings)
        self.settings = settings

    def __getitem__(self, step: int) -> Batch:
        settings = self.settings
        families = list(FAMILIES)
        width, height = settings.views.width, settings.views.height
        images, cells = [], []
        for rng in self.generators(step):
            picture, points = draw_shape(rng, families[rng.integers(len(families))], *SIZE)
            H = random_view(rng, settings.views, SIZE)
            images.append(augment(warp_image(picture, H, width, height), rng, settings.photometric))
            visible = cv2.warpPerspective(np.ones_like(picture), H, (width, height), flags=cv2.INTER_NEAREST) > 0
            agreement = np.ones(len(points), np.float32)
            seen = warp_points(H, points)
            cells.append(label_cells(seen, agreement, visible, width, height, _EXACT))
        return {"images": np.stack(images)[:, None], "cells": np.stack(cells)}
