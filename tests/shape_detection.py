"""Average precision of corner detectors on drawn shapes, where the truth is exact (SuperPoint, section 4)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from improvo.evaluation.statistics import average_precision
from improvo.training.augmentation.photometric import augment
from improvo.training.data.shapes import FAMILIES, draw_shape
from improvo.training.settings import PhotometricSettings
from improvo.types import Float32, UInt8

# grey image -> keypoints (N, 2) and their scores (N,)
ScoredDetector = Callable[[UInt8], tuple[Float32, Float32]]
CORNERLESS = ("ellipses", "noise")  # families in which every detection is wrong


@dataclass(frozen=True)
class ShapeTest:
    """One test picture with its exact corners."""

    family: str
    image: UInt8  # (H, W)
    corners: Float32  # (N, 2)


def shape_tests(
    count: int, seed: int = 0, noise: PhotometricSettings | None = None, size: tuple[int, int] = (160, 120)
) -> list[ShapeTest]:
    """`count` pictures of every family, of `size` (width, height); `noise` changes their light and sensor."""
    tests = []
    for index in range(count):
        for position, family in enumerate(FAMILIES):
            rng = np.random.default_rng([seed, position, index])
            image, corners = draw_shape(rng, family, *size)
            tests.append(ShapeTest(family, augment(image, rng, noise) if noise else image, corners))
    return tests


def mean_average_precision(
    detect: ScoredDetector, tests: Sequence[ShapeTest], pixels: float = 3.0
) -> tuple[float, dict[str, float]]:
    """Mean over the families with corners of the area under precision and recall, and each family's.

    A detection is right if it is the best-scored one within `pixels` of a corner. The pictures without corners are
    part of every family's set: what is found there counts against the detector.
    """
    found = [(test, *detect(test.image)) for test in tests]
    by_family = {}
    for family in FAMILIES:
        if family not in CORNERLESS:
            chosen = [entry for entry in found if entry[0].family in (family, *CORNERLESS)]
            by_family[family] = _average_precision(chosen, pixels)
    return float(np.mean(list(by_family.values()))), by_family


def _average_precision(found: Sequence[tuple[ShapeTest, Float32, Float32]], pixels: float) -> float:
    scores: list[float] = []
    right: list[bool] = []
    corners = sum(len(test.corners) for test, _, _ in found)
    for test, keypoints, confidence in found:
        order = np.argsort(-confidence, kind="stable")
        free = np.ones(len(test.corners), bool)
        for keypoint in keypoints[order]:
            distance = np.where(free, np.linalg.norm(test.corners - keypoint, axis=1), np.inf)
            nearest = int(distance.argmin()) if len(distance) else -1
            hit = nearest >= 0 and bool(distance[nearest] <= pixels)
            if hit:
                free[nearest] = False
            right.append(hit)
        scores.extend(confidence[order])
    return average_precision(np.array(scores, np.float64), np.array(right, np.bool_), corners) or 0.0


def classical_detectors(keypoints: int = 100) -> Mapping[str, ScoredDetector]:
    """Harris, Shi-Tomasi and FAST, each with its own response as the score."""

    def peaks(response: Float32) -> tuple[Float32, Float32]:
        y, x = np.nonzero((response == cv2.dilate(response, np.ones((9, 9), np.uint8))) & (response > 0))
        best = np.argsort(-response[y, x], kind="stable")[:keypoints]
        return np.stack([x, y], axis=1).astype(np.float32)[best], response[y, x][best]

    def fast(image: UInt8) -> tuple[Float32, Float32]:
        found = cv2.FastFeatureDetector.create(threshold=5).detect(image)
        found = sorted(found, key=lambda keypoint: -keypoint.response)[:keypoints]
        points = np.array([keypoint.pt for keypoint in found], np.float32).reshape(-1, 2)
        return points, np.array([keypoint.response for keypoint in found], np.float32)

    return {
        "harris": lambda image: peaks(cv2.cornerHarris(image, 3, 3, 0.04)),
        "shi-tomasi": lambda image: peaks(cv2.cornerMinEigenVal(image, 3)),
        "fast": fast,
    }
