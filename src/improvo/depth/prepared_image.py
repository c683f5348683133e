"""A frame as the plane sweep reads it: half the size, with the four bytes that interpolation needs side by side."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from improvo.depth.sweep_kernels import LEVELS, WINDOW
from improvo.types import Float32, UInt8


@dataclass(frozen=True)
class PreparedImage:
    """What is computed once for a frame, and used with every other one."""

    grey: UInt8  # (h, w)
    packed: NDArray[np.uint32]  # (h * w,) four bytes: the pixel, right of it, below it, right below it

    @property
    def size(self) -> tuple[int, int]:
        """Width and height."""
        return self.grey.shape[1], self.grey.shape[0]

    def values(self) -> Float32:
        """(h, w) grey levels less 128, times LEVELS."""
        return (self.grey.astype(np.float32) - 128) * LEVELS

    def window_sums(self) -> tuple[Float32, Float32]:
        """Of every window: the sum of the values, and 1 / (area * standard deviation); both (h, w)."""
        values = self.values().astype(np.float64)
        sums = np.rint(cv2.boxFilter(values, -1, (WINDOW, WINDOW), normalize=False))
        squares = np.rint(cv2.boxFilter(values**2, -1, (WINDOW, WINDOW), normalize=False))
        spread_squared = np.maximum(WINDOW * WINDOW * squares - sums**2, 1)
        return sums.astype(np.float32), (1 / np.sqrt(spread_squared)).astype(np.float32)


def prepare_image(image: UInt8) -> PreparedImage:
    """Halve a grey image (H, W); a last odd row or column is left out."""
    height, width = image.shape[0] // 2, image.shape[1] // 2
    half = cv2.resize(image[: 2 * height, : 2 * width], (width, height), interpolation=cv2.INTER_AREA)
    padded = np.pad(half, ((0, 1), (0, 1)), mode="edge").astype(np.uint32)
    packed = padded[:-1, :-1] | padded[:-1, 1:] << 8 | padded[1:, :-1] << 16 | padded[1:, 1:] << 24
    return PreparedImage(half, packed.ravel().astype(np.uint32))
