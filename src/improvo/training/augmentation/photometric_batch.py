"""Random light and sensor for whole batches on a device: the effects of `photometric.augment`, in torch."""

from __future__ import annotations

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from improvo.training.device import on_device
from improvo.training.settings import PhotometricSettings

_RADIUS = 4  # pixels of the blur kernels
# the table of luminance of the JPEG standard (annex K), row by row
_QUANTISATION = (
    "16 11 10 16 24 40 51 61 12 12 14 19 26 58 60 55 14 13 16 24 40 57 69 56 14 17 22 29 51 87 80 62 "
    "18 22 37 56 68 109 103 77 24 35 55 64 81 104 113 92 49 64 78 87 103 121 120 101 72 92 95 98 112 100 103 99"
)


def augment_batch(
    images: Tensor, rng: np.random.Generator, generator: torch.Generator, settings: PhotometricSettings
) -> Tensor:
    """Copies (V, 1, H, W) uint8 of grey images under other light and another sensor, in the order light travels.

    Args:
        images: (V, 1, H, W) float, 0 to 255; H and W multiples of 8.
        rng: of what differs between images.
        generator: of what differs between pixels, on the images' device.
    """
    count, _, height, width = images.shape

    def chosen(share: float) -> np.ndarray:
        return rng.uniform(size=count) < share

    def each(values: np.ndarray) -> Tensor:
        return on_device(values, images.device)[:, None, None, None]

    result = images * _shade(rng, chosen(settings.shade_share), height, width, settings.shade, images.device)
    result = result * _vignette(rng, chosen(settings.vignette_share), height, width, images.device)
    result = _blurred(result, rng, chosen(settings.motion_share), chosen(settings.blur_share), settings)
    low, high = settings.gamma
    gamma = np.exp(rng.uniform(np.log(low), np.log(high), count))
    result = 255 * (result.clamp(0, 255) / 255).pow(each(gamma))
    contrast = rng.uniform(*settings.contrast, count)
    shift = 127 * (1 - contrast) + rng.uniform(-1, 1, count) * settings.brightness
    result = result * each(contrast) + each(shift)
    sigma = settings.noise * rng.uniform(size=count) ** 2  # weak noise is more common than strong
    result = result + each(sigma) * torch.randn(result.shape, generator=generator, device=images.device)
    chance = torch.rand(result.shape, generator=generator, device=images.device)
    half = each(0.5 * settings.speckle * rng.uniform(size=count))
    result = torch.where(chance < half, 0.0, torch.where(chance > 1 - half, 255.0, result)).clamp(0, 255)
    rows = np.flatnonzero(chosen(settings.jpeg_share))
    if len(rows):
        where = on_device(rows, images.device)
        quality = rng.integers(*settings.jpeg_quality, len(rows))
        result = result.index_copy(0, where, _compressed(result[where].round(), quality))
    return result.round().to(torch.uint8)


def _shade(
    rng: np.random.Generator, chosen: np.ndarray, height: int, width: int, strongest: float, device: torch.device
) -> Tensor:
    """(V, 1, H, W) factors of a few soft ellipses that darken or brighten; 1 where none is chosen."""
    count, most = len(chosen), 4
    h, w = height // 8 + 2, width // 8 + 2
    half_axes = rng.uniform(0.1, 0.45, (2, count, most)) * np.reshape((w, h), (2, 1, 1))
    centre = rng.uniform(0, 1, (2, count, most)) * np.reshape((w, h), (2, 1, 1))
    angle, soft = rng.uniform(0, np.pi, (count, most)), rng.uniform(0.05, 0.4, (count, most))
    present = np.arange(most) < rng.integers(1, most + 1, (count, 1))
    strength = np.broadcast_to((chosen * rng.uniform(-strongest, strongest, count))[:, None], (count, most))
    values = np.stack([*half_axes, *centre, np.cos(angle), np.sin(angle), soft, present, strength])
    a, b, x, y, c, s, soft_, present_, strength_ = on_device(values, device)[..., None, None]  # (V, most, 1, 1) each
    dx = torch.arange(w, device=device) - x
    dy = torch.arange(h, device=device)[:, None] - y
    radius = torch.hypot((c * dx + s * dy) / a, (c * dy - s * dx) / b)
    inside = (0.5 + (1 - radius) / (2 * soft_)).clamp(0, 1) * present_
    factor = 1 + inside.amax(dim=1, keepdim=True) * strength_[:, :1]
    return functional.interpolate(factor, size=(height, width), mode="bilinear", align_corners=False)


