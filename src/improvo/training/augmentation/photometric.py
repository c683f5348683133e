"""Random light and sensor: what may differ between two views without anything having moved."""

from __future__ import annotations

import cv2
import numpy as np

from improvo.training.settings import PhotometricSettings
from improvo.types import UInt8


def augment(image: UInt8, rng: np.random.Generator, settings: PhotometricSettings) -> UInt8:
    """A copy under another light and another sensor, in the order light travels.

    Args:
        image: (H, W) grey.
        rng: of all choices.
        settings: what may change, and how much.
    """
    result = image.astype(np.float32)
    if rng.uniform() < settings.shade_share:
        result *= _shade(result.shape, rng, settings.shade)
    if rng.uniform() < settings.vignette_share:
        result *= _vignette(result.shape, rng)
    if rng.uniform() < settings.motion_share:
        result = _motion_blur(result, rng, settings.motion_length)
    if rng.uniform() < settings.blur_share:
        result = cv2.GaussianBlur(result, (0, 0), 0.3 + rng.uniform() * max(settings.blur_sigma - 0.3, 0.0))
    low, high = settings.gamma
    gamma = float(np.exp(rng.uniform(np.log(low), np.log(high))))
    result = 255 * np.power(np.clip(result, 0, 255) / 255, gamma)
    result = (result - 127) * rng.uniform(*settings.contrast) + 127 + rng.uniform(-1, 1) * settings.brightness
    sigma = settings.noise * rng.uniform() ** 2  # weak noise is more common than strong
    result += sigma * rng.standard_normal(result.shape, np.float32)
    pixels = np.clip(result, 0, 255).astype(np.uint8)
    _speckle(pixels, rng, settings.speckle)
    if rng.uniform() < settings.jpeg_share:
        quality = int(rng.integers(*settings.jpeg_quality))
        encoded = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
        return np.asarray(cv2.imdecode(encoded, cv2.IMREAD_GRAYSCALE), np.uint8)
    return pixels


def _shade(shape: tuple[int, ...], rng: np.random.Generator, strongest: float) -> np.ndarray:
    """A few soft ellipses that darken or brighten, made small and enlarged: their edges are meant to be soft."""
    height, width = shape[0] // 8 + 2, shape[1] // 8 + 2
    mask = np.zeros((height, width), np.float32)
    for _ in range(int(rng.integers(1, 5))):
        axes = [max(1, int(rng.uniform(0.1, 0.45) * side)) for side in (width, height)]
        centre = [int(rng.integers(0, side)) for side in (width, height)]
        cv2.ellipse(mask, centre, axes, rng.uniform(0, 180), 0, 360, 1.0, -1)
    mask = cv2.GaussianBlur(mask, (0, 0), rng.uniform(0.6, 3.0))
    mask = cv2.resize(mask, (shape[1], shape[0]), interpolation=cv2.INTER_LINEAR)
    return 1 + mask * np.float32(rng.uniform(-strongest, strongest))


def _vignette(shape: tuple[int, ...], rng: np.random.Generator) -> np.ndarray:
    y = np.linspace(-1, 1, shape[0], dtype=np.float32)[:, None] - np.float32(rng.uniform(-0.3, 0.3))
    x = np.linspace(-1, 1, shape[1], dtype=np.float32)[None] - np.float32(rng.uniform(-0.3, 0.3))
    return 1 - np.float32(rng.uniform(0.1, 0.35)) * (x * x + y * y)


def _motion_blur(image: np.ndarray, rng: np.random.Generator, longest: int) -> np.ndarray:
    length = int(rng.integers(2, max(longest, 2) + 1))
    size = length | 1
    kernel = np.zeros((size, size), np.float32)
    angle = rng.uniform(0, np.pi)
    step = 0.5 * (length - 1) * np.array([np.cos(angle), np.sin(angle)])
    start, end = (size // 2 - step).round().astype(int), (size // 2 + step).round().astype(int)
    cv2.line(kernel, [int(v) for v in start], [int(v) for v in end], 1.0, 1)
    return cv2.filter2D(image, -1, kernel / kernel.sum(), borderType=cv2.BORDER_REFLECT_101)


def _speckle(pixels: UInt8, rng: np.random.Generator, largest_share: float) -> None:
    count = int(pixels.size * rng.uniform(0, largest_share))
    where = rng.integers(0, pixels.size, count)
    pixels.reshape(-1)[where] = np.where(rng.uniform(size=count) < 0.5, 0, 255)
