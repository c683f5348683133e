"""Homographic adaptation (SuperPoint, section 5): label pictures with what a detector finds again in many views.

Any detector can be adapted: a trained network, or classical corners for a first round without one.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from improvo import terminal
from improvo.frontend.superpoint import SuperPoint, heat_map
from improvo.training.augmentation.views import random_view, warp_image
from improvo.training.data.pictures import Pictures
from improvo.training.data.point_labels import Consensus, PointLabels
from improvo.training.settings import AdaptationSettings, ViewSettings
from improvo.types import Float32, Float64, UInt8

# picture (H, W), homographies (V, 3, 3) picture to view, view size (width, height) -> keypoints (N, 2) of each view
Detector = Callable[[UInt8, Float64, tuple[int, int]], list[Float32]]


def shi_tomasi(keypoints: int = 120, distance: int = 4) -> Detector:
    """Classical corners as a detector to adapt."""

    def detect(picture: UInt8, homographies: Float64, size: tuple[int, int]) -> list[Float32]:
        views = (warp_image(picture, H, *size) for H in homographies)
        found = [cv2.goodFeaturesToTrack(view, keypoints, 0.01, distance, blockSize=3) for view in views]
        return [np.zeros((0, 2), np.float32) if points is None else points.reshape(-1, 2) for points in found]

    return detect


def network_detector(
    network: SuperPoint, device: torch.device, settings: AdaptationSettings, threshold: float = 0.015
) -> Detector:
    """A trained detector. The views of a picture are made on the device and go through the network as one batch.

    Args:
        network: to adapt.
        device: that it runs on.
        settings: number of keypoints, and their distance.
        threshold: least probability of a keypoint.
    """
    network = network.eval().to(device, memory_format=torch.channels_last)
    suppressed = np.ones((2 * settings.suppression + 1,) * 2, np.uint8)

    def detect(picture: UInt8, homographies: Float64, size: tuple[int, int]) -> list[Float32]:
        with torch.inference_mode():
            views = warp_batch(torch.from_numpy(picture).to(device).float() / 255, homographies, size)
            views = views.contiguous(memory_format=torch.channels_last)
            heat_maps = heat_map(network.detector(network.encode(views)).float()).cpu().numpy()
        return [strongest(heat) for heat in heat_maps]

    def strongest(heat: Float32) -> Float32:
        y, x = np.nonzero((heat == cv2.dilate(heat, suppressed)) & (heat >= threshold))
        order = np.argsort(-heat[y, x], kind="stable")[: settings.keypoints_per_view]
        return np.stack([x, y], axis=1).astype(np.float32)[order]

    return detect


def warp_batch(picture: Tensor, homographies: Float64, size: tuple[int, int]) -> Tensor:
    """Views of a picture, bilinear, mirrored outside.

    Args:
        picture: (H, W) float.
        homographies: (V, 3, 3) picture to view.
        size: width and height of a view, pixels.

    Returns:
        (V, 1, height, width) on the device of the picture.
    """
    width, height = size
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    pixels = torch.stack([x, y, torch.ones_like(x)], dim=-1).reshape(-1, 3).to(picture)
    picture_from_view = torch.from_numpy(np.linalg.inv(homographies)).to(picture)
    shown = pixels @ picture_from_view.transpose(1, 2)
    shown = shown[..., :2] / shown[..., 2:]
    grid = (shown + 0.5) / shown.new_tensor([picture.shape[1], picture.shape[0]]) * 2 - 1
    stack = picture.expand(len(homographies), 1, *picture.shape)
    grid = grid.reshape(-1, height, width, 2)
    return functional.grid_sample(stack, grid, mode="bilinear", padding_mode="reflection", align_corners=False)


def adapt(
    pictures: Pictures, detect: Detector, settings: AdaptationSettings, views: ViewSettings, seed: int, progress: bool
) -> list[list[PointLabels]]:
    """Labels of every picture of every source, by the agreement of a detector over random views.

    Args:
        pictures: to label.
        detect: the detector.
        settings: how many views, and how many of them must agree.
        views: what a view may be.
        seed: of the views.
        progress: show it.
    """
    result = []
    with terminal.progress("homographic adaptation", "picture", len(pictures), progress) as shown:
        for s, source in enumerate(pictures.sources):
            labels = []
            for p, picture in enumerate(source.pictures):
                labels.append(_adapt_one(picture, detect, settings, views, np.random.default_rng([seed, s, p])))
                shown.advance()
            result.append(labels)
    return result


def _adapt_one(
    picture: UInt8, detect: Detector, settings: AdaptationSettings, views: ViewSettings, rng: np.random.Generator
) -> PointLabels:
    height, width = picture.shape
    size = (views.width, views.height)
    homographies = np.stack([random_view(rng, views, (width, height)) for _ in range(settings.views)])
    consensus = Consensus(width, height)
    for keypoints, H in zip(detect(picture, homographies, size), homographies, strict=True):
        consensus.add(keypoints, H, size, settings.border)
    return consensus.labels(settings)
