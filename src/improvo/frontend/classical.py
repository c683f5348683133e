"""SIFT, ORB, AKAZE and SURF behind the `Frontend` interface.

The paper compares with "the default OpenCV implementation" of each; `sensitive=False` is that. Odometry also needs
keypoints on weakly textured walls and doors, so `sensitive=True` lowers the detection threshold. The best
`max_keypoints` are kept in both cases, so only images with too few keypoints change.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import cv2
import numpy as np

from improvo.errors import ConfigError, InputError, MissingExtraError, installed
from improvo.frontend.masking import check_image, check_mask, unmasked, without_masked
from improvo.types import Features, Float32, Int64, Mask, UInt8

_opencv: Any = cv2  # its type stubs lack the detectors' constructors
_SMALLEST_SIDE = 8  # pixels; no detector finds anything in less, and some fail
_ORB_CANDIDATES = 4  # times max_keypoints; ORB's own choice of the strongest clusters on few structures


class ClassicalFrontend:
    """One of OpenCV's detectors with its descriptor.

    Args:
        name: `sift`, `orb` or `akaze`.
        max_keypoints: keep at most this many, strongest first.
        sensitive: lower the detection threshold.
        spread: pick ORB's points evenly over the image instead of the strongest.

    Raises:
        ConfigError: an unknown name.
    """

    def __init__(self, name: str, max_keypoints: int = 1000, sensitive: bool = False, spread: bool = False) -> None:
        if name not in _DETECTORS:
            raise ConfigError(f"frontend {name!r}: unknown; choose among {', '.join(_DETECTORS)}")
        self.name = name
        self._max_keypoints = max_keypoints
        self._spread = spread
        self._sensitive = sensitive
        candidates = max_keypoints * (_ORB_CANDIDATES if spread else 1)
        self._detector = _DETECTORS[name](candidates, sensitive)

    def __call__(self, image: UInt8, mask: Mask | None = None) -> Features:
        """Features of one image (H, W) or (H, W, 3) BGR, uint8; where there is a mask (H, W), on its True pixels."""
        grey = to_grey(image)
        check_mask(mask, grey.shape)
        if min(grey.shape) < _SMALLEST_SIDE:
            return self._nothing()
        cv2.setRNGSeed(0)  # some detectors sample; the same image must give the same features
        found = self._detector.detect(grey, None) if mask is None else self._detect_unmasked(grey, mask)
        order, pixels = _best_first(found)
        if self._spread:
            order = order[spread_over_image(pixels[order], grey.shape, self._max_keypoints)]
        found = [found[i] for i in order[: self._max_keypoints].tolist()]
        found, descriptors = self._detector.compute(grey, found)
        if not found:
            return self._nothing()
        keypoints = np.array([keypoint.pt for keypoint in found], np.float32)
        scores = np.array([keypoint.response for keypoint in found], np.float32)
        best_first = np.argsort(-scores, kind="stable")[: self._max_keypoints]
        if descriptors.dtype != np.uint8:
            descriptors = unit_rows(descriptors)
        return Features(keypoints, descriptors, scores).take(best_first)

    def _detect_unmasked(self, grey: UInt8, mask: Mask) -> list[Any]:
        """Keypoints on used pixels; no masked one takes part in a detector's own choice of the best."""
        # SIFT chooses before it masks, so it is asked for all of them
        detector = _DETECTORS["sift"](0, self._sensitive) if self.name == "sift" else self._detector
        found = list(detector.detect(grey, mask.astype(np.uint8)))
        if not found:
            return found
        kept = unmasked(np.asarray(cv2.KeyPoint.convert(found), np.float32).reshape(-1, 2), mask)
        return [keypoint for keypoint, on in zip(found, kept, strict=True) if on]

    def _nothing(self) -> Features:
        binary = self._detector.descriptorType() == cv2.CV_8U
        width = self._detector.descriptorSize()
        descriptors = np.zeros((0, width), np.uint8 if binary else np.float32)
        return Features(np.zeros((0, 2), np.float32), descriptors, np.zeros(0, np.float32))


