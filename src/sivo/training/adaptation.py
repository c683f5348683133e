"""Homographic adaptation (SuperPoint, section 5): label pictures with what a detector finds again in many views.

Any detector can be adapted: a trained network, or classical corners for a first round without one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import cv2
import numpy as np
import torch
from tqdm import tqdm

from sivo.frontend.superpoint import SuperPoint, heat_map
from sivo.training.labels import Consensus, PointLabels
from sivo.training.pictures import Pictures
from sivo.training.settings import AdaptationSettings, ViewSettings
from sivo.training.views import random_view, warp_image
from sivo.types import Float32, UInt8

# views of one picture, all of one size -> keypoints (N, 2) of each
Detector = Callable[[Sequence[UInt8]], list[Float32]]


def shi_tomasi(keypoints: int = 120, distance: int = 4) -> Detector:
    """Classical corners as a detector to adapt."""

    def detect(views: Sequence[UInt8]) -> list[Float32]:
        found = [cv2.goodFeaturesToTrack(view, keypoints, 0.01, distance, blockSize=3) for view in views]
        return [np.zeros((0, 2), np.float32) if points is None else points.reshape(-1, 2) for points in found]

    return detect


def network_detector(
    network: SuperPoint, device: torch.device, settings: AdaptationSettings, threshold: float = 0.015
) -> Detector:
    """A trained detector; the views of a picture go through it as one batch."""
    network = network.eval().to(device, memory_format=torch.channels_last)
    suppressed = np.ones((2 * settings.suppression + 1,) * 2, np.uint8)

    def detect(views: Sequence[UInt8]) -> list[Float32]:
        with torch.inference_mode():
            images = torch.from_numpy(np.stack(views)[:, None]).to(device).float() / 255
            images = images.contiguous(memory_format=torch.channels_last)
            heat_maps = heat_map(network.detector(network.encode(images)).float()).cpu().numpy()
        return [strongest(heat, threshold) for heat in heat_maps]

    def strongest(heat: Float32, threshold: float) -> Float32:
        y, x = np.nonzero((heat == cv2.dilate(heat, suppressed)) & (heat >= threshold))
        order = np.argsort(-heat[y, x], kind="stable")[: settings.keypoints_per_view]
        return np.stack([x, y], axis=1).astype(np.float32)[order]

    return detect


def adapt(
    pictures: Pictures, detect: Detector, settings: AdaptationSettings, views: ViewSettings, seed: int, progress: bool
) -> list[list[PointLabels]]:
    """Labels of every picture of every source, by the agreement of `detect` over random views."""
    result = []
    with tqdm(total=len(pictures), desc="homographic adaptation", unit="picture", disable=not progress) as bar:
        for s, source in enumerate(pictures.sources):
            labels = []
            for p, picture in enumerate(source.pictures):
                labels.append(_adapt_one(picture, detect, settings, views, np.random.default_rng([seed, s, p])))
                bar.update()
            result.append(labels)
    return result


def _adapt_one(
    picture: UInt8, detect: Detector, settings: AdaptationSettings, views: ViewSettings, rng: np.random.Generator
) -> PointLabels:
    height, width = picture.shape
    size = (views.width, views.height)
    homographies = [random_view(rng, views, (width, height)) for _ in range(settings.views)]
    warped = [warp_image(picture, H, *size) for H in homographies]
    consensus = Consensus(width, height)
    for keypoints, H in zip(detect(warped), homographies, strict=True):
        consensus.add(keypoints, H, size, settings.border)
    return consensus.labels(settings)