def _vignette(rng: np.random.Generator, chosen: np.ndarray, height: int, width: int, device: torch.device) -> Tensor:
    """(V, 1, H, W) factors, darker towards the corners; 1 where none is chosen."""
    count = len(chosen)
    values = np.stack(
        [rng.uniform(-0.3, 0.3, count), rng.uniform(-0.3, 0.3, count), chosen * rng.uniform(0.1, 0.35, count)]
    )
    right, down, strength = on_device(values, device)[..., None, None, None]
    x = torch.linspace(-1, 1, width, device=device) - right
    y = torch.linspace(-1, 1, height, device=device)[:, None] - down
    return 1 - strength * (x * x + y * y)


def _blurred(
    images: Tensor, rng: np.random.Generator, moved: np.ndarray, soft: np.ndarray, settings: PhotometricSettings
) -> Tensor:
    """Motion along a short line and defocus, as one kernel for each image that has either."""
    count = len(moved)
    length = rng.integers(2, max(settings.motion_length, 2) + 1, count) * moved
    angle = rng.uniform(0, np.pi, count)
    sigma = np.where(soft, 0.3 + rng.uniform(size=count) * max(settings.blur_sigma - 0.3, 0.0), 0.3)
    rows = np.flatnonzero(moved | soft)
    if not len(rows):
        return images
    along = np.linspace(-0.5, 0.5, 9) * np.maximum(length[rows, None] - 1, 0)  # (R, 9) pixels along the line
    y, x = np.mgrid[-_RADIUS : _RADIUS + 1, -_RADIUS : _RADIUS + 1]
    dx = x - (along * np.cos(angle[rows, None]))[..., None, None]
    dy = y - (along * np.sin(angle[rows, None]))[..., None, None]
    kernels = np.exp(-(dx * dx + dy * dy) / (2 * sigma[rows, None, None, None] ** 2)).sum(axis=1)
    kernels /= kernels.sum(axis=(1, 2), keepdims=True)
    weight = on_device(kernels[:, None], images.device)
    where = on_device(rows, images.device)
    padded = functional.pad(images[where], (_RADIUS,) * 4, mode="reflect").transpose(0, 1)
    return images.index_copy(0, where, functional.conv2d(padded, weight, groups=len(rows)).transpose(0, 1))


def _compressed(images: Tensor, quality: np.ndarray) -> Tensor:
    """What JPEG of a quality (V,) from 1 to 100 leaves of images (V, 1, H, W): the same blocks and rounding."""
    count, _, height, width = images.shape
    dct = on_device(_dct(), images.device)
    scale = np.where(quality < 50, 5000 / np.maximum(quality, 1), 200 - 2 * quality)
    table = np.array(_QUANTISATION.split(), np.float64).reshape(8, 8)
    steps = np.clip(np.floor((table * scale[:, None, None] + 50) / 100), 1, 255).astype(np.float32)
    step = on_device(steps, images.device)[:, None, None]  # (V, 1, 1, 8, 8)
    blocks = images.view(count, height // 8, 8, width // 8, 8).transpose(2, 3) - 128
    coefficients = ((dct @ blocks @ dct.T) / step).round() * step
    restored = (dct.T @ coefficients @ dct).transpose(2, 3).reshape(images.shape)
    return (restored + 128).clamp(0, 255)


def _dct() -> np.ndarray:
    """(8, 8) float32, the orthonormal cosine transform."""
    return np.asarray(cv2.dct(np.eye(8, dtype=np.float64), flags=cv2.DCT_ROWS).T, np.float32)
