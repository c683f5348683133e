"""What a frontend is given, an image and maybe a mask: the one place where a mask is applied to a frontend."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from improvo.errors import InputError
from improvo.types import Features, Float32, Frame, Mask


def features_of(frontend: Callable[..., Features], frame: Frame) -> Features:
    """Features of a frame, none of them on a masked pixel.

    Args:
        frontend: is given the mask only where there is one, so that one without an argument for it serves all others.
        frame: with or without a mask.
    """
    return frontend(frame.image) if frame.mask is None else frontend(frame.image, frame.mask)


def unmasked(keypoints: Float32, mask: Mask) -> NDArray[np.bool_]:
    """(N,) whether keypoints (N, 2) lie on used pixels."""
    height, width = mask.shape
    x, y = np.rint(keypoints).astype(np.int64).T
    inside = (x >= 0) & (y >= 0) & (x < width) & (y < height)
    return np.asarray(inside & mask[np.clip(y, 0, height - 1), np.clip(x, 0, width - 1)])


def without_masked(features: Features, mask: Mask | None) -> Features:
    """The features on used pixels, in their order."""
    return features if mask is None else features.take(unmasked(features.keypoints, mask))


def check_image(image: object) -> None:
    """Refuse what is no array, such as a path, or the None that `cv2.imread` gives for a file that it cannot read.

    Raises:
        InputError: it is none.
    """
    if not isinstance(image, np.ndarray):
        nothing = "; cv2.imread gives None where it cannot read the file" if image is None else ""
        raise InputError(f"image: is a {type(image).__name__}, give a NumPy array (H, W) or (H, W, 3){nothing}")


def check_mask(mask: Mask | None, shape: tuple[int, ...]) -> None:
    """Refuse a mask of another size than the image of a shape (H, W) or (H, W, 3), and one of numbers.

    Raises:
        InputError: it is.
    """
    if mask is not None and mask.dtype != np.bool_:
        raise InputError(f"mask of type {mask.dtype}: give truth values, such as `mask > 0`")
    if mask is not None and mask.shape != shape[:2]:
        raise InputError(f"mask of shape {mask.shape} for an image of shape {shape[:2]}; they must be the same")
