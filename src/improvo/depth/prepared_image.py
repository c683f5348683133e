"""A frame as the plane sweep reads it: half the size, with the sums of every window."""

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

    values: Float32  # (h, w) grey levels less 128, times LEVELS
    sums: Float32  # (h, w) over each window
    inverse_spread: Float32  # (h, w) 1 / (window area * standard deviation of the window), in these values
    packed: NDArray[np.uint32]  # (h * w,) four bytes: the pixel, right of it, below it, right below it

    @property
    def size(self) -> tuple[int, int]:
        """Width and height."""
        return self.values.shape[1], self.values.shape[0]

    @property
    def grey(self) -> UInt8:
        """(h, w) the picture."""
        return (self.values / LEVELS + 128).astype(np.uint8)


def prepare_image(image: UInt8) -> PreparedImage:
    """Halve a grey image (H, W) and sum its windows; a last odd row or column is left out."""
    height, width = image.shape[0] // 2, image.shape[1] // 2
    half = cv2.resize(image[: 2 * height, : 2 * width], (width, height), interpolation=cv2.INTER_AREA)
    values = (half.astype(np.float32) - 128) * LEVELS
    sums = cv2.boxFilter(values.astype(np.float64), -1, (WINDOW, WINDOW), normalize=False)
    squares = cv2.boxFilter(values.astype(np.float64) ** 2, -1, (WINDOW, WINDOW), normalize=False)
    spread_squared = np.maximum(WINDOW * WINDOW * np.rint(squares) - np.rint(sums) ** 2, 1)
    padded = np.pad(half, ((0, 1), (0, 1)), mode="edge").astype(np.uint32)
    packed = padded[:-1, :-1] | padded[:-1, 1:] << 8 | padded[1:, :-1] << 16 | padded[1:, 1:] << 24
    return PreparedImage(
        values,
        np.rint(sums).astype(np.float32),
        (1 / np.sqrt(spread_squared)).astype(np.float32),
        packed.ravel().astype(np.uint32),
    )