class SurfFrontend:
    """SURF (Bay 2008), from OpenCV where the build has it, else from mahotas.

    OpenCV's pre-built packages leave SURF out.

    Raises:
        MissingExtraError: neither has it.
    """

    name = "surf"

    def __init__(self, max_keypoints: int = 1000, sensitive: bool = False) -> None:
        self._max_keypoints = max_keypoints
        self._threshold = 0.01 if sensitive else 0.1
        self._opencv = _opencv_surf(30.0 if sensitive else 100.0)
        if self._opencv is None and not installed("mahotas"):
            raise MissingExtraError("the frontend surf", "surf")

    def __call__(self, image: UInt8, mask: Mask | None = None) -> Features:
        """Features of one image (H, W) or (H, W, 3) BGR, uint8; where there is a mask (H, W), on its True pixels."""
        grey = to_grey(image)
        check_mask(mask, grey.shape)
        count = self._max_keypoints if mask is None else max(self._max_keypoints, grey.size // 64)  # all there are
        rows = self._with_mahotas(grey, count) if self._opencv is None else self._with_opencv(grey)
        keypoints, scores, descriptors = rows
        features = without_masked(Features(keypoints, unit_rows(descriptors), scores), mask)
        return features.take(np.argsort(-features.scores, kind="stable")[: self._max_keypoints])

    def _with_mahotas(self, grey: UInt8, count: int) -> tuple[Float32, Float32, Float32]:
        from mahotas.features import surf

        rows = surf.surf(grey, threshold=self._threshold, max_points=count)
        # rows are y, x, scale, score, laplacian, angle, 64 descriptor values
        return rows[:, 1::-1].astype(np.float32), rows[:, 3].astype(np.float32), rows[:, 6:].astype(np.float32)

    def _with_opencv(self, grey: UInt8) -> tuple[Float32, Float32, Float32]:
        assert self._opencv is not None
        found, descriptors = self._opencv.detectAndCompute(grey, None)
        if not found:
            return np.zeros((0, 2), np.float32), np.zeros(0, np.float32), np.zeros((0, 64), np.float32)
        keypoints = np.array([keypoint.pt for keypoint in found], np.float32)
        return keypoints, np.array([keypoint.response for keypoint in found], np.float32), descriptors


def to_grey(image: UInt8) -> UInt8:
    """(H, W) or (H, W, 3) BGR uint8 -> (H, W) uint8.

    Raises:
        InputError: an image of another shape or type, or without pixels.
    """
    check_image(image)
    if image.ndim not in (2, 3) or (image.ndim == 3 and image.shape[2] != 3) or 0 in image.shape:
        raise InputError(f"image of shape {image.shape}: give (H, W) grey or (H, W, 3) colour")
    if image.dtype != np.uint8:
        raise InputError(f"image of type {image.dtype}: give uint8")
    return image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)


def unit_rows(descriptors: Float32) -> Float32:
    """Rows scaled to unit L2 norm; zero rows stay zero."""
    norms = np.linalg.norm(descriptors, axis=1, keepdims=True)
    return (descriptors / np.maximum(norms, 1e-12)).astype(np.float32)


def _best_first(found: Sequence[Any]) -> tuple[Int64, Float32]:
    """Order of OpenCV's keypoints by response, ties by place and angle; and their pixels (N, 2)."""
    pixels = np.asarray(cv2.KeyPoint.convert(found), np.float32).reshape(-1, 2)
    angles = np.array([keypoint.angle for keypoint in found])
    responses = np.array([keypoint.response for keypoint in found])
    return np.lexsort((angles, pixels[:, 1], pixels[:, 0], -responses)), pixels


def spread_over_image(pixels: Float32, shape: tuple[int, ...], count: int) -> Int64:
    """Indices of up to `count` pixels (N, 2), sorted best first, taken in turn from the cells of a grid.

    Each cell gives its best point, then its second best and so on, so that a weakly textured part of the image keeps
    some points.
    """
    cell = max(8.0, float(np.sqrt(shape[0] * shape[1] / max(count, 1)) * 2))
    columns = int(shape[1] // cell) + 1
    cells = (pixels[:, 1] // cell).astype(np.int64) * columns + (pixels[:, 0] // cell).astype(np.int64)
    order = np.argsort(cells, kind="stable")
    starts = np.searchsorted(cells[order], cells[order])
    rank = np.empty(len(pixels), np.int64)
    rank[order] = np.arange(len(pixels)) - starts  # 0 for the best of its cell
    return np.argsort(rank, kind="stable")[:count]


def _sift(count: int, sensitive: bool) -> Any:
    return _opencv.SIFT_create(nfeatures=count, contrastThreshold=0.01 if sensitive else 0.04)


def _orb(count: int, sensitive: bool) -> Any:
    return _opencv.ORB_create(nfeatures=count, fastThreshold=5 if sensitive else 20)


def _akaze(count: int, sensitive: bool) -> Any:
    # OpenCV 5 moved AKAZE to the contrib module
    contributed = getattr(_opencv, "xfeatures2d", None)
    create = getattr(_opencv, "AKAZE_create", None) or getattr(contributed, "AKAZE_create", None)
    if create is None:
        raise ConfigError(
            f"frontend akaze: OpenCV {cv2.__version__} has it in opencv-contrib-python(-headless) alone; install that"
        )
    return create(threshold=1e-4 if sensitive else 1e-3)


def _opencv_surf(hessian_threshold: float) -> Any | None:
    try:
        return _opencv.xfeatures2d.SURF_create(hessian_threshold)
    except (AttributeError, cv2.error):
        return None


_DETECTORS: dict[str, Callable[[int, bool], Any]] = {"sift": _sift, "orb": _orb, "akaze": _akaze}
